"""Build Minitaur's `RobotSpec`.

Masses (6.0 kg), motor positions and link lengths are those of GibsonEnv's `minitaur.urdf`, whose inertias are
placeholders; here they follow from the shapes. A leg is a closed chain: two upper links on a motor each, one
fore and one aft, and two lower links that a `connect` constraint joins at the toe. Bodies are authored in the
original's reset pose (motors at pi/2, knees at -2.1834 rad), where the chains are closed.

A motor's angle is that of its upper link from straight down, positive outwards: a smaller angle is a longer leg.
Torque is bounded to the motor's 3.5 N m. Ours: all links of a leg in one plane, the servo's gains, the ranges,
which keep the chains from folding through themselves, and no collisions of the robot's parts with each other.
"""

import dataclasses
import math
from typing import Any

from interactive_nav.robots.gait import legged_robot, legged_row
from interactive_nav.robots.spec import RobotSpec

_UPPER_M, _LOWER_M, _FOOT_Y_M = 0.115, 0.2, 0.107
_DROP_M = math.sqrt(_LOWER_M**2 - _UPPER_M**2)
_KNEE_HOME_RAD = math.atan2(_DROP_M, _UPPER_M) - math.pi
_LEGS = (("front_left", 1, 1), ("back_left", -1, 1), ("front_right", 1, -1), ("back_right", -1, -1))
"""Name, sign of x, sign of y; the original's order of motors."""
_ROW = legged_row("minitaur").legs
_LIFT_RAD = 0.285
_PRESS = 0.17
"""Legs on the ground push down by this share of the lift."""
_LAG_RAD = 0.47
"""Of the phase by which the sweep leads the lift."""
_STRIDE_GAIN, _TURN_GAIN = 0.615, 4.63
"""Over the kinematic sweep: for servos that lag and feet that slip. All six by a random search for tracking."""


def _reference(phase, command, base, xp):
    """Trot, with offsets from home [..., 8]: diagonal legs together; strides of left and right differ in a turn."""
    del base
    forward, turn = command[..., 0], command[..., 1]
    effort = xp.clip(8.0 * xp.abs(forward) + 3.0 * xp.abs(turn), 0.0, 1.0)
    out = []
    for _, x, y in _LEGS:
        at = phase + (0.0 if x * y > 0 else math.pi)
        # A foot on the ground sweeps v / (2 f), 0.164 m below its hip.
        speed = _STRIDE_GAIN * forward - y * _TURN_GAIN * _FOOT_Y_M * turn
        swing = -speed / (4.0 * _ROW.frequency_hz) / _DROP_M * xp.cos(at + _LAG_RAD)
        lift = _LIFT_RAD * effort * (xp.maximum(xp.sin(at), 0.0) - _PRESS)
        out += [swing + lift, -swing + lift]
    return xp.stack(out, -1)


LEGS = dataclasses.replace(_ROW, reference=_reference)


def _leg_angles(command, state, xp):
    """Convert swing, then extension of each leg, [..., 8] in [-1, 1], to motor angles: the original's coordinates."""
    del state
    swing, extension = command[..., :4], command[..., 4:]
    middle = math.pi - 0.25 * math.pi * (extension + 1.5)
    angles = xp.stack([middle + 0.25 * math.pi * swing, middle - 0.25 * math.pi * swing], -1)
    return xp.clip(angles.reshape((*angles.shape[:-2], 8)), *LEGS.ranges[0])


def minitaur(control_mode: str = "native") -> RobotSpec:
    """Return Minitaur's spec."""
    parts = (("motor", LEGS.home[0]), ("knee", _KNEE_HOME_RAD))
    home = tuple((joint.replace("motor", part), value) for joint in LEGS.joints for part, value in parts)
    figures: dict[str, Any] = {"home_qpos": home}
    if control_mode == "leg":
        names = tuple(f"{leg} {what}" for what in ("swing", "extension") for leg, _, _ in _LEGS)
        figures |= {"action_low": (-1.0,) * 8, "action_high": (1.0,) * 8, "action_names": names, "control": _leg_angles}
    return legged_robot(LEGS, control_mode, **figures)
