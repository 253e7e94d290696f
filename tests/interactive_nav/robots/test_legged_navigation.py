"""The scripted follower reaches a goal two metres away with each legged and flying robot, on C MuJoCo."""

import jax
import numpy as np
import pytest

import interactive_nav
from tests.toys import write_room
from train.scoring.policies import make_follower


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("walk") / "room", (6.0, 6.0), (("chair", 2.6, 2.6, 5.0, 0.5),))


OTHERS = [pytest.param(name, marks=pytest.mark.heavy) for name in ("humanoid", "minitaur", "quadrotor")]


@pytest.mark.parametrize("name", ["ant", *OTHERS])
def test_the_follower_reaches_its_goal(name, room):
    env = interactive_nav.make(
        name,
        [room],
        control_mode="twist",
        backend="native",
        num_objects=0,
        episode_steps=400,
        min_goal_distance_m=1.9,
        max_goal_distance_m=2.3,
    )
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    follow = jax.jit(jax.vmap(make_follower(env)))
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    state = reset(keys)
    apart = np.linalg.norm(np.asarray(state.info["nav"].goal_xy_w - state.info["nav"].robot_pos_w[:, :2]), axis=1)
    assert (apart > 1.85).all()
    reached = np.zeros(len(keys), bool)
    for _ in range(env.config.episode_steps):
        state = step(state, follow(state.obs, keys))
        reached |= np.asarray(state.metrics["success"]) > 0
        if reached.all():
            break
    assert reached.all()
    assert not np.asarray(state.metrics["nonfinite"]).any()
