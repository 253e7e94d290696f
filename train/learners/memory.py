"""Give PPO's policies memory: act with it, collect sequences, and replay them from the memory that they started with.

Actor and critic have a GRU each behind their encoders, or one where they share the encoder. What it remembers travels
as `state.info["policy"]`, is zero when an episode starts, and gradients go back to a sequence's start.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from brax.envs import Env
from brax.training import acting, types
from brax.training.agents.ppo import networks as ppo_networks

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


def make_act(both: ppo_networks.PPONetworks, statistics: Any, params: Sequence[Any], deterministic: bool) -> Act:
    """Return a policy that draws actions as Brax's does."""

    def act(observation: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, dict[str, Any]]:
        networks: Any = (both.policy_network, both.value_network)
        # An evaluation keeps the actor's memory alone.
        new = [
            network.remember(each["encoder"], old, network.encoder.apply(statistics, each["encoder"], observation))
            for network, each, old in zip(networks, params, memory, strict=False)
        ]
        logits = networks[0].head.apply(None, params[0]["head"], new[0])
        head = dataclasses.replace(networks[0].head, apply=lambda *_: logits)
        policy = ppo_networks.make_inference_fn(both.replace(policy_network=head))  # type: ignore[attr-defined]
        action, extras = policy((None, None), deterministic)(observation, key)
        return action, {**extras, "memory": new}

    return act


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


def replay(networks: Sequence[Any], params: Sequence[Any], data: types.Transition) -> types.Transition:
    """Return transitions [sequences, time, ...] with memory [..., H] in place of features, a list of one or two.

    The next observation's is of the episode that goes on; where the last step ended one, losses do not read it.
    """
    over, extras = (data.discount == 0).swapaxes(0, 1), data.extras
    firsts: Any = extras["memory"]  # type: ignore[index]

    def through(network: Any, encoder: Any, first: jax.Array, features: jax.Array, last: jax.Array) -> Any:
        def step(memory: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            memory = network.remember(encoder, memory, inputs[0])
            return forget(memory, inputs[1]), memory

        after, kept = jax.lax.scan(step, first[:, 0], (features.swapaxes(0, 1), over))
        return kept.swapaxes(0, 1), network.remember(encoder, after, last[:, 0])[:, None]

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
