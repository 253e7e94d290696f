"""The seven wheeled robots: a table of sourced figures in, one factory (control mode -> `RobotSpec`) a robot out.

Bodies and shapes: `mjcf/<robot>.xml`. Control modes: `native`, velocities of the wheels, left then right, front
before rear (Husky: their torques), an arm folded; `whole_body`, of a robot with an arm, its velocities too, and a
gripper's opening; `twist`, linear and angular velocity of the base, an arm folded; `velocity`, `position` or
`torque` of all joints.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import RobotCamera, RobotSpec


def _wheels(max_speed_rad_s: float, *rows: str) -> tuple[Joint, ...]:
    """Left and right wheel of each row ('front', 'rear'; without names: of the only one)."""
    stems = [f"wheel_{row}_" for row in rows] or ["wheel_"]
    sides = (("left", -1), ("right", 1))
    return tuple(Joint(f"{stem}{place}", max_speed_rad_s, side=side) for stem in stems for place, side in sides)


FETCH_ARM = (
    Joint("shoulder_pan", 1.256, 1.171),
    Joint("shoulder_lift", 1.454, 1.471),
    Joint("upperarm_roll", 1.571, -0.4),
    Joint("elbow_flex", 1.521, 1.671),
    Joint("forearm_roll", 1.571, 0.0),
    Joint("wrist_flex", 2.268, 1.571),
    Joint("wrist_roll", 2.268, 0.0),
)
"""Joint, its largest speed (rad/s), its angle in the folded pose (rad)."""
JACKRABBOT2_ARM = (
    # Speeds: the URDF's.
    Joint("arm_1", 1.0, 1.57),
    Joint("arm_2", 1.0, 5.1),
    Joint("arm_3", 1.0, 1.07),
    Joint("arm_4", 1.0, -2.2),
    Joint("arm_5", 1.0, -1.94),
)
TURTLEBOT_RADIUS_M = 0.0352
TURTLEBOT_TRACK_M = 0.23
TURTLEBOT_NATIVE = (-12.5, 25.0)

_TABLE: tuple[tuple[WheeledBase, dict[str, Any]], ...] = (
    # Fetch: `fetch_description/robots/fetch.urdf`; wheel radius 0.0613 m, folded arm and camera: iGibson;
    # success distance 0.5 m and wheel command -12.5 .. +25 rad/s: its configuration of the 2019 task, in which the
    # policy drives the wheels and the arm stays folded. Later versions drive ten joints: mode `whole_body`, to
    # which ours adds the gripper's opening. The wheels' 8.85 N m are the robot's (the original's had no limit).
    (
        WheeledBase(
            name="fetch",
            joints=(
                *_wheels(17.4),
                Joint("torso", 0.1, 0.02, unit="m"),
                Joint("head_pan", 1.57),
                Joint("head_tilt", 1.57),
                *FETCH_ARM,
                Joint("finger_left", 0.05, unit="m"),
                Joint("finger_right", 0.05, unit="m"),
            ),
            wheel_radius_m=0.0613,
            track_m=0.37476,
            native=(-12.5, 25.0),
            max_linear_m_s=1.0,
            max_angular_rad_s=1.5,
            whole_body=("torso", *(joint.name for joint in FETCH_ARM)),
            gripper=("finger_left", "finger_right"),
        ),
        {
            "body_width_m": 0.5,
            "footprint_radius_m": 0.31,
            "height_m": 1.12,
            "camera": RobotCamera("head_tilt", (0.0593, 0.0, 0.0076), pitch_rad=0.2618),
            "mass_kg": 121.28,
            "size_m": (0.573, 0.528, 1.093),
            "drive_type": "differential, 4 casters; torso, head, 7-joint arm, gripper",
            "source": "fetch_ros fetch.urdf; iGibson; success distance: 2019 task",
        },
    ),
    # Freight, Fetch Robotics' mobile base: `fetch_description/robots/freight.urdf`; wheel radius 0.0613 m: iGibson;
    # speeds: Freight's controllers. No original task gives a success distance: the body's width stands in for it
    # (ours).
    (
        WheeledBase(
            name="freight",
            joints=_wheels(34.8),
            wheel_radius_m=0.0613,
            track_m=0.37476,
            native=(-34.8, 34.8),
            max_linear_m_s=2.0,
            max_angular_rad_s=1.5,
        ),
        {
            "body_width_m": 0.528,
            "footprint_radius_m": 0.31,
            "height_m": 0.359,
            "camera": RobotCamera("base", (0.2645, 0.0, 0.198), pitch_rad=-0.1745),
            "mass_kg": 78.85,
            "size_m": (0.573, 0.528, 0.359),
            "drive_type": "differential, 4 casters",
            "source": "fetch_ros freight.urdf; iGibson",
        },
    ),
    # Husky: GibsonEnv's `husky.urdf` (41 kg, wheel radius 0.17775 m), the maker's manual (sizes), `husky_control`
    # (speeds). Native action: the original's wheel torques, 7.5 N m. Torque limit, damping and friction of the
    # wheels are ours (see the file). The success distance is the body's width (ours).
    (
        WheeledBase(
            name="husky",
            joints=_wheels(15.0, "front", "rear"),
            wheel_radius_m=0.17775,
            track_m=1.22,
            yaw_gain=1.0,
            native=(-7.5, 7.5),
            max_linear_m_s=1.0,
            max_angular_rad_s=2.0,
            native_torque=True,
        ),
        {
            "body_width_m": 0.67,
            "footprint_radius_m": 0.56,
            "height_m": 0.39,
            "camera": RobotCamera("base", (0.4, 0.0, 0.294)),
            "mass_kg": 41.0,
            "size_m": (0.99, 0.67, 0.39),
            "drive_type": "skid steer, 4 wheels",
            "source": "GibsonEnv husky.urdf; Clearpath manual and husky_control",
        },
    ),
    # JackRabbot v1: GibsonEnv's `jr1_gibson.urdf` and the maker's Segway RMP 210 files. The URDF's masses are in part
    # placeholders, but no robot was weighed: their sum, 144.5 kg, is kept. Wheel torque 40 N m and the centre of
    # mass are ours. The success distance is the body's width (ours).
    (
        WheeledBase(
            name="jackrabbot1",
            joints=_wheels(6.25),
            wheel_radius_m=0.2406,
            track_m=0.5424,
            native=(-5.0, 5.0),
            max_linear_m_s=1.0,
            max_angular_rad_s=1.0,
        ),
        {
            "body_width_m": 0.64,
            "footprint_radius_m": 0.48,
            "height_m": 0.993,
            "camera": RobotCamera("base", (-0.2378, 0.0, 0.97)),
            "mass_kg": 144.53,
            "size_m": (0.73, 0.64, 0.99),
            "drive_type": "differential, 1 rear caster",
            "source": "GibsonEnv jr1_gibson.urdf; segway_v3 RMP 210",
        },
    ),
    # JackRabbot v2: iGibson's `jr2_kinova.urdf` (148.2 kg, wheels, arm, camera) and its configuration of the door task
    # (wheel command +/- 6.25 rad/s, success distance 0.5 m; it commands the two wheels and the arm: `whole_body`);
    # arm torques: kinova-ros; wheel torque 40 N m and the folded pose are ours: the original's reset pose holds the
    # hand 0.64 m ahead of the axle, this one beside the body.
    (
        WheeledBase(
            name="jackrabbot2",
            joints=(*_wheels(6.25), *JACKRABBOT2_ARM),
            wheel_radius_m=0.2406,
            track_m=0.5421,
            native=(-6.25, 6.25),
            max_linear_m_s=1.0,
            max_angular_rad_s=0.785,
            whole_body=tuple(joint.name for joint in JACKRABBOT2_ARM),
        ),
        {
            "body_width_m": 0.5,
            "footprint_radius_m": 0.53,
            "height_m": 1.293,
            "camera": RobotCamera("base", (0.224, 0.0, 1.024)),
            "mass_kg": 148.18,
            "size_m": (0.98, 0.634, 1.29),
            "drive_type": "differential, 2 casters; 5-joint arm",
            "source": "iGibson jr2_kinova.urdf; kinova-ros; success distance: 2019 task",
        },
    ),
    # TTbot: only its kind is public (four wheels, lidar, RGB-D camera): every figure here is ours, for an indoor
    # platform of 30 kg that is 0.50 x 0.45 x 1.10 m and drives at 1 m/s.
    (
        WheeledBase(
            name="ttbot",
            joints=_wheels(12.5, "front", "rear"),
            wheel_radius_m=0.08,
            track_m=0.6,
            yaw_gain=1.0,
            native=(-12.5, 12.5),
            max_linear_m_s=1.0,
            max_angular_rad_s=1.5,
        ),
        {
            "body_width_m": 0.45,
            "footprint_radius_m": 0.33,
            "height_m": 1.1,
            "camera": RobotCamera("base", (0.1, 0.0, 1.02)),
            "mass_kg": 30.0,
            "size_m": (0.5, 0.45, 1.1),
            "drive_type": "skid steer, 4 wheels",
            "source": "ours; kind and sensors: project brief",
        },
    ),
    # TurtleBot v2 (Kobuki base): figures are those of iGibson's TurtleBot URDF unless marked 'ours': 2.673 kg in all,
    # wheels of radius 0.0352 m at y = +/- 0.115 m, body disc of radius 0.176 m, casters without friction, success
    # distance 0.333 m, wheel command -12.5 .. +25 rad/s for action -1 .. +1 (reference benchmark, section 2). The
    # original's wheel torque was unlimited; ours is the 1.0 N m of the robot's Gazebo plugin.
    (
        WheeledBase(
            name="turtlebot",
            joints=_wheels(15.0),  # 15 rad/s: iGibson's default for joints without a limit
            wheel_radius_m=TURTLEBOT_RADIUS_M,
            track_m=TURTLEBOT_TRACK_M,
            native=TURTLEBOT_NATIVE,
            max_linear_m_s=TURTLEBOT_NATIVE[1] * TURTLEBOT_RADIUS_M,
            min_linear_m_s=TURTLEBOT_NATIVE[0] * TURTLEBOT_RADIUS_M,
            max_angular_rad_s=-2 * TURTLEBOT_NATIVE[0] * TURTLEBOT_RADIUS_M / TURTLEBOT_TRACK_M,
        ),
        {
            "body_width_m": 0.333,
            "footprint_radius_m": 0.18,
            "height_m": 0.41,
            "camera": RobotCamera("base", (-0.087, -0.0125, 0.272)),
            "mass_kg": 2.673,
            "size_m": (0.352, 0.352, 0.41),
            "drive_type": "differential, 2 casters",
            "source": "iGibson 0.0.4 turtlebot.urdf; torque: kobuki_gazebo",
        },
    ),
)
"""Driven joints and commands; the other fields of the `RobotSpec`."""

WHEELED: dict[str, Callable[[str], RobotSpec]] = {
    base.name: functools.partial(wheeled_robot, base, **figures) for base, figures in _TABLE
}
"""Name -> control mode -> spec."""
