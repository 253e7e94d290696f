"""The environment contract over every registered robot, in a small room, on C MuJoCo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav.task.terms import EPISODE_METRICS, REWARD_TERMS
from interactive_nav_common.errors import UserError
from tests.toys import write_room

ENVS, STEPS = 2, 3


@pytest.fixture(scope="module")
def big_room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("contract") / "room", (7.0, 6.0), (("chair", 2.5, 2.0, 5.0, 0.5),))


SHOWN = ("fetch", "turtlebot", "ttbot", "ant", "humanoid")
"""Compiled at every run; the others with the heavy tests."""


@pytest.mark.parametrize(
    "name", [n if n in SHOWN else pytest.param(n, marks=pytest.mark.heavy) for n in interactive_nav.robot_names()]
)
def test_every_robot_is_an_environment(name, big_room):
    env = interactive_nav.make(
        name, [big_room], backend="native", num_objects=1, episode_steps=STEPS, nav_cell_m=0.2, threads=1
    )
    robot = env.robot
    assert (
        env.action_size == len(robot.action_low) == len(robot.action_high) == len(robot.action_names or robot.actuators)
    )
    keys = jax.random.split(jax.random.PRNGKey(0), ENVS)
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (STEPS, ENVS, env.action_size), minval=-1, maxval=1)

    def episode():
        states = [reset(keys)]
        for action in actions:
            states.append(step(states[-1], action))
        return states

    states = episode()
    for state in states:
        assert state.obs.shape == (ENVS, env.observation_size) == (ENVS, 29)
        assert np.isfinite(state.obs).all() and np.isfinite(state.reward).all()
        assert set(state.metrics) == {*EPISODE_METRICS, *REWARD_TERMS}
        assert all(np.isfinite(v).all() for v in state.metrics.values())
    assert not states[0].done.any() and not states[1].done.any()
    assert states[-1].done.all()  # the time limit, or a goal that the first steps reached
    assert (states[-1].metrics["nonfinite"] == 0).all()
    assert (states[-1].metrics["episode_steps"] >= 1).all()
    # The start is free of contact: what the robot stands on is not touched.
    assert (states[1].metrics["reward/interaction"] == 0).all()
    # Actions matter, and the same keys and actions give the same bits.
    qpos = np.stack([np.asarray(s.pipeline_state.qpos) for s in states])
    assert (np.abs(qpos[-1] - qpos[0])[:, env.world.layout.robot_qpos :] > 0).any(1).all()
    again = np.stack([np.asarray(s.pipeline_state.qpos) for s in episode()])
    np.testing.assert_array_equal(again, qpos)


@pytest.mark.parametrize("name", interactive_nav.robot_names())
def test_every_mode_of_every_robot_maps_actions_to_its_actuators(name):
    from interactive_nav.robots.spec import RobotState

    for mode in interactive_nav.get_robot(name).control_modes:
        robot = interactive_nav.get_robot(name, mode)
        assert robot.control_mode == mode and robot.control_modes[0] == "native"
        assert all(low < high for low, high in zip(robot.action_low, robot.action_high, strict=True))
        state = RobotState(np.zeros((3, 60)), np.zeros((3, 60)), np.zeros(3))
        state.qpos[:, 3] = 1.0
        command = robot.command(np.linspace(-1, 1, 3)[:, None] * np.ones(robot.action_size))
        controls = robot.controls(command, state)
        assert controls.shape == (3, len(robot.actuators)) and np.isfinite(controls).all()
        on_device = robot.controls(jnp.asarray(command), RobotState(*map(jnp.asarray, state)), jnp)
        np.testing.assert_allclose(on_device, controls, atol=1e-4)


def test_an_unknown_robot_is_answered_with_the_list():
    with pytest.raises(UserError, match="did you mean 'fetch'.*known robots: .*fetch.*turtlebot"):
        interactive_nav.make("fetsch", ["nowhere"])
