"""What episodes tell of the physics behind them."""

import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.scenes.scene import load_scene
from topological_nav.scenes.simulation import Simulator, make_env


def test_an_episode_with_lost_contacts_or_left_out_bodies_is_broken(room):
    simulator = Simulator(make_env(load_scene(room), "turtlebot", "native"))
    state = simulator.start(np.zeros((3, 2)) - 1.0, np.zeros(3), np.ones((3, 2)), np.arange(3), 0)
    assert simulator.seen(state).broken.tolist() == [False] * 3
    for name in ("overflow_steps", "left_out_steps"):
        nav = state.info["nav"]
        lost = nav.replace(**{name: jnp.asarray([0, 1, 0], getattr(nav, name).dtype)})
        seen = simulator.seen(state.replace(info={**state.info, "nav": lost}))
        assert seen.broken.tolist() == [False, True, False]
        assert seen.xy_w == pytest.approx(simulator.seen(state).xy_w)
