"""Define what commands of ROS 2 nodes share."""

import contextlib
import os
import shlex
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from interactive_nav_common.errors import UserError, missing, optional
from interactive_nav_common.jobs.processes import Child, Job

_GRACE_S = 10.0
"""Time for a command to end by itself, and again after SIGTERM."""


def need_ros(program: str) -> Any:
    """Import rclpy, or say how to install it."""
    line = missing(program, "rclpy (wheels exist for Python 3.11)", "ros2")
    for module in ("sensor_msgs.msg", "nav_msgs.msg", "geometry_msgs.msg", "rosgraph_msgs.msg", "std_msgs.msg"):
        optional(module, line)
    return optional("rclpy", line)


@contextlib.contextmanager
def beside(command: str, stops: list[int]) -> Iterator[Callable[[], bool]]:
    """Run a command in a separate process; yield a function that returns whether to stop (signal or failure).

    Topics stay on this machine unless ROS_AUTOMATIC_DISCOVERY_RANGE says otherwise.
    """
    words = shlex.split(command)
    program = shutil.which("".join(words[:1]))
    if program is None:
        raise UserError(f"--run is {command!r}, expected a program that can be run, with its words")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    child = Child(Job(command, (program, *words[1:]), Path(os.devnull), env={}), {}, logged=False)
    try:
        yield lambda: bool(stops or child.poll())
        failed = child.wait(0.0 if stops else _GRACE_S)
    finally:
        child.send(signal.SIGTERM)
        child.wait(_GRACE_S)
        child.send(signal.SIGKILL)
        child.wait()  # gone before this command ends
    if failed and not stops:
        raise UserError(f"{words[0]} ended with exit code {failed}; its message is above")
