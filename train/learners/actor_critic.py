"""Share what actor-critic learners have in common: networks, first parameters, and a step down both losses."""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Self

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.training import gradients, types
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics
from brax.training.agents.sac import networks as sac_networks

from train.config import OffPolicyConfig, TrainConfig
from train.learners import networks
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
class ActorCritic(abc.ABC):
    """Holds all that learning does not change; a subclass adds its losses, targets and exploration."""

    section: str
    """The name of its settings in the config."""
    config: OffPolicyConfig
    networks: sac_networks.SACNetworks
    """[..., outputs] and [..., critics] of observations, and actions."""
    size: ObservationSize
    action_size: int
    shared: bool
    """The policy looks through the critics' encoder: its parameters are then `{"head": ...}` alone."""

    @classmethod
    def of(cls, env: Any, config: TrainConfig) -> Self:
        """Build networks for an environment's observations and actions; with images the critics share an encoder."""
        c, network, size = getattr(config, config.algorithm), config.network, env.observation_size
        distribution = cls.distribution(env.action_size)
        outputs, critics = distribution.param_size if distribution else env.action_size, getattr(c, "num_critics", 2)
        prepare: Any = networks.preprocess(c.normalize_observations)
        layers, q_layers, norm = c.policy_hidden_layer_sizes, c.q_hidden_layer_sizes, c.q_layer_norm
        if isinstance(size, Mapping):
            images, head = network.critic_inputs == "all", networks.Head(layers, outputs)
            q_head = networks.TwinHead(q_layers, network.action_features, critics, norm)
            policy = networks.make_split(network, size, True, prepare, head).whole()
            q = networks.make_split(network, size, images, prepare, q_head, env.action_size).whole()
        else:
            policy = brax_networks.make_policy_network(
                outputs, size, preprocess_observations_fn=prepare, hidden_layer_sizes=layers
            )
            q = brax_networks.make_q_network(
                size, env.action_size, prepare, hidden_layer_sizes=q_layers, n_critics=critics, layer_norm=norm
            )
        both = sac_networks.SACNetworks(policy, q, distribution)  # type: ignore[call-arg]
        shared = network.share_encoder and isinstance(size, Mapping)
        return cls(config.algorithm, c, both, size, env.action_size, shared)

    @staticmethod
    def distribution(action_size: int) -> Any:
        """Return the distribution that the policy's outputs parametrise; None: they are actions before tanh."""
        return None

    @property
    def steps_per_update(self) -> int:
        """Return the environment steps collected for one update."""
        return (self.config.num_envs or 0) * (self.config.steps_per_update or 0)

    @property
    @abc.abstractmethod
    def optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        """Return the optimizers of policy, critics, and whatever else the algorithm learns, in this order."""

    @abc.abstractmethod
    def init(self, key_networks: jax.Array, key: jax.Array) -> Any:
        """Return a new learner; `key` is what its updates will draw from."""

    @abc.abstractmethod
    def policy(self, learner: Any, deterministic: bool) -> types.Policy:
        """Return (observation [N, ...], key) -> (action [N, A] in [-1, 1], extras)."""

    @abc.abstractmethod
    def init_noise(self) -> Any:
        """Return the exploration noise of every environment at the start of an episode."""

    @abc.abstractmethod
    def explore(self, learner: Any, observation: Any, noise: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Return actions [envs, A] in [-1, 1] to learn from, and the noise after them."""

    @abc.abstractmethod
    def gradient_step(
        self, learner: Any, transitions: types.Transition, key: jax.Array
    ) -> tuple[Any, dict[str, jax.Array]]:
        """Return the learner after one gradient step on transitions [batch, ...], and scalar metrics."""

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

        The actor's loss is (whole policy's parameters, normalizer_params, q_params, *actor_inputs) -> (); a shared
        encoder does not move with it.

        Returns:
            The learner's fields that change, without its targets; scalar metrics, with the mean value of the
            transitions' actions.
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


def soft_update(target: Any, online: Any, tau: float | jax.Array) -> Any:
    """Move targets by `tau` towards the networks they follow, written as Brax writes it."""
    return jax.tree.map(lambda x, y: x * (1 - tau) + y * tau, target, online)
