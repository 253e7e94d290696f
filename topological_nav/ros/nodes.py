"""The simulator's and the navigator's nodes. Wiring of topics only; what is in a message is decided in `messages`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from scenes_mjcf.look import Lens
from topological_nav.ros import messages, topics
from topological_nav.ros.debian import RosError
from topological_nav.ros.drivers import Command, Driver

if TYPE_CHECKING:
    from topological_nav.ros.simulator import RosSimulator, Sensed

COMMAND_HOLDS_S = 0.5
"""A velocity command is driven for this long; then the robot stops, as mobile bases do."""
_PATIENCE_S = 180.0
"""Of waiting for other nodes, by the wall's clock."""
Asked = Callable[[], bool]
"""Whether a stop was asked for."""


@dataclasses.dataclass(frozen=True)
class Pace:
    """How simulated time runs."""

    factor: float = 1.0
    """Simulated seconds a second; 0: as fast as it goes."""
    lockstep: bool = False
    """Each picture waits for its command: nothing depends on how fast the computer is."""
    limit_s: float = 1800.0
    """Simulated seconds until the episode is over."""
    recorded: bool = False
    """Begin when every topic has somebody who listens, the picture two."""


@dataclasses.dataclass
class Tally:
    """What an episode came to, by the simulator's own truth."""

    seconds: float = 0.0
    path_m: float = 0.0
    movable_s: float = 0.0
    structure_s: float = 0.0
    done: bool = False
    """The navigator said so, within the limit."""
    end_w: tuple[float, ...] = ()
    """x, y (m), yaw (rad), world."""

    def add(self, before: Sensed, after: Sensed) -> None:
        """Counts a control step."""
        step = after.time_s - before.time_s
        self.seconds += step
        self.path_m += float(np.linalg.norm(after.truth_w[:2] - before.truth_w[:2]))
        self.movable_s += step * after.touches_movable
        self.structure_s += step * after.touches_structure
        self.end_w = tuple(round(float(v), 4) for v in after.truth_w)

    def row(self) -> dict[str, Any]:
        """As JSON holds it."""
        return {k: round(v, 4) if isinstance(v, float) else v for k, v in dataclasses.asdict(self).items()}


class SimulatorNode:
    """Publishes what the sensors tell, drives as it is told."""

    def __init__(self, ros: Any, simulator: RosSimulator, pace: Pace, tell: Callable[[str], None] = lambda _: None):
        """Announces its topics."""
        self._ros, self._simulator, self._pace, self._tell = ros, simulator, pace, tell
        self._news = threading.Condition()
        self._command, self._commands, self._done = (0.0, 0.0), 0, False
        ros.rospy.set_param("/use_sim_time", True)
        ros.rospy.init_node("simulator", disable_signals=True)
        self._out = {
            name: ros.rospy.Publisher(
                name, topics.message_class(ros, kind), queue_size=10, latch=name == topics.TF_STATIC
            )
            for name, kind in topics.FROM_ROBOT.items()
        }
        self._in = ros.rospy.Subscriber(topics.COMMAND, ros.geometry_msgs.Twist, self._on_command, tcp_nodelay=True)
        ros.rospy.Subscriber(topics.DONE, ros.std_msgs.Bool, self._on_done)

    def run(self, stop: Asked) -> Tally:
        """Simulates until the navigator is done, the limit is reached or a stop is asked for."""
        pace, tally = self._pace, Tally()
        if pace.lockstep or pace.recorded:
            self._wait_for_others(stop)
        self._send_frames()
        now = self._simulator.sense()
        held = 0.0
        due = time.perf_counter()
        while not stop():
            with self._news:
                seen = self._commands
            self._publish(now)
            if tally.seconds >= pace.limit_s - 1e-6:
                break
            if pace.lockstep:
                self._wait_for_command(seen, stop)
            elif pace.factor:
                due = max(due + self._simulator.dt_s / pace.factor, time.perf_counter() - 1.0)
                time.sleep(max(due - time.perf_counter(), 0.0))
            with self._news:
                linear, angular = self._command
                held = 0.0 if self._commands > seen else held + self._simulator.dt_s
                if self._done:
                    tally.done = True
                    break
            if held > COMMAND_HOLDS_S + 1e-6:
                linear = angular = 0.0
            before, now = now, self._simulator.step(linear, angular)
            tally.add(before, now)
            if int(now.time_s) > int(before.time_s) and int(now.time_s) % 10 == 0:
                x, y, _ = now.truth_w
                self._tell(f"simulator: {now.time_s:.0f} s of at most {pace.limit_s:.0f} s, at ({x:.2f}, {y:.2f})")
        return tally

    def _on_command(self, message: Any) -> None:
        try:
            command = messages.twist_command(message)
        except messages.MessageError as error:
            self._tell(f"simulator: {error}; the robot stops")
            command = (0.0, 0.0)
        with self._news:
            self._command, self._commands = command, self._commands + 1
            self._news.notify_all()

    def _on_done(self, message: Any) -> None:
        with self._news:
            self._done = self._done or bool(message.data)
            self._news.notify_all()

    def _wait_for_others(self, stop: Asked) -> None:
        listeners = dict.fromkeys(self._out, 1) if self._pace.recorded else {topics.HEADING: 0}
        listeners[topics.IMAGE] = 2 if self._pace.recorded else 1

        def lacking() -> list[str]:
            if self._pace.recorded:  # rosbag waits for a time
                self._out[topics.CLOCK].publish(self._ros.rosgraph_msgs.Clock(self._stamp(0.0)))
            out = [name for name, least in listeners.items() if self._out[name].get_num_connections() < least]
            return out if self._in.get_num_connections() else [*out, topics.COMMAND]

        ready, told = lambda: not lacking(), lambda: f"nobody joined {', '.join(lacking())}: is the navigator running?"
        _wait(self._news, ready, stop, told)

    def _wait_for_command(self, seen: int, stop: Asked) -> None:
        told = lambda: f"no command came on {topics.COMMAND}: has the navigator ended?"  # noqa: E731
        _wait(self._news, lambda: self._commands > seen or self._done, stop, told)

    def _send_frames(self) -> None:
        upright = messages.yaw_quat(0.0)
        optical = dict(zip("xyzw", messages.OPTICAL_QUAT, strict=True))
        links = [
            (topics.BASE, topics.LIDAR, self._simulator.lidar_pos_m, upright),
            (topics.BASE, topics.CAMERA, self._simulator.camera_pos_m, upright),
            (topics.CAMERA, topics.OPTICAL, (0.0, 0.0, 0.0), optical),
        ]
        self._send_transforms(topics.TF_STATIC, links, self._stamp(0.0))

    def _send_transforms(self, topic: str, links: list[Any], stamp: Any) -> None:
        kind = self._ros.geometry_msgs.TransformStamped
        made = [messages.set_fields(kind(), messages.transform_fields(stamp, *link)) for link in links]
        self._out[topic].publish(self._ros.tf2_msgs.TFMessage(made))

    def _stamp(self, time_s: float) -> Any:
        return self._ros.rospy.Time(*topics.time_parts(topics.EPOCH_S + time_s))

    def _publish(self, now: Sensed) -> None:
        """All of one moment; the picture last, because it is what the navigator waits for."""
        ros, simulator = self._ros, self._simulator
        stamp = self._stamp(now.time_s)
        self._out[topics.CLOCK].publish(ros.rosgraph_msgs.Clock(stamp))
        x, y, yaw = (float(v) for v in now.odometry)
        link = (topics.ODOM, topics.BASE, (x, y, 0.0), messages.yaw_quat(yaw))
        self._send_transforms(topics.TF, [link], stamp)
        self._out[topics.MOVABLE].publish(now.touches_movable)
        self._out[topics.STRUCTURE].publish(now.touches_structure)
        self._out[topics.FORCE].publish(now.force_n)
        config = simulator.config
        odometry = messages.odometry_fields(now.odometry, now.linear_b, now.angular_b)
        scanner = config.lidar_fov_deg, simulator.range_min_m, config.lidar_range_m, simulator.dt_s
        for name, frame, fields in (
            (topics.HEADING, topics.BASE, messages.imu_fields(now.heading_rad, now.angular_b)),
            (topics.ODOMETRY, topics.ODOM, {"child_frame_id": topics.BASE, **odometry}),
            (topics.SCAN, topics.LIDAR, messages.scan_fields(now.scan, *scanner)),
            (topics.INFO, topics.OPTICAL, messages.camera_info_fields(simulator.lens)),
            (topics.IMAGE, topics.OPTICAL, messages.image_fields(now.rgb)),
        ):
            fields["header"] = {"stamp": stamp, "frame_id": frame}
            self._out[name].publish(messages.set_fields(topics.message_class(ros, topics.TOPICS[name])(), fields))


class NavigatorNode:
    """Hands each picture and its heading to a driver, and publishes what it wants.

    Whether a robot or a simulator is behind the topics it does not know: time is the pictures' own.
    """

    def __init__(
        self,
        ros: Any,
        driver: Driver,
        heading_from: str = "imu",
        heading_offset_rad: float = 0.0,
        tell: Callable[[str], None] = lambda _: None,
    ):
        """Joins its topics.

        Args:
            heading_offset_rad: added to it: yaw of that sensor's frame in the map's.
        """
        self._ros, self._driver, self._offset, self._tell = ros, driver, heading_offset_rad, tell
        self._news = threading.Condition()
        self._headings, self._image, self._lens = topics.Headings(), None, None
        ros.rospy.init_node("navigator", disable_signals=True)
        self._command = ros.rospy.Publisher(topics.COMMAND, ros.geometry_msgs.Twist, queue_size=1, tcp_nodelay=True)
        self._done = ros.rospy.Publisher(topics.DONE, ros.std_msgs.Bool, queue_size=1, latch=True)
        self._heading_topic = topics.HEADING_TOPICS[heading_from]
        kind = topics.message_class(ros, topics.TOPICS[self._heading_topic])
        ros.rospy.Subscriber(self._heading_topic, kind, self._on_heading)
        ros.rospy.Subscriber(topics.INFO, ros.sensor_msgs.CameraInfo, self._on_info)
        # The buffer must hold a picture, or rospy falls behind.
        image = ros.sensor_msgs.Image
        ros.rospy.Subscriber(topics.IMAGE, image, self._on_image, queue_size=1, buff_size=2**24, tcp_nodelay=True)

    def run(self, stop: Asked) -> bool:
        """Drives until the driver is done (True) or a stop is asked for; the robot is stopped at the end."""
        last_s, told_s = -math.inf, -math.inf
        try:
            while not stop():
                message = self._take(stop)
                if message is None:
                    continue
                time_s = message.header.stamp.to_sec()
                if time_s < last_s:
                    continue
                last_s = time_s
                heading = self._heading_at(time_s, stop)
                if heading is None:
                    break
                image = messages.image_array(message)
                if self._driver.lens is not None:
                    image = messages.seen_through(image, self._fov_deg(stop), self._driver.lens)
                command = self._driver.step(image, heading, time_s)
                self._send(command)
                if time_s - told_s >= 10.0:
                    told_s = time_s
                    self._tell(
                        f"navigator: {time_s:.1f} s, heading {math.degrees(heading):.0f} degrees, "
                        f"{command.linear_mps:.2f} m/s, {command.angular_radps:.2f} rad/s"
                    )
                if command.done:
                    return True
            return False
        finally:
            self._send(Command(0.0, 0.0))

    def _send(self, command: Command) -> None:
        # What is done is told first: in lockstep the simulator goes on with the command.
        if command.done:
            self._done.publish(True)
        fields = messages.twist_fields(command.linear_mps, command.angular_radps)
        self._command.publish(messages.set_fields(self._ros.geometry_msgs.Twist(), fields))

    def _take(self, stop: Asked) -> Any:
        with self._news:
            self._news.wait_for(lambda: self._image is not None or stop(), 0.2)
            message, self._image = self._image, None
        return message

    def _heading_at(self, time_s: float, stop: Asked) -> float | None:
        """The heading when a picture was taken; waits a little for one that is not older."""
        with self._news:
            self._news.wait_for(lambda: self._headings.newest_s >= time_s - 1e-6, 0.2)
            told = f"no heading came on {self._heading_topic}"
            if not _wait(self._news, lambda: math.isfinite(self._headings.newest_s), stop, lambda: told):
                return None
            return math.remainder(self._headings.at(time_s) + self._offset, math.tau)

    def _fov_deg(self, stop: Asked) -> float:
        _wait(self._news, lambda: self._lens is not None, stop, lambda: f"no camera_info came on {topics.INFO}")
        lens = self._lens
        return lens.fov_deg if isinstance(lens, Lens) else math.nan

    def _on_image(self, message: Any) -> None:
        with self._reading(topics.IMAGE):
            self._image = message

    def _on_heading(self, message: Any) -> None:
        quat = message.orientation if self._heading_topic == topics.HEADING else message.pose.pose.orientation
        with self._reading(self._heading_topic):
            self._headings.add(message.header.stamp.to_sec(), messages.quat_yaw(quat))

    def _on_info(self, message: Any) -> None:
        with self._reading(topics.INFO):
            self._lens = messages.info_lens(message)

    @contextlib.contextmanager
    def _reading(self, topic: str) -> Iterator[None]:
        with self._news:
            try:
                yield
                self._news.notify_all()
            except messages.MessageError as error:
                self._tell(f"navigator: {topic}: {error}")


def _wait(news: threading.Condition, ready: Callable[[], bool], stop: Asked, lacking: Callable[[], str]) -> bool:
    """Waits until news make it ready (True) or a stop is asked for; an error after `_PATIENCE_S`."""
    until = time.monotonic() + _PATIENCE_S
    with news:
        while not news.wait_for(ready, 0.05):
            if stop():
                return False
            if time.monotonic() > until:
                raise RosError(f"waited {_PATIENCE_S:.0f} s: {lacking()}")
    return True
