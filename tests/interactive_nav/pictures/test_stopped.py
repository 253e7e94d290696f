"""An episode that is stopped while physics on the host steps."""

import signal
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import State

from interactive_nav.pictures.replay import EpisodePlayer
from interactive_nav.task import rollout


class Nav(NamedTuple):
    step_count: jax.Array
    memory: dict[str, jax.Array]
    waypoints_b: jax.Array


class Pose(NamedTuple):
    qpos: jax.Array


class OnHost:
    """Physics as a callback, within whose third step a signal comes."""

    steps, action_size, backend, metric_names = 0, 2, "native", ()

    def reset(self, key):
        zero, count = jnp.zeros(()), jnp.zeros((), jnp.int32)
        memory = {"force_sum_n": zero, "interaction_steps": count, "structure_steps": count}
        nav = Nav(count, memory, jnp.zeros((0, 2)))
        return State(Pose(jnp.zeros(3)), jnp.zeros(2), zero, zero, {}, {"nav": nav})  # pyright: ignore[reportArgumentType]

    def reset_to(self, start, key):
        return self.reset(key)

    def move(self, action):
        self.steps += 1
        if self.steps == 3:
            signal.raise_signal(signal.SIGINT)
        return np.asarray(action)

    def step(self, state, action):
        return state.replace(obs=jax.pure_callback(self.move, action, action, vmap_method="expand_dims"))


def test_a_signal_within_the_physics_comes_after_the_steps_of_the_compiled_program(monkeypatch):
    """Raised within it, it would be an error of JAX's."""
    monkeypatch.setattr(rollout, "CHUNK_STEPS", 5)
    env = OnHost()
    with pytest.raises(KeyboardInterrupt):
        EpisodePlayer(env, lambda obs, key: obs).play(jax.random.PRNGKey(0))  # pyright: ignore[reportArgumentType]
    assert env.steps == 5
