"""A ShapeNet-like OBJ with its materials in, one `CadModel` (z up, a colour per face) out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from converters.errors import SceneRejected
from converters.files import SourceFolder, check_mesh, read_obj
from converters.obj import parse_mtl
from converters.raw import SYNSETS, CadModel

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns a y-up vector into a z-up one: x stays, y becomes z, z becomes -y."""


def material_image(material: Any) -> Image.Image | None:
    """Texture of a trimesh material: of an OBJ's, or the base colour of a glTF's."""
    image = getattr(material, "image", None)
    return getattr(material, "baseColorTexture", None) if image is None else image


def face_colours(mesh: trimesh.Trimesh) -> np.ndarray:
    """(m, 3) uint8 colour of every face: its texture at the face's middle, else the material's."""
    count = len(mesh.faces)
    material = getattr(mesh.visual, "material", None)
    uv = getattr(mesh.visual, "uv", None)
    image = material_image(material)
    if image is not None and uv is not None and len(uv) == len(mesh.vertices):
        pixels = np.asarray(image.convert("RGB"))
        middle = np.asarray(uv)[mesh.faces].mean(axis=1)
        middle = np.where(np.isfinite(middle), middle, 0.0) % 1.0
        column = np.minimum((middle[:, 0] * pixels.shape[1]).astype(int), pixels.shape[1] - 1)
        row = np.minimum(((1.0 - middle[:, 1]) * pixels.shape[0]).astype(int), pixels.shape[0] - 1)
        return pixels[row, column]
    diffuse = getattr(material, "diffuse", None)
    diffuse = getattr(material, "main_color", None) if diffuse is None else diffuse
    if diffuse is not None:
        return np.tile(np.asarray(diffuse, np.uint8)[:3], (count, 1))
    return np.full((count, 3), 160, np.uint8)


def read_cad(source: SourceFolder, synset: str, cad_id: str) -> CadModel:
    """Reads `cad/<synset>/<id>/models/model_normalized.obj` and turns it to z up.

    Raises:
        SceneRejected: unknown synset, absent model, or unreadable file.
    """
    if synset not in SYNSETS:
        known = ", ".join(f"{k} ({v})" for k, v in sorted(SYNSETS.items()))
        raise SceneRejected(f"{source.root}: CAD model {cad_id} has category id {synset}, expected one of {known}")
    relative = f"cad/{synset}/{cad_id}/models/model_normalized.obj"
    path = source.use(
        relative,
        f"an annotation names CAD model {cad_id} of category {synset} ({SYNSETS[synset]}); "
        "put the model there or remove the annotation",
    )
    _use_material_files(source, path)
    try:
        loaded = trimesh.load(path, process=False, force="scene")
        assert isinstance(loaded, trimesh.Scene)
        parts = [m for m in loaded.dump() if isinstance(m, trimesh.Trimesh) and len(m.faces)]
    except Exception as error:  # trimesh's loaders raise anything on a broken file
        read_obj(path)  # says more about what is wrong
        raise SceneRejected(
            f"{path}: not readable as a mesh ({type(error).__name__}: {error}); fetch the model again"
        ) from error
    if not parts:
        raise SceneRejected(f"{path}: no faces, expected a triangle mesh; fetch the model again")
    if any(np.shape(m.vertices)[1:] != (3,) or np.shape(m.faces)[1:] != (3,) for m in parts):
        raise SceneRejected(
            f"{path}: vertices without three coordinates or faces that are no triangles; fetch it again"
        )
    offsets = np.cumsum([0] + [len(m.vertices) for m in parts[:-1]])
    vertices = np.vstack([np.asarray(m.vertices, float) for m in parts])
    faces = np.vstack([np.asarray(m.faces, np.int64) + o for m, o in zip(parts, offsets, strict=True)])
    colours = np.vstack([face_colours(m) for m in parts])
    check_mesh(path, vertices, faces)
    vertices, faces, keep = merge_vertices(vertices, faces)
    vertices, faces, colours = clean_surface(source, relative, vertices, faces, colours[keep])
    return CadModel(SYNSETS[synset], cad_id, vertices @ Y_UP_TO_Z_UP.T, faces, colours.astype(np.uint8))


def clean_surface(
    source: SourceFolder, where: str, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drops faces without area and says what else is wrong; open and non-manifold surfaces are left as they are.

    Decomposition rebuilds such surfaces as closed ones (coacd's manifold preprocessing), so that they need no repair
    here; their hulls are a voxel thicker.

    Args:
        source: takes the warnings.
        where: file named in them.
        vertices: (n, 3), equal positions joined.
        faces: (m, 3).
        colours: (m, 3) of the faces.

    Raises:
        SceneRejected: nothing is left, or the model has no extent in two directions.
    """
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
    open_edges, busy_edges = edge_defects(faces)
    if busy_edges:
        source.note(
            f"{where}: is not manifold ({busy_edges} edges with three faces or more); collision uses closed hulls"
        )
    elif open_edges:
        source.note(f"{where}: is not watertight ({open_edges} open edges); collision uses closed hulls")
    return vertices, faces, colours


def edge_defects(faces: np.ndarray) -> tuple[int, int]:
    """How many edges have one face only, and how many have three or more."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    return int((count == 1).sum()), int((count > 2).sum())


def _use_material_files(source: SourceFolder, obj: Path) -> None:
    """Records the hashes of the MTL and its images; a missing one costs only colour and is a warning."""
    relative = str(obj.relative_to(source.root))
    with obj.open(encoding="utf-8", errors="replace") as lines:
        named = [line[6:].strip() for line in lines if line.startswith("mtllib")]
    for name in named:
        mtl = obj.parent / name
        if source.relative(mtl) is None or not mtl.is_file():
            source.repaired(f"{relative}: its material file '{name}' is missing; the model stays grey")
    for mtl in sorted(obj.parent.glob("*.mtl")):
        where = str(mtl.relative_to(source.root))
        text = source.use(where, "").read_text(encoding="utf-8", errors="replace")
        for _, image_name in parse_mtl(text).values():
            if not image_name:
                continue
            image = (mtl.parent / image_name.split()[-1]).resolve()
            inside = source.relative(image)
            if inside is not None and image.is_file():
                source.use(inside, "")
            else:
                source.repaired(
                    f"{where}: names the texture '{image_name}', which is missing; the material's plain colour is taken"
                )


def merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joins vertices at equal positions (to 1e-6 of the extent) and drops faces that collapse.

    Returns:
        vertices (n', 3), faces (m', 3), keep (m',) indices of the faces that stayed.
    """
    step = max(float(np.ptp(vertices, axis=0).max()), 1e-9) * 1e-6
    _, first, inverse = np.unique(
        np.round(vertices / step).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = inverse.reshape(-1)[faces]
    keep = np.flatnonzero((faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0]))
    return vertices[first], faces[keep], keep
