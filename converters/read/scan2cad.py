"""A folder with one ScanNet scan, its labels, Scan2CAD's annotation and the CAD models in, `RawScene` out."""

import dataclasses
from pathlib import Path

import numpy as np

from converters.read.annotations import inside_scan, parse_annotations
from converters.read.cad import read_cad
from converters.read.files import SourceFolder, read_json, read_mesh, vertex_colours
from converters.read.surfaces import check_upright
from converters.records.errors import SceneRejected
from converters.records.raw import RawScene, ScanMesh
from interactive_nav_common.files import check_name

ANNOTATION = "full_annotations.json"
LICENCE = "ScanNet terms of use and ShapeNet terms of use: research only, no redistribution"


def read_scan2cad(root: Path, strict: bool = False) -> RawScene:
    """Reads `full_annotations.json`, `scan/<id>_vh_clean_2.ply`, its `.labels.ply` and `cad/`."""
    source = SourceFolder(root, strict)
    path = source.use(ANNOTATION, "expected Scan2CAD's annotation of one scan beside scan/ and cad/")
    scan_id, records = parse_annotations(read_json(path), path)
    check_name(scan_id, f"{path}: id_scan", SceneRejected)
    stem = f"scan/{scan_id}_vh_clean_2"
    mesh = read_mesh(source.use(f"{stem}.ply", f"expected ScanNet's reconstruction of {scan_id}"))
    label_path = source.use(f"{stem}.labels.ply", f"expected ScanNet's per-vertex labels of {scan_id}")
    labels = _labels(label_path)
    if len(labels) != len(mesh.vertices):
        raise SceneRejected(
            f"{label_path}: {len(labels)} labels for the {len(mesh.vertices)} vertices of {stem}.ply, "
            f"expected one "
            "a vertex; take both files from the same ScanNet release"
        )
    colours = vertex_colours(mesh)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    check_upright(f"{root / stem}.ply", vertices, faces, labels, None)
    cads = {a.cad_id: read_cad(source, synset, a.cad_id) for synset, a in records}
    annotations = inside_scan(source, ANNOTATION, tuple(a for _, a in records), cads, vertices, faces)
    scan, kept = ScanMesh(vertices, faces, labels, colours), {a.cad_id: cads[a.cad_id] for a in annotations}
    raw = source.scene("scan2cad", scan, cads=kept, annotations=annotations, licence=LICENCE)
    return dataclasses.replace(raw, name=scan_id)


def _labels(path: Path) -> np.ndarray:
    """(n,) int64 property `label` of a PLY's vertices."""
    mesh = read_mesh(path)
    try:
        raw = mesh.metadata["_ply_raw"]["vertex"]["data"]["label"]
    except (KeyError, IndexError, ValueError) as error:
        raise SceneRejected(f"{path}: its vertices have no property 'label', expected NYU40 ids") from error
    return np.asarray(raw).reshape(-1).astype(np.int64)
