"""Read a mesh file of any kind that trimesh reads, as a `TexturedMesh` in metres and z up.

trimesh reads referenced files through `SourceResolver`: only within the source folder, hashed, with missing ones
reported. Only COLLADA files state their unit and up axis.
"""

import collections
import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals

from converters.geometry.faces import merge_vertices
from converters.read import obj, surfaces
from converters.read.files import SourceFolder, as_number, check_mesh, read_labels
from converters.read.formats.gltf import read_gltf
from converters.records.errors import SceneRejected
from converters.records.raw import RawScene
from interactive_nav_common.errors import readable
from interactive_nav_common.rotations import Y_UP_TO_Z_UP

SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".dae", ".off")
"""Of files that may be a scan."""
COLLADA_UNUSED = (
    *("animation", "camera", "controller", "light", "lines", "linestrips", "trifans", "tristrips", "emission"),
    "colours of vertices beside a material",
    "textures that do not repeat",
)
PLY_USED = {"element vertex", "element face"} | {
    f"property {name}"
    for name in (
        *("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", "s", "t", "u", "v", "texture_u"),
        *("texture_v", "vertex_index", "vertex_indices", "texcoord"),
    )
}
UP_AXES = {
    "X_UP": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "Y_UP": Y_UP_TO_Z_UP,
    "Z_UP": np.eye(3),
}
"""COLLADA's word -> turn to z up."""


def beside(path: Path, ending: str) -> Path:
    """Return the path of a mesh's companion: `scan.obj.labels.npz`, or `scan.labels.npz` if it is unambiguous."""
    full, short = path.with_name(f"{path.name}.{ending}"), path.with_name(f"{path.stem}.{ending}")
    meshes = [p for p in path.parent.iterdir() if p.stem == path.stem and p.suffix.lower() in SUFFIXES]
    return short if short.is_file() and not full.is_file() and len(meshes) == 1 else full


class SourceResolver:
    """Give trimesh the files that a model names, and nothing else."""

    def __init__(self, source: SourceFolder, model: Path) -> None:
        """Resolve names in `model`, a path inside of `source`."""
        self.source, self.model = source, model
        self.refusal: SceneRejected | None = None
        """The first error that trimesh's loaders swallowed: they go on without a file, whatever the reason."""

    def get(self, key: str) -> bytes:
        """Return the content of a named file."""
        try:
            path = None
            if Path(key).suffix.lower() not in Image.registered_extensions() or (
                obj.read_texture(self.source, self.model, key) is not None
            ):
                path = obj.use_named(self.source, self.model.parent, key, self.model.name)
        except SceneRejected as refusal:
            self.refusal = self.refusal or refusal
            raise
        if path is None:
            raise FileNotFoundError(key)
        return path.read_bytes()


def read_surface(source: SourceFolder, relative: str, remedy: str) -> obj.TexturedMesh:
    """Read a mesh file of any kind, with its textures or colours, once for every source."""
    if relative not in source.surfaces:
        source.surfaces[relative] = _read_surface(source, relative, remedy)
    return source.surfaces[relative]


def _read_surface(source: SourceFolder, relative: str, remedy: str) -> obj.TexturedMesh:
    if relative.lower().endswith(".obj"):
        return obj.read_scan_obj(source, relative, remedy)
    path = source.use(relative, remedy)
    resolver: Any = SourceResolver(source, path)
    try:
        with readable(path, SceneRejected, "expected OBJ, PLY, STL, GLB or DAE", " as a mesh"), path.open("rb") as file:
            if path.suffix.lower() in (".glb", ".gltf"):
                parts = read_gltf(source, path)
            else:
                loaded = trimesh.load(file, path.suffix[1:].lower(), resolver=resolver, process=False, force="scene")
                assert isinstance(loaded, trimesh.Scene)
                meshes = [p for p in loaded.dump() if isinstance(p, trimesh.Trimesh) and len(p.faces)]
                turn = np.eye(3)
                if path.suffix.lower() == ".dae":
                    axis, unit = collada_frame(path)
                    if not 0.0 < as_number(unit) < math.inf or axis not in UP_AXES:
                        raise SceneRejected(
                            f"{path}: its unit is '{unit}' m and its up axis '{axis}', expected a positive number and "
                            f"one of {', '.join(UP_AXES)}; export it again"
                        )
                    turn = as_number(unit) * UP_AXES[axis]
                parts = [_painted(path, mesh, turn) for mesh in meshes]
    except SceneRejected:
        if resolver.refusal is None:
            raise
    if resolver.refusal is not None:
        raise resolver.refusal from None
    source.note_counts(f"{relative}: not used:", _unused(path), " ")
    if not parts:
        raise SceneRejected(f"{path}: holds no triangle mesh; export it as OBJ, PLY, STL or GLB")
    return obj.join_meshes(*parts)


def _unused(path: Path) -> dict[str, int]:
    """Count what trimesh's readers pass over."""
    if path.suffix.lower() == ".dae":
        root = ElementTree.parse(path).getroot()
        elements = collections.Counter(e.tag.rpartition("}")[2] for e in root.iter())
        glow = ((e.findtext("{*}color") or "1").split()[:3] for e in root.iterfind(".//{*}emission"))
        elements["emission"] = sum(any(as_number(value) > 0 for value in colour) for colour in glow)
        modes = (e.text or "" for tag in ("wrap_s", "wrap_t") for e in root.iterfind(f".//{{*}}{tag}"))
        elements["textures that do not repeat"] = sum(mode.strip() not in ("", "WRAP") for mode in modes)
        painted = (e for e in root.iter() if e.get("material") and e.find("{*}input[@semantic='COLOR']") is not None)
        elements["colours of vertices beside a material"] = sum(1 for _ in painted)
        return {what: count for what, count in elements.items() if count and what in COLLADA_UNUSED}
    content = path.read_bytes()
    if path.suffix.lower() == ".ply":
        lines = [line.split() for line in content.partition(b"end_header")[0].decode("latin-1").splitlines()]
        words = [f"{line[0]} {line[-1] if line[0] == 'property' else line[1]}" for line in lines if len(line) > 2]
        return collections.Counter(w for w in words if w.startswith(("property", "element")) and w not in PLY_USED)
    if path.suffix.lower() == ".stl" and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little"):
        colours = np.frombuffer(content, np.uint8, offset=84).reshape(-1, 50)[:, 48:]
        return {"colours of faces": count} if (count := int(colours.any(axis=1).sum())) else {}
    if path.suffix.lower() == ".off":
        rows = [line.partition("#")[0].split() for line in content.decode("latin-1").splitlines()]
        body = [row for row in rows if row][1:]
        coloured = [row for row in body if row[0].isdigit() and len(row) > int(row[0]) + 1 > 3]
        counts = {"colours of faces": len(coloured), "colours of vertices": int(content.lstrip()[:1] == b"C")}
        return {what: count for what, count in counts.items() if count}
    return {}


def read_single_mesh(
    path: Path, strict: bool = False, up: str = "auto", unit: str = "auto", mirror: bool = False
) -> RawScene:
    """Read a scan that is one mesh file; without labels beside it, structure is recognised by its shape.

    Referenced files must lie in its folder. `up` and `unit` are keys of `surfaces.AXES` and `surfaces.UNITS_M`;
    `auto` detects them.
    """
    source = SourceFolder(path.parent, strict)
    mesh = read_surface(source, source.inside(path), "give a mesh file")
    mesh = dataclasses.replace(mesh, vertices=mesh.vertices * [-1.0 if mirror else 1.0, 1.0, 1.0])
    axis = surfaces.find_up(mesh.vertices, mesh.faces, str(path)) if up == "auto" else surfaces.AXES[up]
    vertices = mesh.vertices @ surfaces.turn_upright(axis).T
    word = surfaces.find_unit(vertices, mesh.faces, str(path)) if unit == "auto" else unit
    tilt = math.degrees(math.acos(float(np.clip(axis[2], -1.0, 1.0))))
    if up == "auto" and tilt > 0.5:
        source.note(f"{path.name}: turned by {tilt:.1f} degrees, so that its floor is level; --up z leaves it")
    if word != "m" and unit == "auto":
        source.note(f"{path.name}: taken to be in {word}; --unit says otherwise")
    mesh = dataclasses.replace(mesh, vertices=vertices * surfaces.UNITS_M[word])
    surfaces.check_extent(str(path), mesh.vertices)
    if surfaces.faces_away(mesh.vertices, mesh.faces):
        raise SceneRejected(
            f"{path}: its floor faces down: the mesh is mirrored or inside out; give --mirror, which mirrors x, or "
            "turn the order of each face's corners if only that is wrong"
        )
    floor_m = surfaces.floor_level(mesh.vertices, mesh.faces, str(path))
    if (beside_it := beside(path, "labels.npz")).is_file():
        given = source.use(source.inside(beside_it), "")
        mesh, labels = surfaces.labelled(mesh, read_labels(given), given)
    else:
        mesh = surfaces.with_split_corners(surfaces.welded(mesh))
        labels = surfaces.label_storeys(mesh.vertices, mesh.faces, (floor_m,))
        source.note(
            f"{path.name}: has no labels: floor, walls and ceiling are labelled by shape, and the rest belongs to them"
        )
    licence = "unknown: a mesh file says none"
    return source.scene("mesh", obj.scan_of(mesh, labels), name=path.stem, floor_height_m=floor_m, licence=licence)


def _painted(path: Path, part: trimesh.Trimesh, turn: np.ndarray) -> obj.TexturedMesh:
    """Return a mesh of trimesh with its texture, or its colours of faces, vertices or material; grey without any."""
    vertices, faces = np.asarray(part.vertices, float), np.asarray(part.faces, np.int64)
    check_mesh(path, vertices, faces)
    vertices = vertices @ turn.T
    material, uv = getattr(part.visual, "material", None), getattr(part.visual, "uv", None)
    image = _first(material, "image", "baseColorTexture")
    if image is not None and uv is not None and len(uv) == len(vertices):
        uv = np.where(np.isfinite(uv), uv, 0.0)
        return obj.TexturedMesh(vertices, faces, uv[faces], np.asarray(image.convert("RGB")))
    if isinstance(part.visual, ColorVisuals) and part.visual.defined:
        colours = np.asarray(part.visual.face_colors, np.uint8)[:, :3]
    else:
        plain = _first(material, "diffuse", "main_color")
        colours = np.tile(np.asarray((160, 160, 160) if plain is None else plain, np.uint8)[:3], (len(faces), 1))
    return obj.textured_by_face(vertices, faces, colours)


def _first(item: Any, *names: str) -> Any:
    """Return the first of some attributes that is there; None without any."""
    return next((value for name in names if (value := getattr(item, name, None)) is not None), None)


def collada_frame(path: Path) -> tuple[str, str]:
    """Return the word for the up axis, and the unit in m, of a COLLADA file; by its standard a silent one is y up."""
    root = ElementTree.parse(path).getroot()
    unit = root.find("{*}asset/{*}unit")
    axis = (root.findtext("{*}asset/{*}up_axis") or "Y_UP").strip()
    return axis, "1" if unit is None else unit.get("meter", "1")


def colours_of_faces(mesh: obj.TexturedMesh) -> np.ndarray:
    """Return (m, 3) uint8: the texture at the middle of each face, grey without one."""
    if mesh.texture is None or mesh.corner_uv is None:
        return np.full((len(mesh.faces), 3), 170, np.uint8)
    return obj.texels(mesh.texture, mesh.corner_uv.mean(axis=1))


def clean_surface(
    source: SourceFolder, where: str, mesh: obj.TexturedMesh, colours: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join vertices, drop faces without area and report other defects; decomposition closes open surfaces itself.

    `colours`: (m, 3) of the faces; None: `colours_of_faces`.
    """
    vertices, faces, keep = merge_vertices(mesh.vertices, mesh.faces)
    colours = (colours_of_faces(mesh) if colours is None else colours)[keep]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    extent = np.ptp(vertices, axis=0)
    longest = np.max([np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)], 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    good = area > 1e-9 * np.maximum(longest, 1e-12) ** 2
    if not good.any() or (extent > 1e-6 * max(float(extent.max()), 1e-12)).sum() < 2:
        raise SceneRejected(f"{source.root / where}: its {len(faces)} faces enclose no area; fetch the model again")
    if not good.all():
        source.note(f"{where}: {int((~good).sum())} of {len(faces)} faces have no area; they are dropped")
        faces, colours = faces[good], colours[good]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    open_edges, busy = int((count == 1).sum()), int((count > 2).sum())
    if busy:
        source.note(f"{where}: is not manifold ({busy} edges with three faces or more); collision uses closed hulls")
    elif open_edges:
        source.note(f"{where}: is not watertight ({open_edges} open edges); collision uses closed hulls")
    return vertices, faces, colours
