"""An episode that is stopped while physics on the host steps."""

import signal
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import State

from interactive_nav.pictures import replay
from interactive_nav.pictures.replay import EpisodePlayer


class Pose(NamedTuple):
    qpos: jax.Array


class OnHost:
    """Physics as a callback, within whose third step a signal comes."""

    steps = 0

    def reset(self, key):
        none = jnp.zeros(())
        return State(Pose(jnp.zeros(3)), jnp.zeros(2), none, none, {}, {"nav": none})  # pyright: ignore[reportArgumentType]

    def reset_to(self, start, key):
        return self.reset(key)

    def move(self, action):
        self.steps += 1
        if self.steps == 3:
            signal.raise_signal(signal.SIGINT)
        return np.asarray(action)


def test_a_signal_within_the_physics_comes_after_the_step(monkeypatch):
    """Raised within it, it would be an error of JAX's."""

    def play_step(env, state, action):
        moved = jax.pure_callback(env.move, action, action, vmap_method="expand_dims")
        return state, {"done": jnp.zeros((), bool), "moved": moved}

    monkeypatch.setattr(replay, "_play_step", play_step)
    env = OnHost()
    with pytest.raises(KeyboardInterrupt):
        EpisodePlayer(env, lambda obs, key: obs).play(jax.random.PRNGKey(0))  # pyright: ignore[reportArgumentType]
    assert env.steps == 3
