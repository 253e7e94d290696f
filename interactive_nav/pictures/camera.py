"""Pictures for people: a state of one environment in, RGB, normals, depth and segmentation at any size out.

    frame = Camera(env).frame(state, 640, 480, streams=("rgb", "normals"), view="follow")

Pictures show the scene's visual meshes. Depth, normals and segmentation come from C MuJoCo's rays, which run
anywhere. RGB comes from MuJoCo's own renderer where a GL is (set MUJOCO_GL to egl or osmesa without a display), or
from MJX-Warp's, both with textures; where neither is, from rays with a flat colour for each object. MJX-Warp's runs
on a CPU too, after a compilation of ten seconds a size, so there it is used only when asked for.
"""

from __future__ import annotations

import math
import os
import warnings
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.physics import resolve_backend
from interactive_nav.pictures.shading import BACKGROUND_COLOUR, lambert
from interactive_nav.pictures.visual import ROBOT_GROUP, VISUAL_GROUP, VisualModel, build_visual
from interactive_nav.sensing.base import FAR_M, CameraPose, Lens

STREAMS = ("rgb", "normals", "depth", "segmentation")
VIEWS = ("robot", "top", "follow")
ENGINES = ("auto", "gl", "warp", "rays")


class Camera:
    """Takes pictures of one environment."""

    def __init__(self, env: Any, engine: str = "auto"):
        """Prepares nothing that is not asked for.

        Args:
            env: an `InteractiveNav`.
            engine: of RGB: gl, warp, rays, or auto: gl where it works, else warp on an NVIDIA GPU, else rays.

        Raises:
            ValueError: unknown engine.
        """
        if engine not in ENGINES:
            raise ValueError(f"engine is '{engine}', expected one of {', '.join(ENGINES)}")
        self._env, self._engine = env, engine
        self._visual: dict[int, VisualModel] = {}
        self._renderers: dict[tuple, Any] = {}

    @property
    def engine(self) -> str:
        """Who draws RGB; auto until the first picture."""
        return self._engine

    def frame(
        self,
        state: Any,
        width: int = 512,
        height: int = 512,
        streams: tuple[str, ...] = ("rgb",),
        view: str = "robot",
    ) -> dict[str, np.ndarray]:
        """Pictures of where a state is now.

        Args:
            state: of one environment, not a batch.
            width: pixels.
            height: pixels.
            streams: of rgb, normals, depth, segmentation.
            view: robot (through its camera), top (the whole scene from above) or follow (from behind the robot).

        Returns:
            rgb [H, W, 3] u8; normals [H, W, 3] f32, unit vectors in the camera's frame (right, up, towards the
            viewer), 0 where nothing is; depth [H, W] f32, m along the optical axis, 0 where nothing is;
            segmentation [H, W] u8 class ids.

        Raises:
            ValueError: unknown stream or view, or a batch of states.
        """
        unknown = [s for s in streams if s not in STREAMS]
        if unknown or not streams:
            raise ValueError(f"streams is {tuple(streams)!r}, expected a choice from {', '.join(STREAMS)}")
        if view not in VIEWS:
            raise ValueError(f"view is '{view}', expected one of {', '.join(VIEWS)}")
        qpos = np.asarray(state.pipeline_state.qpos)
        if qpos.ndim != 1:
            raise ValueError(
                f"state is a batch of shape {qpos.shape[:-1]}, expected one environment; "
                "index it first: jax.tree.map(lambda x: x[0], state)"
            )
        scene = int(state.info["nav"].scene_index)
        if scene not in self._visual:
            self._visual[scene] = build_visual(self._env.world, scene, self._env.sensors.boxes.classes)
        visual = self._visual[scene]
        data = visual.pose(qpos)
        pose, fov = self._pose(visual, data, qpos, scene, view, width / height)
        lens, groups = Lens(width, height, fov), _groups(view != "robot")
        out: dict[str, np.ndarray] = {}
        if "rgb" in streams:
            drawn = self._textured(scene, visual, data, pose, lens, groups)
            if drawn is not None:
                out["rgb"] = drawn
        if set(streams) - set(out):
            out |= _by_rays(visual, data, pose, lens, groups, set(streams) - set(out))
        return {name: out[name] for name in streams}

    def _pose(self, visual: VisualModel, data: mujoco.MjData, qpos, scene: int, view: str, aspect: float):
        env = self._env
        if view == "robot":
            pose = env.sensors.mount.pose(np.asarray(qpos, np.float32))
            return _Pose(np.asarray(pose.pos_w, float), np.asarray(pose.axes_w, float)), env.sensors.lens.fov_deg
        if view == "top":
            maps, fov = env.scenes[scene].maps, 40.0
            rows, columns = maps.traversable.shape
            size = np.array([columns, rows]) * maps.resolution_m
            centre = np.asarray(maps.origin_w) + size / 2
            above = max(size[1], size[0] / aspect) / 2 / math.tan(math.radians(fov / 2)) + 2.5
            return _Pose(np.array([*centre, above]), np.array([[0, 1, 0], [0, 0, 1], [-1, 0, 0]], float)), fov
        base = data.body(env.world.robot.base_body)
        ahead = base.xmat.reshape(3, 3)[:, 0] * [1, 1, 0]
        ahead /= max(np.linalg.norm(ahead), 1e-6)
        target = base.xpos + [0, 0, 0.6 * env.world.robot.height_m]
        back = -1.8 * ahead + [0, 0, 1.1]
        # Not behind a wall.
        hit = mujoco.mj_ray(visual.model, data, target, back, _groups(False), 1, -1, np.zeros(1, np.int32))
        eye = target + back * (min(1.0, 0.9 * hit) if hit > 0 else 1.0)
        forward = (target - eye) / np.linalg.norm(target - eye)
        right = np.array([forward[1], -forward[0], 0.0]) / np.linalg.norm(forward[:2])
        return _Pose(eye, np.stack([forward, right, np.cross(right, forward)], -1)), 70.0

    def _textured(self, scene: int, visual: VisualModel, data, pose: _Pose, lens: Lens, groups) -> np.ndarray | None:
        """RGB with textures, or None where rays must do."""
        if self._engine in ("auto", "gl"):
            try:
                picture = self._gl(scene, visual, data, pose, lens, groups)
                self._engine = "gl"
                return picture
            except Exception as error:  # noqa: BLE001  (GL bindings raise what they like where no GL is)
                if self._engine == "gl":
                    raise RuntimeError(
                        f"MuJoCo's renderer does not start here ({error}); set MUJOCO_GL to egl or osmesa and "
                        "install that library, or choose engine='warp' or 'rays'"
                    ) from error
                self._engine = "warp" if resolve_backend("auto") == "warp" else "rays"
        if self._engine == "warp":
            from interactive_nav.sensing.warp import WarpColour

            key = (scene, lens, bytes(groups))
            if key not in self._renderers:
                shown = [i for i, g in enumerate(groups) if g]
                self._renderers[key] = WarpColour(visual.model, lens, 1, shown)
            camera = CameraPose(jnp.asarray(pose.pos_w[None]), jnp.asarray(pose.axes_w[None]))
            arrays = data.geom_xpos[None], data.geom_xmat.reshape(1, -1, 3, 3)
            return np.asarray(self._renderers[key].draw(*arrays, camera))[0]
        return None

    def _gl(self, scene: int, visual: VisualModel, data, pose: _Pose, lens: Lens, groups) -> np.ndarray:
        key = (scene, lens.width, lens.height)
        if key not in self._renderers:
            _choose_gl()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._renderers[key] = mujoco.Renderer(visual.model, lens.height, lens.width)
        renderer = self._renderers[key]
        forward, up = pose.axes_w[:, 0], pose.axes_w[:, 2]
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = pose.pos_w + forward
        camera.distance = 1.0
        camera.elevation = math.degrees(math.asin(np.clip(forward[2], -1.0, 1.0)))
        flat = forward if abs(forward[2]) < 1 - 1e-9 else up
        camera.azimuth = math.degrees(math.atan2(flat[1], flat[0]))
        visual.model.vis.global_.fovy = lens.fov_deg
        option = mujoco.MjvOption()
        option.geomgroup[:] = groups
        renderer.update_scene(data, camera, option)
        return renderer.render()


class _Pose:
    """A camera on the host: (3,) position and (3, 3) axes forward, right, up as columns."""

    def __init__(self, pos_w: np.ndarray, axes_w: np.ndarray):
        self.pos_w, self.axes_w = pos_w, axes_w


def _groups(robot: bool) -> np.ndarray:
    out = np.zeros(6, np.uint8)
    out[VISUAL_GROUP], out[ROBOT_GROUP] = 1, robot
    return out


def _choose_gl() -> None:
    """Without a display and a choice of its own, MuJoCo would look for a window system."""
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")


def _by_rays(visual: VisualModel, data, pose: _Pose, lens: Lens, groups, streams: set[str]) -> dict[str, np.ndarray]:
    right, up = np.meshgrid(lens.columns.astype(float), lens.rows.astype(float))
    ray = np.stack([np.ones_like(right), right, up], -1) @ pose.axes_w.T
    length = np.linalg.norm(ray, axis=-1)
    count = length.size
    geom, distance, normal = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
    unit = (ray / length[..., None]).ravel()
    mujoco.mj_multiRay(
        visual.model, data, pose.pos_w, unit, groups, 1, -1, geom, distance, normal, count, FAR_M * length.max()
    )
    depth = (distance / length.ravel()).reshape(length.shape)
    met = (geom >= 0).reshape(length.shape) & (depth > 0) & (depth < FAR_M)
    geom = geom.reshape(length.shape)
    out: dict[str, np.ndarray] = {"depth": np.where(met, depth, 0.0).astype(np.float32)}
    out["segmentation"] = np.where(met, visual.class_id[geom], 0).astype(np.uint8)
    if streams & {"normals", "rgb"}:
        faces = normal.reshape(*length.shape, 3)
        # Meshes may be seen from behind: normals are turned to the viewer.
        faces = np.where(((faces * ray).sum(-1) > 0)[..., None], -faces, faces) * met[..., None]
        forward, right_w, up_w = pose.axes_w.T
        out["normals"] = np.stack([faces @ right_w, faces @ up_w, -(faces @ forward)], -1).astype(np.float32)
        base = np.where(met[..., None], visual.colour[geom], np.array(BACKGROUND_COLOUR, np.float32))
        out["rgb"] = lambert(base, faces, forward, met, np)
    return {name: out[name] for name in streams}
