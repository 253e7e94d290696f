"""Placed objects, physical properties, walls and visual meshes in; `MjSpec` and assets out.

Conventions of the written MJCF (classes, groups, names) are in `scenes_mjcf/README.md`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np

from converters.bodies.objects import PlacedObject
from converters.bodies.physical import Physical
from converters.geometry.boxes import Hull, OrientedBox, least_turned
from converters.records.visual import VisualMesh
from converters.write.texture import as_png, quantise

TIMESTEP_S = 0.005
DOOR_DAMPING = 2.0
"""N m s/rad: a pushed interior door stops after about a second."""
DOOR_FRICTION = 0.4
"""N m: no latch, only this dry friction: keeps a door where it was left, half a newton at the handle."""


@dataclasses.dataclass(frozen=True)
class SceneParts:
    """What a scene's model is made of."""

    name: str
    objects: tuple[PlacedObject, ...]
    physical: tuple[Physical, ...]
    walls: tuple[OrientedBox, ...]
    structure_visual: VisualMesh | None = None
    object_visuals: tuple[VisualMesh, ...] = ()
    """Body frame, one an object; empty: no visuals (the settling model)."""


def _add_defaults(spec: mujoco.MjSpec) -> None:
    for name, collides, group, rgba in (
        ("visual", 0, 2, None),
        ("hull", 1, 3, (0.3, 0.6, 0.9, 0.5)),
        ("box", 0, 4, (0.9, 0.6, 0.3, 0.5)),
        ("structure", 1, 3, (0.7, 0.7, 0.7, 0.5)),
    ):
        default = spec.add_default(name, spec.default)
        default.geom.contype = default.geom.conaffinity = collides
        default.geom.group = group
        default.geom.mass = 0.0
        if rgba is not None:
            default.geom.rgba = rgba


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation, float).reshape(9))
    return quaternion


def _tidy(values: np.ndarray) -> np.ndarray:
    """Rounded to a micrometre, without negative zeros: short files, equal bytes."""
    return np.round(np.asarray(values, float), 6) + 0.0


def _add_movable(
    spec: mujoco.MjSpec, placed: PlacedObject, physical: Physical, visual: VisualMesh | None, inline: bool
) -> None:
    body = spec.worldbody.add_body(
        name=placed.name, pos=_tidy(placed.position_w), quat=np.round(placed.quaternion_w, 9)
    )
    body.explicitinertial = True
    body.mass = round(physical.mass_kg, 4)
    body.ipos = _tidy(physical.com_b)
    # Rounded first: which axes a round thing has is a matter of the last digits.
    moments, axes = np.linalg.eigh(np.round(physical.inertia_b, 12))
    axes, moments = least_turned(axes, moments)
    body.inertia = np.round(moments, 8)
    body.iquat = np.round(_quaternion(axes), 9)
    if placed.hinge is None:
        body.add_freejoint(name=f"{placed.name}_free")
    else:
        body.add_joint(
            name=f"{placed.name}_hinge",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            pos=_tidy(placed.hinge.origin_b),
            axis=[0, 0, 1],
            range=np.round(placed.hinge.range_rad, 6),
            damping=np.array([DOOR_DAMPING, 0, 0]),
            frictionloss=DOOR_FRICTION,
            armature=0.01,
        )
    friction = [physical.friction, 0.005, 0.0001]
    if visual is not None:
        body.add_geom(
            spec.find_default("visual"),
            name=f"{placed.name}_visual",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"{placed.name}_visual",
            material=f"{placed.name}_material",
        )
        _add_textured_mesh(spec, f"{placed.name}_visual", placed.name)
    for i, (hull, box) in enumerate(zip(placed.hulls_b, placed.boxes_b, strict=True)):
        mesh = spec.add_mesh(name=f"{placed.name}_hull_{i}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        if inline:
            mesh.uservert = _tidy(hull.vertices).reshape(-1)
        else:
            mesh.file = f"{placed.name}_hull_{i}.obj"
        body.add_geom(
            spec.find_default("hull"),
            name=f"{placed.name}_hull_{i}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            friction=friction,
        )
        body.add_geom(
            spec.find_default("box"),
            name=f"{placed.name}_box_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=_tidy(box.half),
            pos=_tidy(box.centre),
            quat=np.round(_quaternion(box.rotation), 9),
            friction=friction,
        )


def _add_textured_mesh(spec: mujoco.MjSpec, mesh_name: str, stem: str) -> None:
    spec.add_mesh(name=mesh_name, file=f"{mesh_name}.obj", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    spec.add_texture(name=f"{stem}_texture", file=f"{stem}.png", type=mujoco.mjtTexture.mjTEXTURE_2D)
    material = spec.add_material(name=f"{stem}_material", specular=0.1, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"{stem}_texture"


def build_spec(parts: SceneParts, inline: bool) -> mujoco.MjSpec:
    """The scene as an `MjSpec`.

    Args:
        parts: of the scene.
        inline: True keeps hulls inside the spec and leaves visuals out (settling); False names files in
        `assets/`.
    """
    spec = _empty_spec(parts.name)
    _add_surroundings(spec, parts.walls, parts.structure_visual is not None and parts.structure_visual.exact)
    _add_structure(spec, parts)
    # Semantic classes, for tools that read the MJCF alone: text `class_<body>` holds the category.
    for body, category in (("structure", "structure"), *((o.name, o.category) for o in parts.objects)):
        spec.add_text(name=f"class_{body}", data=category)
    visuals = parts.object_visuals or (None,) * len(parts.objects)
    for placed, physical, visual in zip(parts.objects, parts.physical, visuals, strict=True):
        _add_movable(spec, placed, physical, visual, inline)
    return spec


def _empty_spec(name: str) -> mujoco.MjSpec:
    """Options and default classes of every scene."""
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    spec.meshdir = spec.texturedir = "assets"
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    _add_defaults(spec)
    return spec


def _add_surroundings(spec: mujoco.MjSpec, walls: tuple[OrientedBox, ...], lit: bool) -> None:
    """Floor, and a light above the middle of the walls: an even one where the structure is `lit` in its own image."""
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.1],
        friction=[1.0, 0.005, 0.0001],
        rgba=[0.6, 0.6, 0.6, 1.0],
    )
    middle = np.mean([b.centre for b in walls], axis=0) if walls else np.zeros(3)
    spec.worldbody.add_light(
        name="light",
        pos=[round(float(middle[0]), 3), round(float(middle[1]), 3), 4.0],
        dir=[0, 0, -1],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=False,
        diffuse=[0.2] * 3 if lit else [0.6] * 3,
        ambient=[0.6] * 3 if lit else [0.4] * 3,
    )
    if lit:
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.3] * 3, [0.1] * 3


def _add_structure(spec: mujoco.MjSpec, parts: SceneParts) -> None:
    """The cleaned scan as a picture, and the wall boxes."""
    structure = spec.worldbody.add_body(name="structure")
    if parts.structure_visual is not None:
        _add_textured_mesh(spec, "structure_visual", "structure")
        structure.add_geom(
            spec.find_default("visual"),
            name="structure_visual",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname="structure_visual",
            material="structure_material",
        )
    for i, wall in enumerate(parts.walls):
        structure.add_geom(
            spec.find_default("structure"),
            name=f"wall_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=_tidy(wall.half),
            pos=_tidy(wall.centre),
            quat=np.round(_quaternion(wall.rotation), 9),
            friction=[0.6, 0.005, 0.0001],
        )


def write_obj(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | None = None,
    uv_faces: np.ndarray | None = None,
    decimals: int = 4,
) -> None:
    """Writes a triangle mesh as OBJ, 0.1 mm by default."""
    lines = [f"v {x:.{decimals}f} {y:.{decimals}f} {z:.{decimals}f}" for x, y, z in vertices + 0.0]
    if uv is None or uv_faces is None:
        lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    else:
        lines += [f"vt {u:.4f} {v:.4f}" for u, v in uv]
        lines += [f"f {a}/{i} {b}/{j} {c}/{k}" for (a, b, c), (i, j, k) in zip(faces + 1, uv_faces + 1, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_scene(parts: SceneParts, folder: Path, palette: int = 96) -> None:
    """Writes `scene.xml` and `assets/` into an existing folder.

    Args:
        parts: with visuals.
        folder: of the scene.
        palette: colours of a texture.
    """
    assets = folder / "assets"
    assets.mkdir()
    meshes = [(f"{o.name}_visual", o.name, v) for o, v in zip(parts.objects, parts.object_visuals, strict=True)]
    if parts.structure_visual is not None:
        meshes.append(("structure_visual", "structure", parts.structure_visual))
    for mesh_name, stem, visual in meshes:
        write_obj(
            assets / f"{mesh_name}.obj",
            visual.vertices,
            visual.faces,
            visual.uv,
            visual.uv_faces,
            decimals=3 if stem == "structure" else 4,
        )
        image = as_png(visual.image) if visual.exact else quantise(visual.image, palette)
        image.save(assets / f"{stem}.png", optimize=True)
    for placed in parts.objects:
        for i, hull in enumerate(placed.hulls_b):
            _write_hull(assets / f"{placed.name}_hull_{i}.obj", hull)
    spec = build_spec(parts, inline=False)
    spec.modelfiledir = str(folder)
    spec.compile()
    (folder / "scene.xml").write_text(spec.to_xml(), encoding="utf-8")


def _write_hull(path: Path, hull: Hull) -> None:
    write_obj(path, hull.vertices, hull.faces, decimals=5)
