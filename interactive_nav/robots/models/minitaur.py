"""Minitaur: nothing in, its `RobotSpec` out.

Masses (6.0 kg), motor positions and link lengths are those of GibsonEnv's `minitaur.urdf`, whose inertias are
placeholders; here they follow from the shapes. A leg is a closed chain: two upper links on a motor each, one
fore and one aft, and two lower links that a `connect` constraint joins at the toe. Bodies are authored in the
original's reset pose (motors at pi/2, knees at -2.1834 rad), where the chains are closed.

A motor's angle is that of its upper link from straight down, positive outwards: a smaller angle is a longer leg.
Torque is bounded to the motor's 3.5 N m. Ours: all links of a leg in one plane, the servo's gains, the ranges,
which keep the chains from folding through themselves, and no collisions of the robot's parts with each other.
"""

from __future__ import annotations

import math
from typing import Any

from interactive_nav.robots.gait import Legged, Servo, legged_robot
from interactive_nav.robots.spec import RobotCamera, RobotSpec

UPPER_M, LOWER_M = 0.115, 0.2
HIP_X_M, FOOT_Y_M = 0.21, 0.107
TOE_RADIUS_M = 0.0125
TORQUE_NM = 3.5
HOME_RAD = math.pi / 2
_DROP_M = math.sqrt(LOWER_M**2 - UPPER_M**2)
_KNEE_HOME_RAD = math.atan2(_DROP_M, UPPER_M) - math.pi
_MOTOR_RANGE = (0.5, 2.7)
_KNEE_RANGE = (-2.95, -0.6)
_LEGS = (("front_left", 1, 1), ("back_left", -1, 1), ("front_right", 1, -1), ("back_right", -1, -1))
"""Name, sign of x, sign of y; the original's order of motors."""
JOINTS = tuple(f"minitaur_motor_{leg}_{link}" for leg, _, _ in _LEGS for link in ("fore", "aft"))


def _chain(leg: str, link: str, x: int) -> str:
    """One upper and lower link; `x` is +1 for the fore one."""
    knee, toe = x * UPPER_M, -x * UPPER_M
    tip = f'<geom name="toe_{leg}" class="minitaur_toe" pos="{toe} 0 {-_DROP_M}"/>' if x > 0 else ""
    return f"""
        <body name="upper_{leg}_{link}">
          <joint name="motor_{leg}_{link}" class="minitaur_motor" axis="0 {-x} 0"/>
          <geom name="upper_{leg}_{link}" class="minitaur_link" fromto="0 0 0 {knee} 0 0"/>
          <body name="lower_{leg}_{link}" pos="{knee} 0 0">
            <joint name="knee_{leg}_{link}" class="minitaur_knee" axis="0 {-x} 0"/>
            <geom name="lower_{leg}_{link}" class="minitaur_link" fromto="0 0 0 {toe} 0 {-_DROP_M}"/>
            <site name="toe_{leg}_{link}" pos="{toe} 0 {-_DROP_M}" size="0.005"/>
            {tip}
          </body>
        </body>"""


def _leg(leg: str, x: int, y: int) -> str:
    motors = "".join(
        f'<geom name="{leg}_motor_{place}" type="box" size="0.0434 0.013 0.0434" mass="0.25" '
        f'pos="{x * HIP_X_M} {y * at} 0"/>'
        for place, at in (("outer", 0.125), ("inner", 0.06))
    )
    return f"""
      {motors}
      <body name="hip_{leg}" pos="{x * HIP_X_M} {y * FOOT_Y_M} 0">
        {_chain(leg, "fore", 1)}
        {_chain(leg, "aft", -1)}
      </body>"""


def _closure(leg: str) -> str:
    return f'<connect name="toe_{leg}" site1="toe_{leg}_fore" site2="toe_{leg}_aft"/>'


MJCF = f"""
<mujoco model="minitaur">
  <compiler angle="radian"/>
  <default>
    <default class="minitaur">
      <geom contype="0" conaffinity="1" friction="1 0.005 0.0001" group="3"/>
      <equality solref="0.02 1" solimp="0.99 0.999 0.001"/>
      <default class="minitaur_motor">
        <joint type="hinge" ref="{HOME_RAD}" range="{_MOTOR_RANGE[0]} {_MOTOR_RANGE[1]}" armature="0.01"
               actuatorfrcrange="{-TORQUE_NM} {TORQUE_NM}"/>
      </default>
      <default class="minitaur_knee">
        <joint type="hinge" ref="{_KNEE_HOME_RAD}" range="{_KNEE_RANGE[0]} {_KNEE_RANGE[1]}" armature="0.0002"
               damping="0.01"/>
      </default>
      <default class="minitaur_link"><geom type="capsule" size="0.006" mass="0.05"/></default>
      <default class="minitaur_toe"><geom type="sphere" size="{TOE_RADIUS_M}" mass="0"/></default>
    </default>
  </default>
  <worldbody>
    <body name="chassis" childclass="minitaur">
      <freejoint name="free"/>
      <geom name="chassis" type="box" size="0.165 0.05 0.035" mass="1.2"/>
      <geom name="chassis_left" type="box" size="0.085 0.05 0.025" pos="0 0.1 0" mass="0.9"/>
      <geom name="chassis_right" type="box" size="0.085 0.05 0.025" pos="0 -0.1 0" mass="0.9"/>
      <geom name="rail_left" type="box" size="0.17 0.04 0.02" pos="0 0.1 0" mass="0.1"/>
      <geom name="rail_right" type="box" size="0.17 0.04 0.02" pos="0 -0.1 0" mass="0.1"/>
      <site name="eyes" pos="0.3 0 0.05" size="0.005"/>
      <camera name="eyes" pos="0.3 0 0.05" xyaxes="0 -1 0 0 0 1" fovy="120"/>
      {"".join(_leg(*leg) for leg in _LEGS)}
    </body>
  </worldbody>
  <equality>
    {"".join(_closure(leg) for leg, _, _ in _LEGS)}
  </equality>
</mujoco>
"""

_FREQUENCY_HZ = 3.24
_LIFT_RAD = 0.285
_PRESS = 0.17
"""Legs on the ground push down by this share of the lift."""
_LAG_RAD = 0.47
"""Of the phase by which the sweep leads the lift."""
_STRIDE_GAIN, _TURN_GAIN = 0.615, 4.63
"""Over the kinematic sweep: for servos that lag and feet that slip. All six by a random search for tracking."""


def _reference(phase, command, base, xp):
    """Trot: diagonal legs together; strides of left and right differ in a turn. Offsets from home, [..., 8]."""
    del base
    forward, turn = command[..., 0], command[..., 1]
    effort = xp.clip(8.0 * xp.abs(forward) + 3.0 * xp.abs(turn), 0.0, 1.0)
    out = []
    for _, x, y in _LEGS:
        at = phase + (0.0 if x * y > 0 else math.pi)
        # A foot on the ground sweeps v / (2 f), 0.164 m below its hip.
        speed = _STRIDE_GAIN * forward - y * _TURN_GAIN * FOOT_Y_M * turn
        swing = -speed / (4.0 * _FREQUENCY_HZ) / _DROP_M * xp.cos(at + _LAG_RAD)
        lift = _LIFT_RAD * effort * (xp.maximum(xp.sin(at), 0.0) - _PRESS)
        out += [swing + lift, -swing + lift]
    return xp.stack(out, -1)


LEGS = Legged(
    name="minitaur",
    mjcf=MJCF,
    base_body="chassis",
    joints=JOINTS,
    home=(HOME_RAD,) * 8,
    ranges=(_MOTOR_RANGE,) * 8,
    torque_nm=(TORQUE_NM,) * 8,
    servo=Servo(stiffness=20.0, damping=0.35, velocity_gain=0.5),
    max_speed_rad_s=30.0,
    frequency_hz=_FREQUENCY_HZ,
    reference=_reference,
    max_linear_m_s=0.4,
    max_angular_rad_s=0.5,
    modes=("native", "position", "velocity", "torque", "leg", "twist"),
    native="position",
)


def _leg_angles(command, state, xp):
    """Swing then extension of each leg, [..., 8] in [-1, 1], to motor angles: the original's leg coordinates."""
    del state
    swing, extension = command[..., :4], command[..., 4:]
    middle = math.pi - 0.25 * math.pi * (extension + 1.5)
    angles = xp.stack([middle + 0.25 * math.pi * swing, middle - 0.25 * math.pi * swing], -1)
    return xp.clip(angles.reshape((*angles.shape[:-2], 8)), *_MOTOR_RANGE)


def minitaur(control_mode: str = "native") -> RobotSpec:
    """Minitaur's spec.

    Args:
        control_mode: `native` or `position`, eight desired motor angles; `velocity` or `torque` of the motors;
            `leg`, swing of the four legs, then their extension; or `twist`, linear and angular velocity of the
            base through a scripted trot.

    Raises:
        ConfigError: unknown mode.
    """
    figures: dict[str, Any] = {}
    if control_mode == "leg":
        names = tuple(f"{leg} {what}" for what in ("swing", "extension") for leg, _, _ in _LEGS)
        figures = {"action_low": (-1.0,) * 8, "action_high": (1.0,) * 8, "action_names": names, "control": _leg_angles}
    parts = (("motor", HOME_RAD), ("knee", _KNEE_HOME_RAD))
    return legged_robot(
        LEGS,
        control_mode,
        body_width_m=0.28,
        footprint_radius_m=0.36,
        height_m=0.23,
        spawn_height_m=_DROP_M + TOE_RADIUS_M,
        camera=RobotCamera("minitaur_chassis", (0.3, 0.0, 0.05)),
        home_qpos=tuple((joint.replace("motor", part), value) for joint in JOINTS for part, value in parts),
        mass_kg=6.0,
        size_m=(0.65, 0.28, 0.21),
        drive_type="4 closed-chain legs, 8 motors",
        source="GibsonEnv minitaur.urdf; iGibson's motor model",
        **figures,
    )
