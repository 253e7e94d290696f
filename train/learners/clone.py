"""Clone behaviour: fit PPO's policy network to actions by maximum likelihood.

The actions are recorded ones, and environments only score the policy; or a teacher chooses them in states that the
policy visits (DAgger: Ross, Gordon and Bagnell 2011), one round an update, of which `clone.buffer_steps` are kept.
"""

import dataclasses
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.envs import Env

from train.config import CloneConfig, PPOConfig, TrainConfig
from train.learners import networks as nets
from train.learners import ppo
from train.learners.demonstrations import read_demonstrations
from train.learners.learner import Snapshot, Update, all_finite, episode_sums

MOST_ACTION = 0.999
"""Recorded actions are clipped to it: tanh reaches 1 nowhere."""


@flax.struct.dataclass
class CloneData:
    """Holds the environments and R labelled control steps."""

    env_state: Any
    observation: Any
    """[R, ...]."""
    action: jax.Array
    """[R, A]."""
    taken: jax.Array
    """[] i32 rows written so far; beyond R the oldest are overwritten."""

    @property
    def info(self) -> dict[str, Any]:
        return self.env_state.info

    def keep(self, rows: Any) -> "CloneData":
        """Return the data with the newest rows (observations, actions) in the places of the oldest."""
        rows = jax.tree.map(lambda x: x[-len(self.action) :], rows)
        number = len(rows[1])
        at = (self.taken + jnp.arange(number)) % len(self.action)
        old = self.observation, self.action
        observation, action = jax.tree.map(lambda x, new: x.at[at].set(new), old, rows)
        return CloneData(self.env_state, observation, action, self.taken + number)

    @property
    def note(self) -> str:
        """Return how much there is to learn from, in one line."""
        return f"labelled control steps: {int(self.taken):,}" if self.taken else ""


@dataclasses.dataclass(frozen=True)
class CloneParts(ppo.PPOParts):
    clone: CloneConfig = dataclasses.field(default_factory=CloneConfig)


def make_agent(env: Any, config: TrainConfig) -> CloneParts:
    """Build PPO's networks and optimiser with the settings of `clone`."""
    c = config.clone
    shared = {f.name for f in dataclasses.fields(CloneConfig)} & {f.name for f in dataclasses.fields(PPOConfig)}
    settings = {name: getattr(c, name) for name in shared} | {"batch_size": c.num_envs, "num_minibatches": 1}
    parts = ppo.make_agent(env, dataclasses.replace(config, ppo=PPOConfig(**settings)))
    return CloneParts(**vars(parts), clone=c)


def start(parts: CloneParts, env: Env, seed: int) -> Snapshot:
    """Return the first state, with the demonstrations read and the observations' statistics taken from them."""
    first, c = ppo.start(parts, env, seed), parts.clone
    state: Any = first.env_state
    if c.teacher:
        one_row = state.obs, jnp.zeros((1, env.action_size))
        none = jax.tree.map(lambda x: jnp.zeros((c.buffer_steps, *x.shape[1:]), x.dtype), one_row)
        return Snapshot(0, first.learner, CloneData(state, none[0], none[1], jnp.int32(0)))
    recorded = read_demonstrations(Path(c.demonstrations), env.unwrapped, c.episodes == "successful")
    observation, action = jax.tree.map(jnp.asarray, recorded)
    statistics = nets.update_normalizer(first.learner.normalizer_params, observation)
    learner = first.learner.replace(normalizer_params=statistics)
    return Snapshot(0, learner, CloneData(state, observation, action, jnp.int32(len(action))))


def visit(parts: CloneParts, env: Any, learner: ppo.PPOState, env_state: Any, key: jax.Array) -> tuple[Any, Any, Any]:
    """Drive, student or teacher in each step; return environments, rows (observations, labels), and episodes' sums."""
    student = parts.policy(learner, deterministic=False)

    def step(state: Any, key: jax.Array) -> tuple[Any, Any]:
        key_student, key_teacher, key_who = jax.random.split(key, 3)
        label = jnp.clip(env.teach(state, key_teacher), -1.0, 1.0)
        own = jax.random.uniform(key_who, (len(label), 1)) < parts.clone.student_share
        new = env.step(state, jnp.where(own, student(state.obs, key_student)[0], label))
        return new, ((state.obs, label), {name: new.info[name] for name in ("episode_done", "episode_metrics")})

    env_state, (rows, ended) = jax.lax.scan(step, env_state, jax.random.split(key, parts.clone.unroll_length or 0))
    return env_state, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows), episode_sums(ended)


def update(parts: CloneParts, env: Env, state: ppo.PPOState, data: CloneData) -> tuple[ppo.PPOState, Any, Update]:
    """Act in the environments, for scores or for labels, and take gradient steps on random labelled steps."""
    c, normalizer = parts.clone, state.normalizer_params
    assert c.grad_steps_per_update and c.batch_size, "the config must be resolved"
    key_rows, key_unroll, key_next = jax.random.split(state.key, 3)
    if c.teacher:
        env_state, new, sums = visit(parts, env, state, data.env_state, key_unroll)
        normalizer, data = nets.update_normalizer(normalizer, new[0]), data.keep(new)
    else:
        env_state, _, sums = ppo.collect(parts, env, state, data.env_state, key_unroll)
    filled = jnp.minimum(data.taken, len(data.action))
    rows = jax.random.randint(key_rows, (c.grad_steps_per_update, c.batch_size), 0, filled)

    def loss_fn(params: Any, observation: Any, action: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        logits = parts.nets.policy_network.apply(normalizer, ppo.whole_params(params)[0], observation)
        actions = parts.nets.parametric_action_distribution
        before_tanh = jnp.arctanh(jnp.clip(action, -MOST_ACTION, MOST_ACTION))
        loss = -jnp.mean(actions.log_prob(logits, before_tanh))
        return loss, {"total_loss": loss, "squared_error": jnp.mean((actions.mode(logits) - action) ** 2)}

    def step(carry: Any, row: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        optimizer_state, params = carry
        batch = jax.tree.map(lambda x: x[row], (data.observation, data.action))
        grads, losses = jax.grad(loss_fn, has_aux=True)(params, *batch)
        updates, optimizer_state = parts.optimizer.update(grads, optimizer_state, params)
        return (optimizer_state, optax.apply_updates(params, updates)), losses

    (optimizer_state, params), losses = jax.lax.scan(step, (state.optimizer_state, state.params), rows)
    losses = jax.tree.map(jnp.mean, losses)
    changed = {"optimizer_state": optimizer_state, "params": params, "normalizer_params": normalizer}
    learner = state.replace(**changed, key=key_next)  # type: ignore[attr-defined]
    data = data.replace(env_state=env_state)  # type: ignore[attr-defined]
    return learner, data, Update(losses, sums, all_finite((losses, params)), rows)
