"""Build `SceneTables`, all that `reset` and `step` look up, from a `World` and its settings."""

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from interactive_nav.config import TaskRules
from interactive_nav.geodesic import CornerGraph, corner_graph, navigation_grid
from interactive_nav.navigation.lookup import geodesic_at, goal_field
from interactive_nav.navigation.placement import CLEARANCE_M
from interactive_nav.scenes.many import check_device_memory, for_each_home
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.world import World, world_poses
from interactive_nav.types import SceneTables
from interactive_nav_common.grids import cell_centres, sampled_clearance
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.schema import SceneError, SceneMaps

FINE_CELLS = 2
"""Fine cells along the side of a navigation cell: corners and places are 0.05 m fine, nodes 0.1 m apart."""
GOALS_TRIED, GOALS_KEPT, PAIRS_KEPT = 256, 32, 256
"""Goals of each scene that are held against every start; those with a fitting start, and pairs, that are enough."""
SIGHT_STEP_CELLS = 2.0
"""Fine cells between samples of a line of sight inside jit. What is blocked for the robot's centre is at least a
robot wide, so nothing is stepped over; a corner clipped between two samples is cut by centimetres at most."""

LOW_M = 0.02
"""Robots pass over parts of furniture that are lower than this."""


def furniture_map(scene: Scene, poses: dict[str, tuple[np.ndarray, np.ndarray]], height_m: float) -> np.ndarray:
    """Return [rows, columns] bool: cells of the scene's map over which furniture stands below a height."""
    return _covered(scene.maps, _placed_boxes(scene, poses), height_m)


def _placed_boxes(scene: Scene, poses: dict[str, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return [n, 17]: position and quaternion of each box's body, and the box's row."""
    placed = [(*poses[m.name], row) for m in scene.movables if m.name in poses for row in m.boxes]
    return np.array([np.concatenate(each) for each in placed]).reshape(-1, 17)


def _covered(maps: SceneMaps, boxes: np.ndarray, height_m: float) -> np.ndarray:
    """Return [rows, columns] bool: cells of a map over which `_placed_boxes` lie below a height."""
    rows, columns = maps.traversable.shape
    x = maps.origin_w[0] + (np.arange(columns) + 0.5) * maps.resolution_m
    y = maps.origin_w[1] + (np.arange(rows) + 0.5) * maps.resolution_m
    z = np.arange(LOW_M, height_m, 0.03)
    covered = np.zeros((rows, columns), bool)
    for row in boxes:
        body = matrix_from_quat(row[3:7])
        centre, axes, half = row[:3] + body @ row[7:10], body @ matrix_from_quat(row[10:14]), row[14:]
        reach = np.abs(axes) @ half
        cs = np.flatnonzero(np.abs(x - centre[0]) <= reach[0] + maps.resolution_m)
        rs = np.flatnonzero(np.abs(y - centre[1]) <= reach[1] + maps.resolution_m)
        if not len(cs) or not len(rs):
            continue
        grid = np.stack(np.meshgrid(x[cs], y[rs], z, indexing="xy"), -1)
        inside = (np.abs((grid - centre) @ axes) <= half + maps.resolution_m / 2).all(-1).any(-1)
        covered[np.ix_(rs, cs)] |= inside
    return covered


def rest_poses(world: World, index: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return body name -> (position, quaternion) of a scene's furniture at rest, world frame."""
    names, robots, pos, quat = world_poses(world, index, world.rest_qpos[index][None])
    first = robots + len(world.small_objects)
    return dict(zip(names[first:], zip(pos[0, first:], quat[0, first:], strict=True), strict=True))


def friction_share(world: World, index: int) -> np.ndarray:
    """Return [M] mass times friction of what is in a scene's slots over the robot's mass; 0 for an empty slot."""
    return world.slots.mass_kg[index] * world.slots.friction[index] / world.robot_mass_kg


def round_tables(world: World, tables: SceneTables, rules: TaskRules, limit: float) -> SceneTables:
    """Return the tables with shortest paths that also avoid resting furniture of more than this `friction_share`.

    Doors, drawers and other bodies on a hinge or slide are not obstacles.
    """
    fine, held = rules.nav_cell_m / FINE_CELLS, world.slots.held

    def graph(index: int) -> CornerGraph:
        slots = zip(world.slots.names[index], held, friction_share(world, index), strict=True)
        heavy = {name for name, is_held, share in slots if not is_held and share > limit}
        poses = {name: pose for name, pose in rest_poses(world, index).items() if name in heavy}
        maps = world.scenes[index].maps
        for open_ in (~furniture_map(world.scenes[index], poses, world.robot.height_m), True):
            body = maps.resolution_m, world.robot.footprint_radius_m
            free = navigation_grid(maps.traversable & open_, *body, fine)
            if free.any():
                break
        return corner_graph(free, fine, rules.nav_cell_m, maps.origin_w)

    with ThreadPoolExecutor() as pool:
        graphs = list(pool.map(graph, range(len(world.scenes))))
    return jax.device_put(tables.replace(**navigation_tables(graphs)))


Places = tuple[CornerGraph, np.ndarray, np.ndarray, np.ndarray]
"""Shortest paths, start positions [p, 2], goal positions [g, 2] and clutter positions [q, 2] of one scene, m, world."""


def _places(
    maps: SceneMaps, boxes: np.ndarray, radius_m: float, height_m: float, largest_m: float, cell_m: float, clear: bool
) -> Places | None:
    """Return the places of a map with furniture of `boxes`, for a robot of this radius and height; None: no room.

    `largest_m` is the radius of the largest small object; goals are `clear` of furniture, or of structure only.
    """
    fine = cell_m / FINE_CELLS
    free = navigation_grid(maps.traversable, maps.resolution_m, radius_m, fine)
    if not free.any():
        return None
    graph = corner_graph(free, fine, cell_m, maps.origin_w)

    def room(blocked: np.ndarray | bool) -> np.ndarray:
        """Return the clearance in metres that every point of a fine cell has."""
        open_ = maps.traversable & ~np.asarray(blocked)
        return sampled_clearance(open_, maps.resolution_m, fine) - math.sqrt(0.5) * fine

    furnished, needed = room(_covered(maps, boxes, height_m)), radius_m + CLEARANCE_M
    centres = functools.partial(cell_centres, cell_m=fine, origin_w=maps.origin_w)
    starts = centres(graph.free & (furnished >= needed))
    # Unless the option says otherwise the robot must fit at the goal too, or one under a sofa could never be reached.
    goals = starts if clear else centres(graph.free & (room(False) >= needed))
    clutter = centres(furnished >= largest_m + CLEARANCE_M)
    return graph, starts, goals, clutter


def _world_places(world: World, rules: TaskRules) -> list[Places]:
    """Return the places of every scene."""
    robot, largest_m = world.robot, max((o.radius_m for o in world.small_objects), default=0.0)
    shared = robot.footprint_radius_m, robot.height_m, largest_m, rules.nav_cell_m, rules.goal_clear
    boxes = [_placed_boxes(scene, rest_poses(world, i)) for i, scene in enumerate(world.scenes)]
    calls = [(scene.maps, placed, *shared) for scene, placed in zip(world.scenes, boxes, strict=True)]
    every = for_each_home(_places, calls, "finding paths in homes")
    full = [scene for scene, places in zip(world.scenes, every, strict=True) if places is None]
    if full:
        raise SceneError(
            f"{full[0].path}: no room for robot '{robot.name}' (radius "
            f"{robot.footprint_radius_m} m) on the traversable map; use a smaller robot or check the scan's floor"
        )
    return every  # pyright: ignore[reportReturnType]


def _fallback_pairs(world: World, tables: SceneTables, rules: TaskRules) -> np.ndarray:
    """Return some starts and goals of each scene [S, PAIRS_KEPT, 2, 2] f32, at middles of cells, at valid distances."""
    least_m, largest_m = rules.min_goal_distance_m, rules.max_goal_distance_m

    @jax.jit
    def ways_m(scene: int, goal: jax.Array) -> jax.Array:
        field = goal_field(tables, scene, goal)  # type: ignore[arg-type]
        return jax.vmap(lambda start: geodesic_at(tables, scene, field, start))(tables.start_xy_w[scene])  # type: ignore[arg-type]

    pairs_kept, rng = [], np.random.default_rng(0)
    all_starts, all_goals = np.asarray(tables.start_xy_w), np.asarray(tables.goal_xy_w)
    for i, scene in enumerate(world.scenes):
        starts = all_starts[i, : tables.num_starts[i]]
        goals = all_goals[i, : tables.num_goals[i]]
        farthest_m = _farthest(starts, goals)
        most_m = farthest_m.max(initial=0.0)
        if not len(farthest_m) or most_m < least_m:
            raise SceneError(
                f"{scene.path}: no room for a start and a goal {least_m} m apart for robot '{world.robot.name}', the "
                f"farthest are {most_m:.2f} m apart; lower min_goal_distance_m or use a larger scene"
            )
        fits, shortest_m = [], np.inf
        for goal in rng.permutation(goals[farthest_m >= least_m])[:GOALS_TRIED]:
            far = np.linalg.norm(starts - goal, axis=-1) >= least_m
            way_m = np.asarray(ways_m(i, goal))[: len(starts)] if math.isfinite(largest_m) else np.zeros(len(starts))
            shortest_m = min(shortest_m, way_m[far].min())
            near = starts[far & (way_m <= largest_m)]
            fits += [np.stack([near, np.broadcast_to(goal, near.shape)], 1)] if len(near) else []
            if len(fits) == GOALS_KEPT:
                break
        if not fits:
            raise SceneError(
                f"{scene.path}: no start and goal of robot '{world.robot.name}' are at least {least_m} m apart and at "
                f"most {largest_m} m by the way, the shortest way so far is {shortest_m:.2f} m; raise "
                "max_goal_distance_m or lower min_goal_distance_m"
            )
        pairs = np.concatenate(fits)
        pairs_kept.append(pairs[np.linspace(0, len(pairs) - 1, PAIRS_KEPT).astype(int)])
    return np.stack(pairs_kept)


def _farthest(starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Return [g] m: how far the farthest of the starts [p, 2] is from each goal [g, 2], to within 0.2 %."""
    if not len(starts):
        return np.zeros(0)
    angle = np.arange(64) * np.pi / 32
    outermost = starts[np.unique((starts @ np.stack([np.cos(angle), np.sin(angle)])).argmax(0))]
    return np.linalg.norm(goals[:, None] - outermost[None], axis=-1).max(1)


def _pad(arrays: list[np.ndarray], axes: int, fill: float = 0, least: int = 0) -> np.ndarray:
    """Stack arrays padded at the end of their first `axes` axes to common sizes, each at least `least`."""
    sizes = [max(least, *(a.shape[i] for a in arrays)) for i in range(axes)]
    out = np.full((len(arrays), *sizes, *arrays[0].shape[axes:]), fill, arrays[0].dtype)
    for row, array in zip(out, arrays, strict=True):
        row[tuple(map(slice, array.shape))] = array
    return out


def navigation_tables(graphs: list[CornerGraph]) -> dict[str, Any]:
    """Return the shortest paths of all scenes, padded; in each the last corner is none."""
    count = max(len(g.corner_xy_w) for g in graphs)
    # The tables are large: the smallest type that numbers every corner.
    index = np.uint16 if count < 2**16 else np.int32

    visible = [np.where(g.visible < len(g.corner_xy_w), g.visible, count).astype(index) for g in graphs]
    extent = max(math.hypot(*g.free.shape) * g.fine_m for g in graphs)
    arrays = {
        "node_of_cell": np.int32(_pad([g.node_of_cell for g in graphs], 2)),
        "grid_origin_w": np.asarray([g.origin_w for g in graphs], np.float32),
        "node_xy_w": np.float32(_pad([g.node_xy_w for g in graphs], 1)),
        "visible": _pad(visible, 2, fill=count),
        "corner_xy_w": _pad([g.corner_xy_w for g in graphs], 1, least=count + 1),
        "corner_distance_m": _pad([g.distance_m for g in graphs], 2, np.inf, count + 1),
        "next_corner": _pad([g.next_corner for g in graphs], 2, count, count + 1).astype(index),
        "free": _pad([g.free for g in graphs], 2),
    }
    return arrays | {
        "cell_m": graphs[0].cell_m,
        "fine_m": graphs[0].fine_m,
        "sight_samples": math.ceil(extent / (SIGHT_STEP_CELLS * graphs[0].fine_m)),
    }


def build_tables(world: World, rules: TaskRules) -> SceneTables:
    """Solve navigation for every scene and stack all constants on the device."""
    places = _world_places(world, rules)
    mass = np.concatenate([np.full((len(world.scenes), 1), world.robot_mass_kg), world.slots.mass_kg], 1)

    f32: Any = functools.partial(np.asarray, dtype=np.float32)
    i32: Any = functools.partial(np.asarray, dtype=np.int32)
    tables: Any = SceneTables(
        rest_qpos=f32(world.rest_qpos),
        mass_kg=f32(mass),
        com_m=f32(world.slots.com_b_m),
        **navigation_tables([p[0] for p in places]),
        start_xy_w=f32(_pad([p[1] for p in places], 1)),
        num_starts=i32([len(p[1]) for p in places]),
        goal_xy_w=f32(_pad([p[2] for p in places], 1)),
        num_goals=i32([len(p[2]) for p in places]),
        clutter_xy_w=f32(_pad([p[3] for p in places], 1, least=1)),
        num_clutter=i32([len(p[3]) for p in places]),
        fallback_pairs_xy_w=f32(np.zeros((len(places), 1, 2, 2))),
    )
    check_device_memory("homes", len(places), tables)
    tables = jax.device_put(tables)
    return tables.replace(fallback_pairs_xy_w=jax.device_put(f32(_fallback_pairs(world, tables, rules))))
