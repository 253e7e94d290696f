"""Train a policy by SAC in a batched environment, with Brax's losses, our loop and replay.

Soft actor-critic (Haarnoja et al. 2018, arXiv:1812.05905) with Brax's losses, optimisers and order of steps: a test
compares the parameters after a gradient step with Brax's arithmetic. What differs is in `train.learners.offpolicy`: one
device, a compact replay, images, resuming.

Time limits: Brax's critic loss leaves out a step with `truncation` = 1, because its next state is unknown (the
environment shows a new episode's observation); it says nothing about the step's value, so nothing is learned from it.
"""

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training import distribution, types
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac import networks as sac_networks

from train.config import SACConfig
from train.learners.actor_critic import ActorCritic, ActorCriticState, descend, soft_update


@flax.struct.dataclass
class SACState(ActorCriticState):
    """Adds the temperature."""

    alpha_optimizer_state: optax.OptState
    alpha_params: jax.Array
    """() logarithm of the temperature."""


@dataclasses.dataclass(frozen=True)
class SAC(ActorCritic):
    """Holds all that learning does not change."""

    config: SACConfig

    @staticmethod
    def distribution(action_size: int) -> Any:
        return distribution.NormalTanhDistribution(event_size=action_size)

    @property
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        """Return the optimizers of policy, critics and temperature."""
        c = self.config
        return tuple(map(optax.adam, (c.actor_learning_rate, c.critic_learning_rate, c.alpha_learning_rate)))

    def init(self, key_networks: jax.Array, key: jax.Array) -> SACState:
        """Return a new learner."""
        log_alpha = jnp.log(jnp.float32(self.config.initial_alpha))
        return SACState(
            **self.first_fields(key_networks),
            alpha_optimizer_state=self.optimizers[2].init(log_alpha),
            alpha_params=log_alpha,
            key=key,
        )

    def policy(self, learner: SACState, deterministic: bool) -> types.Policy:
        """Return (observation [N, ...], key) -> (action [N, A] in [-1, 1], extras)."""
        params = self.whole_policy(learner.policy_params, learner.q_params)
        return sac_networks.make_inference_fn(self.networks)((learner.normalizer_params, params), deterministic)

    def init_noise(self) -> tuple[()]:
        """Return nothing: the policy is random itself."""
        return ()

    def explore(
        self, learner: SACState, observation: Any, noise: tuple[()], key: jax.Array
    ) -> tuple[jax.Array, tuple[()]]:
        """Return actions drawn from the policy."""
        return self.policy(learner, deterministic=False)(observation, key)[0], noise

    def gradient_step(
        self, learner: SACState, transitions: types.Transition, key: jax.Array
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """Step temperature, critics, policy and targets, as Brax does, with keys split in the same places."""
        alpha_loss, critic_loss, actor_loss = make_losses(self)
        _, key_alpha, key_critic, key_actor = jax.random.split(key, 4)
        acting_policy = self.whole_policy(learner.policy_params, learner.q_params)
        normalizer, alpha = learner.normalizer_params, jnp.exp(learner.alpha_params)
        alpha_loss_value, alpha_params, alpha_optimizer_state = descend(alpha_loss, self.optimizers[2])(
            learner.alpha_params,
            acting_policy,
            normalizer,
            transitions,
            key_alpha,
            optimizer_state=learner.alpha_optimizer_state,
        )
        changed, metrics = self.descended(
            learner,
            critic_loss,
            (acting_policy, normalizer, learner.target_q_params, alpha, transitions, key_critic),
            actor_loss,
            (alpha, transitions, key_actor),
            transitions,
        )
        return learner.replace(  # type: ignore[attr-defined]
            **changed,
            target_q_params=soft_update(learner.target_q_params, changed["q_params"], self.config.tau),
            alpha_optimizer_state=alpha_optimizer_state,
            alpha_params=alpha_params,
        ), {**metrics, "alpha_loss": alpha_loss_value, "alpha": jnp.exp(alpha_params)}


def make_losses(agent: SAC) -> tuple[Any, Any, Any]:
    """Return Brax's losses of temperature, critics and policy."""
    c = agent.config
    # Brax aims at the entropy -0.5 * action_size and reads action_size for nothing else.
    stand_in: Any = -2.0 * c.target_entropy_per_action * agent.action_size
    return sac_losses.make_losses(agent.networks, c.reward_scaling, c.discounting, action_size=stand_in)
