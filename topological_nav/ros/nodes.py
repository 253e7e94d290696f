"""Connect the simulator and the navigator to topics; `messages` decides what is in a message."""

import contextlib
import functools
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Bool, Float32

from interactive_nav_common.errors import UserError, missing, optional
from scenes_mjcf.look import Lens
from topological_nav.ros import messages as ros
from topological_nav.ros.drivers import Driver, VelocityCommand
from topological_nav.ros.simulator import Pace, RosSimulator, Sensed, Tally

COMMAND_HOLDS_S = 0.5
"""A velocity command is driven for this long; then the robot stops, as mobile bases do."""
LOST_S = 1.0
"""Wall-clock time without a picture after which the navigator stops the robot."""
_PATIENCE_S = 180.0
"""Wall-clock time to wait for other nodes."""
_DELIVERY_S = 1.0
"""Between the last message and the end of a node: DDS sends in other threads."""
Stop = Callable[[], bool]
"""Returns whether to stop."""
Say = Callable[[str], None]


class RosError(UserError):
    """Report that another node is missing or silent."""


@contextlib.contextmanager
def ros_node(name: str) -> Iterator[Node]:
    """Yield a node whose callbacks run in a thread; the last messages are delivered before it ends."""
    first = not rclpy.ok()
    if first:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node, executor = rclpy.create_node(name), SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield node
        time.sleep(_DELIVERY_S)
    finally:
        executor.shutdown()
        thread.join(5.0)
        node.destroy_node()
        if first:
            rclpy.shutdown()


class SimulatorNode:
    """Publish the sensors of a simulated robot, and drive it by velocity commands."""

    def __init__(self, node: Node, simulator: RosSimulator, pace: Pace, say: Say = lambda _: None):
        """Create its publishers and subscriptions on a node of `ros_node`."""
        self._node, self._simulator, self._pace, self._say = node, simulator, pace, say
        self._news = threading.Condition()
        self._command, self._commands, self._done = (0.0, 0.0), 0, False
        self._out = {name: node.create_publisher(kind, name, ros.qos(name)) for name, kind in ros.FROM_ROBOT.items()}
        for name, heard in ((ros.COMMAND, self._on_command), (ros.DONE, self._on_done)):
            node.create_subscription(ros.TOPICS[name], name, heard, ros.qos(name, reading=True))

    def run(self, stop: Stop) -> Tally:
        """Simulate until the navigator is done, the limit is reached or `stop` returns True."""
        pace, tally = self._pace, Tally()
        if pace.lockstep or pace.recorded:
            self._wait_for_others(stop)
        self._send_frames()
        now = self._simulator.sense()
        held, obeyed = 0.0, 0
        due = time.perf_counter()
        while not stop():
            with self._news:
                before_this = self._commands
            self._publish(now)
            if tally.seconds >= pace.limit_s - 1e-6:
                break
            if pace.lockstep:
                lacking = f"no command came on {ros.COMMAND}: has the navigator ended?"
                _wait(self._news, lambda n=before_this: self._commands > n or self._done, stop, lambda: lacking)  # noqa: B023
            elif pace.factor:
                due = max(due + self._simulator.dt_s / pace.factor, time.perf_counter() - 1.0)
                time.sleep(max(due - time.perf_counter(), 0.0))
            with self._news:
                linear, angular = self._command
                held = 0.0 if self._commands > obeyed else held + self._simulator.dt_s
                obeyed = self._commands
                if self._done:
                    tally.done = True
                    break
            if held > COMMAND_HOLDS_S + 1e-6:
                linear = angular = 0.0
            before, now = now, self._simulator.step(linear, angular)
            tally.add(before, now)
            if int(now.time_s) > int(before.time_s) and int(now.time_s) % 10 == 0:
                x, y, _ = now.truth_w
                self._say(f"simulator: {now.time_s:.0f} s of at most {pace.limit_s:.0f} s, at ({x:.2f}, {y:.2f})")
        return tally

    def _on_command(self, message: Any) -> None:
        try:
            command = ros.twist_command(message)
        except ros.MessageError as error:
            self._say(f"simulator: {error}; the robot stops")
            command = (0.0, 0.0)
        with self._news:
            self._command, self._commands = command, self._commands + 1
            self._news.notify_all()

    def _on_done(self, message: Any) -> None:
        with self._news:
            self._done = self._done or bool(message.data)
            self._news.notify_all()

    def _wait_for_others(self, stop: Stop) -> None:
        listeners = dict.fromkeys(self._out, 1) if self._pace.recorded else {ros.HEADING: 0}
        listeners[ros.IMAGE] = 2 if self._pace.recorded else 1

        def lacking() -> list[str]:
            out = [name for name, least in listeners.items() if self._out[name].get_subscription_count() < least]
            return out if self._node.count_publishers(ros.COMMAND) else [*out, ros.COMMAND]

        _wait(
            self._news,
            lambda: not lacking(),
            stop,
            lambda: f"nobody joined {', '.join(lacking())}: is the navigator running?",
        )

    def _send_frames(self) -> None:
        base, camera = ros.header(0.0, ros.BASE), ros.header(0.0, ros.CAMERA)
        links = [
            ros.transform(base, ros.LIDAR, self._simulator.lidar_pos_m, ros.yaw_quat(0.0)),
            ros.transform(base, ros.CAMERA, self._simulator.camera_pos_m, ros.yaw_quat(0.0)),
            ros.transform(camera, ros.OPTICAL, (0.0, 0.0, 0.0), ros.OPTICAL_QUAT),
        ]
        self._send({ros.TF_STATIC: ros.TFMessage and ros.TFMessage(transforms=links)})

    def _send(self, by_topic: dict[str, Any]) -> None:
        for topic, message in by_topic.items():
            if topic in self._out:
                self._out[topic].publish(message)

    def _publish(self, now: Sensed) -> None:
        """Publish one moment; the picture last, because the navigator waits for it."""
        simulator, config = self._simulator, self._simulator.config
        base, odom, lidar, optical = (
            ros.header(now.time_s, frame) for frame in (ros.BASE, ros.ODOM, ros.LIDAR, ros.OPTICAL)
        )
        x, y, yaw = (float(v) for v in now.odometry)
        link = ros.transform(odom, ros.BASE, (x, y, 0.0), ros.yaw_quat(yaw))
        scanner = config.lidar_fov_deg, simulator.range_min_m, config.lidar_range_m, simulator.dt_s
        self._send(
            {
                ros.CLOCK: Clock(clock=ros.stamp(now.time_s)),
                ros.TF: ros.TFMessage and ros.TFMessage(transforms=[link]),
                ros.MOVABLE: Bool(data=now.touches_movable),
                ros.STRUCTURE: Bool(data=now.touches_structure),
                ros.FORCE: Float32(data=now.force_n),
                ros.HEADING: ros.imu_message(now.heading_rad, now.angular_b, base),
                ros.ODOMETRY: ros.odometry_message(now.odometry, now.linear_b, now.angular_b, odom),
                ros.SCAN: ros.scan_message(now.scan, *scanner, lidar),
                ros.INFO: ros.info_message(simulator.lens, optical),
                ros.IMAGE: ros.image_message(now.rgb, optical),
            }
        )


class Headings:
    """Hold the last headings by time; not safe for several threads at once."""

    def __init__(self, kept: int = 256):
        self._pairs: deque[tuple[float, float]] = deque(maxlen=kept)

    def add(self, time_s: float, yaw_rad: float) -> None:
        """Add a heading; one that is older than the newest drops all others (a clock that was set back)."""
        if time_s < self.newest_s:
            self._pairs.clear()
        self._pairs.append((time_s, yaw_rad))

    @property
    def newest_s(self) -> float:
        """Return the time of the last heading; minus infinity before the first."""
        return self._pairs[-1][0] if self._pairs else -math.inf

    def at(self, time_s: float) -> float:
        """Return the heading, rad in [-pi, pi]: interpolated between two, else the nearest one."""
        if not self._pairs:
            raise ValueError("no heading was added yet")
        times, yaws = np.array(self._pairs).T
        return math.remainder(np.interp(time_s, times, np.unwrap(yaws)), math.tau)


class NavigatorNode:
    """Hand each picture and its heading to a driver, and publish the driver's commands.

    It does not know whether a robot or a simulator is behind the topics: time is that of the pictures.
    """

    def __init__(
        self,
        node: Node,
        driver: Driver,
        heading_from: str = "imu",
        heading_offset_rad: float = 0.0,
        say: Say = lambda _: None,
    ):
        """Create its publishers and subscriptions on a node of `ros_node`.

        The offset is the yaw of the heading sensor's frame in the map's, added to the heading.
        """
        self._driver, self._offset, self._say = driver, heading_offset_rad, say
        self._news = threading.Condition()
        self._headings, self._image, self._lens = Headings(), None, None
        self._command, self._done = (
            node.create_publisher(ros.TOPICS[name], name, ros.qos(name)) for name in (ros.COMMAND, ros.DONE)
        )
        self._heading_topic = ros.HEADING_TOPICS[heading_from]
        for name in (self._heading_topic, ros.INFO, ros.IMAGE):
            heard = functools.partial(self._on_message, name)
            node.create_subscription(ros.TOPICS[name], name, heard, ros.qos(name, reading=True))

    def run(self, stop: Stop) -> bool:
        """Drive until the driver is done (True) or `stop` returns True; the robot is stopped at the end."""
        last_s, said_s, came = -math.inf, -math.inf, time.monotonic()
        moving = False
        try:
            while not stop():
                with self._news:
                    self._news.wait_for(lambda: self._image is not None or stop(), 0.2)
                    message, self._image = self._image, None
                if message is None:
                    silent_s = time.monotonic() - came
                    if moving and silent_s > LOST_S:
                        self._say(f"navigator: no picture came on {ros.IMAGE} for {LOST_S:g} s; the robot stops")
                        self._send(VelocityCommand(0.0, 0.0))
                        moving = False
                    if silent_s > _PATIENCE_S:
                        raise RosError(f"waited {_PATIENCE_S:.0f} s: no picture came on {ros.IMAGE}")
                    continue
                came = time.monotonic()
                time_s = ros.seconds(message.header.stamp)
                if time_s < last_s:
                    continue
                last_s = time_s
                heading = self._heading_at(time_s, stop)
                if heading is None:
                    break
                image = ros.image_array(message)
                if self._driver.lens is not None:
                    image = ros.seen_through(image, self._fov_deg(stop), self._driver.lens)
                command = self._driver.step(image, heading, time_s)
                self._send(command)
                moving = True
                if time_s - said_s >= 10.0:
                    said_s = time_s
                    self._say(
                        f"navigator: {time_s:.1f} s, heading {math.degrees(heading):.0f} degrees, "
                        f"{command.linear_mps:.2f} m/s, {command.angular_radps:.2f} rad/s"
                    )
                if command.done:
                    return True
            return False
        finally:
            self._send(VelocityCommand(0.0, 0.0))

    def _send(self, command: VelocityCommand) -> None:
        # Whether it is done comes first: in lockstep the simulator goes on with the command.
        if command.done:
            self._done.publish(Bool(data=True))
        self._command.publish(ros.twist_message(command.linear_mps, command.angular_radps))

    def _heading_at(self, time_s: float, stop: Stop) -> float | None:
        """Return the heading when a picture was taken; wait a little for one that is not older."""
        with self._news:
            self._news.wait_for(lambda: self._headings.newest_s >= time_s - 1e-6, 0.2)
            lacking = f"no heading came on {self._heading_topic}"
            if not _wait(self._news, lambda: math.isfinite(self._headings.newest_s), stop, lambda: lacking):
                return None
            return math.remainder(self._headings.at(time_s) + self._offset, math.tau)

    def _fov_deg(self, stop: Stop) -> float:
        _wait(self._news, lambda: self._lens is not None, stop, lambda: f"no camera_info came on {ros.INFO}")
        lens = self._lens
        return lens.fov_deg if isinstance(lens, Lens) else math.nan

    def _on_message(self, topic: str, message: Any) -> None:
        with self._news:
            try:
                if topic == ros.IMAGE:
                    self._image = message
                elif topic == ros.INFO:
                    self._lens = ros.info_lens(message)
                else:
                    quat = message.orientation if topic == ros.HEADING else message.pose.pose.orientation
                    self._headings.add(ros.seconds(message.header.stamp), ros.quat_yaw(quat))
                self._news.notify_all()
            except ros.MessageError as error:
                self._say(f"navigator: {topic}: {error}")


@contextlib.contextmanager
def recording(node: Node, path: Path) -> Iterator[None]:
    """Record all topics in a rosbag2 folder (MCAP); a message's time is the last one of the simulated clock."""
    rosbag2 = optional("rosbags.rosbag2", missing("--bag", "rosbags", "ros2"))
    typesys = optional("rosbags.typesys", missing("--bag", "rosbags", "ros2"))
    store, now_ns = typesys.get_typestore(typesys.Stores.ROS2_KILTED), 0
    lock = threading.Lock()
    try:
        writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        writer.open()
    except rosbag2.WriterError as error:
        raise UserError(f"--bag: {error}; choose another folder") from None

    def add(topic: str, kind: Any) -> None:
        name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
        connection = writer.add_connection(topic, name, typestore=store)

        def heard(raw: bytes) -> None:
            nonlocal now_ns
            with lock:
                if topic == ros.CLOCK:
                    clock = store.deserialize_cdr(raw, name).clock
                    now_ns = clock.sec * 10**9 + clock.nanosec
                writer.write(connection, now_ns, raw)

        node.create_subscription(kind, topic, heard, ros.qos(topic, 1000, reading=True), raw=True)

    for topic, kind in ros.TOPICS.items():
        add(topic, kind)
    try:
        yield
        time.sleep(_DELIVERY_S)
    finally:
        with lock:
            writer.close()


def _wait(news: threading.Condition, ready: Callable[[], bool], stop: Stop, lacking: Callable[[], str]) -> bool:
    """Wait until it is ready (True) or `stop` returns True (False); raise `RosError` after `_PATIENCE_S`."""
    until = time.monotonic() + _PATIENCE_S
    with news:
        while not news.wait_for(ready, 0.05):
            if stop():
                return False
            if time.monotonic() > until:
                raise RosError(f"waited {_PATIENCE_S:.0f} s: {lacking()}")
    return True
