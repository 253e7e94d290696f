"""Ant: nothing in, its `RobotSpec` out.

Shape and joints are those of the MuJoCo and GibsonEnv Ant (`ant.xml`) at GibsonEnv's default scale of 0.25:
at full size it is 1.39 m wide and passes no door. Two readings of that file's mass exist, 0.911 kg (MuJoCo,
density 5) and 182 kg (PyBullet, density 1000), both at scale 1. Ours is the second at scale 0.25: 182 / 4^3 =
2.85 kg. Torques follow gravity's, which goes with the fourth power of the scale: the original's 250 N m become
250 / 4^4 = 0.98 N m, twice what the ankles need to stand.
"""

from __future__ import annotations

import math

from interactive_nav.robots.gait import Legged, Servo, legged_robot
from interactive_nav.robots.spec import RobotCamera, RobotSpec

SCALE = 0.25
HOME_ANKLE_RAD = 1.0
JOINTS = tuple(f"ant_{part}_{i}" for i in range(1, 5) for part in ("hip", "ankle"))
_ANKLE_SIGN = (1.0, -1.0, -1.0, 1.0)

_FREQUENCY_HZ = 2.3
_LIFT_RAD = 0.325
_PRESS = 0.1
"""Legs on the ground push down by this share of the lift."""
_STRIDE_GAIN, _TURN_GAIN = 1.07, 1.16
"""Over the kinematic sweep: for servos that lag and feet that slip. All five by a random search for tracking."""
_REACH_M = 0.104
"""Forward travel of a foot per radian of its hip, at home."""


def _reference(phase, command, base, xp):
    """Trot: diagonal pairs swing half a cycle apart; a leg in swing lifts its ankle. Offsets from home, [..., 8]."""
    del base
    forward, turn = command[..., 0], command[..., 1]
    effort = xp.clip(8.0 * xp.abs(forward) + 2.0 * xp.abs(turn), 0.0, 1.0)
    offsets = []
    for sign, (x, y) in zip(_ANKLE_SIGN, ((1, 1), (-1, 1), (-1, -1), (1, -1)), strict=True):
        at = phase + (0.0 if x * y > 0 else math.pi)
        # A foot on the left (y > 0) goes forward when its hip turns clockwise, one on the right the other way.
        sweep = (_TURN_GAIN * turn - y * _STRIDE_GAIN * forward / _REACH_M) / (4.0 * _FREQUENCY_HZ)
        offsets.append(-sweep * xp.cos(at))
        offsets.append(-sign * _LIFT_RAD * effort * (xp.maximum(xp.sin(at), 0.0) - _PRESS))
    return xp.stack(offsets, -1)


LEGS = Legged(
    name="ant",
    base_body="torso",
    joints=JOINTS,
    home=tuple(v for sign in _ANKLE_SIGN for v in (0.0, sign * HOME_ANKLE_RAD)),
    servo=Servo(stiffness=9.0, damping=0.4, velocity_gain=0.2),
    max_speed_rad_s=8.0,
    frequency_hz=_FREQUENCY_HZ,
    reference=_reference,
    max_linear_m_s=0.2,
    max_angular_rad_s=0.8,
)


def ant(control_mode: str = "native") -> RobotSpec:
    """The Ant's spec.

    Args:
        control_mode: `native`, eight joint torques (hip, ankle of legs 1 to 4: front left, back left, back
            right, front right); `position` or `velocity` of each joint; or `twist`, linear and angular
            velocity of the base through its gait.

    Raises:
        ConfigError: unknown mode.
    """
    return legged_robot(
        LEGS,
        control_mode,
        body_width_m=1.39 * SCALE,
        footprint_radius_m=0.25,
        height_m=0.21,
        spawn_height_m=(0.4 * math.sqrt(2.0) * math.sin(HOME_ANKLE_RAD) + 0.08) * SCALE,
        camera=RobotCamera("ant_torso", (0.0, 0.0, 0.0)),
        mass_kg=182.2 * SCALE**3,
        size_m=(1.39 * SCALE, 1.39 * SCALE, 0.81 * SCALE),
        drive_type="4 legs, 8 hinges",
        source="MuJoCo and GibsonEnv ant.xml at scale 0.25, PyBullet's density",
    )
