"""Build one `RobotSpec` per control mode from a robot's MJCF file and a table of its driven joints.

Files are written without the robot's name in front of theirs; the loader adds it (`wheel_left` becomes
`fetch_wheel_left`) and attaches the file to the world. Collision geoms are in group 3. A group-3 geom
without contype and conaffinity rolls: it is paired with the world's floor and meets nothing else, so that
a sphere can stand for a thin wheel without standing out at its sides.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from interactive_nav.robots.files import read_file
from interactive_nav.robots.spec import ControlLaw, RobotCamera, RobotSpec, TwistMap, check_mode, set_servo, wheel_twist
from interactive_nav_common.errors import ConfigError

FOLDER = Path(__file__).parent / "mjcf"
_OPTIONS = ("timestep", "integrator", "cone", "solver", "iterations", "ls_iterations", "gravity")
"""A robot's file may set them; the world's hold."""
FLOOR = "floor"
"""The world's floor geom."""
_ADVANCE_S = 0.1
"""Position mode: a wheel's largest advance per command is its largest speed times this."""
_WHEEL_STIFFNESS = 8.0
"""1/s: position gain of a wheel over its velocity gain; critically damped within a factor of 2 on all our robots."""
_SPEED_ERROR = 0.05
"""Velocity mode: a joint's torque limit is reached when its speed is off by this fraction of its largest."""


@dataclasses.dataclass(frozen=True)
class Joint:
    """A driven joint. Its actuator has its name; range, torque limit and gains are read from the file."""

    name: str
    max_speed: float
    """rad/s, or m/s for a slide."""
    home: float = 0.0
    side: int = 0
    """Of a wheel: -1 left, +1 right; 0: no wheel."""
    unit: str = "rad"
    """'m' for a slide."""

    @property
    def label(self) -> str:
        """Return its name in words."""
        return self.name.replace("_", " ")


@dataclasses.dataclass(frozen=True)
class WheeledBase:
    """A wheeled robot's driven joints and what its commands may ask."""

    name: str
    joints: tuple[Joint, ...]
    """In the order of the file's actuators, wheels first."""
    wheel_radius_m: float
    track_m: float
    """Distance of left and right wheels; for skid steer the effective one, larger than the true."""
    native: tuple[float, float]
    """The original's command at action -1 and +1: wheel rad/s, or N m with `native_torque`."""
    max_linear_m_s: float
    max_angular_rad_s: float
    min_linear_m_s: float | None = None
    """Most negative base speed of mode `twist`; none: minus the largest."""
    native_torque: bool = False
    yaw_gain: float = 0.0
    """Mode `twist` of a skid steer: the commanded turn is raised by this times its error, as a gyro reads it."""
    whole_body: tuple[str, ...] = ()
    """Joints that mode `whole_body` drives by velocity, beside the wheels."""
    gripper: tuple[str, ...] = ()
    """Finger joints that mode `whole_body` opens and closes together, by position."""
    path: Path | None = None
    """MJCF or URDF; none: the builtin file of the robot's name."""

    @property
    def modes(self) -> tuple[str, ...]:
        """Return the control modes, `native` first."""
        whole = ("whole_body",) if self.whole_body else ()
        return ("native", *whole, "twist", "velocity", "position", "torque")


@dataclasses.dataclass(frozen=True)
class _Action:
    name: str
    low: float
    high: float
    gain: dict[int, float]
    """Joint index -> control per unit of command."""


@dataclasses.dataclass(frozen=True)
class _Limits:
    """Of one joint, from the file."""

    range: tuple[float, float] | None
    effort: float


def attach(world: mujoco.MjSpec, child: mujoco.MjSpec, prefix: str) -> None:
    """Attach a robot to a world, its names prefixed, and pairs its rolling geoms with the floor."""
    rolling = [
        (g.name, list(g.friction), int(g.condim))
        for g in child.geoms
        if g.group == 3 and not g.contype and not g.conaffinity
    ]
    for option in _OPTIONS:
        setattr(child.option, option, getattr(world.option, option))
    world.attach(child, prefix=prefix, frame=world.worldbody.add_frame())
    for name, friction, condim in rolling:
        slide, spin, roll = friction
        world.add_pair(
            name=f"{prefix}{name}_{FLOOR}",
            geomname1=f"{prefix}{name}",
            geomname2=FLOOR,
            condim=condim,
            friction=[slide, slide, spin, roll, roll],
        )


def stand(robot: RobotSpec, world: mujoco.MjSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the robot alone in a world, on the floor in its home pose, with its frames computed."""
    world.compiler.degree = False
    robot.add_to(world)
    model = world.compile()
    data = mujoco.MjData(model)
    at = int(model.joint(robot.base_joint).qposadr[0])
    data.qpos[at : at + 7] = [0, 0, robot.spawn_height_m, 1, 0, 0, 0]
    for name, value in robot.home_qpos:
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    return model, data


def half_extents(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return (3,) half sizes of a box about the geom's origin that holds it, in its frame, m."""
    return np.abs(model.geom_aabb[geom, :3]) + model.geom_aabb[geom, 3:]


def _limits(child: mujoco.MjSpec, joint: Joint) -> _Limits:
    driven = child.joint(joint.name)
    low, high = (float(v) for v in driven.range)
    effort = float(driven.actfrcrange[1])
    if not effort > 0:
        raise ConfigError(f"joint '{joint.name}' has no torque limit (actuatorfrcrange), expected a positive one")
    return _Limits((low, high) if low < high else None, effort)


def _set_mode(actuator: Any, mode: str, joint: Joint, limits: _Limits, low_high: tuple[float, float] | None) -> None:
    """Turn an actuator into a position servo, velocity servo or motor; the file has its native one."""
    stiff, damp = float(actuator.gainprm[0]), -float(actuator.biasprm[2])
    if joint.side:
        stiff = _WHEEL_STIFFNESS * damp
        kv = damp
    else:
        kv = limits.effort / (_SPEED_ERROR * joint.max_speed)
    set_servo(actuator, {"position": (stiff, damp), "velocity": (0.0, kv), "torque": None}[mode], low_high)


def _affine_law(
    matrix: np.ndarray, offset: np.ndarray, relative: np.ndarray, address: np.ndarray, yaw_gain: float
) -> ControlLaw:
    """Return the law controls = matrix @ command + offset, plus the joint's position where the command is an advance.

    With a yaw gain the command is a twist, whose turn is raised by the gain times its error.
    """
    moved = bool(relative.any())

    def law(command, state, xp):
        if yaw_gain:
            turn = command[..., 1] + yaw_gain * (command[..., 1] - state.qvel[..., 5])
            command = xp.stack([command[..., 0], turn], -1)
        controls = command @ xp.asarray(matrix).T
        controls = controls + xp.broadcast_to(xp.asarray(offset), controls.shape)
        if moved:
            controls = controls + xp.broadcast_to(xp.asarray(relative), controls.shape) * state.qpos[..., address]
        return controls

    return law


class _Mode:
    """One control mode: servo kind per joint, actions, joints that are held at home."""

    def __init__(self, base: WheeledBase, limits: list[_Limits]):
        self.base, self.limits = base, limits
        self.kind = ["position"] * len(base.joints)
        self.actions: list[_Action] = []
        self.relative: set[int] = set()

    def _each(self, indices, kind: str) -> None:
        for i in indices:
            joint, limit = self.base.joints[i], self.limits[i]
            self.kind[i] = kind
            if kind == "torque":
                unit = "N" if joint.unit == "m" else "N m"
                action = _Action(f"{joint.label} {unit}", -limit.effort, limit.effort, {i: 1.0})
            elif kind == "velocity":
                action = _Action(f"{joint.label} {joint.unit}/s", -joint.max_speed, joint.max_speed, {i: 1.0})
            elif joint.side:
                self.relative.add(i)
                advance = joint.max_speed * _ADVANCE_S
                action = _Action(f"{joint.label} advance rad", -advance, advance, {i: 1.0})
            else:
                low, high = limit.range or (-math.pi, math.pi)
                action = _Action(f"{joint.label} {joint.unit}", low, high, {i: 1.0})
            self.actions.append(action)

    def _wheels(self) -> None:
        low, high = self.base.native
        unit = "N m" if self.base.native_torque else "rad/s"
        for i in self.wheels:
            self.kind[i] = "torque" if self.base.native_torque else "velocity"
            self.actions.append(_Action(f"{self.base.joints[i].label} {unit}", low, high, {i: 1.0}))

    @property
    def wheels(self) -> list[int]:
        return [i for i, joint in enumerate(self.base.joints) if joint.side]

    def choose(self, mode: str) -> None:
        base = self.base
        if mode in ("velocity", "position", "torque"):
            self._each(range(len(base.joints)), mode)
        elif mode == "twist":
            rows = wheel_twist(base.wheel_radius_m, base.track_m, tuple(base.joints[i].side for i in self.wheels))
            for i in self.wheels:
                self.kind[i] = "velocity"
            least = -base.max_linear_m_s if base.min_linear_m_s is None else base.min_linear_m_s
            linear = {i: row[0] for i, row in zip(self.wheels, rows, strict=True)}
            angular = {i: row[1] for i, row in zip(self.wheels, rows, strict=True)}
            self.actions = [
                _Action("forward m/s", least, base.max_linear_m_s, linear),
                _Action("turn rad/s", -base.max_angular_rad_s, base.max_angular_rad_s, angular),
            ]
        else:
            self._wheels()
        if mode == "whole_body":
            index = {joint.name: i for i, joint in enumerate(base.joints)}
            self._each([index[name] for name in base.whole_body], "velocity")
            if base.gripper:
                fingers = [index[name] for name in base.gripper]
                low, high = self.limits[fingers[0]].range or (0.0, 0.0)
                self.actions.append(_Action("finger opening m", low, high, dict.fromkeys(fingers, 1.0)))

    def twist_map(self, mode: str) -> TwistMap | None:
        base = self.base
        if mode == "twist":
            rows: tuple[tuple[float, float], ...] = ((1.0, 0.0), (0.0, 1.0))
        elif mode in ("position", "torque") or (mode in ("native", "whole_body") and base.native_torque):
            return None
        else:
            driven = wheel_twist(base.wheel_radius_m, base.track_m, tuple(base.joints[i].side for i in self.wheels))
            rows = driven + ((0.0, 0.0),) * (len(self.actions) - len(driven))
        return TwistMap(rows, base.max_linear_m_s, base.max_angular_rad_s)

    def law(self, mode: str) -> ControlLaw | None:
        count = len(self.base.joints)
        matrix = np.zeros((count, len(self.actions)), np.float64)
        for a, action in enumerate(self.actions):
            for i, gain in action.gain.items():
                matrix[i, a] = gain
        driven = {i for action in self.actions for i in action.gain}
        offset = np.asarray([0.0 if i in driven else joint.home for i, joint in enumerate(self.base.joints)])
        if matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, np.eye(count)) and not self.relative:
            return None
        relative = np.asarray([float(i in self.relative) for i in range(count)])
        gain = self.base.yaw_gain if mode == "twist" else 0.0
        return _affine_law(matrix, offset, relative, self.qpos_address, gain)

    qpos_address: np.ndarray = np.zeros(0, np.int64)
    """[joints] addresses among the robot's qpos."""

    def set_servos(self, child: mujoco.MjSpec) -> None:
        bounds: dict[int, tuple[float, float]] = {}
        if self.actions and not self.relative:
            for action in self.actions:
                for i, gain in action.gain.items():
                    if gain == 1.0 and len(action.gain) == 1:
                        bounds[i] = (action.low, action.high)
        for i, joint in enumerate(self.base.joints):
            if i not in bounds and not joint.side and self.limits[i].range and self.kind[i] == "position":
                bounds[i] = self.limits[i].range  # type: ignore[assignment]
            _set_mode(child.actuator(joint.name), self.kind[i], joint, self.limits[i], bounds.get(i))


def _load(base: WheeledBase, base_body: str, prepare: Callable[[mujoco.MjSpec], None] | None) -> mujoco.MjSpec:
    """Return the robot's file, parsed and prepared; it has a joint and an actuator of each driven joint's name."""
    path = base.path or FOLDER / f"{base.name}.xml"
    child = read_file(path, base_body)
    if prepare is not None:
        prepare(child)
    missing = [j.name for j in base.joints if child.joint(j.name) is None or child.actuator(j.name) is None]
    if missing:
        raise ConfigError(f"robot file {path}: no joint and actuator named '{missing[0]}'")
    return child


def _mode(base: WheeledBase, child: mujoco.MjSpec, control_mode: str) -> _Mode:
    mode = _Mode(base, [_limits(child, joint) for joint in base.joints])
    mode.choose(control_mode)
    compiled = child.copy().compile()
    mode.qpos_address = np.asarray([compiled.joint(j.name).qposadr[0] for j in base.joints])
    return mode


def wheeled_robot(
    base: WheeledBase,
    control_mode: str,
    prepare: Callable[[mujoco.MjSpec], None] | None = None,
    *,
    base_body: str = "base",
    camera: RobotCamera,
    rolling: tuple[str, ...] = (),
    **figures: Any,
) -> RobotSpec:
    """Return the spec of a wheeled robot in a control mode.

    Args:
        base_body: the file's body with the free joint.
        camera: its body without the robot's name.
        rolling: bodies of wheels without the robot's name; by default those of the driven wheels.
    """
    check_mode(base.name, control_mode, base.modes)
    prefix = f"{base.name}_"
    child = _load(base, base_body, prepare)
    mode = _mode(base, child, control_mode)
    free = next(j.name for j in child.body(base_body).joints)

    def add_to(world: mujoco.MjSpec) -> None:
        robot = _load(base, base_body, prepare)
        mode.set_servos(robot)
        attach(world, robot, prefix)

    wheels = rolling or tuple(child.joint(j.name).parent.name for j in base.joints if j.side)
    return RobotSpec(
        name=base.name,
        add_to=add_to,
        base_body=f"{prefix}{base_body}",
        base_joint=f"{prefix}{free}",
        actuators=tuple(f"{prefix}{joint.name}" for joint in base.joints),
        action_low=tuple(a.low for a in mode.actions),
        action_high=tuple(a.high for a in mode.actions),
        action_names=tuple(a.name for a in mode.actions),
        camera=dataclasses.replace(camera, body=f"{prefix}{camera.body}"),
        home_qpos=tuple((f"{prefix}{j.name}", j.home) for j in base.joints if j.home),
        rolling_bodies=tuple(f"{prefix}{name}" for name in wheels),
        control_mode=control_mode,
        control_modes=base.modes,
        control=mode.law(control_mode),
        twist=mode.twist_map(control_mode),
        **{"spawn_height_m": 0.0, **figures},
    )
