"""Scene tables and a position in, distance to the goal and the path ahead out, inside jit."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from interactive_nav.types import SceneTables


def _cell(tables: SceneTables, scene: jax.Array, xy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(row, column), each [...] i32, of the navigation cell that holds each point [..., 2], clamped."""
    rows, columns = tables.node_of_cell.shape[1:]
    at = jnp.floor((xy - tables.grid_origin_w[scene]) / tables.cell_m).astype(jnp.int32)
    return jnp.clip(at[..., 1], 0, rows - 1), jnp.clip(at[..., 0], 0, columns - 1)


def node_at(tables: SceneTables, scene: jax.Array, xy: jax.Array) -> jax.Array:
    """[...] i32: the free cell nearest to the cell that holds each world point [..., 2]."""
    r, c = _cell(tables, scene, xy)
    return tables.node_of_cell[scene, r, c]


def geodesic_at(tables: SceneTables, scene: jax.Array, goal: jax.Array, xy: jax.Array) -> jax.Array:
    """Geodesic distance to a goal from a world point, continuous inside cells.

    Bilinear between the four nearest cell centres. A centre where the body would touch structure counts
    as its nearest free cell's distance plus the way there.

    Args:
        tables: constants of the scenes.
        scene: [] i32.
        goal: [] i32 row of the goal.
        xy: (2,) m, world.

    Returns:
        [] f32, m.
    """
    rows, columns = tables.node_of_cell.shape[1:]
    u = (xy - tables.grid_origin_w[scene]) / tables.cell_m - 0.5
    low = jnp.floor(u)
    f = u - low
    c = jnp.clip(low[0].astype(jnp.int32) + jnp.array([0, 1, 0, 1]), 0, columns - 1)
    r = jnp.clip(low[1].astype(jnp.int32) + jnp.array([0, 0, 1, 1]), 0, rows - 1)
    node = tables.node_of_cell[scene, r, c]
    value = tables.distance_m[scene, goal, node] + tables.offset_of_cell_m[scene, r, c]
    weight = jnp.stack([(1 - f[0]) * (1 - f[1]), f[0] * (1 - f[1]), (1 - f[0]) * f[1], f[0] * f[1]])
    return jnp.sum(weight * value)


def waypoints_at(
    tables: SceneTables, scene: jax.Array, goal: jax.Array, xy: jax.Array, count: int, spacing_m: float
) -> jax.Array:
    """The next waypoints on the shortest path, at equal arc length, the goal repeated at its end.

    Args:
        tables: constants of the scenes.
        scene: [] i32.
        goal: [] i32.
        xy: (2,) m, world.
        count: number of waypoints.
        spacing_m: arc length between them; the first lies this far ahead.

    Returns:
        (count, 2) f32, m, world.
    """
    hops = math.ceil(count * spacing_m / tables.cell_m) + 2
    here = node_at(tables, scene, xy)
    r, c = _cell(tables, scene, xy)
    astray = tables.offset_of_cell_m[scene, r, c] > 0

    def following(node):
        return tables.next_node[scene, goal, node].astype(jnp.int32)

    first = jnp.where(astray, here, following(here))

    def hop(node, _):
        return following(node), node

    _, nodes = jax.lax.scan(hop, first, None, length=hops)
    points = jnp.concatenate([xy[None], tables.node_xy_w[scene, nodes]])
    segment = points[1:] - points[:-1]
    length = jnp.linalg.norm(segment, axis=-1)
    before = jnp.cumsum(length) - length
    arc = spacing_m * jnp.arange(1, count + 1)
    share = jnp.clip((arc[:, None] - before) / jnp.maximum(length, 1e-6), 0.0, 1.0)
    return xy + share @ segment
