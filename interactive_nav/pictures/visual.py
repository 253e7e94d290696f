"""A scene as people see it: a world in, a MuJoCo model with visual meshes, robot and small objects out."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from interactive_nav.pictures.shading import FLOOR_COLOUR, PALETTES
from interactive_nav.scenes.objects import SmallObject
from interactive_nav.scenes.world import World
from scenes_mjcf.categories import CATEGORIES, MaskClasses, class_id

VISUAL_GROUP, ROBOT_GROUP = 2, 5
"""Geom groups: what is always drawn, and the robot, which is not in its own view."""


@dataclasses.dataclass(frozen=True)
class VisualModel:
    """One scene's model for pictures, and how the environment's state goes into it."""

    model: mujoco.MjModel
    targets: np.ndarray
    """[k] addresses in this model's qpos..."""
    sources: np.ndarray
    """[k] ...of these numbers of the environment's qpos."""
    class_id: np.ndarray
    """[ngeom] u8 segmentation ids."""
    colour: np.ndarray
    """[ngeom, 3] f32 in [0, 1]: of the geom, or its texture's mean."""

    def pose(self, qpos: np.ndarray) -> mujoco.MjData:
        """Data with the bodies where the environment's `qpos` [nq] has them."""
        data = mujoco.MjData(self.model)
        data.qpos[self.targets] = np.asarray(qpos)[self.sources]
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_camlight(self.model, data)
        return data


def build_visual(world: World, scene: int, classes: MaskClasses = 4) -> VisualModel:
    """Compiles a scene's own `scene.xml` with the robot and the small objects added.

    Args:
        world: of the environment.
        scene: index of the scene.
        classes: the setting `segmentation_classes`.
    """
    ids_of = {m.name: class_id(m.category, classes) for m in world.scenes[scene].movables}
    ids_of |= {f"{o.category}_small_{i}": o.mask_id(classes) for i, o in enumerate(world.small_objects)}
    spec = mujoco.MjSpec.from_file(str(world.scenes[scene].path / "scene.xml"))
    _show_furniture(spec, ids_of, PALETTES[classes])
    before = {b.name for b in spec.bodies}
    world.robot.add_to(spec)
    for body in spec.bodies:
        if body.name not in before:
            for geom in body.geoms:
                geom.group, geom.rgba = ROBOT_GROUP, [*CATEGORIES["robot"].colour, 1.0]
    for i, obj in enumerate(world.small_objects):
        _add_small(spec, f"{obj.category}_small_{i}", obj, PALETTES[classes][obj.mask_id(classes)])
    spec.worldbody.add_light(pos=[0, 0, 6], dir=[0.3, 0.2, -1], diffuse=[0.5] * 3, castshadow=False)
    for camera in list(spec.cameras):  # MJX-Warp draws every camera that there is
        spec.delete(camera)
    spec.worldbody.add_camera(name="view", fovy=60.0)
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 2048
    # The clipping planes are given as shares of the extent.
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 100.0
    model = spec.compile()
    layout = world.layout
    targets, sources = [], []

    def link(target: int, source: int, size: int) -> None:
        targets.append(np.arange(target, target + size))
        sources.append(np.arange(source, source + size))

    link(model.joint(world.robot.base_joint).qposadr[0], layout.robot_qpos, layout.robot_nq)
    for slot, name in enumerate(world.names[scene]):
        if name:
            at = model.jnt_qposadr[model.body(name).jntadr[0]]
            link(at, layout.slot_qpos[slot], 1 if layout.slot_kind[slot] == "hinge" else 7)
    ids, colour = np.zeros(model.ngeom, np.uint8), np.zeros((model.ngeom, 3), np.float32)
    for g in range(model.ngeom):
        name = model.body(model.geom_bodyid[g]).name
        ids[g] = class_id("robot") if model.geom_group[g] == ROBOT_GROUP else ids_of.get(name, 0)
        colour[g] = _colour(model, g)
    return VisualModel(model, np.concatenate(targets), np.concatenate(sources), ids, colour)


def _show_furniture(spec: mujoco.MjSpec, ids_of: dict[str, int], palette: np.ndarray) -> None:
    """Puts what is drawn of a scene into the visual group and all else out of sight."""
    with_mesh = {g.parent.name for g in spec.geoms if g.group == VISUAL_GROUP}
    for geom in list(spec.geoms):
        # Hulls and boxes are for collision; a body without a visual mesh is drawn as its boxes.
        shown = geom.group == VISUAL_GROUP or geom.type == mujoco.mjtGeom.mjGEOM_PLANE
        bare = geom.parent.name not in with_mesh
        geom.group = VISUAL_GROUP if shown or (bare and geom.type == mujoco.mjtGeom.mjGEOM_BOX) else 4
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.rgba = [*FLOOR_COLOUR, 1.0]
        elif bare and geom.group == VISUAL_GROUP:
            geom.rgba = [*palette[ids_of.get(geom.parent.name, 0)], 1.0]


def _add_small(spec: mujoco.MjSpec, name: str, obj: SmallObject, colour: np.ndarray) -> None:
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=f"{name}_joint")
    for box in obj.boxes:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.centre_m,
            quat=box.quat,
            size=box.half_m,
            group=VISUAL_GROUP,
            rgba=[*colour, 1.0],
        )


def _colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    material = model.geom_matid[geom]
    texture = model.mat_texid[material][mujoco.mjtTextureRole.mjTEXROLE_RGB] if material >= 0 else -1
    if texture < 0:
        return (model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom])[:3]
    size = model.tex_height[texture] * model.tex_width[texture]
    first, channels = model.tex_adr[texture], model.tex_nchannel[texture]
    pixels = model.tex_data[first : first + size * channels].reshape(size, channels)[:, :3]
    # Atlases are padded with black.
    used = pixels.max(1) > 8
    return pixels[used].mean(0) / 255.0 if used.any() else np.full(3, 0.5)
