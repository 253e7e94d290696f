"""Build one `RobotSpec` per control mode from a robot's MJCF file and a table of its driven joints.

`WHEELED` are the robots of `models/wheeled.yaml`. Control modes: `native`, velocities of the wheels, left then right,
front before rear (Husky: their torques), an arm folded; `whole_body`, of a robot with an arm, its velocities too, and a
gripper's opening; `twist`, linear and angular velocity of the base, an arm folded; `hand`, `twist` with the velocity of
an arm's hand in the base's frame, and a gripper's opening; `velocity`, `position` or `torque` of all joints.

Files are written without the robot's name in front of theirs; the loader adds it (`wheel_left` becomes
`fetch_wheel_left`) and attaches the file to the world. Collision geoms are in group 3. A group-3 geom
without contype and conaffinity rolls: it is paired with the world's floor and meets nothing else, so that
a sphere can stand for a thin wheel without standing out at its sides.
"""

import dataclasses
import functools
import math
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from interactive_nav.robots.files import read_file
from interactive_nav.robots.links import make_links, repeated
from interactive_nav.robots.spec import ControlLaw, Figures, RobotCamera, RobotSpec, TwistMap, check_mode, set_servo
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import apply_axes

FOLDER = Path(__file__).parent / "mjcf"
_OPTIONS = ("timestep", "integrator", "cone", "impratio", "solver", "iterations", "ls_iterations", "gravity")
"""A robot's file may set them; the world's hold."""
FLOOR = "floor"
"""The world's floor geom."""
_ADVANCE_S = 0.1
"""Position mode: a wheel's largest advance per command is its largest speed times this."""
_WHEEL_STIFFNESS = 8.0
"""1/s: position gain of a wheel over its velocity gain; critically damped within a factor of 2 on all our robots."""
HAND_M_S = 0.25
"""Mode `hand`: its largest velocity along each axis."""
_DAMPING_M_S = 0.05
"""Of the inverse kinematics: along a direction in which the arm moves the hand more slowly, it falls behind."""
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
    """Finger joints that modes `whole_body` and `hand` open and close together, by position."""
    hand: str = ""
    """Body that mode `hand` moves by the joints of `whole_body`."""

    @property
    def wheel_rows(self) -> tuple[tuple[float, float], ...]:
        """Return [wheels] rad/s per m/s of the base, and per rad/s: rows of a `TwistMap.matrix`."""
        radius, sides = self.wheel_radius_m, (joint.side for joint in self.joints if joint.side)
        return tuple((1.0 / radius, side * self.track_m / (2.0 * radius)) for side in sides)

    @property
    def modes(self) -> tuple[str, ...]:
        """Return the control modes, `native` first."""
        whole = ("whole_body",) if self.whole_body else ()
        return ("native", *whole, "twist", *(("hand",) if self.hand else ()), "velocity", "position", "torque")


class _Action(NamedTuple):
    name: str
    low: float
    high: float
    gain: np.ndarray
    """[J] controls of the joints per unit of command."""


def attach(world: mujoco.MjSpec, child: mujoco.MjSpec, prefix: str) -> None:
    """Attach a robot to a world, its names prefixed, and pair its rolling geoms with the floor."""
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


def _limits(child: mujoco.MjSpec, joint: Joint) -> tuple[tuple[float, float] | None, float]:
    """Return a joint's range in the file, None where it has none, and its torque limit."""
    driven = child.joint(joint.name)
    low, high = (float(v) for v in driven.range)
    effort = float(driven.actfrcrange[1])
    if not effort > 0:
        raise ConfigError(f"joint '{joint.name}' has no torque limit (actuatorfrcrange), expected a positive one")
    return (low, high) if low < high else None, effort


def _law(base: WheeledBase, mode: str, child: mujoco.MjSpec, actions: list[_Action]) -> ControlLaw | None:
    """Return the law controls = matrix @ command + offset, plus the joint's position for relative commands.

    A yaw gain adds the gain times the turn's error to a commanded turn. None: the command is the controls.
    """
    joints, model = base.joints, child.copy().compile()
    matrix = np.stack([action.gain for action in actions], 1)
    arm = [i for i, joint in enumerate(joints) if mode == "hand" and joint.name in base.whole_body]
    offset = np.where(matrix.any(1) | np.isin(np.arange(len(joints)), arm), 0.0, [joint.home for joint in joints])
    relative = np.asarray([float(mode == "position" and joint.side != 0) for joint in joints])
    address = np.asarray([model.joint(joint.name).qposadr[0] for joint in joints])
    moved, yaw_gain = bool(relative.any()), base.yaw_gain if mode == "twist" else 0.0
    if np.array_equal(matrix, np.eye(len(joints))) and not moved:
        return None

    bodies = [b for b in range(1, model.nbody) if model.body_rootid[b] == 1]
    links, hand = make_links(model, bodies), bodies.index(model.body(base.hand).id) if arm else 0
    fastest, ids = np.array([joint.max_speed for joint in joints])[arm], [model.joint(joints[i].name).id for i in arm]
    ends = np.where(model.jnt_limited[ids, None] > 0, model.jnt_range[ids], [-np.inf, np.inf])

    def arm_speeds(velocity, state, xp):
        """Return [..., joints], damped least squares (Wampler 1986); joints share by speed, and none is too fast."""
        constant = functools.partial(repeated, state.qpos)
        lever = links.jacobian(state.qpos, hand, address[arm].tolist()) * constant(fastest[None])
        room = abs(constant(ends) - state.qpos[..., address[arm], None])
        for _ in range(3):  # again without the joints that come to an end of their range
            square = (lever[..., :, None, :] * lever[..., None, :, :]).sum(-1) + constant(_DAMPING_M_S**2 * np.eye(3))
            shares = (lever * apply_axes(xp.linalg.inv(square), velocity)[..., None]).sum(-2)
            ahead = xp.where(shares > 0, room[..., 1], room[..., 0])
            lever = lever * (abs(shares) * constant(fastest * _ADVANCE_S) <= ahead)[..., None, :]
        shares = shares / xp.maximum(abs(shares).max(-1, keepdims=True), 1.0)
        return shares @ xp.asarray(fastest[:, None] * np.eye(len(joints))[arm])

    def law(command, state, xp):
        if yaw_gain:
            turn = command[..., 1] + yaw_gain * (command[..., 1] - state.qvel[..., 5])
            command = xp.stack([command[..., 0], turn], -1)
        controls = command @ xp.asarray(matrix).T
        controls = controls + xp.broadcast_to(xp.asarray(offset), controls.shape)
        if arm:
            controls = controls + arm_speeds(command[..., 2:5], state, xp)
        if moved:
            controls = controls + xp.broadcast_to(xp.asarray(relative), controls.shape) * state.qpos[..., address]
        return controls

    return law


def _mode(base: WheeledBase, mode: str, limits: list[tuple[Any, float]]) -> tuple[list[str], list[_Action]]:
    """Return the servo of each joint (position, velocity or torque) and the actions of a control mode."""
    joints, alone = base.joints, np.eye(len(base.joints))
    wheels, names = [i for i, joint in enumerate(joints) if joint.side], [joint.name for joint in joints]
    servos, actions = ["position"] * len(joints), []

    def drive(i: int, kind: str, native: tuple[float, float] | None = None) -> None:
        joint, (span, effort), advance = joints[i], limits[i], joints[i].max_speed * _ADVANCE_S
        place = ("advance rad", -advance, advance) if joint.side else (joint.unit, *(span or (-math.pi, math.pi)))
        unit, low, high = {
            "torque": ("N" if joint.unit == "m" else "N m", -effort, effort),
            "velocity": (f"{joint.unit}/s", -joint.max_speed, joint.max_speed),
            "position": place,
        }[kind]
        servos[i], (low, high) = kind, native or (low, high)
        actions.append(_Action(f"{joint.name.replace('_', ' ')} {unit}", low, high, alone[i]))

    if mode in ("twist", "hand"):
        gains, least = np.zeros((len(joints), 2)), base.min_linear_m_s
        gains[wheels] = base.wheel_rows
        for i in wheels:
            servos[i] = "velocity"
        least = -base.max_linear_m_s if least is None else least
        actions.append(_Action("forward m/s", least, base.max_linear_m_s, gains[:, 0]))
        actions.append(_Action("turn rad/s", -base.max_angular_rad_s, base.max_angular_rad_s, gains[:, 1]))
    for i in range(len(joints)) if mode in ("velocity", "position", "torque") else ():
        drive(i, mode)
    for i in wheels if mode in ("native", "whole_body") else ():
        drive(i, "torque" if base.native_torque else "velocity", base.native)
    for i in map(names.index, base.whole_body if mode in ("whole_body", "hand") else ()):
        if mode == "whole_body":
            drive(i, "velocity")
        servos[i] = "velocity"
    for way in ("forward", "left", "up") if mode == "hand" else ():
        actions.append(_Action(f"hand {way} m/s", -HAND_M_S, HAND_M_S, np.zeros(len(joints))))
    if mode in ("whole_body", "hand") and base.gripper:
        fingers = [names.index(name) for name in base.gripper]
        low, high = limits[fingers[0]][0] or (0.0, 0.0)
        if low == high:
            raise ConfigError(f"finger joint '{base.gripper[0]}' has no range, expected one; give limits")
        actions.append(_Action("finger opening m", low, high, alone[fingers].sum(0)))
    return servos, actions


def _twist_map(base: WheeledBase, mode: str, num_actions: int) -> TwistMap | None:
    """Return how the commands of a control mode move the base."""
    rows = ((1.0, 0.0), (0.0, 1.0))
    if mode in ("position", "torque") or (mode in ("native", "whole_body") and base.native_torque):
        return None
    rows = rows if mode in ("twist", "hand") else base.wheel_rows
    return TwistMap(rows + ((0.0, 0.0),) * (num_actions - len(rows)), base.max_linear_m_s, base.max_angular_rad_s)


def wheeled_robot(
    control_mode: str,
    base: WheeledBase,
    parsed: mujoco.MjSpec | None = None,
    *,
    base_body: str = "base",
    camera: RobotCamera,
    rolling: tuple[str, ...] = (),
    **figures: Any,
) -> RobotSpec:
    """Return the spec of a wheeled robot in a control mode, from a parsed or builtin file.

    `base_body` has the free joint; names of the camera's and the wheels' bodies (`rolling`; by default the driven ones)
    omit the robot's name.
    """
    check_mode(base.name, control_mode, base.modes)
    prefix = f"{base.name}_"
    path, joints = FOLDER / f"{base.name}.xml", base.joints
    child = read_file(path, base_body) if parsed is None else parsed
    missing = [j.name for j in joints if child.joint(j.name) is None or child.actuator(j.name) is None]
    if missing:
        raise ConfigError(f"robot file {path}: no joint and actuator named '{missing[0]}'")
    limits = [_limits(child, joint) for joint in joints]
    servos, actions = _mode(base, control_mode, limits)
    free = next(j.name for j in child.body(base_body).joints)

    def add_to(world: mujoco.MjSpec) -> None:
        robot = child.copy()
        of_joint = zip(joints, servos, limits, strict=True)
        bounds = [span if kind == "position" and not joint.side else None for joint, kind, (span, _) in of_joint]
        for action in actions if control_mode != "position" else ():  # in which wheels advance from where they are
            if np.count_nonzero(action.gain) == 1 and action.gain.max() == 1.0:
                bounds[int(action.gain.argmax())] = action.low, action.high
        for joint, kind, (_, effort), low_high in zip(joints, servos, limits, bounds, strict=True):
            actuator = robot.actuator(joint.name)  # with the gains of its native mode
            stiff, damp = float(actuator.gainprm[0]), -float(actuator.biasprm[2])
            speed = damp if joint.side else effort / (_SPEED_ERROR * joint.max_speed)
            gains = {"position": (_WHEEL_STIFFNESS * damp if joint.side else stiff, damp), "velocity": (0.0, speed)}
            set_servo(actuator, gains.get(kind), low_high)
        attach(world, robot, prefix)

    wheels = rolling or tuple(child.joint(j.name).parent.name for j in joints if j.side)
    return RobotSpec(
        name=base.name,
        add_to=add_to,
        base_body=f"{prefix}{base_body}",
        base_joint=f"{prefix}{free}",
        actuators=tuple(f"{prefix}{joint.name}" for joint in joints),
        action_low=tuple(a.low for a in actions),
        action_high=tuple(a.high for a in actions),
        action_names=tuple(a.name for a in actions),
        camera=dataclasses.replace(camera, body=f"{prefix}{camera.body}"),
        home_qpos=tuple((f"{prefix}{j.name}", j.home) for j in joints if j.home),
        rolling_bodies=tuple(f"{prefix}{name}" for name in wheels),
        hand=base.hand and f"{prefix}{base.hand}",
        control_mode=control_mode,
        control_modes=base.modes,
        control=_law(base, control_mode, child, actions),
        twist=_twist_map(base, control_mode, len(actions)),
        **{"spawn_height_m": 0.0, **figures},
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row(Figures):
    """A robot of `models/wheeled.yaml`."""

    base: WheeledBase


_ROWS = read_packaged(FOLDER.parent / "models" / "wheeled.yaml", tuple[Row, ...])
WHEELED = {row.base.name: functools.partial(wheeled_robot, **vars(row)) for row in _ROWS}
"""Name -> control mode -> spec."""
