"""Floor around a home is cut away; floor of a home, and of a scan without all of its walls, is not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from converters.structure.maps import OPENINGS_M, beyond_obstacles, floor_outside

CELL_M = 0.05


def flat(plane_m: float, door_m: float = 0.9, sides: str = "wens") -> tuple[np.ndarray, np.ndarray]:
    """Return floor and walls of a home of 6 x 5 m amid a plane, with a partition, a doorway in it and a front door."""
    side = round(plane_m / CELL_M)
    floor, walls = np.ones((side, side), bool), np.zeros((side, side), bool)
    low_r, low_c = (side - 100) // 2, (side - 120) // 2
    high_r, high_c = low_r + 100, low_c + 120
    walls[low_r:high_r, low_c : low_c + 2] = "w" in sides
    walls[low_r:high_r, high_c - 2 : high_c] = "e" in sides
    walls[low_r : low_r + 2, low_c:high_c] = "s" in sides
    walls[high_r - 2 : high_r, low_c:high_c] = "n" in sides
    walls[low_r:high_r, low_c + 60 : low_c + 62] = True
    walls[low_r + 40 : low_r + 58, low_c + 60 : low_c + 62] = False
    gap = round(door_m / CELL_M)
    walls[low_r : low_r + 2, low_c + 20 : low_c + 20 + gap] = False
    return floor & ~walls, walls


@pytest.mark.parametrize("plane_m", [8.0, 20.0])
@pytest.mark.parametrize("door_m", [0.0, 0.9, 1.8, 2.4])
def test_the_plane_around_a_home_is_cut_away(plane_m, door_m):
    floor, walls = flat(plane_m, door_m)
    left = floor & ~floor_outside(floor, walls, np.zeros_like(floor), CELL_M)
    # Inside of walls 0.1 m thick: 5.8 x 4.8 m less a partition of 0.1 x 4.8 m with a doorway of 0.9 m.
    inside_m2 = 5.8 * 4.8 - 0.1 * (4.8 - 0.9)
    # The disc that does not fit through the front door reaches into it by a segment of its circle.
    radius_m = next(width for width in OPENINGS_M if width > door_m) / 2
    segment_m2 = radius_m**2 * math.asin(door_m / 2 / radius_m) - door_m / 2 * math.sqrt(radius_m**2 - door_m**2 / 4)
    assert inside_m2 - segment_m2 - 0.4 < left.sum() * CELL_M**2 <= inside_m2 + 0.1 * door_m + 1e-9


def test_floor_that_ends_within_the_walls_stays():
    floor, walls = flat(8.0)
    floor &= ~beyond_obstacles(walls, CELL_M)
    assert not floor_outside(floor, walls, np.zeros_like(floor), CELL_M).any()


@pytest.mark.parametrize("sides", ["", "w", "ws"])
def test_a_scan_without_all_walls_keeps_its_floor(sides):
    floor, walls = flat(8.0, 0.0, sides)
    assert not floor_outside(floor, walls, np.zeros_like(floor), CELL_M).any()


def test_a_shed_is_no_home_where_the_furniture_stands_beside_it():
    floor, walls = flat(20.0)
    indoors, outdoors = np.zeros((2, *floor.shape), bool)
    indoors[190:200, 190:200], outdoors[20:30, 20:30] = True, True
    assert not floor_outside(floor, walls, outdoors, CELL_M).any()
    assert floor_outside(floor, walls, indoors, CELL_M)[20, 20]


def test_obstacles_on_one_line_have_no_inside():
    walls = np.zeros((20, 20), bool)
    walls[5, 3:9] = True
    assert not beyond_obstacles(walls, CELL_M).any() and not beyond_obstacles(np.zeros_like(walls), CELL_M).any()
