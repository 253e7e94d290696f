"""TurtleBot v2 (Kobuki base): control mode in, its `RobotSpec` out; bodies and shapes: `mjcf/turtlebot.xml`.

Figures are those of iGibson's TurtleBot URDF unless marked 'ours': 2.673 kg in all, wheels of radius
0.0352 m at y = +/- 0.115 m, body disc of radius 0.176 m, casters without friction, success distance
0.333 m, wheel command -12.5 .. +25 rad/s for action -1 .. +1 (reference benchmark, section 2). The
original's wheel torque was unlimited; ours is the 1.0 N m of the robot's Gazebo plugin.
"""

from __future__ import annotations

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

WHEEL_RADIUS_M = 0.0352
TRACK_M = 0.23
_NATIVE = (-12.5, 25.0)
_BASE = WheeledBase(
    name="turtlebot",
    # 15 rad/s: iGibson's default for joints without a limit.
    joints=(Joint("wheel_left", 15.0, side=-1), Joint("wheel_right", 15.0, side=1)),
    wheel_radius_m=WHEEL_RADIUS_M,
    track_m=TRACK_M,
    native=_NATIVE,
    max_linear_m_s=_NATIVE[1] * WHEEL_RADIUS_M,
    min_linear_m_s=_NATIVE[0] * WHEEL_RADIUS_M,
    max_angular_rad_s=-2 * _NATIVE[0] * WHEEL_RADIUS_M / TRACK_M,
)


def turtlebot(control_mode: str = "native") -> RobotSpec:
    """TurtleBot v2's spec.

    Args:
        control_mode: `native`, two wheel velocities, left then right; `twist`, linear and angular velocity
            of the base; `velocity`, `position` or `torque` of each wheel.

    Raises:
        ValueError: unknown mode.
    """
    return wheeled_robot(
        _BASE,
        control_mode,
        body_width_m=0.333,
        footprint_radius_m=0.18,
        height_m=0.41,
        camera=Camera("base", (-0.087, -0.0125, 0.272)),
        mass_kg=2.673,
        size_m=(0.352, 0.352, 0.41),
        drive_type="differential, 2 casters",
        source="iGibson 0.0.4 turtlebot.urdf; torque: kobuki_gazebo",
    )
