"""The quadrotor's rotors by hand; hover, speeds, stop, turn under its controllers; flight without gravity."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.robots import get_robot
from interactive_nav.robots.spec import RobotState
from interactive_nav.scenes.world import CEILING_M
from interactive_nav.types import EpisodeStart
from tests.interactive_nav.robots.motion import extents, hall_world, home_data, move, plain_model, schedule
from tests.toys import write_room


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


def test_velocity_mode_sinks_and_slides_along_its_heading(folder):
    world = hall_world(get_robot("quadrotor"), folder)
    command = np.tile([[0.0, 0.4, -0.2, 0.0]], (30, 1))[:, None]
    motion = move(world, command)
    moved = motion.pos_w[30, 0] - motion.pos_w[20, 0]
    np.testing.assert_allclose(moved, [0.0, 0.4, -0.2], atol=0.02)


def test_kinematic_mode_floats_and_takes_six_velocities(folder):
    robot = get_robot("quadrotor", "kinematic")
    world = hall_world(robot, folder)
    np.testing.assert_allclose(world.models[0].body_gravcomp[world.layout.robot_bodies], 1.0)
    np.testing.assert_allclose(world.models[0].opt.gravity, [0, 0, -9.81])  # the scene keeps its gravity
    command = np.zeros((20, 2, 6))
    command[:, 1] = [0.5, 0.0, 0.1, 0.0, 0.0, 0.0]
    motion = move(world, command)
    np.testing.assert_allclose(motion.pos_w[-1, 0], [0, 0, 0.8], atol=1e-4)
    np.testing.assert_allclose(motion.pos_w[-1, 1] - motion.pos_w[-11, 1], [0.5, 0.0, 0.1], atol=5e-3)


@pytest.mark.heavy
def test_mjx_flies_the_same_path(folder):
    world = hall_world(get_robot("quadrotor", "twist"), folder)
    commands = schedule((0.6, 0.8, 0.8))[:, None]
    native, jax_ = (move(world, commands, backend) for backend in ("native", "jax"))
    assert native.pos_w[-1, 0, 0] > 0.1
    np.testing.assert_allclose(jax_.qpos, native.qpos, atol=2e-3)


def room(folder):
    return write_room(folder / "room", (4.0, 3.0), (("chair", 1.2, 0.9, 5.0, 0.5),))


def fly(env, action, steps, xy=(0.0, 0.0), goal=(1.5, -1.0)):
    """Information and metrics after steps of one action from the hover height."""
    start = EpisodeStart(
        scene_index=jnp.zeros((), jnp.int32), start_xy_w=jnp.array(xy), start_yaw_rad=jnp.zeros(()),
        goal_xy_w=jnp.array(goal), small_xy_w=jnp.zeros((0, 2)), small_yaw_rad=jnp.zeros(0),
        small_placed=jnp.zeros(0, bool),
    )  # fmt: skip
    state, step = jax.jit(env.reset_to)(start, jax.random.PRNGKey(0)), jax.jit(env.step)
    for _ in range(steps):
        state = step(state, jnp.asarray(action))
    return state.info["nav"], state.metrics


@pytest.mark.parametrize(
    ("mode", "backend"),
    [("native", "native"), ("thrust", "native"), ("kinematic", "native"),
     pytest.param("native", "jax", marks=pytest.mark.heavy)],
)  # fmt: skip
def test_it_stays_below_the_ceiling_and_within_the_walls(tmp_path, mode, backend):
    env = interactive_nav.make("quadrotor", [room(tmp_path)], backend=backend, num_objects=0, control_mode=mode)
    nav, metrics = fly(env, {"thrust": [1.0] * 4, "kinematic": [1.0, 0, 1, 0, 0, 0]}.get(mode, [1.0, 0, 1, 0]), 60)
    assert (
        1.0 < float(nav.robot_pos_w[2]) < CEILING_M
        and float(nav.memory["overflow_steps"]) == float(metrics["nonfinite"]) == 0
    )
    assert abs(float(nav.robot_pos_w[0])) < 2 and abs(float(nav.robot_pos_w[1])) < 1.5
    if mode == "thrust":  # straight up: the ceiling is no wall
        assert float(nav.memory["structure_steps"]) == float(nav.memory["force_sum_n"]) == 0


def test_its_goal_has_a_height(tmp_path):
    env = interactive_nav.make("quadrotor", [room(tmp_path)], backend="native", num_objects=0, control_mode="twist")
    # 0.5 m away at the goal's height of 0.8 m, the body's width being 0.592 m; then 0.35 m above it: 0.61 m in space.
    still = [0.0] * env.action_size
    assert float(fly(env, still, 1, goal=(0.5, 0.0))[1]["success"]) == 1
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    for height, reached in ((0.8, 1.0), (1.15, 0.0)):
        goal = state.info["nav"].goal_xy_w
        qpos = state.pipeline_state.qpos
        at = env.world.layout.robot_qpos
        qpos = qpos.at[at : at + 3].set(jnp.stack([goal[0] - 0.5, goal[1], jnp.asarray(height)]))
        moved = state.replace(pipeline_state=state.pipeline_state.replace(qpos=qpos))
        assert float(jax.jit(env.step)(moved, jnp.zeros(env.action_size)).metrics["success"]) == reached


def test_climbing_counts_as_path(tmp_path):
    env = interactive_nav.make("quadrotor", [room(tmp_path)], backend="native", num_objects=0)
    nav, _ = fly(env, [0.0, 0, 1, 0], 8)
    assert float(nav.memory["robot_path_m"]) == pytest.approx(float(nav.robot_pos_w[2]) - 0.8, abs=0.02)
    assert float(nav.memory["robot_path_m"]) > 0.1


@pytest.mark.parametrize("robot", ["turtlebot", "fetch", "ant"])
def test_robots_on_the_ground_have_no_ceiling(tmp_path, robot):
    world = interactive_nav.make(robot, [room(tmp_path)], backend="native", num_objects=0).world
    model = world.models[0]
    assert model.geom_type.tolist().count(mujoco.mjtGeom.mjGEOM_PLANE) == 1
    assert not ((model.geom_contype | model.geom_conaffinity) & 4).any()
