"""Run nodes, connect a simulator to topics and record them; `messages` decides what is in a message."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Bool, Float32

from interactive_nav.ros import messages as ros
from interactive_nav.ros.simulator import Pace, RosSimulator, Sensed, Tally
from interactive_nav_common.errors import UserError, missing, optional

COMMAND_HOLDS_S = 0.5
"""A velocity command is driven for this long; then the robot stops, as mobile bases do."""
PATIENCE_S = 180.0
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

    def __init__(
        self, node: Node, simulator: RosSimulator, pace: Pace, say: Say = lambda _: None, awaited: str = ros.IMAGE
    ):
        """Create its publishers and subscriptions on a node of `ros_node`; in lockstep it starts when somebody reads
        the topic `awaited`."""
        self._node, self._simulator, self._pace, self._say = node, simulator, pace, say
        self._news = threading.Condition()
        self._command, self._commands, self._done = (0.0, 0.0), 0, False
        topics = ros.FROM_ROBOT | ros.camera_topics(simulator.sense().images)
        self._out = {name: node.create_publisher(kind, name, ros.qos(name)) for name, kind in topics.items()}
        self._awaited = awaited
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
                wait_for(self._news, lambda n=before_this: self._commands > n or self._done, stop, lambda: lacking)  # noqa: B023
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
        listeners = dict.fromkeys(ros.FROM_ROBOT, 1) if self._pace.recorded else {}
        listeners[self._awaited] = 2 if self._pace.recorded else 1

        def lacking() -> list[str]:
            out = [name for name, least in listeners.items() if self._out[name].get_subscription_count() < least]
            return out if self._node.count_publishers(ros.COMMAND) else [*out, ros.COMMAND]

        wait_for(
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
        if self._simulator.odom_is_map:
            links.append(ros.transform(ros.header(0.0, ros.MAP), ros.ODOM, (0.0, 0.0, 0.0), ros.yaw_quat(0.0)))
        self._send({ros.TF_STATIC: ros.TFMessage and ros.TFMessage(transforms=links)})

    def _send(self, by_topic: dict[str, Any]) -> None:
        for topic, message in by_topic.items():
            if topic in self._out:
                self._out[topic].publish(message)

    def _publish(self, now: Sensed) -> None:
        """Publish one moment; pictures last, because the navigator waits for them."""
        simulator = self._simulator
        base, odom, lidar, optical = (
            ros.header(now.time_s, frame) for frame in (ros.BASE, ros.ODOM, ros.LIDAR, ros.OPTICAL)
        )
        x, y, yaw = (float(v) for v in now.odometry)
        link = ros.transform(odom, ros.BASE, (x, y, 0.0), ros.yaw_quat(yaw))
        scanner = simulator.lidar_fov_deg, simulator.range_min_m, simulator.lidar_range_m, simulator.dt_s
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
            }
        )
        for name, image in now.images.items():
            lens = simulator.lenses[name[: name.rfind("/") + 1]]
            self._send({ros.camera_topic(name, "camera_info"): ros.info_message(lens, optical)})
            self._send({ros.camera_topic(name): ros.image_message(image, optical)})


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
        connection = writer.add_connection(topic, name, typestore=store)

        def heard(raw: bytes) -> None:
            nonlocal now_ns
            with lock:
                if topic == ros.CLOCK:
                    clock = store.deserialize_cdr(raw, name).clock
                    now_ns = clock.sec * 10**9 + clock.nanosec
                writer.write(connection, now_ns, raw)

        node.create_subscription(kind, topic, heard, ros.qos(topic, 1000, reading=True), raw=True)

    for topic, kind in topics.items():
        add(topic, kind)
    try:
        yield
        time.sleep(_DELIVERY_S)
    finally:
        with lock:
            writer.close()


def wait_for(news: threading.Condition, ready: Callable[[], bool], stop: Stop, lacking: Callable[[], str]) -> bool:
    """Wait until it is ready (True) or `stop` returns True (False); raise `RosError` after `PATIENCE_S`."""
    until = time.monotonic() + PATIENCE_S
    with news:
        while not news.wait_for(ready, 0.05):
            if stop():
                return False
            if time.monotonic() > until:
                raise RosError(f"waited {PATIENCE_S:.0f} s: {lacking()}")
    return True
