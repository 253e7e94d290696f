"""Build MuJoCo models for pictures of a scene with a robot and small objects.

All pictures and viewers start from `furnished_spec`. `SceneModel` poses bodies freely and casts rays.
"""

import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import VISUAL_GROUP, SmallObject, add_boxes, body_names
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.slots import bodies_by_name
from interactive_nav.scenes.world import World, world_poses
from interactive_nav.sensing.boxes import FLOOR_COLOUR, PALETTES
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.categories import MaskClasses, class_id
from scenes_mjcf.look import cast, geom_colour, glaze, spec_for_people

THINGS, BUILDING, CUT_WALLS, ROBOT, ROBOT_SOLIDS, HIDDEN = range(6)
"""Geom groups: the floor and what stands on it; walls at full height; walls cut low; the robot; the collision shapes
of a robot that has others to show; what is never drawn."""
SCENE = (THINGS, BUILDING)
"""Groups that show from inside, without the robot."""
CUT_M = 0.55
"""Height of the walls in views from outside."""


def furnished_spec(
    scene: Scene,
    robot: RobotSpec | None,
    small: Sequence[SmallObject],
    cut_walls: bool = False,
    for_people: bool = True,
) -> mujoco.MjSpec:
    """Return the scene of `scene.xml` with a robot and small objects, which are boxes at the origin.

    With `cut_walls`, a copy of the walls is cut low. With `for_people`, glass is transparent and the structure looks as
    in `scenes_mjcf.look.spec_for_people`, not as in observations.
    """
    spec = spec_for_people(scene.path) if for_people else mujoco.MjSpec.from_file(str(scene.path / "scene.xml"))
    if for_people:
        glaze(spec, scene.path)
    if cut_walls:
        _add_cut_walls(spec, scene.walls)
    if robot is not None:
        robot.add_to(spec)
    for name, obj in zip(body_names(small), small, strict=True):
        body = spec.worldbody.add_body(name=name)
        body.add_freejoint(name=f"{name}_joint")
        add_boxes(body, obj, name)
    return spec


def picture_spec(
    scene: Scene,
    robot: RobotSpec | None = None,
    small: Sequence[SmallObject] = (),
    classes: MaskClasses | None = None,
    for_people: bool = False,
) -> mujoco.MjSpec:
    """Return `furnished_spec` in the groups of pictures, with another lamp and a camera named `view`.

    Bodies without visual meshes show boxes, coloured by the setting `segmentation_classes`; None keeps their colours.
    """
    spec = furnished_spec(scene, robot, small, cut_walls=robot is not None, for_people=for_people)
    robot_bodies = {b.name for b in spec.body(robot.base_body).find_all("body")} | {robot.base_body} if robot else set()
    movable = bodies_by_name(scene, small)
    with_mesh = {g.parent.name for g in spec.geoms if g.group == VISUAL_GROUP}
    visible_robot = bool(robot_bodies & with_mesh)
    for geom in list(spec.geoms):
        name = geom.parent.name
        if name == "cut_walls":
            continue
        plane, box = geom.type == mujoco.mjtGeom.mjGEOM_PLANE, geom.type == mujoco.mjtGeom.mjGEOM_BOX
        if name in robot_bodies:
            geom.group = ROBOT_SOLIDS if visible_robot and geom.group != VISUAL_GROUP else ROBOT
            continue
        bare = box and name not in with_mesh
        if plane:
            geom.rgba = [*FLOOR_COLOUR, 1.0]
        elif bare and classes is not None:
            geom.rgba = [*PALETTES[classes][movable[name].mask_id(classes) if name in movable else 0], 1.0]
        if not (plane or bare or geom.group == VISUAL_GROUP):
            geom.group = HIDDEN
        else:
            geom.group = THINGS if plane or name in movable else BUILDING
    for camera in list(spec.cameras):  # MJX-Warp draws every camera that there is
        spec.delete(camera)
    spec.worldbody.add_camera(name="view", fovy=60.0)
    spec.worldbody.add_light(pos=[0, 0, 6], dir=[0.3, 0.2, -1], diffuse=[0.5] * 3, castshadow=False)
    # The clipping planes are given as shares of the extent.
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 100.0
    return spec


class SceneModel:
    """One scene with a robot and small objects, whose bodies are put where a caller wants them."""

    for_people = False
    """As `furnished_spec` has it."""

    def __init__(self, robot: RobotSpec, scene: Scene, small: Sequence[SmallObject], classes: MaskClasses = 4):
        """Compile the model to look at; the robot's collision shapes are drawn, or its visual ones if it has any."""
        self.robot = robot
        rows = {n: (body.mask_id(classes), body.category) for n, body in bodies_by_name(scene, small).items()}
        spec = picture_spec(scene, robot, small, classes, self.for_people)
        spec.visual.global_.offwidth = spec.visual.global_.offheight = 2048
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        for name in body_names(small):  # out of sight until they are placed
            self.data.qpos[self.model.joint(f"{name}_joint").qposadr[0] + 2] = -50.0
        detach(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mine, rest = ((class_id(kind, classes), kind) for kind in ("robot", "structure"))
        robots = np.isin(self.model.geom_group, (ROBOT, ROBOT_SOLIDS))
        names = [self.model.body(int(body)).name for body in self.model.geom_bodyid]
        of_geom = [mine if is_robot else rows.get(name, rest) for is_robot, name in zip(robots, names, strict=True)]
        self.class_id = np.array([number for number, _ in of_geom], np.uint8)
        """[ngeom] segmentation ids."""
        self.category = [category for _, category in of_geom]
        """[ngeom]"""

    @functools.cached_property
    def colour(self) -> np.ndarray:
        """Return [ngeom, 3] in [0, 1]: each geom's colour, or its texture's mean."""
        return np.array([geom_colour(self.model, g) for g in range(self.model.ngeom)], np.float32)

    def pose(self, world: World, scene: int, qpos: np.ndarray) -> None:
        """Put all bodies where an environment's `qpos` [nq] has them; `scene` is the index of this model's scene."""
        names, _, pos, quat = world_poses(world, scene, np.asarray(qpos)[None])
        self.place(names, pos[0], quat[0])

    def place(self, bodies: tuple[str, ...], pos_w: np.ndarray, quat_w: np.ndarray) -> None:
        """Put B named bodies at [B, 3] m with orientations [B, 4] w x y z; the others stay at rest."""
        ids = [mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name) for name in bodies]
        if -1 in ids:
            name = bodies[ids.index(-1)]
            raise ConfigError(f"no body '{name}' in this scene with robot '{self.robot.name}'; record it again")
        self.model.body_pos[ids], self.model.body_quat[ids] = pos_w, quat_w
        mujoco.mj_kinematics(self.model, self.data)


def detach(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Hang each body from the world where it is, without joints: its `body_pos` and `body_quat` then place it."""
    mujoco.mj_kinematics(model, data)
    model.body_pos[:], model.body_quat[:] = data.xpos, data.xquat
    model.body_parentid[:], model.body_jntnum[:], model.dof_armature[:] = 0, 0, 1  # `mj_forward` still inverts dofs


def clear_way(model: SceneModel, target_w: np.ndarray, back_w: np.ndarray) -> float:
    """Return the share of the way from a target (3,) along (3,), both m, at which a camera clears what is behind."""
    reach = np.linalg.norm(back_w)
    hit = cast(model.model, model.data, target_w, back_w[None] / reach, SCENE)[1][0] / reach
    return min(1.0, 0.9 * hit) if hit > 0 else 1.0


def _add_cut_walls(spec: mujoco.MjSpec, walls: np.ndarray) -> None:
    body = spec.worldbody.add_body(name="cut_walls")
    for i, row in enumerate(walls):
        half_m = min(row[2] + row[9], CUT_M) / 2
        place = {"pos": [row[0], row[1], half_m], "quat": row[3:7], "size": [row[7], row[8], max(half_m, 1e-3)]}
        body.add_geom(name=f"cut_wall_{i}", type=mujoco.mjtGeom.mjGEOM_BOX, group=CUT_WALLS, **place)
