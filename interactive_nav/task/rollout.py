"""Play episodes of an environment with any policy, and record them: the only loop over episodes."""

import dataclasses
import functools
import operator
import zlib
from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.physics import compiler_options
from interactive_nav_common.signals import raise_stop, signals_wait

CHUNK_STEPS = 50
"""Control steps in one call of the compiled program."""
FEWEST, MANY = 16, 256
"""On the CPU a batch becomes smaller as episodes end: by a quarter above `MANY`, by half below, down to about `FEWEST`.
Each size costs a compilation, and saves stepping the rest. On an accelerator a step costs about the same for fewer."""
PolicyFn = Callable[[Any, jax.Array], jax.Array]
"""Pure (observation, key) -> action (A,) in [-1, 1], of one environment."""


class MemoryPolicy(Protocol):
    """Define a pytree policy with pure methods of one environment, which has memory and decides when episodes end.

    Recorders read the memory in `state.info["policy"]`. The environment's `done` ends nothing.
    """

    def start(self, state: Any, episode: jax.Array) -> Any:
        """Return the memory at the start of an episode; `episode` is its number, [] i32."""
        ...

    def act(self, memory: Any, state: Any, key: jax.Array) -> tuple[jax.Array, Any, jax.Array]:
        """Return the action (A,), the new memory, and whether the episode was over before this step, [] bool."""
        ...


class HostPolicy:
    """A policy that acts on the host, step by step, for a batch of episodes."""

    note = ""
    """A remark to print beside its scores."""
    observes = True
    """Whether it reads `state.obs`; without it environments are stepped faster."""

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> Any:
        """Return the actions [N, A] of one control step, or a tuple of them and [N] bool of episodes that are over.

        With the tuple, episodes end before this step, and the environment's `done` ends nothing. On `warp`, the next
        step overwrites `state`. Actions for environments not `running` [N] have no effect.
        """
        raise NotImplementedError


Policy = PolicyFn | MemoryPolicy | HostPolicy


@dataclasses.dataclass(frozen=True)
class Recorder:
    """A quantity to record of episodes."""

    read: Callable[[Any, jax.Array], Any]
    """Pure (states, actions [N, A]) after a control step -> pytree of [N, ...]."""
    at: Literal["start", "end", "step"] = "end"
    """When its value is kept: before the first step (with actions of 0), in the last one, or in all of them.

    Where the policy ends episodes, the last value is that of its last `act`, which was not carried out.
    """


@dataclasses.dataclass(frozen=True)
class Rollout:
    """N finished episodes, in the order of their keys."""

    first: Any
    """`NavInfo` at the start, NumPy leaves [N, ...]."""
    num_steps: np.ndarray
    """[N] i32."""
    values: dict[str, Any]
    """Recorder -> [N, ...]; of those at each step [E, T, ...] of the first E episodes, where what follows an episode's
    end means nothing."""


def episode_keys(seed: int, episodes: int | np.ndarray) -> jax.Array:
    """Return keys [N, 2] of N fixed episodes, or of those with numbers [N]: number i is the same for every policy."""
    numbers = jnp.arange(episodes) if isinstance(episodes, int) else jnp.asarray(episodes)
    return jax.vmap(functools.partial(jax.random.fold_in, jax.random.PRNGKey(seed)))(numbers)


def policy_key_of(key: jax.Array) -> jax.Array:
    """Return the key of a policy's randomness in an episode drawn from `key`: none that the environment draws from."""
    return jax.random.fold_in(key, zlib.crc32(b"policy"))


class Player:
    """Play episodes of one environment that is neither batched nor resetting itself.

    Compiled programs are shared by chunks of one size, and by policies that are each a `jax.tree_util.Partial` of one
    function.
    """

    def __init__(self, env: Any, recorders: Mapping[str, Recorder]):
        self.env = env
        self._at_start, self._at_end, self._at_step = (
            {name: r.read for name, r in recorders.items() if r.at == when} for when in ("start", "end", "step")
        )
        held = signals_wait()  # a compilation that is left crashes the interpreter at its end
        self._reset = held(jax.jit(jax.vmap(env.reset)))
        self._reset_to = held(jax.jit(jax.vmap(env.reset_to))) if hasattr(env, "reset_to") else None
        self._begin = held(jax.jit(self._carry))
        self._remember = held(jax.jit(lambda policy, *of: jax.vmap(policy.start)(*of)))
        self._chunk = jax.jit(self._play_chunk, compiler_options=compiler_options())
        # For buffers that have moved MJX-Warp captures its graphs anew: a step writes where the state lay.
        self._step = jax.jit(
            self._play_step,
            static_argnames="observe",
            donate_argnums=(0,) if env.backend == "warp" else (),
            compiler_options=compiler_options(),
        )

    def rollout(
        self,
        policy: Policy,
        keys: jax.Array,
        starts: Any = None,
        scene_index: np.ndarray | None = None,
        record: int | None = None,
        batch: int | None = None,
        on_progress: Callable[[int, int], None] = lambda finished, step: None,
        on_note: Callable[[str], None] = lambda note: None,
        fewest: int = FEWEST,
    ) -> Rollout:
        """Play every episode to its end.

        An episode and its policy's randomness depend on its key of `keys` [N, 2] alone; `starts` (an `EpisodeStart`,
        leaves [N, ...]) replace drawn ones, and `scene_index` [N] i32 fixes their scenes. `record` episodes (None: all)
        pass the recorders at each step. `batch` is halved if memory lacks room; on the CPU it shrinks as
        episodes end, to about `fewest`. `on_progress` receives the numbers of finished episodes and of steps.
        """
        count = len(keys)
        size, record = min(batch or count, count), count if record is None else record
        options = starts, scene_index, record, fewest, on_progress
        parts: list[Rollout] = []
        done = 0
        while done < count:
            try:
                parts.append(self._play_batch(policy, keys, done, size, options))
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error) or size == 1:
                    raise
                on_note(f"{size} episodes at a time do not fit into the device's memory, going on with {size // 2}")
                size //= 2
                continue
            done += size
        values = {name: jax.tree.map(_joined, *(part.values[name] for part in parts)) for name in self._at_step}
        of_episodes = self._at_start | self._at_end
        whole = [(part.first, part.num_steps, {n: part.values[n] for n in of_episodes}) for part in parts]
        first, num_steps, others = jax.tree.map(lambda *x: np.concatenate(x), *whole)
        return Rollout(first, num_steps, values | others)

    def _play_batch(self, policy: Any, keys: jax.Array, done: int, size: int, options: tuple[Any, ...]) -> Rollout:
        """Play the next `size` episodes; the last one, over from the start, fills a batch that is too large."""
        starts, scenes, record, fewest, on_progress = options
        chosen, count = np.minimum(np.arange(done, done + size), len(keys) - 1), min(size, len(keys) - done)
        keys, starts, scenes = jax.tree.map(operator.itemgetter(chosen), (keys, starts, scenes))
        record = max(0, min(record - done, count))
        if starts is None:
            state = self._reset(keys, *(() if scenes is None else (jnp.asarray(scenes),)))
        else:
            assert self._reset_to is not None
            state = self._reset_to(starts, keys)
        policy_keys = jax.vmap(policy_key_of)(keys)
        first = jax.tree.map(np.array, state.info["nav"])
        episode_of = np.arange(size)  # episode played by each place in the batch
        finished = episode_of >= count
        act: Any = policy  # a pytree argument of the program, so that its numbers are none of its constants
        if hasattr(policy, "start"):
            memory = self._remember(policy, state, jnp.asarray(done + episode_of))
            state = state.replace(info=state.info | {"policy": memory})
        elif not isinstance(policy, (jax.tree_util.Partial, HostPolicy)):
            act = jax.tree_util.Partial(policy)
        step, tracks = 0, []
        carry, at_start = self._begin(state, jnp.asarray(finished))
        at_start, ends = jax.tree.map(np.array, (at_start, carry[2]))
        while not finished.all():
            if isinstance(policy, HostPolicy):
                carry, track = self._play_on_host(policy, carry, done + episode_of, step)
            else:
                with signals_wait():  # what is raised within the physics' callbacks is another error, and may crash
                    carry, track = jax.block_until_ready(self._chunk(act, carry, policy_keys[episode_of], step))
            step += CHUNK_STEPS
            new = np.flatnonzero(np.asarray(carry[1]) & ~finished[episode_of])
            _write(ends, episode_of[new], carry[2], new)
            finished[episode_of[new]] = True
            kept = np.flatnonzero(episode_of < record)
            places = jax.tree.map(lambda x: np.zeros((record, CHUNK_STEPS, *x.shape[2:]), x.dtype), track)
            _write(places, episode_of[kept], jax.tree.map(lambda x: np.asarray(x).swapaxes(0, 1), track), kept)
            tracks.append(places)
            on_progress(done + int(finished[:count].sum()), step)
            if self.env.backend == "native":
                left = going_on(finished[episode_of], fewest)
                if len(left) < len(episode_of):
                    carry, episode_of = jax.tree.map(operator.itemgetter(left), carry), episode_of[left]
        first, at_start, (num_steps, values) = jax.tree.map(lambda x: np.asarray(x[:count]), (first, at_start, ends))
        longest = int(num_steps[:record].max(initial=0))
        track = jax.tree.map(lambda *x: np.concatenate(x, axis=1)[:, :longest], *tracks)
        return Rollout(first, num_steps, track | values | at_start)

    def _carry(self, state: Any, ended: jax.Array) -> Any:
        """Return what `_play_step` hands on (the state, which episodes are over, what they ended with), and values at
        the start."""
        action = jnp.zeros((ended.shape[0], self.env.action_size))
        starts, ends = (
            {name: read(state, action) for name, read in of.items()} for of in (self._at_start, self._at_end)
        )
        return (state, ended, (state.info["nav"].step_count, ends)), starts

    def _play_step(self, carry: Any, action: jax.Array, over: Any = None, observe: bool = True) -> tuple[Any, Any]:
        """Step all environments; freeze the values of ended episodes.

        `over` [N] bool: episodes that the policy ended before the step; None: environments end their own.
        """
        state, ended, kept = carry
        if over is not None:
            ended, kept = self._end(state, action, over, ended, kept)
        state = jax.vmap(self.env.step if observe else self.env.advance)(state, action)
        if over is None:
            ended, kept = self._end(state, action, state.done > 0, ended, kept)
        return (state, ended, kept), {name: read(state, action) for name, read in self._at_step.items()}

    def _end(self, state: Any, action: jax.Array, over: jax.Array, ended: jax.Array, kept: Any) -> tuple[Any, Any]:
        """Return which episodes are over by now, and what they ended with."""
        ends = over & ~ended
        new = state.info["nav"].step_count, {name: read(state, action) for name, read in self._at_end.items()}
        kept = jax.tree.map(lambda x, old: jnp.where(ends.reshape(-1, *[1] * (x.ndim - 1)), x, old), new, kept)
        return ended | ends, kept

    def _play_chunk(self, policy: Any, carry: Any, keys: jax.Array, step: int) -> tuple[Any, Any]:
        """Play `CHUNK_STEPS` of all environments; return what `_carry` does, and values at steps [T, N, ...]."""

        def one_step(carry: Any, t: jax.Array) -> tuple[Any, Any]:
            state, now = carry[0], jax.vmap(jax.random.fold_in, (0, None))(keys, step + t)
            if not hasattr(policy, "start"):
                return self._play_step(carry, jax.vmap(policy)(state.obs, now))
            action, memory, over = jax.vmap(policy.act)(state.info["policy"], state, now)
            return self._play_step((state.replace(info=state.info | {"policy": memory}), *carry[1:]), action, over)

        return jax.lax.scan(one_step, carry, jnp.arange(CHUNK_STEPS))

    def _play_on_host(self, policy: HostPolicy, carry: Any, episode_of: np.ndarray, step: int) -> tuple[Any, Any]:
        """Play a chunk as `_play_chunk`, with a policy on the host."""
        tracks = []
        for t in range(CHUNK_STEPS):
            raise_stop()  # a policy on the host may take its time
            running = ~np.asarray(carry[1])
            if not running.any():
                break
            acted = policy.act(carry[0], episode_of, running, step + t)
            actions, over = acted if isinstance(acted, tuple) else (acted, None)
            with signals_wait():
                carry, track = jax.block_until_ready(self._step(carry, actions, over, observe=policy.observes))
            tracks.append(jax.tree.map(np.asarray, track))
        tracks += [tracks[-1]] * (CHUNK_STEPS - len(tracks))
        return carry, jax.tree.map(lambda *x: np.stack(x), *tracks)


def rollout(env: Any, policy: Policy, starts: Any, recorders: Mapping[str, Recorder], **options: Any) -> Rollout:
    """Play episodes with keys [N, 2] once; see `Player.rollout`, which takes `options` and keeps what it compiles."""
    return Player(env, recorders).rollout(policy, starts, **options)


def going_on(over: np.ndarray, fewest: int = FEWEST) -> np.ndarray:
    """Return indices [n] i64 of the running episodes, filled up to one of a few batch sizes (see `FEWEST`)."""
    size, running = len(over), int((~over).sum())
    while size > fewest and running <= (smaller := -(-size * 3 // 4) if size > MANY else -(-size // 2)):
        size = smaller
    return np.argsort(over, kind="stable")[:size]


def _write(target: Any, to: np.ndarray, values: Any, at: np.ndarray) -> None:
    """Write rows `at` of the values into rows `to` of the target, leaf by leaf."""
    for into, new in zip(jax.tree.leaves(target), jax.tree.leaves(values), strict=True):
        into[to] = np.asarray(new)[at]


def _joined(*parts: np.ndarray) -> np.ndarray:
    """Return recordings [E, T, ...] of batches one after the other, as long as the longest."""
    longest = max(part.shape[1] for part in parts)
    return np.concatenate([np.pad(p, [(0, 0), (0, longest - p.shape[1])] + [(0, 0)] * (p.ndim - 2)) for p in parts])
