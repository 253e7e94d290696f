"""Names of algorithms -> the learners behind them: one face for training, checkpoints and evaluation."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
from brax.envs import Env
from brax.training import types

from train.config import TrainConfig
from train.learners import ddpg, offpolicy, ppo, sac
from train.learners.learner import Callbacks, Snapshot, TrainResult, Update, reset_envs, run_loop


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """How an algorithm begins and what it does in an update."""

    make_agent: Callable[[Any, TrainConfig], Any]
    """Networks and settings, which learning does not change; raises ConfigError where they do not fit an environment's
    observations."""
    start: Callable[[Any, Env, int], Snapshot]
    """(agent, env, seed) -> the first state of learner and environments."""
    update: Callable[[Any, Env, Any, Any], tuple[Any, Any, Update]]
    """(agent, env, learner, env_state) -> both after one update, and what is told of it."""

    def train(self, env: Env, config: TrainConfig, callbacks: Callbacks) -> TrainResult:
        """Trains a policy."""
        agent = self.make_agent(env, config)
        begin = self.start(agent, env, config.run.seed)
        restored = callbacks.restore(begin)
        if restored is not None and restored.env_state is None:
            key = jax.random.fold_in(jax.random.PRNGKey(config.run.seed), restored.env_steps)
            fresh, data = reset_envs(agent, env, key), begin.env_state
            state = data.replace(env_state=fresh) if isinstance(data, offpolicy.OffPolicyData) else fresh
            restored = dataclasses.replace(restored, env_state=state)
        update_fn = functools.partial(self.update, agent, env)
        return run_loop(update_fn, restored or begin, agent.steps_per_update, config.run, callbacks)

    def template(self, env: Any, config: TrainConfig) -> Any:
        """A learner in the shapes that this config's checkpoints have."""
        key = jax.random.PRNGKey(0)
        return self.make_agent(env, config).init(key, key)

    def policy(self, env: Any, config: TrainConfig, learner: Any, deterministic: bool) -> types.Policy:
        """(observation [N, ...], key) -> (action [N, A] in [-1, 1], extras)."""
        return self.make_agent(env, config).policy(learner, deterministic)


ALGORITHMS = {
    "ppo": Algorithm(ppo.make_agent, ppo.start, ppo.update),
    "sac": Algorithm(sac.make_agent, offpolicy.start, offpolicy.update),
    "ddpg": Algorithm(ddpg.make_agent, offpolicy.start, offpolicy.update),
}
