"""Command velocities by maps, a scan and a goal: the expert that the local policy learns from.

Pure functions of one robot, for `jax.vmap`, follow the global dynamic window approach (Brock and Khatib 1999): each
node has a field of the distance to go around walls and furniture. Among velocities that are reachable in a control
period (Fox, Burgard and Thrun 1997), the expert chooses by progress down the field, heading along it, and the
footprint's gap to what the lidar and the map contain. The map adds what a planar scan misses, such as table tops. The
robot stops at obstacles in its path that only the scan contains, because paths are not replanned.
"""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from scipy.sparse.csgraph import dijkstra

from interactive_nav import InteractiveNav
from interactive_nav.task.rollout import Recorder
from interactive_nav.types import LOST
from interactive_nav_common.errors import UserError
from interactive_nav_common.grids import MOVES_32, cell_centres, grid_graph, nearest_cell
from interactive_nav_common.rotations import wrap_angle
from interactive_nav_common.rows import Rows
from scenes_mjcf.robot_facts import ROBOTS
from topological_nav.config import DriveConfig, ExpertConfig
from topological_nav.scenes.rendering import make_env
from topological_nav.scenes.space import FreeSpace

CONTROL_S = 0.1
"""Control period."""
LIDAR_B = {name: facts.lidar_b for name, facts in ROBOTS.items() if facts.lidar_b is not None}
"""Scanners by robot, m in the base's frame."""
REFUSED = 100.0
"""Cost of a gap of 0 instead of `margin_m`; if no velocity keeps the margin, the least bad wins."""
_SLOPE_M = 0.1
"""Distance on each side of the points that give a field's direction."""
_SLOW = 0.02
"""Weight of the forward velocity, to break ties."""


@flax.struct.dataclass
class Terrain:
    """Hold the expert's maps of S scenes and G nodes, padded alike."""

    clearance_m: jax.Array
    """[S, rows, columns] f32 distance to the nearest obstacle; 0 where blocked."""
    origin_w: jax.Array
    """[S, 2] f32 m."""
    resolution_m: jax.Array
    """[S] f32."""
    to_go_m: jax.Array
    """[G, rows, columns] f32 distance to go to each node, finite everywhere."""


def way_field(space: FreeSpace, goals_w: np.ndarray, config: ExpertConfig, limit_m: float) -> np.ndarray:
    """Return the distance to go (m) to goals [G, 2], [G, rows, columns] f32, finite everywhere.

    It is by Dijkstra's algorithm over the 32 moves of the environment's geodesic from the cell with room nearest to a
    goal; without any free cell, the Euclidean distance. A metre beside obstacles counts up to 1 + `near_cost`. Blocked
    cells and those beyond the limit have the value of the nearest other cell plus four times the distance there.
    """
    room = np.maximum(space.clearance_m - config.radius_m, 0.0)
    free = space.clearance_m >= config.radius_m
    rows, columns = free.shape
    goals_w = np.asarray(goals_w, float)
    if not free.any():
        xy = cell_centres(~free, space.resolution_m, space.origin_w)
        return np.linalg.norm(xy - goals_w[:, None], axis=-1).astype(np.float32).reshape(-1, rows, columns)
    cost = 1.0 + config.near_cost * np.clip(1.0 - room / config.near_m, 0.0, 1.0)
    graph, nearest = grid_graph(free, cost, space.resolution_m, MOVES_32), nearest_cell(free)
    column, row = space.inner_cells(goals_w).T
    source = nearest[0][row, column] * columns + nearest[1][row, column]
    far = dijkstra(graph, directed=False, indices=source, limit=limit_m).reshape(-1, rows, columns)
    out = np.empty(far.shape, np.float32)
    for i, field in enumerate(far):
        reached = np.isfinite(field)
        away, at = scipy.ndimage.distance_transform_edt(~reached, return_indices=True)  # type: ignore[misc]
        out[i] = field[at[0], at[1]] + 4.0 * space.resolution_m * np.asarray(away)
    return out


def sample(grid: jax.Array, origin_w: jax.Array, resolution_m: jax.Array, xy_w: jax.Array) -> jax.Array:
    """Interpolate a grid [rows, columns] of cell centres at points [..., 2], clipped at the border."""
    rows, columns = grid.shape
    origin, last = (jnp.broadcast_to(x, xy_w.shape) for x in (origin_w, jnp.asarray([columns - 1.001, rows - 1.001])))
    u = jnp.clip((xy_w - origin) / resolution_m - 0.5, 0.0, last)
    low = jnp.floor(u).astype(jnp.int32)
    f, c, r = u - low, low[..., 0], low[..., 1]
    below = grid[r, c] * (1 - f[..., 0]) + grid[r, c + 1] * f[..., 0]
    above = grid[r + 1, c] * (1 - f[..., 0]) + grid[r + 1, c + 1] * f[..., 0]
    return below * (1 - f[..., 1]) + above * f[..., 1]


def window(velocity: jax.Array, config: ExpertConfig) -> tuple[jax.Array, jax.Array]:
    """Return pairs of velocities, [C] and [C], reachable within a control period of the last command `velocity` [2]."""
    most = config.angular_rad_s
    v = jnp.linspace(0.0, config.linear_m_s, config.linear_samples)
    w = jnp.linspace(-most, most, config.angular_samples)
    changes = config.acceleration_m_s2 * CONTROL_S, config.angular_acceleration_rad_s2 * CONTROL_S
    v, w = (jnp.clip(x, now - by, now + by) for x, now, by in zip((v, w), velocity, changes, strict=True))
    pairs = jnp.stack(jnp.meshgrid(v, w, indexing="ij"), -1).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def arcs(linear: jax.Array, angular: jax.Array, times_s: jax.Array) -> jax.Array:
    """Return poses [C, K, 3] after times [K] at constant velocities [C], in the frame of the start."""
    turn = angular[:, None] * times_s[None]
    chord = linear[:, None] * times_s[None] * jnp.sinc(turn / (2 * jnp.pi))
    return jnp.stack([chord * jnp.cos(turn / 2), chord * jnp.sin(turn / 2), turn], -1)


def scan_gap(poses_b: jax.Array, points_b: jax.Array, half_m: jax.Array) -> jax.Array:
    """Return gaps [...] (m) from a rectangle at poses [..., 3] to points [R, 2]; 0 inside, infinite without points."""
    cos, sin = jnp.cos(poses_b[..., 2])[..., None], jnp.sin(poses_b[..., 2])[..., None]
    points_b = jnp.expand_dims(points_b, range(poses_b.ndim - 1))
    met = jnp.isfinite(points_b).all(-1)
    dx = jnp.where(met, points_b[..., 0], 0.0) - poses_b[..., :1]
    dy = jnp.where(met, points_b[..., 1], 0.0) - poses_b[..., 1:2]
    x = jnp.maximum(jnp.abs(cos * dx + sin * dy) - half_m[0], 0.0)
    y = jnp.maximum(jnp.abs(cos * dy - sin * dx) - half_m[1], 0.0)
    return jnp.sqrt(jnp.where(met, x * x + y * y, jnp.inf).min(-1))


def outline(half_m: jax.Array) -> jax.Array:
    """Return the corners and midpoints of the sides [8, 2] of a rectangle about the origin."""
    signs = jnp.asarray([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y], jnp.float32)
    return signs * half_m[None]


def moved(pose: jax.Array, by: jax.Array) -> jax.Array:
    """Transform poses [..., 3] or points [..., 2] from the frame of a pose [..., 3] to the pose's parent frame."""
    cos, sin = jnp.cos(pose[..., 2]), jnp.sin(pose[..., 2])
    x, y = by[..., 0], by[..., 1]
    xy = [pose[..., 0] + cos * x - sin * y, pose[..., 1] + sin * x + cos * y]
    return jnp.stack([*xy, pose[..., 2] + by[..., 2]] if by.shape[-1] == 3 else xy, -1)


def command(
    terrain: Terrain,
    scene: jax.Array,
    goal: jax.Array,
    pose_w: jax.Array,
    velocity: jax.Array,
    points_b: jax.Array,
    half_m: jax.Array,
    config: ExpertConfig,
) -> tuple[jax.Array, jax.Array]:
    """Return the velocities [2] (m/s, rad/s) to command now, and their gap [] (m) until the horizon.

    `velocity` [2] is the last command; `points_b` [R, 2] are ends of beams, infinite if they hit nothing; `half_m` [2]
    is half the footprint's length and width.
    """
    linear, angular = window(velocity, config)
    times = config.horizon_s * (jnp.arange(config.horizon_steps) + 1.0) / config.horizon_steps
    ways_b = arcs(linear, angular, times)
    ways_w = moved(pose_w, ways_b)
    plan = {"origin_w": terrain.origin_w[scene], "resolution_m": terrain.resolution_m[scene]}
    to_go = functools.partial(sample, terrain.to_go_m[goal], **plan)
    scanned = scan_gap(ways_b, points_b, half_m)
    rim = moved(ways_w[..., None, :], outline(half_m)[None, None])
    mapped = sample(terrain.clearance_m[scene], xy_w=rim, **plan).min(-1)
    gap = jnp.minimum(scanned, mapped).min(-1)
    left, end = _left(to_go, ways_w, linear, config)
    heading = _fall(to_go, end[:, :2])
    turn = jnp.abs(wrap_angle(heading - end[:, 2])) / jnp.pi
    cost = (
        config.weigh_progress * left / (config.linear_m_s * config.horizon_s)
        + config.weigh_heading * turn
        + config.weigh_gap * jnp.clip(1.0 - gap / config.caution_m, 0.0, 1.0)
        + REFUSED * jnp.clip(1.0 - gap / max(config.margin_m, 1e-6), 0.0, 1.0)
        - _SLOW * linear / config.linear_m_s
    )
    best = jnp.argmin(cost)
    return jnp.stack([linear[best], angular[best]]), gap[best]


def _left(
    to_go: Callable[..., jax.Array], ways_w: jax.Array, linear: jax.Array, config: ExpertConfig
) -> tuple[jax.Array, jax.Array]:
    """Return the distance to go [C] at the ends of paths [C, K, 3], and the poses [C, 3] where it is read.

    A path that passes the goal ends there, and the rest counts as progress, so that the robot does not stop at a node.
    """
    values = to_go(xy_w=ways_w[..., :2])
    steps = values.shape[1]
    near = values < config.reached_m
    at = jnp.where(near.any(1), near.argmax(1), steps - 1)
    rows = jnp.arange(len(values))
    beyond = linear * config.horizon_s * (steps - 1 - at) / steps
    return values[rows, at] - beyond, ways_w[rows, at]


def _fall(to_go: Callable[..., jax.Array], xy_w: jax.Array) -> jax.Array:
    """Return the headings [C] of a field's descent at points [C, 2]."""
    offsets = _SLOPE_M * jnp.asarray([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    values = to_go(xy_w=xy_w[:, None] + offsets[None])
    return jnp.arctan2(values[:, 3] - values[:, 2], values[:, 1] - values[:, 0])


def scan_points(ranges_m: jax.Array, config: ExpertConfig, lidar_xy_b: tuple[float, float]) -> jax.Array:
    """Return beams' ends [R, 2] in the robot's frame, infinite at `lidar_range_m`; ranges [R] go from right to left."""
    step = config.lidar_fov_deg / config.lidar_rays
    angle = jnp.radians(-0.5 * config.lidar_fov_deg + jnp.arange(config.lidar_rays) * step)
    ends = jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1) * ranges_m[:, None] + jnp.asarray(lidar_xy_b)[None]
    return jnp.where((ranges_m < 0.999 * config.lidar_range_m)[:, None], ends, jnp.inf)


@flax.struct.dataclass
class Tasks(Rows):
    """Hold a batch of B drives over several scenes, a row each; integers are i32."""

    scene: np.ndarray
    goals: np.ndarray
    """[B, legs] fields of the terrain, one per leg."""
    goals_w: np.ndarray
    """[B, legs, 2] m, the nodes of these fields."""
    legs: np.ndarray
    start_xy_w: np.ndarray
    """[B, 2] m."""
    start_yaw_rad: np.ndarray


def drive_env(scenes: Sequence[Path], config: DriveConfig) -> InteractiveNav:
    """Build the environment of the drives, with furniture at rest and no small objects."""
    if config.robot not in LIDAR_B:
        raise UserError(f"robot is '{config.robot}', expected one with a scanner: {', '.join(LIDAR_B)}")
    lidar = {name: getattr(config, name) for name in ("lidar_rays", "lidar_fov_deg", "lidar_range_m")}
    # All that stands in the scene can be met: what MJX's window would leave out would not be felt.
    window = dict.fromkeys(("active_furniture", "active_small", "active_doors", "active_walls"), 0)
    lidar |= {"observations": ("lidar",), "lidar_pos_m": LIDAR_B[config.robot]}
    settings = {"control_dt_s": CONTROL_S, "num_objects": 0, **lidar, **window}
    return make_env(scenes, config.robot, config.backend, **settings)


@flax.struct.dataclass
class Expert:
    """Drive each task's legs until its last node or the time limit: a `rollout.MemoryPolicy`."""

    terrain: Terrain
    tasks: Tasks
    env: InteractiveNav = flax.struct.field(pytree_node=False)
    config: DriveConfig = flax.struct.field(pytree_node=False)

    def start(self, state: Any, episode: jax.Array) -> dict[str, Any]:
        """Return the initial memory of the task."""
        zero, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        fresh = {"leg": zero, "leg_steps": zero, "reached": no, "broken": no, "gap_m": jnp.zeros(())}
        fresh |= {"command": jnp.zeros(2), "pose_w": jnp.zeros(3)}
        return {"task": jax.tree.map(lambda x: x[episode], self.tasks), **fresh}

    def act(self, memory: dict[str, Any], state: Any, key: jax.Array) -> tuple[jax.Array, dict[str, Any], jax.Array]:
        """Return the wheels' action; the memory holds the robot's pose and the command."""
        config, task, nav, size_m = self.config, memory["task"], state.info["nav"], self.env.robot.size_m
        assert size_m is not None
        begun, xy_w = nav.step_count > 0, nav.robot_pos_w[:2]
        arrived = begun & (jnp.linalg.norm(xy_w - task.goals_w[memory["leg"]], axis=-1) < config.reached_m)
        lost = sum((nav.memory[name] for name in LOST), jnp.zeros(())) > 0
        broken = (state.metrics["nonfinite"] > 0) | lost
        reached = arrived & (memory["leg"] + 1 >= task.legs) & ~broken
        leg = jnp.minimum(memory["leg"] + arrived, task.legs - 1)
        leg_steps = jnp.where(arrived, 0, memory["leg_steps"] + begun)
        over = reached | broken | (leg_steps >= round(config.leg_s / CONTROL_S))
        pose = jnp.concatenate([xy_w, nav.yaw_rad[None]])
        points = scan_points(state.obs * config.lidar_range_m, config, LIDAR_B[config.robot][:2])
        half_m = jnp.asarray(size_m[:2], jnp.float32) / 2
        now = self.terrain, task.scene, task.goals[leg], pose, memory["command"], points, half_m, config
        velocity, gap = command(*now)
        memory = {"task": task, "leg": leg, "leg_steps": leg_steps, "reached": reached, "broken": broken, "gap_m": gap}
        action = self.env.robot.drive(velocity[0], velocity[1], jnp)
        return action, {**memory, "command": velocity, "pose_w": pose}, over


_REMEMBERED: Any = {"pose_w": "step", "command": "step", "gap_m": "step", "reached": "end", "broken": "end"}
RECORDERS = {n: Recorder(lambda state, _, n=n: state.info["policy"][n], at) for n, at in _REMEMBERED.items()}
RECORDERS |= {"touching": Recorder(lambda state, action: state.info["nav"].memory["touching"], "step")}
