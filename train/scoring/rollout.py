"""An environment, a policy and one key an episode in; every episode's scores, and some of the paths, out."""

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.physics import compiler_options
from interactive_nav.pictures.replay import policy_key_of
from interactive_nav.types import OF_OBJECTS
from interactive_nav_common.rows import Rows
from interactive_nav_common.signals import signals_wait
from train.scoring.planners import HostPolicy
from train.scoring.policies import PolicyFn

CHUNK_STEPS = 50
"""Steps between two looks at which episodes are over."""
FEWEST, MANY = 16, 256
"""On the CPU a batch becomes smaller as episodes end: by a quarter above `MANY`, by half below, down to about `FEWEST`.
Each size costs a compilation, and saves stepping the rest. On an accelerator a step costs about the same for fewer."""


@dataclasses.dataclass(frozen=True)
class Paths(Rows):
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
class PlayedEpisodes:
    """N finished episodes."""

    scene_index: np.ndarray
    """[N] i32."""
    metrics: dict[str, np.ndarray]
    """name -> [N], the environment's metrics at the step that ended the episode."""
    of_objects: dict[str, np.ndarray]
    """name of `OF_OBJECTS` -> [N, M]."""
    paths: Paths


def episode_keys(seed: int, episodes: int) -> jax.Array:
    """[N, 2] keys of fixed episodes: number i is the same whatever their number and whoever plays them."""
    return jax.vmap(functools.partial(jax.random.fold_in, jax.random.PRNGKey(seed)))(jnp.arange(episodes))


class BatchPlayer:
    """Plays episodes of one environment.

    What is compiled is kept: policies that are `jax.tree_util.Partial`s of one function share it, whatever their
    numbers, as do chunks of one size.
    """

    def __init__(self, env: Any):
        self.env = env
        self._reset = jax.jit(jax.vmap(env.reset))
        self._reset_to = jax.jit(jax.vmap(env.reset_to)) if hasattr(env, "reset_to") else None
        self._chunk = jax.jit(functools.partial(_play_chunk, env), compiler_options=compiler_options())
        self._step = jax.jit(functools.partial(_play_step, env), compiler_options=compiler_options())
        self.known: dict[Any, Any] = {}
        """Functions of learned policies, by kind: see `train.scoring.evaluation.load_policy`."""

    def play(
        self,
        policy: PolicyFn | HostPolicy,
        keys: jax.Array,
        record: int = 0,
        on_progress: Callable[[int, int], None] = lambda finished, step: None,
        starts: Any = None,
        scene_index: np.ndarray | None = None,
        batch: int | None = None,
        on_note: Callable[[str], None] = lambda note: None,
    ) -> PlayedEpisodes:
        """Plays every episode to its end.

        Args:
            keys: [N, 2]; an episode is drawn, and its policy's chances are, from its own key alone.
            starts: of `interactive_nav.episodes.starts_of`, leaves [N, ...]: these episodes instead of drawn ones.
            scene_index: [N] i32, the scene of each drawn episode; None: drawn as well.
            batch: episodes played at a time; None: all. Where the device's memory does not hold so many, half as
                many are tried.

        Returns:
            The episodes in the order of their keys, whatever the batch.
        """
        count = len(keys)
        size = min(batch or count, count)
        parts: list[PlayedEpisodes] = []
        done = 0
        while done < count:
            try:
                parts.append(self._play_batch(policy, keys, done, size, record, on_progress, starts, scene_index))
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error) or size == 1:
                    raise
                on_note(f"{size} episodes at a time do not fit into the device's memory, going on with {size // 2}")
                size //= 2
                continue
            done += size
        return _joined(parts)

    def _play_batch(
        self,
        policy: Any,
        keys: jax.Array,
        done: int,
        size: int,
        record: int,
        on_progress: Any,
        starts: Any,
        scenes: Any,
    ) -> PlayedEpisodes:
        """The next `size` episodes behind those that are done; where there are not so many left, the last one fills the
        batch and is over from the start. Words as `play`'s."""
        chosen, count = np.minimum(np.arange(done, done + size), len(keys) - 1), min(size, len(keys) - done)
        keys, starts, scenes = jax.tree.map(operator.itemgetter(chosen), (keys, starts, scenes))
        record = max(0, min(record - done, count))
        if starts is None:
            state = self._reset(keys, *(() if scenes is None else (jnp.asarray(scenes),)))
        else:
            assert self._reset_to is not None
            state = self._reset_to(starts, keys)
        policy_keys = jax.vmap(policy_key_of)(keys)
        first = jax.tree.map(np.asarray, state.info["nav"])
        metrics = {name: np.full(size, np.nan, np.float32) for name in state.metrics}
        ends = {name: getattr(first, name).copy() for name in ("object_pos_w", *OF_OBJECTS)}
        tracks = [first.robot_pos_w[None, :record, :2]]

        episode_of = np.arange(size)  # episode played by each place in the batch
        finished = episode_of >= count
        act: Any = policy  # a pytree argument of the program, so that its numbers are none of its constants
        if not isinstance(policy, (jax.tree_util.Partial, HostPolicy)):
            act = jax.tree_util.Partial(policy)
        step, carry = 0, _carry(state, jnp.asarray(finished))
        while not finished.all():
            if isinstance(policy, HostPolicy):
                carry, track = _play_planned(self._step, policy, carry, done + episode_of, step)
            else:
                with signals_wait():  # what is raised within the physics' callbacks is another error, and may crash
                    carry, track = jax.block_until_ready(self._chunk(act, carry, policy_keys[episode_of], step))
            _, ended, final, moved = carry
            step += CHUNK_STEPS
            new = np.flatnonzero(np.asarray(ended) & ~finished[episode_of])
            for name, values in final.items():
                metrics[name][episode_of[new]] = np.asarray(values)[new]
            for name, values in moved.items():
                ends[name][episode_of[new]] = np.asarray(values)[new]
            finished[episode_of[new]] = True
            places = np.full((CHUNK_STEPS, record, 2), np.nan, np.float32)
            seen = episode_of < record
            places[:, episode_of[seen]] = np.asarray(track)[:, seen]
            tracks.append(places)
            on_progress(done + int(finished[:count].sum()), step)
            if self.env.backend == "native":
                kept = going_on(finished[episode_of])
                if len(kept) < len(episode_of):
                    carry, episode_of = jax.tree.map(operator.itemgetter(kept), carry), episode_of[kept]
        paths = _paths(first, ends.pop("object_pos_w"), tracks, record)
        metrics, ends = ({name: x[:count] for name, x in values.items()} for values in (metrics, ends))
        return PlayedEpisodes(first.scene_index[:count], metrics, ends, paths)


def going_on(over: np.ndarray) -> np.ndarray:
    """Places of a batch that go on once those of `over` have ended: all that run, then as many others as fill it.

    Returns:
        [n] i64, n the smallest of N's sizes (see `FEWEST`) that holds all that run. So all batches of N episodes have
        the same few, and what is compiled for one serves the next.
    """
    size, running = len(over), int((~over).sum())
    while size > FEWEST and running <= (smaller := -(-size * 3 // 4) if size > MANY else -(-size // 2)):
        size = smaller
    return np.argsort(over, kind="stable")[:size]


def _paths(first: Any, object_end: np.ndarray, tracks: list[np.ndarray], record: int) -> Paths:
    """Where the first `record` episodes of a batch began, went and ended; tracks [T, record, 2] follow each other."""
    robot_xy = np.concatenate(tracks).swapaxes(0, 1)
    longest = np.isfinite(robot_xy[..., 0]).any(0).sum() if record else 0
    return Paths(
        scene_index=first.scene_index[:record],
        start_xy_w=first.start_xy_w[:record],
        goal_xy_w=first.goal_xy_w[:record],
        robot_xy_w=robot_xy[:, :longest],
        object_start_w=first.object_pos_w[:record],
        object_end_w=object_end[:record],
    )


def _joined(parts: list[PlayedEpisodes]) -> PlayedEpisodes:
    """Batches one after the other; recorded paths as long as the longest."""
    if len(parts) == 1:
        return parts[0]
    longest = max(part.paths.robot_xy_w.shape[1] for part in parts)

    def padded(paths: Paths) -> Paths:
        more = ((0, 0), (0, longest - paths.robot_xy_w.shape[1]), (0, 0))
        return dataclasses.replace(paths, robot_xy_w=np.pad(paths.robot_xy_w, more, constant_values=np.nan))

    return PlayedEpisodes(
        np.concatenate([part.scene_index for part in parts]),
        {name: np.concatenate([part.metrics[name] for part in parts]) for name in parts[0].metrics},
        {name: np.concatenate([part.of_objects[name] for part in parts]) for name in OF_OBJECTS},
        Paths.joined([padded(part.paths) for part in parts]),
    )


def _play_step(env: Any, carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
    """Steps all environments; what belongs to an episode is frozen at the step that ended it."""
    state, ended, final, moved = carry
    state = jax.vmap(env.step)(state, action)
    ends = (state.done > 0) & ~ended
    nav = state.info["nav"]
    final = {name: jnp.where(ends, state.metrics[name], value) for name, value in final.items()}
    moved = {
        name: jnp.where(ends.reshape(-1, *[1] * (old.ndim - 1)), getattr(nav, name), old) for name, old in moved.items()
    }
    track = jnp.where(ended[:, None], jnp.nan, nav.robot_pos_w[:, :2])
    return (state, ended | ends, final, moved), track


def _carry(state: Any, ended: jax.Array) -> Any:
    """What `_play_step` hands on: the state, which episodes are over, and what they ended with."""
    nav = state.info["nav"]
    return state, ended, dict(state.metrics), {name: getattr(nav, name) for name in ("object_pos_w", *OF_OBJECTS)}


def _play_planned(one_step: Any, planner: Any, carry: Any, episode_of: np.ndarray, step: int) -> tuple[Any, np.ndarray]:
    """`_play_chunk` for a planner on the host."""
    tracks = []
    for t in range(CHUNK_STEPS):
        running = ~np.asarray(carry[1])
        if not running.any():
            break
        actions = planner.act(carry[0], episode_of, running, step + t)
        with signals_wait():
            carry, track = jax.block_until_ready(one_step(carry, actions))
        tracks.append(np.asarray(track))
    tracks += [np.full_like(tracks[0], np.nan)] * (CHUNK_STEPS - len(tracks))
    return carry, np.stack(tracks)


def _play_chunk(env: Any, policy: PolicyFn, carry: Any, keys: jax.Array, step: int) -> tuple[Any, jax.Array]:
    """`CHUNK_STEPS` of all environments: what `_carry` holds, and robots' positions [T, N, 2] (NaN after the end)."""

    def one_step(carry: Any, t: jax.Array) -> tuple[Any, jax.Array]:
        action = jax.vmap(policy)(carry[0].obs, jax.vmap(jax.random.fold_in, (0, None))(keys, step + t))
        return _play_step(env, carry, action)

    return jax.lax.scan(one_step, carry, jnp.arange(CHUNK_STEPS))
