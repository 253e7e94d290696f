"""What the detector overlooks: where obstacles stand, and the table."""

import numpy as np
import pytest

from docs.studies.policies.thin import OBSTACLES, ROOM_M, places, table
from tests.topological_nav.maps.test_sight import two_rooms_space


def test_obstacles_stand_on_the_floor_with_their_front_at_the_origin():
    sizes = {}
    for thing in OBSTACLES:
        corners = np.array([corner for box in thing.boxes for corner in box.corners_m])
        assert corners[:, 0].min() == pytest.approx(0.0, abs=1e-9) and corners[:, 2].min() == pytest.approx(0.0)
        assert corners[:, 1].min() == pytest.approx(-corners[:, 1].max())
        sizes[thing.name] = tuple(np.ptp(corners, axis=0).round(3).tolist())
    assert list(sizes.values()) == [
        (0.03, 0.03, 1.2), (0.44, 0.44, 0.45), (0.1, 0.8, 0.05), (0.3, 0.3, 0.15), (0.4, 0.4, 0.4)
    ]  # fmt: skip


def test_places_are_free_ahead():
    space = two_rooms_space()
    at = places(space, 20, np.random.default_rng(3), 1.2, 50)
    ahead = np.stack([np.cos(at[:, 2]), np.sin(at[:, 2])], -1)
    for share in np.linspace(0.0, 1.0, 13):
        assert space.at(at[:, :2] + share * 1.2 * ahead).min() >= ROOM_M - 0.08  # a cell's diagonal
    with pytest.raises(SystemExit, match="places are free for 50 m, expected 2"):
        places(space, 2, np.random.default_rng(3), 50.0, 50)


def test_the_table_has_wilson_intervals():
    free = np.zeros((16, 60), bool)
    free[0], free[1, :15] = True, True
    lines = table(free).splitlines()
    # Wilson, z = 1.96: 60 of 60 is [1 / (1 + 3.84 / 60), 1], 0 of 60 [0, 3.84 / 63.84], 15 of 60 [0.158, 0.372].
    assert lines[2] == "| nothing | 1.00 [0.94, 1.00] | 1.00 [0.94, 1.00] | 1.00 [0.94, 1.00] |"
    assert lines[3] == "| thin pole, 3 cm | 0.25 [0.16, 0.37] | 0.00 [0.00, 0.06] | 0.00 [0.00, 0.06] |"
    assert len(lines) == 2 + 1 + len(OBSTACLES)
