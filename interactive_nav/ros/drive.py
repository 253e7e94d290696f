"""Connect a policy to topics."""

import functools
import math
from typing import Any

import numpy as np
from rclpy.node import Node

from interactive_nav.ros import messages as ros
from interactive_nav.ros.driving import DrivingNode
from interactive_nav.ros.nodes import Say
from interactive_nav.ros.pilot import Pilot
from interactive_nav.ros.simulator import compose


class DriveNode(DrivingNode):
    """Pass sensor measurements to a policy, and publish its velocities; without a goal the robot stands.

    It acts when the odometry is a control period newer and every needed topic has news, so time is the sensors'.
    """

    def __init__(
        self, node: Node, pilot: Pilot, silence_s: float = 1.0, button: int | None = None, say: Say = lambda _: None
    ):
        """Create its subscriptions on a node of `ros_node`; `button` of /joy must be held."""
        super().__init__(node, "policy", silence_s, say, button)
        self._pilot = pilot
        self._values: dict[str, np.ndarray] = {}
        self._used: dict[str, float] = {}  # topic -> s of its message at the last action
        self._need(ros.Odometry, ros.ODOMETRY, self._on_odometry)
        if pilot.lidar:
            self._need(ros.LaserScan, ros.SCAN, self._on_scan)
        for at, topic in enumerate((ros.MOVABLE, ros.STRUCTURE) if "collision" in pilot.inputs else ()):
            self._need(ros.Bool, topic, functools.partial(self._on_touch, at))
        for name in pilot.lenses:
            image = name.removeprefix("pixels/")
            self._need(ros.Image, ros.camera_topic(image), functools.partial(self._on_image, name))
            self._need_lens(image)
        self._subscribe(ros.PoseStamped, ros.GOAL, self._on_goal)
        self._subscribe(ros.Path, ros.PLAN, self._on_plan)
        for topic in (ros.TF, ros.TF_STATIC) if ros.TFMessage else ():
            self._subscribe(ros.TFMessage, topic, self._on_frames)

    def _complete(self) -> bool:
        if set(self._stamps) < set(self._sensors) or len(self._lenses) < len(self._pilot.lenses):
            return False
        due = self._used.get(ros.ODOMETRY, -math.inf) + 0.95 * self._pilot.period_s
        news = (math.isinf(at) or at > self._used.get(topic, -math.inf) for topic, at in self._stamps.items())
        return self._stamps[ros.ODOMETRY] >= due and all(news)

    def _decide(self) -> tuple[tuple[float, float], bool]:
        self._used, had, values = dict(self._stamps), self._pilot.goal, dict(self._values)
        for name, lens in self._pilot.lenses.items():
            image = self._seen(name.removeprefix("pixels/"), values[name], lens)
            values[name] = image / np.float32(255.0) if name.endswith("rgb") else image
        command = self._pilot.decide(values)
        if had is not None and self._pilot.goal is None:
            self._say(f"policy: reached ({had[0]:.2f}, {had[1]:.2f})")
        return command, False

    def _forget(self) -> str:
        self._used = {}
        self._pilot.aim(None)
        return f"{super()._forget()}; send the goal again"

    def _on_odometry(self, message: Any) -> None:
        self._values["pose"], self._values["velocity"] = ros.odometry_values(message)

    def _on_scan(self, message: Any) -> None:
        rays, fov_deg, range_m = (self._pilot.lidar[f"lidar_{name}"] for name in ("rays", "fov_deg", "range_m"))
        self._values["lidar"] = ros.scan_readings(message, rays, fov_deg, range_m) * range_m

    def _on_touch(self, at: int, message: Any) -> None:
        self._values.setdefault("collision", np.zeros(2))[at] = message.data

    def _on_image(self, name: str, message: Any) -> None:
        self._values[name] = ros.image_array(message, name.rpartition("/")[2])

    def _on_goal(self, message: Any) -> None:
        self._pilot.aim(self._in_map([message.pose], message.header)[0])

    def _on_plan(self, message: Any) -> None:
        plan = self._in_map([at.pose for at in message.poses], message.header)
        self._pilot.aim(plan[-1] if len(plan) else None, plan)

    def _in_map(self, poses: Any, head: Any) -> np.ndarray:
        points, frame = ros.path_points(poses, head.frame_id), self._pilot.odom_in_map
        return points if head.frame_id == ros.MAP else np.array([compose(frame, [*p, 0.0])[:2] for p in points])

    def _on_frames(self, message: Any) -> None:
        for link in message.transforms:
            if (link.header.frame_id, link.child_frame_id) == (ros.MAP, ros.ODOM):
                at = link.transform
                yaw = ros.quat_yaw(at.rotation)
                self._pilot.odom_in_map = np.array([at.translation.x, at.translation.y, yaw])
