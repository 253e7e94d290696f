"""Connect a policy to topics."""

import functools
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node

from interactive_nav.ros import messages as ros
from interactive_nav.ros.nodes import PATIENCE_S, RosError, Say, Stop
from interactive_nav.ros.pilot import Pilot
from interactive_nav.ros.simulator import compose
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens


class DriveNode:
    """Hand what sensors measure to a policy, and publish its velocities.

    It acts when the odometry is a control period newer than at the last action and every needed topic has news, so that
    time is the sensors'. Without them, without a goal, or with the dead man's button released, the robot stands.
    """

    def __init__(
        self, node: Node, pilot: Pilot, silence_s: float = 1.0, button: int | None = None, say: Say = lambda _: None
    ):
        """Create its subscriptions on a node of `ros_node`; `button` of /joy must be held."""
        self._node, self._pilot, self._silence_s, self._button, self._say = node, pilot, silence_s, button, say
        self._news = threading.Condition()
        self._values: dict[str, np.ndarray] = {}
        self._lenses: dict[str, Lens] = {}
        self._stamps, self._used = {}, {}  # topic -> s
        self._mistake, self._said, self._held_s = "", "", -math.inf
        self._readers: dict[str, Callable[[Any], dict[str, Any]]] = {
            ros.ODOMETRY: lambda m: dict(zip(("pose", "velocity"), ros.odometry_values(m), strict=True))
        }
        if lidar := pilot.lidar:
            scanner = lidar["lidar_rays"], lidar["lidar_fov_deg"], lidar["lidar_range_m"]
            self._readers[ros.SCAN] = lambda m: {"lidar": ros.scan_readings(m, *scanner) * scanner[2]}
        if "collision" in pilot.inputs:
            self._readers |= {topic: functools.partial(self._touch, topic) for topic in (ros.MOVABLE, ros.STRUCTURE)}
        for name in pilot.lenses:
            image = name.removeprefix("pixels/")
            self._readers[ros.camera_topic(image)] = functools.partial(self._image, name)
            self._subscribe(ros.CameraInfo, ros.camera_topic(image, "camera_info"), functools.partial(self._info, name))
        self._came = dict.fromkeys(self._readers, time.monotonic())
        types = ros.TOPICS | {ros.camera_topic(n.removeprefix("pixels/")): ros.Image for n in pilot.lenses}
        self._sensors = [
            self._subscribe(types[topic], topic, functools.partial(self._on_sensor, topic)) for topic in self._readers
        ]
        asked = {ros.GOAL: self._on_goal, ros.PLAN: self._on_plan} | ({} if button is None else {ros.JOY: self._on_joy})
        for topic, heard in asked.items():
            self._subscribe(ros.REQUESTS[topic], topic, heard)
        for topic in (ros.TF, ros.TF_STATIC) if ros.TFMessage else ():
            self._subscribe(ros.TFMessage, topic, self._on_frames)
        self._command: Any = None

    def run(self, stop: Stop) -> None:
        """Drive until `stop` returns True; the robot is stopped at the end."""
        try:
            while not stop():
                self._join()
                with self._news:
                    self._news.wait_for(lambda: self._mistake or self._complete() or stop(), 0.05)
                    reason = self._mistake or self._silent() or self._released()
                    self._mistake = ""
                    if reason:
                        self._send((0.0, 0.0), reason)
                    elif self._complete():
                        self._used, had = dict(self._stamps), self._pilot.goal
                        self._send(self._pilot.decide(self._values))
                        if had is not None and self._pilot.goal is None:
                            self._say(f"policy: reached ({had[0]:.2f}, {had[1]:.2f})")
        finally:
            self._send((0.0, 0.0), "the node ends")

    def _join(self) -> None:
        """Publish once every sensor has a publisher; refuse to be one of two that drive."""
        if self._command is None and all(sensor.get_publisher_count() for sensor in self._sensors):
            self._command = self._node.create_publisher(ros.Twist, ros.COMMAND, ros.qos(ros.COMMAND))
        others = self._node.count_publishers(ros.COMMAND) - (self._command is not None)
        if others > 0:
            raise RosError(f"{others} other node(s) publish {ros.COMMAND}, expected none; end them")

    def _send(self, command: tuple[float, float], reason: str = "") -> None:
        if self._command and not (reason and reason == self._said):
            self._command.publish(ros.twist_message(*command))
        if reason and reason != self._said:
            self._say(f"policy: {reason}; the robot stops")
        self._said = reason

    def _complete(self) -> bool:
        if set(self._stamps) < set(self._readers):
            return False
        due = self._used.get(ros.ODOMETRY, -math.inf) + 0.95 * self._pilot.period_s
        news = (math.isinf(at) or at > self._used.get(topic, -math.inf) for topic, at in self._stamps.items())
        return self._stamps[ros.ODOMETRY] >= due and all(news)

    def _silent(self) -> str:
        waited = {topic: time.monotonic() - came for topic, came in self._came.items()}
        topic = max(waited, key=waited.__getitem__)
        if waited[topic] > PATIENCE_S:
            raise RosError(f"waited {PATIENCE_S:.0f} s: nothing came on {topic}")
        return f"nothing came on {topic} for {self._silence_s:g} s" if waited[topic] > self._silence_s else ""

    def _released(self) -> str:
        held = self._button is None or time.monotonic() - self._held_s < self._silence_s
        return "" if held else f"button {self._button} of {ros.JOY} is not held"

    def _subscribe(self, kind: Any, topic: str, read: Callable[[Any], None]) -> Any:
        def heard(message: Any) -> None:
            with self._news:
                try:
                    read(message)
                except UserError as error:
                    self._mistake = f"{topic}: {error}"
                    self._stamps.pop(topic, None)
                self._news.notify_all()

        return self._node.create_subscription(kind, topic, heard, ros.qos(topic, reading=True))

    def _on_sensor(self, topic: str, message: Any) -> None:
        # What has no stamp counts as new.
        stamp = ros.seconds(message.header.stamp) if hasattr(message, "header") else math.inf
        before = self._stamps.get(topic, -math.inf)
        self._came[topic] = time.monotonic()
        if stamp < before:
            self._pilot.aim(None)
            self._stamps, self._used = {}, {}
            raise ros.MessageError(f"time jumped back from {before:.3f} to {stamp:.3f} s; send the goal again")
        self._values |= self._readers[topic](message)
        self._stamps[topic] = stamp

    def _touch(self, topic: str, message: Any) -> dict[str, Any]:
        touched = np.array(self._values.get("collision", np.zeros(2)))
        touched[(ros.MOVABLE, ros.STRUCTURE).index(topic)] = message.data
        return {"collision": touched}

    def _info(self, name: str, message: Any) -> None:
        self._lenses[name] = ros.info_lens(message)

    def _image(self, name: str, message: Any) -> dict[str, Any]:
        kind = name.rpartition("/")[2]
        if name not in self._lenses:
            raise ros.MessageError(f"no {ros.camera_topic(name.removeprefix('pixels/'), 'camera_info')} came yet")
        image = ros.image_array(message, kind)
        image = ros.seen_through(image, self._lenses[name].fov_deg, self._pilot.lenses[name])
        return {name: image / np.float32(255.0) if kind == "rgb" else image}

    def _on_goal(self, message: Any) -> None:
        self._pilot.aim(self._in_map([message.pose], message.header)[0])

    def _on_plan(self, message: Any) -> None:
        plan = self._in_map([at.pose for at in message.poses], message.header)
        self._pilot.aim(plan[-1] if len(plan) else None, plan)

    def _in_map(self, poses: Any, head: Any) -> np.ndarray:
        points, frame = ros.path_points(poses, head.frame_id), self._pilot.odom_in_map
        return (
            points if head.frame_id == ros.MAP else np.array([compose(frame, np.array([*p, 0.0]))[:2] for p in points])
        )

    def _on_joy(self, message: Any) -> None:
        held = self._button is not None and len(message.buttons) > self._button and message.buttons[self._button]
        self._held_s = time.monotonic() if held else -math.inf

    def _on_frames(self, message: Any) -> None:
        for link in message.transforms:
            if (link.header.frame_id, link.child_frame_id) == (ros.MAP, ros.ODOM):
                at = link.transform
                yaw = ros.quat_yaw(at.rotation)
                self._pilot.odom_in_map = np.array([at.translation.x, at.translation.y, yaw])
