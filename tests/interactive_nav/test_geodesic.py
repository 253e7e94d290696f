"""Geodesics against straight lines, a wall with a known detour, and SciPy on the same graph."""

import math

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav import geodesic


def test_open_space_is_straight_within_1_3_percent():
    free = np.ones((40, 60), bool)
    field = np.asarray(geodesic.distance_field(free, 0.1, (2.05, 1.05), origin=(0.0, 0.0)))
    x, y = (np.arange(60) + 0.5) * 0.1, (np.arange(40) + 0.5) * 0.1
    straight = np.hypot(x[None, :] - 2.05, y[:, None] - 1.05)
    assert field[10, 20] == pytest.approx(0.0, abs=1e-6)
    far = straight > 0.3
    ratio = field[far] / straight[far]
    assert ratio.min() >= 1 - 1e-5 and ratio.max() <= 1 / math.cos(math.atan(1 / 3) / 2) + 1e-5


def test_a_wall_is_walked_around():
    # A wall on row 5 from column 0 to 8 of a 10-wide grid: the way from (2, 4.5) to (8, 4.5) passes column 9.
    free = np.ones((11, 10), bool)
    free[5, :9] = False
    field = np.asarray(geodesic.distance_field(free, 1.0, (4.5, 8.5)))
    # From (4.5, 2.5) to (9.5, 4.5), straight up through the gap to (9.5, 6.5), on to (4.5, 8.5).
    shortest = 2 * math.hypot(5, 2) + 2
    assert shortest <= field[2, 4] + 1e-5 and field[2, 4] <= 1.02 * shortest


def test_blocked_unreachable_and_outside_goals():
    free = np.ones((6, 6), bool)
    free[:, 3] = False
    field = np.asarray(geodesic.distance_field(free, 1.0, (0.5, 0.5)))
    assert np.isinf(field[:, 3:]).all() and np.isfinite(field[:, :3]).all()
    assert np.isinf(np.asarray(geodesic.distance_field(free, 1.0, (3.5, 0.5)))).all()
    assert np.isinf(np.asarray(geodesic.distance_field(free, 1.0, (99.0, 0.5)))).all()


def test_paths_do_not_slip_between_blocked_diagonals():
    free = np.ones((4, 4), bool)
    free[0, 1] = free[1, 0] = False
    field = np.asarray(geodesic.distance_field(free, 1.0, (0.5, 0.5)))
    assert np.isinf(field[1, 1])


def test_field_is_vmappable_over_goals_and_refuses_bad_maps():
    free = np.ones((8, 9), bool)
    goals = np.array([[0.5, 0.5], [8.5, 7.5]], np.float32)
    fields = jax.jit(jax.vmap(lambda g: geodesic.distance_field(free, 1.0, g)))(goals)
    np.testing.assert_allclose(fields[0], np.asarray(fields[1])[::-1, ::-1], rtol=1e-5)
    with pytest.raises(ValueError, match="expected \\[rows, columns\\]"):
        geodesic.distance_field(np.ones(4, bool), 1.0, (0.5, 0.5))
    with pytest.raises(ValueError, match="resolution is 0"):
        geodesic.distance_field(free, 0, (0.5, 0.5))


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_table_equals_field_on_random_maps(seed):
    rng = np.random.default_rng(seed)
    raw = rng.uniform(size=(17, 23)) > 0.25
    free = geodesic.largest_component(raw)
    table = geodesic.distance_table(free, 0.1, (-1.0, 2.0), max_goals=3, seed=seed)
    for row, node in enumerate(table.goal_node):
        field = geodesic.distance_field(free, 0.1, table.node_xy_w[node], origin=(-1.0, 2.0))
        np.testing.assert_allclose(np.asarray(field)[free], table.distance_m[row], atol=1e-4)
    # Following next_node shortens the distance by exactly the hop, down to the goal.
    goal, node = 0, int(np.argmax(table.distance_m[0]))
    while node != table.goal_node[goal]:
        after = int(table.next_node[goal, node])
        hop = np.linalg.norm(table.node_xy_w[after] - table.node_xy_w[node])
        assert table.distance_m[goal, node] - table.distance_m[goal, after] == pytest.approx(hop, abs=1e-4)
        node = after


def test_erosion_keeps_a_disc_clear_of_walls():
    free = np.ones((20, 20), bool)
    free[:, 0] = False
    eroded = geodesic.erode(free, 0.1, 0.24)
    # Column c's centre is (c - 0.5) * 0.1 m from the wall's face at column 0's right border.
    assert not eroded[10, 2] and eroded[10, 3]
    assert not eroded[1, 10] and eroded[3, 10] and not eroded[19, 10]  # the map's edge counts as a wall


def test_a_doorway_narrower_than_the_robot_closes():
    free = np.ones((40, 40), bool)
    free[20, :] = False
    free[20, 18:22] = True  # 0.2 m at 0.05 m a cell
    assert geodesic.navigation_grid(free, 0.05, 0.18, 0.1).sum() < 0.6 * 20 * 20
    free[20, 10:30] = True  # 1 m
    grid = geodesic.navigation_grid(free, 0.05, 0.18, 0.1)
    assert grid[:10].any() and grid[11:].any()
