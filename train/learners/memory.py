"""Give policies memory: act with it, collect sequences, and replay them from the memory that they started with.

Actor and critic have a GRU each behind their encoders, or one where they share the encoder. What it remembers travels
as `state.info["policy"]`, is zero when an episode starts, and gradients go back to a sequence's start. Off-policy
learners take each sequence as a `History`, which their networks read in place of an observation.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Self

import flax.struct
import jax
import jax.numpy as jnp
from brax.envs import Env
from brax.training import acting, types

from interactive_nav_common.errors import ConfigError

Memory = list[jax.Array]
"""[N, H] of the actor's recurrent layer, then of the critic's if it has its own."""
Act = Callable[[Any, Memory, jax.Array], tuple[jax.Array, dict[str, Any]]]
"""(observation [N, ...], memory, key) -> (action [N, A] in [-1, 1], extras), and the new memory among the extras."""


def lost(where: str) -> ConfigError:
    """Return the error of a policy that is played where nothing keeps its memory."""
    return ConfigError(
        f"network.memory is 'gru', and the policy is played as {where}, which keeps no memory from step to step; "
        "expected network.memory 'none', or an evaluation of the run itself (python -m train.evaluate)"
    )


class Agent(abc.ABC):
    """Base of what acts by networks that may have memory."""

    config: Any
    shared: bool
    memory_size: int

    @abc.abstractmethod
    def policy(self, learner: Any, deterministic: bool) -> types.Policy:
        """Return (observation [N, ...], key) -> (action [N, A] in [-1, 1], extras)."""

    @abc.abstractmethod
    def recall(self, learner: Any, observation: Any, kept: Memory) -> tuple[Self, Memory]:
        """Return an agent with the policy for this observation [N, ...] after what was kept, and the new memory."""

    def first_memory(self) -> Memory:
        """Return what the networks remember when episodes start, [envs, H] of each recurrent layer, if any."""
        return [jnp.zeros((self.config.num_envs or 1, self.memory_size))] * bool(self.memory_size) * (2 - self.shared)

    def recurrent_policy(self, learner: Any, deterministic: bool) -> Act:
        """Return the policy of networks with memory; it carries on as many of their memories as it is given."""

        def act(observation: Any, kept: Memory, key: jax.Array) -> tuple[jax.Array, dict[str, Any]]:
            agent, new = self.recall(learner, observation, kept)
            action, extras = agent.policy(learner, deterministic)(observation, key)
            return action, {**extras, "memory": new}

        return act


def advance(networks: Any, params: Any, statistics: Any, observation: Any, memory: Memory) -> tuple[Any, Memory]:
    """Return a network that gives the actor's outputs for an observation [N, ...], and the new memory."""
    # An evaluation keeps the actor's memory alone.
    new = [
        network.remember(each["encoder"], old, network.encoder.apply(statistics, each["encoder"], observation))
        for network, each, old in zip(networks, params, memory, strict=False)
    ]
    outputs = networks[0].head.apply(None, params[0]["head"], new[0])
    return dataclasses.replace(networks[0].head, apply=lambda *_: outputs), new


def forget(memory: Any, over: jax.Array) -> Any:
    """Return memory [N, H] (a pytree) with zeros where episodes are over, [N] bool."""
    return jax.tree.map(lambda x: jnp.where(over[:, None], 0.0, x), memory)


def generate_unroll(
    env: Env, env_state: Any, act: Act, key: jax.Array, unroll_length: int, extra_fields: Sequence[str] = ()
) -> tuple[Any, types.Transition]:
    """Act as Brax's `generate_unroll`, and add `memory`, [1, N, H] before the first step, to the extras."""
    first = jax.tree.map(lambda x: x[None], env_state.info["policy"])

    def step(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], types.Transition]:
        env_state, key = carry
        key, next_key = jax.random.split(key)
        memory = env_state.info["policy"]
        env_state, data = acting.actor_step(
            env, env_state, lambda observation, key: act(observation, memory, key), key, extra_fields
        )
        extras: Any = data.extras
        memory = forget(extras["policy_extras"].pop("memory"), data.discount == 0)
        return (env_state.replace(info=env_state.info | {"policy": memory}), next_key), data

    (env_state, _), data = jax.lax.scan(step, (env_state, key), None, length=unroll_length)
    extras: Any = data.extras
    return env_state, data._replace(extras={**extras, "memory": first})


def unroll(network: Any, encoder: Any, first: Any, features: Any, over: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Go through sequences from their first memory [N, H]; `over` [N, T] says which steps ended an episode.

    Return the memory [N, T, H] after each of the features [N, T, F], and that [N, H] with which the next step starts.
    """

    def step(memory: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        memory = network.remember(encoder, memory, inputs[0])
        return forget(memory, inputs[1]), memory

    after, kept = jax.lax.scan(step, first, (features.swapaxes(0, 1), over.swapaxes(0, 1)))
    return kept.swapaxes(0, 1), after


@flax.struct.dataclass
class History:
    """Holds observations [N, T, ...] of sequences; in a replay, of single steps, with observation and memory alone."""

    observation: Any
    memory: Memory
    """[N, H] before the first step, as it was collected."""
    over: Any = None
    """[N, T] bool: the step ended its episode."""
    at: Any = None
    """[N, L] i32: steps after the burn-in whose outputs are wanted."""
    burn_in: int = flax.struct.field(pytree_node=False, default=0)
    """The first steps, which only bring the memory up to the newest parameters."""


def over_history(network: Any, index: int) -> Any:
    """Return a `Split` whose `apply` takes a `History`, its memory at `index`; gradients do not reach the burn-in."""

    def apply(statistics: Any, params: Any, history: Any, *action: jax.Array) -> jax.Array:
        if not isinstance(history, History):
            raise lost("a function of the observation alone")

        def through(encoder: Any, first: jax.Array, steps: slice) -> tuple[jax.Array, jax.Array]:
            observation = jax.tree.map(lambda x: x[:, steps], history.observation)
            features = network.encoder.apply(statistics, encoder, observation)
            return unroll(network, encoder, first, features, history.over[:, steps])

        first, burn_in = history.memory[index], history.burn_in
        if burn_in:
            _, first = through(jax.lax.stop_gradient(params["encoder"]), first, slice(burn_in))
        kept, _ = through(params["encoder"], first, slice(burn_in, None))
        wanted = jnp.take_along_axis(kept, history.at[..., None], 1)
        return network.head.apply(None, params["head"], wanted, *action)

    return dataclasses.replace(network, apply=apply)


def replay(networks: Sequence[Any], params: Sequence[Any], data: types.Transition) -> types.Transition:
    """Return transitions [sequences, time, ...] with memory [..., H] in place of features, a list of one or two.

    The next observation's is of the episode that goes on; where the last step ended one, losses do not read it.
    """
    over, extras = data.discount == 0, data.extras
    firsts: Any = extras["memory"]  # type: ignore[index]

    def through(network: Any, encoder: Any, first: jax.Array, features: jax.Array, last: jax.Array) -> Any:
        kept, after = unroll(network, encoder, first[:, 0], features, over)
        return kept, network.remember(encoder, after, last[:, 0])[:, None]

    of_both = zip(networks, params, firsts, data.observation, data.next_observation, strict=False)
    kept, last = zip(*(through(network, each["encoder"], *rest) for network, each, *rest in of_both), strict=True)
    return data._replace(observation=list(kept), next_observation=list(last))


@flax.struct.dataclass
class RecurrentPolicy:
    """Plays a learned policy with memory: a `rollout.MemoryPolicy`."""

    learner: Any
    decide: Callable[..., Any] = flax.struct.field(pytree_node=False)
    """(learner, observation, memory, key) -> (action, extras with the new memory)."""
    size: int = flax.struct.field(pytree_node=False)

    def start(self, state: Any, episode: jax.Array) -> Memory:
        """Return the actor's memory at the start of an episode."""
        return [jnp.zeros(self.size)]

    def act(self, memory: Memory, state: Any, key: jax.Array) -> tuple[jax.Array, Memory, jax.Array]:
        """Return the action (A,), the new memory, and whether the environment has ended the episode."""
        action, extras = self.decide(self.learner, state.obs, memory, key)
        return action, extras["memory"], state.done > 0

    def __call__(self, observation: Any, key: jax.Array) -> jax.Array:
        """Refuse to act without memory."""
        raise lost("a function of the observation alone")
