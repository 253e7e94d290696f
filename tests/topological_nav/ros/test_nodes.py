"""The nodes on real topics of this process, with a robot that does at once what it is commanded."""

import contextlib
import dataclasses
import math
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from interactive_nav.ros import messages, nodes
from interactive_nav.ros.nodes import RosError, SimulatorNode, ros_node
from interactive_nav.ros.simulator import Pace, Sensed
from scenes_mjcf.look import Lens
from tests.topological_nav.ros.turning import Turning
from topological_nav.ros import nodes as navigator_nodes
from topological_nav.ros.nodes import NavigatorNode, heading_at


class Robot:
    """Has what `SimulatorNode` reads of a simulator; its world's frame is turned by a quarter from its start's."""

    dt_s, lidar_fov_deg, lidar_range_m, range_min_m, lidar_pos_m = 0.1, 240.0, 5.6, 0.05, (0.17, 0.0, 0.36)

    def __init__(self):
        self.steps, self.pose = 0, np.zeros(3)
        self.lenses, self.cameras = {"": Lens(8, 6, 90.0)}, {"": (np.array([0.1, 0.0, 1.02]), 0.0, 0.0)}

    def step(self, linear, angular):
        self.steps += 1
        self.pose[2] += 0.1 * angular
        self.pose[:2] += 0.1 * linear * np.array([math.cos(self.pose[2]), math.sin(self.pose[2])])
        return self.sense()

    def sense(self):
        x, y, yaw = self.pose
        truth_w = np.array([-y, x, yaw + math.pi / 2])
        return Sensed(
            0.1 * self.steps, {"rgb": np.full((6, 8, 3), self.steps % 256, np.uint8)},
            np.ones(4, np.float32), self.pose.copy(), np.zeros(3),
            np.zeros(3), yaw + math.pi / 2, bool(x > 0.5), False, 0.0, truth_w,
        )  # fmt: skip


def never():
    return False


@pytest.fixture
def bus(monkeypatch):
    """Two nodes, and a third one that keeps all messages by topic."""
    monkeypatch.setattr(nodes, "_DELIVERY_S", 0.1)
    kept = {topic: [] for topic in messages.TOPICS}
    with contextlib.ExitStack() as stack:
        simulator, navigator, listener = (stack.enter_context(ros_node(n)) for n in ("sim", "navigator", "listener"))
        for topic, kind in messages.TOPICS.items():
            listener.create_subscription(kind, topic, kept[topic].append, messages.qos(topic, 100, reading=True))
        yield SimpleNamespace(simulator=simulator, navigator=navigator, listener=listener, of=kept.__getitem__)


def until(ready, seconds=5.0):
    end = time.monotonic() + seconds
    while not ready() and time.monotonic() < end:
        time.sleep(0.01)
    assert ready()


def together(simulator, navigator):
    results = []
    thread = threading.Thread(target=lambda: results.append(navigator.run(never)))
    thread.start()
    tally = simulator.run(never)
    thread.join(10)
    assert not thread.is_alive()
    return tally, results[0]


def test_an_episode_in_lockstep_has_one_command_for_each_picture(bus):
    simulator = SimulatorNode(bus.simulator, Robot(), Pace(lockstep=True, recorded=True))  # type: ignore[arg-type]
    tally, done = together(simulator, NavigatorNode(bus.navigator, Turning(math.pi / 2)))  # type: ignore[arg-type]
    # 20 steps of 0.05 m along the world's y; half of them and more beyond 0.5 m, where the robot touches something.
    assert done and tally.done
    assert (tally.seconds, tally.path_m, tally.structure_s) == pytest.approx((2.0, 1.0, 0.0))
    assert tally.movable_s == pytest.approx(1.0, abs=0.11)
    assert tally.end_w == pytest.approx((0.0, 1.0, math.pi / 2), abs=1e-3)
    images, commands = bus.of(messages.IMAGE), bus.of(messages.COMMAND)
    until(lambda: len(images) == 21 and len(commands) == 22)  # and one that stops the robot
    assert [m.linear.x for m in commands] == [0.5] * 20 + [0.0, 0.0]
    assert [m.data[0] for m in images] == list(range(21))
    stamps = [messages.seconds(m.header.stamp) for m in images]
    assert stamps == pytest.approx(1.0 + 0.1 * np.arange(21))
    assert stamps == [messages.seconds(m.clock) for m in bus.of(messages.CLOCK)]
    assert {m.header.frame_id for m in images} == {"camera_optical_frame"}
    (odometry, *_) = bus.of(messages.ODOMETRY)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")


def test_frames_hang_together(bus, monkeypatch):
    """tf2_msgs is in no wheel: a stand-in of one field is sent to a stand-in for the publisher."""
    sent = {messages.TF: [], messages.TF_STATIC: []}
    monkeypatch.setattr(messages, "TFMessage", SimpleNamespace)
    robot = Robot()
    robot.cameras |= {"left/": (np.array([0.0, 0.2, 0.9]), math.pi / 2, 0.4)}
    robot.lenses |= {"left/": Lens(4, 3, 60.0)}
    sense = robot.sense
    moving = {"hand/": (np.array([0.5, 0.0, 0.7]), 0.0, 0.1)}
    robot.sense = lambda: dataclasses.replace(
        sense(), images={"left/rgb": np.zeros((3, 4, 3), np.uint8)}, cameras=moving
    )
    node = SimulatorNode(bus.simulator, robot, Pace(factor=0.0, limit_s=0.0))  # type: ignore[arg-type]
    monkeypatch.setattr(
        node,
        "_send",
        lambda by_topic: [sent.setdefault(topic, []).append(message) for topic, message in by_topic.items()],
    )
    node.run(never)
    fixed = [t for m in sent[messages.TF_STATIC] for t in m.transforms]
    assert [(t.header.frame_id, t.child_frame_id) for t in fixed] == [
        ("base_link", "lidar_link"),
        ("base_link", "camera_link"),
        ("base_link", "left_camera_link"),
        ("camera_link", "camera_optical_frame"),
        ("left_camera_link", "left_camera_optical_frame"),
        ("hand_camera_link", "hand_camera_optical_frame"),
        ("map", "odom"),
    ]
    (moment,) = sent[messages.TF]  # with each one where the hand's camera is
    assert [(t.header.frame_id, t.child_frame_id) for t in moment.transforms] == [
        ("odom", "base_link"),
        ("base_link", "hand_camera_link"),
    ]
    place = moment.transforms[1].transform.translation
    assert (place.x, place.y, place.z) == (0.5, 0.0, 0.7) and moment.transforms[1].header.stamp == messages.stamp(0.0)
    # The left camera's x axis points to the left and 0.4 rad down.
    quat = fixed[2].transform.rotation
    x, y, z, w = quat.x, quat.y, quat.z, quat.w
    ahead = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    assert ahead == pytest.approx((0.0, math.cos(0.4), -math.sin(0.4)))
    (picture,) = sent["/camera/left/image_raw"]
    assert picture.header.frame_id == "left_camera_optical_frame"


def test_a_command_is_driven_for_half_a_second_and_no_longer(bus):
    robot = Robot()
    node = SimulatorNode(bus.simulator, robot, Pace(factor=0.0, limit_s=2.0))  # type: ignore[arg-type]
    step = robot.step

    def with_a_command(linear, angular):
        if robot.steps == 3:
            node._on_command(messages.twist_message(1.0, 0.0))
        return step(linear, angular)

    robot.step = with_a_command
    tally = node.run(never)
    assert not tally.done and tally.seconds == pytest.approx(2.0)
    # The step after it came, and five more, although it came while the simulator computed a step.
    assert robot.pose[0] == pytest.approx(0.6)


def test_simulated_time_follows_the_clock_by_its_factor(bus, monkeypatch):
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    clock = SimpleNamespace(perf_counter=lambda: now[0], sleep=sleep, monotonic=time.monotonic)
    monkeypatch.setattr(nodes, "time", clock)
    SimulatorNode(bus.simulator, Robot(), Pace(factor=2.0, limit_s=1.0)).run(never)  # type: ignore[arg-type]
    assert slept == pytest.approx([0.05] * 10)


def test_without_a_navigator_lockstep_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(nodes, "PATIENCE_S", 0.3)
    with ros_node("alone") as node:
        simulator = SimulatorNode(node, Robot(), Pace(lockstep=True))  # type: ignore[arg-type]
        with pytest.raises(
            RosError, match="nobody joined /camera/image_raw or /odom, /cmd_vel: is the navigator running"
        ):
            simulator.run(never)


class Watcher:
    """A driver that keeps what it is given."""

    def __init__(self, lens, steps=2):
        self.lens, self.steps, self.shown = lens, steps, []

    def step(self, image, heading_rad, time_s):
        self.shown.append((image, heading_rad, time_s))
        return (0.2, 0.0), len(self.shown) == self.steps


def test_pictures_have_the_drivers_lens_and_headings_are_in_the_maps_frame(bus):
    driver = Watcher(Lens(4, 3, 90.0))
    simulator = SimulatorNode(bus.simulator, Robot(), Pace(lockstep=True))  # type: ignore[arg-type]
    navigator = NavigatorNode(bus.navigator, driver, "odom", heading_offset_rad=-0.5)  # type: ignore[arg-type]
    tally, done = together(simulator, navigator)
    assert done and tally.seconds == pytest.approx(0.1)
    assert [image.shape for image, _, _ in driver.shown] == [(3, 4, 3)] * 2
    assert [(h, t) for _, h, t in driver.shown] == [(pytest.approx(-0.5), 1.0), (pytest.approx(-0.5), 1.1)]


def test_a_velocity_that_is_not_finite_stops_the_robot(bus):
    said = []
    node = SimulatorNode(bus.simulator, Robot(), Pace(factor=0.0, limit_s=0.3), said.append)  # type: ignore[arg-type]
    node._on_command(messages.Twist(linear=messages.Vector3(x=math.nan)))
    assert node.run(never).path_m == 0.0
    assert said == ["simulator: velocity command is (nan, 0.0), expected finite numbers; the robot stops"]


def test_a_lost_camera_stops_the_robot(bus, monkeypatch):
    monkeypatch.setattr(navigator_nodes, "SILENCE_S", 0.3)
    said, stops = [], []
    navigator = NavigatorNode(bus.navigator, Watcher(None, 9), say=said.append)  # type: ignore[arg-type]
    thread = threading.Thread(target=lambda: navigator.run(lambda: bool(stops)))
    thread.start()
    robot = Robot().sense()
    camera = bus.simulator.create_publisher(messages.Image, messages.IMAGE, messages.qos(messages.IMAGE))
    compass = bus.simulator.create_publisher(messages.Imu, messages.HEADING, messages.qos(messages.HEADING))
    until(lambda: camera.get_subscription_count() == 2 and compass.get_subscription_count() == 2)
    until(lambda: navigator._command and navigator._command.get_subscription_count())
    head = messages.header(0.0, "base_link")
    compass.publish(messages.imu_message(0.0, np.zeros(3), head))
    camera.publish(messages.image_message(robot.images["rgb"], head))
    speeds = bus.of(messages.COMMAND)
    until(lambda: [m.linear.x for m in speeds] == [0.2, 0.0])
    assert said[-1] == "navigator: nothing came on /camera/image_raw for 0.3 s; the robot stops"
    stops.append(1)
    thread.join(5)
    assert not thread.is_alive()


def test_headings_turn_the_short_way_between_two_tellings():
    told = [(1.0, math.radians(170)), (2.0, math.radians(-170))]
    at = [math.degrees(heading_at(told, time_s)) for time_s in (1.25, 1.75, 0.0, 9.0)]
    assert at == pytest.approx([175, -175, 170, -170])


def test_headings_before_a_clock_that_is_set_back_do_not_count(bus):
    said = []
    navigator = NavigatorNode(bus.navigator, Watcher(None), say=said.append)  # type: ignore[arg-type]
    compass = bus.simulator.create_publisher(messages.Imu, messages.HEADING, messages.qos(messages.HEADING))
    until(lambda: compass.get_subscription_count() == 2)
    for time_s, yaw_rad in ((5.0, 0.1), (6.0, 0.2)):
        compass.publish(messages.imu_message(yaw_rad, np.zeros(3), messages.header(time_s, "base_link")))
    until(lambda: len(navigator._headings) == 2)
    for time_s in (1.0, 1.1):  # the first of them is refused
        compass.publish(messages.imu_message(0.3, np.zeros(3), messages.header(time_s, "base_link")))
    until(lambda: navigator._headings and navigator._headings[-1] == (pytest.approx(2.1), pytest.approx(0.3)))
    assert len(navigator._headings) == 1 and "time jumped back from 7.000 to 2.000 s" in navigator._mistake
