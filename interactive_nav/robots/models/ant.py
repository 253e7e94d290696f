"""Build Ant's `RobotSpec`.

Shape and joints are those of the MuJoCo and GibsonEnv Ant (`ant.xml`) at GibsonEnv's default scale of 0.25:
at full size it is 1.39 m wide and passes no door. Two readings of that file's mass exist, 0.911 kg (MuJoCo,
density 5) and 182 kg (PyBullet, density 1000), both at scale 1. Ours is the second at scale 0.25: 182 / 4^3 =
2.85 kg. Torques follow gravity's, which goes with the fourth power of the scale: the original's 250 N m become
250 / 4^4 = 0.98 N m, twice what the ankles need to stand.

Control modes: `native`, eight joint torques (hip, ankle of legs 1 to 4: front left, back left, back right, front
right); `position` or `velocity` of each joint; or `twist`, linear and angular velocity of the base through its gait.
"""

import dataclasses
import functools
import math

from interactive_nav.robots.gait import legged_robot, legged_row

_ANKLE_SIGN = (1.0, -1.0, -1.0, 1.0)
_ROW = legged_row("ant").legs
_LIFT_RAD = 0.325
_PRESS = 0.1
"""Legs on the ground push down by this share of the lift."""
_STRIDE_GAIN, _TURN_GAIN = 1.07, 1.16
"""Over the kinematic sweep: for servos that lag and feet that slip. All five by a random search for tracking."""
_REACH_M = 0.104
"""Forward travel of a foot per radian of its hip, at home."""


def _reference(phase, command, base, xp):
    """Trot, offsets from home [..., 8]: diagonal pairs swing half a cycle apart; a leg in swing lifts its ankle."""
    del base
    forward, turn = command[..., 0], command[..., 1]
    effort = xp.clip(8.0 * xp.abs(forward) + 2.0 * xp.abs(turn), 0.0, 1.0)
    offsets = []
    for sign, (x, y) in zip(_ANKLE_SIGN, ((1, 1), (-1, 1), (-1, -1), (1, -1)), strict=True):
        at = phase + (0.0 if x * y > 0 else math.pi)
        # A foot on the left (y > 0) goes forward when its hip turns clockwise, one on the right the other way.
        sweep = (_TURN_GAIN * turn - y * _STRIDE_GAIN * forward / _REACH_M) / (4.0 * _ROW.frequency_hz)
        offsets.append(-sweep * xp.cos(at))
        offsets.append(-sign * _LIFT_RAD * effort * (xp.maximum(xp.sin(at), 0.0) - _PRESS))
    return xp.stack(offsets, -1)


LEGS = dataclasses.replace(_ROW, reference=_reference)
ant = functools.partial(legged_robot, LEGS)
