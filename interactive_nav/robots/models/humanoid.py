"""Build Humanoid's `RobotSpec`.

Shape, masses (42.1 kg), joints and their springs are those of the MuJoCo and GibsonEnv `humanoid.xml`; torque
limits are iGibson's gains times 0.41. Two things are ours. The feet: the original's are spheres, on which no
stance without steps exists; here each is a capsule, 0.24 m long, of the same mass and the same sole height. And
limbs do not collide with each other.

Control modes: `native`, seventeen joint torques; `position` or `velocity` of each joint; or `twist`, linear and angular
velocity of the base through its gait, which also balances it.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

from interactive_nav.robots.gait import legged_robot, legged_row

_ROW = legged_row("humanoid")
_JOINTS = tuple(name.removeprefix("humanoid_") for name in _ROW.legs.joints)


class Stepping(NamedTuple):
    """A walk with feedback, after SIMBICON (Yin et al. 2007): the leg in swing steps to where the body falls, the
    leg in stance holds the torso upright. Figures by the cross-entropy method over random twists and pushes."""

    frequency_hz: float
    hip_lift: float
    knee_lift: float
    sway: float
    """Of the hips towards the leg in stance, rad."""
    sway_phase: float
    waist: float
    """Of the waist against the sway, rad."""
    stride: float
    """Hip swing over that of a step of v / (2 f)."""
    lean: float
    """Of the thighs, rad per m/s."""
    width: float
    """Outward hips, rad."""
    bend: float
    """Of the waist forward, rad per m/s."""
    place_forward: float
    """Hip of the swing leg, rad per m/s of velocity error."""
    place_side: float
    """The same sideways, rad per m/s."""
    pitch: float
    pitch_rate: float
    roll: float
    roll_rate: float
    """Hips of the stance leg, rad per rad and per rad/s."""
    swing_pitch: float
    """Hip of the swing leg against the torso's lean, rad per rad."""
    waist_roll: float
    turn: float
    """Hip yaw over that of a turn of w / (2 f) a step."""
    slip: float
    """Velocity by which the walk lags behind, m/s."""
    step_speed: float
    step_lean: float
    step_threshold: float
    """Untold, it steps in so far as step_speed * speed + step_lean * (|pitch| + |roll|) exceeds the threshold."""


WALK, STAND = (Stepping(**dict(zip(_ROW.gait, row, strict=True))) for row in zip(*_ROW.gait.values(), strict=True))


def _reference(phase, command, base, xp):
    """Return the walk of `Stepping` p as offsets from home, [..., 17]; without command or force to step it stands."""
    forward, turn = command[..., 0], command[..., 1]
    commanded = xp.clip(10.0 * xp.abs(forward) + 5.0 * xp.abs(turn), 0.0, 1.0)
    p = Stepping(*(commanded * a + (1.0 - commanded) * b for a, b in zip(WALK, STAND, strict=True)))
    speed = xp.sqrt(base.forward**2 + base.left**2 + 1e-6)
    forced = p.step_speed * speed + p.step_lean * (xp.abs(base.pitch) + xp.abs(base.roll)) - p.step_threshold
    going = xp.clip(xp.maximum(commanded, forced), 0.0, 1.0)
    forward = forward + p.slip * going
    sway = going * xp.cos(phase - p.sway_phase)
    out = {name: 0.0 * forward for name in _JOINTS}
    for side, shift, left in (("right", 0.0, -1.0), ("left", math.pi, 1.0)):
        swing = going * xp.maximum(xp.sin(phase + shift), 0.0)
        stance = 1.0 - swing
        stride = p.stride * forward / (4.0 * p.frequency_hz) / 0.75 * xp.cos(phase + shift)
        out[f"{side}_hip_y"] = (
            stride
            - p.hip_lift * swing
            - p.lean * forward
            - swing * (p.place_forward * (base.forward - forward) + p.swing_pitch * base.pitch)
            + stance * (p.pitch * base.pitch + p.pitch_rate * base.pitch_rate)
        )
        out[f"{side}_knee"] = -p.knee_lift * swing
        out[f"{side}_hip_x"] = -p.width * going - left * (
            p.sway * sway
            + swing * p.place_side * base.left
            # On both feet this would push to and fro: the legs, the floor and the hips are one closed chain.
            + going * stance * (p.roll * base.roll + p.roll_rate * base.roll_rate)
        )
        out[f"{side}_hip_z"] = left * p.turn * turn / (4.0 * p.frequency_hz) * xp.cos(phase + shift)
    out["abdomen_x"] = p.waist * sway + p.waist_roll * base.roll
    out["abdomen_y"] = p.bend * forward
    return xp.stack([out[name] for name in _JOINTS], -1)


LEGS = dataclasses.replace(_ROW.legs, reference=_reference)
humanoid = functools.partial(legged_robot, LEGS)
