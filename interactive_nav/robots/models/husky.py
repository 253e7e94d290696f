"""Husky: control mode in, its `RobotSpec` out; bodies and shapes: `mjcf/husky.xml`.

Figures: GibsonEnv's `husky.urdf` (41 kg, wheel radius 0.17775 m), the maker's manual (sizes), `husky_control`
(speeds). Native action: the original's wheel torques, 7.5 N m. Torque limit, damping and friction of the
wheels are ours (see the file). The success distance is the body's width (ours).
"""

from __future__ import annotations

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

_BASE = WheeledBase(
    name="husky",
    joints=(
        Joint("wheel_front_left", 15.0, side=-1),
        Joint("wheel_front_right", 15.0, side=1),
        Joint("wheel_rear_left", 15.0, side=-1),
        Joint("wheel_rear_right", 15.0, side=1),
    ),
    wheel_radius_m=0.17775,
    track_m=1.22,
    yaw_gain=1.0,
    native=(-7.5, 7.5),
    max_linear_m_s=1.0,
    max_angular_rad_s=2.0,
    native_torque=True,
)


def husky(control_mode: str = "native") -> RobotSpec:
    """Husky's spec.

    Args:
        control_mode: `native`, torques of the four wheels, front left and right, then rear; `twist`, linear and
            angular velocity of the base; `velocity`, `position` or `torque` of each wheel.

    Raises:
        ValueError: unknown mode.
    """
    return wheeled_robot(
        _BASE,
        control_mode,
        body_width_m=0.67,
        footprint_radius_m=0.56,
        height_m=0.39,
        camera=Camera("base", (0.4, 0.0, 0.294)),
        mass_kg=41.0,
        size_m=(0.99, 0.67, 0.39),
        drive_type="skid steer, 4 wheels",
        source="GibsonEnv husky.urdf; Clearpath manual and husky_control",
    )
