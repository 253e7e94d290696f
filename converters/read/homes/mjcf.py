"""Any MJCF home in (RoboCasa, MolmoSpaces, a scene of our own), `RawScene` out.

MuJoCo itself reads and compiles it, after every file that it names was seen to lie in the source's folder. What hangs
on a free joint is a part; what no joint lets move is structure, body by body; what hinges and slides carry stays where
it is, but for doors.
"""

from __future__ import annotations

import collections
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from converters.read.files import SourceFolder
from converters.read.homes.parts import Part, category_of, home
from converters.read.meshes import textured_by_face
from converters.read.obj import TexturedMesh
from converters.read.urdf import joined, placed
from converters.records.errors import SceneRejected
from converters.records.raw import RawScene
from interactive_nav_common.rotations import matrix_from_quat

DEEPEST = 16
"""Includes within includes."""
MOST_GEOMS = 100_000
FARTHEST_M = 1e4
FOLDERS = ("assetdir", "meshdir", "texturedir")
_GEOM = mujoco.mjtGeom


def mains_of(root: Path) -> list[Path]:
    """The folder's own MJCF files: `scene.xml` where there is one, else all."""
    found = [p for p in sorted(root.glob("*.xml")) if _tag(p) == "mujoco"]
    return [p for p in found if p.name == "scene.xml"] or found


def _tag(path: Path) -> str:
    try:
        return next(iter(ElementTree.iterparse(path, events=("start",))))[1].tag
    except (ElementTree.ParseError, OSError, StopIteration):
        return ""


def looks_like(root: Path) -> bool:
    """True when the folder has an MJCF file."""
    return root.is_dir() and bool(mains_of(root))


def read_mjcf(root: Path, strict: bool = False, chosen: Path | None = None) -> RawScene:
    """Reads a folder's only MJCF file, its `scene.xml`, or the chosen one.

    Raises:
        SceneRejected: none or several, one that MuJoCo refuses, or it names a file outside of the folder.
    """
    source = SourceFolder(root, strict)
    mains = [chosen] if chosen else mains_of(root)
    if len(mains) != 1:
        names = ", ".join(p.name for p in mains) or "none"
        raise SceneRejected(f"{root}: MJCF files are {names}, expected one or scene.xml; give the file of one")
    _check_files(source, mains[0], 0, dict.fromkeys(FOLDERS, ""))
    try:
        model = mujoco.MjSpec.from_file(str(mains[0])).compile()
    except (ValueError, RuntimeError) as error:
        raise SceneRejected(f"{mains[0]}: MuJoCo refuses it ({' '.join(str(error).split())})") from error
    if model.ngeom > MOST_GEOMS:
        raise SceneRejected(f"{mains[0]}: has {model.ngeom} geoms, expected a home of at most {MOST_GEOMS}")
    return home(source, "mjcf", _parts(model, source, mains[0]))


def _check_files(source: SourceFolder, path: Path, depth: int, folders: dict[str, str]) -> None:
    """Every file that an MJCF names, with its includes, lies in the source; their hashes are kept.

    Raises:
        SceneRejected: one does not, or is missing.
    """
    relative = source.inside(path)
    if depth > DEEPEST:
        raise SceneRejected(f"{path}: includes lie {DEEPEST} deep in includes; does one include itself?")
    try:
        root = ElementTree.parse(source.use(relative, "an MJCF names it")).getroot()
    except ElementTree.ParseError as error:
        raise SceneRejected(f"{path}: not readable as MJCF ({error}); fetch the file again") from error
    for compiler in root.iter("compiler"):
        for word in FOLDERS:
            folders[word] = compiler.get(word, folders[word])
    for element in root.iter():
        for key, name in element.attrib.items():
            if not key.startswith("file"):
                continue
            if element.tag in ("include", "model"):
                _check_files(source, path.parent / name, depth + 1, folders)
                continue
            own = folders["texturedir"] if element.tag == "texture" else folders["meshdir"]
            place = path.parent / (own or folders["assetdir"]) / name
            source.use(source.inside(place), f"{path.name} names it")


def _parts(model: mujoco.MjModel, source: SourceFolder, path: Path) -> list[Part]:
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    top = _tops(model)
    dropped: collections.Counter[str] = collections.Counter()
    for joint in range(model.njnt):
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            dropped[f"{mujoco.mjtJoint(model.jnt_type[joint]).name[6:].lower()} joint (stays as it is)"] += 1
    if not (np.abs(data.geom_xpos) < FARTHEST_M).all():  # NaN too
        raise SceneRejected(f"{path}: a geom stands at no usable place, expected all within {FARTHEST_M:g} m")
    span = float(2.0 * max(np.abs(data.geom_xpos).max(initial=0.0), 2.0))
    parts = []
    for body in range(model.nbody):
        if top[body] != body:
            continue
        members = np.flatnonzero(top == body)
        pose = _matrix(data.xpos[body], data.xquat[body])
        back = np.linalg.inv(pose)
        seen, solid = [], []
        for geom in np.flatnonzero(np.isin(model.geom_bodyid, members)):
            mesh = _mesh(model, int(geom), span)
            if mesh is None:
                dropped[_GEOM(model.geom_type[geom]).name[7:].lower()] += 1
                continue
            at = back @ _matrix(data.geom_xpos[geom], None, data.geom_xmat[geom])
            collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
            drawn = model.geom_group[geom] < 3 and model.geom_rgba[geom, 3] > 0
            if collides:
                solid.append((placed(mesh, at), bool(drawn), float(model.geom_friction[geom, 0])))
            elif drawn:
                seen.append(placed(mesh, at))
        surface = joined(seen or [m for m, drawn, _ in solid if drawn] or [m for m, _, _ in solid])
        if surface is None:
            continue
        free = model.body_jntnum[body] == 1 and model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE
        friction = max((f for _, _, f in solid), default=0.0)
        parts.append(
            Part(
                model.body(body).name or f"body_{body}",
                pose,
                surface,
                joined([m for m, _, _ in solid]),
                not free,
                float(model.body_mass[members].sum()) or None,
                friction if 0 < friction <= 2 else None,
            )
        )
    for kind, count in sorted(dropped.items()):
        source.note(f"{path.name}: {count} x {kind}")
    return parts


def _tops(model: mujoco.MjModel) -> np.ndarray:
    """(nbody,) the body that each one is a part of: the world's children, and what moves or has a name within them."""
    top = np.arange(model.nbody)
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        still = model.body_weldid[parent] == 0
        apart = model.body_jntnum[body] > 0 or category_of(model.body(body).name) is not None
        top[body] = body if parent == 0 or (still and apart) else top[parent]
    return top


def _matrix(position: np.ndarray, quat: np.ndarray | None, turn: np.ndarray | None = None) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    matrix[:3, :3] = turn.reshape(3, 3) if turn is not None else matrix_from_quat(np.asarray(quat))
    return matrix


def _mesh(model: mujoco.MjModel, geom: int, span_m: float) -> TexturedMesh | None:
    """A geom's surface in its own frame; None for kinds without one. Planes without an end reach `span_m` far."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    if kind == _GEOM.mjGEOM_MESH:
        return _of_mesh(model, int(model.geom_dataid[geom]), material, rgba)
    if kind == _GEOM.mjGEOM_PLANE:
        x, y = (v if v > 0 else span_m for v in size[:2])
        solid = trimesh.Trimesh([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], [(0, 1, 2), (0, 2, 3)], process=False)
    elif kind == _GEOM.mjGEOM_BOX:
        solid = trimesh.creation.box(2 * size)
    elif kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID):
        solid = trimesh.creation.icosphere(2)
        solid.apply_scale(size if kind == _GEOM.mjGEOM_ELLIPSOID else size[0])
    elif kind == _GEOM.mjGEOM_CYLINDER:
        solid = trimesh.creation.cylinder(size[0], 2 * size[1], sections=16)
    elif kind == _GEOM.mjGEOM_CAPSULE:
        solid = trimesh.creation.capsule(2 * size[1], size[0], count=(12, 12))
    else:
        return None
    return _plain(np.asarray(solid.vertices, float), np.asarray(solid.faces, np.int64), rgba)


def _plain(vertices: np.ndarray, faces: np.ndarray, rgba: np.ndarray) -> TexturedMesh:
    colour = np.clip(np.round(255 * np.asarray(rgba)[:3]), 0, 255).astype(np.uint8)
    return textured_by_face(vertices, faces, np.tile(colour, (len(faces), 1)))


def _of_mesh(model: mujoco.MjModel, mesh: int, material: int, rgba: np.ndarray) -> TexturedMesh:
    """A compiled mesh, with its material's texture where both have coordinates."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces_n = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = np.array(model.mesh_vert[first : first + count], float)
    faces = np.array(model.mesh_face[face : face + faces_n], np.int64)
    texture = -1
    if material >= 0:
        texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    start = model.mesh_texcoordadr[mesh]
    if texture < 0 or start < 0 or model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D:
        return _plain(vertices, faces, rgba)
    uv = np.array(model.mesh_texcoord[start + model.mesh_facetexcoord[face : face + faces_n]], float)
    height, width, channels = (int(v[texture]) for v in (model.tex_height, model.tex_width, model.tex_nchannel))
    at = model.tex_adr[texture]
    image = np.array(model.tex_data[at : at + height * width * channels], np.uint8).reshape(height, width, channels)
    # MuJoCo keeps images with their first row at the top and texture coordinates from there.
    return TexturedMesh(vertices, faces, uv * [1.0, -1.0] + [0.0, 1.0], np.ascontiguousarray(image[..., :3]))
