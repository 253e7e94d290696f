"""Connect a driver to topics."""

import math
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from rclpy.node import Node
from std_msgs.msg import Bool

from interactive_nav.ros import messages as ros
from interactive_nav.ros.driving import DrivingNode
from interactive_nav.ros.nodes import Say
from topological_nav.ros.drivers import PilotDriver

SILENCE_S = 1.0
"""Wall-clock time without an image or a heading after which the node stops the robot."""
_HEADING_LATE_S = 0.2
"""Wall-clock time to wait for a heading no older than an image."""


def heading_at(headings: Sequence[tuple[float, float]], time_s: float) -> float:
    """Return the heading, rad in [-pi, pi], at a time: between two of (s, rad) in order, or else the nearest one."""
    times, yaws = np.array(headings).T
    return math.remainder(np.interp(time_s, times, np.unwrap(yaws)), math.tau)


class NavigatorNode(DrivingNode):
    """Pass images and headings to a driver, for a robot or a simulator, and publish commands; time is the images'."""

    def __init__(
        self,
        node: Node,
        driver: PilotDriver,
        heading_from: str = "imu",
        heading_offset_rad: float = 0.0,
        say: Say = lambda _: None,
    ):
        """Subscribe on a node of `ros_node`; the offset is the yaw of the heading's frame in the map's frame."""
        super().__init__(node, "navigator", SILENCE_S, say)
        self._driver, self._offset = driver, heading_offset_rad
        self._headings: deque[tuple[float, float]] = deque(maxlen=256)  # s of the message, rad
        self._image, self._said_s = np.zeros(0), -math.inf
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
        late = time.monotonic() - self._came[ros.IMAGE] > _HEADING_LATE_S
        return bool(self._headings) and (late or self._headings[-1][0] >= time_s - 1e-6)

    def _decide(self) -> tuple[tuple[float, float], bool]:
        time_s = self._used_s = self._stamps[ros.IMAGE]
        heading = math.remainder(heading_at(self._headings, time_s) + self._offset, math.tau)
        lens = self._driver.lens
        image = self._image if lens is None else self._seen("rgb", self._image, lens)
        (linear, angular), done = self._driver.step(image, heading, time_s)
        if time_s - self._said_s >= 10.0:
            self._said_s = time_s
            self._say(
                f"navigator: {time_s:.1f} s, heading {math.degrees(heading):.0f} degrees, "
                f"{linear:.2f} m/s, {angular:.2f} rad/s"
            )
        if done:  # before the command, with which the simulator goes on in lockstep
            self._done.publish(Bool(data=True))
        return (linear, angular), done

    def _forget(self) -> str:
        self._used_s = self._said_s = -math.inf
        self._headings.clear()
        return super()._forget()

    def _on_image(self, message: Any) -> None:
        self._image = ros.image_array(message)

    def _on_heading(self, message: Any) -> None:
        quat = message.orientation if isinstance(message, ros.Imu) else message.pose.pose.orientation
        self._headings.append((ros.seconds(message.header.stamp), ros.quat_yaw(quat)))
