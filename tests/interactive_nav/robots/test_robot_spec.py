"""Action maps by hand; a control law runs alike on C MuJoCo and MJX-JAX, once a period or at every substep."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.robots import get_robot, robot_names
from interactive_nav.robots.build import FOLDER
from interactive_nav.robots.spec import RobotState
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav_common.errors import UserError
from scenes_mjcf.robot_facts import ROBOTS, SMALLEST
from tests.toys import write_room


def test_turtlebot_commands_and_actions_are_inverse():
    robot = get_robot("turtlebot")
    np.testing.assert_allclose(robot.command([-1.0, 1.0]), [-12.5, 25.0])
    np.testing.assert_allclose(robot.command([0.0, 5.0]), [6.25, 25.0])
    np.testing.assert_allclose(robot.action([6.25, 40.0]), [0.0, 1.0])


def test_the_table_of_facts_agrees_with_the_models():
    for name, facts in ROBOTS.items():
        robot = get_robot(name)
        assert (robot.footprint_radius_m, robot.height_m) == (facts.radius_m, facts.height_m)
        if facts.lidar_b is not None:
            site = mujoco.MjSpec.from_file(str(FOLDER / f"{name}.xml")).site("lidar")
            assert f"{name}_{site.parent.name}" == robot.base_body and tuple(site.pos) == facts.lidar_b
    wheeled = [robot for robot in map(get_robot, robot_names()) if robot.kind == "wheeled"]
    assert SMALLEST.radius_m == min(robot.footprint_radius_m for robot in wheeled)


def test_symmetric_actions_drive_backwards_as_fast_as_forwards(tmp_path):
    scene = write_room(tmp_path / "room", (6.0, 3.0), ())
    still = {"num_objects": 0, "sleep": False}
    for symmetric, metres in ((True, -0.88), (False, -0.44)):
        env = interactive_nav.make("turtlebot", [scene], backend="native", symmetric_actions=symmetric, **still)
        step = jax.jit(env.step)
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        zero = env.robot.command(np.zeros(2))
        np.testing.assert_allclose(zero, 0.0 if symmetric else 6.25)
        for _ in range(8):
            state = step(state, jnp.full(2, -1.0))
        # 25 rad/s x 0.0352 m = 0.88 m/s, 12.5 rad/s half of that; the wheels slip a little.
        assert float(state.obs[23]) == pytest.approx(metres, rel=0.05)


def test_turtlebot_drives_by_hand():
    robot = get_robot("turtlebot")
    # 0.352 m/s and 1 rad/s: (0.352 -+ 0.115) / 0.0352 = 6.7330 and 13.2670 rad/s.
    command = robot.command(robot.drive(np.float64(0.352), np.float64(1.0)))
    np.testing.assert_allclose(command, [6.73295, 13.26705], atol=1e-4)


def test_twist_mode_makes_the_same_wheel_speeds():
    native, twist = get_robot("turtlebot"), get_robot("turtlebot", "twist")
    v, w = np.array([0.3, -0.2, 0.0]), np.array([0.5, -1.0, 2.0])
    wheels = twist.controls(twist.command(twist.drive(v, w)), RobotState(None, None, None))
    np.testing.assert_allclose(wheels, native.command(native.drive(v, w)), atol=1e-9)


def test_unknown_control_mode_lists_the_known_ones():
    with pytest.raises(UserError, match="no control mode 'sideways'; it has native, twist, velocity, position, torque"):
        get_robot("turtlebot", "sideways")


def test_a_robot_without_twist_cannot_be_driven():
    with pytest.raises(UserError, match="takes no base velocity"):
        dataclasses.replace(get_robot("turtlebot"), twist=None).drive(np.float64(0.1), np.float64(0.0))


@pytest.fixture(scope="module")
def brake_world(tmp_path_factory):
    """A robot whose law drives at the commanded wheel speed until x = 0.1 m or t = 0.15 s, and then backwards."""

    def law(command, state, xp):
        late = (state.qpos[..., 0] > 0.1) | (state.time_s > 0.15)
        return xp.where(late[..., None], -command, command)

    robot = dataclasses.replace(get_robot("turtlebot"), control=law, control_every_substep=True)
    scene = load_scene(write_room(tmp_path_factory.mktemp("law") / "room", (4.0, 3.0), ()))
    return build_world(robot, (scene,), NavConfig.of(num_objects=0))


def _run(world, backend, periods=4):
    physics = make_physics(world, NavConfig.of(backend=backend, num_objects=0, sleep=False))
    qpos = np.repeat(world.rest_qpos[:1], 2, 0)
    qpos[:, :7] = [0, 0, 0, 1, 0, 0, 0]
    still = jnp.zeros((2, world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
    command = jnp.array([[10.0, 10.0], [20.0, 20.0]], jnp.float32)
    step = jax.jit(jax.vmap(physics.step))
    out = []
    for k in range(periods):
        state, _ = step(jnp.zeros(2, jnp.int32), state, command, jnp.full(2, 0.1 * k))
        out.append(np.concatenate([state.qpos[:, :9], state.qvel[:, :8]], -1))
    return np.stack(out)


@pytest.mark.heavy
def test_control_law_sees_state_and_time_at_every_substep(brake_world):
    native = _run(brake_world, "native")
    # 10 rad/s is 0.352 m/s: less than 0.1 m by 0.15 s; the law turns at the time limit, within the second period.
    assert native[0, 0, 0] > 0.015 and native[3, 0, 0] < native[1, 0, 0]
    assert native[3, 0, 9] < -0.2
    np.testing.assert_allclose(_run(brake_world, "jax"), native, atol=2e-3)


def test_a_law_once_a_period_is_held(brake_world):
    held = dataclasses.replace(brake_world.robot, control_every_substep=False)
    native = _run(dataclasses.replace(brake_world, robot=held), "native", periods=3)
    # Judged at 0, 0.1 and 0.2 s: the second period is still forward at its end.
    assert native[1, 0, 9] > 0.2 and native[2, 0, 9] < native[1, 0, 9]
