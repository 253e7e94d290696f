"""Humanoid: nothing in, its `RobotSpec` out.

Shape, masses (42.1 kg), joints and their springs are those of the MuJoCo and GibsonEnv `humanoid.xml`; torque
limits are iGibson's gains times 0.41. Two things are ours. The feet: the original's are spheres, on which no
stance without steps exists; here each is a capsule, 0.24 m long, of the same mass and the same sole height. And
limbs do not collide with each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from interactive_nav.robots.gait import Legged, Servo, legged_robot
from interactive_nav.robots.spec import RobotCamera, RobotSpec

_THIGH_RAD, _SHIN_RAD = 0.2, 0.24
"""Thighs lean forward and shins back by this in the home pose; the soles are level then, under the centre of mass."""

_LEG = {"hip_x": 0.0, "hip_z": 0.0, "hip_y": -_THIGH_RAD, "knee": -_THIGH_RAD - _SHIN_RAD}
_HOME = {
    **{"abdomen_z": 0.0, "abdomen_y": 0.0, "abdomen_x": 0.0},
    **{f"{side}_{joint}": angle for side in ("right", "left") for joint, angle in _LEG.items()},
    **{"right_shoulder1": 0.67, "right_shoulder2": -0.51, "right_elbow": -1.47},
    **{"left_shoulder1": -0.67, "left_shoulder2": 0.51, "left_elbow": -1.47},
}
"""Joint -> rad."""
JOINTS = tuple(f"humanoid_{name}" for name in _HOME)


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


_FIGURES = {
    # Told to go; told to stand: it steps only where it must.
    "frequency_hz": (2.15, 2.15),
    "hip_lift": (0.179, 0.273),
    "knee_lift": (0.414, 0.478),
    "sway": (0.141, 0.201),
    "sway_phase": (0.326, 0.226),
    "waist": (-0.16, -0.18),
    "stride": (0.624, 0.778),
    "lean": (0.401, 0.305),
    "width": (0.034, 0.021),
    "bend": (0.145, -0.018),
    "place_forward": (0.427, 0.639),
    "place_side": (0.935, 0.77),
    "pitch": (0.705, 0.562),
    "pitch_rate": (0.067, 0.094),
    "roll": (0.937, 1.057),
    "roll_rate": (0.23, 0.194),
    "swing_pitch": (1.385, 1.039),
    "waist_roll": (-0.357, -0.549),
    "turn": (0.696, 0.764),
    "slip": (0.333, 0.224),
    "step_speed": (4.0, 8.327),
    "step_lean": (6.0, 10.492),
    "step_threshold": (0.6, 0.8),
}
WALK, STAND = (Stepping(**dict(zip(_FIGURES, own, strict=True))) for own in zip(*_FIGURES.values(), strict=True))


def _reference(phase, command, base, xp):
    """The walk of `Stepping` p as offsets from home, [..., 17]; it stands when neither told nor forced to step."""
    forward, turn = command[..., 0], command[..., 1]
    told = xp.clip(10.0 * xp.abs(forward) + 5.0 * xp.abs(turn), 0.0, 1.0)
    p = Stepping(*(told * a + (1.0 - told) * b for a, b in zip(WALK, STAND, strict=True)))
    speed = xp.sqrt(base.forward**2 + base.left**2 + 1e-6)
    forced = p.step_speed * speed + p.step_lean * (xp.abs(base.pitch) + xp.abs(base.roll)) - p.step_threshold
    going = xp.clip(xp.maximum(told, forced), 0.0, 1.0)
    forward = forward + p.slip * going
    sway = going * xp.cos(phase - p.sway_phase)
    out = {name: 0.0 * forward for name in _HOME}
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
    return xp.stack([out[name] for name in _HOME], -1)


LEGS = Legged(
    name="humanoid",
    base_body="torso",
    joints=JOINTS,
    home=tuple(_HOME.values()),
    servo=Servo(stiffness=400.0, damping=15.0, velocity_gain=60.0),
    max_speed_rad_s=8.0,
    frequency_hz=WALK.frequency_hz,
    reference=_reference,
    max_linear_m_s=0.35,
    max_angular_rad_s=0.5,
)


def _spawn_height_m() -> float:
    thigh, shin = 0.383, 0.02 + 0.35
    return 0.26 + 0.165 + 0.04 + thigh * math.cos(_THIGH_RAD) + shin * math.cos(_SHIN_RAD) + 0.075


def humanoid(control_mode: str = "native") -> RobotSpec:
    """The Humanoid's spec.

    Args:
        control_mode: `native`, seventeen joint torques; `position` or `velocity` of each joint; or `twist`,
            linear and angular velocity of the base through its gait, which also balances it.

    Raises:
        ConfigError: unknown mode.
    """
    return legged_robot(
        LEGS,
        control_mode,
        body_width_m=0.42,
        footprint_radius_m=0.35,
        height_m=1.57,
        spawn_height_m=_spawn_height_m(),
        camera=RobotCamera("humanoid_torso", (0.0, 0.0, 0.19)),
        mass_kg=42.116,
        size_m=(0.28, 0.58, 1.56),
        drive_type="2 legs, 17 hinges",
        source="MuJoCo and GibsonEnv humanoid.xml; feet are ours",
        contact_time_constant_s=0.04,
    )
