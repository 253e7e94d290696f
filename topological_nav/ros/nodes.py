"""Connect a driver to topics."""

import functools
import math
import threading
import time
from collections import deque
from typing import Any

import numpy as np
from rclpy.node import Node
from std_msgs.msg import Bool

from interactive_nav.ros import messages as ros
from interactive_nav.ros.nodes import PATIENCE_S, RosError, Say, Stop, wait_for
from scenes_mjcf.look import Lens
from topological_nav.ros.drivers import Driver, VelocityCommand

LOST_S = 1.0
"""Wall-clock time without a picture after which the navigator stops the robot."""


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
                    if silent_s > PATIENCE_S:
                        raise RosError(f"waited {PATIENCE_S:.0f} s: no picture came on {ros.IMAGE}")
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
            if not wait_for(self._news, lambda: math.isfinite(self._headings.newest_s), stop, lambda: lacking):
                return None
            return math.remainder(self._headings.at(time_s) + self._offset, math.tau)

    def _fov_deg(self, stop: Stop) -> float:
        wait_for(self._news, lambda: self._lens is not None, stop, lambda: f"no camera_info came on {ros.INFO}")
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
