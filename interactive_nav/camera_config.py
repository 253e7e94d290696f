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
    """Name of the camera: its images have the keys `pixels/<name>/...`."""
    body: str = ""
    """Body of the robot that carries it, such as fetch_gripper (then give pos_m); empty: its camera's."""
    yaw_deg: float = 0.0
    """Angle to the left of its body's x axis, in degrees."""
    pitch_deg: float | None = None
    """Angle below the horizontal in degrees; auto: the robot's camera's."""
    pos_m: tuple[float, float, float] | None = None
    """Position in the frame of the body that carries it, in m; auto: the robot's camera's."""
    fov_deg: FovDeg = None
    """Vertical field of view in degrees; auto: `image_fov_deg`."""
    size: ImageSide | None = None
    """Side of its square images in pixels; auto: `image_size`."""


@dataclasses.dataclass(frozen=True)
class CameraNoise(Settings):
    """Errors of cameras, drawn in each step; 0: none. Formulas and sources: `docs/sensors.md`."""

    rgb_exposure: NotNegative = 0.0
    """Standard deviation of a frame's exposure in stops: colours are multiplied by 2 to that power and cut at 1."""
    rgb_blur_px: Annotated[float, Bounds(0, 16)] = 0.0
    """Standard deviation of a Gaussian blur in pixels."""
    rgb_noise: NotNegative = 0.0
    """Standard deviation of a pixel's colours (0 to 1) at any brightness (read noise)."""
    rgb_shot_noise: NotNegative = 0.0
    """Standard deviation of a pixel's colours (0 to 1) at full brightness; it grows with the root of brightness."""
    rgb_dropout: Share = 0.0
    """Share of pixels whose colour reads 0."""
    depth_disparity_noise: NotNegative = 0.0
    """Standard deviation of 1 / depth in 1/m: that of depth is this times its square (0.0014: a Kinect's)."""
    depth_disparity_step: NotNegative = 0.0
    """Step in which 1 / depth is read, in 1/m (0.0028: a Kinect's)."""
    depth_grazing_deg: Annotated[float, Bounds(0, 90)] = 0.0
    """Least angle in degrees between a surface and the line of sight; at smaller ones depth reads 0."""
    depth_edge_m: NotNegative = 0.0
    """Difference of depth in m to a nearer pixel beside, from which depth reads 0."""
    depth_min_m: NotNegative = 0.0
    """Least depth in m; nearer surfaces read 0."""
    depth_max_m: NotNegative = 0.0
    """Largest depth in m; farther surfaces read 0; 0: no limit."""
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
