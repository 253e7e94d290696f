"""Fetch: control mode in, its `RobotSpec` out; bodies and shapes: `mjcf/fetch.xml`.

Figures: `fetch_description/robots/fetch.urdf`; wheel radius 0.0613 m, folded arm and camera: iGibson;
success distance 0.5 m and wheel command -12.5 .. +25 rad/s: its configuration of the 2019 task, in which the
policy drives the wheels and the arm stays folded. Later versions drive ten joints: mode `whole_body`, to
which ours adds the gripper's opening. The wheels' 8.85 N m are the robot's (the original's had no limit).
"""

from __future__ import annotations

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

ARM = (
    Joint("shoulder_pan", 1.256, 1.171),
    Joint("shoulder_lift", 1.454, 1.471),
    Joint("upperarm_roll", 1.571, -0.4),
    Joint("elbow_flex", 1.521, 1.671),
    Joint("forearm_roll", 1.571, 0.0),
    Joint("wrist_flex", 2.268, 1.571),
    Joint("wrist_roll", 2.268, 0.0),
)
"""Joint, its largest speed (rad/s), its angle in the folded pose (rad)."""
_BASE = WheeledBase(
    name="fetch",
    joints=(
        Joint("wheel_left", 17.4, side=-1),
        Joint("wheel_right", 17.4, side=1),
        Joint("torso", 0.1, 0.02, unit="m"),
        Joint("head_pan", 1.57),
        Joint("head_tilt", 1.57),
        *ARM,
        Joint("finger_left", 0.05, unit="m"),
        Joint("finger_right", 0.05, unit="m"),
    ),
    wheel_radius_m=0.0613,
    track_m=0.37476,
    native=(-12.5, 25.0),
    max_linear_m_s=1.0,
    max_angular_rad_s=1.5,
    whole_body=("torso", *(joint.name for joint in ARM)),
    gripper=("finger_left", "finger_right"),
)


def fetch(control_mode: str = "native") -> RobotSpec:
    """Fetch's spec.

    Args:
        control_mode: `native`, two wheel velocities, left then right, arm folded; `whole_body`, velocities
            of wheels, torso and arm, and the gripper's opening; `twist`, linear and angular velocity of the
            base, arm folded; `velocity`, `position` or `torque` of all fourteen joints.

    Raises:
        ValueError: unknown mode.
    """
    return wheeled_robot(
        _BASE,
        control_mode,
        body_width_m=0.5,
        footprint_radius_m=0.31,
        height_m=1.12,
        camera=Camera("head_tilt", (0.0593, 0.0, 0.0076), pitch_rad=0.2618),
        mass_kg=121.28,
        size_m=(0.573, 0.528, 1.093),
        drive_type="differential, 4 casters; torso, head, 7-joint arm, gripper",
        source="fetch_ros fetch.urdf; iGibson; success distance: 2019 task",
    )
