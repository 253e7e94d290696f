"""Read a ScanNet scan with Scan2CAD's annotation, and the same list as Gibson's `alignments.json`.

Frames of the file (Avetisyan et al. 2019): the annotation world is y up; the scan's `trs` leads scan -> world, each
model's `trs` CAD -> world, and both keypoint sets are in that world (the CAD's after its `trs`).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from converters.geometry.boxes import convex_pieces
from converters.geometry.faces import compacted
from converters.read.files import SourceFolder, read_json, read_mesh, read_obj
from converters.read.meshes import clean_surface
from converters.read.obj import GREY, TexturedMesh, join_textures, read_painted_obj, texels
from converters.read.surfaces import check_upright
from converters.records.errors import SceneRejected
from converters.records.raw import UP, Annotation, CadModel, RawScene, ScanMesh, ScannedHinge, category_of_id
from interactive_nav_common.files import check_name
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, transform, transformed

ANNOTATION = "full_annotations.json"
LICENCE = "ScanNet terms of use and ShapeNet terms of use: research only, no redistribution"
COLLISION = "collision.obj"
"""Beside a model: its collision mesh, made of convex pieces that share no vertex."""
MOST_PIECES = 10
"""Convex pieces of a model that has a `collision.obj`."""
SLACK = 0.007
"""Share of the model's bounding box that joining two of them may add: slats become a back, legs stay legs."""
OUTSIDE_M = 0.5
"""An object this far from everything scanned stands outside the scan."""
TURNS = 20


def trs_matrix(trs: dict[str, Any]) -> np.ndarray:
    """Return the (4, 4) matrix that scales, then turns (quaternion w x y z), then moves."""
    w, x, y, z = (float(v) for v in trs["rotation"])
    turn = Rotation.from_quat([x, y, z, w]).as_matrix() * np.asarray(trs["scale"], float)
    matrix = transform(turn, np.asarray(trs["translation"], float))
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > 1e6:
        raise ValueError(f"the transform {trs} is not made of usable numbers")
    return matrix


def _keypoints(model: dict[str, Any], key: str) -> np.ndarray:
    flat = np.asarray(model.get(key, {}).get("position", []), float)
    if not np.isfinite(flat).all():
        raise ValueError(f"{key} has positions that are not finite numbers")
    return flat.reshape(-1, 3)


def _hinge(model: dict[str, Any], category: str, where: str) -> ScannedHinge | None:
    raw = model.get("articulation")
    if raw is None:
        return None
    if raw.get("type") not in ("hinge", "slide"):
        raise SceneRejected(f"{where}: articulation type is {raw.get('type')!r}, expected 'hinge' or 'slide'")
    slides, axis = raw["type"] == "slide", Y_UP_TO_Z_UP @ np.asarray(raw["axis"], float)
    low, high = sorted(float(v) for v in raw["range_m" if slides else "range_rad"])
    origin = Y_UP_TO_Z_UP @ np.asarray(raw["origin"], float)
    if not np.isfinite([low, high, *origin, *axis]).all() or not axis.any():
        raise SceneRejected(f"{where}: the articulation has numbers that are not finite, or no axis")
    if category == "door":
        if slides or not abs(axis[2]) >= 0.9 * np.linalg.norm(axis):
            raise SceneRejected(f"{where}: a door's axis is {raw['axis']}, expected the vertical (0, 1, 0) of a hinge")
        axis = np.sign(axis[2]) * UP
    return ScannedHinge(origin, axis / np.linalg.norm(axis), (low, high), slides=slides)


def parse_annotations(data: Any, path: Path) -> tuple[str, tuple[tuple[str, Annotation], ...]]:
    """Return the scan id of a decoded list of one scan, and for each object its synset id and annotation."""
    if not isinstance(data, list) or len(data) != 1:
        got = f"a list of {len(data)}" if isinstance(data, list) else type(data).__name__
        raise SceneRejected(f"{path}: got {got}, expected a list with the annotation of one scan; cut it to one scan")
    records = []
    where = str(path)
    try:
        scan_to_world = trs_matrix(data[0]["trs"])
        world_to_scan = np.linalg.inv(scan_to_world)
        cad_to_y_up = transform(Y_UP_TO_Z_UP.T)
        for i, model in enumerate(data[0]["aligned_models"]):
            where = f"{path}: aligned_models[{i}]"
            synset, cad_id = str(model["catid_cad"]), str(model["id_cad"])
            category = category_of_id(synset, f"{where}: category id is")
            check_name(cad_id, f"{where}: id_cad", SceneRejected)
            pose_y_up = trs_matrix(model["trs"])
            if abs(np.linalg.det(pose_y_up)) < 1e-9:
                raise SceneRejected(f"{where}: the scale is {model['trs']['scale']}, expected three non-zero numbers")
            pose = world_to_scan @ pose_y_up @ cad_to_y_up
            cad_points = transformed(_keypoints(model, "keypoints_cad"), np.linalg.inv(pose_y_up @ cad_to_y_up))
            scan_points = transformed(_keypoints(model, "keypoints_scan"), world_to_scan)
            count = min(len(cad_points), len(scan_points))
            confidence = model.get("proposal", {}).get("retrieval_confidence")
            if confidence is not None and not 0 <= float(confidence) <= 1:
                raise ValueError(f"retrieval_confidence is {confidence}, not in [0, 1]")
            annotation = Annotation(
                category=category,
                cad_id=cad_id,
                pose=pose,
                symmetry=str(model.get("sym", "__SYM_NONE")),
                keypoints_cad=cad_points[:count],
                keypoints_scan=scan_points[:count],
                hinge=_hinge(model, category, where),
                confidence=None if confidence is None else float(confidence),
            )
            records.append((synset, annotation))
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        what = f"missing key {error}" if isinstance(error, KeyError) else str(error)
        raise SceneRejected(f"{where}: {what}; expected Scan2CAD's annotation layout") from error
    return str(data[0].get("id_scan", path.parent.name)), tuple(records)


def gap_to_scan(annotation: Annotation, cad_vertices: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the distance from an object's upright bounding box to the scan's surface, m; 0 if they intersect.

    Alternating projections between box and triangle, both convex, converge to their nearest points.
    """
    placed = transformed(cad_vertices, annotation.pose)
    low, high = placed.min(axis=0), placed.max(axis=0)
    gap = float(np.linalg.norm(vertices - vertices.clip(low, high), axis=1).min())
    if gap <= OUTSIDE_M:
        return gap
    corners = vertices[faces]
    base, top = corners.min(axis=1), corners.max(axis=1)
    corners = corners[np.linalg.norm(np.maximum(np.maximum(low - top, base - high), 0.0), axis=1) < gap]
    point = np.tile((low + high) / 2, (len(corners), 1))
    for _ in range(TURNS if len(corners) else 0):
        on = trimesh.triangles.closest_point(corners, point)
        point = on.clip(low, high)
        gap = min(gap, float(np.linalg.norm(on - point, axis=1).min()))
    return gap


def inside_scan(
    source: SourceFolder, where: str, annotations: tuple[Annotation, ...], cads: Mapping[str, CadModel], scan: Any
) -> tuple[tuple[Annotation, ...], dict[str, CadModel]]:
    """Return the annotations whose objects stand in the scan, and their models; warn of each that is left out."""
    gaps = [gap_to_scan(a, cads[a.cad_id].vertices, scan.vertices, scan.faces) for a in annotations]
    outside = [i for i, gap in enumerate(gaps) if gap > OUTSIDE_M]
    if 2 * len(outside) > len(annotations):
        raise SceneRejected(
            f"{source.root / where}: {len(outside)} of {len(annotations)} objects lie outside the scan (the first by "
            f"{gaps[outside[0]]:.1f} m); the annotation belongs to another scan, or its `trs` is wrong"
        )
    for i in outside:
        source.repaired(
            f"{where}: object {i} ({annotations[i].category}, {annotations[i].cad_id}) lies {gaps[i]:.1f} m outside "
            "the scan; it is left out"
        )
    kept = tuple(a for i, a in enumerate(annotations) if i not in outside)
    return kept, {a.cad_id: cads[a.cad_id] for a in kept}


def read_cad(source: SourceFolder, synset: str, cad_id: str) -> CadModel:
    """Read a normalised ShapeNet OBJ, turned to z up, with the convex pieces of a `collision.obj` beside it."""
    category = category_of_id(synset, f"{source.root}: CAD model {cad_id} has category id")
    relative = f"cad/{synset}/{cad_id}/models/model_normalized.obj"
    mesh, image, images = read_painted_obj(
        source,
        relative,
        f"an annotation names CAD model {cad_id} of category {synset} ({category}); "
        "put the model there or remove the annotation",
    )
    colours = np.full((len(mesh.faces), 3), GREY, np.uint8)
    uv = np.zeros((len(mesh.faces), 3, 2)) if mesh.corner_uv is None else mesh.corner_uv
    for k, texture in enumerate(images):
        colours[image == k] = texels(texture, uv[image == k].mean(axis=1))
    # By material, the last first: decompositions depend on the order of the faces, and stored ones have this.
    order = np.argsort(-image, kind="stable")
    skin = TexturedMesh(*compacted(mesh.vertices, mesh.faces[order]))
    vertices, faces, colours = clean_surface(source, relative, skin, colours[order])
    pieces, collision = None, f"cad/{synset}/{cad_id}/models/{COLLISION}"
    if source.has(collision):
        hard = read_obj(source.use(collision, ""))
        pieces = convex_pieces(hard.vertices @ Y_UP_TO_Z_UP.T, hard.faces, MOST_PIECES, SLACK)
        if pieces is None:
            source.repaired(f"{collision}: has a piece that is not convex; the model is decomposed")
    surface = None
    if images:
        surface = TexturedMesh(mesh.vertices @ Y_UP_TO_Z_UP.T, mesh.faces, *join_textures(uv, image, images))
    turned = vertices @ Y_UP_TO_Z_UP.T
    return CadModel(category, cad_id, turned, faces, colours, pieces, surface=surface)


def read_scan2cad(root: Path, strict: bool = False) -> RawScene:
    """Read `full_annotations.json`, `scan/<id>_vh_clean_2.ply`, its `.labels.ply` and `cad/`."""
    source = SourceFolder(root, strict)
    path = source.use(ANNOTATION, "expected Scan2CAD's annotation of one scan beside scan/ and cad/")
    scan_id, records = parse_annotations(read_json(path), path)
    check_name(scan_id, f"{path}: id_scan", SceneRejected)
    stem = f"scan/{scan_id}_vh_clean_2"
    mesh = read_mesh(source.use(f"{stem}.ply", f"expected ScanNet's reconstruction of {scan_id}"))
    label_path = source.use(f"{stem}.labels.ply", f"expected ScanNet's per-vertex labels of {scan_id}")
    try:
        labels = read_mesh(label_path).metadata["_ply_raw"]["vertex"]["data"]["label"]
    except (KeyError, IndexError, ValueError) as error:
        raise SceneRejected(f"{label_path}: its vertices have no property 'label', expected NYU40 ids") from error
    labels = np.asarray(labels).reshape(-1).astype(np.int64)
    if len(labels) != len(mesh.vertices):
        raise SceneRejected(
            f"{label_path}: {len(labels)} labels for the {len(mesh.vertices)} vertices of {stem}.ply, expected one a "
            "vertex; take both files from the same ScanNet release"
        )
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    colours = np.full((len(vertices), 3), 170, np.uint8)
    painted = getattr(mesh.visual, "vertex_colors", None)
    if painted is not None and len(painted) == len(vertices):
        colours = np.asarray(painted, np.uint8)[:, :3]
    check_upright(f"{root / stem}.ply", vertices, faces, labels, 0.0)
    cads = {a.cad_id: read_cad(source, synset, a.cad_id) for synset, a in records}
    scan = ScanMesh(vertices, faces, labels=labels, vertex_colours=colours)
    annotations, cads = inside_scan(source, ANNOTATION, tuple(a for _, a in records), cads, scan)
    return source.scene("scan2cad", scan, name=scan_id, cads=cads, annotations=annotations, licence=LICENCE)
