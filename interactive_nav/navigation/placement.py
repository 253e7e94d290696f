"""Draw an episode's start, goal and clutter from random keys and scene tables, inside jit.

Draws are uniform over tabulated free places, with a bounded number of candidates. A small object without a place is
parked outside and counted; without a suitable pair of start and goal, a fallback pair is used.
"""

import math
import zlib
from typing import Any

import jax
import jax.numpy as jnp

from interactive_nav.config import TaskRules
from interactive_nav.navigation.lookup import geodesic_at, goal_field
from interactive_nav.types import EpisodeStart, SceneTables

PAIR_CANDIDATES = 64
"""Start-goal pairs tried at first; and in each round that follows, of those far enough apart in a straight line."""
WIDER_CANDIDATES = 1024
"""Pairs drawn in each round: the straight line is cheap to measure, the way round is not."""
MAX_ROUNDS = 64
"""Rounds that follow where no pair qualifies; without one after all, one of the scene's fallback pairs is taken."""
DISTANCE_TOLERANCE_M = 1e-3
"""Rounding of distances that are measured again."""
CLUTTER_CANDIDATES = 16
"""Places tried per small object."""
CLEARANCE_M = 0.02
"""Least gap between bodies at the start of an episode."""


def _uniform_places(key: jax.Array, shape: tuple[int, ...], cells: jax.Array, count: jax.Array, side_m: float):
    """Draw [*shape, 2] points, uniform over the first `count` of square cells [p, 2] given by their middles."""
    key_cell, key_within = jax.random.split(key)
    index = jnp.minimum((jax.random.uniform(key_cell, shape) * count).astype(jnp.int32), count - 1)
    return cells[index] + side_m * jax.random.uniform(key_within, (*shape, 2), minval=-0.5, maxval=0.5)


def miss_m(
    tables: SceneTables, scene: jax.Array, start: jax.Array, goal: jax.Array, least_m: float, largest_m: Any
) -> jax.Array:
    """Return [] m by which a start and a goal (2,) miss a least planar and a largest geodesic distance, or 0."""
    miss = jnp.maximum(least_m - jnp.linalg.norm(start - goal), 0.0)
    if isinstance(largest_m, jax.Array) or math.isfinite(largest_m):
        way_m = geodesic_at(tables, scene, goal_field(tables, scene, goal), start)
        miss += jnp.maximum(way_m - largest_m, 0.0)
    return miss


def _draw_pair(
    key_start: jax.Array, key_goal: jax.Array, tables: SceneTables, scene: jax.Array, least_m: float, largest_m: Any
) -> tuple[jax.Array, jax.Array]:
    """Return the first of uniform pairs of start and goal that is as far apart as required; else a fallback pair."""

    start_places = tables.start_xy_w[scene], tables.num_starts[scene], tables.fine_m
    goal_places = tables.goal_xy_w[scene], tables.num_goals[scene], tables.fine_m

    def candidates(key_start, key_goal, count):
        return _uniform_places(key_start, (count,), *start_places), _uniform_places(key_goal, (count,), *goal_places)

    def best(starts, goals):
        miss = jax.vmap(lambda a, b: miss_m(tables, scene, a, b, least_m, largest_m))(starts, goals)
        at = jnp.argmin(miss)
        return starts[at], goals[at], miss[at]

    def unmet(carry):
        i, (_, _, miss) = carry
        return (miss > 0) & (i < MAX_ROUNDS)

    def again(carry):
        i, old = carry
        starts, goals = candidates(jax.random.fold_in(wider[0], i), jax.random.fold_in(wider[1], i), WIDER_CANDIDATES)
        straight = jnp.linalg.norm(starts - goals, axis=-1)
        # No way is shorter than the straight line: what is too far already need not be measured.
        kept = jnp.nonzero((straight >= least_m) & (straight <= largest_m), size=PAIR_CANDIDATES, fill_value=0)[0]
        new = best(starts[kept], goals[kept])
        return i + 1, jax.tree.map(lambda a, b: jnp.where(new[2] < old[2], a, b), new, old)

    # By name, not by a small number, which would be one of the keys that `candidates` splits off.
    wider = [jax.random.fold_in(key, zlib.crc32(b"wider")) for key in (key_start, key_goal)]
    first = best(*candidates(key_start, key_goal, PAIR_CANDIDATES))
    _, (start, goal, miss) = jax.lax.while_loop(unmet, again, (jnp.zeros((), jnp.int32), first))
    fallback = jax.random.choice(jax.random.fold_in(wider[0], MAX_ROUNDS), tables.fallback_pairs_xy_w[scene])
    return jnp.where(miss > 0, fallback[0], start), jnp.where(miss > 0, fallback[1], goal)


def place_small(
    key: jax.Array,
    tables: SceneTables,
    scene: jax.Array,
    radius_m: jax.Array,
    kept_free_w: list[jax.Array],
    robot_radius_m: float,
) -> tuple[jax.Array, jax.Array]:
    """Place objects of radii [k] at [k, 2], clear of each other and of a robot at points (2,); say which fit."""
    count = radius_m.shape[0]
    if not count:
        return jnp.zeros((0, 2)), jnp.zeros(0, bool)
    shape = (count, CLUTTER_CANDIDATES)
    places = _uniform_places(key, shape, tables.clutter_xy_w[scene], tables.num_clutter[scene], tables.fine_m)

    def place(carry, i):
        xys, oks = carry
        xy = places[i]
        reach = radius_m[i] + CLEARANCE_M
        gaps = jnp.linalg.norm(xy[:, None] - xys[None], axis=-1) - radius_m[None]
        ok = ((gaps > reach) | ~oks[None]).all(-1)
        for point in kept_free_w:
            ok &= jnp.linalg.norm(xy - point[None], axis=-1) > robot_radius_m + reach
        ok &= tables.num_clutter[scene] > 0
        best = jnp.argmax(ok)
        return (xys.at[i].set(xy[best]), oks.at[i].set(ok[best])), None

    placed, _ = jax.lax.scan(place, (jnp.zeros((count, 2)), jnp.zeros(count, bool)), jnp.arange(count))
    return placed


def draw_episode(
    key: jax.Array,
    tables: SceneTables,
    small_radius_m: jax.Array,
    robot_radius_m: float,
    rules: TaskRules,
    scene: jax.Array | None = None,
    limit_m: jax.Array | None = None,
) -> EpisodeStart:
    """Draw scene (if None), start, goal and small objects uniformly (paper section IV).

    Start and goal are the first of up to `MAX_ROUNDS` uniform pairs at the required distance, else one of
    `tables.fallback_pairs_xy_w`. Each small object, of radii [k], takes the first of `CLUTTER_CANDIDATES` uniform
    places clear of earlier objects, the robot at the start and, with `goal_clear`, the goal. `limit_m` [] lowers the
    largest distance; without a suitable pair, the fallback pair keeps the rules alone.
    """
    key_scene, key_start, key_goal, key_yaw, key_place, key_turn = jax.random.split(key, 6)
    if scene is None:
        scene = jax.random.randint(key_scene, (), 0, tables.rest_qpos.shape[0])
    most_m = rules.max_goal_distance_m if limit_m is None else jnp.minimum(limit_m, rules.max_goal_distance_m)
    targets, target = tables.targets, None
    if targets is None:
        start_xy, goal_xy = _draw_pair(key_start, key_goal, tables, scene, rules.min_goal_distance_m, most_m)
    else:
        pair = jax.random.randint(key_start, (), 0, jnp.maximum((targets.path_m[scene] <= most_m).sum(), 1))
        (start_xy, goal_xy), target = targets.pair_xy_w[scene, pair], targets.slot[scene, pair]
    kept_free = [start_xy, goal_xy] if rules.goal_clear else [start_xy]
    small_xy, small_placed = place_small(key_place, tables, scene, small_radius_m, kept_free, robot_radius_m)
    turn = jax.random.uniform(key_turn, small_radius_m.shape, minval=-jnp.pi, maxval=jnp.pi)
    return EpisodeStart(
        scene_index=scene,
        start_xy_w=start_xy,
        start_yaw_rad=jax.random.uniform(key_yaw, (), minval=-jnp.pi, maxval=jnp.pi),
        goal_xy_w=goal_xy,
        small_xy_w=small_xy,
        small_yaw_rad=turn if rules.random_object_yaw else jnp.zeros_like(turn),
        small_placed=small_placed,
        target=target,
    )
