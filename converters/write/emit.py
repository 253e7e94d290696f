"""Write a scene as an `MjSpec` with assets, by the MJCF conventions in `scenes_mjcf/README.md`."""

import dataclasses
import math
import re
from pathlib import Path

import mujoco
import numpy as np

from converters.bodies.objects import Physical, PlacedObject
from converters.geometry.boxes import OrientedBox, least_turned
from converters.geometry.faces import corner_normals, unit_normals
from converters.records.raw import ScannedHinge, VisualMesh, Window
from converters.write.texture import as_png, quantise, share_plain
from interactive_nav_common.rotations import yaw_matrix
from scenes_mjcf.agreement import light_evenly

TIMESTEP_S = 0.005
HINGED, SLIDING = (0.4, 0.25), (15.0, 3.0)
"""Damping, N m s/rad and N s/m, and dry friction, N m and N, of joints: a 5 kg drawer at 0.5 m/s slides on by 0.1 m."""
HINGES = {"door": (2.0, 0.4)}
"""The same by category: a pushed interior door stops after about a second, and half a newton at the handle moves it."""
ONE = (1.0, 1.0, 1.0)
SAME_M = 5e-5
"""Meshes no farther apart are one; half of what a file's last digit is."""
HULL_DECIMALS = 5
NEAR, CURVED = 0.9997, 0.998
"""Cosine of a written normal to its own; where a corner's to its face's is below that, a surface is curved.

MuJoCo computes normals where there are none, one a vertex, which bend the light at the rims of lids and seats; they do
for the structure, which is mostly flat."""


@dataclasses.dataclass(frozen=True)
class Appearance:
    """Which files show a body."""

    mesh: str
    """Body after which the mesh's file is named."""
    scale: tuple[float, float, float]
    """Of the mesh along the body's axes."""
    image: str
    """Body after which the texture's file is named."""


Assets = tuple[dict[str, Appearance], dict[str, tuple[str, ...]]]
"""By body: which files show it, and the mesh of each hull, whose file has the same name."""


@dataclasses.dataclass(frozen=True)
class SceneParts:
    """What a scene's model consists of."""

    name: str
    objects: tuple[PlacedObject, ...]
    physical: tuple[Physical, ...]
    walls: tuple[OrientedBox, ...]
    structure_visual: VisualMesh | None = None
    object_visuals: tuple[VisualMesh, ...] = ()
    """Body frame, one an object; empty: no visuals (the settling model)."""
    windows: tuple[Window, ...] = ()
    """World frame."""


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation, float).reshape(9))
    return quaternion


def _tidy(values: np.ndarray) -> np.ndarray:
    """Round to a micrometre, without negative zeros: short files, equal bytes."""
    return np.round(np.asarray(values, float), 6) + 0.0


def _add_movable(
    spec: mujoco.MjSpec, placed: PlacedObject, physical: Physical, look: Appearance | None, hulls: tuple[str, ...]
) -> None:
    body = spec.worldbody.add_body(name=placed.name, pos=_tidy(placed.position_w))
    body.quat, body.explicitinertial = np.round(placed.quaternion_w, 9), True
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
        _add_hinge(spec, body, placed, placed.hinge)
    friction = [physical.friction, 0.005, 0.0001]
    if look is not None:
        _add_look(spec, body, placed.name, look)
    for i, (hull, box) in enumerate(zip(placed.hulls_b, placed.boxes_b, strict=True)):
        name = f"{placed.name}_hull_{i}"
        shared = hulls[i] if hulls else name
        if shared == name:
            mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
            if hulls:
                mesh.file = f"{name}.obj"
            else:
                mesh.uservert = _tidy(hull.vertices).reshape(-1)
        kind, mesh_geom = spec.find_default("hull"), mujoco.mjtGeom.mjGEOM_MESH
        body.add_geom(kind, name=name, type=mesh_geom, meshname=shared, friction=friction)
        _add_box(spec, body, "box", f"{placed.name}_box_{i}", box, friction)


def _add_hinge(spec: mujoco.MjSpec, body: mujoco.MjsBody, placed: PlacedObject, hinge: ScannedHinge) -> None:
    """Add the joint of a body that opens; a door's leaf keeps clear of the walls, other fronts lie in their cabinet."""
    kind = "slide" if hinge.slides else "hinge"
    damping, friction = HINGES.get(placed.category, SLIDING if hinge.slides else HINGED)
    if not hinge.slides and abs(hinge.axis[2]) < 0.99:
        body.gravcomp = 1.0  # a flap is balanced by springs: it stays where it is put
    joint = body.add_joint(name=f"{placed.name}_{kind}", type=getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}"))
    joint.axis, joint.pos, joint.range = _tidy(hinge.axis), _tidy(hinge.origin), np.round(hinge.range_rad, 6)
    joint.damping, joint.frictionloss, joint.armature = [damping, 0, 0], friction, 0.01
    if placed.category != "door":
        spec.add_exclude(bodyname1=placed.name, bodyname2="structure")


def _add_box(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, kind: str, name: str, box: OrientedBox, friction: list[float]
) -> None:
    place = {"size": _tidy(box.half), "pos": _tidy(box.centre), "quat": np.round(_quaternion(box.rotation), 9)}
    geom = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(spec.find_default(kind), name=name, type=geom, friction=friction, **place)


def _add_look(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, look: Appearance) -> None:
    """Add a textured visual geom; reuse meshes, textures and materials of other bodies."""
    mesh_name = f"{name}_visual" if look.scale != ONE else f"{look.mesh}_visual"
    if mesh_name == f"{name}_visual":
        mesh = spec.add_mesh(name=mesh_name, file=f"{look.mesh}_visual.obj", scale=look.scale)
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    if look.image == name:
        spec.add_texture(name=f"{name}_texture", file=f"{name}.png", type=mujoco.mjtTexture.mjTEXTURE_2D)
        material = spec.add_material(name=f"{name}_material", specular=0.1, shininess=0.1)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"{name}_texture"
    kind, mesh_geom = spec.find_default("visual"), mujoco.mjtGeom.mjGEOM_MESH
    body.add_geom(kind, name=f"{name}_visual", type=mesh_geom, meshname=mesh_name, material=f"{look.image}_material")


def share_assets(parts: SceneParts) -> Assets:
    """Return the files that show and bound each body; equal ones are written once, under the first body's name."""
    looks, meshes, images, solids, hulls = {}, {}, {}, {}, {}
    drawn = [(o.name, v) for o, v in zip(parts.objects, parts.object_visuals, strict=True)]
    for name, visual in [*drawn, *([("structure", parts.structure_visual)] if parts.structure_visual else [])]:
        image = images.setdefault((visual.exact, visual.image.shape, visual.image.tobytes()), name)
        key = tuple(np.ascontiguousarray(v).tobytes() for v in (visual.faces, visual.uv, visual.uv_faces))
        first, mesh = meshes.setdefault(key, (name, visual))
        size, wanted = (np.ptp(m.vertices, axis=0) for m in (mesh, visual))
        scale = np.round(np.where(size > 1e-6, wanted / np.maximum(size, 1e-6), 1.0), 6)
        same = np.abs(mesh.vertices * scale - visual.vertices).max() <= SAME_M
        x, y, z = scale.tolist()
        looks[name] = Appearance(first, (x, y, z), image) if same else Appearance(name, ONE, image)
    for placed in parts.objects:
        for i, hull in enumerate(placed.hulls_b):
            key = (np.round(hull.vertices, HULL_DECIMALS) + 0.0).tobytes(), hull.faces.tobytes()
            hulls.setdefault(placed.name, []).append(solids.setdefault(key, f"{placed.name}_hull_{i}"))
    return looks, {name: tuple(names) for name, names in hulls.items()}


def build_spec(parts: SceneParts, assets: Assets | None = None) -> mujoco.MjSpec:
    """Build the scene as an `MjSpec`; `assets` are file names, or None for inline hulls without visuals (settling)."""
    spec = _empty_spec(parts.name)
    lit = parts.structure_visual is not None and parts.structure_visual.exact
    _add_surroundings(spec, parts.walls, lit)
    looks, hulls = assets or ({}, {})
    structure = spec.worldbody.add_body(name="structure")
    if (look := looks.get("structure")) is not None:
        _add_look(spec, structure, "structure", look)
    for i, wall in enumerate(parts.walls):
        _add_box(spec, structure, "structure", f"wall_{i}", wall, [0.6, 0.005, 0.0001])
    for k, window in enumerate(parts.windows):  # of a group that viewers hide
        quat = np.round(_quaternion(yaw_matrix(window.yaw)), 9)
        place = {"pos": _tidy(window.middle), "size": _tidy(window.half), "quat": quat}
        structure.add_site(name=f"window_{k}", type=mujoco.mjtGeom.mjGEOM_BOX, group=5, **place)
    # Semantic classes, for tools that read the MJCF alone: text `class_<body>` holds the category.
    for body, category in (("structure", "structure"), *((o.name, o.category) for o in parts.objects)):
        spec.add_text(name=f"class_{body}", data=category)
    for placed, physical in zip(parts.objects, parts.physical, strict=True):
        _add_movable(spec, placed, physical, looks.get(placed.name), hulls.get(placed.name, ()))
    return spec


def _empty_spec(name: str) -> mujoco.MjSpec:
    """Set the options and default classes of every scene."""
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.meshdir = spec.texturedir = "assets"
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
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
    return spec


def _add_surroundings(spec: mujoco.MjSpec, walls: tuple[OrientedBox, ...], lit: bool) -> None:
    """Add floor, and a light above the walls' middle: an even one where the structure's image is `lit`."""
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
    floor.friction, floor.rgba = [1.0, 0.005, 0.0001], [0.6, 0.6, 0.6, 1.0]
    middle = np.mean([b.centre for b in walls], axis=0) if walls else np.zeros(3)
    light = spec.worldbody.add_light(name="light", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=False)
    light.pos = [round(float(middle[0]), 3), round(float(middle[1]), 3), 4.0]
    light.dir, light.diffuse, light.ambient = [0, 0, -1], [0.6] * 3, [0.4] * 3
    if lit:
        light_evenly(spec)


def paired(faces: np.ndarray, corners: np.ndarray) -> list[list[int]]:
    """Return triangles, with quads in place of two that share an edge.

    Readers of OBJ split a quad from its first to its third corner or along its shorter diagonal. Both are the shared
    edge here, unless the quad is a parallelogram, where either gives the same surface. `faces` (m, 3) have one
    orientation; `corners` (k, 5) are position and texture coordinates in units of their last digit.
    """
    polygons: list[list[int]] = []
    free: dict[tuple[int, int], int] = {}
    at = corners[:, :3].tolist()
    for a, b, c in faces.tolist():
        for start, end, tip in ((a, b, c), (b, c, a), (c, a, b)):
            k = free.get((end, start))
            if k is None:
                continue
            u, v, w = polygons[k]
            other = u + v + w - start - end
            shared, across = math.dist(at[start], at[end]), math.dist(at[tip], at[other])
            if (
                shared < 0.999 * across
                or np.abs(corners[[start, end]].sum(0) - corners[[tip, other]].sum(0)).max() < 2.5
            ):
                for edge in ((u, v), (v, w), (w, u)):
                    if free.get(edge) == k:
                        del free[edge]
                polygons[k] = [start, other, end, tip]
                break
        else:
            free.update(dict.fromkeys(((a, b), (b, c), (c, a)), len(polygons)))
            polygons.append([a, b, c])
    return polygons


def _commonest_first(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct ones of (m, 3, k) rows, the commonest first, whose number is short, and indices (m, 3)."""
    rows = corners.reshape(-1, corners.shape[2]) + 0.0
    rows, of, uses = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(-uses, kind="stable")
    return rows[order], np.argsort(order)[of].reshape(-1, 3)


def _short(normals: np.ndarray) -> np.ndarray:
    """Return multiples of about unit vectors (m, 3, 3), in whole numbers of one digit; readers normalise them."""
    longest = np.maximum(np.abs(normals).max(axis=2, keepdims=True), 1e-9)
    result, best = normals.copy(), np.full(normals.shape[:2], -1.0)
    for most in range(1, 10):
        whole = np.round(normals * (most / longest))
        cosine = (whole * normals).sum(axis=2) / np.maximum(np.linalg.norm(whole, axis=2), 1.0)
        better = (best < NEAR) & (cosine > best)
        result[better], best[better] = whole[better], cosine[better]
    return result


def write_obj(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | None = None,
    uv_faces: np.ndarray | None = None,
    decimals: int = 4,
    uv_decimals: int = 4,
    smooth: bool = False,
) -> None:
    """Write a triangle mesh as a compact OBJ, with normals if it is `smooth`, textured and curved somewhere."""
    if uv is None or uv_faces is None:
        lines = [f"v {x:.{decimals}f} {y:.{decimals}f} {z:.{decimals}f}" for x, y, z in vertices + 0.0]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    else:
        at_corners = corner_normals(vertices, faces)
        curved = smooth and ((at_corners * unit_normals(vertices, faces)[:, None]).sum(axis=2) < CURVED).any()
        vertices, faces = _commonest_first(np.round(vertices, decimals)[faces])
        apart = (faces != np.roll(faces, 1, axis=1)).all(axis=1)  # else two corners are in one place
        vertices, faces = _commonest_first(vertices[faces[apart]])
        uv, uv_faces = _commonest_first(np.round(uv, uv_decimals)[uv_faces[apart]])
        tables, indices = {"v": vertices, "vt": uv}, [faces, uv_faces]
        if curved:
            tables["vn"], of = _commonest_first(_short(at_corners[apart]))
            indices.append(of)
        rows = np.stack(indices, axis=2).reshape(-1, len(indices))
        rows, of = np.unique(rows, axis=0, return_inverse=True)
        lines = [" ".join((k, *(f"{v:.9g}" for v in row))) for k, table in tables.items() for row in table.tolist()]
        lines = [re.sub(r"\b0\.", ".", line) for line in lines]  # -0.25: every reader takes -.25
        names = ["/".join(map(str, row)) for row in (rows + 1).tolist()]
        steps = np.hstack([vertices[rows[:, 0]] * 10**decimals, uv[rows[:, 1]] * 10**uv_decimals])
        for polygon in paired(of.reshape(-1, 3), steps):
            lines.append(" ".join(("f", *(names[k] for k in polygon))))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_scene(parts: SceneParts, folder: Path, palette: int = 96) -> None:
    """Write `scene.xml` and `assets/` into an existing folder, textures in `palette` colours."""
    parts = dataclasses.replace(parts, object_visuals=tuple(map(share_plain, parts.object_visuals)))
    assets, (looks, hulls) = folder / "assets", share_assets(parts)
    assets.mkdir()
    drawn = dict(zip((o.name for o in parts.objects), parts.object_visuals, strict=True))
    for name, look in looks.items():
        visual = parts.structure_visual if name == "structure" else drawn[name]
        assert visual is not None
        if look.mesh == name:
            mesh = visual.vertices, visual.faces, visual.uv, visual.uv_faces
            small = name != "structure" and max(visual.image.shape) <= 256
            digits = 3 if name == "structure" else 4, 3 if small else 4
            write_obj(assets / f"{name}_visual.obj", *mesh, *digits, smooth=name != "structure")
        if look.image == name:
            image = as_png(visual.image) if visual.exact else quantise(visual.image, palette)
            image.save(assets / f"{name}.png", compress_level=7)  # at 9, 3 % smaller in five times the time
    for placed in parts.objects:
        for i, (hull, name) in enumerate(zip(placed.hulls_b, hulls[placed.name], strict=True)):
            if name == f"{placed.name}_hull_{i}":
                write_obj(assets / f"{name}.obj", hull.vertices, hull.faces, decimals=HULL_DECIMALS)
    spec = build_spec(parts, (looks, hulls))
    spec.modelfiledir = str(folder)
    spec.compile()
    (folder / "scene.xml").write_text(_full_lengths(spec), encoding="utf-8")


def _full_lengths(spec: mujoco.MjSpec) -> str:
    """Return the spec as XML with all digits of positions and sizes of 10 m and more, of which MuJoCo writes six."""

    def full(match: re.Match[str]) -> str:
        kind, name = match[1], match[2]
        element = spec.body(name) if kind == "body" else spec.geom(name) if kind == "geom" else spec.site(name)
        text = match[0]
        for key in ("pos", "size") if element is not None else ():
            values = np.asarray(getattr(element, key, ()), float)
            if len(values) and np.isfinite(values).all() and np.abs(values).max() >= 10:
                text = re.sub(rf' {key}="[^"]*"', f' {key}="{" ".join(f"{v:.12g}" for v in values)}"', text)
        return text

    return re.sub(r'<(body|geom|site) name="([^"]*)"[^>]*>', full, spec.to_xml())
