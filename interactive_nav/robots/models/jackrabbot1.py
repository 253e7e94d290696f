"""JackRabbot v1: control mode in, its `RobotSpec` out; bodies and shapes: `mjcf/jackrabbot1.xml`.

Figures: GibsonEnv's `jr1_gibson.urdf` and the maker's Segway RMP 210 files. The URDF's masses are in part
placeholders, but no robot was weighed: their sum, 144.5 kg, is kept. Wheel torque 40 N m and the centre of
mass are ours. The success distance is the body's width (ours).
"""

from __future__ import annotations

from interactive_nav.robots.build import Joint, WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Camera, RobotSpec

_BASE = WheeledBase(
    name="jackrabbot1",
    joints=(
        Joint("wheel_left", 6.25, side=-1),
        Joint("wheel_right", 6.25, side=1),
    ),
    wheel_radius_m=0.2406,
    track_m=0.5424,
    native=(-5.0, 5.0),
    max_linear_m_s=1.0,
    max_angular_rad_s=1.0,
)


def jackrabbot1(control_mode: str = "native") -> RobotSpec:
    """JackRabbot v1's spec.

    Args:
        control_mode: `native`, two wheel velocities, left then right; `twist`, linear and angular velocity
            of the base; `velocity`, `position` or `torque` of each wheel.

    Raises:
        ValueError: unknown mode.
    """
    return wheeled_robot(
        _BASE,
        control_mode,
        body_width_m=0.64,
        footprint_radius_m=0.48,
        height_m=0.993,
        camera=Camera("base", (-0.2378, 0.0, 0.97)),
        mass_kg=144.53,
        size_m=(0.73, 0.64, 0.99),
        drive_type="differential, 1 rear caster",
        source="GibsonEnv jr1_gibson.urdf; segway_v3 RMP 210",
    )
