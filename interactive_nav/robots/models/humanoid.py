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

# name: (range in degrees, torque in N m, home in rad)
_LEG: dict[str, tuple[tuple[float, float], float, float]] = {
    "hip_x": ((-25, 5), 41.0, 0.0),
    "hip_z": ((-60, 35), 41.0, 0.0),
    "hip_y": ((-120, 20), 123.0, -_THIGH_RAD),
    "knee": ((-160, -2), 82.0, -_THIGH_RAD - _SHIN_RAD),
}
_TABLE: dict[str, tuple[tuple[float, float], float, float]] = {
    "abdomen_z": ((-45, 45), 41.0, 0.0),
    "abdomen_y": ((-75, 30), 41.0, 0.0),
    "abdomen_x": ((-35, 35), 41.0, 0.0),
    **{f"{side}_{joint}": facts for side in ("right", "left") for joint, facts in _LEG.items()},
    "right_shoulder1": ((-85, 60), 30.75, 0.67),
    "right_shoulder2": ((-85, 60), 30.75, -0.51),
    "right_elbow": ((-90, 50), 30.75, -1.47),
    "left_shoulder1": ((-60, 85), 30.75, -0.67),
    "left_shoulder2": ((-60, 85), 30.75, 0.51),
    "left_elbow": ((-90, 50), 30.75, -1.47),
}
JOINTS = tuple(f"humanoid_{name}" for name in _TABLE)


def _joint(name: str, axis: str, pos: str = "0 0 0", kind: str = "humanoid") -> str:
    (low, high), torque, _ = _TABLE[name]
    return (
        f'<joint name="{name}" class="{kind}" axis="{axis}" pos="{pos}" '
        f'range="{math.radians(low)} {math.radians(high)}" actuatorfrcrange="{-torque} {torque}"/>'
    )


def _leg(side: str, y: int) -> str:
    """`y` is -1 on the right; hips mirror their axes there, so that equal angles are mirror images."""
    return f"""
          <body name="{side}_thigh" pos="0 {y * 0.1} -0.04">
            {_joint(f"{side}_hip_x", f"{-y} 0 0", kind="humanoid_hip")}
            {_joint(f"{side}_hip_z", f"0 0 {-y}", kind="humanoid_hip")}
            {_joint(f"{side}_hip_y", "0 1 0", kind="humanoid_hip_y")}
            <geom name="{side}_thigh" fromto="0 0 0 0 {-y * 0.01} -0.34" size="0.06"/>
            <body name="{side}_shin" pos="0 {-y * 0.01} -0.403">
              {_joint(f"{side}_knee", "0 -1 0", "0 0 0.02", "humanoid_knee")}
              <geom name="{side}_shin" fromto="0 0 0 0 0 -0.3" size="0.049"/>
              <body name="{side}_foot" pos="0 0 -0.35" euler="0 {-_SHIN_RAD} 0">
                <geom name="{side}_foot" fromto="-0.05 0 -0.03 0.1 0 -0.03" size="0.045" mass="1.767"/>
              </body>
            </body>
          </body>"""


def _arm(side: str, y: int) -> str:
    return f"""
      <body name="{side}_upper_arm" pos="0 {y * 0.17} 0.06">
        {_joint(f"{side}_shoulder1", f"2 {-y} 1", kind="humanoid_shoulder1")}
        {_joint(f"{side}_shoulder2", f"0 {y} 1", kind="humanoid_shoulder2")}
        <geom name="{side}_upper_arm" fromto="0 0 0 0.16 {y * 0.16} -0.16" size="0.04"/>
        <body name="{side}_lower_arm" pos="0.18 {y * 0.18} -0.18">
          {_joint(f"{side}_elbow", f"0 -1 {-y}", kind="humanoid_elbow")}
          <geom name="{side}_lower_arm" fromto="0.01 {-y * 0.01} 0.01 0.17 {-y * 0.17} 0.17" size="0.031"/>
          <geom name="{side}_hand" type="sphere" pos="0.18 {-y * 0.18} 0.18" size="0.04"/>
        </body>
      </body>"""


MJCF = f"""
<mujoco model="humanoid">
  <compiler angle="radian"/>
  <default>
    <default class="humanoid">
      <joint type="hinge" stiffness="10" damping="5" armature="0.02"/>
      <geom type="capsule" contype="0" conaffinity="1" density="1000" friction="1 0.005 0.0001" group="3"/>
      <default class="humanoid_hip"><joint armature="0.01"/></default>
      <default class="humanoid_hip_y"><joint stiffness="20" armature="0.01"/></default>
      <default class="humanoid_knee"><joint stiffness="1" damping="1" armature="0.006"/></default>
      <default class="humanoid_shoulder1"><joint stiffness="1" damping="1" armature="0.0068"/></default>
      <default class="humanoid_shoulder2"><joint stiffness="1" damping="1" armature="0.0051"/></default>
      <default class="humanoid_elbow"><joint stiffness="0" damping="1" armature="0.0028"/></default>
    </default>
  </default>
  <worldbody>
    <body name="torso" childclass="humanoid">
      <freejoint name="free"/>
      <geom name="torso" fromto="0 -0.07 0 0 0.07 0" size="0.07"/>
      <geom name="head" type="sphere" pos="0 0 0.19" size="0.09"/>
      <geom name="upper_waist" fromto="-0.01 -0.06 -0.12 -0.01 0.06 -0.12" size="0.06"/>
      <site name="eyes" pos="0 0 0.19" size="0.01"/>
      <camera name="eyes" pos="0 0 0.19" xyaxes="0 -1 0 0 0 1" fovy="120"/>
      <body name="lower_waist" pos="-0.01 0 -0.26">
        {_joint("abdomen_z", "0 0 1", "0 0 0.065").replace("/>", ' stiffness="20"/>')}
        {_joint("abdomen_y", "0 1 0", "0 0 0.065")}
        <geom name="lower_waist" fromto="0 -0.06 0 0 0.06 0" size="0.06"/>
        <body name="pelvis" pos="0 0 -0.165">
          {_joint("abdomen_x", "1 0 0", "0 0 0.1")}
          <geom name="pelvis" fromto="-0.02 -0.07 0 -0.02 0.07 0" size="0.09"/>
          {_leg("right", -1)}
          {_leg("left", 1)}
        </body>
      </body>
      {_arm("right", -1)}
      {_arm("left", 1)}
    </body>
  </worldbody>
</mujoco>
"""


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
    out = {name: 0.0 * forward for name in _TABLE}
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
    return xp.stack([out[name] for name in _TABLE], -1)


LEGS = Legged(
    name="humanoid",
    mjcf=MJCF,
    base_body="torso",
    joints=JOINTS,
    home=tuple(home for _, _, home in _TABLE.values()),
    ranges=tuple((math.radians(low), math.radians(high)) for (low, high), _, _ in _TABLE.values()),
    torque_nm=tuple(torque for _, torque, _ in _TABLE.values()),
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
