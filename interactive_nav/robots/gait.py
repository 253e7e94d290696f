"""What legged robots share: MJCF and actuators in, joint servos by control mode; twist in, joint targets out.

A gait is a pure function of the twist command, the robot's state and the clock, run at every physics step: its
targets are `home + reference(phase, command, base)`, a scripted stepping motion.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco

from interactive_nav.robots.spec import ControlLaw, RobotState

GRAVITY_M_S2 = 9.81


@dataclasses.dataclass(frozen=True)
class Servo:
    """Gains of a robot's joint servos; torque is bounded by the joints (`actuatorfrcrange`)."""

    stiffness: float
    """Position mode, N m/rad."""
    damping: float
    """Position mode, N m s/rad."""
    velocity_gain: float
    """Velocity mode, N m s/rad."""


def check_mode(robot: str, mode: str, known: tuple[str, ...]) -> None:
    """Raises ValueError for a control mode that the robot does not have."""
    if mode not in known:
        raise ValueError(f"robot '{robot}' has no control mode '{mode}'; it has {', '.join(known)}")


def attach(spec: mujoco.MjSpec, mjcf: str, prefix: str) -> None:
    """Attaches a robot's MJCF (one body with a free joint) to a world; every name gets the prefix."""
    robot = mujoco.MjSpec.from_string(mjcf)
    spec.worldbody.add_frame().attach_body(robot.worldbody.first_body(), prefix, "")


def add_servos(
    spec: mujoco.MjSpec,
    joints: tuple[str, ...],
    mode: str,
    servo: Servo,
    torque_nm: tuple[float, ...],
    ranges_rad: tuple[tuple[float, float], ...],
) -> None:
    """One actuator per joint, named like it: torque (`native`, `torque`), velocity, or position otherwise."""
    for joint, torque, limits in zip(joints, torque_nm, ranges_rad, strict=True):
        gain, bias, control = 1.0, (0.0, 0.0, 0.0), (-torque, torque)
        if mode == "velocity":
            gain, bias, control = servo.velocity_gain, (0.0, 0.0, -servo.velocity_gain), (-100.0, 100.0)
        elif mode not in ("native", "torque"):
            gain, bias, control = servo.stiffness, (0.0, -servo.stiffness, -servo.damping), limits
        spec.add_actuator(
            name=joint,
            target=joint,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE if any(bias) else mujoco.mjtBias.mjBIAS_NONE,
            gainprm=[gain] + [0.0] * 9,
            biasprm=[*bias] + [0.0] * 7,
            ctrllimited=True,
            ctrlrange=list(control),
        )


def joint_command_range(
    mode: str, torque_nm: tuple[float, ...], ranges_rad: tuple[tuple[float, float], ...], speed_rad_s: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Commands at action -1 and +1 of a mode that drives joints: torques, positions or velocities."""
    if mode == "position":
        return tuple(low for low, _ in ranges_rad), tuple(high for _, high in ranges_rad)
    most = (speed_rad_s,) * len(torque_nm) if mode == "velocity" else torque_nm
    return tuple(-m for m in most), most


def joint_units(joints: tuple[str, ...], mode: str) -> tuple[str, ...]:
    """Action names with units."""
    if mode == "twist":
        return ("forward m/s", "turn rad/s")
    unit = {"position": "rad", "velocity": "rad/s"}.get(mode, "N m")
    return tuple(f"{joint.split('_', 1)[1]} {unit}" for joint in joints)


class BaseMotion(NamedTuple):
    """How the base leans and moves, in the frame that has its heading; each [...]."""

    pitch: Any
    """Forward lean, rad."""
    roll: Any
    """Lean to the right, rad."""
    pitch_rate: Any
    roll_rate: Any
    forward: Any
    """m/s"""
    left: Any
    """m/s"""


def base_motion(state: RobotState, xp: Any) -> BaseMotion:
    """The base's lean and velocity in its heading frame."""
    w, x, y, z = (state.qpos[..., 3 + k] for k in range(4))
    up_x, up_y, up_z = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    heading = xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    cos, sin = xp.cos(heading), xp.sin(heading)
    vx, vy = state.qvel[..., 0], state.qvel[..., 1]
    return BaseMotion(
        pitch=xp.arctan2(-up_x, up_z),
        roll=xp.arctan2(up_y, up_z),
        pitch_rate=state.qvel[..., 4],
        roll_rate=state.qvel[..., 3],
        forward=cos * vx + sin * vy,
        left=-sin * vx + cos * vy,
    )


@dataclasses.dataclass(frozen=True)
class Gait:
    """A robot's gait: its scripted motion and the limits that hold for it."""

    home: tuple[float, ...]
    """[J] rad, of the driven joints in the order of the actuators."""
    ranges: tuple[tuple[float, float], ...]
    """[J] least and largest target, rad."""
    frequency_hz: float
    """Cycles a second."""
    reference: Callable[[Any, Any, BaseMotion, Any], Any]
    """(phase [...], command [..., 2], base, numpy or jax.numpy) -> target offsets from home [..., J], rad."""
    max_linear_m_s: float
    max_angular_rad_s: float
    torque_nm: tuple[float, ...]

    def command_range(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """(linear m/s, angular rad/s) at action -1 and +1: symmetric, so that action 0 stands."""
        most = (self.max_linear_m_s, self.max_angular_rad_s)
        return (-most[0], -most[1]), most


def rotate_to_body(quat: Any, vector: Any, xp: Any) -> Any:
    """World vectors [..., 3] in the frame of a body with quaternion [..., 4] (w x y z)."""
    w, axis = quat[..., :1], -quat[..., 1:]
    t = 2.0 * xp.cross(axis, vector)
    return vector + w * t + xp.cross(axis, t)


def gait_law(gait: Gait) -> ControlLaw:
    """Twist to joint targets [..., J], rad, within the joints' ranges."""

    def law(command, state, xp):
        phase = 2.0 * math.pi * gait.frequency_hz * state.time_s
        low, high = xp.asarray(gait.ranges).T
        wanted = xp.asarray(gait.home) + gait.reference(phase, command, base_motion(state, xp), xp)
        return xp.clip(wanted, low, high)

    return law
