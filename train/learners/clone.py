"""Clone behaviour: fit PPO's policy network to recorded actions by maximum likelihood; environments only score it."""

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
from train.learners.learner import Snapshot, Update, all_finite

MOST_ACTION = 0.999
"""Recorded actions are clipped to it: tanh reaches 1 nowhere."""


@flax.struct.dataclass
class CloneData:
    """Holds the environments and the demonstrations."""

    env_state: Any
    observation: Any
    """[R, ...]."""
    action: jax.Array
    """[R, A]."""

    @property
    def info(self) -> dict[str, Any]:
        return self.env_state.info

    @property
    def note(self) -> str:
        """Return how much there is to learn from, in one line."""
        return f"demonstrations: {len(self.action):,} control steps"


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
    first, path = ppo.start(parts, env, seed), Path(parts.clone.demonstrations)
    recorded = read_demonstrations(path, env.unwrapped, parts.clone.episodes == "successful")
    observation, action = jax.tree.map(jnp.asarray, recorded)
    statistics = nets.update_normalizer(first.learner.normalizer_params, observation)
    learner = first.learner.replace(normalizer_params=statistics)
    return Snapshot(0, learner, CloneData(first.env_state, observation, action))


def update(parts: CloneParts, env: Env, state: ppo.PPOState, data: CloneData) -> tuple[ppo.PPOState, Any, Update]:
    """Act in the environments for their scores, and take gradient steps on random demonstrated steps."""
    c, normalizer = parts.clone, state.normalizer_params
    assert c.grad_steps_per_update and c.batch_size, "the config must be resolved"
    key_rows, key_unroll, key_next = jax.random.split(state.key, 3)
    env_state, _, sums = ppo.collect(parts, env, state, data.env_state, key_unroll)
    rows = jax.random.randint(key_rows, (c.grad_steps_per_update, c.batch_size), 0, len(data.action))

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
    learner = state.replace(optimizer_state=optimizer_state, params=params, key=key_next)  # type: ignore[attr-defined]
    data = data.replace(env_state=env_state)  # type: ignore[attr-defined]
    return learner, data, Update(losses, sums, all_finite((losses, params)), rows)
