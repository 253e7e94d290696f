"""Random keys and scene tables in, an episode's start, goal and clutter out, inside jit.

Each draw is uniform over tabulated free places and judged from a fixed number of candidates, so nothing
retries without bound; a small object that finds no place is parked outside, and counted.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from interactive_nav.navigation import node_at
from interactive_nav.types import EpisodeStart, SceneTables

PAIR_CANDIDATES = 64
"""Start-goal pairs tried per episode; the best of them is taken if none qualifies."""
CLUTTER_CANDIDATES = 16
"""Places tried per small object."""
CLEARANCE_M = 0.02
"""Least gap between bodies at the start of an episode."""


def _uniform_index(key: jax.Array, shape, count: jax.Array) -> jax.Array:
    """Uniform integers in [0, count) for a traced count."""
    return jnp.minimum((jax.random.uniform(key, shape) * count).astype(jnp.int32), count - 1)


def draw_episode(
    key: jax.Array,
    tables: SceneTables,
    small_radius_m: jax.Array,
    robot_radius_m: float,
    min_goal_distance_m: float,
    max_goal_distance_m: float,
    jitter_m: float,
) -> EpisodeStart:
    """Draws scene, start, goal and small objects uniformly (paper section IV).

    Args:
        key: consumed.
        tables: constants of the scenes.
        small_radius_m: [k] radii of the small objects' footprints.
        robot_radius_m: footprint of the robot.
        min_goal_distance_m: least planar distance from start to goal.
        max_goal_distance_m: largest geodesic distance from start to goal.
        jitter_m: half side of the square about a tabulated start in which the start is uniform.

    Returns:
        The episode's start. Start and goal are free of contact: small objects keep
        clear of the robot at both, and of each other.
    """
    key_scene, key_start, key_goal, key_jitter, key_yaw, key_clutter = jax.random.split(key, 6)
    scene = jax.random.randint(key_scene, (), 0, tables.rest_qpos.shape[0])
    starts = tables.start_xy_w[scene, _uniform_index(key_start, (PAIR_CANDIDATES,), tables.num_starts[scene])]
    goals = _uniform_index(key_goal, (PAIR_CANDIDATES,), tables.num_goals[scene])
    goal_nodes = tables.goal_node[scene, goals]
    goal_xy = tables.node_xy_w[scene, goal_nodes]
    straight = jnp.linalg.norm(starts - goal_xy, axis=-1)
    nodes = node_at(tables, scene, starts)
    geodesic = tables.distance_m[scene, goals, nodes]
    valid = (straight >= min_goal_distance_m) & (geodesic <= max_goal_distance_m)
    # Without a valid pair, the one nearest to being valid; construction refuses scenes with no room at all.
    badness = jnp.maximum(min_goal_distance_m - straight, 0.0) + jnp.maximum(geodesic - max_goal_distance_m, 0.0)
    chosen = jnp.where(valid.any(), jnp.argmax(valid), jnp.argmin(badness))
    jitter = jax.random.uniform(key_jitter, (2,), minval=-jitter_m, maxval=jitter_m)
    start_xy = starts[chosen] + jnp.where(straight[chosen] - min_goal_distance_m > 2 * jitter_m, jitter, 0.0)

    count = small_radius_m.shape[0]
    key_place, key_turn = jax.random.split(key_clutter)
    candidates = _uniform_index(key_place, (count, CLUTTER_CANDIDATES), tables.num_clutter[scene])

    def place(carry, i):
        xys, oks = carry
        xy = tables.clutter_xy_w[scene, candidates[i]]
        reach = small_radius_m[i] + CLEARANCE_M
        gaps = jnp.linalg.norm(xy[:, None] - xys[None], axis=-1) - small_radius_m
        ok = ((gaps > reach) | ~oks).all(-1)
        ok &= jnp.linalg.norm(xy - start_xy, axis=-1) > robot_radius_m + reach
        ok &= jnp.linalg.norm(xy - goal_xy[chosen], axis=-1) > robot_radius_m + reach
        ok &= tables.num_clutter[scene] > 0
        best = jnp.argmax(ok)
        return (xys.at[i].set(xy[best]), oks.at[i].set(ok[best])), None

    nothing = (jnp.zeros((count, 2)), jnp.zeros((count,), bool))
    small_xy, small_placed = nothing
    if count:
        (small_xy, small_placed), _ = jax.lax.scan(place, nothing, jnp.arange(count))
    return EpisodeStart(
        scene_index=scene,
        goal_index=goals[chosen],
        start_xy_w=start_xy,
        start_yaw_rad=jax.random.uniform(key_yaw, (), minval=-jnp.pi, maxval=jnp.pi),
        goal_xy_w=goal_xy[chosen],
        small_xy_w=small_xy,
        small_yaw_rad=jax.random.uniform(key_turn, (count,), minval=-jnp.pi, maxval=jnp.pi),
        small_placed=small_placed,
    )
