"""Name the algorithms, and train, restore and play each in the same way."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
from brax.envs import Env
from brax.training import types

from interactive_nav.task.wrappers import ShardedEnv
from train.config import TrainConfig
from train.learners import clone, offpolicy, ppo
from train.learners.actor_critic import DDPG, SAC, policy_part
from train.learners.learner import Callbacks, Snapshot, TrainResult, Update, reset_envs, run_loop


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """Says how an algorithm starts, what an update does, and which part of its learner is the policy."""

    make_agent: Callable[[Any, TrainConfig], Any]
    """Networks and settings, which learning does not change; raises ConfigError where they do not fit an environment's
    observations."""
    start: Callable[[Any, Env, int], Snapshot]
    """(agent, env, seed) -> the first state of learner and environments."""
    update: Callable[[Any, Env, Any, Any], tuple[Any, Any, Update]]
    """(agent, env, learner, env_state) -> both after one update, and its metrics."""
    policy_part: Callable[[Mapping[str, Any]], Mapping[str, Any]]
    """(learner as nested dicts) -> the part that `agent.policy` reads, parameters and normaliser: all that an exported
    policy holds."""

    def train(self, env: Env, config: TrainConfig, callbacks: Callbacks) -> TrainResult:
        agent = self.make_agent(env, config)
        first = self.start(agent, env, config.run.seed)
        snapshot = callbacks.restore(first) or first
        if snapshot.env_state is None:
            key = jax.random.fold_in(jax.random.PRNGKey(config.run.seed), snapshot.env_steps)
            fresh, data = reset_envs(agent, env, key), first.env_state
            kept = isinstance(data, offpolicy.OffPolicyData | clone.CloneData)
            state = data.replace(env_state=fresh) if kept else fresh
            snapshot = dataclasses.replace(snapshot, env_state=state)
        if isinstance(env, ShardedEnv):  # a checkpoint's arrays come from one device
            learner = jax.device_put(snapshot.learner, env.replicated)
            snapshot = Snapshot(snapshot.env_steps, learner, jax.device_put(snapshot.env_state, env.sharding))
        update_fn = functools.partial(self.update, agent, env)
        return run_loop(update_fn, snapshot, agent.steps_per_update, config.run, callbacks)

    def template(self, env: Any, config: TrainConfig) -> Any:
        """Return a learner in the shapes that this config's checkpoints have."""
        key = jax.random.PRNGKey(0)
        return self.make_agent(env, config).init(key, key)

    def policy(self, env: Any, config: TrainConfig, learner: Any, deterministic: bool) -> types.Policy:
        """Return (observation [N, ...], key) -> (action [N, A] in [-1, 1], extras)."""
        return self.make_agent(env, config).policy(learner, deterministic)


ALGORITHMS = {
    "ppo": Algorithm(ppo.make_agent, ppo.start, ppo.update, ppo.policy_part),
    "sac": Algorithm(SAC.of, offpolicy.start, offpolicy.update, policy_part),
    "ddpg": Algorithm(DDPG.of, offpolicy.start, offpolicy.update, policy_part),
    "clone": Algorithm(clone.make_agent, clone.start, clone.update, ppo.policy_part),
}
