"""Look up the distance to the goal and the path ahead of a position in scene tables, inside jit.

Once an episode, `goal_field` computes every corner's distance to the goal (`interactive_nav.geodesic.CornerGraph`). A
distance is then the minimum over the visible corners. Visibility is tabulated at nodes 0.1 m apart and blended between
the four nearest, so the distance is continuous.
"""

import math

import jax
import jax.numpy as jnp

from interactive_nav.types import GoalField, SceneTables

_LIFT = 1.0 + 1e-4
"""The straight path wins over one around a corner that lies on the line."""


def _cell(tables: SceneTables, scene: jax.Array, xy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (row, column), each [...] i32, of the navigation cell that holds each point [..., 2], clamped."""
    rows, columns = tables.node_of_cell.shape[1:]
    origin = jnp.broadcast_to(tables.grid_origin_w[scene], xy.shape)
    at = jnp.floor((xy - origin) / tables.cell_m).astype(jnp.int32)
    return jnp.clip(at[..., 1], 0, rows - 1), jnp.clip(at[..., 0], 0, columns - 1)


def node_at(tables: SceneTables, scene: jax.Array, xy: jax.Array) -> jax.Array:
    """Return the node, [...] i32, that stands for the cell that holds each world point [..., 2]."""
    r, c = _cell(tables, scene, xy)
    return tables.node_of_cell[scene, r, c]


def cell_centre(tables: SceneTables, scene: jax.Array, xy: jax.Array) -> jax.Array:
    """Return the centre, [..., 2] m, of the navigation cell that holds each world point [..., 2]."""
    r, c = _cell(tables, scene, xy)
    offset = tables.cell_m * (jnp.stack([c, r], -1) + 0.5)
    return jnp.broadcast_to(tables.grid_origin_w[scene], offset.shape) + offset


def free_at(tables: SceneTables, scene: jax.Array, points: jax.Array) -> jax.Array:
    """Return [p] bool: which of the world points [p, 2] lie in free cells; beyond the map its edge counts."""
    rows, columns = tables.free.shape[1:]
    at = jnp.floor((points - tables.grid_origin_w[scene][None]) / tables.fine_m).astype(jnp.int32)
    r, c = jnp.clip(at[:, 1], 0, rows - 1), jnp.clip(at[:, 0], 0, columns - 1)
    return tables.free[scene, r, c]


def all_free(tables: SceneTables, scene: jax.Array, points: jax.Array) -> jax.Array:
    """Return [] bool: whether world points [p, 2] all lie in free cells."""
    return free_at(tables, scene, points).all()


def goal_field(tables: SceneTables, scene: jax.Array, goal_xy_w: jax.Array) -> GoalField:
    """Return every corner's distance to a goal (2,) on free ground, and the next corner on the way: once an episode."""
    none = tables.corner_xy_w.shape[1] - 1
    near = tables.visible[scene, node_at(tables, scene, goal_xy_w)].astype(jnp.int32)

    def through(best, corner):
        distance, last = best
        length = jnp.linalg.norm(tables.corner_xy_w[scene, corner] - goal_xy_w)
        total = tables.corner_distance_m[scene, corner] + jnp.where(corner == none, jnp.inf, length)
        shorter = total < distance
        return (jnp.where(shorter, total, distance), jnp.where(shorter, corner, last)), None

    nothing = (jnp.full((none + 1,), jnp.inf), jnp.full((none + 1,), none, jnp.int32))
    (distance, last), _ = jax.lax.scan(through, nothing, near)
    itself = jnp.arange(none + 1)
    following = jnp.where(last == itself, none, tables.next_corner[scene, itself, last].astype(jnp.int32))
    return GoalField(xy_w=goal_xy_w, corner_m=distance, next_corner=jnp.where(jnp.isinf(distance), none, following))


def _from_node(
    tables: SceneTables, scene: jax.Array, goal: GoalField, node: jax.Array, xy: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the distance of a point that sees what its node sees, and where its path leads: a corner or the goal."""
    none = tables.corner_xy_w.shape[1] - 1
    corners = tables.visible[scene, node].astype(jnp.int32)
    around = jnp.linalg.norm(tables.corner_xy_w[scene, corners] - xy[None], axis=-1) + goal.corner_m[corners]
    best = jnp.argmin(around)
    straight = jnp.linalg.norm(goal.xy_w - xy)
    share, start = (jnp.arange(tables.sight_samples) + 0.5) / tables.sight_samples, tables.node_xy_w[scene, node]
    in_sight = all_free(tables, scene, start[None] + share[:, None] * (goal.xy_w - start)[None])
    direct = in_sight | jnp.isinf(around[best])
    direct &= straight <= around[best] * _LIFT
    return jnp.where(direct, straight, around[best]), jnp.where(direct, none, corners[best])


def geodesic_at(tables: SceneTables, scene: jax.Array, goal: GoalField, xy: jax.Array) -> jax.Array:
    """Return the continuous geodesic distance [], m, from a world point (2,); near walls, that of the nearest node."""
    rows, columns = tables.node_of_cell.shape[1:]
    u = (xy - tables.grid_origin_w[scene]) / tables.cell_m - 0.5
    low = jnp.floor(u)
    f = u - low
    c = jnp.clip(low[0].astype(jnp.int32) + jnp.array([0, 1, 0, 1]), 0, columns - 1)
    r = jnp.clip(low[1].astype(jnp.int32) + jnp.array([0, 0, 1, 1]), 0, rows - 1)
    nodes = tables.node_of_cell[scene, r, c]
    values, _ = jax.vmap(lambda node: _from_node(tables, scene, goal, node, xy))(nodes)
    weight = jnp.stack([(1 - f[0]) * (1 - f[1]), f[0] * (1 - f[1]), (1 - f[0]) * f[1], f[0] * f[1]])
    return jnp.sum(weight * values)


def _path(tables: SceneTables, scene: jax.Array, goal: GoalField, xy: jax.Array, hops: int) -> jax.Array:
    """Return [hops + 1, 2] m: the point and the bends of its shortest path; the goal repeated at its end."""
    none = tables.corner_xy_w.shape[1] - 1
    _, first = _from_node(tables, scene, goal, node_at(tables, scene, xy), xy)

    def hop(corner, _):
        return goal.next_corner[corner], corner

    _, corners = jax.lax.scan(hop, first, None, length=hops)
    bends = jnp.where((corners == none)[:, None], goal.xy_w, tables.corner_xy_w[scene, corners])
    return jnp.concatenate([xy[None], bends])


def _along(points: jax.Array, length: jax.Array, arc: jax.Array) -> jax.Array:
    """Return [k, 2]: points of a polyline [p, 2] at given lengths [k], its pieces measured by `length` [p - 1]."""
    before = jnp.cumsum(length) - length
    share = jnp.clip((arc[:, None] - before[None]) / jnp.maximum(length, 1e-6)[None], 0.0, 1.0)
    return points[:1] + share @ (points[1:] - points[:-1])


def _hops(tables: SceneTables, ahead_m: float) -> int:
    return math.ceil(ahead_m / tables.cell_m) + 2


def waypoints_at(
    tables: SceneTables, scene: jax.Array, goal: GoalField, xy: jax.Array, count: int, spacing_m: float
) -> jax.Array:
    """Return the next waypoints (count, 2), m, on the shortest path from a world point (2,), at equal arc length, the
    goal repeated at its end."""
    points = _path(tables, scene, goal, xy, _hops(tables, count * spacing_m))
    length = jnp.linalg.norm(points[1:] - points[:-1], axis=-1)
    return _along(points, length, spacing_m * jnp.arange(1, count + 1))


def grid_waypoints_at(
    tables: SceneTables, scene: jax.Array, goal: GoalField, xy: jax.Array, count: int, spacing_m: float
) -> jax.Array:
    """Return waypoints as in the original's code (reference benchmark, section 1.2), from cell to cell.

    They are the robot's cell, then every second node (spacing / cell) of an 8-connected path, so 0.2 m apart along an
    axis and 0.283 m on diagonals, then the goal, repeated.
    """
    points = _path(tables, scene, goal, cell_centre(tables, scene, xy), _hops(tables, 1.5 * count * spacing_m))
    # A step to one of eight neighbours advances the larger of the two differences by one cell.
    length = jnp.abs(points[1:] - points[:-1]).max(-1)
    arc = spacing_m * jnp.arange(count)
    snapped = cell_centre(tables, scene, _along(points, length, arc))
    return jnp.where((arc >= length.sum())[:, None], goal.xy_w, snapped)
