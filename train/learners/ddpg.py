"""Train a policy by DDPG in a batched environment, in the shape of Brax's SAC.

Deep deterministic policy gradient (Lillicrap et al. 2016, arXiv:1509.02971) as the original benchmark has it: Huber
loss, target networks of policy and critic, Ornstein-Uhlenbeck noise (reference benchmark, section 8.2). Several
critics with the least of them as target (Fujimoto et al. 2018, arXiv:1802.09477) are an option.

Time limits: a step with `truncation` = 1 is left out of the critic's loss, as in Brax's SAC: what comes after it is
not observed (the environment shows a new episode's observation).
"""

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training import types
from brax.training.agents.sac.networks import SACNetworks

from train.config import DDPGConfig
from train.learners.actor_critic import ActorCritic, ActorCriticState, soft_update


def action_of(networks: SACNetworks, normalizer_params: Any, policy_params: Any, observation: Any) -> jax.Array:
    """Return the policy's actions [..., A] in [-1, 1]."""
    return jnp.tanh(networks.policy_network.apply(normalizer_params, policy_params, observation))


@flax.struct.dataclass
class DDPGState(ActorCriticState):
    """Adds a target of the policy."""

    target_policy_params: Any


def make_losses(ddpg_network: SACNetworks, reward_scaling: float, discounting: float) -> tuple[Any, Any]:
    """Return the losses of critic and policy, with arguments in Brax's order."""

    def critic_loss(
        q_params: Any,
        target_policy_params: Any,
        normalizer_params: Any,
        target_q_params: Any,
        transitions: types.Transition,
    ) -> jax.Array:
        q_old_action = ddpg_network.q_network.apply(
            normalizer_params, q_params, transitions.observation, transitions.action
        )
        next_action = action_of(ddpg_network, normalizer_params, target_policy_params, transitions.next_observation)
        next_q = ddpg_network.q_network.apply(
            normalizer_params, target_q_params, transitions.next_observation, next_action
        )
        target_q = jax.lax.stop_gradient(
            transitions.reward * reward_scaling + transitions.discount * discounting * jnp.min(next_q, axis=-1)
        )
        extras: Any = transitions.extras
        truncation = extras["state_extras"]["truncation"]
        q_error = (q_old_action - target_q[..., None]) * (1.0 - truncation)[..., None]
        return jnp.mean(optax.losses.huber_loss(q_error))

    def actor_loss(
        policy_params: Any, normalizer_params: Any, q_params: Any, transitions: types.Transition
    ) -> jax.Array:
        action = action_of(ddpg_network, normalizer_params, policy_params, transitions.observation)
        q = ddpg_network.q_network.apply(normalizer_params, q_params, transitions.observation, action)
        return -jnp.mean(q[..., 0])

    return critic_loss, actor_loss


@dataclasses.dataclass(frozen=True)
class DDPG(ActorCritic):
    """Holds all that learning does not change."""

    config: DDPGConfig

    @property
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        """Return the optimizers of policy and critic."""
        return optax.adam(self.config.actor_learning_rate), optax.adam(self.config.critic_learning_rate)

    def init(self, key_networks: jax.Array, key: jax.Array) -> DDPGState:
        """Return a new learner."""
        common = self.first_fields(key_networks)
        return DDPGState(**common, target_policy_params=common["policy_params"], key=key)

    def policy(self, learner: DDPGState, deterministic: bool = True) -> types.Policy:
        """Return (observation [N, ...], key) -> (action [N, A] in [-1, 1], extras), which is never random."""
        del deterministic
        params = self.whole_policy(learner.policy_params, learner.q_params)

        def act(observation: Any, key: jax.Array) -> tuple[jax.Array, dict[str, Any]]:
            del key
            return action_of(self.networks, learner.normalizer_params, params, observation), {}

        return act

    def init_noise(self) -> jax.Array:
        """Return zeros [envs, A]."""
        return jnp.zeros((self.config.num_envs or 1, self.action_size))

    def explore(
        self, learner: DDPGState, observation: Any, noise: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the policy's actions with noise added, clipped to [-1, 1]."""
        c = self.config
        sd = jnp.linspace(c.noise_sd[0], c.noise_sd[-1], noise.shape[0])[:, None]
        kept = 1.0 - c.noise_damping if c.noise == "ou" else 0.0
        noise = kept * noise + sd * jax.random.normal(key, noise.shape)
        action, _ = self.policy(learner)(observation, key)
        return jnp.clip(action + noise, -1.0, 1.0), noise

    def gradient_step(
        self, learner: DDPGState, transitions: types.Transition, key: jax.Array
    ) -> tuple[DDPGState, dict[str, jax.Array]]:
        """Step critic and policy, and the targets when they are due."""
        del key  # nothing is drawn
        c = self.config
        critic_loss, actor_loss = make_losses(self.networks, c.reward_scaling, c.discounting)
        acting = self.whole_policy(learner.target_policy_params, learner.target_q_params)
        changed, metrics = self.descended(
            learner,
            critic_loss,
            (acting, learner.normalizer_params, learner.target_q_params, transitions),
            actor_loss,
            (transitions,),
            transitions,
        )
        tau = jnp.where(changed["gradient_steps"] % c.target_update_period == 0, c.tau, 0.0)
        return learner.replace(  # type: ignore[attr-defined]
            **changed,
            target_policy_params=soft_update(learner.target_policy_params, changed["policy_params"], tau),
            target_q_params=soft_update(learner.target_q_params, changed["q_params"], tau),
        ), metrics
