"""Define the settings of the robot's cameras: where they look, and their errors."""

import dataclasses
from typing import Annotated, Any

from interactive_nav_common.config import Bounds, NotNegative, Settings, Share
from interactive_nav_common.errors import ConfigError

ImageSide = Annotated[int, Bounds(32, 512)]
FovDeg = Annotated[float | None, Bounds(0, 180, open=True)]


@dataclasses.dataclass(frozen=True)
class CameraView(Settings):
    """One of several cameras; it sits where the robot's camera does, and what it does not say is as there."""

    name: str = ""
    """Its images have the keys `pixels/<name>/...`."""
    yaw_deg: float = 0.0
    """It looks so far to the left of its body's x axis."""
    pitch_deg: float | None = None
    """Positive looks down."""
    pos_m: tuple[float, float, float] | None = None
    """In the frame of the body that carries it."""
    fov_deg: FovDeg = None
    """Vertical; none: `image_fov_deg`."""
    size: ImageSide | None = None
    """Side of its square images, pixels; none: `image_size`."""


@dataclasses.dataclass(frozen=True)
class CameraNoise(Settings):
    """Errors of cameras, drawn in each step; 0: none. Formulas and sources: `docs/sensors.md`."""

    rgb_exposure: NotNegative = 0.0
    """Standard deviation of a frame's exposure, stops: its colours times 2 to that power, cut at 1."""
    rgb_blur_px: Annotated[float, Bounds(0, 16)] = 0.0
    """Standard deviation of a Gaussian blur, pixels."""
    rgb_noise: NotNegative = 0.0
    """Standard deviation of each colour of a pixel whatever it reads (read noise), of 1."""
    rgb_shot_noise: NotNegative = 0.0
    """Standard deviation at full brightness of the error that grows with the root of brightness (shot noise), of 1."""
    rgb_dropout: Share = 0.0
    """Share of pixels whose colour reads 0."""
    depth_disparity_noise: NotNegative = 0.0
    """Standard deviation of 1 / depth, 1/m: that of depth is this times its square (a Kinect's: 0.0014)."""
    depth_disparity_step: NotNegative = 0.0
    """Steps that 1 / depth is read in, 1/m (a Kinect's: 0.0028)."""
    depth_grazing_deg: Annotated[float, Bounds(0, 90)] = 0.0
    """Depth reads 0 on surfaces viewed at less than this angle to them."""
    depth_edge_m: NotNegative = 0.0
    """Depth reads 0 where a pixel beside is nearer by more than this."""
    depth_min_m: NotNegative = 0.0
    """Nearer surfaces read 0."""
    depth_max_m: NotNegative = 0.0
    """Farther surfaces read 0; 0: no limit."""
    frame_dropout: Share = 0.0
    """Share of a camera's frames that are lost: all its images are 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.depth_max_m <= self.depth_min_m:
            raise ConfigError(f"depth_max_m is {self.depth_max_m}, expected more than depth_min_m ({self.depth_min_m})")


KINECT: dict[str, Any] = {
    "depth_disparity_noise": 0.0014,
    "depth_disparity_step": 0.0028,
    "depth_grazing_deg": 10.0,
    "depth_edge_m": 0.1,
    "depth_min_m": 0.5,
    "depth_max_m": 5.0,
}
"""Settings of `CameraNoise` like the first Kinect (Khoshelham and Elberink 2012)."""
