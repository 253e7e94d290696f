"""The recorder's node: all topics into a bag."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from topological_nav.ros import topics


class RecorderNode:
    """Writes every topic of `topics.TOPICS` into a bag."""

    def __init__(self, ros: Any, path: Path):
        """Opens the bag and joins the topics."""
        self._bag = ros.rosbag.Bag(str(path), "w")
        self._lock, self._now = threading.Lock(), ros.rospy.Time(*topics.time_parts(topics.EPOCH_S))
        self._counts, self._closed = 0, False
        ros.rospy.init_node("recorder", disable_signals=True)
        for name, kind in topics.TOPICS.items():
            ros.rospy.Subscriber(name, topics.message_class(ros, kind), self._write, callback_args=name)

    def run(self, stop: Callable[[], bool]) -> int:
        """Records until a stop is asked for; returns the number of messages."""
        while not stop():
            time.sleep(0.05)
        with self._lock:
            self._bag.close()
            self._closed = True
            return self._counts

    def _write(self, message: Any, topic: str) -> None:
        with self._lock:
            if topic == topics.CLOCK:
                self._now = max(self._now, message.clock)
            header = getattr(message, "header", None)
            if not self._closed:
                self._bag.write(topic, message, header.stamp if header is not None else self._now)
                self._counts += 1
