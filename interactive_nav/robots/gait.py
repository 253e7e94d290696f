"""Build one `RobotSpec` per control mode from a row of `models/legged.yaml`, a gait and `mjcf/<robot>.xml`.

A gait is a pure function of the twist command, the robot's state and the clock, run at every physics step: its
targets are `home + reference(phase, command, base)`, a scripted stepping motion.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco

from interactive_nav.robots.build import FOLDER
from interactive_nav.robots.files import read_file
from interactive_nav.robots.spec import (
    ControlLaw,
    Figures,
    RobotSpec,
    RobotState,
    TwistMap,
    check_mode,
    set_servo,
)
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import yaw_from_quat


@dataclasses.dataclass(frozen=True)
class Servo:
    """Gains of a robot's joint servos; torque is bounded by the joints (`actuatorfrcrange`)."""

    stiffness: float
    """Position mode, N m/rad."""
    damping: float
    """Position mode, N m s/rad."""
    velocity_gain: float
    """Velocity mode, N m s/rad."""


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
    """Return the base's lean and velocity in its heading frame."""
    quat = state.qpos[..., 3:7]
    w, x, y, z = (quat[..., k] for k in range(4))
    up_x, up_y, up_z = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    heading = yaw_from_quat(quat)
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
class Legged:
    """A legged robot's body, its J driven joints and its gait."""

    name: str
    base_body: str
    """Of the file, with the free joint `free`; names there are without the robot's in front."""
    joints: tuple[str, ...]
    """[J] names in the model; their actuators have the same."""
    home: tuple[float, ...]
    """[J] rad."""
    servo: Servo
    max_speed_rad_s: float
    """Of a joint in mode `velocity`."""
    frequency_hz: float
    """Cycles of the gait a second."""
    max_linear_m_s: float
    max_angular_rad_s: float
    modes: tuple[str, ...] = ("native", "position", "velocity", "twist")
    native: str = "torque"
    """What the original's actions are: `torque` or `position` of the joints."""
    reference: Callable[[Any, Any, BaseMotion, Any], Any] | None = None
    """(phase [...], command [..., 2], base, numpy or jax.numpy) -> target offsets from home [..., J], rad."""

    def body(self) -> mujoco.MjSpec:
        """Return the robot's file, parsed."""
        return read_file(FOLDER / f"{self.name}.xml")

    @functools.cached_property
    def _joints_of_file(self) -> list[mujoco.MjsJoint]:
        body = self.body()
        return [body.joint(name.removeprefix(f"{self.name}_")) for name in self.joints]

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Return [J] least and largest target, rad."""
        return tuple((float(joint.range[0]), float(joint.range[1])) for joint in self._joints_of_file)

    @property
    def torque_nm(self) -> tuple[float, ...]:
        """Return [J] torque limits."""
        return tuple(float(joint.actfrcrange[1]) for joint in self._joints_of_file)


@dataclasses.dataclass(frozen=True)
class Row(Figures):
    """A robot of `models/legged.yaml`."""

    legs: Legged
    spawn_height_m: float
    contact_time_constant_s: float | None = None
    gait: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Figures of its gait when it is commanded to go, and to stand; the other robots' stand with their gaits."""


@functools.cache
def legged_row(name: str) -> Row:
    """Return a legged robot's row."""
    rows = read_packaged(FOLDER.parent / "models" / "legged.yaml", tuple[Row, ...])
    return next(row for row in rows if row.legs.name == name)


def gait_law(legs: Legged) -> ControlLaw:
    """Return the law from a twist to joint targets [..., J], rad, within the joints' ranges."""

    def law(command, state, xp):
        assert legs.reference is not None
        phase = 2.0 * math.pi * legs.frequency_hz * state.time_s
        offsets = legs.reference(phase, command, base_motion(state, xp), xp)
        of_joints = (legs.home, *zip(*legs.ranges, strict=True))
        home, low, high = (xp.broadcast_to(xp.asarray(x), offsets.shape) for x in of_joints)
        return xp.clip(home + offsets, low, high)

    return law


def _commands(legs: Legged, mode: str) -> list[tuple[str, float, float]]:
    """Return each action's name with its unit and its command at -1 and +1, which but for positions are symmetric:
    action 0 stands."""
    if mode == "twist":
        speeds = ("forward m/s", legs.max_linear_m_s), ("turn rad/s", legs.max_angular_rad_s)
        return [(name, -most, most) for name, most in speeds]
    unit, ends = "N m", tuple((-most, most) for most in legs.torque_nm)
    if mode in ("position", "velocity"):
        most = legs.max_speed_rad_s
        unit, ends = ("rad", legs.ranges) if mode == "position" else ("rad/s", ((-most, most),) * len(legs.joints))
    return [(f"{joint.split('_', 1)[1]} {unit}", *end) for joint, end in zip(legs.joints, ends, strict=True)]


def _add_to(legs: Legged, mode: str, world: mujoco.MjSpec) -> None:
    """Attach the robot to a world, with one actuator per joint: torque, velocity, or position otherwise."""
    world.worldbody.add_frame().attach_body(legs.body().worldbody.first_body(), f"{legs.name}_", "")
    servo = legs.servo
    for joint, torque, limits in zip(legs.joints, legs.torque_nm, legs.ranges, strict=True):
        gains = {"velocity": (0.0, servo.velocity_gain), "torque": None}.get(mode, (servo.stiffness, servo.damping))
        actuator = world.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        set_servo(actuator, gains, {"velocity": (-100.0, 100.0), "torque": (-torque, torque)}.get(mode, limits))


def legged_robot(legs: Legged, control_mode: str = "native", **figures: Any) -> RobotSpec:
    """Return the spec of a legged robot in one of `legs.modes`: `native` is `legs.native` of each joint, `twist` the
    base's linear and angular velocity through the gait."""
    check_mode(legs.name, control_mode, legs.modes)
    joint_mode = legs.native if control_mode == "native" else control_mode
    twist = control_mode == "twist"
    names, low, high = zip(*_commands(legs, joint_mode), strict=True)
    row = vars(legged_row(legs.name))
    fields: dict[str, Any] = {
        "action_low": low,
        "action_high": high,
        "action_names": names,
        "home_qpos": tuple(zip(legs.joints, legs.home, strict=True)),
        "control": gait_law(legs) if twist else None,
    }
    return RobotSpec(
        name=legs.name,
        add_to=functools.partial(_add_to, legs, joint_mode),
        base_body=f"{legs.name}_{legs.base_body}",
        base_joint=f"{legs.name}_free",
        actuators=legs.joints,
        kind="legged",
        control_mode=control_mode,
        control_modes=legs.modes,
        control_every_substep=twist,
        twist=TwistMap(((1.0, 0.0), (0.0, 1.0)), legs.max_linear_m_s, legs.max_angular_rad_s) if twist else None,
        **(fields | {name: row[name] for name in row.keys() - {"legs", "gait"}} | figures),
    )
