"""Robots alone in an empty hall: twist commands in, base trajectories out, on any backend."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState, make_physics
from interactive_nav.robots import get_robot
from interactive_nav.robots.spec import RobotSpec
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import World, build_world
from tests.toys import write_room

DT_S = 0.1


class Motion(NamedTuple):
    """Per control step (first axis; the start included) and run (second)."""

    pos_w: np.ndarray
    """[T + 1, N, 3]"""
    yaw_rad: np.ndarray
    """[T + 1, N], continuous over full turns."""
    up: np.ndarray
    """[T + 1, N] cosine of the tilt."""
    qpos: np.ndarray
    """[T + 1, N, robot nq]"""


@functools.cache
def hall(folder: Path):
    """A 12 x 12 m hall without furniture."""
    return load_scene(write_room(folder / "hall", (12.0, 12.0), ()))


def hall_world(robot: RobotSpec, folder: Path) -> World:
    """The robot's models in the hall."""
    return build_world(robot, (hall(folder),), NavConfig.of(num_objects=0))


def move(world: World, commands: np.ndarray, backend: str = "native", raised_m: float = 0.0) -> Motion:
    """Runs the robot from its home pose.

    Args:
        world: see `hall_world`.
        commands: [T, N, A], in the commands' units, of T control steps and N runs side by side.
        backend: of the physics.
        raised_m: of the home pose, in which feet just touch the floor.
    """
    physics = make_physics(world, NavConfig.of(backend=backend, num_objects=0))
    steps, runs, _ = commands.shape
    layout = world.layout
    qpos = np.repeat(world.rest_qpos[:1], runs, 0)
    own = slice(layout.robot_qpos, layout.robot_qpos + layout.robot_nq)
    qpos[:, own][:, :7] = [0, 0, world.robot.spawn_height_m + raised_m, 1, 0, 0, 0]
    still = jnp.zeros((runs, world.models[0].nv), jnp.float32)
    state = PhysicsState(jnp.asarray(qpos, jnp.float32), still, still)
    step = jax.jit(jax.vmap(physics.step))
    seen = [np.asarray(state.qpos[:, own])]
    for k in range(steps):
        state, signals = step(
            jnp.zeros(runs, jnp.int32), state, jnp.asarray(commands[k], jnp.float32), jnp.full(runs, DT_S * k)
        )
        assert not np.asarray(signals.nonfinite).any()
        seen.append(np.asarray(state.qpos[:, own]))
    qpos = np.stack(seen)
    w, x, y, z = np.moveaxis(qpos[..., 3:7], -1, 0)
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), axis=0)
    return Motion(qpos[..., :3], yaw, 1 - 2 * (x * x + y * y), qpos)


def schedule(*segments: tuple[float, float, float]) -> np.ndarray:
    """[T, 2] twists from segments (duration s, forward m/s, turn rad/s)."""
    return np.concatenate([np.tile([v, w], (round(t / DT_S), 1)) for t, v, w in segments])


def plain_model(name: str, mode: str, gravity: bool = True) -> mujoco.MjModel:
    """The robot alone over a floor, under the environment's solver settings."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    option = spec.option
    option.timestep, option.iterations, option.ls_iterations = 0.02, 10, 20
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.gravity = [0, 0, -9.81 if gravity else 0.0]
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
    get_robot(name, mode).add_to(spec)
    return spec.compile()


def home_data(model: mujoco.MjModel, robot: RobotSpec, height_m: float | None = None) -> mujoco.MjData:
    """The home pose, kinematics computed."""
    data = mujoco.MjData(model)
    data.qpos[2] = robot.spawn_height_m if height_m is None else height_m
    for joint, value in robot.home_qpos:
        data.qpos[model.joint(joint).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    return data


def extents(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, float]:
    """Length, width, height of all geoms but the floor, m; radius of the disc about the base that holds them."""
    corners, radius = [], 0.0
    for g in range(model.ngeom):
        kind, size = model.geom_type[g], model.geom_size[g]
        rotation, centre = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
        if kind == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            points, swell = centre + (2 * np.array(list(np.ndindex(2, 2, 2))) - 1) * size @ rotation.T, 0.0
        else:
            half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            points, swell = centre + np.outer([-half, half], rotation[:, 2]), size[0]
        corners += [points - swell, points + swell]
        radius = max(radius, np.linalg.norm(points[:, :2] - data.qpos[:2], axis=1).max() + swell)
    every = np.concatenate(corners)
    return every.max(0) - every.min(0), float(radius)
