"""Build the environments of drives and contests, read where their robots are, and take their cameras' images.

Furniture begins where it stands at rest. Images show what is pushed where it is, open doors open, and small objects
where they lie.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import interactive_nav
from interactive_nav.pictures.scene_model import world_poses
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.world import World
from interactive_nav.task.env import InteractiveNav
from interactive_nav.types import EpisodeStart
from topological_nav.scenes.rendering import SceneRenderer, camera_pose, need_engine

Camera = Callable[..., np.ndarray]
"""Places [n, 2] (m), headings [n] (rad) and the world's `qpos` [n, nq] to images from there [n, ...]; None: a world at
rest, without small objects."""
CONTROL = "twist"
"""Control mode whose action is a base velocity."""


def make_env(scenes: Sequence[Path], robot: str | RobotSpec, backend: str, **settings: Any) -> InteractiveNav:
    """Build an environment of velocity commands to a robot, by `interactive_nav.make`; its episodes have no end."""
    need_engine(backend)
    fixed = {"control_mode": CONTROL, "episode_steps": 10**8, "num_waypoints": 1}
    return interactive_nav.make(robot, scenes, backend=backend, **fixed, **settings)


def episode_starts(start_xy_w: Any, yaw_rad: Any, goal_xy_w: Any, objects: int, scene: Any = 0) -> EpisodeStart:
    """Return the starts of B episodes, in scenes [B] or one of an environment, small objects left out."""
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


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """Hold where a batch of robots is."""

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

    @classmethod
    def of(cls, state: Any) -> "Snapshot":
        """Read the state of a batch of environments."""
        nav = state.info["nav"]
        memory = [nav.memory[name] for name in ("robot_path_m", "touching", "overflow_steps", "left_out_steps")]
        parts = nav.robot_pos_w, nav.yaw_rad, *memory, state.metrics["nonfinite"], state.pipeline_state.qpos
        values = np.asarray(_packed(*parts)).astype(float)
        (yaw, path), (movable, wall, broken) = values[:, 2:4].T, values[:, 4:7].T > 0
        return cls(values[:, :2], yaw, path, movable, wall, values[:, 7:], broken)


@jax.jit
def _packed(pos, yaw, path, touching, overflow, left_out, nonfinite, qpos) -> jax.Array:
    """Return a `Snapshot` as one array [B, 7 + nq] f32, because every transfer from an accelerator makes it wait."""
    broken = (nonfinite > 0) | (overflow + left_out > 0)
    flags = jnp.stack([yaw, path, *touching.T[:2], broken], 1)
    return jnp.concatenate([pos[:, :2], flags, qpos], 1).astype(jnp.float32)


def scene_camera(renderer: SceneRenderer, robot: RobotSpec, world: World) -> Camera:
    """Return the level images of a robot's camera, in the world's first scene."""

    def images(xy: np.ndarray, yaw: np.ndarray, qpos: np.ndarray | None = None) -> np.ndarray:
        bodies = None
        if qpos is not None:
            names, first, pos_w, quat_w = world_poses(world, 0, qpos)
            bodies = names[first:], pos_w[:, first:], quat_w[:, first:]
        return renderer.draw(camera_pose(robot, xy, yaw, np.zeros(len(xy))), bodies)

    return images


def pose_camera(xy_w: np.ndarray, yaw_rad: np.ndarray, _: np.ndarray | None = None) -> np.ndarray:
    """Return poses [n, 3], the images of `sight.TrueSight`."""
    return np.concatenate([np.asarray(xy_w, float), np.asarray(yaw_rad, float)[:, None]], -1)
