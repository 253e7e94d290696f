"""Draw pictures of a scene for people from body poses: shaded colour, depth and class images, without OpenGL.

Everything is cast with MuJoCo's rays from the scene's visual meshes, so pictures are the same on a laptop, a
cluster node without a display and in the tests. Walls are cut low where one looks in from outside.
Policies see `interactive_nav.sensing` (or nothing but numbers); nothing here is on their path.
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

from interactive_nav.pictures.camera import BEHIND_M, Painter, clear_way
from interactive_nav.pictures.scene_model import CUT_WALLS, ROBOT, SCENE, THINGS, SceneModel, cast, trace
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import SmallObject
from interactive_nav.scenes.scene import Scene
from interactive_nav.sensing.base import CameraPose, Lens, look_along
from interactive_nav.sensing.shading import SKY_COLOUR
from interactive_nav.task.env import InteractiveNav
from interactive_nav_common.rotations import yaw_from_quat
from scenes_mjcf.categories import SEGMENTATIONS, TABLE, MaskClasses

COLOURS = {category.name: category.colour for category in TABLE}
"""RGB in [0, 1] by category, in colour and mask pictures alike."""
GOAL_COLOUR = (0.30, 0.72, 0.36)
TRAIL_COLOUR = (0.16, 0.47, 0.84)
FLOOR_COLOUR = (0.80, 0.78, 0.74)
ON_FLOOR_M = 0.03
"""What is no higher, such as a carpet, is painted on."""
NOTHING = 255
"""Class of a ray that meets nothing."""

OUTSIDE = (THINGS, CUT_WALLS, ROBOT)
"""What a view from outside shows: walls cut low."""
INSIDE = SCENE
"""What the robot sees: full walls, not itself."""


@dataclasses.dataclass(frozen=True)
class Image:
    """What a camera saw."""

    colour: np.ndarray
    """[rows, columns, 3] u8."""
    depth_m: np.ndarray
    """[rows, columns] f32 along the optical axis; infinite where there is nothing."""
    classes: np.ndarray
    """[rows, columns] u8 segmentation ids, as the observation's; or `NOTHING`."""


@dataclasses.dataclass(frozen=True)
class FloorPaint:
    """What is drawn on the floor of views from outside."""

    goal_xy_w: np.ndarray | None = None
    """(2,) m."""
    goal_radius_m: float = 0.33
    trail_xy_w: np.ndarray | None = None
    """[n, 2] path so far, m."""


class SceneView(SceneModel):
    """One scene with a robot and small objects, whose bodies are put where a caller wants them, to be looked at."""

    def __init__(self, robot: RobotSpec, scene: Scene, small: Sequence[SmallObject], classes: MaskClasses = 4):
        """Compile the model to look at; see `SceneModel`."""
        super().__init__(robot, scene, small, classes)
        self._painter = Painter()
        self._floor = self.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._colour = np.array([COLOURS[category] for category in self.category])
        # Objects of one kind differ a little, so that two chairs can be distinguished.
        for g in np.flatnonzero((self.model.geom_group == THINGS) & ~self._floor):
            self._colour[g] = _varied(self._colour[g], int(self.model.geom_bodyid[g]))

    def render(
        self, pose: CameraPose, lens: Lens, groups: tuple[int, ...] = OUTSIDE, paint: FloorPaint | None = None
    ) -> Image:
        """Render an image.

        Args:
            pose: of the camera.
            lens: its.
            groups: `OUTSIDE` or `INSIDE`.
            paint: drawn on the floor.
        """
        ray, geom, depth_m, normal = trace(self.model, self.data, pose, lens, groups)
        hit = geom >= 0
        points = pose.pos_w + ray * depth_m[..., None]
        colour = np.full(ray.shape, SKY_COLOUR)
        colour[hit] = self._colour[geom[hit]]
        floor = hit & self._floor[geom]
        colour[floor] = _floor_colour(points[floor, :2], paint or FloorPaint())
        if CUT_WALLS in groups:
            colour[hit] *= self._light(points[hit], normal[hit], groups)[:, None]
        else:  # indoors, a lamp beside the camera
            along = (normal * ray).sum(-1, keepdims=True) / np.linalg.norm(ray, axis=-1, keepdims=True)
            colour[hit] *= 0.5 + 0.5 * np.abs(along[hit])
        return Image(
            colour=(np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8),
            depth_m=np.where(hit, depth_m, np.inf).astype(np.float32),
            classes=np.where(hit, self.class_id[geom], NOTHING).astype(np.uint8),
        )

    def textured(
        self, pose: CameraPose, lens: Lens, groups: Sequence[int], paint: FloorPaint | None = None
    ) -> np.ndarray:
        """Render [rows, columns, 3] u8 with textures, or as `render` colours it where no engine draws them."""
        drawn = self._painter.draw(self, pose, lens, groups)
        if drawn is None:
            return self.render(pose, lens, tuple(groups), paint).colour
        depth_m = self._painter.depth(self, pose, lens, groups)
        points, colour = pose.pos_w + lens.rays(pose) * depth_m[..., None], drawn / 255
        floor = np.abs(points[..., 2]) < ON_FLOOR_M
        colour[floor] = _painted(colour[floor], points[floor, :2], paint or FloorPaint())
        return (colour * 255 + 0.5).astype(np.uint8)

    def _light(self, points: np.ndarray, normal: np.ndarray, groups: tuple[int, ...]) -> np.ndarray:
        """Return [n] brightness: light of the sky, and a lamp high above the middle of the view that casts shadows."""
        lamp = points[:, :2].mean(0) if len(points) else np.zeros(2)
        lamp = np.array([lamp[0] - 2.0, lamp[1] - 3.0, 9.0])
        ray = points - lamp
        far = np.linalg.norm(ray, axis=1)
        unit = ray / far[:, None]
        _, distance, _ = cast(self.model, self.data, lamp, unit, groups)
        lit = (distance < 0) | (distance > far - 0.02)
        facing = np.clip(-(normal * unit).sum(1), 0, 1)
        sky = 0.58 + 0.10 * normal[:, 2]
        return sky + 0.38 * facing * np.where(lit, 1.0, 0.15)


def robot_camera(view: SceneView, rows: int, columns: int, fov_deg: float | None = None) -> tuple[CameraPose, Lens]:
    """Return the robot's camera, at the pose that its body has been placed at; `fov_deg` for another field of view."""
    mount = view.robot.camera
    body = mujoco.mj_name2id(view.model, mujoco.mjtObj.mjOBJ_BODY, mount.body)
    axes = view.data.xmat[body].reshape(3, 3)
    forward = axes @ [math.cos(mount.pitch_rad), 0.0, -math.sin(mount.pitch_rad)]
    pos = view.data.xpos[body] + axes @ np.asarray(mount.pos_m)
    return look_along(pos, forward), Lens(columns, rows, fov_deg or mount.fov_deg)


def chase_camera(
    robot_pos_w: np.ndarray, yaw_rad: float, rows: int, columns: int, distance_m: float = 3.6
) -> tuple[CameraPose, Lens]:
    """Return a camera behind and above the robot, 40 degrees down."""
    pitch = math.radians(40)
    ahead = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    forward = math.cos(pitch) * ahead - np.array([0.0, 0.0, math.sin(pitch)])
    target = np.array([robot_pos_w[0], robot_pos_w[1], 0.15]) + 0.45 * ahead
    return look_along(target - distance_m * forward, forward), Lens(columns, rows, 48.0)


class ThirdPerson:
    """The camera behind the robot, for a running environment."""

    def __init__(self, env: InteractiveNav, rows: int = 360, columns: int = 480):
        self.env, self.rows, self.columns = env, rows, columns
        config, small = env.config, env.world.small_objects
        self._view = functools.cache(
            lambda scene: SceneView(env.robot, env.scenes[scene], small, config.sensors.segmentation_classes)
        )

    def frames(self, state: Any) -> tuple[np.ndarray, ...]:
        """Draw [rows, columns, 3] u8 of each environment of a batch, or of one that is alone."""
        nav, qpos = state.info["nav"], np.asarray(state.pipeline_state.qpos)
        which = np.asarray(nav.scene_index).reshape(-1), np.asarray(nav.goal_xy_w).reshape(-1, 2)
        each = zip(which[0], qpos.reshape(-1, qpos.shape[-1]), which[1], strict=True)
        return tuple(self._frame(int(scene), *row) for scene, *row in each)

    def _frame(self, scene: int, qpos: np.ndarray, goal_xy_w: np.ndarray) -> np.ndarray:
        view = self._view(scene)
        view.pose(self.env.world, scene, qpos)
        base, (back_m, up_m) = view.data.body(self.env.robot.base_body), BEHIND_M["follow"]
        yaw, middle_m = yaw_from_quat(base.xquat), 0.6 * self.env.robot.height_m
        target = np.array([*base.xpos[:2], base.xpos[2] - self.env.robot.spawn_height_m + middle_m])
        back = np.array([-back_m * np.cos(yaw), -back_m * np.sin(yaw), up_m - middle_m])
        back *= clear_way(view, target, back)
        camera = look_along(target + back, -back), Lens(self.columns, self.rows, 60.0)
        return view.textured(*camera, (*SCENE, ROBOT), FloorPaint(goal_xy_w, self.env.success_distance_m))


def depth_picture(depth_m: np.ndarray, far_m: float = 5.0) -> np.ndarray:
    """Convert [rows, columns] depth to [rows, columns, 3] u8: near bright, far and nothing black."""
    near = 1.0 - np.clip(np.nan_to_num(depth_m, posinf=far_m) / far_m, 0.0, 1.0)
    return np.repeat((255 * near**2).astype(np.uint8)[..., None], 3, -1)


def mask_picture(mask: np.ndarray, classes: MaskClasses = 4) -> np.ndarray:
    """Convert [rows, columns] ids to [rows, columns, 3] u8 in the classes' colours; nothing is black."""
    table, colours = np.zeros((256, 3), np.uint8), np.array(SEGMENTATIONS[classes].colours)
    table[: len(colours)] = colours * 255
    return table[mask]


def _varied(colour: np.ndarray, index: int) -> np.ndarray:
    hue, light, saturation = colorsys.rgb_to_hls(*colour)
    light = np.clip(light + 0.05 * ((index * 5) % 7 - 3) / 3, 0, 1)
    return np.array(colorsys.hls_to_rgb(hue, light, saturation))


def _floor_colour(xy_w: np.ndarray, paint: FloorPaint) -> np.ndarray:
    colour = np.tile(np.array(FLOOR_COLOUR), (len(xy_w), 1))
    checker = np.floor(xy_w / 0.5).sum(-1) % 2 == 0
    colour[checker] *= 0.96
    return _painted(colour, xy_w, paint)


def _painted(colour: np.ndarray, xy_w: np.ndarray, paint: FloorPaint) -> np.ndarray:
    if not len(xy_w):
        return colour
    if paint.goal_xy_w is not None:
        away = np.linalg.norm(xy_w - paint.goal_xy_w, axis=1)
        colour[away < paint.goal_radius_m] = np.array(GOAL_COLOUR)
        colour[away < 0.75 * paint.goal_radius_m] = 0.55 * np.array(GOAL_COLOUR) + 0.45
    if paint.trail_xy_w is not None and len(paint.trail_xy_w):
        near, _ = cKDTree(paint.trail_xy_w).query(xy_w, distance_upper_bound=0.04)
        colour[np.isfinite(near)] = TRAIL_COLOUR
    return colour
