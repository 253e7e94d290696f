"""Propose furniture instances of a labelled scan with class, box and confidence (section III-B's region proposals).

An instance is a set of connected voxels of one class. Fragments, and objects with two labels, are merged by footprint.
Touching objects are split where their footprint has a neck or is too long for the class; tables and desks also by their
tops.
"""

import collections
import dataclasses
import json
import math
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from converters.geometry.boxes import upright_box
from converters.geometry.faces import face_labels, sample_faces
from converters.propose import pieces, retrieval
from converters.propose.pieces import Proposal, bounds
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR, SYNSETS, UNLABELLED, WALL, Annotation, CadModel, RawScene, ScanMesh
from converters.structure.clean import fit_floor
from interactive_nav_common.files import write_text
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, transform, yaw_matrix

VOXEL_M = 0.03
"""Chairs that touch at 0.05 m stay apart at 0.03 m in the sample scan."""
NO_POINTS = np.zeros((0, 3))


def _inside_range(value: float, limits: tuple[float, float]) -> float:
    """Return 1 inside the range, falling with the ratio outside: half the lower limit gives 0.5."""
    return min(1.0, value / limits[0], limits[1] / max(value, 1e-9))


def _confidence(category: str, extent: np.ndarray, purity: float, n_voxels: int, voxel_m: float) -> float:
    """Return the product of three shares: usual size for the class, agreeing labels in the box, and visible surface.

    `purity` is the class's share of the box's furniture voxels. Half of one side plus the top is enough surface.
    """
    wide, high = pieces.SIZES_M[category]
    size = _inside_range(float(max(extent[:2])), wide) * _inside_range(float(extent[2]), high)
    surface = extent[0] * extent[1] + max(extent[0], extent[1]) * extent[2]
    visible = min(1.0, n_voxels * voxel_m**2 / max(0.5 * surface, 1e-9))
    return float(size * purity * visible)


def propose_instances(scan: ScanMesh, voxel_m: float = VOXEL_M) -> tuple[Proposal, ...]:
    """Return instances of every furniture class in a scan with NYU40 labels, the most certain first."""
    points, face = sample_faces(scan.vertices, scan.faces, voxel_m / 2)
    label = face_labels(scan.labels, scan.faces)[face]
    origin = scan.vertices.min(axis=0)
    floor_xy = points[label == FLOOR, :2]
    instances: list[pieces.Piece] = []
    for wanted in pieces.LABEL_CATEGORIES:
        if (label == wanted).any():
            parts = pieces.merge(pieces.components(points[label == wanted], wanted, origin, voxel_m), pieces.stacked)
            parts = [p for p in parts if len(p.voxels) >= pieces.MIN_VOXELS]
            parts = [part for p in parts for part in pieces.split_at_necks(p)]
            parts = [part for p in parts for part in pieces.split_tops(p, floor_xy, voxel_m)]
            instances += [part for p in parts for part in pieces.split_row(p)]
    instances = pieces.merge(instances, pieces.same_box)
    other = ~np.isin(label, (UNLABELLED, WALL, 2, 22))
    other_voxels = np.unique(np.floor((points[other] - origin) / voxel_m).astype(np.int64), axis=0)
    proposals = []
    for piece in instances:
        category = pieces.LABEL_CATEGORIES[piece.label]
        box = upright_box(piece.points)
        inside = (other_voxels >= piece.voxels.min(axis=0)) & (other_voxels <= piece.voxels.max(axis=0))
        purity = min(1.0, len(piece.voxels) / max(int(inside.all(axis=1).sum()), 1))
        extent, count, yaw = 2 * box.half, len(piece.voxels), math.atan2(box.rotation[1, 0], box.rotation[0, 0])
        confidence = round(_confidence(category, extent, purity, count, voxel_m), 4)
        proposals.append(Proposal(category, piece.label, piece.points, box.centre, extent, yaw, count, confidence))
    return tuple(sorted(proposals, key=lambda p: (-p.confidence, p.centre.tolist())))


def scan2cad_model(
    category: str,
    cad_id: str,
    pose: tuple[np.ndarray, float, np.ndarray],
    vertices: np.ndarray,
    symmetry: str = "__SYM_NONE",
    pairs: tuple[np.ndarray, np.ndarray] = (NO_POINTS, NO_POINTS),
) -> dict[str, Any]:
    """Return one model of Scan2CAD's list, whose world is y up, from z-up arguments.

    `pose` is scale (3,), yaw (rad) and translation (3,) m; `vertices` (n, 3) are in the CAD frame. `pairs` are clicked
    points (k, 3) of the posed model and of the scan, m.
    """
    (scale, yaw, translation), (low, high) = pose, bounds(vertices @ Y_UP_TO_Z_UP)
    return {
        "catid_cad": next(key for key, name in SYNSETS.items() if name == category),
        "id_cad": cad_id,
        "sym": symmetry,
        "trs": {
            "scale": np.round([scale[0], scale[2], scale[1]], 6).tolist(),
            "rotation": np.round([math.cos(yaw / 2), 0.0, math.sin(yaw / 2), 0.0], 9).tolist(),
            "translation": np.round(Y_UP_TO_Z_UP.T @ translation, 6).tolist(),
        },
        "bbox": np.round((high - low) / 2, 6).tolist(),
        "center": np.round((high + low) / 2, 6).tolist(),
        **{
            f"keypoints_{side}": {"n_keypoints": len(at), "position": np.round(at @ Y_UP_TO_Z_UP, 6).ravel().tolist()}
            for side, at in zip(("cad", "scan"), pairs, strict=True)
        },
    }


def as_scan2cad(scan_id: str, proposals: tuple[Proposal, ...], chosen: dict[int, Any] | None = None) -> list[dict]:
    """Return the proposals as a Scan2CAD annotation list with one extra key, `proposal`, for the measurements.

    A proposal without a model is a unit cube with `id_cad` "", posed as its box; keypoints are empty. `chosen`:
    proposal's index -> `Retrieval` (model and pose).
    """
    models = []
    for k, proposal in enumerate(proposals):
        about: dict[str, Any] = {
            "category": proposal.category,
            "confidence": proposal.confidence,
            "label": proposal.label,
            "n_voxels": proposal.n_voxels,
            "extent_m": np.round(proposal.extent_m, 4).tolist(),
        }
        cube, pose = np.array([[-0.5], [0.5]]).repeat(3, 1), (proposal.extent_m, proposal.yaw, proposal.centre)
        entry = scan2cad_model(proposal.category, "", pose, cube)
        if (best := (chosen or {}).get(k)) is not None:
            pose = best.pose.scale, best.pose.yaw, best.pose.translation
            entry = scan2cad_model(best.cad.category, best.cad.cad_id, pose, best.cad.vertices)
            about |= {"retrieval_confidence": best.confidence, "residual_m": best.residual_m}
        models.append(entry | {"proposal": about})
    return scan2cad_list(scan_id, models)


def scan2cad_list(scan_id: str, models: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return Scan2CAD's list of one scan, whose `trs` turns its z up to the file's y."""
    half = math.sqrt(0.5)
    return [
        {
            "id_scan": scan_id,
            "trs": {"scale": [1.0, 1.0, 1.0], "rotation": [half, -half, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]},
            "n_aligned_models": len(models),
            "aligned_models": models,
        }
    ]


def floor_of(raw: RawScene) -> float:
    """Return the height of the floor in the scan frame, m."""
    given = raw.floor_height_m
    return given if given is not None else fit_floor(raw.scan.vertices, raw.scan.faces, raw.scan.labels).height_m


def retrieve_sure(
    raw: RawScene, library_root: Path | None, progress: Callable[[float], None]
) -> tuple[tuple[Proposal, ...], dict[int, retrieval.Retrieval]]:
    """Return the furniture without an annotation, and by its index the model of a library where that is sure."""
    new = propose_instances(raw.scan)
    new = tuple(new[k] for k in retrieval.without_annotation(new, raw.annotations, raw.cads))
    retrieved = retrieval.auto_align(new, retrieval.read_library(library_root), floor_of(raw), progress) if new else {}
    return new, {k: retrieved[k] for k in sorted(retrieved) if retrieved[k].confidence >= retrieval.MIN_CONFIDENCE}


def given_up(proposals: Sequence[Proposal], sure: Container[int]) -> tuple[str, ...]:
    """Return one line that counts the furniture for which no model is sure, or none."""
    counts = collections.Counter(p.category for k, p in enumerate(proposals) if k not in sure)
    listed = ", ".join(f"{count} {category}" for category, count in sorted(counts.items()))
    return (f"no sure model, so part of the structure: {listed}",) if listed else ()


def with_retrieved(raw: RawScene, library_root: Path | None, progress: Callable[[float], None]) -> RawScene:
    """Add to the annotations what `retrieve_sure` finds, and to the warnings what it gives up."""
    proposals, sure = retrieve_sure(raw, library_root, progress)
    annotations = list(raw.annotations)
    for one in sure.values():
        pose = transform(yaw_matrix(one.pose.yaw) * one.pose.scale, one.pose.translation)
        annotations.append(Annotation(one.cad.category, one.cad.cad_id, pose, confidence=one.confidence))
    return dataclasses.replace(
        raw,
        annotations=tuple(annotations),
        cads=raw.cads | {r.cad.cad_id: r.cad for r in sure.values()},
        warnings=raw.warnings + given_up(proposals, sure),
    )


def propose(
    raw: RawScene,
    target: Path,
    library: Mapping[str, CadModel] | None = None,
    report: Callable[[str, float], None] = lambda stage, share: None,
) -> tuple[tuple[Proposal, ...], dict[int, retrieval.Retrieval]]:
    """Propose instances, and by their index models of a library; write `proposals.json`, whole or not at all."""
    report("propose", 0.0)
    proposals = propose_instances(raw.scan)
    if not proposals:
        raise SceneRejected(f"{raw.name}: no furniture label in the scan, expected NYU40 ids 5, 6, 7, 8, 14 or 39")
    retrieved: dict[int, retrieval.Retrieval] = {}
    if library is not None:
        retrieved = retrieval.auto_align(
            proposals, library, floor_of(raw), lambda share: report("retrieve", 0.1 + 0.8 * share)
        )
    text = json.dumps(as_scan2cad(raw.name, proposals, retrieved), indent=1, allow_nan=False) + "\n"
    write_text(target / "proposals.json", text)
    report("write", 1.0)
    return proposals, retrieved
