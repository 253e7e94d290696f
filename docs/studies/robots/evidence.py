"""What a robot really does, measured on any physics backend: robot name in, a list of checks out.

All manoeuvres of a robot run as one batch in one hall: a wheeled one stands, drives straight and stops, turns
on the spot, takes a corner at full speed, and pushes a basket, a table and a sofa; a legged or flying one
stands, moves over a metre, stops and turns. Limits are those of the tests and of
`python -m docs.studies.robots evidence`, which runs without pytest, for instance on a GPU machine.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from docs.studies.robots.hall import LOADS, box, hall
from interactive_nav.config import NavConfig
from interactive_nav.metrics import GRAVITY
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.robots import get_robot
from interactive_nav.robots.build import half_extents
from interactive_nav.robots.spec import RobotSpec
from interactive_nav.scenes.world import World, build_world
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import yaw_from_quat

_DT_S = 0.1
_STEPS = 60
_SETTLE = 10
"""Control steps that a robot may take to settle on its wheels before drift counts."""
PUSH_SPEED_M_S = 0.3
MODE = "twist"


@dataclasses.dataclass(frozen=True)
class Check:
    """A measured value and the closed interval that it must lie in."""

    name: str
    value: float
    low: float
    high: float

    @property
    def passed(self) -> bool:
        """Whether the value is finite and in the interval."""
        return bool(np.isfinite(self.value)) and self.low <= self.value <= self.high


@dataclasses.dataclass(frozen=True)
class Evidence:
    """A robot's checks and the curves behind them."""

    robot: str
    backend: str
    checks: tuple[Check, ...]
    time_s: np.ndarray
    """[T]"""
    speed_m_s: np.ndarray
    """[T] of the straight drive."""
    commanded_m_s: np.ndarray
    turn_rad_s: np.ndarray
    """[T] of the turn on the spot."""
    commanded_rad_s: np.ndarray

    @property
    def passed(self) -> bool:
        """Whether all checks passed."""
        return all(c.passed for c in self.checks)


def push_limit_n(robot: RobotSpec, world: World) -> float:
    """Largest horizontal force by the wheels' torque and grip: min(sum tau / r, mu m g)."""
    model = world.models[0]
    torque = grip = 0.0
    for name in robot.actuators:
        joint = model.actuator(name).trnid[0]
        body = model.jnt_bodyid[joint]
        if mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) not in robot.rolling_bodies:
            continue
        geom = next(g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] == 3)
        torque += model.jnt_actfrcrange[joint, 1] / model.geom_size[geom, 0]
        grip = max(grip, float(model.geom_friction[geom, 0]))
    return min(torque, grip * world.robot_mass_kg * GRAVITY)


@dataclasses.dataclass(frozen=True)
class _Manoeuvre:
    name: str
    y_w: float
    twist: Callable[[float], tuple[float, float]]
    """Time (s) -> linear m/s, angular rad/s."""


def _manoeuvres(robot: RobotSpec) -> tuple[_Manoeuvre, ...]:
    assert robot.twist is not None
    v, w = robot.twist.max_linear_m_s, robot.twist.max_angular_rad_s
    push = tuple(_Manoeuvre(load.name, 20.0 * (i + 1), lambda t: (PUSH_SPEED_M_S, 0.0)) for i, load in enumerate(LOADS))
    return (
        _Manoeuvre("stand", -20.0, lambda t: (0.0, 0.0)),
        _Manoeuvre("straight", 0.0, lambda t: (v if t < 4 else 0.0, 0.0)),
        _Manoeuvre("half speed", -10.0, lambda t: (0.5 * v if t < 4 else 0.0, 0.0)),
        _Manoeuvre("turn", -40.0, lambda t: (0.0, w if t < 4 else 0.0)),
        _Manoeuvre("half turn", -50.0, lambda t: (0.0, -0.5 * w if t < 4 else 0.0)),
        _Manoeuvre("corner", -60.0, lambda t: (v, 0.0 if t < 3 else w)),
        *push,
    )


def _at_home(world: World) -> mujoco.MjData:
    """The robot at home with its base frame at the world's."""
    model, at = world.models[0], world.layout.robot_qpos
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[0]
    data.qpos[at : at + 7] = [0, 0, 0, 1, 0, 0, 0]
    mujoco.mj_kinematics(model, data)
    return data


def _axle_b(robot: RobotSpec, world: World) -> np.ndarray:
    """(2,) m: middle of the driven wheels in the base frame, about which a wheeled robot turns."""
    model, data = world.models[0], _at_home(world)
    bodies = [int(model.jnt_bodyid[model.actuator(name).trnid[0]]) for name in robot.actuators]
    wheels = [data.xpos[b, :2] for b in bodies if model.body(b).name in robot.rolling_bodies]
    return np.mean(wheels, 0) if wheels else np.zeros(2)


def _front_m(world: World) -> float:
    """How far the robot's collision geoms reach ahead of its base frame at home."""
    model, layout, data = world.models[0], world.layout, _at_home(world)
    reach = 0.0
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] in layout.robot_bodies and model.geom_contype[geom]:
            half = np.abs(data.geom_xmat[geom].reshape(3, 3)[0]) @ half_extents(model, geom)
            reach = max(reach, float(data.geom_xpos[geom, 0] + half))
    return reach


def measure_wheeled(name: str, backend: str = "native") -> Evidence:
    """Runs every manoeuvre of a wheeled robot.

    Args:
        name: of a registered robot that has mode `twist`.
        backend: native, jax or warp.
    """
    robot = get_robot(name, MODE)
    assert robot.twist is not None
    front = _front_m(build_world(robot, (hall((box(LOADS[0], 50.0, 50.0),)),), NavConfig.of(num_objects=0)))
    boxes = tuple(box(load, front + load.half_m[0] + 0.1, 20.0 * (i + 1)) for i, load in enumerate(LOADS))
    config = NavConfig.of(backend=backend, num_objects=0, sleep=False)
    world = build_world(robot, (hall(boxes),), config)
    runs = _manoeuvres(robot)
    used, poses, forces = _run(robot, world, config, runs, _STEPS)
    motion = _motion(world, runs, poses)
    checks = _driving_checks(robot, world, motion) + _pushing_checks(robot, world, motion, poses, forces)
    return _evidence(robot, used, runs, motion, checks)


def _run(
    robot: RobotSpec, world: World, config: NavConfig, runs: tuple[_Manoeuvre, ...], steps: int
) -> tuple[str, np.ndarray, np.ndarray]:
    """All manoeuvres side by side: the backend, states [steps + 1, N, nq], mean contact forces [steps, N]."""
    physics = make_physics(world, config)
    count, at = len(runs), world.layout.robot_qpos
    qpos = np.repeat(world.rest_qpos[:1], count, 0)
    for row, run in zip(qpos, runs, strict=True):
        row[at : at + 7] = [0, run.y_w, robot.spawn_height_m, 1, 0, 0, 0]
    still = jnp.zeros((count, world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
    step = jax.jit(jax.vmap(physics.step))
    scene = jnp.zeros(count, jnp.int32)
    poses, forces = [qpos], []
    for k in range(steps):
        twist = np.array([run.twist(k * _DT_S) for run in runs])
        command = robot.command(robot.drive(twist[:, 0], twist[:, 1]))
        state, signals = step(scene, state, jnp.asarray(command, jnp.float32), jnp.full(count, k * _DT_S))
        poses.append(np.asarray(state.qpos))
        forces.append(np.asarray(signals.force_n))
    return physics.name, np.stack(poses), np.stack(forces)


def _tilt_deg(q: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2), -1, 1)))


@dataclasses.dataclass(frozen=True)
class _Motion:
    """What the base did in each of N manoeuvres, from poses [T + 1, N, nq]."""

    index: dict[str, int]
    """Name of a manoeuvre -> its place among the N."""
    xy: np.ndarray
    """[T + 1, N, 2] m, from the start."""
    yaw: np.ndarray
    """[T + 1, N] rad, without jumps."""
    tilt: np.ndarray
    """[T + 1, N] degrees."""
    speed: np.ndarray
    """[T, N] m/s along the world's x."""
    rate: np.ndarray
    """[T, N] rad/s"""


def _motion(world: World, runs: tuple[_Manoeuvre, ...], poses: np.ndarray) -> _Motion:
    at = world.layout.robot_qpos
    xy = poses[..., at : at + 2] - poses[:1, :, at : at + 2]
    yaw, tilt = np.unwrap(yaw_from_quat(poses[..., at + 3 : at + 7]), axis=0), _tilt_deg(poses[..., at + 3 : at + 7])
    speed, rate = np.diff(xy[..., 0], axis=0) / _DT_S, np.diff(yaw, axis=0) / _DT_S
    return _Motion({run.name: i for i, run in enumerate(runs)}, xy, yaw, tilt, speed, rate)


def _mass_check(robot: RobotSpec, world: World) -> Check:
    return Check("mass kg / table", world.robot_mass_kg / (robot.mass_kg or world.robot_mass_kg), 0.99, 1.01)


def _axle_moves_m(robot: RobotSpec, world: World, motion: _Motion) -> float:
    """How far the axle's middle moves in the turns on the spot."""
    turns = [motion.index["turn"], motion.index["half turn"]]
    # The base frame may lie off the axle, and then goes round it.
    axle, cos, sin = _axle_b(robot, world), np.cos(motion.yaw[:, turns]), np.sin(motion.yaw[:, turns])
    offset = np.stack([cos * axle[0] - sin * axle[1], sin * axle[0] + cos * axle[1]], -1)
    centre = motion.xy[:, turns] + offset - offset[:1]
    return float(np.linalg.norm(centre, axis=-1).max())


def _driving_checks(robot: RobotSpec, world: World, motion: _Motion) -> list[Check]:
    """Standing, driving straight, stopping, turning, cornering."""
    assert robot.twist is not None
    v, w = robot.twist.max_linear_m_s, robot.twist.max_angular_rad_s
    index, xy, yaw, speed = motion.index, motion.xy, motion.yaw, motion.speed
    straight, half_speed, corner, stand = (index[n] for n in ("straight", "half speed", "corner", "stand"))
    steady = slice(25, 40)

    def ratio(values: np.ndarray, run: str, asked: float) -> float:
        return float(values[steady, index[run]].mean() / asked)

    # Four wheels that skid wander with the last bits of their contacts: by up to a twentieth of the robot's length.
    turn_limit_m = max(0.03, 0.05 * robot.size_m[0]) if robot.size_m else 0.03
    return [
        _mass_check(robot, world),
        Check("standing drift mm", 1e3 * float(np.abs(xy[_SETTLE:, stand] - xy[_SETTLE, stand]).max()), 0, 2),
        Check("standing drift deg", math.degrees(float(np.ptp(yaw[_SETTLE:, stand]))), 0, 0.2),
        Check("linear / asked", ratio(speed, "straight", v), 0.9, 1.1),
        Check("linear / asked, half speed", ratio(speed, "half speed", 0.5 * v), 0.9, 1.1),
        Check("straight line deviation %", 100 * float(np.abs(xy[:41, straight, 1]).max() / xy[40, straight, 0]), 0, 2),
        Check("stopped mm/s", 1e3 * float(np.abs(speed[-5:, [straight, half_speed]]).max()), 0, 5),
        Check("angular / asked", ratio(motion.rate, "turn", w), 0.9, 1.1),
        Check("angular / asked, half rate", ratio(motion.rate, "half turn", -0.5 * w), 0.9, 1.1),
        Check("turn: centre moves m", _axle_moves_m(robot, world, motion), 0, turn_limit_m),
        Check("corner: turned deg", math.degrees(float(yaw[-1, corner])), 90, 1e4),
        Check("corner: largest tilt deg", float(motion.tilt[:, corner].max()), 0, 5),
    ]


def _face_friction(robot: RobotSpec, world: World) -> float:
    """Largest friction of the base's own collision geoms."""
    model = world.models[0]
    base = model.body(robot.base_body).id
    solid = [g for g in range(model.ngeom) if model.geom_bodyid[g] == base and model.geom_contype[g]]
    return float(model.geom_friction[solid, 0].max())


def _pushing_checks(
    robot: RobotSpec, world: World, motion: _Motion, poses: np.ndarray, forces: np.ndarray
) -> list[Check]:
    """What wheels and grip can push moves, by the force that it takes; what they cannot stays; nothing tips."""
    checks = []
    limit, friction = push_limit_n(robot, world), _face_friction(robot, world)
    for i, load in enumerate(LOADS):
        run, slot = motion.index[load.name], world.layout.slot_qpos[i]
        pushed = float(poses[-1, run, slot] - poses[0, run, slot])
        if load.force_n < limit / 1.4:
            checks.append(Check(f"pushes {load.name} m", pushed, 0.5, 2))
            # The mean of the force's norm. With friction f between the robot's face and the load, the face lifts or
            # presses it: the push is mu m g / (1 -+ f mu), its norm at most sqrt(1 + f^2) of that; 7 % for contacts
            # that open and close. A test of C MuJoCo's force vectors holds the push to mu (m g - lift).
            face = max(load.friction, friction)
            low = 0.93 / (1 + face * load.friction)
            high = 1.07 * math.hypot(1, face) / max(1 - face * load.friction, 0.1)
            ratio = float(forces[-20:, run].mean()) / load.force_n
            checks.append(Check(f"force / mu m g, {load.name}", ratio, low, high))
        elif load.force_n > limit * 1.4:
            # Soft friction lets a load creep below its limit, here by less than 2 cm/s for 5 s.
            checks.append(Check(f"cannot push {load.name} m", pushed, -0.01, 0.1))
        checks.append(Check(f"tilt at {load.name} deg", float(motion.tilt[:, run].max()), 0, 5))
    return checks


def _evidence(
    robot: RobotSpec, backend: str, runs: tuple[_Manoeuvre, ...], motion: _Motion, checks: list[Check]
) -> Evidence:
    """The checks with the curves of the manoeuvres `straight` and `turn`."""
    straight, turn = motion.index["straight"], motion.index["turn"]
    steps = len(motion.speed)
    asked = np.array([[run.twist(k * _DT_S) for run in runs] for k in range(steps)])
    return Evidence(
        robot=robot.name,
        backend=backend,
        checks=tuple(checks),
        time_s=_DT_S * (np.arange(steps) + 0.5),
        speed_m_s=motion.speed[:, straight],
        commanded_m_s=asked[:, straight, 0],
        turn_rad_s=motion.rate[:, turn],
        commanded_rad_s=asked[:, turn, 1],
    )


def measure_walking(name: str, backend: str = "native") -> Evidence:
    """Runs a legged or flying robot: it stands (hovers), moves well over a metre, stops and turns.

    Args:
        name: of a registered robot that has mode `twist`.
        backend: native, jax or warp.
    """
    robot = get_robot(name, MODE)
    assert robot.twist is not None
    v, w = robot.twist.max_linear_m_s, robot.twist.max_angular_rad_s
    start_s, going_s, turning_s = 0.5, max(4.0, 1.6 / v), 4.0
    end_s = start_s + max(going_s, turning_s) + 3.0
    steps = max(_SETTLE + 50, round(end_s / _DT_S))
    runs = (
        _Manoeuvre("stand", -20.0, lambda t: (0.0, 0.0)),
        _Manoeuvre("straight", 0.0, lambda t: (v if start_s <= t < start_s + going_s else 0.0, 0.0)),
        _Manoeuvre("turn", -40.0, lambda t: (0.0, w if start_s <= t < start_s + turning_s else 0.0)),
    )
    config = NavConfig.of(backend=backend, num_objects=0, sleep=False)
    # One box far away: the layouts of all backends expect something that can be touched.
    world = build_world(robot, (hall((box(LOADS[0], 50.0, 50.0),)),), config)
    used, poses, _ = _run(robot, world, config, runs, steps)
    motion, at = _motion(world, runs, poses), world.layout.robot_qpos
    xyz = poses[..., at : at + 3]
    stood = xyz[_SETTLE : _SETTLE + 51, 0, :2]
    walked = xyz[:, 1] - xyz[:1, 1]
    stop_k, turn_k = round((start_s + going_s) / _DT_S), round((start_s + turning_s) / _DT_S)
    turned = float(motion.yaw[turn_k, 2] - motion.yaw[0, 2])
    checks = [
        _mass_check(robot, world),
        Check("standing drift m, 5 s", float(np.abs(stood - stood[0]).max()), 0, 0.03),
        Check("moves m", float(np.linalg.norm(walked[stop_k, :2])), 1.0, 100.0),
        Check("linear / asked", float(np.linalg.norm(walked[stop_k, :2])) / (v * going_s), 0.65, 1.35),
        Check("sideways / ahead", float(np.abs(walked[stop_k, 1] / walked[stop_k, 0])), 0, 0.5),
        Check("stopped: last second moves m", float(np.linalg.norm(walked[-1] - walked[-11])), 0, 0.05),
        Check("angular / asked", turned / (w * turning_s), 0.65, 1.35),
        Check("turn: centre moves m", float(np.linalg.norm(motion.xy[:, 2], axis=-1).max()), 0, 0.5),
        Check("largest tilt deg", float(motion.tilt.max()), 0, 30),
    ]
    return _evidence(robot, used, runs, motion, checks)


EVIDENCE: dict[str, Callable[[str, str], Evidence]] = {
    "wheeled": measure_wheeled,
    "legged": measure_walking,
    "flying": measure_walking,
}
"""Kind of robot -> its evidence, (name, backend) -> `Evidence`."""


def measure(name: str, backend: str = "native") -> Evidence:
    """A robot's evidence, by its kind.

    Raises:
        ConfigError: unknown robot, or a kind without evidence.
    """
    kind = get_robot(name).kind
    if kind not in EVIDENCE:
        raise ConfigError(f"robot '{name}' is {kind}; evidence exists for {', '.join(sorted(EVIDENCE))} robots")
    return EVIDENCE[kind](name, backend)
