"""Run nodes, connect a simulator to topics and record them; `messages` decides what is in a message."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Bool, Float32

from interactive_nav.ros import messages as ros
from interactive_nav.ros.simulator import CameraPoses, Pace, Sensed, Tally
from interactive_nav_common.errors import UserError, missing, optional

COMMAND_HOLDS_S = 0.5
"""A velocity command is driven for this long; then the robot stops, as mobile bases do."""
PATIENCE_S = 180.0
"""Wall-clock time to wait for other nodes."""
_ACKNOWLEDGED_S = 5.0
"""For readers to acknowledge a node's last messages."""
_DELIVERY_S = 1.0
"""For messages that other threads of DDS still send before a node ends, and for news of its subscriptions."""
AGAIN_S = 2.0
"""Wall-clock time after which in lockstep a moment without an answer is sent again: best effort may lose a message."""
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
    finally:  # `sys.exit` within the block ends up here, too
        until = time.monotonic() + _ACKNOWLEDGED_S  # for all together: a reader that hangs acknowledges nothing
        for publisher in node.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, until - time.monotonic())))
        time.sleep(_DELIVERY_S)
        executor.shutdown()
        thread.join(5.0)
        node.destroy_node()
        if first:
            rclpy.shutdown()


class SimulatorNode:
    """Publish the sensors of a simulated robot, and drive it by velocity commands."""

    def __init__(self, node: Node, robot: Any, pace: Pace, say: Say = lambda _: None):
        """Subscribe on a node of `ros_node`; in lockstep, start when somebody reads pictures or the odometry.

        `robot` is a `RosSimulator`, or a `RosSensors` of states that the caller steps.
        """
        self._node, self._robot, self._pace, self._say = node, robot, pace, say
        self._news = threading.Condition()
        self._command, self._commands, self._done = (0.0, 0.0), 0, False
        self._out: dict[str, Any] = {}
        self._moment: dict[str, Any] = {}
        self._heard = [
            node.create_subscription(ros.TOPICS[name], name, heard, ros.qos(name, reading=True))
            for name, heard in ((ros.COMMAND, self._on_command), (ros.DONE, self._on_done))
        ]

    def run(self, stop: Stop) -> Tally:
        """Simulate until the navigator is done, the limit is reached or `stop` returns True."""
        pace, tally, simulator = self._pace, Tally(), self._robot
        now = simulator.sense()
        self.begin(now, simulator.cameras, stop)
        held, obeyed = 0.0, 0
        due = time.perf_counter()
        while not stop():
            before_this = self.publish(now)
            if tally.seconds >= pace.limit_s - 1e-6:
                break
            if pace.lockstep:
                self.answer(before_this, stop)
            elif pace.factor:
                due = max(due + simulator.dt_s / pace.factor, time.perf_counter() - 1.0)
                time.sleep(max(due - time.perf_counter(), 0.0))
            with self._news:
                linear, angular = self._command
                held = 0.0 if self._commands > obeyed else held + simulator.dt_s
                obeyed = self._commands
                if self._done:
                    tally.done = True
                    break
            if held > COMMAND_HOLDS_S + 1e-6:
                linear = angular = 0.0
            before, now = now, simulator.step(linear, angular)
            tally.add(before, now)
            if int(now.time_s) > int(before.time_s) and int(now.time_s) % 10 == 0:
                x, y, _ = now.truth_w
                self._say(f"simulator: {now.time_s:.0f} s of at most {pace.limit_s:.0f} s, at ({x:.2f}, {y:.2f})")
        return tally

    def begin(self, now: Sensed, cameras: CameraPoses, stop: Stop) -> None:
        """Create publishers of what is sensed, wait in lockstep for the other nodes, and publish fixed frames.

        `cameras` are fixed to the base.
        """
        topics, lossless = ros.FROM_ROBOT | ros.camera_topics(now.images), self._pace.recorded
        self._out = {
            name: self._node.create_publisher(kind, name, ros.qos(name, lossless=lossless))
            for name, kind in topics.items()
        }
        if self._pace.lockstep or lossless:
            self._wait_for_others(stop)
        links = [ros.transform(ros.BASE, ros.LIDAR, self._robot.lidar_pos_m), *ros.camera_links(cameras)]
        for prefix in (*cameras, *now.cameras):
            links.append(ros.transform(*ros.camera_frames(prefix), np.zeros(3), ros.OPTICAL_QUAT))
        links.append(ros.transform(ros.MAP, ros.ODOM, np.zeros(3)))
        self._send({ros.TF_STATIC: ros.TFMessage and ros.TFMessage(transforms=links)})

    def answer(self, before: int, stop: Stop) -> tuple[float, float]:
        """Wait for another velocity command than the first `before`; return the last, m/s and rad/s."""
        lacking, again_s = f"no command came on {ros.COMMAND}: has the navigator ended?", time.monotonic() + AGAIN_S

        def answered() -> bool:
            nonlocal again_s
            ready = self._commands > before or self._done
            if not ready and time.monotonic() > again_s:  # readers ignore what they have: its stamp is not new
                self._send({topic: one for topic, one in self._moment.items() if hasattr(one, "header")})
                again_s = time.monotonic() + AGAIN_S
            return ready

        wait_for(self._news, answered, stop, lambda: lacking)
        return self._command

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
        recorded, read = self._pace.recorded, (ros.IMAGE, ros.ODOMETRY)

        def lacking() -> list[str]:
            count = {name: out.get_subscription_count() for name, out in self._out.items()}
            out = [name for name in ros.FROM_ROBOT if recorded and not count[name]]
            out += [] if max(count[name] for name in read) > recorded else [" or ".join(read)]
            # Matched, not only announced: a command from a publisher that is not matched yet would be lost.
            return out if self._heard[0].get_publisher_count() else [*out, ros.COMMAND]

        wait_for(
            self._news,
            lambda: not lacking(),
            stop,
            lambda: f"nobody joined {', '.join(lacking())}: is the navigator running?",
        )
        time.sleep(_DELIVERY_S)  # its other subscriptions may be announced later

    def _send(self, by_topic: dict[str, Any]) -> None:
        self._moment |= by_topic
        for topic, message in by_topic.items():
            if message is not None and topic in self._out:
                self._out[topic].publish(message)

    def publish(self, now: Sensed) -> int:
        """Publish one moment, pictures last, because the navigator waits for them; return how many velocity commands
        came before."""
        with self._news:
            before = self._commands
        robot = self._robot
        base, odom, lidar = (ros.header(now.time_s, frame) for frame in (ros.BASE, ros.ODOM, ros.LIDAR))
        x, y, yaw = (float(v) for v in now.odometry)
        link = ros.transform(ros.ODOM, ros.BASE, np.array([x, y, 0.0]), ros.yaw_quat(yaw), now.time_s)
        scanner = robot.lidar_fov_deg, robot.range_min_m, robot.lidar_range_m, robot.dt_s
        self._send(
            {
                ros.CLOCK: Clock(clock=ros.stamp(now.time_s)),
                ros.TF: ros.TFMessage and ros.TFMessage(transforms=[link, *ros.camera_links(now.cameras, now.time_s)]),
                ros.MOVABLE: Bool(data=now.touches_movable),
                ros.STRUCTURE: Bool(data=now.touches_structure),
                ros.FORCE: Float32(data=now.force_n),
                ros.HEADING: ros.imu_message(now.heading_rad, now.angular_b, base),
                ros.ODOMETRY: ros.odometry_message(now.odometry, now.linear_b, now.angular_b, odom),
                ros.SCAN: ros.scan_message(now.scan, *scanner, lidar) if len(now.scan) else None,
            }
        )
        for name, image in now.images.items():
            prefix = name[: name.rfind("/") + 1]
            optical = ros.header(now.time_s, ros.camera_frames(prefix)[1])
            self._send({ros.camera_topic(name, "camera_info"): ros.info_message(robot.lenses[prefix], optical)})
            self._send({ros.camera_topic(name): ros.image_message(image, optical)})
        return before


@contextlib.contextmanager
def recording(node: Node, path: Path, topics: Mapping[str, Any] = ros.TOPICS) -> Iterator[None]:
    """Record topics in a rosbag2 folder (MCAP); a message's time is the last one of the simulated clock."""
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
        connection, last = writer.add_connection(topic, name, typestore=store), b""
        stamped = "header" in kind.get_fields_and_field_types()

        def heard(raw: bytes) -> None:
            nonlocal now_ns, last
            if stamped and raw == last:  # sent again, see `AGAIN_S`
                return
            last = raw
            with lock:
                if topic == ros.CLOCK:
                    clock = store.deserialize_cdr(raw, name).clock
                    now_ns = clock.sec * 10**9 + clock.nanosec
                writer.write(connection, now_ns, raw)

        node.create_subscription(kind, topic, heard, ros.qos(topic, 1000, lossless=True), raw=True)

    for topic, kind in topics.items():
        add(topic, kind)
    try:
        yield
        time.sleep(_DELIVERY_S)
    finally:
        with lock:
            writer.close()


def wait_for(news: threading.Condition, ready: Callable[[], bool], stop: Stop, lacking: Callable[[], str]) -> None:
    """Wait until it is ready or `stop` returns True; raise `RosError` after `PATIENCE_S`."""
    until = time.monotonic() + PATIENCE_S
    with news:
        while not news.wait_for(ready, 0.05):
            if stop():
                return
            if time.monotonic() > until:
                raise RosError(f"waited {PATIENCE_S:.0f} s: {lacking()}")
