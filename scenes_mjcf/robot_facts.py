"""State facts of robots for code that does not load their models, to which a test holds them."""

from typing import NamedTuple


class RobotFacts(NamedTuple):
    """Facts of one robot."""

    radius_m: float
    """Smallest disc about the base frame that holds the body."""
    height_m: float
    """Top of the body above the floor."""
    title: str = ""
    """The name as papers write it; empty: as commands do."""
    lidar_b: tuple[float, float, float] | None = None
    """Scanner that drives are recorded with, m in the base's frame; None: there are no drives with it."""


ROBOTS = {
    "turtlebot": RobotFacts(0.18, 0.41, "TurtleBot"),
    "fetch": RobotFacts(0.31, 1.12, "Fetch"),
    "ttbot": RobotFacts(0.33, 1.1, lidar_b=(0.17, 0.0, 0.36)),
}
SMALLEST = ROBOTS["turtlebot"]
"""The wheeled robot that fits through the narrowest gaps."""


def title(robot: str) -> str:
    """Return a robot's name as papers write it, or nothing where that is not known."""
    return ROBOTS[robot].title if robot in ROBOTS else ""
