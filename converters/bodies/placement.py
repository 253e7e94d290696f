"""Place annotated objects upright, and compare their poses with the re-solved ones."""

import dataclasses
import math
from typing import Any

import numpy as np

from converters.bodies import alignment
from converters.bodies.objects import name_objects
from converters.records.raw import Annotation, RawScene
from interactive_nav_common.rotations import transformed, wrap_angle, yaw_matrix

LYING_DEG = 15.0
"""Annotated tilt from which a scene's report says that the object was stood upright."""


def upright(pose: np.ndarray, pivot_cad: np.ndarray) -> tuple[alignment.Alignment, float]:
    """Take the small roll and pitch out of an annotated pose, turning about the object's middle.

    `pose`: (4, 4) CAD frame -> scan frame, with scale.
    `pivot_cad`: (3,) point of the CAD frame that keeps its place (the middle of the bounding box).
    Returns the upright pose (`rms_m` is nan: nothing was fitted) and the tilt that was removed, rad.
    """
    scale = np.linalg.norm(pose[:3, :3], axis=0)
    turn = pose[:3, :3] / scale
    yaw = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    place = pose[:3, :3] @ pivot_cad + pose[:3, 3]
    translation = place - yaw_matrix(yaw) @ (scale * pivot_cad)
    tilt = math.acos(float(np.clip(turn[2, 2], -1.0, 1.0)))
    return alignment.Alignment(scale, translation, yaw, math.nan), tilt


def compare(
    annotation: Annotation, placed: alignment.Alignment, tilt_rad: float, pivot_cad: np.ndarray, name: str
) -> dict[str, Any]:
    """Return one row of the alignment report: residual of the annotated pose, and the re-solved pose beside it.

    `pivot_cad`: (3,) where the two poses' translations are compared.
    """
    row: dict[str, Any] = {
        "name": name,
        "cad_id": annotation.cad_id,
        "n_keypoints": len(annotation.keypoints_cad),
        "symmetry": annotation.symmetry,
        "tilt_removed_deg": round(math.degrees(tilt_rad), 3),
    }
    if annotation.confidence is not None:
        row["retrieved_confidence"] = annotation.confidence
    if tilt_rad > math.radians(LYING_DEG):
        degrees = math.degrees(tilt_rad)
        row["note"] = f"annotated {degrees:.0f} degrees off the vertical; placed upright, yaw is the only rotation"
    if len(annotation.keypoints_cad):
        at = transformed(annotation.keypoints_cad, annotation.pose)
        distance2 = ((at - annotation.keypoints_scan) ** 2).sum(axis=1)
        row["annotated_rms_m"] = round(float(np.sqrt(distance2.mean())), 5)
    try:
        solved = alignment.solve_alignment(annotation.keypoints_cad, annotation.keypoints_scan, annotation.symmetry)
        outliers = alignment.gross_outliers(annotation.keypoints_cad, annotation.keypoints_scan, annotation.symmetry)
    except alignment.AlignmentError as error:
        return row | {"solved": False, "reason": str(error)}
    difference = pose_difference(solved, placed, pivot_cad, annotation.symmetry)
    return row | {
        "solved": True,
        "n_outliers": int(outliers.sum()),
        "rms_m": round(solved.rms_m, 5),
        "translation_difference_m": round(difference.translation_m, 5),
        "yaw_difference_deg": round(math.degrees(difference.yaw_rad), 3),
        "scale_ratio": [round(float(v), 4) for v in difference.scale_ratio],
    }


@dataclasses.dataclass(frozen=True)
class PoseDifference:
    """Distance of one pose of a model from another, modulo the model's symmetry."""

    translation_m: float
    yaw_rad: float
    """In [0, pi]."""
    scale_ratio: np.ndarray
    """(3,) first / second along the second's axes."""


def pose_difference(
    one: alignment.Alignment, other: alignment.Alignment, pivot_cad: np.ndarray, symmetry: str
) -> PoseDifference:
    """Compare two poses of the same model at the pivot; turns that the symmetry allows do not count.

    `pivot_cad`: (3,) point of the CAD frame where translations are compared.
    `symmetry`: Scan2CAD's word; unknown words count as none.
    """
    period = alignment.SYMMETRY_PERIOD_RAD.get(symmetry, 2 * math.pi)
    at = [alignment.apply_alignment(a, pivot_cad[None])[0] for a in (one, other)]
    turn = wrap_angle(one.yaw - other.yaw)
    yaw = wrap_angle(turn, period) if period else 0.0
    swapped = period and round((turn - yaw) / (math.pi / 2)) % 2
    scale = one.scale[[1, 0, 2]] if swapped else one.scale
    return PoseDifference(float(np.linalg.norm(at[0] - at[1])), abs(yaw), scale / other.scale)


def align_objects(raw: RawScene) -> tuple[list[alignment.Alignment], list[dict[str, Any]]]:
    """Return upright placements from the annotations, and the report that compares them with re-solved ones."""
    placements, rows = [], []
    for name, annotation in zip(name_objects(raw.annotations), raw.annotations, strict=True):
        vertices = raw.cads[annotation.cad_id].vertices
        pivot = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        placed, tilt = upright(annotation.pose, pivot)
        placements.append(placed)
        rows.append(compare(annotation, placed, tilt, pivot, name))
    return placements, rows
