"""Connect a driver to topics."""

import math
import time
from collections import deque
from typing import Any

import numpy as np
from rclpy.node import Node
from std_msgs.msg import Bool

from interactive_nav.ros import messages as ros
from interactive_nav.ros.driving import DrivingNode
from interactive_nav.ros.nodes import Say
from topological_nav.ros.drivers import Driver

SILENCE_S = 1.0
"""Wall-clock time without an image or a heading after which the node stops the robot."""
_HEADING_LATE_S = 0.2
"""Wall-clock time to wait for a heading no older than an image."""


class Headings:
    """Hold recent headings by time; not thread-safe."""

    def __init__(self, kept: int = 256):
        self._pairs: deque[tuple[float, float]] = deque(maxlen=kept)

    def add(self, time_s: float, yaw_rad: float) -> None:
        """Add a heading; one older than the newest drops all others (the clock was set back)."""
        if time_s < self.newest_s:
            self._pairs.clear()
        self._pairs.append((time_s, yaw_rad))

    @property
    def newest_s(self) -> float:
        """Return the time of the last heading; minus infinity without one."""
        return self._pairs[-1][0] if self._pairs else -math.inf

    def at(self, time_s: float) -> float:
        """Return the heading, rad in [-pi, pi], interpolated between two, or else the nearest one."""
        if not self._pairs:
            raise ValueError("no heading was added yet")
        times, yaws = np.array(self._pairs).T
        return math.remainder(np.interp(time_s, times, np.unwrap(yaws)), math.tau)


class NavigatorNode(DrivingNode):
    """Pass images and headings to a driver, for a robot or a simulator, and publish commands; time is the images'."""

    def __init__(
        self,
        node: Node,
        driver: Driver,
        heading_from: str = "imu",
        heading_offset_rad: float = 0.0,
        say: Say = lambda _: None,
    ):
        """Subscribe on a node of `ros_node`; the offset is the yaw of the heading's frame in the map's frame."""
        super().__init__(node, "navigator", SILENCE_S, say)
        self._driver, self._offset = driver, heading_offset_rad
        self._headings, self._image, self._said_s = Headings(), np.zeros(0), -math.inf
        self._used_s = -math.inf
        self._done = node.create_publisher(Bool, ros.DONE, ros.qos(ros.DONE))
        heading = ros.HEADING_TOPICS[heading_from]
        self._need(ros.Image, ros.IMAGE, self._on_image)
        self._need(ros.TOPICS[heading], heading, self._on_heading)
        if driver.lens is not None:
            self._need_lens("rgb")

    def _complete(self) -> bool:
        time_s = self._stamps.get(ros.IMAGE, -math.inf)
        if time_s <= self._used_s or (self._driver.lens is not None and not self._lenses):
            return False
        late = math.isfinite(self._headings.newest_s) and time.monotonic() - self._came[ros.IMAGE] > _HEADING_LATE_S
        return late or self._headings.newest_s >= time_s - 1e-6

    def _decide(self) -> tuple[tuple[float, float], bool]:
        time_s = self._used_s = self._stamps[ros.IMAGE]
        heading = math.remainder(self._headings.at(time_s) + self._offset, math.tau)
        lens = self._driver.lens
        image = self._image if lens is None else self._seen("rgb", self._image, lens)
        command = self._driver.step(image, heading, time_s)
        if time_s - self._said_s >= 10.0:
            self._said_s = time_s
            self._say(
                f"navigator: {time_s:.1f} s, heading {math.degrees(heading):.0f} degrees, "
                f"{command.linear_mps:.2f} m/s, {command.angular_radps:.2f} rad/s"
            )
        if command.done:  # before the command, with which the simulator goes on in lockstep
            self._done.publish(Bool(data=True))
        return (command.linear_mps, command.angular_radps), command.done

    def _forget(self) -> str:
        self._used_s = self._said_s = -math.inf
        return super()._forget()

    def _on_image(self, message: Any) -> None:
        self._image = ros.image_array(message)

    def _on_heading(self, message: Any) -> None:
        quat = message.orientation if isinstance(message, ros.Imu) else message.pose.pose.orientation
        self._headings.add(ros.seconds(message.header.stamp), ros.quat_yaw(quat))
