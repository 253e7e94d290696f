"""Nodes stay on loopback, as those of the navigator."""

from tests.topological_nav.ros.conftest import *  # noqa: F403
