"""Where ROS comes in: Debian's Python packages, made visible to this interpreter.

Debian keeps them in /usr/lib/python3/dist-packages, which a virtual environment does not look into. The folder goes to
the end of `sys.path`, so that everything the environment has itself comes first, and only in the processes of
`topological_nav.ros`. Where rospy can be imported anyway (a sourced ROS workspace), nothing is changed.
"""

import importlib.util
import os
import sys
import types
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from interactive_nav_common.errors import UserError, optional

DIST_PACKAGES = Path("/usr/lib/python3/dist-packages")
PACKAGES = (
    "ros-core python3-rospy python3-std-msgs python3-sensor-msgs "
    "python3-geometry-msgs python3-nav-msgs python3-rosgraph-msgs python3-tf2-msgs"
)
"""Of Debian 12 and later."""
_MODULES = (
    *("rospy", "rosgraph"),
    *(f"{name}.msg" for name in ("std_msgs", "sensor_msgs", "geometry_msgs", "nav_msgs", "rosgraph_msgs", "tf2_msgs")),
)


class RosError(UserError):
    """ROS is not there, or its master is not."""


def load() -> types.SimpleNamespace:
    """The modules of ROS by their first names, messages as `std_msgs.Bool` and so on.

    Where the master is on loopback, this process and its children stay there too, unless ROS_IP or ROS_HOSTNAME is set.
    """
    if importlib.util.find_spec("rospy") is None and str(DIST_PACKAGES) not in sys.path:
        sys.path.append(str(DIST_PACKAGES))
    if urlsplit(_master()).hostname in ("localhost", "127.0.0.1", "::1") and "ROS_HOSTNAME" not in os.environ:
        os.environ.setdefault("ROS_IP", "127.0.0.1")
    line = f"ROS is not installed here; on Debian 12: apt-get install --no-install-recommends {PACKAGES}"
    return types.SimpleNamespace(**{name.split(".")[0]: optional(name, line, RosError) for name in _MODULES})


def need_master(ros: Any) -> None:
    """Raises RosError unless a master is there."""
    if not ros.rosgraph.is_master_online():
        raise RosError(f"no master answers at {_master()}; start one (roscore), or set ROS_MASTER_URI")


def _master() -> str:
    return os.environ.get("ROS_MASTER_URI") or "http://localhost:11311"
