"""JackRabbot v2: control mode in, its `RobotSpec` out; bodies and shapes: `mjcf/jackrabbot2.xml`.

Figures: iGibson's `jr2_kinova.urdf` (148.2 kg, wheels, arm, camera) and its configuration of the door task (wheel
command +/- 6.25 rad/s, success distance 0.5 m); arm torques: kinova-ros; wheel torque 40 N m and the folded
pose are ours: the original's reset pose holds the hand 0.64 m ahead of the axle, this one beside the body.
"""

from __future__ import annotations

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

_BASE = WheeledBase(
    name="jackrabbot2",
    joints=(
        Joint("wheel_left", 6.25, side=-1),
        Joint("wheel_right", 6.25, side=1),
        # Speeds: the URDF's.
        Joint("arm_1", 1.0, 1.57),
        Joint("arm_2", 1.0, 5.1),
        Joint("arm_3", 1.0, 1.07),
        Joint("arm_4", 1.0, -2.2),
        Joint("arm_5", 1.0, -1.94),
    ),
    wheel_radius_m=0.2406,
    track_m=0.5421,
    native=(-6.25, 6.25),
    max_linear_m_s=1.0,
    max_angular_rad_s=0.785,
    whole_body=("arm_1", "arm_2", "arm_3", "arm_4", "arm_5"),
)


def jackrabbot2(control_mode: str = "native") -> RobotSpec:
    """JackRabbot v2's spec.

    Args:
        control_mode: `native`, two wheel velocities, left then right, arm folded; `whole_body`, the original's
            two wheel and five arm velocities; `twist`, linear and angular velocity of the base, arm folded;
            `velocity`, `position` or `torque` of all seven joints.

    Raises:
        ValueError: unknown mode.
    """
    return wheeled_robot(
        _BASE,
        control_mode,
        body_width_m=0.5,
        footprint_radius_m=0.53,
        height_m=1.293,
        camera=Camera("base", (0.224, 0.0, 1.024)),
        mass_kg=148.18,
        size_m=(0.98, 0.634, 1.29),
        drive_type="differential, 2 casters; 5-joint arm",
        source="iGibson jr2_kinova.urdf; kinova-ros; success distance: 2019 task",
    )
