"""A hand-made policy that follows waypoints: its numbers by hand, and drives over real DDS on loopback."""

import contextlib
import json
import math
import threading
import time
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav.interop.onnx_file import OnnxError, OnnxFile
from interactive_nav.ros import driving as shared
from interactive_nav.ros import messages, nodes, pilot
from interactive_nav.ros.__main__ import main
from interactive_nav.ros.drive import DriveNode
from interactive_nav.ros.nodes import SimulatorNode, ros_node
from interactive_nav.ros.pilot import Pilot, encoded, remaining, resampled, scene_path
from interactive_nav.ros.remote import RosPolicy
from interactive_nav.ros.simulator import Pace, Sensed
from interactive_nav.sensing.description import KEY
from interactive_nav.task.rollout import Player, Recorder, episode_keys
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens
from tests.toys import write_room

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

VECTOR = {"dtype": "float32", "scale": 1.0, "range": None}
ABOUT = {
    "robot": {"name": "turtlebot", "control_mode": "native", "rate_hz": 10.0,
              "base_height_m": 0.02, "success_distance_m": 0.3},
    "inputs": {
        "waypoints": {**VECTOR, "shape": [6], "spacing_m": 0.2},
        "goal": {**VECTOR, "shape": [3]},
        "lidar": {**VECTOR, "shape": [4], "scale": 5.6, "range": [0.01, 1.0]},
        "pixels/depth": {**VECTOR, "shape": [3, 4, 1], "scale": 5.0, "range": [0.0, 1.0]},
    },
    "outputs": {"twist": {"low": [-0.5, -1.5], "high": [0.5, 1.5]}},
    "cameras": [{"inputs": "pixels/", "vertical_fov_deg": 90.0, "width": 4, "height": 3}],
    "lidar": {"lidar_rays": 4, "lidar_fov_deg": 360.0, "lidar_range_m": 5.6},
}  # fmt: skip


def changed(**parts):
    return {**json.loads(json.dumps(ABOUT)), **parts}


def write_policy(path, about=ABOUT, gains=(1.0, 4.0)):
    """Twist = (x of the last waypoint, 4 times its y): ahead where the path runs, turning towards it."""
    gain = np.zeros((6, 2), np.float32)
    gain[4, 0], gain[5, 1] = gains
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", *of["shape"]])
              for name, of in about["inputs"].items()]  # fmt: skip
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["waypoints", "gain"], ["twist"])], "policy", values,
        [onnx.helper.make_tensor_value_info("twist", onnx.TensorProto.FLOAT, ["batch", 2])],
        [onnx.numpy_helper.from_array(gain, "gain")],
    )  # fmt: skip
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.helper.set_model_props(model, {KEY: json.dumps(about)})
    onnx.save(model, path)
    return path


def recording(about=ABOUT, twist=(0.1, 0.2)) -> Any:
    """A policy that keeps what it is given."""
    kept = []

    def run(output, inputs):
        assert output == "twist"
        kept.append({name: value[0] for name, value in inputs.items()})
        return np.array([twist], np.float32)

    return SimpleNamespace(about=about, path="policy.onnx", run=run, kept=kept)


def values(x=0.0, y=0.0, yaw=0.0):
    return {"pose": np.array([x, y, yaw]), "lidar": np.full(4, 2.8), "pixels/depth": np.full((3, 4), 7.0)}


def test_inputs_are_in_the_robots_frame_and_in_the_files_scale():
    policy = recording()
    pilot = Pilot(policy, odom_in_map=(1.0, 0.0, 0.0))
    assert pilot.decide(values()) == (0.0, 0.0) and not policy.kept  # no goal
    pilot.aim(np.array([1.0, 3.0]))
    assert pilot.decide(values(yaw=math.pi / 2)) == pytest.approx((0.1, 0.2))
    (given,) = policy.kept
    # The robot stands at (1, 0) on the map and looks along y, to the goal 3 m ahead.
    assert given["waypoints"] == pytest.approx([0.2, 0, 0.4, 0, 0.6, 0], abs=1e-6)
    assert given["goal"] == pytest.approx([3.0, 0.0, -0.02], abs=1e-6)
    assert given["lidar"] == pytest.approx([0.5] * 4)
    assert given["pixels/depth"].shape == (3, 4, 1) and (given["pixels/depth"] == 1.0).all()  # cut at 5 m
    assert pilot.decide(values(y=2.8)) == (0.0, 0.0) and pilot.goal is None


def test_odometry_counts_from_where_the_goal_came():
    inputs = {name: {**VECTOR, "shape": [3]} for name in ("odometry", "localisation")}
    policy = recording(changed(inputs=inputs))
    pilot = Pilot(policy)
    pilot.aim(np.array([9.0, 9.0]))
    pilot.decide(values(2.0, 1.0, math.pi / 2))
    pilot.decide(values(1.5, 2.0, -3.0))
    assert policy.kept[0]["odometry"] == pytest.approx([0, 0, 0], abs=1e-6)
    assert policy.kept[1]["odometry"] == pytest.approx([1.0, 0.5, math.tau - 3.0 - math.pi / 2], abs=1e-6)
    assert policy.kept[1]["localisation"] == pytest.approx([1.5, 2.0, -3.0])


def test_a_plan_is_resampled_and_what_lies_behind_is_dropped():
    plan = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    ahead = remaining(plan, np.array([0.7, 0.1]), 2.0)
    assert ahead.tolist() == [[0.7, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    points = resampled(ahead, 4, 0.2)
    assert points == pytest.approx(np.array([[0.9, 0.0], [1.0, 0.1], [1.0, 0.3], [1.0, 0.5]]))
    assert resampled(ahead, 3, 2.0)[1:].tolist() == [[0.0, 1.0], [0.0, 1.0]]  # its end is repeated
    # The last leg is nearer, but farther along the path than is looked.
    assert remaining(plan, np.array([0.0, 0.9]), 0.5)[0].tolist() == [0.0, 0.0]
    assert remaining(plan[:1], np.array([0.7, 0.1]), 2.0).tolist() == [[0.0, 0.0]]


def test_a_goal_at_the_plans_end_keeps_the_plan_and_another_drops_it():
    policy = recording()
    pilot = Pilot(policy)
    pilot.aim(np.array([1.0, 1.0]), np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]))
    pilot.aim(np.array([1.0, 0.9]))
    pilot.decide(values(0.9))
    assert policy.kept[-1]["waypoints"] == pytest.approx([0.1, 0.1, 0.1, 0.3, 0.1, 0.5], abs=1e-6)
    pilot.aim(np.array([3.0, 0.0]))
    pilot.decide(values(0.9))
    assert policy.kept[-1]["waypoints"] == pytest.approx([0.2, 0, 0.4, 0, 0.6, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("twist", "limits", "expected"),
    [
        ((1.0, 0.0), (None, None), (0.5, 0.0)),
        ((1.0, 0.9), (None, 0.3), (1 / 3, 0.3)),
        ((-0.4, 0.1), (0.2, 9), (-0.2, 0.05)),
    ],
)
def test_limits_keep_the_curve(twist, limits, expected):
    pilot = Pilot(recording(twist=twist), limits)
    pilot.aim(np.array([3.0, 0.0]))
    assert pilot.decide(values()) == pytest.approx(expected)


def test_a_velocity_that_is_not_finite_ends_the_node(tmp_path, quick):
    policy = write_policy(tmp_path / "policy.onnx", gains=(math.nan, 0.0))
    with driving(policy, Robot(), Pace(lockstep=True), silence_s=60.0) as bus:
        publisher(bus.user, messages.GOAL, messages.PoseStamped).publish(goal(3.0, 0.0))
        until(lambda: bus.errors)
    assert bus.errors == ["velocity command is (nan, 0.0), expected finite numbers"]


def test_bytes_are_rounded():
    of = {"dtype": "uint8", "scale": 5.0 / 255, "range": [0, 255], "shape": [2, 1]}
    assert encoded(np.array([[2.51], [9.0]]), of).tolist() == [[[128], [255]]]


@pytest.mark.parametrize(
    ("about", "line"),
    [
        (changed(inputs={"hand": {**VECTOR, "shape": [10]}}), "no topic carries its input hand"),
        (changed(outputs={"action": {}}), "the policy gives no velocity of a base"),
    ],
)
def test_other_policies_are_refused(about, line):
    with pytest.raises(OnnxError, match=line):
        Pilot(recording(about))


def test_paths_of_a_map_that_lack_what_the_policy_avoided_are_said(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pilot, "scene_path", lambda about, scene: None if about is None else lambda goal, xy: xy)
    for avoided in ({}, {"avoids": "heavy furniture"}):
        about = changed()
        about["inputs"]["waypoints"] |= avoided
        words = [str(write_policy(tmp_path / "policy.onnx", about)), "--map", "home", "--odom-in-map", "1,2"]
        assert main(["drive", *words]) == 2  # for the pose
        assert ("waypoints avoided heavy furniture, which paths in --map do not" in capsys.readouterr().err) == bool(
            avoided
        )


def test_mistakes_are_one_line(tmp_path, capsys):
    policy = str(write_policy(tmp_path / "policy.onnx"))
    (tmp_path / "empty.onnx").write_bytes(b"")
    for words, line in (
        ([policy, "--robot", "fetch"], "the policy is for robot 'turtlebot', expected 'fetch'"),
        ([str(tmp_path / "empty.onnx")], "not readable as an ONNX model"),
        ([policy, "--silence", "0"], "--silence is 0.0, expected a positive number"),
        ([policy, "--odom-in-map", "1,2"], "--odom-in-map is '1,2', expected X,Y,YAW"),
    ):
        assert main(["drive", *words]) == 2
        error = capsys.readouterr().err
        assert line in error and error.count("\n") == 1, error


class Robot:
    """What `SimulatorNode` reads of a simulator: a robot that does at once what it is commanded."""

    dt_s, lenses, lidar_fov_deg, lidar_range_m = 0.1, {"": Lens(8, 6, 90.0)}, 360.0, 5.6
    range_min_m, lidar_pos_m, cameras = 0.05, (0.0, 0.0, 0.3), {"": (np.array([0.1, 0.0, 1.0]), 0.0, 0.0)}

    def __init__(self):
        self.steps, self.pose, self.blind, self.passed = 0, np.zeros(3), False, []

    def step(self, linear, angular):
        self.steps += 1
        self.pose[2] += 0.1 * angular
        self.pose[:2] += 0.1 * linear * np.array([math.cos(self.pose[2]), math.sin(self.pose[2])])
        self.passed.append(self.pose.copy())
        return self.sense()

    def sense(self):
        images = {} if self.blind else {"depth": np.full((6, 8), 2.0, np.float32)}
        return Sensed(
            0.1 * self.steps, images, np.ones(4, np.float32), self.pose.copy(), np.zeros(3), np.zeros(3),
            self.pose[2], False, False, 0.0, self.pose.copy(),
        )  # fmt: skip


def until(ready, seconds=60.0):
    end = time.monotonic() + seconds
    while not ready() and time.monotonic() < end:
        time.sleep(0.01)
    assert ready()


@contextlib.contextmanager
def driving(policy, robot, pace, **settings):
    """A policy and a robot on topics, each in a thread; yields a node for goals, what was said, and their end."""
    with contextlib.ExitStack() as stack:
        ours, theirs, user = (stack.enter_context(ros_node(name)) for name in ("policy", "simulator", "user"))
        said, stops, errors = [], [], []

        def run(node):
            try:
                node.run(lambda: bool(stops))
            except UserError as error:
                errors.append(str(error))

        simulator = SimulatorNode(theirs, robot, pace)
        runs = [simulator, DriveNode(ours, Pilot(OnnxFile(policy)), say=said.append, **settings)]
        threads = [threading.Thread(target=run, args=[node]) for node in runs]
        for thread in threads:
            thread.start()
        try:
            yield SimpleNamespace(user=user, said=said, errors=errors, drive=runs[1])
        finally:
            stops.append(1)
            for thread in threads:
                thread.join(10)
        assert not any(thread.is_alive() for thread in threads)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(nodes, "_DELIVERY_S", 0.1)


def publisher(node, topic, kind, readers=1):
    out = node.create_publisher(kind, topic, messages.qos(topic))
    until(lambda: out.get_subscription_count() >= readers)
    return out


def goal(x, y, frame="map"):
    pose = messages.Pose(position=messages.Point(x=x, y=y), orientation=messages.Quaternion(w=1.0))
    return messages.PoseStamped(header=messages.header(0.0, frame), pose=pose)


def test_a_policy_drives_to_three_goals_through_topics(tmp_path, quick):
    robot = Robot()
    with driving(write_policy(tmp_path / "policy.onnx"), robot, Pace(lockstep=True), silence_s=60.0) as bus:
        goals, plans = (publisher(bus.user, *of) for of in messages.REQUESTS.items() if of[0] != messages.JOY)
        for k, (x, y) in enumerate([(1.5, 0.5), (1.0, -1.0)]):
            goals.publish(goal(x, y))
            until(lambda k=k: len(bus.said) > k)
            assert bus.said[k] == f"policy: reached ({x:.2f}, {y:.2f})"
            assert math.dist(robot.pose[:2], (x, y)) < 0.3
        # The third along a plan with a corner, which a straight line would cut.
        plans.publish(
            messages.Path(
                header=messages.header(0.0, "map"), poses=[goal(*p) for p in ((1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0))]
            )
        )
        until(lambda: len(bus.said) > 2)
        assert math.dist(robot.pose[:2], (-1.0, 1.0)) < 0.3
        corner = min(math.dist(p[:2], (-1.0, -1.0)) for p in robot.passed)
        assert corner < 0.35, corner
        assert max(np.linalg.norm(np.diff([p[:2] for p in robot.passed], axis=0), axis=-1)) <= 0.05 + 1e-6
    assert not bus.errors


def test_episodes_over_topics_are_those_of_the_same_policy_without(tmp_path, quick):
    room = write_room(tmp_path / "room", (6.0, 4.0), (("chair", 1.4, -1.5, 5.0, 0.5),))
    few: dict[str, Any] = {"num_objects": 0, "num_waypoints": 3, "episode_steps": 60}
    env = interactive_nav.make("turtlebot", [room], backend="native", observations=("waypoints",), **few)
    about = changed(inputs={"waypoints": ABOUT["inputs"]["waypoints"]})
    del about["lidar"]
    file = OnnxFile(write_policy(tmp_path / "policy.onnx", about | {"cameras": []}, gains=(0.5, 2.0)))
    recorders = {"at_w": Recorder(lambda state, action: state.info["nav"].robot_pos_w),
                 "success": Recorder(lambda state, action: state.metrics["success"])}  # fmt: skip
    player, keys = Player(env, recorders), episode_keys(0, 2)
    alone = player.rollout(lambda obs, key: env.robot.drive(0.5 * obs[4], 2.0 * obs[5], jnp), keys, batch=1)
    stops = []
    with ros_node("policy") as node, contextlib.closing(RosPolicy(env)) as policy:
        drive = DriveNode(node, Pilot(file, scene=scene_path(about, room)), silence_s=60.0)
        thread = threading.Thread(target=lambda: drive.run(lambda: bool(stops)))
        thread.start()
        behind = player.rollout(policy, keys, batch=1)
        stops.append(1)
        thread.join(10)
        with pytest.raises(UserError, match="policy ros: one episode at a time can be driven; set --batch 1"):
            policy.act(None, np.arange(2), np.ones(2, bool), 0)
    assert behind.num_steps.tolist() == alone.num_steps.tolist()
    assert behind.values["success"].tolist() == alone.values["success"].tolist()
    assert behind.values["at_w"] == pytest.approx(alone.values["at_w"], abs=1e-3)


def test_a_lost_camera_stops_the_robot_and_it_goes_on_with_the_next_picture(tmp_path, quick):
    robot = Robot()
    with driving(write_policy(tmp_path / "policy.onnx"), robot, Pace(), silence_s=1.0) as bus:
        publisher(bus.user, messages.GOAL, messages.PoseStamped).publish(goal(50.0, 0.0))
        until(lambda: robot.pose[0] > 0.2)
        robot.blind = True
        until(lambda: any("camera" in line for line in bus.said))
        assert bus.said[-1] == "policy: nothing came on /camera/depth/image_raw for 1 s; the robot stops"
        until(lambda: len(robot.passed) > 1 and robot.passed[-1][0] == robot.passed[-2][0])
        stood, steps = robot.pose[0], robot.steps
        until(lambda: robot.steps > steps + 3)
        assert robot.pose[0] == stood
        robot.blind = False
        until(lambda: robot.pose[0] > stood + 0.1)


def test_a_second_publisher_of_velocities_ends_the_node(tmp_path, quick):
    robot = Robot()
    with driving(write_policy(tmp_path / "policy.onnx"), robot, Pace(), silence_s=60.0) as bus:
        publisher(bus.user, messages.GOAL, messages.PoseStamped).publish(goal(50.0, 0.0))
        until(lambda: robot.pose[0] > 0.1)
        bus.user.create_publisher(messages.Twist, messages.COMMAND, 1)
        until(lambda: bus.errors)
        assert bus.errors == ["1 other node(s) publish /cmd_vel, expected none; end them"]


@pytest.fixture
def alone(tmp_path, quick):
    """A node whose messages are handed to it directly, with the odometry's and the scan's values."""
    with ros_node("policy") as node:
        said = []
        driver = DriveNode(node, Pilot(OnnxFile(write_policy(tmp_path / "policy.onnx"))), say=said.append, button=1)
        heard = {s.topic_name: s.callback for s in node.subscriptions}
        yield SimpleNamespace(driver=driver, heard=heard, said=said)


def odometry(time_s, x=0.0):
    three = np.zeros(3)
    return messages.odometry_message(np.array([x, 0.0, 0.0]), three, three, messages.header(time_s, "odom"))


def scan(readings, time_s=0.0):
    return messages.scan_message(np.array(readings), 360.0, 0.05, 5.6, 0.1, messages.header(time_s, "lidar_link"))


def test_nan_and_a_clock_that_jumps_back_are_refused(alone):
    driver, heard = alone.driver, alone.heard
    heard[messages.ODOMETRY](odometry(1.0, math.nan))
    assert driver._mistake == "/odom: odometry has numbers that are not finite" and not driver._stamps
    broken = scan([0.5] * 4)
    broken.ranges[2] = math.nan
    heard[messages.SCAN](broken)
    assert driver._mistake == "/scan: 1 of 4 ranges are NaN, expected none (REP 117)"
    heard[messages.GOAL](goal(1.0, 0.0, "base_link"))
    assert "frame is 'base_link', expected 'map' or 'odom'" in driver._mistake and driver._pilot.goal is None
    heard[messages.GOAL](goal(1.0, 0.0))
    heard[messages.ODOMETRY](odometry(5.0))
    assert driver._pilot.goal.tolist() == [1.0, 0.0]
    heard[messages.ODOMETRY](odometry(4.0))
    assert driver._mistake == "/odom: time jumped back from 6.000 to 5.000 s; send the goal again"
    assert driver._pilot.goal is None


def test_goals_in_the_odometrys_frame_and_frames_of_tf(alone):
    driver, heard = alone.driver, alone.heard
    link = messages.transform("map", "odom", (2.0, 1.0, 0.0), messages.yaw_quat(math.pi / 2))
    driver._on_frames(SimpleNamespace(transforms=[link]))
    heard[messages.GOAL](goal(1.0, 0.0, "odom"))
    assert driver._pilot.goal == pytest.approx([2.0, 2.0])


def test_the_dead_mans_button_must_be_held(alone, monkeypatch):
    driver, now = alone.driver, [100.0]
    monkeypatch.setattr(shared, "time", SimpleNamespace(monotonic=lambda: now[0]))
    assert driver._released() == "button 1 of /joy is not held"
    alone.heard[messages.JOY](messages.Joy(buttons=[0, 1]))
    assert driver._released() == ""
    now[0] += 1.1  # nothing came since
    assert driver._released()
    alone.heard[messages.JOY](messages.Joy(buttons=[0, 1]))
    alone.heard[messages.JOY](messages.Joy(buttons=[1, 0]))
    assert driver._released()


def test_scans_are_read_by_angle():
    # Beams from -180 degrees on, every 90: behind, right, ahead, left.
    turned = messages.LaserScan(angle_min=0.0, angle_increment=math.pi / 2, range_min=0.1, range_max=9.0)
    turned.ranges = [1.0, 2.0, math.inf, -math.inf]  # ahead, left, behind, right (too near)
    assert messages.scan_readings(turned, 4, 360.0, 4.0) == pytest.approx([1.0, 0.025, 0.25, 0.5])
    clockwise = messages.LaserScan(angle_min=math.pi / 2, angle_increment=-math.pi / 2, ranges=[4.0, 2.0, 1.0])
    assert messages.scan_readings(clockwise, 2, 180.0, 4.0) == pytest.approx([0.25, 0.5])
    with pytest.raises(messages.MessageError, match="scan covers 270 degrees"):
        messages.scan_readings(clockwise, 4, 360.0, 4.0)


def test_depth_is_read_in_metres_and_nothing_reads_0():
    seen = np.array([[1.5, math.inf]], np.float32)
    assert messages.image_array(messages.image_message(seen, messages.header(0.0, "c")), "depth").tolist() == [
        [1.5, 0.0]
    ]
    kinect = messages.Image(height=1, width=1, step=2, encoding="16UC1", is_bigendian=1, data=[4, 0])  # 1,024 mm
    assert messages.image_array(kinect, "depth") == pytest.approx(np.array([[1.024]]))
    ids = np.array([[3, 7]], np.uint8)
    assert messages.image_array(messages.image_message(ids, messages.header(0.0, "c")), "segmentation").tolist() == [
        [3, 7]
    ]
    assert messages.camera_topic("left/depth") == "/camera/left/depth/image_raw"
