"""Freight, Fetch Robotics' mobile base: control mode in, its `RobotSpec` out; bodies and shapes: `mjcf/freight.xml`.

Figures: `fetch_description/robots/freight.urdf`; wheel radius 0.0613 m: iGibson; speeds: Freight's controllers.
No original task gives a success distance: the body's width stands in for it (ours).
"""

from __future__ import annotations

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

_BASE = WheeledBase(
    name="freight",
    joints=(Joint("wheel_left", 34.8, side=-1), Joint("wheel_right", 34.8, side=1)),
    wheel_radius_m=0.0613,
    track_m=0.37476,
    native=(-34.8, 34.8),
    max_linear_m_s=2.0,
    max_angular_rad_s=1.5,
)


def freight(control_mode: str = "native") -> RobotSpec:
    """Freight's spec.

    Args:
        control_mode: `native`, two wheel velocities, left then right; `twist`, linear and angular velocity
            of the base; `velocity`, `position` or `torque` of each wheel.

    Raises:
        ValueError: unknown mode.
    """
    return wheeled_robot(
        _BASE,
        control_mode,
        body_width_m=0.528,
        footprint_radius_m=0.31,
        height_m=0.359,
        camera=Camera("base", (0.2645, 0.0, 0.198), pitch_rad=-0.1745),
        mass_kg=78.85,
        size_m=(0.573, 0.528, 0.359),
        drive_type="differential, 4 casters",
        source="fetch_ros freight.urdf; iGibson",
    )
