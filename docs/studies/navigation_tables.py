"""Shortest-path tables: accuracy against fast marching, the host's time to build them, bytes, time of a look-up.

`python -m docs.studies.navigation_tables SCENE_DIR ...` tables of these scenes, for a TurtleBot
`python -m docs.studies.navigation_tables --plans N` of N synthetic plans of 160 m2: sixteen rooms, forty fixed blocks
`python -m docs.studies.navigation_tables --accuracy ROOMS` errors in random rooms (needs scikit-fmm)
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.steps_per_second import timed
from docs.studies import command_line
from interactive_nav.geodesic import CornerGraph, corner_graph, navigation_grid
from interactive_nav.navigation import lookup
from interactive_nav.navigation.tables import navigation_tables
from interactive_nav.scenes.scene import load_scene
from interactive_nav.types import SceneTables
from interactive_nav_common.grids import clearance

RADIUS_M, FINE_M, CELL_M = 0.18, 0.05, 0.1
POINTS, BATCH = 800, 64


def scene_tables(values: dict[str, Any]) -> SceneTables:
    """What navigation reads, without the rest."""
    others: dict[str, Any] = {field.name: None for field in dataclasses.fields(SceneTables) if field.name not in values}
    return jax.device_put(SceneTables(**values, **others))


def random_room(seed: int) -> np.ndarray:
    """[80, 100] bool at 0.05 m: a walled 5 x 4 m room with a partition and up to eight blocks."""
    rng = np.random.default_rng(seed)
    free = np.ones((80, 100), bool)
    free[:2] = free[-2:] = free[:, :2] = free[:, -2:] = False
    column, gap = rng.integers(30, 70), rng.integers(4, 55)
    free[:, column : column + 3] = False
    free[gap : gap + 20, column : column + 3] = True
    for _ in range(rng.integers(2, 9)):
        (height, width), row, col = rng.integers(2, 14, 2), rng.integers(0, 70), rng.integers(0, 90)
        free[row : row + height, col : col + width] = False
    return free


def fast_marching(
    free: np.ndarray, goal_xy: np.ndarray, fold: int = 4, radius_m: float = RADIUS_M
) -> np.ma.MaskedArray:
    """[80 fold, 100 fold] m, masked: second-order fast marching of a disc's centre, `fold` times as fine."""
    import skfmm  # pyright: ignore[reportMissingImports]

    fine = np.kron(free, np.ones((fold, fold), bool))
    side = FINE_M / fold
    room = clearance(fine, side) < radius_m
    y, x = ((np.arange(n) + 0.5) * side for n in fine.shape)
    seed_m = 0.04
    away = np.hypot(x[None] - goal_xy[0], y[:, None] - goal_xy[1]) - seed_m
    return skfmm.distance(np.ma.MaskedArray(away, room), dx=side) + seed_m


def random_points(graph: CornerGraph, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """[POINTS, 2] free points of a random room and a goal [2], m."""
    room = np.argwhere(clearance(random_room(seed), FINE_M) >= RADIUS_M + 0.08)
    room = room[graph.free[room[:, 0], room[:, 1]]]
    xy = (room[:, ::-1] + 0.5) * FINE_M
    rng = np.random.default_rng(seed + 1)
    goal = xy[rng.integers(len(xy))] + rng.uniform(-0.02, 0.02, 2)
    xy = xy[rng.integers(len(xy), size=POINTS)]
    return xy + rng.uniform(-0.025, 0.025, xy.shape), goal


def reference(seed: int, xy: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fast marching at points: [n] m, and [n] bool where it can be relied on.

    A passage about as wide as the robot is open at one resolution and shut at another: there no solver is right.
    Elsewhere the distance grows evenly with the radius.
    """
    c, r = np.floor(xy / (FINE_M / 4)).astype(int).T
    want, thin, fat = (
        fast_marching(random_room(seed), goal, radius_m=RADIUS_M + more)[r, c] for more in (0.0, -0.025, 0.025)
    )
    even = (abs(fat + thin - 2 * want) < 0.01 * want) & (fat < 1.06 * thin)
    return np.ma.filled(want, np.inf), ~np.ma.getmaskarray(want) & even.filled(False)


def plan(seed: int) -> np.ndarray:
    """[260, 260] bool at 0.05 m: a square building of 4 x 4 rooms."""
    rng, n = np.random.default_rng(seed), 260
    free = np.ones((n, n), bool)
    free[:4] = free[-4:] = free[:, :4] = free[:, -4:] = False
    for k in (1, 2, 3):
        at = k * n // 4
        free[at - 1 : at + 1] = free[:, at - 1 : at + 1] = False
    for row in range(4):
        for wall in (1, 2, 3):
            door, at = row * n // 4 + n // 8 + rng.integers(-10, 10), wall * n // 4
            free[door - 9 : door + 9, at - 1 : at + 1] = free[at - 1 : at + 1, door - 9 : door + 9] = True
    for _ in range(40):
        (height, width), r, c = rng.integers(2, 16, 2), rng.integers(0, n - 16), rng.integers(0, n - 16)
        free[r : r + height, c : c + width] = False
    return free


def accuracy(rooms: int) -> None:
    """Prints the largest error over random rooms."""
    worst, compared = 0.0, 0
    for seed in range(rooms):
        graph = corner_graph(navigation_grid(random_room(seed), FINE_M, RADIUS_M, FINE_M), FINE_M, CELL_M, (0.0, 0.0))
        tables = scene_tables(navigation_tables([graph]))
        xy, goal = random_points(graph, seed)
        want, sure = reference(seed, xy, goal)
        sure &= np.linalg.norm(xy - goal, axis=-1) >= 1.0
        scene = jnp.asarray(0)
        field = lookup.goal_field(tables, scene, jnp.asarray(goal))
        at = jax.vmap(lookup.geodesic_at, (None, None, None, 0))
        got = np.asarray(at(tables, scene, field, jnp.asarray(xy)))
        error = np.abs(got[sure] / want[sure] - 1.0)
        worst, compared = max(worst, float(error.max(initial=0.0))), compared + int(sure.sum())
        print(f"room {seed}: {sure.sum()} points, largest error {100 * error.max(initial=0.0):.2f} %", flush=True)
    print(f"{rooms} rooms, {compared} points at 1 m and more: largest error {100 * worst:.2f} %")


def build(name: str, free: np.ndarray, origin_w: tuple[float, float]) -> CornerGraph:
    """One scene's graph, with a line on what it took."""
    began = time.process_time()
    graph = corner_graph(free, FINE_M, CELL_M, origin_w)
    print(
        f"{name}: {time.process_time() - began:.1f} s of CPU, {len(graph.corner_xy_w)} corners, "
        f"{len(graph.node_xy_w)} nodes, at most {graph.visible.shape[1]} corners seen by one",
        flush=True,
    )
    return graph


def look_up_ms(values: dict[str, Any], graphs: list[CornerGraph], rounds: int = 100) -> float:
    """Median time of a distance and ten waypoints for `BATCH` environments, ms."""
    tables, rng = scene_tables(values), np.random.default_rng(0)
    scene = np.arange(BATCH) % len(graphs)
    points = np.stack([graphs[s].node_xy_w[rng.integers(len(graphs[s].node_xy_w), size=2)] for s in scene])
    index, start, goal = jnp.asarray(scene), jnp.asarray(points[:, 0]), jnp.asarray(points[:, 1])
    fields = jax.jit(jax.vmap(lambda s, g: lookup.goal_field(tables, s, g)))(index, goal)

    @jax.jit
    @jax.vmap
    def look(s, field, xy):
        near = lookup.geodesic_at(tables, s, field, xy)
        return near, lookup.waypoints_at(tables, s, field, xy, 10, 0.2)

    times = [timed(look, index, fields, start)[1] for _ in range(rounds + 1)]
    return 1e3 * float(np.median(times[1:]))  # the first call compiles


def main(argv: Sequence[str] | None = None) -> None:
    """Prints a line a scene and the totals."""
    parser = command_line(__doc__)
    parser.add_argument("scenes", nargs="*", metavar="SCENE_DIR")
    parser.add_argument("--plans", type=int, default=0, metavar="N")
    parser.add_argument("--accuracy", type=int, default=0, metavar="ROOMS")
    arguments = parser.parse_args(argv)
    if not (arguments.scenes or arguments.plans or arguments.accuracy):
        parser.error("nothing to measure: name scene folders, --plans or --accuracy")
    if arguments.accuracy:
        accuracy(arguments.accuracy)
    graphs = []
    for folder in arguments.scenes:
        maps = load_scene(folder).maps
        free = navigation_grid(maps.traversable, maps.resolution_m, RADIUS_M, FINE_M)
        graphs.append(build(folder, free, maps.origin_w))
    for seed in range(arguments.plans):
        graphs.append(build(f"plan {seed}", navigation_grid(plan(seed), FINE_M, RADIUS_M, FINE_M), (0.0, 0.0)))
    if not graphs:
        return
    values = navigation_tables(graphs)
    size = sum(value.nbytes for value in values.values() if hasattr(value, "nbytes"))
    print(f"{len(graphs)} scenes: {size / 1e6:.1f} MB on the device")
    fixed = sum(1024 * len(graph.node_xy_w) * 6 for graph in graphs)
    print(f"distance and next hop from every node to 1,024 goal cells would take {fixed / 1e6:.0f} MB")
    print(f"a distance and ten waypoints for {BATCH} environments: {look_up_ms(values, graphs):.2f} ms")


if __name__ == "__main__":
    main()
