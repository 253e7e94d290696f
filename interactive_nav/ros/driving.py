"""Define what nodes that drive a robot share: they wait for sensors' topics, and stop the robot when one fails."""

import math
import time
from collections.abc import Callable
from threading import Condition
from typing import Any

import numpy as np
from rclpy.node import Node

from interactive_nav.ros import messages as ros
from interactive_nav.ros.nodes import PATIENCE_S, RosError, Say, Stop
from interactive_nav.sensing.base import seen_through
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens


class DrivingNode:
    """Publish velocities computed from sensor topics.

    The robot stops, with one line, while a needed topic is silent, after an unreadable message, when time jumps back,
    and while the dead man's button is released. A second publisher of velocities ends the node.
    """

    def __init__(self, node: Node, name: str, silence_s: float, say: Say, button: int | None = None):
        """Prepare a node of `ros_node`; `button` of /joy must be held."""
        self._node, self._name, self._silence_s, self._button, self._say = node, name, silence_s, button, say
        self._news = Condition()
        self._sensors: dict[str, Any] = {}  # topic -> subscription
        self._came: dict[str, float] = {}  # topic -> s of our clock
        self._stamps: dict[str, float] = {}  # topic -> s of the message's
        self._lenses: dict[str, Lens] = {}
        self._mistake, self._said, self._held_s, self._acted_s = "", "", -math.inf, -math.inf
        self._command: Any = None
        if button is not None:
            self._subscribe(ros.Joy, ros.JOY, self._on_joy)

    def run(self, stop: Stop) -> bool:
        """Drive until it is done (True) or `stop` returns True; the robot is stopped at the end."""
        try:
            while not stop():
                self._join()
                with self._news:
                    self._news.wait_for(lambda: self._mistake or self._complete() or stop(), 0.05)
                    reason = self._mistake or self._silent() or self._released()
                    self._mistake = ""
                    if reason:
                        self._send((0.0, 0.0), reason)
                    elif self._complete() and self._command and self._command.get_subscription_count():
                        command, done = self._decide()
                        self._send(command)
                        self._acted_s = time.monotonic()
                        if done:
                            return True
            return False
        finally:
            self._send((0.0, 0.0), "the node ends")

    def _complete(self) -> bool:
        """Return whether everything is there that the next command follows from."""
        raise NotImplementedError

    def _decide(self) -> tuple[tuple[float, float], bool]:
        """Return the next command, m/s and rad/s, and whether it is the last one."""
        raise NotImplementedError

    def _forget(self) -> str:
        """Forget what does not hold after time has jumped back; return what the user should do about it."""
        self._stamps = {}
        return ""

    def _need(self, kind: Any, topic: str, read: Callable[[Any], None]) -> None:
        """Subscribe to a topic without which the robot stands."""

        def heard(message: Any) -> None:
            # What has no stamp counts as new.
            stamp = ros.seconds(message.header.stamp) if hasattr(message, "header") else math.inf
            before = self._stamps.get(topic, -math.inf)
            self._came[topic] = time.monotonic()
            if stamp < before:
                raise ros.MessageError(f"time jumped back from {before:.3f} to {stamp:.3f} s{self._forget()}")
            read(message)
            self._stamps[topic] = stamp

        self._came[topic] = time.monotonic()
        self._sensors[topic] = self._subscribe(kind, topic, heard)

    def _need_lens(self, image: str) -> None:
        """Wait for the camera_info of an image, such as `left/depth`."""
        topic = ros.camera_topic(image, "camera_info")

        def heard(message: Any) -> None:
            self._lenses[image] = ros.info_lens(message)
            self._came[topic] = math.inf  # one is enough

        self._came[topic] = time.monotonic()
        self._subscribe(ros.CameraInfo, topic, heard)

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

    def _seen(self, image: str, pixels: np.ndarray, lens: Lens) -> np.ndarray:
        """Return what a lens would show of an image, whose camera_info has come."""
        return seen_through(pixels, self._lenses[image].fov_deg, lens)

    def _join(self) -> None:
        """Publish once every sensor has a publisher; refuse to be one of two that drive."""
        if self._command is None and all(sensor.get_publisher_count() for sensor in self._sensors.values()):
            self._command = self._node.create_publisher(ros.Twist, ros.COMMAND, ros.qos(ros.COMMAND))
        others = self._node.count_publishers(ros.COMMAND) - (self._command is not None)
        if others > 0:
            raise RosError(f"{others} other node(s) publish {ros.COMMAND}, expected none; end them")

    def _send(self, command: tuple[float, float], reason: str = "") -> None:
        # A robot that was never commanded needs no stop, and a simulator in lockstep would take it for an answer.
        if self._command and not (reason and (reason == self._said or self._acted_s == -math.inf)):
            self._command.publish(ros.twist_message(*command))
        if reason and reason != self._said:
            self._say(f"{self._name}: {reason}; the robot stops")
        self._said = reason

    def _silent(self) -> str:
        # Nobody is blamed for the time that our decision took: in lockstep all wait for it.
        now = time.monotonic()
        waited = {topic: now - max(came, self._acted_s) for topic, came in self._came.items()}
        topic = max(waited, key=waited.__getitem__)
        if waited[topic] > PATIENCE_S:
            raise RosError(f"waited {PATIENCE_S:.0f} s: nothing came on {topic}")
        return f"nothing came on {topic} for {self._silence_s:g} s" if waited[topic] > self._silence_s else ""

    def _released(self) -> str:
        held = self._button is None or time.monotonic() - self._held_s < self._silence_s
        return "" if held else f"button {self._button} of {ros.JOY} is not held"

    def _on_joy(self, message: Any) -> None:
        held = self._button is not None and len(message.buttons) > self._button and message.buttons[self._button]
        self._held_s = time.monotonic() if held else -math.inf
