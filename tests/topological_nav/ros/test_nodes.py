"""The nodes on topics that are lists in memory, with a robot that does at once what it is told: no ROS needed."""

import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from scenes_mjcf.look import Lens
from topological_nav.ros import nodes, topics
from topological_nav.ros.config import HeadingConfig, SimulatorConfig
from topological_nav.ros.debian import RosError
from topological_nav.ros.drivers import Command, HeadingDriver
from topological_nav.ros.nodes import NavigatorNode, Pace, SimulatorNode
from topological_nav.ros.simulator import Sensed


class Message:
    """Has every field, each empty until it is set."""

    def __init__(self, value=None):
        self.data = self.clock = self.transforms = value

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, Message())
        return getattr(self, name)


class Time(float):
    def __new__(cls, secs, nsecs):
        return super().__new__(cls, secs + 1e-9 * nsecs)

    def to_sec(self):
        return float(self)


class Bus:
    """Stands for rospy and the message packages; delivers at once, in the publisher's thread."""

    def __init__(self):
        self.listeners, self.latched, self.sent, self.lock = {}, {}, [], threading.RLock()
        self.rospy = SimpleNamespace(
            Publisher=self._publisher, Subscriber=self._subscriber, Time=Time, init_node=lambda *_, **__: None,
            set_param=lambda name, value: self.sent.append((name, value)),
        )  # fmt: skip
        kinds = [kind.split("/") for kind in [*topics.TOPICS.values(), "geometry_msgs/TransformStamped"]]
        for package, _ in kinds:
            setattr(self, package, SimpleNamespace(**{n: Message for p, n in kinds if p == package}))

    def of(self, topic):
        return [message for name, message in self.sent if name == topic]

    def _subscriber(self, topic, kind, callback, **_):
        del kind
        self.listeners.setdefault(topic, []).append(callback)
        for message in self.latched.get(topic, []):
            callback(message)
        return SimpleNamespace(get_num_connections=lambda: 1)

    def _publisher(self, topic, kind, latch=False, **_):
        del kind

        def publish(content):
            message = content if isinstance(content, Message) else Message(content)
            with self.lock:
                self.sent.append((topic, message))
                if latch:
                    self.latched[topic] = [message]
                for callback in self.listeners.get(topic, []):
                    callback(message)

        return SimpleNamespace(publish=publish, get_num_connections=lambda: len(self.listeners.get(topic, [])))


class Robot:
    """What `SimulatorNode` asks of a simulator; its world's frame is turned by a quarter from its start's."""

    dt_s, config, lens = 0.1, SimulatorConfig(), Lens(8, 6, 90.0)
    range_min_m, lidar_pos_m, camera_pos_m = 0.05, (0.17, 0.0, 0.36), (0.1, 0.0, 1.02)

    def __init__(self):
        self.steps, self.pose = 0, np.zeros(3)

    def step(self, linear, angular):
        self.steps += 1
        self.pose[2] += 0.1 * angular
        self.pose[:2] += 0.1 * linear * np.array([math.cos(self.pose[2]), math.sin(self.pose[2])])
        return self.sense()

    def sense(self):
        x, y, yaw = self.pose
        truth_w = np.array([-y, x, yaw + math.pi / 2])
        return Sensed(
            0.1 * self.steps, np.full((6, 8, 3), self.steps % 256, np.uint8), np.ones(4, np.float32), self.pose.copy(),
            np.zeros(3), np.zeros(3), yaw + math.pi / 2, bool(x > 0.5), False, 0.0, truth_w,
        )  # fmt: skip


def never():
    return False


def together(bus, simulator, navigator):
    told = []
    thread = threading.Thread(target=lambda: told.append(navigator.run(never)))
    thread.start()
    tally = simulator.run(never)
    thread.join(10)
    assert not thread.is_alive()
    return tally, told[0]


def test_an_episode_in_lockstep_has_one_command_for_each_picture():
    bus = Bus()
    simulator = SimulatorNode(bus, Robot(), Pace(lockstep=True))  # type: ignore[arg-type]
    config = HeadingConfig(heading_rad=math.pi / 2, linear_mps=0.5, drive_s=2.0)
    tally, done = together(bus, simulator, NavigatorNode(bus, HeadingDriver(config)))
    # 20 steps of 0.05 m along the world's y; half of them and more beyond 0.5 m, where the robot touches something.
    assert done and tally.done
    assert (tally.seconds, tally.path_m, tally.structure_s) == pytest.approx((2.0, 1.0, 0.0))
    assert tally.movable_s == pytest.approx(1.0, abs=0.11)
    assert tally.end_w == pytest.approx((0.0, 1.0, math.pi / 2), abs=1e-3)
    images, commands = bus.of(topics.IMAGE), bus.of(topics.COMMAND)
    assert len(images) == 21 and len(commands) == 22  # and one that stops the robot
    assert [m.linear.x for m in commands] == [0.5] * 20 + [0.0, 0.0]
    assert [m.data[0] for m in images] == list(range(21))
    stamps = [m.header.stamp for m in images]
    assert stamps == pytest.approx(1.0 + 0.1 * np.arange(21)) and stamps == [m.clock for m in bus.of(topics.CLOCK)]
    assert {m.header.frame_id for m in images} == {"camera_optical_frame"}
    assert bus.of("/use_sim_time") == [True]


def test_frames_hang_together():
    bus = Bus()
    SimulatorNode(bus, Robot(), Pace(factor=0.0, limit_s=0.0)).run(never)  # type: ignore[arg-type]
    links = [(t.header.frame_id, t.child_frame_id) for m in bus.of(topics.TF_STATIC) for t in m.transforms]
    assert links == [
        ("base_link", "lidar_link"),
        ("base_link", "camera_link"),
        ("camera_link", "camera_optical_frame"),
    ]
    (moving,) = bus.of(topics.TF)[0].transforms
    assert (moving.header.frame_id, moving.child_frame_id) == ("odom", "base_link")
    (odometry,) = bus.of(topics.ODOMETRY)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")


def test_a_command_is_driven_for_half_a_second_and_no_longer():
    bus, robot = Bus(), Robot()
    node = SimulatorNode(bus, robot, Pace(factor=0.0, limit_s=2.0))  # type: ignore[arg-type]

    def once(message):
        if message.data[0] == 3:
            command = Message()
            command.linear.x, command.angular.z = 1.0, 0.0
            bus.listeners[topics.COMMAND][0](command)

    bus.listeners.setdefault(topics.IMAGE, []).append(once)
    tally = node.run(never)
    assert not tally.done and tally.seconds == pytest.approx(2.0)
    # The step it came in, and five more.
    assert robot.pose[0] == pytest.approx(0.6)


def test_the_clock_runs_as_it_is_told(monkeypatch):
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    monkeypatch.setattr(nodes, "time", SimpleNamespace(perf_counter=lambda: now[0], sleep=sleep))
    bus = Bus()
    SimulatorNode(bus, Robot(), Pace(factor=2.0, limit_s=1.0)).run(never)  # type: ignore[arg-type]
    assert slept == pytest.approx([0.05] * 10)


def test_without_a_navigator_lockstep_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(nodes, "_PATIENCE_S", 0.3)
    node = SimulatorNode(Bus(), Robot(), Pace(lockstep=True))  # type: ignore[arg-type]
    with pytest.raises(RosError, match="nobody joined /camera/image_raw: is the navigator running"):
        node.run(never)


class Seen:
    """A driver that keeps what it was shown."""

    def __init__(self, lens):
        self.lens, self.shown = lens, []

    def step(self, image, heading_rad, time_s):
        self.shown.append((image, heading_rad, time_s))
        return Command(0.0, 0.0, done=len(self.shown) == 2)


def test_pictures_are_seen_through_the_drivers_lens_and_headings_are_turned_into_the_maps_frame():
    bus, driver = Bus(), Seen(Lens(4, 3, 90.0))
    simulator = SimulatorNode(bus, Robot(), Pace(lockstep=True))  # type: ignore[arg-type]
    tally, done = together(bus, simulator, NavigatorNode(bus, driver, "odom", heading_offset_rad=-0.5))
    assert done and tally.seconds == pytest.approx(0.1)
    assert [image.shape for image, _, _ in driver.shown] == [(3, 4, 3)] * 2
    assert [(h, t) for _, h, t in driver.shown] == [(pytest.approx(-0.5), 1.0), (pytest.approx(-0.5), 1.1)]


def test_a_velocity_that_is_not_finite_stops_the_robot():
    bus, said = Bus(), []
    node = SimulatorNode(bus, Robot(), Pace(factor=0.0, limit_s=0.3), said.append)  # type: ignore[arg-type]
    command = Message()
    command.linear.x, command.angular.z = math.nan, 0.0
    bus.listeners[topics.COMMAND][0](command)
    assert node.run(never).path_m == 0.0
    assert said == ["simulator: velocity command is (nan, 0.0), expected finite numbers; the robot stops"]
