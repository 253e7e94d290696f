"""What legged robots share: MJCF and actuators in, joint servos by control mode; twist in, joint targets out.

A gait is a pure function of the twist command, the robot's state and the clock, run at every physics step. Its
targets are `home + reference(phase, command) + scale * tanh(network(observation))`: a scripted stepping motion,
corrected by a small network where one was trained (`python -m train.gait`); its weights lie in `gaits/`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from interactive_nav.robots.spec import ControlLaw, RobotState
from interactive_nav_common.rotations import rotate_back

GAITS = Path(__file__).parent / "gaits"
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
    """A robot's gait: its scripted motion, and all that training a correction needs to know."""

    robot: str
    joints: tuple[str, ...]
    """Driven joints, in the order of the actuators; J of them."""
    home: tuple[float, ...]
    """[J] rad."""
    ranges: tuple[tuple[float, float], ...]
    """[J] least and largest target, rad."""
    action_scale: tuple[float, ...]
    """[J] largest correction of each target by the network, rad."""
    frequency_hz: float
    """Cycles a second."""
    reference: Callable[[Any, Any, BaseMotion, Any], Any]
    """(phase [...], command [..., 2], base, numpy or jax.numpy) -> target offsets from home [..., J], rad."""
    tracked: tuple[int, ...]
    """Joints whose reference training rewards following."""
    max_linear_m_s: float
    max_angular_rad_s: float
    servo: Servo
    torque_nm: tuple[float, ...]
    fall_height_m: float
    """Base below this: fallen."""
    offsets: tuple[int, ...] = ()
    """Driven joints among the robot's joints after the free one; by default the first J."""

    @property
    def joint_index(self) -> np.ndarray:
        """[J] position of each driven joint after the free joint."""
        return np.asarray(self.offsets or range(len(self.joints)))

    @property
    def observation_size(self) -> int:
        """O: 14 numbers of the base, command and clock, and two per joint."""
        return 14 + 2 * len(self.joints)

    def command_range(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """(linear m/s, angular rad/s) at action -1 and +1: symmetric, so that action 0 stands."""
        most = (self.max_linear_m_s, self.max_angular_rad_s)
        return (-most[0], -most[1]), most


def phase_at(gait: Gait, time_s: Any) -> Any:
    """The gait's phase [...], rad."""
    return 2.0 * math.pi * gait.frequency_hz * time_s


def observe(gait: Gait, command: Any, state: RobotState, xp: Any) -> Any:
    """What the network sees, [..., O].

    Gravity's direction (3), linear and angular velocity (6) in the base frame, height of the base; joints from
    home and their velocities / 10; command over its maximum (2); cosine and sine of the phase.
    """
    qpos, qvel = state.qpos, state.qvel
    quat = qpos[..., 3:7]
    down = xp.zeros_like(qpos[..., :3]) + xp.asarray([0.0, 0.0, -1.0], dtype=qpos.dtype)
    joints = gait.joint_index
    phase = phase_at(gait, state.time_s)[..., None] + xp.zeros_like(qpos[..., :1])
    most = xp.asarray([gait.max_linear_m_s, gait.max_angular_rad_s], dtype=qpos.dtype)
    return xp.concatenate(
        [
            rotate_back(quat, down),
            rotate_back(quat, qvel[..., :3]),
            qvel[..., 3:6],
            qpos[..., 2:3],
            qpos[..., 7 + joints] - xp.asarray(gait.home, dtype=qpos.dtype),
            0.1 * qvel[..., 6 + joints],
            command / most,
            xp.cos(phase),
            xp.sin(phase),
        ],
        -1,
    )


def targets(gait: Gait, command: Any, correction: Any, state: RobotState, xp: Any) -> Any:
    """Joint targets [..., J], rad, within the joints' ranges; `correction` [..., J] is in [-1, 1]."""
    low, high = xp.asarray(gait.ranges).T
    wanted = xp.asarray(gait.home) + gait.reference(phase_at(gait, state.time_s), command, base_motion(state, xp), xp)
    return xp.clip(wanted + xp.asarray(gait.action_scale) * correction, low, high)


@dataclasses.dataclass(frozen=True)
class Network:
    """A trained correction: a swish network whose tanh is the correction."""

    mean: np.ndarray
    """[O] of the observations."""
    deviation: np.ndarray
    """[O]"""
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Kernels [in, out] and biases [out]; the last layer has J outputs."""

    def __call__(self, observation: Any, xp: Any) -> Any:
        """[..., O] to corrections [..., J] in [-1, 1]."""
        x = xp.clip((observation - xp.asarray(self.mean)) / xp.asarray(self.deviation), -10.0, 10.0)
        for i, (kernel, bias) in enumerate(self.layers):
            x = x @ xp.asarray(kernel) + xp.asarray(bias)
            if i + 1 < len(self.layers):
                x = x * 0.5 * (1.0 + xp.tanh(0.5 * x))
        return xp.tanh(x)


def save_network(network: Network, path: Path) -> None:
    """Writes weights as float16, statistics as float32."""
    arrays = {"mean": network.mean.astype(np.float32), "deviation": network.deviation.astype(np.float32)}
    for i, (kernel, bias) in enumerate(network.layers):
        arrays |= {f"kernel_{i}": kernel.astype(np.float16), f"bias_{i}": bias.astype(np.float16)}
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


@functools.cache
def load_network(path: Path) -> Network:
    """Reads what `save_network` wrote."""
    with np.load(path) as file:
        count = sum(name.startswith("kernel_") for name in file.files)
        layers = tuple(
            (file[f"kernel_{i}"].astype(np.float32), file[f"bias_{i}"].astype(np.float32)) for i in range(count)
        )
        return Network(file["mean"], file["deviation"], layers)


def scripted_gait(gait: Gait) -> ControlLaw:
    """Twist to joint targets by the reference motion alone."""

    def law(command, state, xp):
        return targets(gait, command, 0.0, state, xp)

    return law


def learned_gait(gait: Gait, network: Network) -> ControlLaw:
    """Twist to joint targets with the network's corrections."""

    def law(command, state, xp):
        return targets(gait, command, network(observe(gait, command, state, xp), xp), state, xp)

    return law


def gait_law(gait: Gait) -> ControlLaw:
    """Twist to joint targets: corrected by the network in `gaits/<robot>.npz` where there is one."""
    path = GAITS / f"{gait.robot}.npz"
    return learned_gait(gait, load_network(path)) if path.is_file() else scripted_gait(gait)
