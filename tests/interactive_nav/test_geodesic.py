"""Geodesics against straight lines, detours by hand and fast marching (scikit-fmm), which knows none of ours."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.csgraph
from hypothesis import given, settings
from hypothesis import strategies as st

from docs.studies.navigation_tables import RADIUS_M, fast_marching, random_points, random_room, reference, scene_tables
from interactive_nav import geodesic
from interactive_nav.navigation import lookup
from interactive_nav.navigation.tables import navigation_tables
from interactive_nav.types import SceneTables
from interactive_nav_common import grids


def field_to(goal_xy_w, free, cell_m: float, origin_w=(0.0, 0.0)) -> np.ndarray:
    """[rows, columns] m: paths over 32 moves to a point, a solver that knows no corner graph; inf: no path."""
    x, y = (np.arange(n) * cell_m + cell_m / 2 + low for n, low in zip(np.shape(free)[::-1], origin_w, strict=True))
    c, r = np.floor((np.asarray(goal_xy_w) - origin_w) / cell_m).astype(int)
    if not (0 <= r < len(y) and 0 <= c < len(x) and free[r, c]):
        return np.full(free.shape, np.inf)
    graph = grids.grid_graph(free, np.ones(free.shape), cell_m, grids.MOVES_32)
    far = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=int(r * len(x) + c))
    return far.reshape(free.shape) + math.hypot(x[c] - goal_xy_w[0], y[r] - goal_xy_w[1])


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


@pytest.mark.parametrize("seed", range(3))
def test_the_field_in_jax_is_that_of_dijkstras_algorithm_on_the_graph_of_moves(seed):
    free = grids.clearance(random_room(seed), 0.05)[::2, ::2] >= RADIUS_M
    rows, columns = np.nonzero(free)
    goal = (np.array([columns[seed], rows[seed]]) + 0.3) * 0.1 - 1.0
    field = geodesic.distance_field(free, 0.1, goal, (-1.0, -1.0))
    assert np.isfinite(field).sum() > 100
    np.testing.assert_allclose(field, field_to(goal, free, 0.1, (-1.0, -1.0)), atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_sight_is_that_of_samples_all_along_the_line(seed):
    """Against every line sampled one by one, where its middle halves fall, at most a cell apart."""
    rng = np.random.default_rng(seed)
    free = np.ones((30, 40), bool)
    for _ in range(5):
        row, column, height, width = (int(rng.integers(*span)) for span in ((0, 30), (0, 40), (1, 12), (1, 6)))
        free[row : row + height, column : column + width] = False
    a, b = rng.uniform(-1.0, (41.0, 31.0), (2, 200, 2))
    want = []
    for start, end in zip(a, b, strict=True):
        parts = 1
        while np.linalg.norm(end - start) > parts:
            parts *= 2
        shares = np.concatenate([(np.arange(2**k) + 0.5) / 2**k for k in range(parts.bit_length())])
        column, row = np.floor(start + shares[:, None] * (end - start)).astype(int).T
        inside = (row >= 0) & (row < 30) & (column >= 0) & (column < 40)
        want.append(bool((inside & free[row.clip(0, 29), column.clip(0, 39)]).all()))
    np.testing.assert_array_equal(geodesic.sees(grids.clearance(free, 1.0), a, b), want)
    assert 0.05 < np.mean(want) < 0.95


MOST_CORNERS, MOST_SEEN, CELLS = 160, 80, (40, 50)


def tables_of(graph: geodesic.CornerGraph) -> SceneTables:
    """The tables that navigation reads, padded to one size so that one program serves all maps."""
    rows, columns = CELLS
    count = rows * columns
    filler = geodesic.CornerGraph(
        free=np.zeros((2 * rows, 2 * columns), bool),
        fine_m=graph.fine_m,
        cell_m=graph.cell_m,
        origin_w=(0.0, 0.0),
        node_of_cell=np.zeros(CELLS, int),
        node_xy_w=np.zeros((count, 2), np.float32),
        corner_xy_w=np.zeros((MOST_CORNERS, 2), np.float32),
        visible=np.zeros((count, MOST_SEEN), int),
        distance_m=np.zeros((MOST_CORNERS,) * 2, np.float32),
        next_corner=np.zeros((MOST_CORNERS,) * 2, int),
    )
    assert len(graph.corner_xy_w) <= MOST_CORNERS and graph.visible.shape[1] <= MOST_SEEN
    values = navigation_tables([graph, filler])
    return scene_tables(values)


@functools.cache
def solved(seed: int):
    """A random room's tables, 800 of its free points and a goal among them."""
    free = geodesic.navigation_grid(random_room(seed), 0.05, RADIUS_M, 0.05)
    graph = geodesic.corner_graph(free, 0.05, 0.1, (0.0, 0.0))
    tables = tables_of(graph)
    return tables, *random_points(graph, seed)


SCENE = jnp.asarray(0)


@jax.jit
def distances(tables, goal, xy):
    field = lookup.goal_field(tables, SCENE, goal)
    return jax.vmap(lambda p: lookup.geodesic_at(tables, SCENE, field, p))(xy)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_distances_are_within_2_percent_of_fast_marching(seed):
    tables, xy, goal = solved(seed)
    pytest.importorskip("skfmm", reason="scikit-fmm could not be built here")
    want, sure = reference(seed, xy, goal)
    far = np.linalg.norm(xy - goal, axis=-1) >= 1.0
    got = np.asarray(distances(tables, jnp.asarray(goal), jnp.asarray(xy)))
    error = got[sure] / want[sure] - 1.0
    assert np.abs(error[far[sure]]).max(initial=0.0) < 0.02
    near = np.asarray(sure) & ~np.asarray(far)  # where 2 % is less than the reference's own cells
    np.testing.assert_allclose(got[near], want[near], rtol=0.0, atol=0.05)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), angle=st.floats(0, 2 * np.pi))
def test_distance_is_continuous_along_a_line(seed, angle):
    tables, xy, goal = solved(seed)
    start = xy[seed % len(xy)]
    step_m = 0.001
    line = start + step_m * np.arange(-80, 81)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    got = np.asarray(distances(tables, jnp.asarray(goal), jnp.asarray(line)))
    # A true distance changes by at most the step; blending views 0.1 m apart may add as much again near corners.
    assert np.abs(np.diff(got)).max() <= 3 * step_m + 2e-5


def test_a_distance_is_zero_at_the_goal_and_the_same_both_ways():
    tables, xy, goal = solved(3)
    assert float(distances(tables, jnp.asarray(goal), jnp.asarray(goal)[None])[0]) == pytest.approx(0.0, abs=1e-6)
    there = np.asarray(distances(tables, jnp.asarray(goal), jnp.asarray(xy[::40])))
    back = np.array([float(distances(tables, jnp.asarray(p), jnp.asarray(goal)[None])[0]) for p in xy[::40]])
    np.testing.assert_allclose(there, back, atol=0.02)


def test_a_room_without_corners_has_straight_distances():
    graph = geodesic.corner_graph(np.ones((20, 30), bool), 0.05, 0.1, (1.0, 2.0))
    assert graph.corner_xy_w.shape == (0, 2)
    points = np.array([[1.3, 2.2], [2.2, 2.9]])
    got = distances(tables_of(graph), jnp.asarray([2.0, 2.1]), jnp.asarray(points))
    np.testing.assert_allclose(got, np.linalg.norm(points - [2.0, 2.1], axis=-1), rtol=1e-5)


def test_corner_graph_by_hand():
    """A wall from below to row 6 of 8: the way from one side to the other bends at its two upper corners."""
    free = np.ones((8, 9), bool)
    free[:6, 4] = False
    graph = geodesic.corner_graph(free, 1.0, 1.0, (0.0, 0.0))
    np.testing.assert_allclose(np.sort(graph.corner_xy_w, 0), [[3.8, 6.2], [5.2, 6.2]], atol=1e-5)
    np.testing.assert_allclose(graph.distance_m, [[0, 1.4], [1.4, 0]], atol=1e-5)
    got = distances(tables_of(graph), jnp.asarray([8.5, 2.05]), jnp.asarray([[0.5, 2.05], [2.5, 6.5]]))
    side = math.hypot(8.5 - 5.2, 6.2 - 2.05)
    np.testing.assert_allclose(got[0], math.hypot(3.3, 4.15) + 1.4 + side, atol=1e-3)
    np.testing.assert_allclose(got[1], math.hypot(5.2 - 2.5, 0.3) + side, atol=1e-3)  # passes above the first


def test_cells_that_touch_only_at_a_corner_are_no_passage():
    free = np.zeros((8, 8), bool)
    free[:4, :4] = free[4:, 4:] = True
    graph = geodesic.corner_graph(free, 0.05, 0.1, (0.0, 0.0))
    assert graph.free.sum() < 17


def descend(field: np.ndarray, side_m: float, xy: np.ndarray, length_m: float) -> np.ndarray:
    """Oracle: follows the negative gradient of a fast-marching field in steps of 2 mm; [steps + 1, 2]."""
    filled = field.filled(np.nan)
    path = [xy]
    for _ in range(int(length_m / 0.002)):
        c, r = np.floor(path[-1] / side_m).astype(int)
        window = filled[r - 2 : r + 3, c - 2 : c + 3]
        gy, gx = np.gradient(np.where(np.isnan(window), np.nanmax(window), window))
        slope = np.array([gx[2, 2], gy[2, 2]])
        path.append(path[-1] - 0.002 * slope / max(np.linalg.norm(slope), 1e-9))
    return np.array(path)


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5])
def test_waypoints_lie_on_the_descent_of_a_fast_marching_field(seed):
    tables, xy, goal = solved(seed)
    pytest.importorskip("skfmm", reason="scikit-fmm could not be built here")
    want = fast_marching(random_room(seed), goal)
    field = lookup.goal_field(tables, SCENE, jnp.asarray(goal))
    waypoints = jax.jit(lambda p: lookup.waypoints_at(tables, SCENE, field, p, 10, 0.2))
    far = xy[np.linalg.norm(xy - goal, axis=-1) > 2.3]
    compared = 0
    for start in far[:: max(len(far) // 4, 1)]:
        got = np.asarray(waypoints(jnp.asarray(start)))
        path = descend(want, 0.0125, start, 2.0)
        oracle = path[100::100]
        # Where two ways are nearly as long, the solvers may take different ones: the length decides there.
        if np.linalg.norm(got - oracle, axis=-1).max() < 0.12:
            compared += 1
        along = np.linalg.norm(np.diff(np.vstack([start, got]), axis=0), axis=-1)
        assert along.max() <= 0.2 + 1e-4  # chords of arcs of 0.2 m
        # Every waypoint is nearer by its arc length.
        left = np.asarray(distances(tables, jnp.asarray(goal), jnp.asarray(np.vstack([start, got]))))
        np.testing.assert_allclose(left[0] - left[1:], 0.2 * np.arange(1, 11), atol=0.06)
    assert compared >= 3


def test_waypoints_repeat_the_goal_at_the_end():
    graph = geodesic.corner_graph(np.ones((40, 60), bool), 0.05, 0.1, (0.0, 0.0))
    tables = tables_of(graph)
    goal = jnp.asarray([1.5, 1.0])
    field = lookup.goal_field(tables, SCENE, goal)
    got = lookup.waypoints_at(tables, SCENE, field, jnp.asarray([1.0, 1.0]), 5, 0.2)
    np.testing.assert_allclose(got, [[1.2, 1.0], [1.4, 1.0], [1.5, 1.0], [1.5, 1.0], [1.5, 1.0]], atol=1e-5)


def test_grid_waypoints_start_at_the_own_cell_and_skip_every_second_node():
    graph = geodesic.corner_graph(np.ones((60, 60), bool), 0.05, 0.1, (0.0, 0.0))
    tables = tables_of(graph)

    def points(xy, goal):
        field = lookup.goal_field(tables, SCENE, jnp.asarray(goal))
        return np.asarray(lookup.grid_waypoints_at(tables, SCENE, field, jnp.asarray(xy), 5, 0.2))

    # Along x: own cell's centre first, then every 0.2 m; along a diagonal every 0.283 m; the goal at the end.
    np.testing.assert_allclose(points([0.52, 1.03], [2.55, 1.05])[:, 0], [0.55, 0.75, 0.95, 1.15, 1.35], atol=1e-5)
    diagonal = points([0.55, 0.55], [2.55, 2.55])
    np.testing.assert_allclose(np.linalg.norm(np.diff(diagonal, axis=0), axis=-1), 0.2 * math.sqrt(2), atol=1e-5)
    np.testing.assert_allclose(points([0.55, 1.05], [0.97, 1.02])[3:], [[0.97, 1.02]] * 2, atol=1e-5)


def test_the_original_grid_is_longer_than_ours():
    """8 neighbours make a way at 22.5 degrees 8.2 % too long; the corner graph's is straight."""
    octile = 2.0 * (math.cos(math.pi / 8) + (math.sqrt(2) - 1) * math.sin(math.pi / 8))
    graph = geodesic.corner_graph(np.ones((60, 60), bool), 0.05, 0.1, (0.0, 0.0))
    end = 0.5 + 2.0 * np.array([math.cos(math.pi / 8), math.sin(math.pi / 8)])
    ours = float(distances(tables_of(graph), jnp.asarray([0.5, 0.5]), jnp.asarray(end)[None])[0])
    assert octile / 2.0 == pytest.approx(1.082, abs=1e-3) and ours == pytest.approx(2.0, abs=1e-5)


def test_erosion_keeps_a_disc_clear_of_walls():
    free = np.ones((20, 20), bool)
    free[:, 0] = False
    eroded = grids.clearance(free, 0.1) >= 0.24
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
