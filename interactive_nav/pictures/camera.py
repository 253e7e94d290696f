"""Pictures for people: a state of one environment in, RGB, normals, depth and segmentation at any size out.

    frame = Camera(env).frame(state, 640, 480, streams=("rgb", "normals"), view="follow")

Pictures show the scene's visual meshes. Depth, normals and segmentation come from C MuJoCo's rays, which run
anywhere. RGB comes from MuJoCo's own renderer where a GL is (see `interactive_nav.pictures.gl`), or
from MJX-Warp's, both with textures; where neither is, from rays with a flat colour for each object. MJX-Warp's runs
on a CPU too, after a compilation of ten seconds a size, so there it is used only when asked for.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from interactive_nav.physics import resolve_backend
from interactive_nav.pictures.gl import GlPainter
from interactive_nav.pictures.scene_model import ROBOT, ROBOT_SOLIDS, SCENE, SceneModel, cast, trace
from interactive_nav.sensing.base import FAR_M, CameraPose, Lens, look_along
from interactive_nav.sensing.shading import SKY_COLOUR, geom_colour, lambert
from interactive_nav_common.errors import ConfigError, UserError

STREAMS = ("rgb", "normals", "depth", "segmentation")
VIEWS = ("robot", "top", "follow")
ENGINES = ("auto", "gl", "warp", "rays")


class Camera:
    """Takes pictures of one environment."""

    def __init__(self, env: Any, engine: str = "auto", fov_deg: float | None = None):
        """Prepares nothing that is not asked for.

        Args:
            env: an `InteractiveNav`.
            engine: of RGB: gl, warp, rays, or auto: gl where it works, else warp on an NVIDIA GPU, else rays.
            fov_deg: vertical field of view of the robot's camera; None: that of its observations.

        Raises:
            ConfigError: unknown engine.
        """
        if engine not in ENGINES:
            raise ConfigError(f"engine is '{engine}', expected one of {', '.join(ENGINES)}")
        self._env, self._engine, self._fov_deg = env, engine, fov_deg or env.sensors.lens.fov_deg
        self._models: dict[int, _PictureModel] = {}
        self._painters: dict[tuple, Any] = {}

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
            ConfigError: unknown stream or view, or a batch of states.
        """
        unknown = [s for s in streams if s not in STREAMS]
        if unknown or not streams:
            raise ConfigError(f"streams is {tuple(streams)!r}, expected a choice from {', '.join(STREAMS)}")
        if view not in VIEWS:
            raise ConfigError(f"view is '{view}', expected one of {', '.join(VIEWS)}")
        qpos = np.asarray(state.pipeline_state.qpos)
        if qpos.ndim != 1:
            raise ConfigError(
                f"state is a batch of shape {qpos.shape[:-1]}, expected one environment; "
                "index it first: jax.tree.map(lambda x: x[0], state)"
            )
        scene = int(state.info["nav"].scene_index)
        if scene not in self._models:
            self._models[scene] = _PictureModel(self._env, scene)
        model = self._models[scene]
        model.pose(self._env.world, scene, qpos)
        pose, fov = self._pose(model, qpos, scene, view, width / height)
        lens, groups = Lens(width, height, fov), SCENE if view == "robot" else (*SCENE, ROBOT, ROBOT_SOLIDS)
        out: dict[str, np.ndarray] = {}
        if "rgb" in streams:
            drawn = self._textured(scene, model, pose, lens, groups)
            if drawn is not None:
                out["rgb"] = drawn
        if set(streams) - set(out):
            out |= _by_rays(model, pose, lens, groups, set(streams) - set(out))
        return {name: out[name] for name in streams}

    def _pose(self, model: SceneModel, qpos: np.ndarray, scene: int, view: str, aspect: float):
        """Where the camera of a view is, and its field of view in degrees."""
        env = self._env
        if view == "robot":
            pose = env.sensors.mount.pose(np.asarray(qpos, np.float32))
            return CameraPose(np.asarray(pose.pos_w, float), np.asarray(pose.axes_w, float)), self._fov_deg
        if view == "top":
            maps, fov = env.scenes[scene].maps, 40.0
            rows, columns = maps.traversable.shape
            size = np.array([columns, rows]) * maps.resolution_m
            centre = np.asarray(maps.origin_w) + size / 2
            above = max(size[1], size[0] / aspect) / 2 / math.tan(math.radians(fov / 2)) + 2.5
            down = np.array([[0, 1, 0], [0, 0, 1], [-1, 0, 0]], float)
            return CameraPose(np.array([*centre, above]), down), fov
        base = model.data.body(env.world.robot.base_body)
        ahead = base.xmat.reshape(3, 3)[:, 0] * [1, 1, 0]
        ahead /= max(np.linalg.norm(ahead), 1e-6)
        target = base.xpos + [0, 0, 0.6 * env.world.robot.height_m]
        back = -1.8 * ahead + [0, 0, 1.1]
        # Not behind a wall.
        reach = np.linalg.norm(back)
        hit = cast(model.model, model.data, target, back[None] / reach, SCENE)[1][0] / reach
        eye = target + back * (min(1.0, 0.9 * hit) if hit > 0 else 1.0)
        return look_along(eye, target - eye), 70.0

    def _textured(
        self, scene: int, model: SceneModel, pose: CameraPose, lens: Lens, groups: tuple[int, ...]
    ) -> np.ndarray | None:
        """RGB with textures, or None where rays must do."""
        one = CameraPose(pose.pos_w[None], pose.axes_w[None])
        if self._engine in ("auto", "gl"):
            key = (scene, lens.width, lens.height)
            try:
                if key not in self._painters:
                    self._painters[key] = GlPainter(model.model, lens.width, lens.height, sky=None)
                picture = self._painters[key].draw(model.data, one, lens.fov_deg, groups)[0]
                self._engine = "gl"
                return picture
            except UserError:
                if self._engine == "gl":
                    raise
                self._engine = "warp" if resolve_backend("auto") == "warp" else "rays"
        if self._engine == "warp":
            from interactive_nav.sensing.warp import WarpColour

            key = (scene, lens, groups)
            if key not in self._painters:
                self._painters[key] = WarpColour(model.model, lens, 1, list(groups))
            arrays = model.data.geom_xpos[None], model.data.geom_xmat.reshape(1, -1, 3, 3)
            return np.asarray(self._painters[key].draw(*arrays, one))[0]
        return None


class _PictureModel(SceneModel):
    """A scene's model with the colours that rays give it."""

    def __init__(self, env: Any, scene: int):
        world = env.world
        super().__init__(world.robot, world.scenes[scene], world.small_objects, env.sensors.boxes.classes)
        self.colour = np.array([geom_colour(self.model, g) for g in range(self.model.ngeom)], np.float32)
        """[ngeom, 3] in [0, 1]: of the geom, or its texture's mean."""


def _by_rays(
    model: _PictureModel, pose: CameraPose, lens: Lens, groups: tuple[int, ...], streams: set[str]
) -> dict[str, np.ndarray]:
    ray, geom, depth, faces = trace(model.model, model.data, pose, lens, groups)
    met = (geom >= 0) & (depth > 0) & (depth < FAR_M)
    out: dict[str, np.ndarray] = {"depth": np.where(met, depth, 0.0).astype(np.float32)}
    out["segmentation"] = np.where(met, model.class_id[geom], 0).astype(np.uint8)
    if streams & {"normals", "rgb"}:
        # Meshes may be seen from behind: normals are turned to the viewer.
        faces = np.where(((faces * ray).sum(-1) > 0)[..., None], -faces, faces) * met[..., None]
        forward, right_w, up_w = pose.axes_w.T
        out["normals"] = np.stack([faces @ right_w, faces @ up_w, -(faces @ forward)], -1).astype(np.float32)
        base = np.where(met[..., None], model.colour[geom], np.array(SKY_COLOUR, np.float32))
        out["rgb"] = lambert(base, faces, forward, met, np)
    return {name: out[name] for name in streams}
