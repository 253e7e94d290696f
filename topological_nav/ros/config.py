"""Define the settings of the simulator and of driver `heading`, checked on construction; docstrings are the help."""

import dataclasses
import math
from typing import Annotated, Literal

from interactive_nav_common.config import Bounds, Settings
from interactive_nav_common.errors import UserError


@dataclasses.dataclass(frozen=True)
class SimulatorConfig(Settings):
    """Set what is simulated and sensed."""

    seed: Annotated[int, Bounds(0, 2**31 - 1)] = 0
    """Of the start, where none is given, and of sensor noise."""
    start: tuple[float, ...] = ()
    """x, y (m) and yaw (rad) in the world's frame; auto: drawn."""
    objects: Annotated[int, Bounds(0, 100)] = 0
    """Small objects strewn about."""
    width: Annotated[int, Bounds(16, 4096)] = 128
    """Of a picture, pixels."""
    height: Annotated[int, Bounds(16, 4096)] = 96
    """Of a picture, pixels."""
    supersample: Annotated[int, Bounds(1, 16)] = 5
    """Pictures are drawn this many times larger along each side and averaged."""
    fov_deg: Annotated[float, Bounds(1.0, 170.0)] = 120.0
    """Vertical field of view of the camera."""
    engine: Literal["auto", "warp", "gl", "rays"] = "warp"
    """Who draws; rays: flat colours, unlike what networks learned from."""
    lidar_rays: Annotated[int, Bounds(1, 10**5)] = 228
    """Beams."""
    lidar_fov_deg: Annotated[float, Bounds(1.0, 360.0)] = 240.0
    """That they are spread over."""
    lidar_range_m: Annotated[float, Bounds(0.1, 1000.0)] = 5.6
    """Where they end."""
    lidar_noise: Annotated[float, Bounds(0.0, 10.0)] = 0.0
    """Standard deviation of a distance, as a share of it."""
    odometry_noise: Annotated[float, Bounds(0.0, 10.0)] = 0.0
    """Standard deviation of each step's distance and angle, as a share of them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.start) not in (0, 3):
            raise UserError(f"start is {list(self.start)}, expected x, y and yaw, such as start=[1.0,-0.5,0]")


@dataclasses.dataclass(frozen=True)
class HeadingConfig(Settings):
    """Turn, then drive straight ahead for a while."""

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
