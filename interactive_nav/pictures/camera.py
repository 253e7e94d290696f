"""Draw pictures for people of one environment's state: RGB, normals, depth and segmentation at any size.

    frame = PictureCamera(env).frame(state, 640, 480, streams=("rgb", "normals"), view="follow")

Pictures show the scene's visual meshes. Depth, normals and segmentation come from C MuJoCo's rays, which run
anywhere. RGB comes from MuJoCo's renderer where a GL is (see `interactive_nav.pictures.gl`), or
from MJX-Warp's, both with textures; where neither is, from rays with a flat colour for each object. MJX-Warp's runs
on a CPU too, after a compilation of ten seconds a size, so there it is used only on request.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from interactive_nav.physics import resolve_backend
from interactive_nav.pictures.gl import GlPainter
from interactive_nav.pictures.scene_model import ROBOT, ROBOT_SOLIDS, SCENE, SceneModel, cast, trace
from interactive_nav.sensing.base import FAR_M, CameraPose, Lens, look_along
from interactive_nav.sensing.shading import SKY_COLOUR, lambert
from interactive_nav_common.errors import ConfigError, UserError

STREAMS = ("rgb", "normals", "depth", "segmentation")
VIEWS = ("robot", "top", "follow")
BEHIND_M = {"follow": (1.8, 1.8), "eye": (2.6, 1.5)}
"""Views of films and viewers: how far behind the robot and how high a camera is, m; it looks at its middle."""
ENGINES = ("auto", "gl", "warp", "rays")


class Painter:
    """RGB with textures of scene models, by the first engine that works here."""

    def __init__(self, engine: str = "auto"):
        """Prepare nothing before it is needed; `engine` as `PictureCamera` has it; auto until the first picture."""
        if engine not in ENGINES:
            raise ConfigError(f"engine is '{engine}', expected one of {', '.join(ENGINES)}")
        self.engine = engine
        self._painters: dict[tuple, Any] = {}

    def draw(self, model: SceneModel, pose: CameraPose, lens: Lens, groups: Sequence[int]) -> np.ndarray | None:
        """Draw [H, W, 3] u8 of a model's geoms of these groups; None where rays must do."""
        one = CameraPose(np.asarray(pose.pos_w)[None], np.asarray(pose.axes_w)[None])
        if self.engine in ("auto", "gl"):
            key = (model, lens.width, lens.height)
            try:
                if key not in self._painters:
                    self._painters[key] = GlPainter(model.model, lens.width, lens.height, sky=None)
                picture = self._painters[key].draw(model.data, one, lens.fov_deg, groups)[0]
                self.engine = "gl"
                return picture
            except UserError:
                if self.engine == "gl":
                    raise
                self.engine = "warp" if resolve_backend("auto") == "warp" else "rays"
        if self.engine == "warp":
            from interactive_nav.sensing.warp import WarpColour

            key = (model, lens, tuple(groups))
            if key not in self._painters:
                self._painters[key] = WarpColour(model.model, lens, 1, list(groups))
            arrays = model.data.geom_xpos[None], model.data.geom_xmat.reshape(1, -1, 3, 3)
            return np.asarray(self._painters[key].draw(*arrays, one))[0]
        return None

    def depth(self, model: SceneModel, pose: CameraPose, lens: Lens, groups: Sequence[int]) -> np.ndarray:
        """Return [H, W] depth along the axis, m, of the picture last drawn: GL looks through ceilings."""
        if self.engine != "gl":
            return trace(model.model, model.data, pose, lens, groups)[2]
        one = CameraPose(np.asarray(pose.pos_w)[None], np.asarray(pose.axes_w)[None])
        return self._painters[model, lens.width, lens.height].draw(model.data, one, lens.fov_deg, groups, depth=True)[0]


def clear_way(model: SceneModel, target_w: np.ndarray, back_w: np.ndarray, groups: Sequence[int] = SCENE) -> float:
    """Return the share of the way from a target (3,) along (3,), both m, at which a camera clears what is behind."""
    reach = np.linalg.norm(back_w)
    hit = cast(model.model, model.data, target_w, back_w[None] / reach, groups)[1][0] / reach
    return min(1.0, 0.9 * hit) if hit > 0 else 1.0


def straight_down(low_w: np.ndarray, high_w: np.ndarray, aspect: float, fov_deg: float) -> CameraPose:
    """Return a camera, x to the right and y up, over the floor between two corners (2,), m, and its walls."""
    size, centre = np.subtract(high_w, low_w), np.add(high_w, low_w) / 2
    above = max(size[1], size[0] / aspect) / 2 / math.tan(math.radians(fov_deg / 2)) + 2.5
    return CameraPose(np.array([*centre, above]), np.array([[0, 1, 0], [0, 0, 1], [-1, 0, 0]], float))


class PictureCamera:
    """Takes pictures of one environment."""

    def __init__(self, env: Any, engine: str = "auto", fov_deg: float | None = None):
        """Prepare nothing before it is needed.

        Args:
            fov_deg: vertical field of view of the robot's camera; None: that of its observations.
        """
        self._env, self._painter, self._fov_deg = env, Painter(engine), fov_deg or env.sensors.lens.fov_deg
        world, classes = env.world, env.sensors.boxes.classes
        self._model = functools.cache(
            lambda scene: SceneModel(world.robot, world.scenes[scene], world.small_objects, classes)
        )

    @property
    def engine(self) -> str:
        """Return who draws RGB; auto until the first picture."""
        return self._painter.engine

    def frame(
        self,
        state: Any,
        width: int = 512,
        height: int = 512,
        streams: tuple[str, ...] = ("rgb",),
        view: str = "robot",
    ) -> dict[str, np.ndarray]:
        """Draw pictures of where a state is now.

        Args:
            width: pixels.
            height: pixels.

        Returns:
            rgb [H, W, 3] u8; normals [H, W, 3] f32, unit vectors in the camera's frame (right, up, towards the
            viewer), 0 where nothing is; depth [H, W] f32, m along the optical axis, 0 where nothing is;
            segmentation [H, W] u8 class ids.
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
        model = self._model(scene)
        model.pose(self._env.world, scene, qpos)
        pose, fov = self._pose(model, qpos, scene, view, width / height)
        lens, groups = Lens(width, height, fov), SCENE if view == "robot" else (*SCENE, ROBOT, ROBOT_SOLIDS)
        out: dict[str, np.ndarray] = {}
        if "rgb" in streams:
            drawn = self._painter.draw(model, pose, lens, groups)
            if drawn is not None:
                out["rgb"] = drawn
        if set(streams) - set(out):
            out |= _by_rays(model, pose, lens, groups, set(streams) - set(out))
        return {name: out[name] for name in streams}

    def _pose(self, model: SceneModel, qpos: np.ndarray, scene: int, view: str, aspect: float):
        """Return where the camera of a view is, and its field of view in degrees."""
        env = self._env
        if view == "robot":
            pose = env.sensors.mount.pose(np.asarray(qpos, np.float32))
            return CameraPose(np.asarray(pose.pos_w, float), np.asarray(pose.axes_w, float)), self._fov_deg
        if view == "top":
            maps = env.scenes[scene].maps
            size = np.array(maps.traversable.shape[::-1]) * maps.resolution_m
            return straight_down(maps.origin_w, maps.origin_w + size, aspect, 40.0), 40.0
        base = model.data.body(env.world.robot.base_body)
        ahead = base.xmat.reshape(3, 3)[:, 0] * [1, 1, 0]
        ahead /= max(np.linalg.norm(ahead), 1e-6)
        target = base.xpos + [0, 0, 0.6 * env.world.robot.height_m]
        back = -1.8 * ahead + [0, 0, 1.1]
        eye = target + back * clear_way(model, target, back)
        return look_along(eye, target - eye), 70.0


def _by_rays(
    model: SceneModel, pose: CameraPose, lens: Lens, groups: tuple[int, ...], streams: set[str]
) -> dict[str, np.ndarray]:
    ray, geom, depth, faces = trace(model.model, model.data, pose, lens, groups)
    met = (geom >= 0) & (depth > 0) & (depth < FAR_M)
    out: dict[str, np.ndarray] = {"depth": np.where(met, depth, 0.0).astype(np.float32)}
    out["segmentation"] = np.where(met, model.class_id[geom], 0).astype(np.uint8)
    if streams & {"normals", "rgb"}:
        # Meshes may be visible from behind: normals are turned to the viewer.
        faces = np.where(((faces * ray).sum(-1) > 0)[..., None], -faces, faces) * met[..., None]
        forward, right_w, up_w = pose.axes_w.T
        out["normals"] = np.stack([faces @ right_w, faces @ up_w, -(faces @ forward)], -1).astype(np.float32)
        base = np.where(met[..., None], model.colour[geom], np.array(SKY_COLOUR, np.float32))
        out["rgb"] = lambert(base, faces, forward, met, np)
    return {name: out[name] for name in streams}
