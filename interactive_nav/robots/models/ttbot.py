"""TTbot: control mode in, its `RobotSpec` out; bodies and shapes: `mjcf/ttbot.xml`.

Only its kind is public (four wheels, lidar, RGB-D camera): every figure here is ours, for an indoor platform of
30 kg that is 0.50 x 0.45 x 1.10 m and drives at 1 m/s.
"""

from __future__ import annotations

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

_BASE = WheeledBase(
    name="ttbot",
    joints=(
        Joint("wheel_front_left", 12.5, side=-1),
        Joint("wheel_front_right", 12.5, side=1),
        Joint("wheel_rear_left", 12.5, side=-1),
        Joint("wheel_rear_right", 12.5, side=1),
    ),
    wheel_radius_m=0.08,
    track_m=0.6,
    yaw_gain=1.0,
    native=(-12.5, 12.5),
    max_linear_m_s=1.0,
    max_angular_rad_s=1.5,
)


def ttbot(control_mode: str = "native") -> RobotSpec:
    """TTbot's spec.

    Args:
        control_mode: `native`, velocities of the four wheels, front left and right, then rear; `twist`, linear
            and angular velocity of the base; `velocity`, `position` or `torque` of each wheel.

    Raises:
        ValueError: unknown mode.
    """
    return wheeled_robot(
        _BASE,
        control_mode,
        body_width_m=0.45,
        footprint_radius_m=0.33,
        height_m=1.1,
        camera=Camera("base", (0.1, 0.0, 1.02)),
        mass_kg=30.0,
        size_m=(0.5, 0.45, 1.1),
        drive_type="skid steer, 4 wheels",
        source="ours; kind and sensors: project brief",
    )
