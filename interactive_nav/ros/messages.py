"""Convert arrays to ROS 2 messages and back; define topics, types and frames.

Units are SI and frames right-handed (REP 103): x forward, y left, z up; optical frames: z forward, x right, y down.
Frame names follow REP 105, topics Nav2.
"""

import array
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu, Joy, LaserScan
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
GOAL, PLAN, JOY = "/goal_pose", "/plan", "/joy"
FROM_ROBOT: dict[str, Any] = {
    **{CLOCK: Clock, IMAGE: Image, INFO: CameraInfo, SCAN: LaserScan, ODOMETRY: Odometry, HEADING: Imu},
    **{MOVABLE: Bool, STRUCTURE: Bool, FORCE: Float32},
    **({} if TFMessage is None else {TF: TFMessage, TF_STATIC: TFMessage}),
}
"""Topics that the simulator publishes, and their types; a robot publishes the same apart from the clock."""
TOPICS = {**FROM_ROBOT, COMMAND: Twist, DONE: Bool}
REQUESTS: dict[str, Any] = {GOAL: PoseStamped, PLAN: Path, JOY: Joy}
"""Topics by which people and planners steer a policy, and their types."""
HEADING_TOPICS = {"imu": HEADING, "odom": ODOMETRY}
"""Where the navigator's heading may come from."""
LATCHED = (TF_STATIC, DONE)
MAP, ODOM, BASE, LIDAR = "map", "odom", "base_link", "lidar_link"
EPOCH_S = 1.0
"""First time of the simulated clock: ROS takes 0 as "not set"."""
CAMERA_TOPICS = {"rgb": "image_raw", "depth": "depth/image_raw", "segmentation": "segmentation/image_raw"}
"""Kind of image -> its topic below the camera's."""
_ENCODINGS: dict[str, dict[str, tuple[str, int, list[int]]]] = {
    "rgb": {
        "rgb8": ("u1", 3, [0, 1, 2]),
        "bgr8": ("u1", 3, [2, 1, 0]),
        "rgba8": ("u1", 4, [0, 1, 2]),
        "bgra8": ("u1", 4, [2, 1, 0]),
    },
    "depth": {"32FC1": ("f4", 1, [0]), "16UC1": ("u2", 1, [0])},
    "segmentation": {"mono8": ("u1", 1, [0]), "8UC1": ("u1", 1, [0])},
}
"""Kind of image -> readable encodings -> type, channels, and those that are read."""
OPTICAL_QUAT = Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5)
"""A camera's optical frame in the frame that looks along its x axis."""


class MessageError(UserError):
    """Report a message that cannot be read."""


def qos(topic: str, depth: int = 10, reading: bool = False, lossless: bool = False) -> QoSProfile:
    """Return a topic's quality of service: best effort for sensors, unless all data must be `lossless`.

    Odometry and contacts are published reliably and read best effort, as some robots offer only that.
    """
    lossy = topic.startswith("/camera/") or topic in (SCAN, HEADING)
    lossy |= reading and topic in (ODOMETRY, MOVABLE, STRUCTURE, FORCE)
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if lossy and not lossless else ReliabilityPolicy.RELIABLE,
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


def camera_topic(image: str, topic: str = "") -> str:
    """Return the topic of an image, such as `depth` or `left/depth`, or another topic of its camera."""
    prefix, _, kind = image.rpartition("/")
    return "/".join(["/camera", *([prefix] if prefix else []), topic or CAMERA_TOPICS[kind]])


def camera_frames(prefix: str) -> tuple[str, str]:
    """Return the frame that looks along a camera's axis with x, and its optical frame; `prefix` as `left/`."""
    link = f"{prefix.replace('/', '_')}camera_link"
    return link, link.replace("link", "optical_frame")


def camera_topics(images: Iterable[str]) -> dict[str, Any]:
    """Return the topics that images are sent on, and their types."""
    return {camera_topic(*of): kind for one in images for *of, kind in ((one, Image), (one, "camera_info", CameraInfo))}


def image_message(image: np.ndarray, head: Header) -> Image:
    """Return colours [H, W, 3] u8, class ids [H, W] u8 or depth [H, W] f32, m, as a message."""
    height, width, *_ = image.shape
    encoding = "rgb8" if image.ndim == 3 else {"uint8": "mono8", "float32": "32FC1"}[image.dtype.name]
    step, data = image[0].nbytes, array.array("B", image.tobytes())
    return Image(header=head, height=height, width=width, encoding=encoding, step=step, data=data)


def image_array(message: Image, kind: str = "rgb") -> np.ndarray:
    """Return colours [H, W, 3] u8, depth [H, W] f32, m, or class ids [H, W] u8 of a picture; rows may be padded."""
    if message.encoding not in _ENCODINGS[kind]:
        raise MessageError(f"image encoding is '{message.encoding}', expected one of {', '.join(_ENCODINGS[kind])}")
    dtype, channels, order = _ENCODINGS[kind][message.encoding]
    pixel = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = message.height, message.width, message.step
    data, row = np.frombuffer(message.data, np.uint8), pixel.itemsize * channels * width
    if step < row or len(data) != step * height:
        raise MessageError(
            f"image of {width} x {height} ({message.encoding}) has {len(data)} bytes in rows of {step}, "
            f"expected {row * height} in rows of {row} or padded ones"
        )
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :row]).view(pixel)
    image = np.ascontiguousarray(rows.reshape(height, width, channels)[..., order])
    if kind != "depth":
        return image if kind == "rgb" else image[..., 0]
    depth = image[..., 0].astype(np.float32) * (0.001 if dtype == "u2" else 1.0)  # REP 118: mm or m
    return np.where(np.isfinite(depth), depth, 0.0)


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


def scan_message(
    readings: np.ndarray, fov_deg: float, range_min_m: float, range_max_m: float, period_s: float, head: Header
) -> LaserScan:
    """Return a scan of the lidar of `interactive_nav.sensing.sensors`.

    Readings [n] in [0, 1] are distances over `range_max_m`, from right to left, 1 without a hit, which becomes infinity
    (REP 117); the message's ranges are in m.
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


def scan_readings(message: LaserScan, rays: int, fov_deg: float, range_max_m: float) -> np.ndarray:
    """Return [rays] f32 in [0, 1], as `scan_message` has them, from the nearest beams of a scan that covers as much."""
    ranges, step = np.asarray(message.ranges, np.float64), abs(message.angle_increment)
    if np.isnan(ranges).any() or not (len(ranges) and step > 0.0):
        raise MessageError(f"{np.isnan(ranges).sum()} of {len(ranges)} ranges are NaN, expected none (REP 117)")
    wanted = np.radians(fov_deg * (np.arange(rays) / rays - 0.5))
    turned = (wanted - message.angle_min) * math.copysign(1.0, message.angle_increment)
    beams = np.floor((turned + step / 2) % math.tau / step).astype(int)
    if (beams >= len(ranges)).any():
        covered = math.degrees(step * len(ranges))
        raise MessageError(f"scan covers {covered:.0f} degrees, expected those that the policy sees ({fov_deg:.0f})")
    near = np.maximum(ranges, message.range_min)[beams]  # -inf: too near (REP 117)
    return np.clip(near / range_max_m, 0.0, 1.0).astype(np.float32)


def yaw_quat(yaw_rad: float, pitch_rad: float = 0.0) -> Quaternion:
    """Return a turn about z, after one about y: positive lowers x."""
    (sin, cos), (down, level) = ((math.sin(a / 2), math.cos(a / 2)) for a in (yaw_rad, pitch_rad))
    return Quaternion(x=-sin * down, y=cos * down, z=sin * level, w=cos * level)


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


def odometry_values(message: Odometry) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose (3,), x, y (m) and yaw (rad), and the linear and angular velocity (6,) in the robot's frame."""
    at, moving = message.pose.pose, message.twist.twist
    pose = np.array([at.position.x, at.position.y, quat_yaw(at.orientation)])
    velocity = np.array([getattr(v, axis) for v in (moving.linear, moving.angular) for axis in "xyz"])
    if not (np.isfinite(pose).all() and np.isfinite(velocity).all()):
        raise MessageError("odometry has numbers that are not finite")
    return pose, velocity


def path_points(poses: Sequence[Pose], frame: str) -> np.ndarray:
    """Return [p, 2], m, of poses in the map's or the odometry's frame."""
    points = np.array([(pose.position.x, pose.position.y) for pose in poses]).reshape(-1, 2)
    if frame not in (MAP, ODOM) or not np.isfinite(points).all():
        raise MessageError(f"frame is '{frame}', expected '{MAP}' or '{ODOM}', and finite positions")
    return points


def imu_message(yaw_rad: float, angular_b: np.ndarray, head: Header) -> Imu:
    """Return the heading in the world's frame and the turn rate; accelerations are marked as unknown."""
    message = Imu(header=head, orientation=yaw_quat(yaw_rad), angular_velocity=_vector(angular_b))
    message.linear_acceleration_covariance[0] = -1.0
    return message


def twist_message(linear_mps: float, angular_radps: float) -> Twist:
    """Return a velocity along x and a turn about z, which are finite."""
    message = Twist(linear=Vector3(x=float(linear_mps)), angular=Vector3(z=float(angular_radps)))
    twist_command(message)
    return message


def twist_command(message: Twist) -> tuple[float, float]:
    """Return (m/s forward, rad/s to the left) of a velocity; robots on wheels cannot follow the rest."""
    command = float(message.linear.x), float(message.angular.z)
    if not all(map(math.isfinite, command)):
        raise MessageError(f"velocity command is {command}, expected finite numbers")
    return command


def transform(
    frame: str, child: str, pos_m: Any, quat: Quaternion | None = None, time_s: float = 0.0
) -> TransformStamped:
    """Return where the child's frame is in another one; without a quaternion it is not turned."""
    placed = Transform(translation=_vector(np.asarray(pos_m)), rotation=quat or yaw_quat(0.0))
    return TransformStamped(header=header(time_s, frame), child_frame_id=child, transform=placed)


def camera_links(poses: Mapping[str, tuple[np.ndarray, float, float]], time_s: float = 0.0) -> list[TransformStamped]:
    """Return where cameras are in the base's frame: (3,) m, yaw and pitch, rad, by the prefix of their images."""
    return [
        transform(BASE, camera_frames(prefix)[0], pos_m, yaw_quat(yaw, pitch), time_s)
        for prefix, (pos_m, yaw, pitch) in poses.items()
    ]


def _vector(values: np.ndarray) -> Vector3:
    return Vector3(**{name: float(v) for name, v in zip("xyz", values, strict=True)})
