"""Act into the replay, learn from it, start and resume: the common part of off-policy algorithms.

One update steps every environment `steps_per_update` times and then takes `grad_steps_per_update` gradient steps, each
on a new batch. Until the replay holds `min_replay_size` transitions it takes none (metric `gradient_steps`), and a
learner without any gradient step acts at random; the compiled program is always the same.

The replay travels with the environments in `Snapshot.env_state`, is donated to the compiled update and written in
place. A checkpoint without room for it (`run.env_state_limit_mb`) leaves it out: the resumed run starts new episodes
and fills the replay with its policy before it learns on; these steps count.

It is a ring [slots, envs, ...] of observations and actions. The next observation of a step is the next slot's, so
nothing is stored twice, and the newest `n_steps` slots cannot be drawn yet. After an episode's end the next slot
belongs to another one: the discount is 0, or, at a time limit, the truncation is 1 and the losses leave it out (see
`sample`).

With memory its observations are `memory.History`, and a batch is one of sequences.
"""

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from brax.envs import Env
from brax.training import types

from interactive_nav.task.wrappers import where_rows
from interactive_nav_common.errors import ConfigError
from train.config import OffPolicyConfig
from train.learners import memory, networks
from train.learners.actor_critic import ActorCritic
from train.learners.learner import Snapshot, Update, all_finite, episode_sums, reset_envs


@flax.struct.dataclass
class ReplayBuffer:
    """The ring."""

    observation: Any
    """[slots, envs, ...] before the step, in the environments' types; `memory.History` where there is memory."""
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


def empty_replay(slots: int, observation: Any, action_size: int) -> ReplayBuffer:
    """Return an empty ring for observations shaped as [envs, ...]."""
    envs = jax.tree.leaves(observation)[0].shape[0]
    return ReplayBuffer(
        observation=jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), observation),
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

    The observation [envs, ...] is that before the step, action is [envs, A], the others are [envs]: `done` is nonzero
    if the step ended an episode, `truncated` if the time limit did.
    """
    at, slots = replay.position, replay.reward.shape[0]

    def write(ring: jax.Array, x: jax.Array) -> jax.Array:
        return ring.at[at].set(x.astype(ring.dtype))

    step = {"observation": observation, "action": action, "reward": reward, "done": done, "truncated": truncated}
    written = {name: jax.tree.map(write, getattr(replay, name), value) for name, value in step.items()}
    moved = {"position": (at + 1) % slots, "filled": jnp.minimum(replay.filled + 1, slots)}
    return replay.replace(**written, **moved)  # type: ignore[attr-defined]


def replay_size(replay: ReplayBuffer) -> jax.Array:
    """Return () i32: transitions in the ring, including those that cannot be drawn yet."""
    return replay.filled * replay.reward.shape[1]


def sample(
    replay: ReplayBuffer,
    key: jax.Array,
    batch_size: int,
    n_steps: int,
    discounting: float,
    unroll_length: int = 1,
    burn_in: int = 0,
) -> types.Transition:
    """Draw transitions [batch, ...] uniformly, with replacement, from all that have `n_steps` >= 1 younger slots.

    A transition covers `n_steps` steps, or fewer where the episode ends. For m steps of discount g it holds
    reward r_1 + g r_2 + ... + g^(m-1) r_m and discount g^(m-1), or 0 where the last one is a failure or success:
    Brax's losses multiply by the last g themselves. At a time limit there is no observation of what comes after
    (the next slot shows a new episode): a window that meets one ends before that step and bootstraps from the
    observation there; a window that begins with it has truncation 1, and the losses leave it out, as Brax's do.

    With memory they are [sequences, unroll_length, ...], at least one sequence, and observations are `memory.History`.
    Sequences start at any step, and may reach into the next episode.
    """
    slots, envs = replay.reward.shape
    remembers, younger = isinstance(replay.observation, memory.History), n_steps + burn_in + unroll_length - 1
    shape = (max(1, batch_size // unroll_length), 1)
    key_age, key_env = jax.random.split(key)
    age = jax.random.randint(key_age, shape, 0, jnp.maximum(replay.filled - younger, 1))
    env = jax.random.randint(key_env, shape, 0, envs)
    start, wanted = replay.position - replay.filled + age, jnp.arange(unroll_length)[None]
    first = start + burn_in + wanted

    step = jnp.arange(n_steps)[None, None]
    window = ((first[..., None] + step) % slots, env[..., None])
    done, truncated = replay.done[window], replay.truncated[window]
    ended_before = jnp.cumsum(done, -1) - done > 0
    counts = ~ended_before & ~(truncated & (step > 0))
    length = jnp.sum(counts, -1)
    reward = jnp.sum(jnp.where(counts, replay.reward[window] * discounting**step, 0.0), -1)
    alive = ~jnp.any(counts & done, -1)

    def at(rings: Any, slot: jax.Array) -> Any:
        return jax.tree.map(lambda ring: ring[slot % slots, env], rings)

    def observation(transition: jax.Array) -> Any:
        """Return the observations before transitions, counted from `first`."""
        if not remembers:
            return at(replay.observation, first + transition)
        steps = start + jnp.arange(younger + 1)[None]
        seen, over = at((replay.observation.observation, replay.done), steps)
        kept = jax.tree.map(lambda x: x[:, 0], at(replay.observation.memory, start))
        return memory.History(seen, kept, over, wanted + transition, burn_in)  # type: ignore[call-arg]

    drawn = types.Transition(  # type: ignore[call-arg]
        observation=observation(0 * length),
        action=at(replay.action, first),
        reward=reward,
        discount=alive * jnp.float32(discounting) ** (length - 1),
        next_observation=observation(length),
        extras={"policy_extras": {}, "state_extras": {"truncation": truncated[..., 0].astype(jnp.float32)}},  # type: ignore
    )
    return drawn if remembers else jax.tree.map(lambda x: x[:, 0], drawn)


@flax.struct.dataclass
class OffPolicyData:
    """Holds all that acting changes: environments, replay and noise."""

    env_state: Any
    replay: ReplayBuffer
    noise: Any
    """State of the exploration noise, leaves [envs, ...]."""

    @property
    def info(self) -> dict[str, Any]:
        return self.env_state.info

    @property
    def note(self) -> str:
        """Return what a user should know before training starts, in one line."""
        return describe(self.replay)


def stored(env_state: Any) -> Any:
    """Return what the ring holds of the observation before a step."""
    kept = env_state.info.get("policy")
    return memory.History(env_state.obs, kept) if kept else env_state.obs  # type: ignore[call-arg]


def collect(
    agent: ActorCritic, env: Env, learner: Any, data: OffPolicyData, key: jax.Array
) -> tuple[OffPolicyData, Any]:
    """Act for one update: take `steps_per_update` steps of every environment into the replay.

    Return the new data, vectors and rewards of the steps, leaves [steps, envs, ...], and `sums` over ended episodes.
    """
    assert agent.config.steps_per_update, "the config must be resolved"
    at_random = learner.gradient_steps == 0

    def step(data: OffPolicyData, key: jax.Array) -> tuple[OffPolicyData, Any]:
        key_explore, key_random = jax.random.split(key)
        before = data.env_state
        kept, acting, new = before.info.get("policy"), agent, None
        if kept:
            acting, new = agent.recall(learner, before.obs, kept)
        action, noise = acting.explore(learner, before.obs, data.noise, key_explore)
        random = jax.random.uniform(key_random, action.shape, minval=-1.0, maxval=1.0)
        action = jnp.where(at_random, random, action)
        after = env.step(before, action)
        done, truncated = after.done, after.info["truncation"]
        replay = insert(data.replay, stored(before), action, after.reward, done, truncated)
        collected = {
            "observation": networks.vector_part(before.obs),
            "reward": after.reward,
            "sums": episode_sums(after.info),
        }
        ended = done > 0
        if kept:
            after = after.replace(info=after.info | {"policy": memory.forget(new, ended)})
        return OffPolicyData(after, replay, where_rows(ended, agent.init_noise(), noise)), collected

    return jax.lax.scan(step, data, jax.random.split(key, agent.config.steps_per_update))


def learn(
    agent: ActorCritic, learner: Any, replay: ReplayBuffer, key: jax.Array
) -> tuple[Any, dict[str, jax.Array], Any]:
    """Take gradient steps, if the replay is full enough.

    Return the learner, mean metrics (0 without a step), and one batch: the first with non-finite metrics, if any.
    """
    c = agent.config
    assert c.grad_steps_per_update and c.batch_size and c.min_replay_size, "the config must be resolved"
    keys = jax.random.split(key, c.grad_steps_per_update)
    settings = {"batch_size": c.batch_size, "n_steps": c.n_steps, "discounting": c.discounting}
    remembers = isinstance(replay.observation, memory.History)
    settings |= {"unroll_length": c.unroll_length, "burn_in": c.burn_in} if remembers else {}
    draw = functools.partial(sample, replay, **settings)

    def one(learner: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        key_draw, key_step = jax.random.split(key)
        return agent.gradient_step(learner, draw(key_draw), key_step)

    def body(i: jax.Array, carry: tuple[Any, Any, jax.Array]) -> tuple[Any, Any, jax.Array]:
        learner, sums, good = carry
        learner, metrics = one(learner, keys[i])
        sums = jax.tree.map(jnp.add, sums, metrics)
        return learner, sums, good + all_finite(sums).astype(jnp.int32)

    _, metrics = jax.eval_shape(one, learner, keys[0])
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)
    ready = (replay_size(replay) >= c.min_replay_size) & (replay.filled > c.younger_slots(remembers))
    count = jnp.where(ready, c.grad_steps_per_update, 0)
    learner, sums, good = jax.lax.fori_loop(0, count, body, (learner, zeros, jnp.zeros((), jnp.int32)))
    means = jax.tree.map(lambda x: x / jnp.maximum(count, 1), sums)
    key_draw, _ = jax.random.split(keys[jnp.minimum(good, c.grad_steps_per_update - 1)])
    return learner, {**means, "gradient_steps": count.astype(jnp.float32)}, draw(key_draw)


def update(agent: ActorCritic, env: Env, learner: Any, data: OffPolicyData) -> tuple[Any, OffPolicyData, Update]:
    key_act, key_learn, key_next = jax.random.split(learner.key, 3)
    data, collected = collect(agent, env, learner, data, key_act)
    sums = jax.tree.map(jnp.sum, collected.pop("sums"))
    normalizer = networks.update_normalizer(learner.normalizer_params, collected["observation"])
    learner, losses, batch = learn(agent, learner.replace(normalizer_params=normalizer), data.replay, key_learn)
    learner = learner.replace(key=key_next)
    losses = {
        **losses,
        "reward_per_step": jnp.mean(collected["reward"]),
        "replay_size": replay_size(data.replay).astype(jnp.float32),
    }
    finite = all_finite((losses, learner))
    return learner, data, Update(losses, sums, finite, {"collected": collected, "learned": batch})


def start(agent: ActorCritic, env: Env, seed: int) -> Snapshot:
    """Return the first state of learner, environments and replay, derived from the seed."""
    c = agent.config
    key_networks, key_env, key_updates = jax.random.split(jax.random.PRNGKey(seed), 3)
    env_state = reset_envs(agent, env, key_env)
    make_replay = functools.partial(empty_replay, c.replay_slots, stored(env_state), env.action_size)
    check_memory(c, jax.eval_shape(make_replay), agent.section)
    data = OffPolicyData(env_state, make_replay(), agent.init_noise())
    return Snapshot(0, jax.jit(agent.init)(key_networks, key_updates), data)


def check_memory(config: OffPolicyConfig, replay: ReplayBuffer, section: str) -> None:
    """Raise `ConfigError` where the replay, or one of such shapes, takes more than `replay_limit_gb`."""
    if nbytes(replay) > config.replay_limit_gb * 1e9:
        smaller = "lower network.memory_size, " if isinstance(replay.observation, memory.History) else ""
        if any(leaf.ndim > 3 for leaf in jax.tree.leaves(replay.observation)):
            smaller += "choose env.image_dtype=uint8 if it is not chosen yet, "
        raise ConfigError(
            f"{section}.replay_limit_gb is {config.replay_limit_gb:g}, but the {describe(replay)}; lower "
            f"{section}.max_replay_size, {smaller}or raise the limit"
        )
