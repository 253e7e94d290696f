"""A TurtleBot and a TTbot in a bare toy room of 6 x 4 m: pictures, scans, odometry and touches by hand."""

import math
import sys
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest
from rclpy.publisher import Publisher
from std_msgs.msg import Bool

import interactive_nav
from interactive_nav.ros import nodes
from interactive_nav.ros.__main__ import main
from interactive_nav.ros.simulator import NEEDED, RosSensors, RosSimulator, compose
from interactive_nav_common.errors import UserError
from tests.toys import write_room

CHAIR = 2
"""Its class id."""


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("ros") / "room", (6.0, 4.0), (("chair", 1.4, -1.5, 5.0, 0.5),))


@pytest.fixture(scope="module")
def env(room):
    observed = ("depth", "segmentation", "rgb", *NEEDED)
    sizes = {"image_size": 33, "lidar_rays": 4, "lidar_fov_deg": 360.0, "num_objects": 0}
    return interactive_nav.make("turtlebot", [room], backend="native", observations=observed, **sizes)


def test_sensors_are_those_of_the_environment_in_si_units(env):
    simulator = RosSimulator(env, start=(-1.0, 0.5, math.pi / 2))
    now = simulator.sense()
    assert now.odometry == pytest.approx([-1.0, 0.5, math.pi / 2], abs=1e-4)  # the map's
    assert now.scan * 5.6 == pytest.approx([2.5, 4.0, 1.5, 2.0], abs=1e-3)  # behind, right, ahead, left
    depth, ids, rgb = (now.images[name] for name in ("depth", "segmentation", "rgb"))
    assert (depth.shape, depth.dtype, ids.dtype, rgb.shape, rgb.dtype) == (
        (33, 33),
        "float32",
        "uint8",
        (33, 33, 3),
        "uint8",
    )
    # The camera is 0.087 m behind the middle of the base.
    assert depth[16, 16] == pytest.approx(1.587, abs=2e-3) and depth.max() <= 5.0
    assert rgb.std() > 5 and not ids.any()  # structure
    facing = RosSimulator(env, start=(0.0, -1.5, 0.0)).sense().images
    assert facing["segmentation"][16, 16] == CHAIR and 0.8 < facing["depth"][16, 16] < 1.487
    for _ in range(10):
        now = simulator.step(0.3, 0.0)
    assert now.odometry == pytest.approx(now.truth_w, abs=1e-3) and now.truth_w[1] > 0.6


def ttbot(room, **settings):
    """A TTbot at x = -2 m, y = 1 m, along x, whose camera draws flat colours; it is commanded a velocity."""
    lidar = {"lidar_rays": 4, "lidar_fov_deg": 360.0, "lidar_range_m": 4.5, "lidar_pos_m": (0.17, 0.0, 0.36)}
    fixed = {"observations": ("depth", *NEEDED), "image_size": 32, "num_objects": 0, "control_mode": "twist"}
    env = interactive_nav.make("ttbot", [room], backend="native", **fixed, **lidar, **settings)
    return RosSimulator(env, 0, (-2.0, 1.0, 0.0), "rays")


def test_it_drives_ahead_until_it_meets_the_wall_and_turns(room):
    simulator = ttbot(room)
    first = simulator.sense()
    assert first.time_s == 0.0 and first.truth_w == pytest.approx([-2.0, 1.0, 0.0])
    # The scanner is 0.17 m ahead: behind, to the right, ahead (out of range) and to the left.
    assert first.scan * 4.5 == pytest.approx([1.17, 3.0, 4.5, 1.0], abs=1e-4)
    assert first.images["rgb"].shape == (32, 32, 3) and first.images["rgb"].std() > 5
    assert first.images["depth"].shape == (32, 32)
    for _ in range(20):
        now = simulator.step(0.5, 0.0)
    assert now.time_s == pytest.approx(2.0)
    assert now.odometry == pytest.approx(now.truth_w, abs=2e-3)
    assert 0.85 < now.odometry[0] + 2.0 < 1.0  # a metre, less what speeding up takes
    assert now.linear_b == pytest.approx([0.5, 0, 0], abs=0.02)
    assert now.scan[0] * 4.5 == pytest.approx(3.17 + now.odometry[0], abs=2e-3)
    assert not now.touches_structure and now.force_n == 0.0
    for _ in range(60):
        if now.touches_structure:
            break
        now = simulator.step(1.0, 0.0)
    # Its chassis ends 0.25 m ahead of its middle.
    assert now.touches_structure and not now.touches_movable and now.force_n > 1.0
    assert now.truth_w[0] == pytest.approx(2.75, abs=0.06)
    for _ in range(11):
        back = simulator.step(-0.5, 0.0)
    assert not back.touches_structure and back.truth_w[0] < now.truth_w[0] - 0.2
    for _ in range(5):
        before = simulator.step(0.0, 0.0)
    for _ in range(20):
        after = simulator.step(0.0, 0.5)
    turned = math.remainder(after.heading_rad - before.heading_rad, math.tau)
    assert turned == pytest.approx(1.0, abs=0.15)  # less what speeding up takes
    assert math.remainder(after.odometry[2] - after.heading_rad, math.tau) == pytest.approx(0.0, abs=1e-4)
    assert after.angular_b[2] == pytest.approx(0.5, abs=0.25)  # tyres that scrub sideways do it in jerks
    assert np.abs(after.images["rgb"].astype(float) - before.images["rgb"]).mean() > 2


def test_pictures_span_the_field_of_view_of_the_settings(room):
    wide, narrow = (ttbot(room, image_fov_deg=fov_deg) for fov_deg in (120.0, 40.0))
    assert narrow.lenses[""].fov_deg == 40.0
    assert np.abs(narrow.sense().images["rgb"].astype(float) - wide.sense().images["rgb"]).mean() > 2


def test_a_start_in_a_wall_is_refused(env):
    with pytest.raises(UserError, match=r"start \(-3.0, 0.5\) is not where the robot has room"):
        RosSimulator(env, start=(-3.0, 0.5, 0.0))


def test_a_camera_on_the_arm_is_where_c_mujoco_has_its_link(room):
    views = ({"name": "base"}, {"name": "hand", "body": "fetch_gripper", "pos_m": (0.05, 0.0, 0.0), "pitch_deg": 0.0})
    fixed = {"observations": ("depth", *NEEDED), "image_size": 32, "num_objects": 0, "cameras": views}
    env = interactive_nav.make("fetch", [room], backend="native", **fixed)
    sensors, model = RosSensors(env), env.world.models[0]
    state, data = jax.jit(env.reset)(jax.random.PRNGKey(0)), mujoco.MjData(model)
    elbow, places = model.joint("fetch_elbow_flex").qposadr[0], []
    for angle in (0.5, 1.5):
        qpos = state.pipeline_state.qpos.at[elbow].set(angle)
        state = state.replace(pipeline_state=state.pipeline_state.replace(qpos=qpos))
        data.qpos[:] = np.asarray(qpos)
        mujoco.mj_kinematics(model, data)
        base, hand = data.body(env.robot.base_body), data.body("fetch_gripper")
        there = hand.xpos + hand.xmat.reshape(3, 3) @ [0.05, 0.0, 0.0] - base.xpos
        places.append(sensors.read(state, 0.0).cameras["hand/"][0])
        assert places[-1] == pytest.approx(base.xmat.reshape(3, 3).T @ there, abs=1e-4)
    assert np.linalg.norm(places[1] - places[0]) > 0.2
    assert "hand/" not in sensors.camera_poses(state, moving=False)


def test_poses_are_composed():
    assert compose(np.array([1.0, 2.0, math.pi / 2]), np.array([3.0, 1.0, 0.5])) == pytest.approx(
        [0, 5, math.pi / 2 + 0.5]
    )


def test_a_start_that_is_no_pose_is_one_line(capsys):
    assert main(["simulate", "room", "--start", "1,2"]) == 2
    assert "--start is '1,2', expected X,Y,YAW" in capsys.readouterr().err


def test_a_moment_that_nobody_answers_is_sent_again(monkeypatch):
    """As best effort may lose a message; what has no stamp, by which readers know it, is not."""
    monkeypatch.setattr(nodes, "AGAIN_S", 0.05)
    simulator = nodes.SimulatorNode(SimpleNamespace(create_subscription=lambda *_: None), None, nodes.Pace())  # type: ignore[arg-type]
    sent = []
    simulator._out = {name: SimpleNamespace(publish=sent.append) for name in ("image", "clock")}
    image = SimpleNamespace(header="now")
    simulator._send({"clock": "tick", "image": image})
    assert simulator.answer(0, lambda: len(sent) >= 4) == (0.0, 0.0)
    assert sent == ["tick", image, image, image]


def test_the_last_messages_have_time_whichever_way_a_node_ends(monkeypatch):
    """All publishers share five seconds: here the first one's reader takes four of them, and the clock stands then."""
    asked, slept, clock = [], [], [10.0]

    def acknowledged(_, timeout):
        asked.append(timeout.nanoseconds / 1e9)
        clock[0] = 14.0

    monkeypatch.setattr(Publisher, "wait_for_all_acked", acknowledged)
    monkeypatch.setattr(nodes, "time", SimpleNamespace(monotonic=lambda: clock[0], sleep=slept.append))
    with pytest.raises(SystemExit), nodes.ros_node("ends") as node:
        for topic in ("one", "two"):
            node.create_publisher(Bool, topic, 1)
        sys.exit(3)
    assert len(asked) >= 2 and asked == [5.0] + [1.0] * (len(asked) - 1)
    assert slept == [1.0]
