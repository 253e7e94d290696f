"""Names, types and frames of all that goes over topics: one table for nodes, recorder and tests."""

import math
from collections import deque
from typing import Any

import numpy as np

CLOCK, COMMAND, DONE = "/clock", "/cmd_vel", "/navigator/done"
IMAGE, INFO = "/camera/image_raw", "/camera/camera_info"
SCAN, ODOMETRY, HEADING = "/scan", "/odom", "/imu/data"
MOVABLE, STRUCTURE, FORCE = "/contacts/movable", "/contacts/structure", "/contacts/force"
TF, TF_STATIC = "/tf", "/tf_static"

FROM_ROBOT = {
    CLOCK: "rosgraph_msgs/Clock",
    IMAGE: "sensor_msgs/Image",
    INFO: "sensor_msgs/CameraInfo",
    SCAN: "sensor_msgs/LaserScan",
    ODOMETRY: "nav_msgs/Odometry",
    HEADING: "sensor_msgs/Imu",
    MOVABLE: "std_msgs/Bool",
    STRUCTURE: "std_msgs/Bool",
    FORCE: "std_msgs/Float32",
    TF: "tf2_msgs/TFMessage",
    TF_STATIC: "tf2_msgs/TFMessage",
}
"""What the simulator publishes, a robot likewise (the clock aside)."""
TO_ROBOT = {COMMAND: "geometry_msgs/Twist", DONE: "std_msgs/Bool"}
TOPICS = {**FROM_ROBOT, **TO_ROBOT}
"""Topic -> message type."""
HEADING_TOPICS = {"imu": HEADING, "odom": ODOMETRY}
"""Where the navigator's heading may come from."""

ODOM, BASE, LIDAR, CAMERA, OPTICAL = "odom", "base_link", "lidar_link", "camera_link", "camera_optical_frame"
"""Frames, by REP-105 and REP-103."""


EPOCH_S = 1.0
"""The simulated clock's first time: ROS takes 0 as 'not set'."""


def time_parts(time_s: float) -> tuple[int, int]:
    """Seconds and nanoseconds of a ROS time; to the nearest microsecond, so that sums of 0.1 s stay round."""
    micro = round(time_s * 1e6)
    return micro // 10**6, micro % 10**6 * 1000


def message_class(ros: Any, kind: str) -> Any:
    """The class of a message type such as std_msgs/Bool, among the modules of `debian.load`."""
    package, _, name = kind.partition("/")
    return getattr(getattr(ros, package), name)


class Headings:
    """Headings of the last while, asked by time; not safe for several threads at once."""

    def __init__(self, kept: int = 256):
        self._told: deque[tuple[float, float]] = deque(maxlen=kept)

    def add(self, time_s: float, yaw_rad: float) -> None:
        """Tells a heading; one that is older than the newest begins anew (a clock that was set back)."""
        if time_s < self.newest_s:
            self._told.clear()
        self._told.append((time_s, yaw_rad))

    @property
    def newest_s(self) -> float:
        """Time of the last heading; minus infinity before the first."""
        return self._told[-1][0] if self._told else -math.inf

    def at(self, time_s: float) -> float:
        """Heading, rad in [-pi, pi]: turned evenly between two tellings, else the nearest one."""
        if not self._told:
            raise ValueError("no heading was told yet")
        times, yaws = np.array(self._told).T
        return math.remainder(np.interp(time_s, times, np.unwrap(yaws)), math.tau)
