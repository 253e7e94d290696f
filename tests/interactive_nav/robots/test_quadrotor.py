"""The quadrotor's rotors by hand; hover, speeds, stop, turn under its controllers; flight without gravity."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from interactive_nav.robots import get_robot
from interactive_nav.robots.spec import RobotState
from tests.interactive_nav.robots.motion import extents, hall_world, home_data, move, plain_model, schedule


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("quadrotor")


def test_mass_inertia_size():
    model = plain_model("quadrotor", "thrust")
    body = model.body("quadrotor")
    np.testing.assert_allclose(body.mass, 0.5)
    np.testing.assert_allclose(body.inertia, [0.0023, 0.0023, 0.004])
    robot = get_robot("quadrotor")
    size, radius = extents(model, home_data(model, robot))
    np.testing.assert_allclose(size[:2], 0.592, atol=1e-3)
    assert radius <= robot.footprint_radius_m < radius + 0.01


def test_rotor_forces_by_hand():
    model = plain_model("quadrotor", "thrust")
    data = home_data(model, get_robot("quadrotor"))
    data.ctrl[:] = [1.0, 2.0, 3.0, 20.0]  # front, left, back, right; the last is clipped to 10 N
    mujoco.mj_forward(model, data)
    # 1 + 2 + 3 + 10 N; 0.175 (2 - 10) about x; 0.175 (3 - 1) about y; 0.0245 (1 - 2 + 3 - 10) about z.
    np.testing.assert_allclose(data.qfrc_actuator, [0, 0, 16, -1.4, 0.35, -0.196], atol=1e-9)


@pytest.mark.parametrize("mode", ["velocity", "rate"])
def test_allocation_gives_what_the_controller_asks(mode):
    robot = get_robot("quadrotor", mode)
    model = plain_model("quadrotor", mode)
    data = home_data(model, robot)
    rng = np.random.default_rng(0)
    quat = np.array([1.0, *(0.1 * rng.normal(size=3))])
    data.qpos[3:7] = quat / np.linalg.norm(quat)
    state = RobotState(data.qpos.copy(), data.qvel.copy(), np.float64(0.0))
    command = np.array([0.1, -0.2, 0.05, 0.3]) if mode == "velocity" else np.array([0.2, -0.1, 0.1, 5.0])
    data.ctrl[:] = robot.controls(command, state)
    mujoco.mj_forward(model, data)
    assert (data.ctrl > 0).all() and (data.ctrl < 10).all()
    if mode == "rate":
        # 16 / s times the rate error, times the inertia.
        np.testing.assert_allclose(data.qfrc_actuator[3:], 16 * command[:3] * [0.0023, 0.0023, 0.004], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(data.qfrc_actuator[:3]), 5.0, atol=1e-9)
    on_device = robot.controls(jnp.asarray(command), RobotState(*map(jnp.asarray, state)), jnp)
    np.testing.assert_allclose(on_device, data.ctrl, atol=1e-5)


def test_it_hovers_follows_twists_and_stops(folder):
    world = hall_world(get_robot("quadrotor", "twist"), folder)
    hover = schedule((6, 0, 0))
    ahead = schedule((3, 0.5, 0), (3, 0, 0))
    turn = schedule((6, 0, 1))
    fast = schedule((3, 1.0, 0), (3, 1.0, 0.8))
    motion = move(world, np.stack([hover, ahead, turn, fast], 1))
    # 5 s without drifting: less than a millimetre.
    assert np.abs(motion.pos_w[:, 0] - [0, 0, 0.8]).max() < 1e-3 and np.abs(motion.yaw_rad[:, 0]).max() < 1e-3
    # 0.5 m/s within 5 % once it has accelerated, 1.5 m less the start's lag, straight, and stopped again.
    speed = (motion.pos_w[30, 1, 0] - motion.pos_w[20, 1, 0]) / 1.0
    assert speed == pytest.approx(0.5, rel=0.05)
    assert 1.2 < motion.pos_w[-1, 1, 0] < 1.6
    assert np.abs(motion.pos_w[:, 1, 1]).max() < 0.01
    assert np.linalg.norm(motion.pos_w[-1, 1] - motion.pos_w[-6, 1]) < 0.01
    # 1 rad/s on the spot.
    assert motion.yaw_rad[-1, 2] - motion.yaw_rad[10, 2] == pytest.approx(5.0, rel=0.03)
    assert np.abs(motion.pos_w[:, 2, :2]).max() < 0.01
    # Full speed into a turn: it keeps its height and never leans over.
    assert np.abs(motion.pos_w[:, 3, 2] - 0.8).max() < 0.05 and motion.up[:, 3].min() > np.cos(0.45)


def test_velocity_mode_climbs_and_slides_along_its_heading(folder):
    world = hall_world(get_robot("quadrotor"), folder)
    command = np.tile([[0.0, 0.4, 0.3, 0.0]], (30, 1))[:, None]
    motion = move(world, command)
    moved = motion.pos_w[30, 0] - motion.pos_w[20, 0]
    np.testing.assert_allclose(moved, [0.0, 0.4, 0.3], atol=0.02)


def test_kinematic_mode_floats_and_takes_six_velocities(folder):
    robot = get_robot("quadrotor", "kinematic")
    world = hall_world(robot, folder)
    np.testing.assert_allclose(world.models[0].body_gravcomp[world.layout.robot_bodies], 1.0)
    np.testing.assert_allclose(world.models[0].opt.gravity, [0, 0, -9.81])  # the scene keeps its gravity
    command = np.zeros((20, 2, 6))
    command[:, 1] = [0.5, 0.0, 0.2, 0.0, 0.0, 0.0]
    motion = move(world, command)
    np.testing.assert_allclose(motion.pos_w[-1, 0], [0, 0, 0.8], atol=1e-4)
    np.testing.assert_allclose(motion.pos_w[-1, 1] - motion.pos_w[-11, 1], [0.5, 0.0, 0.2], atol=5e-3)


@pytest.mark.heavy
def test_mjx_flies_the_same_path(folder):
    world = hall_world(get_robot("quadrotor", "twist"), folder)
    commands = schedule((0.6, 0.8, 0.8))[:, None]
    native, jax_ = (move(world, commands, backend) for backend in ("native", "jax"))
    assert native.pos_w[-1, 0, 0] > 0.1
    np.testing.assert_allclose(jax_.qpos, native.qpos, atol=2e-3)
