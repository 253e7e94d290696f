"""Keep each test process's nodes on loopback and in a DDS domain of their own; skip where ROS 2 has no wheels."""

import os

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed (wheels exist for Python 3.11)")
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
