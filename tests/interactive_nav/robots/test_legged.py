"""Ant, Humanoid and Minitaur: figures against the table, limits, closed chains, gaits that go where they are told."""

import math

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from interactive_nav.robots import get_robot
from interactive_nav.robots.models.legged import ROWS, Legged, base_motion, gait_law
from interactive_nav.robots.spec import RobotState
from interactive_nav_common.errors import UserError
from tests.interactive_nav.robots.motion import extents, hall_world, home_data, move, plain_model, schedule

LEGGED = ("ant", "humanoid", "minitaur")


NOTHING = RobotState(None, None, None)


def legs_of(name: str) -> Legged:
    return ROWS[name].legs


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("legged")


# Ant: PyBullet's 182 kg and the table's sizes at scale 0.25. Sizes: length, width, height at home.
TABLE = {
    "ant": (182.2 / 64, (1.39 / 4, 1.39 / 4, 0.81 / 4), 0.02),
    "humanoid": (42.116, (0.28, 0.58, 1.573), 0.02),
    "minitaur": (6.0, (0.65, 0.28, 0.21), 0.08),
}


@pytest.mark.parametrize("name", LEGGED)
def test_mass_and_size_against_the_table(name):
    mass, size, tolerance = TABLE[name]
    model, robot = plain_model(name, "native"), get_robot(name)
    assert model.body_mass.sum() == pytest.approx(mass, rel=2e-3) == robot.mass_kg
    measured, radius = extents(model, home_data(model, robot))
    np.testing.assert_allclose(measured, size, rtol=tolerance)
    assert radius <= robot.footprint_radius_m < radius + 0.05
    assert measured[2] <= robot.height_m < measured[2] + 0.03


@pytest.mark.parametrize("name", LEGGED)
def test_everything_is_named_after_the_robot(name):
    model = plain_model(name, "native")
    kinds = {"body": model.nbody, "joint": model.njnt, "geom": model.ngeom, "actuator": model.nu, "site": model.nsite}
    for kind, count in kinds.items():
        names = [getattr(model, kind)(i).name for i in range(count)]
        assert all(n.startswith(f"{name}_") for n in names if n not in ("world", "floor")), names
    assert model.camera(f"{name}_eyes").name and tuple(get_robot(name).actuators) == tuple(
        model.actuator(i).name for i in range(model.nu)
    )


def test_humanoid_masses_by_body():
    model = plain_model("humanoid", "native")
    # Table of `humanoid.xml`: torso with head and upper waist, lower waist, pelvis; then legs and arms.
    expected = {
        "torso": 5.854 + 3.054,
        "lower_waist": 2.262,
        "pelvis": 6.616,
        "left_thigh": 4.752,
        "right_shin": 2.756,
        "left_foot": 1.767,
        "right_upper_arm": 1.661,
        "left_lower_arm": 1.230,
    }
    for name, mass in expected.items():
        assert model.body(f"humanoid_{name}").mass[0] == pytest.approx(mass, abs=2e-3), name


@pytest.mark.parametrize("name", LEGGED)
def test_joint_limits_and_torque_limits_hold_under_full_torque(name):
    mode = "torque" if name == "minitaur" else "native"
    robot, legs = get_robot(name, mode), legs_of(name)
    model = plain_model(name, mode, gravity=False)
    address = [model.joint(j).qposadr[0] for j in robot.actuators]
    dofs = [model.joint(j).dofadr[0] for j in robot.actuators]
    ranges = np.array([model.joint(j).range for j in robot.actuators])
    for action in (np.full(robot.action_size, 1.0), np.full(robot.action_size, -1.0)):
        data = home_data(model, robot, height_m=3.0)
        reached = []
        for _ in range(100):
            data.ctrl[:] = 10.0 * robot.command(action)  # ten times too much: the limits are physical
            mujoco.mj_step(model, data)
            assert (np.abs(data.qfrc_actuator[dofs]) <= np.array(legs.torque_nm) * (1 + 1e-6)).all()
            reached.append(data.qpos[address].copy())
        # MuJoCo's limits are soft: a joint that runs into one at full speed overshoots, and is then held.
        over = np.maximum(ranges[:, 0] - reached, reached - ranges[:, 1])[-20:]
        assert over.max() < 0.12, over.max()
        assert (over.max(0) > -0.05).any()  # some joint did get to its limit


@pytest.mark.parametrize("name", LEGGED)
def test_position_and_velocity_modes_reach_what_they_ask(name):
    model, robot = plain_model(name, "velocity", gravity=False), get_robot(name, "velocity")
    data = home_data(model, robot, height_m=3.0)
    assert robot.action_names[0].endswith("rad/s")
    joint = robot.actuators[1] if name == "ant" else "humanoid_abdomen_z" if name == "humanoid" else robot.actuators[0]
    data.ctrl[robot.actuators.index(joint)] = 0.5
    speeds = []
    for _ in range(10):
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[model.joint(joint).dofadr[0]])
    assert np.mean(speeds[5:]) == pytest.approx(0.5, rel=0.25)

    model, robot = plain_model(name, "position", gravity=False), get_robot(name, "position")
    data = home_data(model, robot, height_m=3.0)
    home = dict(robot.home_qpos)
    target = np.array([home[j] for j in robot.actuators])
    # Both motors of a Minitaur's leg together: its chain would resist one alone.
    moved = [robot.actuators.index(joint)] + ([1] if name == "minitaur" else [])
    target[moved] += 0.2
    for _ in range(100):
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
    # The Humanoid's joints have springs towards zero.
    assert data.qpos[model.joint(joint).qposadr[0]] == pytest.approx(target[moved[0]], abs=0.03)


def test_minitaur_chains_start_closed_and_stay_closed():
    robot = get_robot("minitaur", "twist")
    model = plain_model("minitaur", "twist")
    data = home_data(model, robot)
    ends = [
        [model.site(f"minitaur_toe_{leg}_{link}").id for link in ("fore", "aft")]
        for leg in ("front_left", "back_left", "front_right", "back_right")
    ]

    def gap():
        return max(np.linalg.norm(data.site_xpos[a] - data.site_xpos[b]) for a, b in ends)

    assert gap() < 1e-9
    # Hip height of the reset pose: sqrt(0.2^2 - 0.115^2) = 0.1636 m, on toes of radius 12.5 mm.
    assert data.qpos[2] - 0.0125 == pytest.approx(0.1636, abs=1e-4)
    worst = 0.0
    for k in range(200):
        state = RobotState(data.qpos.copy(), data.qvel.copy(), np.float64(0.02 * k))
        data.ctrl[:] = robot.controls(np.array([0.4, 0.0]), state)
        mujoco.mj_step(model, data)
        worst = max(worst, gap())
    assert worst < 0.012


def test_minitaur_leg_coordinates_by_hand():
    robot = get_robot("minitaur", "leg")
    command = np.array([0.4, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.5])
    angles = robot.controls(command, NOTHING)
    quarter = math.pi / 4
    # pi - pi/4 (0.5 + 1.5) = pi/2; swing 0.4 adds pi/10 fore and takes it aft; extension 0: pi - 1.5 pi/4.
    expected = [math.pi / 2 + 0.4 * quarter, math.pi / 2 - 0.4 * quarter, *[math.pi / 2] * 2]
    expected += [math.pi - 1.5 * quarter] * 2 + [math.pi / 2] * 2
    np.testing.assert_allclose(angles, expected)
    np.testing.assert_allclose(robot.controls(jnp.asarray(command)[None], NOTHING, jnp)[0], expected, rtol=1e-6)


@pytest.mark.parametrize("name", LEGGED)
def test_it_stands_walks_a_metre_stops_and_turns(name, folder):
    robot = get_robot(name, "twist")
    assert robot.twist is not None
    v, w = robot.twist.max_linear_m_s, robot.twist.max_angular_rad_s
    walk_s = 1.4 / v
    world = hall_world(robot, folder)
    total = max(walk_s + 3.0, 6.0)
    runs = [
        schedule((total, 0, 0)),
        schedule((walk_s, v, 0), (total - walk_s, 0, 0)),
        schedule((total, 0, w)),
        schedule((total, 0, -w)),
        schedule((total, 0.5 * v, 0.5 * w)),
    ]
    steps = min(len(r) for r in runs)
    motion = move(world, np.stack([r[:steps] for r in runs], 1))
    assert motion.up.min() > 0.9, "it fell"
    # Stands: after half a second to settle, less than 3 cm and 1 degree in 5 s.
    stood = motion.pos_w[5:56, 0, :2] - motion.pos_w[5, 0, :2]
    assert np.linalg.norm(stood, axis=1).max() < 0.03
    assert np.ptp(motion.yaw_rad[5:56, 0]) < math.radians(1)
    # Walks a metre and more, less than 45 degrees off, at the commanded speed within 20 % (the Humanoid 35 %).
    end = round(walk_s / 0.1)
    x, y = motion.pos_w[end, 1, :2]
    assert x > 1.0 and abs(y) < 0.5 * x
    within = 0.35 if name == "humanoid" else 0.2
    assert math.hypot(x, y) / (v * walk_s) == pytest.approx(1.0, abs=within)
    # Stops; the Humanoid goes on shifting its feet.
    left = np.linalg.norm(motion.pos_w[-1, 1, :2] - motion.pos_w[-11, 1, :2])
    assert left < (0.2 if name == "humanoid" else 0.01)
    # Turns both ways at the commanded rate within the same, on the spot; the Humanoid's wanders.
    seconds = 0.1 * (steps - 10)
    for run, sign in ((2, 1.0), (3, -1.0)):
        turned = motion.yaw_rad[-1, run] - motion.yaw_rad[10, run]
        assert turned / (sign * w * seconds) == pytest.approx(1.0, abs=within)
        assert np.linalg.norm(motion.pos_w[:, run, :2], axis=1).max() < (0.8 if name == "humanoid" else 0.2)
    # An arc to the left ends on the left.
    assert motion.yaw_rad[-1, 4] > 0.3 and motion.pos_w[30, 4, 0] > 0


@pytest.mark.heavy
@pytest.mark.slow
def test_mjx_walks_the_ant_alike(folder):
    world = hall_world(get_robot("ant", "twist"), folder)
    commands = schedule((0.4, 0.2, 0.3))[:, None]
    # Feet that just touch are in contact or not by a rounding error of 1e-8 m.
    native, jax_ = (move(world, commands, backend, raised_m=-1e-3) for backend in ("native", "jax"))
    assert np.abs(native.qpos[-1] - native.qpos[0])[0, 7:].max() > 0.1
    np.testing.assert_allclose(jax_.qpos, native.qpos, atol=1e-4)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_nudge_of_the_standing_humanoid_dies_out(axis, folder):
    robot = get_robot("humanoid", "twist")
    world = hall_world(robot, folder)
    model = world.models[0]
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[0]
    at, dof, way = world.layout.robot_qpos, world.layout.robot_qvel, []
    data.qpos[at : at + 7] = [0, 0, robot.spawn_height_m, 1, 0, 0, 0]
    for k in range(400):
        if k == 75:  # 0.05 rad/s of roll or pitch
            data.qvel[dof + 3 + axis] += 0.05
        state = RobotState(data.qpos[at : at + 24], data.qvel[dof : dof + 23], np.float64(0.02 * k))
        data.ctrl[:] = robot.controls(np.zeros(2), state)
        mujoco.mj_step(model, data)
        way.append(data.qpos[at : at + 2].copy())
    # It does not set out: less than 1 cm in 6.5 s, and still at the end.
    assert np.linalg.norm(np.array(way[75:]) - way[74], axis=1).max() < 0.01
    assert np.ptp(way[-50:], axis=0).max() < 2e-3


def test_base_motion_by_hand():
    # Heading 90 degrees left, then leaning 0.1 rad forward: velocity along world y is forward.
    yaw, lean = math.pi / 2, 0.1
    quat = np.zeros(4)
    mujoco.mju_mulQuat(
        quat,
        np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]),
        np.array([math.cos(lean / 2), 0, math.sin(lean / 2), 0]),
    )
    state = RobotState(np.array([0, 0, 1, *quat]), np.array([-0.2, 0.7, 0, 0.3, 0.4, 0.5]), np.float64(0))
    base = base_motion(state, np)
    got = [base.pitch, base.roll, base.pitch_rate, base.roll_rate, base.forward, base.left]
    np.testing.assert_allclose(got, [0.1, 0.0, 0.4, 0.3, 0.7, 0.2], atol=1e-9)


@pytest.mark.parametrize("name", LEGGED)
def test_a_gait_asks_alike_on_host_and_device_and_within_the_ranges(name):
    legs, rng = legs_of(name), np.random.default_rng(0)
    data = home_data(plain_model(name, "twist"), get_robot(name, "twist"))
    qpos = data.qpos + 0.05 * rng.normal(size=(3, len(data.qpos)))
    state = RobotState(qpos, rng.normal(size=(3, len(data.qvel))), np.array([0.0, 0.13, 2.0]))
    command = rng.uniform(-0.2, 0.2, (3, 2))
    targets = gait_law(legs)(command, state, np)
    low, high = np.array(legs.ranges).T
    assert targets.shape == (3, len(legs.home))
    assert (targets >= low).all() and (targets <= high).all()
    assert np.abs(targets - legs.home).max() > 0.01
    on_device = gait_law(legs)(jnp.asarray(command), RobotState(*map(jnp.asarray, state)), jnp)
    np.testing.assert_allclose(on_device, targets, atol=2e-4)


def test_unknown_modes_are_answered_with_the_list():
    for name in (*LEGGED, "quadrotor"):
        with pytest.raises(UserError, match=f"'{name}' has no control mode 'hop'; it has native, "):
            get_robot(name, "hop")
