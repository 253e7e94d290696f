"""Train a policy by PPO in a batched environment, with Brax's losses, networks and unrolls.

Brax's `ppo.train` cannot be resumed, so the loop is ours (`learner.run_loop`), and the update is Brax's, with keys
split in the same places: a test compares parameters after an update with those of `brax.training.agents.ppo.train`. We
use jit instead of pmap, sum episode scores before learning, and keep only a sequence's last next-observation.

With `run.devices` above 1 the environments are a `ShardedEnv`, and XLA reduces statistics and gradients. Transitions
stay on their device: each minibatch takes an equal share from each, shuffled within the shares. One device with as many
groups of environments computes the same (a test).

An episode cut by the time limit has `done` = 1 and `truncation` = 1. Brax's GAE leaves the cut step out and bootstraps
the step before it from V(observation at the cut step). We do not use `bootstrap_on_timeout` (reward += discount * V):
it needs `truncation` = 0, takes V before the cut for V after it, and multiplies V by `reward_scaling`.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, Self

import flax.struct
import jax
import jax.numpy as jnp
import optax
from brax.envs import Env
from brax.training import acting, gradients, types
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo import networks as ppo_networks

from interactive_nav.task.privileged import without_privileged
from train.config import PPOConfig, TrainConfig
from train.learners import memory
from train.learners import networks as nets
from train.learners.learner import Snapshot, Update, all_finite, episode_sums, reset_envs
from train.learners.networks import ObservationSize

OF_LOSS = ("entropy_cost", "discounting", "reward_scaling", "gae_lambda", "clipping_epsilon", "normalize_advantage")
"""Settings that Brax's loss takes."""


@flax.struct.dataclass
class SharedParams:
    """Holds the parameters of an actor and a critic that look through one encoder."""

    encoder: Any
    policy: Any
    """Head of the policy."""
    value: Any
    """Head of the value."""


@flax.struct.dataclass
class PPOState:
    """Holds all that learning changes."""

    optimizer_state: optax.OptState
    params: ppo_losses.PPONetworkParams | SharedParams
    normalizer_params: running_statistics.RunningStatisticsState
    key: jax.Array


@dataclasses.dataclass(frozen=True)
class PPOParts(memory.Agent):
    """Holds all that learning does not change."""

    config: PPOConfig
    nets: ppo_networks.PPONetworks
    optimizer: optax.GradientTransformation
    observation_size: ObservationSize
    shared: bool = False
    """Actor and critic have one encoder, and one memory."""
    memory_size: int = 0
    groups: int = 1
    """Equal groups of environments, within which sequences are shuffled: one for each device."""
    learning_rate: optax.Schedule | None = None
    """Adam's step size by its count; none: `config.learning_rate`."""

    @property
    def steps_per_update(self) -> int:
        """Return the environment steps collected for one update."""
        c = self.config
        assert c.batch_size and c.num_minibatches and c.unroll_length, "the config must be resolved"
        return c.batch_size * c.num_minibatches * c.unroll_length

    def init(self, key_networks: jax.Array, key: jax.Array) -> PPOState:
        """Return a new learner; `key` is what its updates will draw from."""
        key_policy, key_value = jax.random.split(key_networks)
        policy = self.nets.policy_network.init(key_policy)  # type: ignore[call-arg]
        value = self.nets.value_network.init(key_value)  # type: ignore[call-arg]
        if self.shared:
            params: Any = SharedParams(encoder=policy["encoder"], policy=policy["head"], value=value["head"])
        else:
            params = ppo_losses.PPONetworkParams(policy=policy, value=value)  # type: ignore[call-arg]
        return PPOState(
            optimizer_state=jax.jit(self.optimizer.init)(params),
            params=params,
            normalizer_params=nets.init_normalizer(self.observation_size),
            key=key,
        )

    def policy(self, learner: PPOState, deterministic: bool) -> types.Policy:
        if self.memory_size:
            raise memory.lost("a function of the observation alone")
        make = ppo_networks.make_inference_fn(self.nets)
        return make((learner.normalizer_params, *whole_params(learner.params)), deterministic)

    def recall(self, learner: PPOState, observation: Any, kept: memory.Memory) -> tuple[Self, memory.Memory]:
        both, params = (self.nets.policy_network, self.nets.value_network), whole_params(learner.params)
        policy, new = memory.advance(both, params, learner.normalizer_params, observation, kept)
        nets = self.nets.replace(policy_network=policy)  # type: ignore[attr-defined]
        return dataclasses.replace(self, nets=nets, memory_size=0), new


def make_agent(env: Any, config: TrainConfig) -> PPOParts:
    """Build networks and optimiser for what an environment observes and takes."""
    network, size, c = config.network, without_privileged(env.observation_size), config.ppo
    layers = c.policy_hidden_layer_sizes, c.value_hidden_layer_sizes
    n = env.privileged_size if network.critic_inputs == "privileged" else 0
    built = nets.make_ppo_networks(network, size, env.action_size, *layers, c.normalize_observations, n)
    shared, memory_size = network.share_encoder and isinstance(built.policy_network, nets.Split), network.memory_size
    memory_size *= network.memory != "none"
    parts = PPOParts(c, built, optax.identity(), size, shared, memory_size, config.run.devices)
    rate, end = None, c.final_learning_rate
    if end is not None:
        updates = math.ceil(config.run.num_timesteps / parts.steps_per_update)
        rate = optax.linear_schedule(c.learning_rate, end, updates * c.num_updates_per_batch * (c.num_minibatches or 1))
    optimizer = optax.chain(optax.clip_by_global_norm(c.max_grad_norm), optax.adam(rate or c.learning_rate))
    return dataclasses.replace(parts, optimizer=optimizer, learning_rate=rate)


def policy_part(learner: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a learner, as nested dicts, that its policy reads."""
    params = {name: value for name, value in learner["params"].items() if name != "value"}
    return {"params": params, "normalizer_params": learner["normalizer_params"]}


def whole_params(params: ppo_losses.PPONetworkParams | SharedParams) -> tuple[Any, Any]:
    """Return the parameters of the policy and the value network as `PPOParts.networks` take them."""
    if isinstance(params, SharedParams):
        return {"encoder": params.encoder, "head": params.policy}, {"encoder": params.encoder, "head": params.value}
    return params.policy, params.value


def collect(
    parts: PPOParts, env: Env, state: PPOState, env_state: Any, key: jax.Array
) -> tuple[Any, types.Transition, dict[str, jax.Array]]:
    """Act for one update; return environment state, transitions [sequences, time, ...], and ended episodes' sums."""
    config = parts.config
    make, generate_unroll = parts.policy, acting.generate_unroll
    if parts.memory_size:
        make, generate_unroll = parts.recurrent_policy, memory.generate_unroll
    act: Any = make(state, deterministic=False)
    assert config.batch_size and config.num_minibatches and config.num_envs

    def unroll(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], Any]:
        env_state, key = carry
        key, next_key = jax.random.split(key)
        env_state, data = generate_unroll(
            env,
            env_state,
            act,
            key,
            config.unroll_length or 0,
            extra_fields=("truncation", "episode_metrics", "episode_done"),
        )
        extras: Any = data.extras["state_extras"]  # type: ignore[call-overload,index]
        sums = episode_sums(extras)
        data = data._replace(
            extras={**data.extras, "state_extras": {"truncation": extras["truncation"]}},  # type: ignore[dict-item]
            next_observation=jax.tree.map(lambda x: x[-1:], data.next_observation),
        )
        return (env_state, next_key), (data, sums)

    length = config.batch_size * config.num_minibatches // config.num_envs
    (env_state, _), (data, sums) = jax.lax.scan(unroll, (env_state, key), None, length=length)

    def sequences(x: jax.Array) -> jax.Array:
        """[unrolls, time, envs, ...] -> [sequences, time, ...], group by group."""
        unrolls, time, _, *rest = x.shape
        x = x.reshape(unrolls, time, parts.groups, -1, *rest)
        return x.transpose(2, 0, 3, 1, *range(4, x.ndim)).reshape(-1, time, *rest)

    return env_state, jax.tree.map(sequences, data), jax.tree.map(jnp.sum, sums)


def loss_of_splits(
    both: ppo_networks.PPONetworks,
    params: ppo_losses.PPONetworkParams | SharedParams,
    normalizer_params: Any,
    data: types.Transition,
    key: jax.Array,
    **settings: Any,
) -> tuple[jax.Array, types.Metrics]:
    """Return Brax's loss of the two heads, on features of one shared encoder or of one each.

    Features are computed before Brax puts time first: otherwise a convolution over [time, sequences] would gather all
    images on every device. Networks with memory go through each sequence from the memory that it was collected with.
    """
    networks, whole = (both.policy_network, both.value_network), whole_params(params)
    encoders = [network.encoder.apply for network in networks]  # type: ignore[attr-defined]
    parts = list(zip(encoders, whole, strict=True))[: 1 if isinstance(params, SharedParams) else 2]

    def encode(observation: Any) -> list[jax.Array]:
        return [apply(normalizer_params, each["encoder"], observation) for apply, each in parts]

    def head(network: Any, index: int) -> Any:
        return dataclasses.replace(network.head, apply=lambda _, p, features: network.head.apply(_, p, features[index]))

    data = data._replace(observation=encode(data.observation), next_observation=encode(data.next_observation))
    data = memory.replay(networks, whole, data) if getattr(networks[0], "remember", None) else data
    heads = ppo_losses.PPONetworkParams(policy=whole[0]["head"], value=whole[1]["head"])  # type: ignore[call-arg]
    of_heads: Any = both.replace(policy_network=head(networks[0], 0), value_network=head(networks[1], -1))  # type: ignore
    return ppo_losses.compute_ppo_loss(heads, None, data, key, ppo_network=of_heads, **settings)


def learn(
    parts: PPOParts, state: PPOState, data: types.Transition, normalizer_params: Any, key: jax.Array
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """Pass over transitions [sequences, time, ...] several times, in shuffled minibatches.

    Return the optimiser's state, the parameters, and losses [passes, minibatches].
    """
    config = parts.config
    of_vectors = functools.partial(ppo_losses.compute_ppo_loss, ppo_network=parts.nets)
    splits = isinstance(parts.nets.policy_network, nets.Split)
    loss_fn = functools.partial(
        functools.partial(loss_of_splits, parts.nets) if splits else of_vectors,
        **{name: getattr(config, name) for name in OF_LOSS},
        vf_coefficient=config.vf_loss_coefficient,
    )
    loss_and_grad = gradients.loss_and_pgrad(loss_fn, pmap_axis_name=None, has_aux=True)  # type: ignore[arg-type]

    def minibatch_step(carry: Any, batch: types.Transition) -> tuple[Any, dict[str, jax.Array]]:
        optimizer_state, params, key = carry
        key, key_loss = jax.random.split(key)
        (_, losses), grads = loss_and_grad(params, normalizer_params, batch, key_loss)
        updates, optimizer_state = parts.optimizer.update(grads, optimizer_state)
        params = optax.apply_updates(params, updates)
        return (optimizer_state, params, key), {**losses, "grad_norm": optax.tree.norm(grads)}

    def one_pass(carry: Any, _: None) -> tuple[Any, dict[str, jax.Array]]:
        optimizer_state, params, key = carry
        key, key_perm, key_grad = jax.random.split(key, 3)

        keys = jax.random.split(key_perm, parts.groups) if parts.groups > 1 else key_perm[None]  # 1: Brax's

        def shuffle(x: jax.Array) -> jax.Array:
            """[sequences, ...] -> [minibatches, sequences of one, ...]."""
            x = jax.vmap(jax.random.permutation)(keys, x.reshape(parts.groups, -1, *x.shape[1:]))
            x = x.reshape(parts.groups, config.num_minibatches, -1, *x.shape[2:]).swapaxes(0, 1)
            return x.reshape(config.num_minibatches, -1, *x.shape[3:])

        carry = optimizer_state, params, key_grad
        (optimizer_state, params, _key), losses = jax.lax.scan(minibatch_step, carry, jax.tree.map(shuffle, data))
        return (optimizer_state, params, key), losses

    carry = state.optimizer_state, state.params, key
    (optimizer_state, params, _), losses = jax.lax.scan(one_pass, carry, None, length=config.num_updates_per_batch)
    return optimizer_state, params, losses


def update(parts: PPOParts, env: Env, state: PPOState, env_state: Any) -> tuple[PPOState, Any, Update]:
    """Collect a batch and learn from it: Brax's training step."""
    key_sgd, key_unroll, key_next = jax.random.split(state.key, 3)
    env_state, data, sums = collect(parts, env, state, env_state, key_unroll)
    statistics = nets.update_normalizer(state.normalizer_params, data.observation)
    optimizer_state, params, losses = learn(parts, state, data, statistics, key_sgd)
    rate: Any = parts.learning_rate(state.optimizer_state[1][0].count) if parts.learning_rate else None  # type: ignore[index]
    rate = jnp.asarray(parts.config.learning_rate if rate is None else rate)
    means = {"learning_rate": rate, "reward_per_step": jnp.mean(data.reward)}
    losses = jax.tree.map(jnp.mean, losses) | means
    new_state = PPOState(optimizer_state=optimizer_state, params=params, normalizer_params=statistics, key=key_next)
    finite = all_finite((losses, params, statistics.mean, statistics.std))
    return new_state, env_state, Update(losses, sums, finite, data)


def start(parts: PPOParts, env: Env, seed: int) -> Snapshot:
    """Return the first state of learner and environments; keys are derived from the seed as Brax derives them."""
    key_networks, key_local = jax.random.split(jax.random.PRNGKey(seed))
    key_local, key_env, _ = jax.random.split(jax.random.fold_in(key_local, 0), 3)
    key_updates = jax.random.split(jax.random.split(key_local)[0], 1)[0]
    return Snapshot(0, parts.init(key_networks, key_updates), reset_envs(parts, env, key_env))
