"""TD3 (Fujimoto et al. 2018, arXiv:1802.09477), added as docs/extend.md describes: the example of a new algorithm."""

import dataclasses
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training import types

from interactive_nav_common.config import AtLeastOne, NotNegative, Positive, Share
from train.config import OffPolicyConfig, TrainConfig
from train.learners import offpolicy
from train.learners.actor_critic import ActorCritic, ActorCriticState, action_of, policy_part
from train.learners.algorithms import Algorithm


@dataclasses.dataclass(frozen=True)
class TD3Config(OffPolicyConfig):
    """Twin delayed deep deterministic policy gradient."""

    learning_rate: Positive = 3e-4
    """Adam's step size for policy and critics."""
    tau: Share = 0.005
    """Share of the networks in their targets at each update of the targets."""
    policy_delay: AtLeastOne = 2
    """Gradient steps of the critics for each one of the policy and the targets."""
    noise_sd: NotNegative = 0.1
    """Deviation of the exploration noise."""
    smoothing_sd: NotNegative = 0.2
    """Deviation of the noise on the target policy's actions."""
    smoothing_limit: NotNegative = 0.5
    """Largest noise on the target policy's actions."""


@dataclasses.dataclass(frozen=True)
class TrainConfigWithTD3(TrainConfig):
    """`TrainConfig` as it would be with a field `td3`."""

    algorithm: Literal["ppo", "sac", "ddpg", "td3"] = "ppo"
    """Learner."""
    td3: TD3Config = dataclasses.field(default_factory=TD3Config)
    """Settings of TD3."""


@flax.struct.dataclass
class TD3State(ActorCriticState):
    """Adds a target of the policy."""

    target_policy_params: Any


@dataclasses.dataclass(frozen=True)
class TD3(ActorCritic):
    """Holds all that learning does not change."""

    config: TD3Config

    @property
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        return optax.adam(self.config.learning_rate), optax.adam(self.config.learning_rate)

    def init(self, key_networks: jax.Array, key: jax.Array) -> TD3State:
        fields = self.first_fields(key_networks)
        return TD3State(**fields, target_policy_params=fields["policy_params"], key=key)

    def policy(self, learner: TD3State, deterministic: bool = True) -> types.Policy:
        params = self.whole_policy(learner.policy_params, learner.q_params)
        return lambda observation, key: (action_of(self.networks, learner.normalizer_params, params, observation), {})

    def init_noise(self) -> tuple[()]:
        return ()

    def explore(self, learner: TD3State, observation: Any, noise: tuple[()], key: jax.Array) -> tuple[Any, tuple[()]]:
        action, _ = self.policy(learner)(observation, key)
        return jnp.clip(action + self.config.noise_sd * jax.random.normal(key, action.shape), -1.0, 1.0), noise

    def gradient_step(
        self, learner: TD3State, transitions: types.Transition, key: jax.Array
    ) -> tuple[TD3State, dict[str, jax.Array]]:
        c, normalizer, apply_q = self.config, learner.normalizer_params, self.networks.q_network.apply
        noise = c.smoothing_sd * jax.random.normal(key, transitions.action.shape)
        target_policy = self.whole_policy(learner.target_policy_params, learner.target_q_params)
        next_action = action_of(self.networks, normalizer, target_policy, transitions.next_observation)
        next_action = jnp.clip(next_action + jnp.clip(noise, -c.smoothing_limit, c.smoothing_limit), -1.0, 1.0)
        next_q = apply_q(normalizer, learner.target_q_params, transitions.next_observation, next_action)
        target_q = transitions.reward * c.reward_scaling + transitions.discount * c.discounting * next_q.min(-1)
        extras: Any = transitions.extras
        counts = 1.0 - extras["state_extras"]["truncation"]

        def critic_loss(q_params: Any) -> jax.Array:
            q = apply_q(normalizer, q_params, transitions.observation, transitions.action)
            return jnp.mean(((q - target_q[..., None]) * counts[..., None]) ** 2)

        def actor_loss(policy_params: Any, normalizer: Any, q_params: Any) -> jax.Array:
            action = action_of(self.networks, normalizer, policy_params, transitions.observation)
            return -jnp.mean(apply_q(normalizer, q_params, transitions.observation, action)[..., 0])

        changed, metrics = self.descended(learner, critic_loss, (), actor_loss, (), transitions)
        due = changed["gradient_steps"] % c.policy_delay == 0
        for name in ("policy_params", "policy_optimizer_state"):
            delayed = jax.tree.map(lambda new, old: jnp.where(due, new, old), changed[name], getattr(learner, name))
            changed[name] = delayed
        tau = jnp.where(due, c.tau, 0.0)
        return learner.replace(  # type: ignore[attr-defined]
            **changed,
            target_policy_params=optax.incremental_update(changed["policy_params"], learner.target_policy_params, tau),
            target_q_params=optax.incremental_update(changed["q_params"], learner.target_q_params, tau),
        ), metrics


ALGORITHM = Algorithm(TD3.of, offpolicy.start, offpolicy.update, policy_part)
