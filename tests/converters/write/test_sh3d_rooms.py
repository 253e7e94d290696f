"""Rooms of a map."""

import numpy as np
import pytest
import shapely

from converters.write.sh3d_rooms import rooms_of
from scenes_mjcf.schema import SceneMaps


@pytest.mark.parametrize(("door_m", "count"), [(0.9, 2), (2.0, 1)])
def test_a_doorway_parts_rooms_and_a_wide_passage_does_not(door_m, count):
    free = np.ones((60, 100), bool)
    free[:, 60:62] = False
    free[20 : 20 + round(door_m / 0.05), 60:62] = True
    cupboard = shapely.box(1.0, 2.5, 2.0, 3.0)
    free[50:, 20:40] = False
    wall = shapely.union_all([shapely.box(3, 0, 3.1, 1), shapely.box(3, 1 + door_m, 3.1, 3)])
    rooms = rooms_of(SceneMaps(free, 0.05, (0.0, 0.0), 0.0), cupboard, wall, 0.5, 0.0)
    assert len(rooms) == count
    whole = shapely.union_all(rooms)
    assert whole.covers(cupboard.buffer(-0.01)) and shapely.intersection(whole, wall).area < 1e-3
    assert whole.area == pytest.approx(15 - 0.1 * (3 - door_m), abs=0.01)


def test_a_narrow_room_behind_a_door_is_one():
    free = np.ones((40, 40), bool)
    free[:, 20] = False
    free[20:, :20] = False
    maps = SceneMaps(free, 0.05, (-1.0, 2.0), 0.0)
    rooms = rooms_of(maps, shapely.Polygon(), shapely.box(0.0, 2.0, 0.05, 4.0), 0.5, 0.0)
    assert [r.area for r in rooms] == pytest.approx([0.95 * 2, 1.0])
    assert shapely.distance(rooms[1], shapely.Point(-0.5, 2.5)) == 0
