"""Convert arrays to ROS 2 messages and back; name the topics, their types and the frames.

Units are SI and frames right-handed as in REP 103: x forward, y left, z up; in a camera's optical frame z points
forward, x right, y down. Frames are named as in REP 105, topics as in Nav2.
"""

import array
import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseWithCovariance,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from nav_msgs.msg import Odometry
from PIL import Image as Pillow
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu, LaserScan
from std_msgs.msg import Bool, Float32, Header

from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens

try:  # PyPI lacks it; a sourced ROS 2 workspace has it
    from tf2_msgs.msg import TFMessage  # pyright: ignore[reportMissingImports]
except ImportError:
    TFMessage = None

CLOCK, COMMAND, DONE = "/clock", "/cmd_vel", "/navigator/done"
IMAGE, INFO = "/camera/image_raw", "/camera/camera_info"
SCAN, ODOMETRY, HEADING = "/scan", "/odom", "/imu/data"
MOVABLE, STRUCTURE, FORCE = "/contacts/movable", "/contacts/structure", "/contacts/force"
TF, TF_STATIC = "/tf", "/tf_static"
FROM_ROBOT: dict[str, Any] = {
    **{CLOCK: Clock, IMAGE: Image, INFO: CameraInfo, SCAN: LaserScan, ODOMETRY: Odometry, HEADING: Imu},
    **{MOVABLE: Bool, STRUCTURE: Bool, FORCE: Float32},
    **({} if TFMessage is None else {TF: TFMessage, TF_STATIC: TFMessage}),
}
"""Topics that the simulator publishes, and their types; a robot publishes the same apart from the clock."""
TOPICS = {**FROM_ROBOT, COMMAND: Twist, DONE: Bool}
HEADING_TOPICS = {"imu": HEADING, "odom": ODOMETRY}
"""Where the navigator's heading may come from."""
LATCHED = (TF_STATIC, DONE)
ODOM, BASE, LIDAR, CAMERA, OPTICAL = "odom", "base_link", "lidar_link", "camera_link", "camera_optical_frame"
EPOCH_S = 1.0
"""First time of the simulated clock: ROS takes 0 as "not set"."""
_ORDER = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0)}
"""Readable encodings -> the channels of red, green and blue."""
OPTICAL_QUAT = Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5)
"""A camera's optical frame in the frame that looks along its x axis."""


class MessageError(UserError):
    """Report a message that cannot be read."""


def qos(topic: str, depth: int = 10, reading: bool = False) -> QoSProfile:
    """Return how a topic is published, or read: from best-effort publishers, too."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.BEST_AVAILABLE if reading else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic in LATCHED else DurabilityPolicy.VOLATILE,
    )


def stamp(time_s: float) -> Time:
    """Return a simulated time to the nearest microsecond, so that sums of 0.1 s stay round."""
    microseconds = round((EPOCH_S + time_s) * 1e6)
    return Time(sec=microseconds // 10**6, nanosec=microseconds % 10**6 * 1000)


def seconds(time: Time) -> float:
    """Return a ROS time in seconds."""
    return time.sec + 1e-9 * time.nanosec


def header(time_s: float, frame: str) -> Header:
    """Return the header of a message about a simulated time in a frame."""
    return Header(stamp=stamp(time_s), frame_id=frame)


def image_message(rgb: np.ndarray, head: Header) -> Image:
    """Return a picture [H, W, 3] u8 as a message."""
    height, width, channels = rgb.shape
    assert channels == 3 and rgb.dtype == np.uint8
    data = array.array("B", rgb.tobytes())
    return Image(header=head, height=height, width=width, encoding="rgb8", step=3 * width, data=data)


def image_array(message: Image) -> np.ndarray:
    """Return [H, W, 3] u8 RGB of a picture; rows may be padded."""
    order = _ORDER.get(message.encoding)
    if order is None:
        raise MessageError(f"image encoding is '{message.encoding}', expected one of {', '.join(_ORDER)}")
    channels = 4 if "a" in message.encoding else 3
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(message.data, np.uint8)
    if step < channels * width or len(data) != step * height:
        raise MessageError(
            f"image of {width} x {height} ({message.encoding}) has {len(data)} bytes in rows of {step}, "
            f"expected {channels * width * height} in rows of {channels * width} or padded ones"
        )
    rows = data.reshape(height, step)[:, : channels * width]
    return np.ascontiguousarray(rows.reshape(height, width, channels)[..., list(order)])


def info_message(lens: Lens, head: Header) -> CameraInfo:
    """Return a pinhole camera without distortion; pixel centres are at whole numbers, as in OpenCV."""
    focal, cx, cy = 1.0 / lens.pixel, (lens.width - 1) / 2, (lens.height - 1) / 2
    return CameraInfo(
        header=head,
        height=lens.height,
        width=lens.width,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=[focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[focal, 0.0, cx, 0.0, 0.0, focal, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def info_lens(message: CameraInfo) -> Lens:
    """Return the pinhole lens of a camera, with an ideal centre and square pixels."""
    fx, fy = message.k[0], message.k[4]
    if not fy > 0:
        raise MessageError("camera_info has no focal length (k[4] is 0), expected a calibrated camera")
    if abs(fx / fy - 1) > 0.02:
        raise MessageError(f"camera_info has focal lengths {fx:.1f} and {fy:.1f}, expected square pixels")
    if any(abs(d) > 1e-9 for d in message.d):
        raise MessageError("camera_info has a distortion; subscribe to a rectified image (image_proc: image_rect)")
    return Lens(message.width, message.height, math.degrees(2 * math.atan(message.height / 2 / fy)))


def seen_through(rgb: np.ndarray, fov_deg: float, lens: Lens) -> np.ndarray:
    """Return what a narrower or coarser pinhole lens on the same axis would show of a picture [H, W, 3] u8.

    It is [h, w, 3] u8: the middle of the picture, averaged over each wanted pixel.
    """
    height, width, _ = rgb.shape
    have = Lens(width, height, fov_deg)
    # In pixels of the picture: what the wanted lens covers.
    rows = 2 * lens.half_height / have.pixel
    columns = rows * lens.width / lens.height
    if rows > height * 1.001 or columns > width * 1.001:
        raise MessageError(
            f"the camera's picture of {width} x {height} spans {fov_deg:.1f} degrees in height, the networks learned "
            f"from {lens.width} x {lens.height} that span {lens.fov_deg:.1f}: use a wider lens, or train with fov_deg"
        )
    rows, columns = min(rows, height), min(columns, width)
    box = ((width - columns) / 2, (height - rows) / 2, (width + columns) / 2, (height + rows) / 2)
    return np.asarray(Pillow.fromarray(rgb).resize((lens.width, lens.height), Pillow.Resampling.BOX, box=box))


def scan_message(
    readings: np.ndarray, fov_deg: float, range_min_m: float, range_max_m: float, period_s: float, head: Header
) -> LaserScan:
    """Return a scan of the lidar of `interactive_nav.sensing.sensors`.

    Readings [n] in [0, 1] are distances over `range_max_m`, 1 where nothing is nearer, from right to left; the
    message's ranges are in m, positive infinity where nothing was met (REP 117).
    """
    step, first = math.radians(fov_deg) / len(readings), -math.radians(fov_deg) / 2
    ranges = np.where(readings < 1.0, np.asarray(readings, np.float64) * range_max_m, np.inf)
    return LaserScan(
        header=head,
        angle_min=first,
        angle_max=first + (len(readings) - 1) * step,
        angle_increment=step,
        scan_time=period_s,
        range_min=range_min_m,
        range_max=range_max_m,
        ranges=array.array("f", ranges.tolist()),
    )


def yaw_quat(yaw_rad: float) -> Quaternion:
    """Return a turn about z."""
    return Quaternion(z=math.sin(yaw_rad / 2), w=math.cos(yaw_rad / 2))


def quat_yaw(quat: Quaternion) -> float:
    """Return the yaw, rad in [-pi, pi], of a quaternion of any length but 0."""
    x, y, z, w = quat.x, quat.y, quat.z, quat.w
    norm = x * x + y * y + z * z + w * w
    if not norm > 1e-12:
        raise MessageError("orientation is the zero quaternion: the sensor has no heading")
    return math.atan2(2 * (w * z + x * y), norm - 2 * (y * y + z * z))


def odometry_message(pose: np.ndarray, linear_b: np.ndarray, angular_b: np.ndarray, head: Header) -> Odometry:
    """Return a pose, x, y (m) and yaw (rad) in the frame of the start, with velocities (3,), m/s and rad/s, in the
    robot's frame."""
    x, y, yaw = (float(v) for v in pose)
    there = Pose(position=Point(x=x, y=y), orientation=yaw_quat(yaw))
    moving = TwistWithCovariance(twist=Twist(linear=_vector(linear_b), angular=_vector(angular_b)))
    return Odometry(header=head, child_frame_id=BASE, pose=PoseWithCovariance(pose=there), twist=moving)


def imu_message(yaw_rad: float, angular_b: np.ndarray, head: Header) -> Imu:
    """Return the heading in the world's frame and the turn rate; accelerations are marked as unknown."""
    message = Imu(header=head, orientation=yaw_quat(yaw_rad), angular_velocity=_vector(angular_b))
    message.linear_acceleration_covariance[0] = -1.0
    return message


def twist_message(linear_mps: float, angular_radps: float) -> Twist:
    """Return a velocity along x and a turn about z."""
    return Twist(linear=Vector3(x=float(linear_mps)), angular=Vector3(z=float(angular_radps)))


def twist_command(message: Twist) -> tuple[float, float]:
    """Return (m/s forward, rad/s to the left) of a velocity; robots on wheels cannot follow the rest."""
    command = float(message.linear.x), float(message.angular.z)
    if not all(map(math.isfinite, command)):
        raise MessageError(f"velocity command is {command}, expected finite numbers")
    return command


def transform(head: Header, child: str, pos_m: Any, quat: Quaternion) -> TransformStamped:
    """Return where the child's frame is in the header's frame."""
    placed = Transform(translation=_vector(np.asarray(pos_m)), rotation=quat)
    return TransformStamped(header=head, child_frame_id=child, transform=placed)


def _vector(values: np.ndarray) -> Vector3:
    return Vector3(**{name: float(v) for name, v in zip("xyz", values, strict=True)})
