"""Define the off-policy actor-critics: shared parts, SAC with Brax's losses, and DDPG in the same form.

SAC (Haarnoja et al. 2018, arXiv:1812.05905) takes Brax's losses, optimisers and order of steps; a test compares the
parameters after a gradient step. `train.learners.offpolicy` differs: one device, a compact replay, images, resuming.
DDPG (Lillicrap et al. 2016, arXiv:1509.02971) is the original benchmark's: Huber loss, target networks,
Ornstein-Uhlenbeck noise (reference benchmark, section 8.2), optionally with several critics and the least as target
(Fujimoto et al. 2018, arXiv:1802.09477).

Time limits: the critics' losses leave out a step with `truncation` = 1, because its next state is unknown: the
environment shows a new episode's observation.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Self

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training import distribution, gradients, types
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics
from brax.training.agents.sac import losses as sac_losses
from brax.training.agents.sac import networks as sac_networks

from train.config import DDPGConfig, OffPolicyConfig, SACConfig, TrainConfig
from train.learners import memory, networks
from train.learners.networks import ObservationSize


@flax.struct.dataclass
class ActorCriticState:
    """Holds all that learning changes."""

    policy_optimizer_state: optax.OptState
    policy_params: Any
    q_optimizer_state: optax.OptState
    q_params: Any
    target_q_params: Any
    normalizer_params: running_statistics.RunningStatisticsState
    gradient_steps: jax.Array
    key: jax.Array


@dataclasses.dataclass(frozen=True)
class ActorCritic(memory.Agent):
    """Holds all that learning does not change; a subclass adds its losses, targets and exploration."""

    section: str
    """The name of its settings in the config."""
    config: OffPolicyConfig
    networks: sac_networks.SACNetworks
    """[..., outputs] and [..., critics] of observations, and actions. With memory they take a `memory.History`."""
    size: ObservationSize
    action_size: int
    shared: bool
    """The policy looks through the critics' encoder: its parameters are then `{"head": ...}` alone."""
    memory_size: int = 0
    """Numbers that actor and critics each remember, or together where they share an encoder."""

    @classmethod
    def of(cls, env: Any, config: TrainConfig) -> Self:
        """Build networks for an environment's observations and actions; with images the critics share an encoder."""
        c, network, size = getattr(config, config.algorithm), config.network, env.observation_size
        actions = cls.distribution(env.action_size)
        outputs, critics = actions.param_size if actions else env.action_size, getattr(c, "num_critics", 2)
        prepare: Any = networks.preprocess(c.normalize_observations)
        layers, q_layers, norm = c.policy_hidden_layer_sizes, c.q_hidden_layer_sizes, c.q_layer_norm
        images, remembers = isinstance(size, Mapping), network.memory != "none"
        if images or remembers:
            of_critics, head = images and network.critic_inputs == "all", networks.Head(layers, outputs)
            q_head = networks.TwinHead(q_layers, network.action_features, critics, norm)
            policy = networks.make_split(network, size, images, prepare, head)
            q = networks.make_split(network, size, of_critics, prepare, q_head, env.action_size)
            if remembers:
                policy, q = memory.over_history(policy, 0), memory.over_history(q, -1)
        else:
            policy = brax_networks.make_policy_network(
                outputs, size, preprocess_observations_fn=prepare, hidden_layer_sizes=layers
            )
            q = brax_networks.make_q_network(
                size, env.action_size, prepare, hidden_layer_sizes=q_layers, n_critics=critics, layer_norm=norm
            )
        both = sac_networks.SACNetworks(policy, q, actions)  # type: ignore[call-arg]
        shared = network.share_encoder and (images or remembers)
        return cls(config.algorithm, c, both, size, env.action_size, shared, network.memory_size * remembers)

    @staticmethod
    def distribution(action_size: int) -> Any:
        """Return the distribution that the policy's outputs parametrise; None: they are actions before tanh."""
        return None

    @property
    def steps_per_update(self) -> int:
        """Return the environment steps collected for one update."""
        return (self.config.num_envs or 0) * (self.config.steps_per_update or 0)

    @property
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        """Return the optimizers of policy, critics, and whatever else the algorithm learns, in this order."""
        c: Any = self.config
        return optax.adam(c.actor_learning_rate), optax.adam(c.critic_learning_rate)

    @abc.abstractmethod
    def init(self, key_networks: jax.Array, key: jax.Array) -> Any:
        """Return a new learner; `key` is what its updates will draw from."""

    def recall(self, learner: Any, observation: Any, kept: memory.Memory) -> tuple[Self, memory.Memory]:
        params = self.whole_policy(learner.policy_params, learner.q_params), learner.q_params
        of_both = self.networks.policy_network, self.networks.q_network
        policy, new = memory.advance(of_both, params, learner.normalizer_params, observation, kept)
        return dataclasses.replace(self, networks=self.networks.replace(policy_network=policy)), new  # type: ignore

    def init_noise(self) -> Any:
        """Return the exploration noise of every environment at the start of an episode; none by default."""
        return ()

    def explore(self, learner: Any, observation: Any, noise: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Return actions [envs, A] in [-1, 1] to learn from, by default drawn from the policy, and the next noise."""
        return self.policy(learner, deterministic=False)(observation, key)[0], noise

    @abc.abstractmethod
    def gradient_step(
        self, learner: Any, transitions: types.Transition, key: jax.Array
    ) -> tuple[Any, dict[str, jax.Array]]:
        """Return the learner after a gradient step on transitions, [batch, ...] or sequences, and scalar metrics."""

    def first_fields(self, key: jax.Array) -> dict[str, Any]:
        """Return the fields of a new `ActorCriticState`, without its key."""
        key_policy, key_q = jax.random.split(key)
        policy_params = self.networks.policy_network.init(key_policy)
        policy_params = {"head": policy_params["head"]} if self.shared else policy_params
        q_params = self.networks.q_network.init(key_q)
        return {
            "policy_optimizer_state": self.optimizers[0].init(policy_params),
            "policy_params": policy_params,
            "q_optimizer_state": self.optimizers[1].init(q_params),
            "q_params": q_params,
            "target_q_params": q_params,
            "normalizer_params": networks.init_normalizer(self.size),
            "gradient_steps": jnp.zeros((), jnp.int32),
        }

    def whole_policy(self, policy_params: Any, q_params: Any) -> Any:
        """Return the parameters of the whole policy network, with the critics' encoder if it is shared."""
        return {**policy_params, "encoder": q_params["encoder"]} if self.shared else policy_params

    def descended(
        self,
        learner: Any,
        critic_loss: Callable[..., jax.Array],
        critic_inputs: tuple[Any, ...],
        actor_loss: Callable[..., jax.Array],
        actor_inputs: tuple[Any, ...],
        transitions: types.Transition,
    ) -> tuple[dict[str, Any], dict[str, jax.Array]]:
        """Step critics and policy, each from the other's parameters before the step.

        The actor's loss is (whole policy's parameters, normalizer_params, q_params, *actor_inputs) -> (); it does not
        move a shared encoder. Return the changed fields, except targets, and scalar metrics.
        """

        def policy_loss(policy_params: Any, q_params: Any, *rest: Any) -> jax.Array:
            whole = self.whole_policy(policy_params, q_params)
            return actor_loss(whole, learner.normalizer_params, q_params, *rest)

        critic_loss_value, q_params, q_optimizer_state = descend(critic_loss, self.optimizers[1])(
            learner.q_params, *critic_inputs, optimizer_state=learner.q_optimizer_state
        )
        actor_loss_value, policy_params, policy_optimizer_state = descend(policy_loss, self.optimizers[0])(
            learner.policy_params, learner.q_params, *actor_inputs, optimizer_state=learner.policy_optimizer_state
        )
        values = self.networks.q_network.apply(
            learner.normalizer_params, learner.q_params, transitions.observation, transitions.action
        )
        changed = {
            "policy_optimizer_state": policy_optimizer_state,
            "policy_params": policy_params,
            "q_optimizer_state": q_optimizer_state,
            "q_params": q_params,
            "gradient_steps": learner.gradient_steps + 1,
        }
        metrics = {"critic_loss": critic_loss_value, "actor_loss": actor_loss_value, "q_mean": jnp.mean(values)}
        return changed, metrics


def policy_part(learner: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a learner, as nested dicts, that its policy reads."""
    policy, q = learner["policy_params"], learner["q_params"]
    encoder = {"encoder": q["encoder"]} if "encoder" in q and "encoder" not in policy else {}  # it is shared
    return {"policy_params": policy, "q_params": encoder, "normalizer_params": learner["normalizer_params"]}


def descend(loss: Callable[..., jax.Array], optimizer: optax.GradientTransformation) -> Callable[..., Any]:
    """Return a step down a loss: (params, *rest, optimizer_state=) -> (loss, params, optimizer_state)."""
    # No axis to average gradients over: one device.
    return gradients.gradient_update_fn(loss, optimizer, None)  # type: ignore[arg-type]


@flax.struct.dataclass
class SACState(ActorCriticState):
    """Adds the temperature."""

    alpha_optimizer_state: optax.OptState
    alpha_params: jax.Array
    """() logarithm of the temperature."""


@dataclasses.dataclass(frozen=True)
class SAC(ActorCritic):
    config: SACConfig

    @staticmethod
    def distribution(action_size: int) -> Any:
        return distribution.NormalTanhDistribution(event_size=action_size)

    @property
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        return *super().optimizers, optax.adam(self.config.alpha_learning_rate)

    def init(self, key_networks: jax.Array, key: jax.Array) -> SACState:
        log_alpha = jnp.log(jnp.float32(self.config.initial_alpha))
        return SACState(
            **self.first_fields(key_networks),
            alpha_optimizer_state=self.optimizers[2].init(log_alpha),
            alpha_params=log_alpha,
            key=key,
        )

    def policy(self, learner: SACState, deterministic: bool) -> types.Policy:
        params = self.whole_policy(learner.policy_params, learner.q_params)
        return sac_networks.make_inference_fn(self.networks)((learner.normalizer_params, params), deterministic)

    def gradient_step(
        self, learner: SACState, transitions: types.Transition, key: jax.Array
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """Step temperature, critics, policy and targets, as Brax does, with keys split in the same places."""
        alpha_loss, critic_loss, actor_loss = self.losses()
        _, key_alpha, key_critic, key_actor = jax.random.split(key, 4)
        acting_policy = self.whole_policy(learner.policy_params, learner.q_params)
        normalizer, alpha = learner.normalizer_params, jnp.exp(learner.alpha_params)
        inputs = acting_policy, normalizer, transitions, key_alpha
        alpha_loss_value, alpha_params, alpha_optimizer_state = descend(alpha_loss, self.optimizers[2])(
            learner.alpha_params, *inputs, optimizer_state=learner.alpha_optimizer_state
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
            target_q_params=optax.incremental_update(changed["q_params"], learner.target_q_params, self.config.tau),
            alpha_optimizer_state=alpha_optimizer_state,
            alpha_params=alpha_params,
        ), {**metrics, "alpha_loss": alpha_loss_value, "alpha": jnp.exp(alpha_params)}

    def losses(self) -> tuple[Any, Any, Any]:
        """Return Brax's losses of temperature, critics and policy."""
        c = self.config
        # Brax aims at the entropy -0.5 * action_size and reads action_size for nothing else.
        stand_in: Any = -2.0 * c.target_entropy_per_action * self.action_size
        return sac_losses.make_losses(self.networks, c.reward_scaling, c.discounting, action_size=stand_in)


def action_of(
    both: sac_networks.SACNetworks, normalizer_params: Any, policy_params: Any, observation: Any
) -> jax.Array:
    """Return the policy's actions [..., A] in [-1, 1]."""
    return jnp.tanh(both.policy_network.apply(normalizer_params, policy_params, observation))


@flax.struct.dataclass
class DDPGState(ActorCriticState):
    """Adds a target of the policy."""

    target_policy_params: Any


def ddpg_losses(both: sac_networks.SACNetworks, reward_scaling: float, discounting: float) -> tuple[Any, Any]:
    """Return the losses of critic and policy, with arguments in Brax's order."""

    def critic_loss(
        q_params: Any,
        target_policy_params: Any,
        normalizer_params: Any,
        target_q_params: Any,
        transitions: types.Transition,
    ) -> jax.Array:
        q_old_action = both.q_network.apply(normalizer_params, q_params, transitions.observation, transitions.action)
        next_action = action_of(both, normalizer_params, target_policy_params, transitions.next_observation)
        next_q = both.q_network.apply(normalizer_params, target_q_params, transitions.next_observation, next_action)
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
        action = action_of(both, normalizer_params, policy_params, transitions.observation)
        q = both.q_network.apply(normalizer_params, q_params, transitions.observation, action)
        return -jnp.mean(q[..., 0])

    return critic_loss, actor_loss


@dataclasses.dataclass(frozen=True)
class DDPG(ActorCritic):
    config: DDPGConfig

    def init(self, key_networks: jax.Array, key: jax.Array) -> DDPGState:
        common = self.first_fields(key_networks)
        return DDPGState(**common, target_policy_params=common["policy_params"], key=key)

    def policy(self, learner: DDPGState, deterministic: bool = True) -> types.Policy:
        """Return (observation [N, ...], key) -> (action [N, A] in [-1, 1], extras), which is never random."""
        params = self.whole_policy(learner.policy_params, learner.q_params)

        def act(observation: Any, key: jax.Array) -> tuple[jax.Array, dict[str, Any]]:
            return action_of(self.networks, learner.normalizer_params, params, observation), {}

        return act

    def init_noise(self) -> jax.Array:
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
        """Step critic and policy, and the targets when they are due; nothing is drawn with the key."""
        c = self.config
        critic_loss, actor_loss = ddpg_losses(self.networks, c.reward_scaling, c.discounting)
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
        policy = optax.incremental_update(changed["policy_params"], learner.target_policy_params, tau)
        q = optax.incremental_update(changed["q_params"], learner.target_q_params, tau)
        targets = {"target_policy_params": policy, "target_q_params": q}
        return learner.replace(**changed, **targets), metrics  # type: ignore[attr-defined]
