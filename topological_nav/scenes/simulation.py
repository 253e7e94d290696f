"""Velocity commands in, poses, images and contacts out: TTbot in a scene, many at a time, at 10 Hz.

Physics is `interactive_nav`'s environment; furniture begins where it stands at rest. Images show what is pushed where
it is, open doors open, and small objects where they lie.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.pictures.scene_model import world_poses
from interactive_nav.robots import RobotSpec, get_robot
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.world import World
from interactive_nav.task.env import InteractiveNav
from interactive_nav.types import EpisodeStart
from interactive_nav_common.versions import usable_cores
from topological_nav.scenes.rendering import SceneRenderer, camera_pose, need_engine

Camera = Callable[..., np.ndarray]
"""Places [n, 2] (m), headings [n] (rad) and the world's `qpos` [n, nq] to what is seen there [n, ...]; None: a world at
rest, without small objects."""
CONTROL = "twist"
"""Control mode whose action is a base velocity."""


@dataclasses.dataclass(frozen=True)
class Seen:
    """Where a batch of robots is."""

    xy_w: np.ndarray
    """[B, 2] m."""
    yaw_rad: np.ndarray
    """[B]."""
    path_m: np.ndarray
    """[B] driven so far."""
    movable: np.ndarray
    """[B] bool: touched something movable in the last control step."""
    wall: np.ndarray
    """[B] bool: touched a wall in it."""
    qpos: np.ndarray
    """[B, nq] of the environment: where everything is."""
    broken: np.ndarray
    """[B] bool: the physics gave up on it, lost contacts, or left out something near (MJX's window was full)."""


def make_env(scene: Scene, robot: str, backend: str, radius_m: float | None = None, objects: int = 0) -> InteractiveNav:
    """The environment that evaluation steps, on past what it itself would call the end of an episode.

    Args:
        radius_m: footprint that planners keep clear; None: the robot's, which its corners reach.
    """
    need_engine(backend)
    config = NavConfig.of(
        backend=backend,
        control_mode=CONTROL,
        num_objects=objects,
        observations=("localisation",),
        episode_steps=10**8,
        num_waypoints=1,
        threads=usable_cores() if backend in ("auto", "native") else 0,
    )
    spec = get_robot(robot, CONTROL)
    if radius_m is not None:
        spec = dataclasses.replace(spec, footprint_radius_m=radius_m)
    return InteractiveNav(spec, (scene,), config)


def episode_starts(start_xy_w: Any, yaw_rad: Any, goal_xy_w: Any, objects: int, scene: Any = 0) -> EpisodeStart:
    """Starts of B episodes, in scenes [B] or one of an environment, small objects left out."""
    batch = len(start_xy_w)
    return EpisodeStart(
        scene_index=jnp.broadcast_to(jnp.asarray(scene, jnp.int32), batch),
        start_xy_w=jnp.asarray(start_xy_w, jnp.float32),
        start_yaw_rad=jnp.asarray(yaw_rad, jnp.float32),
        goal_xy_w=jnp.asarray(goal_xy_w, jnp.float32),
        small_xy_w=jnp.zeros((batch, objects, 2)),
        small_yaw_rad=jnp.zeros((batch, objects)),
        small_placed=jnp.zeros((batch, objects), bool),
    )


class Simulator:
    """A batch of robots in one environment; the state travels, so that it can be thinned out."""

    def __init__(self, env: Any):
        """Compiles on the first call, and anew for every size of a batch."""
        self.env = env
        self._reset = jax.jit(jax.vmap(env.reset_to))
        self._strewn = jax.jit(jax.vmap(env.strew))
        # A step writes where the state lay: for buffers that have moved MJX-Warp captures its graphs anew.
        self._advance = jax.jit(jax.vmap(env.advance), donate_argnums=0)
        self._step = jax.jit(jax.vmap(env.step), donate_argnums=0)
        self._packed = jax.jit(_packed)
        self._last: tuple[Any, Seen] | None = None

    @property
    def dt_s(self) -> float:
        """Control period."""
        return self.env.dt

    def start(
        self,
        start_xy_w: np.ndarray,
        yaw_rad: np.ndarray,
        goal_xy_w: np.ndarray,
        number: np.ndarray,
        seed: int,
        strewn: bool = False,
    ) -> Any:
        """States of B episodes, with observations; noise of an episode depends on its number [B] and the seed.

        So does where its small objects lie, if they are `strewn`; else they are left out.
        """
        objects = len(self.env.world.small_objects)
        keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.PRNGKey(seed)))(jnp.asarray(number))
        starts = episode_starts(start_xy_w, yaw_rad, goal_xy_w, objects)
        return self._reset(self._strewn(keys, starts) if strewn else starts, keys)

    def drive(self, state: Any, linear: np.ndarray, angular: np.ndarray) -> Any:
        """One control step under base velocities [B] m/s and [B] rad/s; the state given is used up."""
        robot: RobotSpec = self.env.robot
        return self._advance(state, np.asarray(robot.drive(linear, angular, np), np.float32))

    def act(self, state: Any, action: Any) -> Any:
        """One control step under the environment's own actions [B, A], observed; the state given is used up."""
        return self._step(state, action)

    def seen(self, state: Any) -> Seen:
        """Where the robots are."""
        if self._last is None or self._last[0] is not state:
            nav = state.info["nav"]
            path_m, touching, *lost = (
                nav.memory[name] for name in ("robot_path_m", "touching", "overflow_steps", "left_out_steps")
            )
            of = (nav.robot_pos_w, nav.yaw_rad, path_m, touching, lost[0] + lost[1])
            told = np.asarray(self._packed(of, state.metrics["nonfinite"], state.pipeline_state.qpos)).astype(float)
            xy, (yaw, path), (movable, wall, broken) = told[:, :2], told[:, 2:4].T, told[:, 4:7].T > 0
            self._last = state, Seen(xy, yaw, path, movable, wall, told[:, 7:], broken)
        return self._last[1]


def _packed(nav: tuple[jax.Array, ...], nonfinite: jax.Array, qpos: jax.Array) -> jax.Array:
    """[B, 7 + nq] f32: what `Seen` tells, in one array, because every transfer from an accelerator makes it wait."""
    pos, yaw, path, touching, lost = nav
    broken = (nonfinite > 0) | (lost > 0)
    flags = jnp.stack([yaw, path, *touching.T[:2], broken], 1)
    return jnp.concatenate([pos[:, :2], flags, qpos], 1).astype(jnp.float32)


def scene_camera(renderer: SceneRenderer, robot: RobotSpec, world: World) -> Camera:
    """Level images of a robot's camera, of the world's first scene."""

    def images(xy: np.ndarray, yaw: np.ndarray, qpos: np.ndarray | None = None) -> np.ndarray:
        bodies = None
        if qpos is not None:
            names, own, pos_w, quat_w = world_poses(world, 0, qpos)
            bodies = names[own:], pos_w[:, own:], quat_w[:, own:]
        return renderer.draw(camera_pose(robot, xy, yaw, np.zeros(len(xy))), bodies)

    return images


def pose_camera(xy_w: np.ndarray, yaw_rad: np.ndarray, _: np.ndarray | None = None) -> np.ndarray:
    """The camera of `sight.TrueSight`: [n, 3] poses."""
    return np.concatenate([np.asarray(xy_w, float), np.asarray(yaw_rad, float)[:, None]], -1)
