"""Pictures for people: a scene and body poses in, shaded colour, depth and class images out, without OpenGL.

Everything is cast with MuJoCo's rays from the scene's visual meshes, so pictures are the same on a laptop, a
cluster node without a display and in the tests. Walls are cut low where one looks in from outside.
Policies see `interactive_nav.rendering` (or nothing but numbers); nothing here is on their path.
"""

from __future__ import annotations

import colorsys
import dataclasses
import functools
import math
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from interactive_nav.pictures.replay import world_poses
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import SmallObject
from interactive_nav.scenes.scene import Scene
from interactive_nav.task.env import InteractiveNav
from interactive_nav_common.rotations import matrix_from_quat, yaw_from_quat
from scenes_mjcf.categories import SEGMENTATIONS, TABLE, MaskClasses, class_id

COLOURS = {category.name: category.colour for category in TABLE}
"""RGB in [0, 1] by category, in colour and mask pictures alike."""
GOAL_COLOUR = (0.30, 0.72, 0.36)
TRAIL_COLOUR = (0.16, 0.47, 0.84)
FLOOR_COLOUR = (0.80, 0.78, 0.74)
SKY_COLOUR = (0.93, 0.95, 0.97)
CUT_M = 0.55
"""Height of the walls in views from outside."""
NOTHING = 255
"""Class of a ray that meets nothing."""

_FLOOR, _THINGS, _BUILDING, _CUT_WALLS, _ROBOT, _HIDDEN = range(6)
OUTSIDE = (_FLOOR, _THINGS, _CUT_WALLS, _ROBOT)
"""What a view from outside shows: walls cut low."""
INSIDE = (_FLOOR, _THINGS, _BUILDING)
"""What the robot sees: full walls, not itself."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera without roll."""

    pos_w: np.ndarray
    """(3,) m."""
    forward_w: np.ndarray
    """(3,) unit vector."""
    fov_rad: float
    """Vertical field of view."""
    rows: int
    columns: int

    def rays(self) -> np.ndarray:
        """[rows * columns, 3] directions; their component along `forward_w` is 1."""
        right = np.cross(self.forward_w, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, self.forward_w)
        reach = math.tan(self.fov_rad / 2)
        y = reach * (1 - (2 * np.arange(self.rows) + 1) / self.rows)
        x = reach * ((2 * np.arange(self.columns) + 1) / self.columns - 1) * self.columns / self.rows
        return (self.forward_w + y[:, None, None] * up + x[None, :, None] * right).reshape(-1, 3)


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


class SceneView:
    """One scene with a robot and small objects, whose bodies are put where a caller wants them."""

    def __init__(self, robot: RobotSpec, scene: Scene, small: Sequence[SmallObject], classes: MaskClasses = 4):
        """Compiles the model to look at.

        Args:
            robot: its collision shapes are drawn, or its visual ones where it has any.
            scene: its visual meshes are drawn.
            small: the small objects.
            classes: the setting `segmentation_classes`.
        """
        self.robot = robot
        self.model = _compile(robot, scene, small)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self._class, kinds = _geom_classes(self.model, robot, scene, small, classes)
        self._colour = np.array([COLOURS[kind] for kind in kinds])
        # Things of one kind differ a little, so that two chairs can be told apart.
        for g in range(self.model.ngeom):
            body = int(self.model.geom_bodyid[g])
            if self.model.geom_group[g] == _THINGS:
                self._colour[g] = _varied(self._colour[g], body)

    def place(self, bodies: tuple[str, ...], pos_w: np.ndarray, quat_w: np.ndarray) -> None:
        """Puts bodies where they are to be drawn; those that are not named stay at rest.

        Args:
            bodies: B names.
            pos_w: [B, 3] m.
            quat_w: [B, 4] w x y z.

        Raises:
            ValueError: the scene has no body of a name.
        """
        model, data = self.model, self.data
        rotation = np.zeros(9)
        for name, pos, quat in zip(bodies, pos_w, quat_w, strict=True):
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            if body < 0:
                raise ValueError(f"no body '{name}' in this scene with robot '{self.robot.name}'; record it again")
            quat = np.asarray(quat, float)
            mujoco.mju_quat2Mat(rotation, quat)
            data.xpos[body], data.xquat[body], data.xmat[body] = pos, quat, rotation
            axes = rotation.reshape(3, 3)
            data.xipos[body] = pos + axes @ model.body_ipos[body]
            data.ximat[body] = (axes @ matrix_from_quat(model.body_iquat[body])).ravel()
            for g in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
                data.geom_xpos[g] = pos + axes @ model.geom_pos[g]
                data.geom_xmat[g] = (axes @ matrix_from_quat(model.geom_quat[g])).ravel()

    def look(self, camera: Camera, groups: tuple[int, ...] = OUTSIDE, paint: FloorPaint | None = None) -> Image:
        """Renders.

        Args:
            camera: where from.
            groups: `OUTSIDE` or `INSIDE`.
            paint: drawn on the floor.
        """
        shown = np.isin(np.arange(6), groups).astype(np.uint8)
        rays = camera.rays()
        length = np.linalg.norm(rays, axis=1)
        geom, distance, normal = self._cast(camera.pos_w, rays / length[:, None], shown)
        hit = geom >= 0
        points = camera.pos_w + rays * (distance / length)[:, None]
        colour = np.tile(np.array(SKY_COLOUR), (len(rays), 1))
        colour[hit] = self._colour[geom[hit]]
        floor = hit & (self.model.geom_group[geom] == _FLOOR)
        colour[floor] = _floor_colour(points[floor, :2], paint or FloorPaint())
        if _CUT_WALLS in groups:
            colour[hit] *= self._light(points[hit], normal[hit], shown)[:, None]
        else:  # indoors, a lamp beside the camera
            colour[hit] *= 0.5 + 0.5 * np.abs((normal[hit] * rays[hit]).sum(1, keepdims=True) / length[hit, None])
        classes = np.where(hit, self._class[geom], NOTHING).astype(np.uint8)
        shape = (camera.rows, camera.columns)
        return Image(
            colour=(np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8).reshape(*shape, 3),
            depth_m=np.where(hit, distance / length, np.inf).astype(np.float32).reshape(shape),
            classes=classes.reshape(shape),
        )

    def _cast(self, origin: np.ndarray, unit: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, ...]:
        count = len(unit)
        geom, distance, normal = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
        mujoco.mj_multiRay(
            self.model,
            self.data,
            np.asarray(origin, float),
            np.ascontiguousarray(unit).ravel(),
            shown,
            1,
            -1,
            geom,
            distance,
            normal,
            count,
            mujoco.mjMAXVAL,
        )
        return geom, distance, normal.reshape(-1, 3)

    def _light(self, points: np.ndarray, normal: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """[n] brightness: light of the sky, and a lamp high above the middle of the view that casts shadows."""
        lamp = points[:, :2].mean(0) if len(points) else np.zeros(2)
        lamp = np.array([lamp[0] - 2.0, lamp[1] - 3.0, 9.0])
        ray = points - lamp
        far = np.linalg.norm(ray, axis=1)
        unit = ray / far[:, None]
        _, distance, _ = self._cast(lamp, unit, shown)
        lit = (distance < 0) | (distance > far - 0.02)
        facing = np.clip(-(normal * unit).sum(1), 0, 1)
        sky = 0.58 + 0.10 * normal[:, 2]
        return sky + 0.38 * facing * np.where(lit, 1.0, 0.15)


def robot_camera(view: SceneView, rows: int, columns: int) -> Camera:
    """The robot's own camera, at the pose that its body has been placed at."""
    mount = view.robot.camera
    body = mujoco.mj_name2id(view.model, mujoco.mjtObj.mjOBJ_BODY, mount.body)
    axes = view.data.xmat[body].reshape(3, 3)
    forward = axes @ [math.cos(mount.pitch_rad), 0.0, -math.sin(mount.pitch_rad)]
    pos = view.data.xpos[body] + axes @ np.asarray(mount.pos_m)
    return Camera(pos, forward, math.radians(mount.fov_deg), rows, columns)


def chase_camera(robot_pos_w: np.ndarray, yaw_rad: float, rows: int, columns: int, distance_m: float = 3.6) -> Camera:
    """A camera behind and above the robot, 40 degrees down."""
    pitch = math.radians(40)
    ahead = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    forward = math.cos(pitch) * ahead - np.array([0.0, 0.0, math.sin(pitch)])
    target = np.array([robot_pos_w[0], robot_pos_w[1], 0.15]) + 0.45 * ahead
    return Camera(target - distance_m * forward, forward, math.radians(48), rows, columns)


class ThirdPerson:
    """The camera behind the robot, for a running environment."""

    def __init__(self, env: InteractiveNav, rows: int = 360, columns: int = 480):
        self.env, self.rows, self.columns = env, rows, columns
        config, small = env.config, env.world.small_objects
        self._view = functools.cache(
            lambda scene: SceneView(env.robot, env.scenes[scene], small, config.segmentation_classes)
        )

    def frame(self, scene: int, qpos: np.ndarray, goal_xy_w: np.ndarray) -> np.ndarray:
        """[rows, columns, 3] u8.

        Args:
            scene: index of the scene.
            qpos: [nq] of the environment's physics.
            goal_xy_w: (2,) m.
        """
        view = self._view(scene)
        names, _, pos, quat = world_poses(self.env, scene, np.asarray(qpos)[None])
        view.place(names, pos[0], quat[0])
        camera = chase_camera(pos[0, 0], yaw_from_quat(quat[0, 0]), self.rows, self.columns)
        paint = FloorPaint(np.asarray(goal_xy_w), self.env.success_distance_m)
        return view.look(camera, OUTSIDE, paint).colour


def depth_picture(depth_m: np.ndarray, far_m: float = 5.0) -> np.ndarray:
    """[rows, columns] depth to [rows, columns, 3] u8: near bright, far and nothing black."""
    near = 1.0 - np.clip(np.nan_to_num(depth_m, posinf=far_m) / far_m, 0.0, 1.0)
    return np.repeat((255 * near**2).astype(np.uint8)[..., None], 3, -1)


def mask_picture(mask: np.ndarray, classes: MaskClasses = 4) -> np.ndarray:
    """[rows, columns] ids to [rows, columns, 3] u8 in the classes' colours; nothing is black."""
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


def _compile(robot: RobotSpec, scene: Scene, small: Sequence[SmallObject]) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(scene.path / "scene.xml"))
    movable = {m.name for m in scene.movables}
    seen = {geom.parent.name for geom in spec.geoms if geom.group <= 2}
    for geom in list(spec.geoms):
        owner = geom.parent.name
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.group = _FLOOR
        elif owner in movable:
            # Boxes stand in for what has no visual mesh.
            drawn = geom.group <= 2 if owner in seen else geom.type == mujoco.mjtGeom.mjGEOM_BOX
            geom.group = _THINGS if drawn else _HIDDEN
        else:
            geom.group = _BUILDING if geom.group <= 2 or owner not in seen else _HIDDEN
    walls = spec.worldbody.add_body(name="cut_walls")
    for i, row in enumerate(scene.walls):
        top = min(row[2] + row[9], CUT_M)
        walls.add_geom(
            name=f"cut_wall_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[row[0], row[1], top / 2],
            quat=row[3:7],
            size=[row[7], row[8], max(top / 2, 1e-3)],
            group=_CUT_WALLS,
        )
    before = {g.name for g in spec.geoms}
    robot.add_to(spec)
    own = [g for g in spec.geoms if g.name not in before]
    visual = [g for g in own if g.group <= 2]
    for geom in own:
        geom.group = _ROBOT if geom in visual or not visual else _HIDDEN
    for i, obj in enumerate(small):
        body = spec.worldbody.add_body(name=f"{obj.category}_small_{i}", pos=[0, 0, -50.0])
        for box in obj.boxes:
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=box.centre_m,
                quat=box.quat,
                size=box.half_m,
                group=_THINGS,
                contype=0,
                mass=1.0,
            )
    return spec.compile()


def _geom_classes(
    model: mujoco.MjModel, robot: RobotSpec, scene: Scene, small: Sequence[SmallObject], classes: MaskClasses
) -> tuple[np.ndarray, list[str]]:
    """[ngeom] segmentation ids, and each geom's category."""
    known = {m.name: (class_id(m.category, classes), m.category) for m in scene.movables}
    known |= {f"{o.category}_small_{i}": (o.mask_id(classes), o.category) for i, o in enumerate(small)}
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, robot.base_body)
    robot_row, structure = ((class_id(kind, classes), kind) for kind in ("robot", "structure"))
    rows = []
    for body in model.geom_bodyid:
        own = model.body_rootid[body] == base
        rows.append(robot_row if own else known.get(model.body(int(body)).name, structure))
    return np.array([number for number, _ in rows], np.uint8), [kind for _, kind in rows]
