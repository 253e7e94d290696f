"""Keep steps of many environments for random transitions: a ring in device memory that holds each image once.

The ring is [slots, envs, ...]: one slot holds what every environment saw and did in one step. The next observation
of a step is the observation in the next slot, so nothing is stored twice, and the newest `n_steps` slots cannot be
drawn yet. Where an episode ended, the next slot belongs to another episode: its discount is 0, or, at a time limit,
its truncation is 1 and the losses leave it out (see `sample`).

Everything is pure; learners donate the ring to their compiled update, which then writes it in place.
"""

from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from brax.training import types

from train.learners.networks import vector_part


@flax.struct.dataclass
class ReplayBuffer:
    """The ring."""

    observation: Any
    """[slots, envs, ...] before the step; images in their type, vectors as configured."""
    action: jax.Array
    """[slots, envs, A]."""
    reward: jax.Array
    """[slots, envs] f32."""
    done: jax.Array
    """[slots, envs] bool: the step ended its episode, for whatever reason."""
    truncated: jax.Array
    """[slots, envs] bool: it was the time limit that did."""
    position: jax.Array
    """() i32: the slot that is written next."""
    filled: jax.Array
    """() i32: slots written so far, at most all."""


def init(slots: int, observation: Any, action_size: int, vector_dtype: str = "float32") -> ReplayBuffer:
    """Return an empty ring for observations shaped as [envs, ...], with vectors in float32 or float16."""
    envs = jax.tree.leaves(observation)[0].shape[0]
    return ReplayBuffer(
        observation=_cast(jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), observation), vector_dtype),
        action=jnp.zeros((slots, envs, action_size)),
        reward=jnp.zeros((slots, envs)),
        done=jnp.zeros((slots, envs), bool),
        truncated=jnp.zeros((slots, envs), bool),
        position=jnp.zeros((), jnp.int32),
        filled=jnp.zeros((), jnp.int32),
    )


def nbytes(replay: ReplayBuffer) -> int:
    """Return the memory of a ring, or of one with the shapes that `jax.eval_shape` computes, bytes."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(replay))


def describe(replay: ReplayBuffer) -> str:
    """Return a line about a ring's memory; as `nbytes`."""
    slots, envs = replay.reward.shape
    total, transitions = nbytes(replay), slots * envs
    return (
        f"replay of {transitions:,} transitions ({slots:,} steps of {envs:,} environments) of "
        f"{total / transitions:,.0f} bytes each takes {total / 1e9:.2f} GB on the device"
    )


def insert(
    replay: ReplayBuffer, observation: Any, action: jax.Array, reward: jax.Array, done: jax.Array, truncated: jax.Array
) -> ReplayBuffer:
    """Return the ring with one step of every environment in place of its oldest.

    The observation [envs, ...] is that before the step, action is [envs, A], the others are [envs]: `done` is not 0
    where the step ended an episode, `truncated` where the time limit did.
    """
    at, slots = replay.position, replay.reward.shape[0]

    def write(ring: jax.Array, x: jax.Array) -> jax.Array:
        if ring.dtype == jnp.float16:  # beyond its range: its largest number, not infinity
            x = jnp.clip(x, -65504.0, 65504.0)
        return ring.at[at].set(x.astype(ring.dtype))

    return ReplayBuffer(
        observation=jax.tree.map(write, replay.observation, observation),
        action=write(replay.action, action),
        reward=write(replay.reward, reward),
        done=write(replay.done, done),
        truncated=write(replay.truncated, truncated),
        position=(at + 1) % slots,
        filled=jnp.minimum(replay.filled + 1, slots),
    )


def size(replay: ReplayBuffer) -> jax.Array:
    """Return () i32: transitions in the ring, including those that cannot be drawn yet."""
    return replay.filled * replay.reward.shape[1]


def sample(replay: ReplayBuffer, key: jax.Array, batch_size: int, n_steps: int, discounting: float) -> types.Transition:
    """Draw transitions [batch, ...] uniformly, with replacement, from all that have `n_steps` >= 1 younger slots.

    A transition covers `n_steps` steps, or fewer where the episode ends. For m steps of discount g it holds
    reward r_1 + g r_2 + ... + g^(m-1) r_m and discount g^(m-1), or 0 where the last one is a failure or success:
    Brax's losses multiply by the last g themselves. At a time limit there is no observation of what comes after
    (the next slot shows a new episode): a window that meets one ends before that step and bootstraps from the
    observation there; a window that begins with it has truncation 1, and the losses leave it out, as Brax's do. Vectors
    are f32, images as stored.
    """
    slots, envs = replay.reward.shape
    key_age, key_env = jax.random.split(key)
    age = jax.random.randint(key_age, (batch_size,), 0, jnp.maximum(replay.filled - n_steps, 1))
    env = jax.random.randint(key_env, (batch_size,), 0, envs)
    first = replay.position - replay.filled + age

    step = jnp.arange(n_steps)[None]
    window = ((first[:, None] + step) % slots, env[:, None])
    done, truncated = replay.done[window], replay.truncated[window]
    ended_before = jnp.cumsum(done, 1) - done > 0
    counts = ~ended_before & ~(truncated & (step > 0))
    length = jnp.sum(counts, 1)
    reward = jnp.sum(jnp.where(counts, replay.reward[window] * discounting**step, 0.0), 1)
    alive = ~jnp.any(counts & done, 1)

    def at(slot: jax.Array) -> Any:
        return _cast(jax.tree.map(lambda ring: ring[slot % slots, env], replay.observation), "float32")

    return types.Transition(  # type: ignore[call-arg]
        observation=at(first),
        action=replay.action[first % slots, env],
        reward=reward,
        discount=alive * jnp.float32(discounting) ** (length - 1),
        next_observation=at(first + length),
        extras={"policy_extras": {}, "state_extras": {"truncation": truncated[:, 0].astype(jnp.float32)}},  # type: ignore
    )


def _cast(observation: Any, dtype: str) -> Any:
    """Return the observation with its vectors in another type; images pass."""
    vectors = jax.tree.map(lambda x: x.astype(dtype), vector_part(observation))
    return {**observation, **vectors} if isinstance(observation, Mapping) else vectors
