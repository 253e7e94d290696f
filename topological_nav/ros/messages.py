"""Arrays in, fields of ROS messages out, and back: pure, and without ROS.

Units are SI and frames right-handed as REP-103 has them: x ahead, y left, z up; a camera's optical frame has z ahead, x
right, y down. `*_fields` return nested dicts of a message's fields (a header's aside), which `set_fields` writes into
any object with such attributes.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image as Pillow

from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens

RGB = "rgb8"
_ORDER = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0)}
"""Encodings that can be read -> where red, green and blue are."""
OPTICAL_QUAT = (-0.5, 0.5, -0.5, 0.5)
"""x y z w: a camera's optical frame in the frame that looks along its x axis."""


class MessageError(UserError):
    """A message that cannot be read."""


def set_fields(message: Any, fields: Mapping[str, Any]) -> Any:
    """Writes nested fields into a message, and returns it."""
    for name, value in fields.items():
        if isinstance(value, Mapping):
            set_fields(getattr(message, name), value)
        else:
            getattr(message, name)
            setattr(message, name, value)
    return message


def image_fields(rgb: np.ndarray) -> dict[str, Any]:
    """sensor_msgs/Image of a picture [H, W, 3] u8."""
    height, width, channels = rgb.shape
    assert channels == 3 and rgb.dtype == np.uint8
    return {
        "height": height,
        "width": width,
        "encoding": RGB,
        "is_bigendian": 0,
        "step": 3 * width,
        "data": rgb.tobytes(),
    }


def image_array(message: Any) -> np.ndarray:
    """[H, W, 3] u8 RGB of a sensor_msgs/Image; rows may be padded."""
    order = _ORDER.get(message.encoding)
    if order is None:
        raise MessageError(f"image encoding is '{message.encoding}', expected one of {', '.join(_ORDER)}")
    channels = 4 if "a" in message.encoding else 3
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(bytes(message.data), np.uint8)
    if step < channels * width or len(data) != step * height:
        raise MessageError(
            f"image of {width} x {height} ({message.encoding}) has {len(data)} bytes in rows of {step}, "
            f"expected {channels * width * height} in rows of {channels * width} or padded ones"
        )
    rows = data.reshape(height, step)[:, : channels * width]
    return np.ascontiguousarray(rows.reshape(height, width, channels)[..., list(order)])


def camera_info_fields(lens: Lens) -> dict[str, Any]:
    """sensor_msgs/CameraInfo of a pinhole camera: no distortion; pixel centres are at whole numbers, as in OpenCV."""
    focal, cx, cy = 1.0 / lens.pixel, (lens.width - 1) / 2, (lens.height - 1) / 2
    return {
        "height": lens.height,
        "width": lens.width,
        "distortion_model": "plumb_bob",
        "D": [0.0] * 5,
        "K": [focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0],
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [focal, 0.0, cx, 0.0, 0.0, focal, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }


def info_lens(message: Any) -> Lens:
    """The pinhole lens of a sensor_msgs/CameraInfo, its centre and its pixels' shape taken as ideal."""
    fx, fy = message.K[0], message.K[4]
    if not fy > 0:
        raise MessageError("camera_info has no focal length (K[4] is 0), expected a calibrated camera")
    if abs(fx / fy - 1) > 0.02:
        raise MessageError(f"camera_info has focal lengths {fx:.1f} and {fy:.1f}, expected square pixels")
    if any(abs(d) > 1e-9 for d in message.D):
        raise MessageError("camera_info tells of distortion; subscribe to a rectified image (image_proc: image_rect)")
    return Lens(message.width, message.height, math.degrees(2 * math.atan(message.height / 2 / fy)))


def seen_through(rgb: np.ndarray, fov_deg: float, lens: Lens) -> np.ndarray:
    """Return what a narrower or coarser pinhole lens on the same axis would have seen of a picture [H, W, 3] u8.

    It is [h, w, 3] u8: the middle of the picture, averaged over each wanted pixel.
    """
    height, width, _ = rgb.shape
    have = Lens(width, height, fov_deg)
    # Of the picture's pixels: what the wanted lens covers.
    rows = 2 * lens.half_height / have.pixel
    columns = rows * lens.width / lens.height
    if rows > height * 1.001 or columns > width * 1.001:
        raise MessageError(
            f"the camera's picture of {width} x {height} spans {fov_deg:.1f} degrees in height, the networks learned "
            f"from {lens.width} x {lens.height} that span {lens.fov_deg:.1f}: use a wider lens, or train with fov_deg"
        )
    rows, columns = min(rows, height), min(columns, width)
    box = ((width - columns) / 2, (height - rows) / 2, (width + columns) / 2, (height + rows) / 2)
    small = Pillow.fromarray(rgb).resize((lens.width, lens.height), Pillow.Resampling.BOX, box=box)
    return np.asarray(small)


def scan_fields(
    readings: np.ndarray, fov_deg: float, range_min_m: float, range_max_m: float, period_s: float
) -> dict[str, Any]:
    """Return the sensor_msgs/LaserScan of the lidar of `interactive_nav.sensing.sensors`.

    Readings [n] in [0, 1] are distances over `range_max_m`, 1 where nothing is nearer, from right to left; the
    message's ranges are in m, positive infinity where nothing was met (REP-117).
    """
    step = math.radians(fov_deg) / len(readings)
    first = -math.radians(fov_deg) / 2
    ranges = np.where(readings < 1.0, np.asarray(readings, np.float64) * range_max_m, np.inf)
    return {
        "angle_min": first,
        "angle_max": first + (len(readings) - 1) * step,
        "angle_increment": step,
        "time_increment": 0.0,
        "scan_time": period_s,
        "range_min": range_min_m,
        "range_max": range_max_m,
        "ranges": ranges.tolist(),
        "intensities": [],
    }


def yaw_quat(yaw_rad: float) -> dict[str, float]:
    """geometry_msgs/Quaternion of a turn about z."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw_rad / 2), "w": math.cos(yaw_rad / 2)}


def quat_yaw(quat: Any) -> float:
    """Yaw, rad in [-pi, pi], of a geometry_msgs/Quaternion of any length but 0."""
    x, y, z, w = quat.x, quat.y, quat.z, quat.w
    norm = x * x + y * y + z * z + w * w
    if not norm > 1e-12:
        raise MessageError("orientation is the zero quaternion: the sensor tells no heading")
    return math.atan2(2 * (w * z + x * y), norm - 2 * (y * y + z * z))


def odometry_fields(pose: np.ndarray, linear_b: np.ndarray, angular_b: np.ndarray) -> dict[str, Any]:
    """Return the nav_msgs/Odometry of a pose, x, y (m) and yaw (rad) in the frame of the start.

    Velocities (3,), m/s and rad/s, are in the robot's frame, the message's child frame.
    """
    x, y, yaw = (float(v) for v in pose)
    return {
        "pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": yaw_quat(yaw)}},
        "twist": {"twist": {"linear": _vector(linear_b), "angular": _vector(angular_b)}},
    }


def imu_fields(yaw_rad: float, angular_b: np.ndarray) -> dict[str, Any]:
    """sensor_msgs/Imu that tells the heading in the world's frame and the turn; accelerations are marked as unknown."""
    return {
        "orientation": yaw_quat(yaw_rad),
        "angular_velocity": _vector(angular_b),
        "linear_acceleration_covariance": [-1.0] + [0.0] * 8,
    }


def twist_fields(linear_mps: float, angular_radps: float) -> dict[str, Any]:
    """geometry_msgs/Twist of a velocity along x and a turn about z."""
    return {"linear": {"x": float(linear_mps)}, "angular": {"z": float(angular_radps)}}


def twist_command(message: Any) -> tuple[float, float]:
    """(m/s ahead, rad/s to the left) of a geometry_msgs/Twist; the rest a robot on wheels cannot do."""
    command = float(message.linear.x), float(message.angular.z)
    if not all(map(math.isfinite, command)):
        raise MessageError(f"velocity command is {command}, expected finite numbers")
    return command


def transform_fields(
    stamp: Any, parent: str, child: str, pos_m: tuple[float, float, float], quat: Mapping[str, float]
) -> dict[str, Any]:
    """geometry_msgs/TransformStamped: where the child's frame is in the parent's."""
    return {
        "header": {"stamp": stamp, "frame_id": parent},
        "child_frame_id": child,
        "transform": {"translation": _vector(np.asarray(pos_m)), "rotation": dict(quat)},
    }


def _vector(values: np.ndarray) -> dict[str, float]:
    return {name: float(v) for name, v in zip("xyz", values, strict=True)}
