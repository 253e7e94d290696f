"""Wheeled robots do what they are asked: evidence per robot, force balance by hand, limits, whole-body control."""

import math

import mujoco
import numpy as np
import pytest

from docs.studies.robots import __main__ as study
from docs.studies.robots import evidence
from docs.studies.robots.hall import LOADS, box, hall
from docs.studies.robots.pictures import picture, stage
from interactive_nav.config import NavConfig
from interactive_nav.robots import get_robot, robot_names
from interactive_nav.robots.__main__ import main
from interactive_nav.robots.build import half_extents
from interactive_nav.robots.spec import RobotState
from interactive_nav.scenes.world import build_world

WHEELED = tuple(name for name in robot_names() if get_robot(name).kind == "wheeled")
SKID = ("husky", "ttbot")


def _simulate(robot, model, data, action, seconds):
    """Steps like the environment does; [T, nq] and [T, nv] at every substep."""
    qpos, qvel = [], []
    for k in range(round(seconds / 0.1)):
        for substep in range(5):
            if substep == 0 or robot.control_every_substep:
                state = RobotState(data.qpos, data.qvel, np.asarray(0.1 * k + 0.02 * substep))
                data.ctrl[:] = robot.controls(robot.command(action), state)
            mujoco.mj_step(model, data)
            qpos.append(data.qpos.copy())
            qvel.append(data.qvel.copy())
    return np.asarray(qpos), np.asarray(qvel)


def _alone(robot):
    """The robot alone in an empty hall, at home: model and data."""
    world = build_world(robot, (hall(()),), NavConfig.of(num_objects=0))
    model = world.models[0]
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[0]
    data.qpos[:7] = [0, 0, robot.spawn_height_m, 1, 0, 0, 0]
    mujoco.mj_forward(model, data)
    return model, data


def _failures(name, backend):
    own = evidence.measure(name, backend)
    return [f"{c.name} = {c.value:.4g}, expected {c.low:g} .. {c.high:g}" for c in own.checks if not c.passed]


@pytest.mark.parametrize("name", WHEELED)
def test_evidence_on_c_mujoco(name):
    assert _failures(name, "native") == []


@pytest.mark.slow
@pytest.mark.heavy
@pytest.mark.parametrize("name", ("turtlebot", "husky"))
def test_evidence_on_mjx_jax(name):
    assert _failures(name, "jax") == []


@pytest.mark.slow
@pytest.mark.heavy
@pytest.mark.parametrize("name", ("turtlebot", "fetch"))
def test_evidence_on_mjx_warp(name):
    pytest.importorskip("warp", reason="the package warp-lang (extra 'warp') is not installed")
    assert _failures(name, "warp") == []


def test_a_broken_robot_fails_its_evidence(monkeypatch):
    import dataclasses

    robot = get_robot("turtlebot", "twist")
    law = robot.control
    assert law is not None
    swapped = dataclasses.replace(robot, control=lambda c, s, xp: law(c, s, xp)[..., ::-1] * 0.8)
    monkeypatch.setattr(evidence, "get_robot", lambda name, mode="native": swapped)
    failed = {c.name for c in evidence.measure_wheeled("turtlebot").checks if not c.passed}
    assert {"linear / asked", "angular / asked"} <= failed


@pytest.mark.parametrize("name", WHEELED)
def test_pushing_at_constant_speed_balances_the_floors_friction(name):
    # The floor gives mu (m g - lift), lift being the upward part of the robot's force; at constant speed the
    # robot's horizontal force equals it. Vectors from the contact sensors, means over 2 s.
    robot, load = get_robot(name, "twist"), LOADS[1 if name != "turtlebot" else 0]
    front = 0.6
    scene = hall((box(load, front + load.half_m[0], 0.0),))
    world = build_world(robot, (scene,), NavConfig.of(num_objects=0))
    model = world.models[0]
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[0]
    data.qpos[:7] = [0, 0, robot.spawn_height_m, 1, 0, 0, 0]
    action = robot.drive(np.float64(0.3), np.float64(0.0))
    _simulate(robot, model, data, action, 4.0)
    at, force, speed = world.layout.force_sensors[0], [], []
    for _ in range(20):
        data.ctrl[:] = robot.controls(robot.command(action), RobotState(data.qpos, data.qvel, np.asarray(0.0)))
        for _ in range(5):
            mujoco.mj_step(model, data)
            force.append(data.sensordata[at : at + 3].copy())
            speed.append(data.qvel[world.layout.slot_qvel[0]])
    push, lift = np.mean(force, 0)[0], np.mean(force, 0)[2]
    assert np.mean(speed) == pytest.approx(0.3, abs=0.04)
    assert push == pytest.approx(load.friction * (load.mass_kg * 9.81 - lift), rel=0.12)


@pytest.mark.parametrize("name", WHEELED)
def test_mass_inertia_and_size_are_the_tables(name):
    robot = get_robot(name)
    assert robot.size_m is not None
    model, data = _alone(robot)
    base = model.body(robot.base_body).id
    assert model.body_subtreemass[base] == pytest.approx(robot.mass_kg, rel=2e-3)
    mine = [b for b in range(model.nbody) if model.body_rootid[b] == base]
    for body in mine:
        a, b, c = sorted(model.body_inertia[body])
        assert a > 0 and a + b >= c * (1 - 1e-9)  # a rigid body's principal moments
        # No denser than lead and no larger than the robot: radius of gyration against the robot's size.
        assert math.sqrt(c / model.body_mass[body]) < max(robot.size_m)
    low, high, radius = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] not in mine or model.geom_group[geom] != 3 or not model.geom_contype[geom]:
            continue
        rotation = data.geom_xmat[geom].reshape(3, 3)
        half = half_extents(model, geom)
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            line, thick = rotation[:, 2] * model.geom_size[geom, 1], model.geom_size[geom, 0]
            points = data.geom_xpos[geom] + np.array([line, -line])
        else:
            thick = 0.0
            signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            points = data.geom_xpos[geom] + (signs * half) @ rotation.T
        low, high = np.minimum(low, points.min(0) - thick), np.maximum(high, points.max(0) + thick)
        radius = max(radius, float(np.hypot(*points[:, :2].T).max()) + thick)
    length, width, _ = robot.size_m
    # TurtleBot's octagon is 8 % narrower than its disc; JackRabbot v2's folded arm stands out 1.5 cm.
    assert (high - low)[0] == pytest.approx(length, rel=0.08)
    assert (high - low)[1] == pytest.approx(width, rel=0.08)
    assert high[2] == pytest.approx(robot.height_m, abs=0.02)
    assert radius <= robot.footprint_radius_m <= radius + 0.05


# Robot, body: mass (kg) and principal moments (kg m^2) of the sources; and wheel radius, y and x of a front left wheel.
INERTIA = {
    ("turtlebot", "base"): (2.473, (0.0200, 0.0200, 0.0368)),
    ("freight", "base"): (70.139, (1.225, 1.285, 0.987)),
    ("freight", "wheel_left"): (4.354, (0.0045, 0.005, 0.0045)),
    ("fetch", "torso"): (10.780, (0.3354, 0.3354, 0.0954)),
    ("fetch", "torso_fixed"): (13.278, (0.3861, 0.3388, 0.1018)),
    ("fetch", "shoulder_lift"): (2.662, (0.0028, 0.0111, 0.0112)),
    ("fetch", "wrist_flex"): (1.725, (0.0018, 0.0042, 0.0042)),
    ("husky", "base"): (30.455, (0.602, 1.739, 2.030)),
    ("husky", "wheel_rear_right"): (2.637, (0.0247, 0.0441, 0.0247)),
    ("jackrabbot2", "base"): (103.827, (5.383, 5.383, 5.383)),
    ("jackrabbot2", "wheel_left"): (20.0, (0.304, 0.579, 0.304)),
}
WHEELS = {
    "turtlebot": (0.0352, 0.115, 0.0),
    "freight": (0.0613, 0.18738, 0.0013),
    "fetch": (0.0613, 0.18738, 0.0013),
    "husky": (0.17775, 0.2854, 0.256),
    "jackrabbot1": (0.2406, 0.2712, 0.0),
    "jackrabbot2": (0.2406, 0.27105, 0.0),
}


@pytest.mark.parametrize(("name", "body"), list(INERTIA))
def test_inertias_are_the_sources(name, body):
    mass, moments = INERTIA[name, body]
    own = _alone(get_robot(name))[0].body(f"{name}_{body}")
    assert own.mass[0] == pytest.approx(mass)
    np.testing.assert_allclose(sorted(own.inertia), sorted(moments))


@pytest.mark.parametrize("name", list(WHEELS))
def test_wheels_are_where_and_as_large_as_the_sources_say(name):
    radius, y, x = WHEELS[name]
    robot = get_robot(name)
    model, data = stage(robot)
    front_left = next(b for b in robot.rolling_bodies if b.endswith("left"))
    np.testing.assert_allclose(data.body(front_left).xpos, [x, y, radius], atol=1e-4)
    geom = next(g for g in range(model.ngeom) if model.geom(g).name == front_left)
    assert model.geom_size[geom, 0] == radius
    # And the twist map of a differential drive is the one of these figures.
    twist = get_robot(name, "velocity").twist
    assert twist is not None and twist.matrix[0][0] == pytest.approx(1 / radius)
    if name not in SKID:
        assert twist.matrix[0][1] == pytest.approx(-y / radius, rel=2e-3)


@pytest.mark.parametrize("name", [n for n in WHEELED if len(get_robot(n).home_qpos)])
def test_joint_limits_hold_under_full_torque(name):
    robot = get_robot(name, "torque")
    neutral = robot.action(np.zeros(robot.action_size))
    for k, actuator in enumerate(robot.actuators):
        model, data = _alone(robot)
        joint = model.actuator(actuator).trnid[0]
        if not model.jnt_limited[joint]:
            continue
        slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        low, high = model.jnt_range[joint]
        at = model.jnt_qposadr[joint]
        reached = []
        for sign in (-1.0, 1.0):
            action = neutral.copy()
            action[k] = sign
            qpos, _ = _simulate(robot, model, data, action, 5.0)
            reached.append(qpos[:, at])
        # Soft limits give way while a limb is stopped that full torque has spun up to 20 rad/s ...
        give = 0.015 if slide else 0.5
        assert min(r.min() for r in reached) > low - give, actuator
        assert max(r.max() for r in reached) < high + give, actuator
        # ... and hold it, pressed on by all of its torque, within 3 degrees or 5 mm.
        rest = 0.005 if slide else 0.05
        assert low - rest < reached[0][-1] < low + rest and high - rest < reached[1][-1] < high + rest, actuator


@pytest.mark.parametrize("name", WHEELED)
def test_torques_stay_within_their_limits(name):
    robot = get_robot(name, "velocity")
    model, data = _alone(robot)
    rng = np.random.default_rng(0)
    for _ in range(20):
        _simulate(robot, model, data, rng.choice([-1.0, 1.0], robot.action_size), 0.1)
        for actuator in robot.actuators:
            joint = model.actuator(actuator).trnid[0]
            limit = model.jnt_actfrcrange[joint, 1]
            assert limit > 0 and abs(data.qfrc_actuator[model.jnt_dofadr[joint]]) <= limit * (1 + 1e-9)


@pytest.mark.parametrize("name", WHEELED)
def test_no_native_action_tips_it_over(name):
    # As fast as the action goes, then the inner wheels as far back as it goes: the sharpest turn there is; then
    # full speed ahead and full speed back.
    robot = get_robot(name)
    model, data = _alone(robot)
    inner = np.array([-1.0 if "left" in action else 1.0 for action in robot.action_names])
    _simulate(robot, model, data, np.ones(robot.action_size), 4.0)
    turned, _ = _simulate(robot, model, data, inner, 3.0)
    _simulate(robot, model, data, np.ones(robot.action_size), 4.0)
    braked, _ = _simulate(robot, model, data, -np.ones(robot.action_size), 3.0)
    yaw = np.unwrap(2 * np.arctan2(turned[:, 6], turned[:, 3]))
    assert abs(yaw[-1] - yaw[0]) > math.pi / 2
    for qpos in (turned, braked):
        tilt = np.degrees(np.arccos(1 - 2 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2)))
        assert tilt.max() < 10.0


@pytest.mark.parametrize("name", SKID)
def test_skid_steers_effective_track_is_the_measured_one(name):
    # Open loop, without the gyro: wheel speeds +/- s turn the base at 2 s r / track.
    robot, twist = get_robot(name, "velocity"), get_robot(name, "twist")
    assert twist.twist is not None
    rate = 0.75 * twist.twist.max_angular_rad_s
    model, data = _alone(robot)
    qpos, _ = _simulate(robot, model, data, robot.drive(np.float64(0.0), np.float64(rate)), 5.0)
    yaw = np.unwrap(2 * np.arctan2(qpos[:, 6], qpos[:, 3]))
    assert (yaw[-1] - yaw[100]) / 3.0 == pytest.approx(rate, rel=0.15, abs=0.02)


def test_husky_turns_on_the_spot_with_the_originals_torque():
    robot = get_robot("husky")
    model, data = _alone(robot)
    _, qvel = _simulate(robot, model, data, np.array([-1.0, 1.0, -1.0, 1.0]), 4.0)
    assert qvel[-50:, 5].mean() > 0.5
    assert np.abs(data.qpos[:2]).max() < 0.02


@pytest.mark.parametrize("name", WHEELED)
def test_position_mode_advances_each_wheel(name):
    robot = get_robot(name, "position")
    model, data = _alone(robot)
    action = np.zeros(robot.action_size)
    wheels = [k for k, label in enumerate(robot.action_names) if label.endswith("advance rad")]
    held = [k for k in range(robot.action_size) if k not in wheels]
    home = dict(robot.home_qpos)
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, model.actuator(a).trnid[0]) for a in robot.actuators]
    action[held] = robot.action(np.array([home.get(n, 0.0) for n in names]))[held]
    action[wheels] = 0.2
    _simulate(robot, model, data, action, 3.0)
    assert data.qpos[0] > 0.15 and abs(data.qpos[1]) < 0.02
    for k in held:
        address = model.jnt_qposadr[model.actuator(robot.actuators[k]).trnid[0]]
        assert data.qpos[address] == pytest.approx(home.get(names[k], 0.0), abs=0.04)


@pytest.mark.parametrize("name", ("fetch", "jackrabbot2"))
def test_arm_stays_folded_when_only_the_wheels_are_driven(name):
    robot = get_robot(name)
    model, data = _alone(robot)
    _simulate(robot, model, data, np.ones(2), 2.0)
    _simulate(robot, model, data, np.array([-1.0, 1.0]), 2.0)
    for joint, value in robot.home_qpos:
        assert data.qpos[model.joint(joint).qposadr[0]] == pytest.approx(value, abs=0.05), joint


def test_fetch_moves_arm_torso_and_gripper_in_whole_body_mode():
    robot = get_robot("fetch", "whole_body")
    assert robot.action_size == 11 and robot.action_names[2] == "torso m/s"
    model, data = _alone(robot)
    command = np.zeros(11)
    command[2], command[4], command[-1] = 0.05, -0.5, 0.04  # torso, shoulder lift, fingers
    _simulate(robot, model, data, robot.action(command), 2.0)
    joint = {j: data.qpos[model.joint(f"fetch_{j}").qposadr[0]] for j in ("torso", "shoulder_lift", "finger_left")}
    # The torso gains speed for half a second: 450 N lift 29 kg.
    assert joint["torso"] == pytest.approx(0.02 + 0.1, abs=0.025)
    assert joint["shoulder_lift"] == pytest.approx(1.471 - 1.0, abs=0.1)
    assert joint["finger_left"] == pytest.approx(0.04, abs=0.003)


def test_a_velocity_servo_that_holds_a_stretched_arm_hardly_sags():
    # Without an integral part gravity moves it: 40 N m of 132 N m at 5 % of 1.454 rad/s is 0.02 rad/s.
    robot = get_robot("fetch", "whole_body")
    model, data = _alone(robot)
    lift = model.joint("fetch_shoulder_lift").qposadr[0]
    for name in ("shoulder_lift", "elbow_flex", "wrist_flex"):
        data.qpos[model.joint(f"fetch_{name}").qposadr[0]] = 0.0
    qpos, _ = _simulate(robot, model, data, robot.action(np.zeros(11)), 2.0)
    assert 0.0 < (qpos[-1, lift] - qpos[0, lift]) / 2.0 < 0.04


def test_jackrabbots_reset_pose_puts_the_hand_where_the_source_says():
    # iGibson: joints -pi/2, pi/2, pi/2, pi/2, 0 put the end effector at (0.642, -0.256, 0.953).
    model, data = stage(get_robot("jackrabbot2"))
    for k, angle in enumerate((-math.pi / 2, math.pi / 2, math.pi / 2, math.pi / 2, 0.0)):
        data.qpos[model.joint(f"jackrabbot2_arm_{k + 1}").qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site("jackrabbot2_hand").xpos, [0.642, -0.256, 0.953], atol=1e-3)


def test_fetchs_straight_arm_reaches_as_far_as_the_source_says():
    # fetch.urdf: with the arm straight and the torso down the gripper is at x 1.128, z 0.786.
    model, data = stage(get_robot("fetch"))
    data.qpos[7:] = 0.0
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site("fetch_grip").xpos, [1.128, 0.0, 0.786], atol=1e-3)


@pytest.mark.parametrize("name", WHEELED)
def test_the_models_camera_is_the_specs(name):
    robot = get_robot(name)
    model, data = stage(robot)
    camera = data.camera(f"{name}_eyes")
    body = data.body(robot.camera.body)
    np.testing.assert_allclose(camera.xpos, body.xpos + body.xmat.reshape(3, 3) @ robot.camera.pos_m, atol=1e-9)
    forward = -camera.xmat.reshape(3, 3)[:, 2]
    pitch = robot.camera.pitch_rad
    np.testing.assert_allclose(forward, [math.cos(pitch), 0, -math.sin(pitch)], atol=1e-3)
    assert model.cam_fovy[camera.id] == robot.camera.fov_deg


@pytest.mark.parametrize("name", WHEELED)
def test_everything_has_a_name_and_only_primitives_collide(name):
    model, _ = stage(get_robot(name))
    kinds = {"BODY": model.nbody, "JOINT": model.njnt, "GEOM": model.ngeom, "SITE": model.nsite, "CAMERA": model.ncam}
    for kind, count in (kinds | {"ACTUATOR": model.nu}).items():
        for k in range(1 if kind in ("BODY", "GEOM") else 0, count):
            label = mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), k)
            assert label and label.startswith(f"{name}_"), (kind, k, label)
    solid = [g for g in range(1, model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    allowed = {mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE}
    assert {int(model.geom_type[g]) for g in solid} <= {int(k) for k in allowed}
    assert len(solid) <= 25


def test_pictures_need_no_display():
    image = picture(get_robot("jackrabbot2"), renderer="rays")
    assert image.shape == (480, 480, 3) and image.dtype == np.uint8
    ink = (image < 200).any(-1)
    assert 0.05 < ink.mean() < 0.7  # a robot, on a light ground


def test_command_prints_the_table_and_the_study_renders(tmp_path, capsys):
    assert main([]) == 0
    assert "descriptions of TTbot" in " ".join(get_robot("ttbot").source.split())
    assert "brief" not in capsys.readouterr().out
    assert main(["--robots", "husky"]) == 0
    text = capsys.readouterr().out
    assert "skid steer" in text and "0.67" in text and "-7.5..7.5 N m" in text
    assert study.main(["pictures", "--robots", "husky", str(tmp_path / "pictures")]) == 0
    assert (tmp_path / "pictures" / "husky.png").stat().st_size > 1000


def test_command_measures_and_answers_an_unknown_name(capsys, monkeypatch):
    assert study.main(["evidence", "--robots", "turtlebot"]) == 0
    assert "all passed" in capsys.readouterr().out
    monkeypatch.setattr(evidence, "PUSH_SPEED_M_S", 0.0)
    assert study.main(["evidence", "--robots", "turtlebot"]) == 1
    assert "FAILED" in capsys.readouterr().out
    for program in (lambda: main(["--robots", "turtelbot"]), lambda: study.main(["evidence", "--robots", "turtelbot"])):
        assert program() == 2
        assert "did you mean 'turtlebot'" in capsys.readouterr().err
