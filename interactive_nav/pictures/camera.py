"""Draw pictures for people: of an environment's state, or of a scene whose bodies are put where one wants them::

    frame = PictureCamera(env).frame(state, 640, 480, streams=("rgb", "normals"), view="follow")

Pictures show the scene's visual meshes. Depth, normals and segmentation come from C MuJoCo's rays, which run
anywhere. RGB comes from MuJoCo's renderer where a GL is (see `scenes_mjcf.look`), or
from MJX-Warp's, both with textures; where neither is, from rays with a flat colour for each object. MJX-Warp's runs
on a CPU too, after a compilation of ten seconds a size, so there it is used only on request.
"""

import colorsys
import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from interactive_nav.physics import resolve_backend
from interactive_nav.pictures.scene_model import CUT_WALLS, ROBOT, ROBOT_SOLIDS, SCENE, THINGS, SceneModel, clear_way
from interactive_nav.sensing.base import FAR_M, lit
from interactive_nav_common.errors import ConfigError, UserError
from interactive_nav_common.rotations import yaw_from_quat
from scenes_mjcf.categories import SEGMENTATIONS, TABLE, MaskClasses
from scenes_mjcf.look import SKY_COLOUR, CameraPose, GlPainter, Lens, cast, look_along, straight_down, trace

STREAMS = ("rgb", "normals", "depth", "segmentation")
VIEWS = ("robot", "top", "follow")
BEHIND_M = {"follow": (1.8, 1.8), "eye": (2.6, 1.5)}
"""Views of films and viewers: how far behind the robot and how high a camera is, m; it looks at its middle."""
ENGINES = ("auto", "gl", "warp", "rays")

COLOURS = {category.name: category.colour for category in TABLE}
"""RGB in [0, 1] by category, in colour and mask pictures alike."""
GOAL_COLOUR = (0.30, 0.72, 0.36)
TRAIL_COLOUR = (0.16, 0.47, 0.84)
FLOOR_COLOUR = (0.80, 0.78, 0.74)
ON_FLOOR_M = 0.03
"""What is no higher, such as a carpet, is painted on."""
OUTSIDE = (THINGS, CUT_WALLS, ROBOT)
"""What a view from outside shows: walls cut low."""


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
                    self._painters[key] = GlPainter(model.model, lens.width, lens.height, sky=None, shadows=True)
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


class PictureCamera:
    """Takes pictures of one environment."""

    def __init__(self, env: Any, engine: str = "auto"):
        """Prepare nothing before it is needed."""
        self._env, self._painter = env, Painter(engine)
        world, classes = env.world, env.sensors.boxes.classes
        self._model = functools.cache(
            lambda scene: SceneModel(world.robot, world.scenes[scene], world.small_objects, classes)
        )

    def frame(
        self, state: Any, width: int = 512, height: int = 512, streams: tuple[str, ...] = ("rgb",), view: str = "robot"
    ) -> dict[str, np.ndarray]:
        """Draw pictures, `width` by `height` pixels, of where a state is now.

        rgb [H, W, 3] u8; normals [H, W, 3] f32, unit vectors in the camera's frame (right, up, towards the viewer), 0
        where nothing is; depth [H, W] f32, m along the optical axis, 0 where nothing is; segmentation [H, W] u8.
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
            out = by_rays(model, pose, lens, groups) | out
        return {name: out[name] for name in streams}

    def _pose(self, model: SceneModel, qpos: np.ndarray, scene: int, view: str, aspect: float):
        """Return where the camera of a view is, and its field of view in degrees."""
        env = self._env
        if view == "robot":
            pose = env.sensors.mount.pose(np.asarray(qpos, np.float32))
            return CameraPose(np.asarray(pose.pos_w, float), np.asarray(pose.axes_w, float)), env.sensors.lens.fov_deg
        if view == "top":
            maps = env.scenes[scene].maps
            size = np.array(maps.traversable.shape[::-1]) * maps.resolution_m
            return straight_down(maps.origin_w, maps.origin_w + size, aspect, 40.0), 40.0
        return behind(model), 60.0


def by_rays(model: SceneModel, pose: CameraPose, lens: Lens, groups: Sequence[int]) -> dict[str, np.ndarray]:
    """Return all streams of `PictureCamera.frame`, without textures."""
    ray, geom, depth, faces = trace(model.model, model.data, pose, lens, groups)
    met = (geom >= 0) & (depth > 0) & (depth < FAR_M)
    # Meshes may be visible from behind: normals are turned to the viewer.
    faces = np.where(((faces * ray).sum(-1) > 0)[..., None], -faces, faces) * met[..., None]
    forward, right_w, up_w = pose.axes_w.T
    base = np.where(met[..., None], model.colour[geom], np.array(SKY_COLOUR, np.float32))
    return {
        "rgb": np.round(255.0 * lit(base, faces, forward, met, np)).astype(np.uint8),
        "normals": np.stack([faces @ right_w, faces @ up_w, -(faces @ forward)], -1).astype(np.float32),
        "depth": np.where(met, depth, 0.0).astype(np.float32),
        "segmentation": np.where(met, model.class_id[geom], 0).astype(np.uint8),
    }


@dataclasses.dataclass(frozen=True)
class FloorPaint:
    """What is drawn on the floor of views from outside."""

    goal_xy_w: np.ndarray | None = None
    """(2,) m."""
    goal_radius_m: float = 0.33
    trail_xy_w: np.ndarray | None = None
    """[n, 2] path so far, m."""


class SceneView(SceneModel):
    """One scene with a robot and small objects, in the colours of their categories or with textures."""

    for_people = True

    @functools.cached_property
    def _painter(self) -> Painter:
        return Painter()

    @functools.cached_property
    def colour(self) -> np.ndarray:
        """Return [ngeom, 3] in [0, 1]: of each geom's category; objects of one kind differ a little."""
        floor, things = self.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, self.model.geom_group == THINGS
        colour = np.array([COLOURS[category] for category in self.category])
        for g in np.flatnonzero(things):
            colour[g] = FLOOR_COLOUR if floor[g] else _varied(colour[g], int(self.model.geom_bodyid[g]))
        return colour

    def render(
        self, pose: CameraPose, lens: Lens, groups: Sequence[int] = OUTSIDE, paint: FloorPaint | None = None
    ) -> dict[str, np.ndarray]:
        """Return the streams of `by_rays`, with `paint` on a chequered floor, and from outside with shadows."""
        out = by_rays(self, pose, lens, groups)
        rgb = _painted(out["rgb"], out["depth"], pose, lens, paint or FloorPaint(), 0.96)
        if CUT_WALLS in groups:
            rgb = np.clip(rgb * self._light(out["depth"], pose, lens, groups)[..., None], 0, 255).astype(np.uint8)
        return out | {"rgb": rgb}

    def _light(self, depth_m: np.ndarray, pose: CameraPose, lens: Lens, groups: Sequence[int]) -> np.ndarray:
        """Return [rows, columns] brightness by a lamp high above the middle of the view, which casts shadows."""
        light, met = np.ones(depth_m.shape), depth_m > 0
        points = pose.pos_w + (lens.rays(pose) * depth_m[..., None])[met]
        lamp = np.array([*points[:, :2].mean(0) - [2.0, 3.0], 9.0]) if len(points) else np.zeros(3)
        far = np.linalg.norm(points - lamp, axis=1)
        _, distance, _ = cast(self.model, self.data, lamp, (points - lamp) / far[:, None], groups)
        light[met] = np.where((distance < 0) | (distance > far - 0.02), 1.13, 0.83)
        return light

    def textured(
        self, pose: CameraPose, lens: Lens, groups: Sequence[int], paint: FloorPaint | None = None
    ) -> np.ndarray:
        """Render [rows, columns, 3] u8 with textures, or as `render` colours it where no engine draws them."""
        drawn = self._painter.draw(self, pose, lens, groups)
        if drawn is None:
            return self.render(pose, lens, groups, paint)["rgb"]
        return _painted(drawn, self._painter.depth(self, pose, lens, groups), pose, lens, paint or FloorPaint())


def robot_camera(view: SceneView, rows: int, columns: int, fov_deg: float | None = None) -> tuple[CameraPose, Lens]:
    """Return the robot's camera, at the pose that its body has been placed at; `fov_deg` for another field of view."""
    mount = view.robot.camera
    body = mujoco.mj_name2id(view.model, mujoco.mjtObj.mjOBJ_BODY, mount.body)
    axes = view.data.xmat[body].reshape(3, 3)
    forward = axes @ [math.cos(mount.pitch_rad), 0.0, -math.sin(mount.pitch_rad)]
    pos = view.data.xpos[body] + axes @ np.asarray(mount.pos_m)
    return look_along(pos, forward), Lens(columns, rows, fov_deg or mount.fov_deg)


def chase_camera(robot_pos_w: np.ndarray, yaw_rad: float, rows: int, columns: int) -> tuple[CameraPose, Lens]:
    """Return a camera behind and above the robot, 40 degrees down."""
    pitch = math.radians(40)
    ahead = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    forward = math.cos(pitch) * ahead - np.array([0.0, 0.0, math.sin(pitch)])
    target = np.array([robot_pos_w[0], robot_pos_w[1], 0.15]) + 0.45 * ahead
    return look_along(target - 3.6 * forward, forward), Lens(columns, rows, 48.0)


def behind(model: SceneModel) -> CameraPose:
    """Return a camera behind the robot, in front of what would hide it."""
    robot, (back_m, up_m), middle_m = model.robot, BEHIND_M["follow"], 0.6 * model.robot.height_m
    base = model.data.body(robot.base_body)
    yaw, target = yaw_from_quat(base.xquat), base.xpos + [0, 0, middle_m - robot.spawn_height_m]
    back = np.array([-back_m * np.cos(yaw), -back_m * np.sin(yaw), up_m - middle_m])
    back *= clear_way(model, target, back)
    return look_along(target + back, -back)


class ThirdPerson:
    """The camera behind the robot, for a running environment."""

    def __init__(self, env: Any, rows: int = 360, columns: int = 480):
        """Prepare nothing before it is needed; `env` is an `InteractiveNav`."""
        self._env, self._lens = env, Lens(columns, rows, 60.0)
        small, classes = env.world.small_objects, env.config.segmentation_classes
        self._view = functools.cache(lambda scene: SceneView(env.robot, env.scenes[scene], small, classes))

    def frames(self, state: Any) -> tuple[np.ndarray, ...]:
        """Draw [rows, columns, 3] u8 of each environment of a batch, or of one that is alone."""
        nav, qpos = state.info["nav"], np.asarray(state.pipeline_state.qpos)
        which = np.asarray(nav.scene_index).reshape(-1), np.asarray(nav.goal_xy_w).reshape(-1, 2)
        each = zip(which[0], qpos.reshape(-1, qpos.shape[-1]), which[1], strict=True)
        return tuple(self._frame(int(scene), *row) for scene, *row in each)

    def _frame(self, scene: int, qpos: np.ndarray, goal_xy_w: np.ndarray) -> np.ndarray:
        view = self._view(scene)
        view.pose(self._env.world, scene, qpos)
        paint = FloorPaint(goal_xy_w, self._env.success_distance_m)
        return view.textured(behind(view), self._lens, (*SCENE, ROBOT), paint)


def depth_picture(depth_m: np.ndarray, far_m: float = 5.0) -> np.ndarray:
    """Convert [rows, columns] depth to [rows, columns, 3] u8: near bright, far and nothing (0) black."""
    near = np.where(depth_m > 0, 1.0 - np.clip(depth_m / far_m, 0.0, 1.0), 0.0)
    return np.repeat((255 * near**2).astype(np.uint8)[..., None], 3, -1)


def mask_picture(mask: np.ndarray, depth_m: np.ndarray, classes: MaskClasses = 4) -> np.ndarray:
    """Convert [rows, columns] ids to [rows, columns, 3] u8 in the classes' colours; nothing, of depth 0, is black."""
    return (np.array(SEGMENTATIONS[classes].colours) * 255).astype(np.uint8)[mask] * (depth_m > 0)[..., None]


def _varied(colour: np.ndarray, index: int) -> np.ndarray:
    hue, light, saturation = colorsys.rgb_to_hls(*colour)
    light = np.clip(light + 0.05 * ((index * 5) % 7 - 3) / 3, 0, 1)
    return np.array(colorsys.hls_to_rgb(hue, light, saturation))


def _painted(
    drawn: np.ndarray, depth_m: np.ndarray, pose: CameraPose, lens: Lens, paint: FloorPaint, check: float = 1.0
) -> np.ndarray:
    """Return [H, W, 3] u8 with the floor painted, every second square of which is `check` as bright."""
    points = pose.pos_w + lens.rays(pose) * depth_m[..., None]
    floor = (np.abs(points[..., 2]) < ON_FLOOR_M) & (depth_m > 0)
    out, colour, xy_w = drawn / 255, drawn[floor] / 255, points[floor, :2]
    colour[np.floor(xy_w / 0.5).sum(-1) % 2 == 0] *= check
    if paint.goal_xy_w is not None:
        away = np.linalg.norm(xy_w - paint.goal_xy_w, axis=1)
        colour[away < paint.goal_radius_m] = np.array(GOAL_COLOUR)
        colour[away < 0.75 * paint.goal_radius_m] = 0.55 * np.array(GOAL_COLOUR) + 0.45
    if paint.trail_xy_w is not None and len(paint.trail_xy_w):
        near, _ = cKDTree(paint.trail_xy_w).query(xy_w, distance_upper_bound=0.04)
        colour[np.isfinite(near)] = TRAIL_COLOUR
    out[floor] = colour
    return (out * 255 + 0.5).astype(np.uint8)
