"""A raw Gibson folder with labels, alignments and a CAD library in, `RawScene` out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from converters.annotations import parse_annotations
from converters.cad import read_cad
from converters.errors import SceneRejected
from converters.files import SourceFolder, read_image, read_json, read_npz, read_textured_obj
from converters.raw import GivenMap, RawScene, ScanMesh

MESH = "mesh_z_up.obj"
MAP_RESOLUTION_M = 0.01
"""Gibson's floor maps: 0.01 m a pixel, the middle of the image at the world's origin."""


def looks_like(root: Path) -> bool:
    """True when the folder has Gibson's z-up mesh."""
    return (root / MESH).is_file()


def read_gibson(root: Path) -> RawScene:
    """Reads mesh, texture, labels, floor height, traversable map, alignments and CAD models.

    Raises:
        SceneRejected: a file is missing or damaged, counts differ, or the building has several floors.
    """
    source = SourceFolder(root)
    mesh_path = source.use(MESH, "expected Gibson's textured z-up mesh")
    vertices, faces, corner_uv = read_textured_obj(mesh_path)
    labels = _labels(source.use("mesh_z_up.labels.npz", "expected per-vertex NYU40 labels (array 'label')"))
    if len(labels) != len(vertices):
        raise SceneRejected(
            f"{root / 'mesh_z_up.labels.npz'}: {len(labels)} labels for the {len(vertices)} vertices of "
            f"{MESH}, "
            "expected one for each 'v' line; label the same mesh again"
        )
    texture = _texture(source) if corner_uv is not None else None
    colours = None if texture is not None else np.full((len(vertices), 3), 170, np.uint8)
    alignment_path = source.use("alignments.json", "expected the furniture's alignments in Scan2CAD's layout")
    _, records = parse_annotations(read_json(alignment_path), alignment_path)
    cads = {a.cad_id: read_cad(source, synset, a.cad_id) for synset, a in records}
    licence = "unknown: the source folder has no LICENCE file"
    if source.has("LICENCE"):
        text = source.use("LICENCE", "").read_text(encoding="utf-8", errors="replace").strip()
        licence = " ".join(text.split())[:400] or licence
    return RawScene(
        name=root.resolve().name,
        source_format="gibson",
        scan=ScanMesh(vertices, faces, labels, colours, corner_uv if texture is not None else None, texture),
        cads=cads,
        annotations=tuple(a for _, a in records),
        floor_height_m=_floor_height(source),
        given_map=_traversable(source),
        licence=licence,
        sources=dict(sorted(source.sha256.items())),
    )


def _labels(path: Path) -> np.ndarray:
    labels = read_npz(path, "label", "expected an NPZ with the array 'label' of NYU40 ids")
    if labels.dtype.kind not in "iu":
        raise SceneRejected(f"{path}: labels are {labels.dtype}, expected whole NYU40 ids")
    return labels.reshape(-1).astype(np.int64)


def _texture(source: SourceFolder) -> np.ndarray:
    """(h, w, 3) uint8 image that the mesh's MTL names."""
    mtl = source.use("mesh_z_up.mtl", "expected the material file of the textured mesh")
    images = [
        line.split(maxsplit=1)[1].strip()
        for line in mtl.read_text(encoding="utf-8", errors="replace").splitlines()
        if line.strip().lower().startswith("map_kd ")
    ]
    if len(images) != 1:
        raise SceneRejected(f"{mtl}: names {len(images)} textures (map_Kd), expected exactly one")
    return read_image(source.use(images[0], f"{mtl.name} names it as the mesh's texture"), "RGB")


def _floor_height(source: SourceFolder) -> float:
    path = source.use("floors.txt", "expected one floor height in metres a line")
    words = path.read_text(encoding="utf-8", errors="replace").split()
    try:
        heights = [float(word) for word in words]
    except ValueError as error:
        raise SceneRejected(f"{path}: {error}; expected one floor height in metres a line") from error
    if len(heights) != 1 or not np.isfinite(heights[0]):
        raise SceneRejected(
            f"{path}: holds {len(heights)} floor heights, expected one; convert each floor from a folder of its own"
        )
    return heights[0]


def _traversable(source: SourceFolder) -> GivenMap | None:
    """The scan's own traversable map; absent maps are computed from the mesh alone."""
    if not source.has("floor_trav_0.png"):
        return None
    image = read_image(source.use("floor_trav_0.png", ""), "L")
    if image.shape[0] != image.shape[1]:
        raise SceneRejected(
            f"{source.root / 'floor_trav_0.png'}: is {image.shape[1]} x {image.shape[0]}, expected a square image"
        )
    half = image.shape[0] / 2 * MAP_RESOLUTION_M
    return GivenMap(image > 127, MAP_RESOLUTION_M, (-half, -half))
