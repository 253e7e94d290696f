"""Run the navigator as a ROS 2 node: `pip install 'interactive-nav[ros2]'`; see `docs/ros.md`."""

import dataclasses
import math
from typing import Annotated

from interactive_nav_common.config import Bounds, Settings


@dataclasses.dataclass(frozen=True)
class HeadingConfig(Settings):
    """Set how driver `heading` of the ROS 2 node turns, then drives straight ahead for a while."""

    heading_rad: Annotated[float, Bounds(-2 * math.pi, 2 * math.pi)] = 0.0
    """To drive along, in the map's frame."""
    linear_mps: Annotated[float, Bounds(-2.0, 2.0)] = 0.4
    """Along it."""
    drive_s: Annotated[float, Bounds(0.0, 10**6)] = 5.0
    """For how long, once the heading is met."""
    gain: Annotated[float, Bounds(1e-6, 100.0)] = 2.0
    """1/s: turn for each rad of error."""
    max_angular_radps: Annotated[float, Bounds(1e-6, 100.0)] = 1.0
    """Of turns."""
    tolerance_rad: Annotated[float, Bounds(1e-6, 100.0)] = 0.1
    """The heading is met within this much."""
