"""Settings of the simulator and of what drives: frozen dataclasses checked on construction; docstrings are the help."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from interactive_nav_common.errors import UserError
from topological_nav.settings import require


@dataclasses.dataclass(frozen=True)
class SimulatorConfig:
    """What is simulated and sensed."""

    seed: int = 0
    """Of the start, where none is given, and of sensor noise."""
    start: tuple[float, ...] = ()
    """x, y (m) and yaw (rad) in the world's frame; auto: drawn."""
    objects: int = 0
    """Small objects strewn about."""
    width: int = 128
    """Of a picture, pixels."""
    height: int = 96
    """Of a picture, pixels."""
    supersample: int = 5
    """Pictures are drawn this many times larger along each side and averaged."""
    fov_deg: float = 120.0
    """Vertical field of view of the camera."""
    engine: Literal["auto", "warp", "gl", "rays"] = "warp"
    """Who draws; rays: flat colours, unlike what networks learned from."""
    lidar_rays: int = 228
    """Beams."""
    lidar_fov_deg: float = 240.0
    """That they are spread over."""
    lidar_range_m: float = 5.6
    """Where they end."""
    lidar_noise: float = 0.0
    """Standard deviation of a distance, as a share of it."""
    odometry_noise: float = 0.0
    """Standard deviation of each step's distance and angle, as a share of them."""

    def __post_init__(self) -> None:
        require(self, "seed", 0, 2**31 - 1)
        require(self, "objects", 0, 100)
        require(self, "width height", 16, 4096)
        require(self, "supersample", 1, 16)
        require(self, "fov_deg", 1.0, 170.0)
        require(self, "lidar_rays", 1, 10**5)
        require(self, "lidar_fov_deg", 1.0, 360.0)
        require(self, "lidar_range_m", 0.1, 1000.0)
        require(self, "lidar_noise odometry_noise", 0.0, 10.0)
        if len(self.start) not in (0, 3):
            raise UserError(f"start is {list(self.start)}, expected x, y and yaw, such as start=[1.0,-0.5,0]")


@dataclasses.dataclass(frozen=True)
class HeadingConfig:
    """Turn, then drive straight ahead for a while."""

    heading_rad: float = 0.0
    """To drive along, in the map's frame."""
    linear_mps: float = 0.4
    """Along it."""
    drive_s: float = 5.0
    """For how long, once the heading is met."""
    gain: float = 2.0
    """1/s: turn for each rad of error."""
    max_angular_radps: float = 1.0
    """Of turns."""
    tolerance_rad: float = 0.1
    """The heading is met within this much."""

    def __post_init__(self) -> None:
        require(self, "heading_rad", -2 * math.pi, 2 * math.pi)
        require(self, "linear_mps", -2.0, 2.0)
        require(self, "drive_s", 0.0, 10**6)
        require(self, "gain max_angular_radps tolerance_rad", 1e-6, 100.0)
