"""Find furniture instances with class, box and confidence in a labelled scan (section III-B's region proposals).

The labels are put into a voxel grid; connected voxels of one class are an instance. What a scan tears apart
(the seat of a swivel chair above its base: the thin column is missing) or names twice (table and desk) is
merged by footprint. Things of one class that touch are split where their common footprint has a neck, and where it is
too long for one of its class; tables and desks also where two tops meet in a step, or make an outline that two
rectangles have and one has not.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from converters.geometry.boxes import upright_box
from converters.geometry.faces import face_labels, sample_faces
from converters.propose import pieces
from converters.records.raw import FLOOR, SYNSETS, UNLABELLED, WALL, ScanMesh
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, yaw_matrix

VOXEL_M = 0.03
"""Chairs that touch at 0.05 m stay apart at 0.03 m in the sample scan."""
NO_POINTS = np.zeros((0, 3))


@dataclasses.dataclass(frozen=True)
class Proposal:
    """One instance that an annotator, or retrieval, should find a CAD model for."""

    category: str
    label: int
    """NYU40 id that most of its voxels carry."""
    points: np.ndarray
    """(n, 3) samples of its surface, scan frame, m."""
    centre: np.ndarray
    """(3,) of the upright box, scan frame, m."""
    extent_m: np.ndarray
    """(3,) full sizes along the box's axes."""
    yaw: float
    """rad, of the box's x axis; modulo 90 degrees."""
    n_voxels: int
    confidence: float
    """In [0, 1], see `_confidence`."""


def _inside_range(value: float, limits: tuple[float, float]) -> float:
    """Return 1 inside the range, falling with the ratio outside: half the lower limit gives 0.5."""
    return min(1.0, value / limits[0], limits[1] / max(value, 1e-9))


def _confidence(category: str, extent: np.ndarray, purity: float, n_voxels: int, voxel_m: float) -> float:
    """Return the product of three shares: usual size for the class, labels in the box that agree, and visible surface.

    `purity` is the class's share of the box's furniture voxels. Surface counts as enough when the voxels cover
    half of one side and the top of the box.
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
            parts = [part for p in parts for part in pieces.split_at_necks(p, origin, voxel_m)]
            parts = [part for p in parts for part in pieces.split_tops(p, floor_xy, origin, voxel_m)]
            instances += [part for p in parts for part in pieces.split_row(p, origin, voxel_m)]
    instances = pieces.merge(instances, pieces.same_box)
    other = ~np.isin(label, (UNLABELLED, WALL, 2, 22))
    other_voxels = np.unique(np.floor((points[other] - origin) / voxel_m).astype(np.int64), axis=0)
    proposals = []
    for piece in instances:
        category = pieces.LABEL_CATEGORIES[piece.label]
        box = upright_box(piece.points)
        inside = (other_voxels >= piece.voxels.min(axis=0)) & (other_voxels <= piece.voxels.max(axis=0))
        purity = min(1.0, len(piece.voxels) / max(int(inside.all(axis=1).sum()), 1))
        extent = 2 * box.half
        yaw = math.atan2(box.rotation[1, 0], box.rotation[0, 0])
        confidence = _confidence(category, extent, purity, len(piece.voxels), voxel_m)
        proposals.append(
            Proposal(
                category, piece.label, piece.points, box.centre, extent, yaw, len(piece.voxels), round(confidence, 4)
            )
        )
    return tuple(sorted(proposals, key=lambda p: (-p.confidence, p.centre.tolist())))


def box_iou(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the intersection over union of two axis-aligned boxes, each (low (3,), high (3,))."""
    shared = np.prod(np.maximum(np.minimum(one[1], other[1]) - np.maximum(one[0], other[0]), 0.0))
    total = np.prod(one[1] - one[0]) + np.prod(other[1] - other[0]) - shared
    return float(shared / total) if total > 0 else 0.0


def bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (low (3,), high (3,)) of (n, 3) points."""
    return points.min(axis=0), points.max(axis=0)


def scan2cad_model(
    category: str,
    cad_id: str,
    pose: tuple[np.ndarray, float, np.ndarray],
    vertices: np.ndarray,
    symmetry: str = "__SYM_NONE",
    pairs: tuple[np.ndarray, np.ndarray] = (NO_POINTS, NO_POINTS),
) -> dict[str, Any]:
    """Return one model of Scan2CAD's list, whose world is y up; arguments are z up.

    `pose`: scale (3,), yaw (rad) and translation (3,) m of the upright model.
    `vertices`: (n, 3) of the model, CAD frame.
    `symmetry`: Scan2CAD's word.
    `pairs`: (k, 3) points of the model under its pose and of the scan, m, that were clicked.
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
    """Return the proposals in the shape of Scan2CAD's annotation list, for an annotation tool to take further.

    A proposal without a model is a unit cube with `id_cad` "" and the box as its pose; keypoints are empty. Each
    has one key more, `proposal`, with what was measured. `chosen`: proposal's index -> `Retrieval` (model and pose).
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


def box_corners(proposal: Proposal) -> np.ndarray:
    """Return (4, 2) corners of the box from above, counter-clockwise, m."""
    half = proposal.extent_m[:2] / 2
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    return square @ yaw_matrix(proposal.yaw)[:2, :2].T + proposal.centre[:2]
