"""Render a robot camera's images of a scene, in batches of any size, and build environments to drive in.

Images show furniture and doors as they stand, and small objects as they lie; furniture is at rest at first. `warp`
(MJX-Warp's ray tracer, on a CPU or an NVIDIA GPU) and `gl` (MuJoCo's renderer, needs EGL or OSMesa) draw the textured
visual meshes. Their lighting differs, so a network trained on images of one does not suit the other.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav import InteractiveNav, make
from interactive_nav.pictures.scene_model import SCENE, detach, picture_spec
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import SmallObject, body_names
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.world import World, world_poses
from interactive_nav.types import LOST, EpisodeStart
from interactive_nav_common.errors import UserError, missing, optional
from scenes_mjcf.look import CameraPose, GlPainter, Lens, look_along

CPU_IMAGES = (1, 2, 6, 18)
"""Batch sizes on a CPU, where batching saves no time; 18 are the headings of one position and pitch."""
DEVICE_BATCH, DEVICE_PIXELS = (8, 2048), 256 * 640 * 480
"""Least and most images per call on an accelerator, and the most pixels rendered for them."""
Painter = Callable[..., Any]
"""Positions [n, 3] and axes [n, 3, 3] of cameras, the same of all geoms [n, g, ...], to images [n, H, W, 3] u8, in an
array of any kind."""
Bodies = tuple[Sequence[str], np.ndarray, np.ndarray]
"""Names (B), positions [N, B, 3] (m, world) and quaternions [N, B, 4] of bodies, in N images."""
Camera = Callable[..., np.ndarray]
"""Places [n, 2] (m), headings [n] (rad) and the world's `qpos` [n, nq] to images from there [n, ...]; None: a world at
rest, without small objects."""
HIDDEN_M = -50.0
"""Height of small objects that an image does not show."""
CONTROL = "twist"
"""Control mode whose action is a base velocity."""


def camera_pose(robot: RobotSpec, xy_w: np.ndarray, heading_rad: np.ndarray, pitch_rad: np.ndarray) -> CameraPose:
    """Return a robot camera's pose at [..., 2] m and headings [...]; `pitch_rad` tilts it up from its mount."""
    camera = robot.camera
    if camera.body != robot.base_body:
        raise UserError(
            f"the camera of '{robot.name}' sits on '{camera.body}', expected its base '{robot.base_body}'; "
            "choose a robot with a camera on its base, such as ttbot"
        )
    shape = np.broadcast_shapes(np.shape(xy_w)[:-1], np.shape(heading_rad), np.shape(pitch_rad))
    xy = np.broadcast_to(xy_w, (*shape, 2))
    heading, pitch = np.broadcast_to(heading_rad, shape), np.broadcast_to(pitch_rad, shape) - camera.pitch_rad
    cos, sin = np.cos(heading), np.sin(heading)
    x, y, z = camera.pos_m
    pos = np.stack([xy[..., 0] + cos * x - sin * y, xy[..., 1] + sin * x + cos * y, np.full(shape, z)], -1)
    forward = np.stack([np.cos(pitch) * cos, np.cos(pitch) * sin, np.sin(pitch)], -1)
    return look_along(np.asarray(pos, np.float32), np.asarray(forward, np.float32))


def need_engine(engine: str) -> None:
    """Raise if an engine of images or physics is not installed, before any work is done."""
    if engine == "warp":
        note = "; networks need the engine that they learned from; new pictures can have engine=gl"
        optional("warp", missing("engine=warp", "warp-lang", "warp", note))


class SceneRenderer:
    """Render one scene without a robot."""

    def __init__(
        self, scene: Scene, lens: Lens, supersample: int = 1, engine: str = "warp", small: Sequence[SmallObject] = ()
    ):
        """Load the scene's meshes; the first image may compile."""
        need_engine(engine)
        self._lens, self._by = lens, supersample
        self._large = Lens(lens.width * supersample, lens.height * supersample, lens.fov_deg)
        self._model = _visual_model(scene, self._large, small)
        self._data = mujoco.MjData(self._model)
        for name in body_names(small):
            self._data.qpos[self._model.joint(f"{name}_joint").qposadr[0] + 2] = HIDDEN_M
        mujoco.mj_forward(self._model, self._data)
        detach(self._model, self._data)
        self._sizes = batch_sizes(self._large, jax.default_backend()) if engine == "warp" else (1,)
        self._painter = functools.cache(
            functools.partial(_painter, engine, self._model, self._data, self._large, supersample)
        )
        self._painter(self._sizes[0])  # an engine that does not start says so here

    def draw(self, pose: CameraPose, bodies: Bodies | None = None) -> np.ndarray:
        """Render images [N, H, W, 3] u8 of cameras with leaves [N, ...]."""
        pos, axes = np.asarray(pose.pos_w, np.float32), np.asarray(pose.axes_w, np.float32)
        if not len(pos):
            return np.empty((0, self._lens.height, self._lens.width, 3), np.uint8)
        cameras = pos, axes, *self._geoms(len(pos), bodies)
        return batched(lambda *of: self._painter(len(of[0]))(*of), cameras, self._sizes)

    def _geoms(self, count: int, bodies: Bodies | None) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [count, ngeom, 3] and axes [count, ngeom, 3, 3]."""
        model, data = self._model, self._data
        at_rest = model.body_pos.copy(), model.body_quat.copy()
        names, pos_w, quat_w = bodies or ((), np.empty((count, 0, 3)), np.empty((count, 0, 4)))
        ids = np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in names], int)
        there, geoms = ids > 0, []
        for pos, quat in zip(pos_w, quat_w, strict=True):
            model.body_pos[ids[there]], model.body_quat[ids[there]] = pos[there], quat[there]
            mujoco.mj_kinematics(model, data)
            geoms.append((data.geom_xpos.astype(np.float32), data.geom_xmat.reshape(-1, 3, 3).astype(np.float32)))
        model.body_pos[:], model.body_quat[:] = at_rest
        xpos, xmat = map(np.stack, zip(*geoms, strict=True))
        return xpos, xmat


# Not a method: a context holds some 100 MiB, and goes with its renderer, not when cycles are collected.
def _painter(engine: str, model: mujoco.MjModel, data: mujoco.MjData, lens: Lens, by: int, size: int) -> Painter:
    if engine == "warp":
        from interactive_nav.sensing.warp import WarpColour

        warp = WarpColour(model, lens, size, list(SCENE))
        return jax.jit(lambda pos, axes, xpos, xmat: shrink(warp.draw(xpos, xmat, CameraPose(pos, axes)), by))
    gl = GlPainter(model, lens.width, lens.height)

    def paint(pos: np.ndarray, axes: np.ndarray, xpos: np.ndarray, xmat: np.ndarray) -> np.ndarray:
        data.geom_xpos[:], data.geom_xmat[:] = xpos[0], xmat[0].reshape(-1, 9)
        return shrink(gl.draw(data, CameraPose(pos, axes), lens.fov_deg, SCENE), by)

    return paint


def batch_sizes(lens: Lens, platform: str) -> tuple[int, ...]:
    """Return the engine's batch sizes, ascending; each compiles at its first use."""
    if platform == "cpu":
        return CPU_IMAGES
    least, most = DEVICE_BATCH
    most = min(most, max(least, DEVICE_PIXELS // (lens.width * lens.height)))
    return tuple(1 << n for n in range(least.bit_length() - 1, most.bit_length()))


def calls(count: int, sizes: tuple[int, ...]) -> list[int]:
    """Return batch sizes for `count` images: unpadded if one is 1, else the fewest calls and the smallest last one."""
    out: list[int] = []
    while count > 0:
        if sizes[0] == 1:
            out.append(max(n for n in sizes if n <= count))
        else:
            out.append(next((n for n in sizes if n >= count), sizes[-1]))
        count -= out[-1]
    return out


def batched(function: Callable[..., Any], arrays: Sequence[np.ndarray], sizes: tuple[int, ...]) -> Any:
    """Return a function's rows (a tree) for arrays [N, ...], in calls of these sizes only; the last call is padded."""
    count, first, waiting, out = len(arrays[0]), 0, None, []
    for size in calls(count, sizes):
        rows = np.minimum(np.arange(first, first + size), count - 1)
        call, first = function(*(array[rows] for array in arrays)), first + size
        if waiting is not None:  # copied while an accelerator works on the next
            out.append(jax.tree.map(np.asarray, waiting))
        waiting = call
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *out, jax.tree.map(np.asarray, waiting))


def shrink(images: Any, by: int) -> Any:
    """Average squares of `by` pixels: [N, by H, by W, 3] u8 to [N, H, W, 3], equal on all devices; halves to even."""
    if by == 1:
        return images
    xp = jnp if isinstance(images, jax.Array) else np
    n, height, width, channels = images.shape
    # Rows first, in one piece of memory each: NumPy is several times slower over both axes at once.
    rows = images.reshape(n, height // by, by, width, channels).sum(2, dtype=xp.uint32)
    total = rows.reshape(n, height // by, width // by, by, channels).sum(3, dtype=xp.uint32)
    area = by * by
    whole, rest = total // area, total % area
    up = (2 * rest > area) | ((2 * rest == area) & (whole % 2 == 1))
    return (whole + up).astype(xp.uint8)


def _visual_model(scene: Scene, lens: Lens, small: Sequence[SmallObject]) -> mujoco.MjModel:
    """Build the scene's visual meshes and floor; bodies without a mesh are boxes."""
    spec = picture_spec(scene, small=small)
    if not any(body.joints for body in spec.bodies):
        # MJX-Warp wants at least one degree of freedom.
        body = spec.worldbody.add_body(name="unseen", pos=[0, 0, -60.0])
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
        body.mass, body.inertia, body.explicitinertial = 1.0, np.ones(3), True
    spec.visual.global_.offwidth, spec.visual.global_.offheight = max(lens.width, 640), max(lens.height, 480)
    return spec.compile()


def make_env(scenes: Sequence[Path], robot: str | RobotSpec, backend: str, **settings: Any) -> InteractiveNav:
    """Build an environment of velocity commands to a robot by `interactive_nav.make`, with endless episodes."""
    need_engine(backend)
    fixed = {"control_mode": CONTROL, "episode_steps": 10**8, "num_waypoints": 1}
    return make(robot, scenes, backend=backend, **fixed, **settings)


def episode_starts(start_xy_w: Any, yaw_rad: Any, goal_xy_w: Any, objects: int, scene: Any = 0) -> EpisodeStart:
    """Return the starts of B episodes, in scenes [B] or in one, without small objects."""
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
    """Hold the state of a batch of robots."""

    xy_w: np.ndarray
    """[B, 2] m."""
    yaw_rad: np.ndarray
    """[B]."""
    path_m: np.ndarray
    """[B] driven so far."""
    movable: np.ndarray
    """[B] bool: touched a movable object in the last control step."""
    wall: np.ndarray
    """[B] bool: touched a wall in the last control step."""
    qpos: np.ndarray
    """[B, nq] of the environment."""
    broken: np.ndarray
    """[B] bool: the physics failed, lost contacts, or had no room for an object near or awake (MJX)."""

    @classmethod
    def of(cls, state: Any) -> "Snapshot":
        """Read the state of a batch of environments."""
        nav = state.info["nav"]
        memory = [nav.memory[name] for name in ("robot_path_m", "touching")]
        lost = sum((nav.memory[name] for name in LOST), jnp.zeros(()))
        parts = nav.robot_pos_w, nav.yaw_rad, *memory, lost, state.metrics["nonfinite"], state.pipeline_state.qpos
        values = np.asarray(_packed(*parts)).astype(float)
        (yaw, path), (movable, wall, broken) = values[:, 2:4].T, values[:, 4:7].T > 0
        return cls(values[:, :2], yaw, path, movable, wall, values[:, 7:], broken)


@jax.jit
def _packed(pos, yaw, path, touching, lost, nonfinite, qpos) -> jax.Array:
    """Return a `Snapshot` as one array [B, 7 + nq] f32, because each transfer stalls an accelerator."""
    broken = (nonfinite > 0) | (lost > 0)
    flags = jnp.stack([yaw, path, *touching.T[:2], broken], 1)
    return jnp.concatenate([pos[:, :2], flags, qpos], 1).astype(jnp.float32)


def scene_camera(renderer: SceneRenderer, robot: RobotSpec, world: World) -> Camera:
    """Return a function that renders level images of a robot's camera in the world's first scene."""

    def images(xy: np.ndarray, yaw: np.ndarray, qpos: np.ndarray | None = None) -> np.ndarray:
        bodies = None
        if qpos is not None:
            names, first, pos_w, quat_w = world_poses(world, 0, qpos)
            bodies = names[first:], pos_w[:, first:], quat_w[:, first:]
        return renderer.draw(camera_pose(robot, xy, yaw, np.zeros(len(xy))), bodies)

    return images
