"""Plans of homes of several seeds: rooms, walls, doors on their hinges and maps; no scan is made here."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
import shapely

from converters.generate import GenerationError, design_building
from converters.generate.homes.building import Plan
from converters.generate.homes.config import HomeConfig
from converters.generate.homes.doors import DOOR_GAP_M, SIDE_WALL_M, hang_doors, wall_behind_m
from converters.generate.homes.plans import home_plan
from converters.generate.homes.space import floor_maps, image_size
from converters.generate.models.cad import Instance, cad_model, place
from interactive_nav_common.errors import ConfigError

SEEDS = range(8)
CONFIG = HomeConfig()


@functools.cache
def drawn(seed: int) -> Plan:
    return home_plan(CONFIG, np.random.default_rng(seed))[0]


@functools.cache
def leaves(seed: int) -> list[Instance]:
    hung = hang_doors(drawn(seed), CONFIG, np.random.default_rng(seed))
    assert hung is not None
    return [item for item, _ in hung[0]]


def polygon(rect) -> shapely.Polygon:
    return shapely.box(rect.x0, rect.y0, rect.x1, rect.y1)


def turned(item: Instance, angle_rad: float) -> Instance:
    """A door leaf turned about its hinge by an angle, by plain geometry in the floor plane."""
    assert item.hinge is not None
    hinge = item.to_floor(np.array([item.hinge.origin]))[0]
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    offset = item.position - hinge
    moved = hinge + np.array([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1], offset[2]])
    return dataclasses.replace(item, yaw_rad=item.yaw_rad + angle_rad, position=moved)


@pytest.mark.parametrize("seed", SEEDS)
def test_rooms_walls_and_doorways_do_not_overlap_and_lintels_close_the_walls(seed):
    plan = drawn(seed)
    rooms = [polygon(r) for r in plan.rooms]
    holes = [polygon(d.rect) for d in plan.doorways]
    standing = [polygon(w.rect) for w in plan.walls if w.low[2] == 0]
    lintels = [w for w in plan.walls if w.low[2] > 0]
    pieces = rooms + holes + standing
    for a, b in itertools.combinations(pieces, 2):
        assert a.intersection(b).area < 1e-9
    assert len(lintels) == len(holes)
    assert all(w.low[2] == plan.doorways[0].height_m and w.high[2] == plan.wall_height_m for w in lintels)
    assert all(d.width_m >= 0.92 - 1e-9 for d in plan.doorways)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_leaf_hangs_at_a_jamb_and_swings_from_closed_to_the_wall(seed):
    plan = drawn(seed)
    walls = shapely.union_all([polygon(w.rect) for w in plan.walls if w.low[2] == 0])
    for item in leaves(seed):
        assert item.hinge is not None
        low, high = item.hinge.range_rad
        assert item.hinge.axis.tolist() == [0.0, 1.0, 0.0] and low < 0 < high
        bottom = item.to_floor(np.concatenate([p.vertices for p in item.model.parts]))[:, 2].min()
        assert 0.005 <= bottom <= 0.0105
        hinge = item.to_floor(np.array([item.hinge.origin]))[0]
        # The hinge line: DOOR_GAP_M from the jamb, 2 cm before the wall's face.
        doorway = min(plan.doorways, key=lambda d: polygon(d.rect).distance(shapely.Point(hinge[:2])))
        outline = polygon(doorway.rect)
        assert outline.distance(shapely.Point(hinge[:2])) == pytest.approx(CONFIG.leaf_proud_m, abs=1e-6)
        along = 1 - doorway.axis
        ends = doorway.rect.span(along)
        assert min(abs(hinge[along] - e) for e in ends) == pytest.approx(DOOR_GAP_M, abs=1e-6)
        # A side wall is close behind the hinge, and the leaf opens into no corridor.
        high_side = hinge[doorway.axis] > doorway.rect.centre[doorway.axis]
        high_jamb = hinge[along] > doorway.rect.centre[along]
        assert doorway.rooms[int(high_side)] != plan.corridor
        assert 0 < wall_behind_m(doorway, high_side, high_jamb, plan) <= SIDE_WALL_M
        # One end of the range closes it: the slab (first part; handles stand off) then lies in the doorway.
        slab, near = item.model.parts[0].vertices, outline.buffer(CONFIG.leaf_proud_m + 1e-6)
        closed = [
            near.contains(shapely.MultiPoint(turned(item, a).to_floor(slab)[:, :2]).convex_hull) for a in (low, high)
        ]
        assert sum(closed) == 1
        opened = -low if closed[0] else high
        assert math.radians(84) <= opened <= math.radians(115) + 1e-9
        assert math.pi / 2 <= high - low <= math.radians(121)
        # No other leaf stands in the sweep; the slab never enters a wall.
        others = [o.footprint for o in leaves(seed) if o is not item]
        for angle in np.linspace(low, high, 25):
            leaf = shapely.MultiPoint(turned(item, angle).to_floor(slab)[:, :2]).convex_hull
            assert leaf.intersection(walls).area < 1e-6
            assert all(not leaf.intersects(o) for o in others)


@pytest.mark.parametrize("seed", SEEDS)
def test_maps_show_the_static_structure_at_one_centimetre(seed):
    plan = drawn(seed)
    obstacles, traversable = floor_maps(plan)
    size = image_size(plan)
    assert obstacles.shape == traversable.shape == (size, size) and size % 2 == 0
    assert set(np.unique(obstacles)) == set(np.unique(traversable)) == {0, 255}
    assert not ((traversable == 255) & (obstacles == 0)).any()
    rooms_m2 = sum(r.area_m2 for r in plan.rooms) + sum(d.rect.area_m2 for d in plan.doorways)
    assert (traversable == 255).sum() * 1e-4 == pytest.approx(rooms_m2, abs=1e-6)
    for box in plan.walls:
        x, y = box.rect.centre
        expected = 0 if box.low[2] == 0 else 255  # above a doorway one walks through
        assert obstacles[int(y / 0.01 + size / 2), int(x / 0.01 + size / 2)] == expected


def test_place_faces_where_it_is_told():
    model = cad_model("dresser_tall")
    item = place(model, np.full(3, model.unit_m), np.array([1.0, 2.0]), math.radians(30))
    ahead = (item.to_floor(model.center[None] + [0, 0, 0.5]) - item.to_floor(model.center[None]))[0]
    assert math.atan2(ahead[1], ahead[0]) == pytest.approx(math.radians(30)) and ahead[2] == pytest.approx(0)
    assert item.footprint.centroid.coords[0] == pytest.approx((1.0, 2.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"floor_area_m2": (9.0, 9.0)}, "no plan in"),
        ({"n_rooms": (4, 3)}, "n_rooms is (4, 3), expected at least 1, ascending"),
        ({"voxel_m": -1.0}, "voxel_m is -1.0"),
        ({"models": ("chair_throne",)}, "unknown CAD models"),
        ({"models": ("dresser_tall",)}, "`models` names no door"),
        ({"corner_doorways": 1.5}, "corner_doorways is 1.5, expected between 0 and 1"),
    ],
)
def test_what_cannot_be_built_is_said_in_one_line(changes, message):
    with pytest.raises(ConfigError) as caught:
        design_building(0, dataclasses.replace(CONFIG, **changes))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_negative_seed_is_refused():
    with pytest.raises(GenerationError, match="seed is -1"):
        design_building(-1)
