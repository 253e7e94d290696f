"""An environment, a policy and one key an episode in; every episode's scores, and some of the paths, out."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from train.planners import Planner
from train.policies import PolicyFn

CHUNK_STEPS = 50
"""Steps between two looks at which episodes are over."""
SHRINK = 4
"""On the CPU, once only one episode in so many still runs, those go on in a batch of their own: it costs a
compilation and saves stepping the rest. On an accelerator a step costs about the same for fewer."""


@dataclasses.dataclass(frozen=True)
class Paths:
    """Where the robot went and what it moved, in the first E episodes; world frame, m."""

    scene_index: np.ndarray
    """[E] i32."""
    start_xy_w: np.ndarray
    """[E, 2]."""
    goal_xy_w: np.ndarray
    """[E, 2]."""
    robot_xy_w: np.ndarray
    """[E, T + 1, 2], NaN after the episode's end."""
    object_start_w: np.ndarray
    """[E, M, 3]."""
    object_end_w: np.ndarray
    """[E, M, 3]."""


@dataclasses.dataclass(frozen=True)
class Episodes:
    """N finished episodes."""

    scene_index: np.ndarray
    """[N] i32."""
    metrics: dict[str, np.ndarray]
    """name -> [N], the environment's metrics at the step that ended the episode."""
    paths: Paths


def episode_keys(seed: int, episodes: int) -> jax.Array:
    """[N, 2] keys of fixed episodes: number i is the same whatever their number and whoever plays them."""
    return jax.vmap(functools.partial(jax.random.fold_in, jax.random.PRNGKey(seed)))(jnp.arange(episodes))


def run_episodes(
    env: Any,
    policy: PolicyFn | Planner,
    keys: jax.Array,
    record: int = 0,
    on_progress: Callable[[int, int], None] = lambda finished, step: None,
    starts: Any = None,
) -> Episodes:
    """Plays every episode to its end, all in one batch.

    Args:
        env: one environment, not batched, not resetting itself.
        policy: see `train.policies`, or a planner.
        keys: [N, 2]; an episode is drawn, and its policy's chances are, from its own key alone.
        record: for how many of the first episodes to return paths.
        on_progress: told (episodes finished, steps taken) now and then.
        starts: of `interactive_nav.episodes.starts_of`, leaves [N, ...]: these episodes instead of drawn ones.
    """
    count, record = len(keys), min(record, len(keys))
    state = jax.jit(jax.vmap(env.reset))(keys) if starts is None else jax.jit(jax.vmap(env.reset_to))(starts, keys)
    policy_keys = jax.vmap(functools.partial(jax.random.fold_in, data=0))(keys)
    first = jax.tree.map(np.asarray, state.info["nav"])
    metrics = {name: np.full(count, np.nan, np.float32) for name in state.metrics}
    object_end = first.object_pos_w.copy()
    tracks = [[first.robot_pos_w[:record, :2]]]

    episode_of = np.arange(count)  # episode played by each place in the batch
    finished = np.zeros(count, bool)
    planner = policy if isinstance(policy, Planner) else None
    chunk = None if isinstance(policy, Planner) else jax.jit(functools.partial(_play_chunk, env, policy))
    one_step = _planned_step(env) if planner else None
    step = 0
    while not finished.all():
        ended_here = jnp.asarray(finished[episode_of])
        if chunk is None:
            state, ended, final, moved, track = _play_planned(one_step, planner, state, episode_of, ended_here, step)
        else:
            state, ended, final, moved, track = chunk(state, policy_keys[episode_of], ended_here, step)
        step += CHUNK_STEPS
        new = np.flatnonzero(np.asarray(ended) & ~finished[episode_of])
        for name, values in final.items():
            metrics[name][episode_of[new]] = np.asarray(values)[new]
        object_end[episode_of[new]] = np.asarray(moved)[new]
        finished[episode_of[new]] = True
        places = np.full((CHUNK_STEPS, record, 2), np.nan, np.float32)
        seen = episode_of < record
        places[:, episode_of[seen]] = np.asarray(track)[:, seen]
        tracks.append(list(places))
        on_progress(int(finished.sum()), step)
        running = np.flatnonzero(~finished[episode_of])
        if env.backend == "native" and 0 < len(running) <= len(episode_of) // SHRINK:
            state = jax.tree.map(operator.itemgetter(running), state)
            episode_of = episode_of[running]
    robot_xy = np.stack([place for part in tracks for place in part], 1)
    longest = np.isfinite(robot_xy[..., 0]).any(0).sum() if record else 0
    paths = Paths(
        scene_index=first.scene_index[:record],
        start_xy_w=first.start_xy_w[:record],
        goal_xy_w=first.goal_xy_w[:record],
        robot_xy_w=robot_xy[:, :longest],
        object_start_w=first.object_pos_w[:record],
        object_end_w=object_end[:record],
    )
    return Episodes(first.scene_index, metrics, paths)


@functools.lru_cache(maxsize=1)
def _planned_step(env: Any) -> Any:
    """Compiled once for all planners of an environment: nothing of them is in it."""
    return jax.jit(functools.partial(_play_step, env))


def _play_step(env: Any, carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
    """Steps all environments; what belongs to an episode is frozen at the step that ended it."""
    state, ended, final, moved = carry
    state = jax.vmap(env.step)(state, action)
    ends = (state.done > 0) & ~ended
    nav = state.info["nav"]
    final = {name: jnp.where(ends, state.metrics[name], value) for name, value in final.items()}
    moved = jnp.where(ends[:, None, None], nav.object_pos_w, moved)
    track = jnp.where(ended[:, None], jnp.nan, nav.robot_pos_w[:, :2])
    return (state, ended | ends, final, moved), track


def _play_planned(one_step: Any, planner: Any, state: Any, episode_of: np.ndarray, ended: jax.Array, step: int) -> Any:
    """`_play_chunk` for a planner on the host."""
    carry = (state, ended, dict(state.metrics), state.info["nav"].object_pos_w)
    tracks = []
    for t in range(CHUNK_STEPS):
        running = ~np.asarray(carry[1])
        if not running.any():
            break
        carry, track = one_step(carry, planner.act(carry[0], episode_of, running, step + t))
        tracks.append(np.asarray(track))
    state, ended, final, moved = carry
    tracks += [np.full_like(tracks[0], np.nan)] * (CHUNK_STEPS - len(tracks))
    return state, ended, final, moved, np.stack(tracks)


def _play_chunk(env: Any, policy: PolicyFn, state: Any, keys: jax.Array, ended: jax.Array, step: int) -> Any:
    """Steps all environments by `CHUNK_STEPS`.

    Returns:
        state, ended [N], metrics at the end {name: [N]}, objects at the end [N, M, 3],
        robot positions [T, N, 2] (NaN after the end).
    """

    def one_step(carry: Any, t: jax.Array) -> tuple[Any, jax.Array]:
        action = jax.vmap(policy)(carry[0].obs, jax.vmap(jax.random.fold_in, (0, None))(keys, step + t))
        return _play_step(env, carry, action)

    carry = (state, ended, dict(state.metrics), state.info["nav"].object_pos_w)
    (state, ended, final, moved), track = jax.lax.scan(one_step, carry, jnp.arange(CHUNK_STEPS))
    return state, ended, final, moved, track
