"""Keypoint pairs and annotated poses in, upright placements and their residuals out.

The seven free parameters (three scales, three translations, yaw; roll and pitch fixed) are those of the
original annotation (Interactive Gibson, section III-B).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from converters.raw import Annotation

MIN_POINTS = 4
"""Four pairs give twelve equations for the seven unknowns and still leave a residual on every axis."""


class AlignmentError(ValueError):
    """Keypoints that do not determine the seven parameters; the message says why."""


@dataclasses.dataclass(frozen=True)
class Alignment:
    """CAD frame (z up) -> scan frame: `Rz(yaw) @ diag(scale) @ p + translation`."""

    scale: np.ndarray
    """(3,) along the CAD model's own axes."""
    translation: np.ndarray
    """(3,) m."""
    yaw: float
    """rad, counter-clockwise seen from above."""
    rms_m: float
    """Root mean square point-to-point distance of the fit; nan where nothing was fitted."""


def yaw_matrix(yaw: float) -> np.ndarray:
    """(3, 3) rotation about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wrap_angle(angle: float, period: float = 2 * math.pi) -> float:
    """The angle's representative in [-period/2, period/2)."""
    return (angle + period / 2) % period - period / 2


def solve_alignment(cad_points: np.ndarray, scan_points: np.ndarray) -> Alignment:
    """Least squares over point-to-point distances, in closed form where all scales come out positive.

    For a fixed yaw the best scales are one-dimensional regressions, and the explained variance left as a
    function of (cos, sin) is a quadratic form: its leading eigenvector is the yaw. A mirrored optimum (a
    negative scale) is refused; the best yaw with positive scales is then searched for.

    Args:
        cad_points: (k, 3) in a z-up CAD frame, unscaled.
        scan_points: (k, 3) in the scan frame, m, row by row the same physical points.

    Raises:
        AlignmentError: fewer than four pairs, or no extent along an axis of the CAD model.
    """
    p, q = np.asarray(cad_points, float), np.asarray(scan_points, float)
    if p.shape != q.shape or p.ndim != 2 or p.shape[1] != 3:
        raise AlignmentError(f"keypoints have shapes {p.shape} and {q.shape}, expected two equal (k, 3) arrays")
    if len(p) < MIN_POINTS:
        raise AlignmentError(f"{len(p)} keypoint pairs, expected at least {MIN_POINTS}")
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    pc, qc = p - p_mean, q - q_mean
    power = (pc**2).sum(axis=0)
    flat = np.flatnonzero(power < 1e-8 * max(power.max(), 1e-12))
    if len(flat):
        raise AlignmentError(
            f"the keypoints have no extent along the model's {'xyz'[flat[0]]} axis: scale unobservable"
        )
    a, b = qc[:, 0] @ pc[:, 0], qc[:, 1] @ pc[:, 0]
    d, e = qc[:, 0] @ pc[:, 1], qc[:, 1] @ pc[:, 1]
    form = np.array(
        [
            [a * a / power[0] + e * e / power[1], a * b / power[0] - d * e / power[1]],
            [a * b / power[0] - d * e / power[1], b * b / power[0] + d * d / power[1]],
        ]
    )
    c, s = np.linalg.eigh(form)[1][:, -1]
    if c * a + s * b < 0:
        c, s = -c, -s
    yaw = math.atan2(s, c)
    if c * a + s * b <= 0 or c * e - s * d <= 0:
        yaw = _best_positive_yaw(a, b, d, e, power)
    c, s = math.cos(yaw), math.sin(yaw)
    scale = np.array([(c * a + s * b) / power[0], (c * e - s * d) / power[1], (qc[:, 2] @ pc[:, 2]) / power[2]])
    if (scale <= 0).any():
        raise AlignmentError("the best fit mirrors the model: the keypoint pairs contradict each other")
    turn = yaw_matrix(yaw)
    translation = q_mean - turn @ (scale * p_mean)
    residual = p * scale @ turn.T + translation - q
    return Alignment(scale, translation, yaw, float(np.sqrt((residual**2).sum(axis=1).mean())))


def _best_positive_yaw(a: float, b: float, d: float, e: float, power: np.ndarray) -> float:
    """Yaw of least residual among those with two positive horizontal scales."""

    def unexplained(yaw: float) -> float:
        c, s = math.cos(yaw), math.sin(yaw)
        return -(max(c * a + s * b, 0.0) ** 2 / power[0] + max(c * e - s * d, 0.0) ** 2 / power[1])

    step = math.radians(1.0)
    start = min(np.arange(-math.pi, math.pi, step), key=unexplained)
    found = minimize_scalar(unexplained, bounds=(start - step, start + step), method="bounded")
    return wrap_angle(float(getattr(found, "x")))  # noqa: B009 (scipy's result has no static fields)


def upright(pose: np.ndarray, pivot_cad: np.ndarray) -> tuple[Alignment, float]:
    """Takes the small roll and pitch out of an annotated pose, turning about the object's own middle.

    Args:
        pose: (4, 4) CAD frame -> scan frame, with scale.
        pivot_cad: (3,) point of the CAD frame that keeps its place (the middle of the bounding box).

    Returns:
        The upright pose (`rms_m` is nan: nothing was fitted) and the tilt that was removed, rad.
    """
    scale = np.linalg.norm(pose[:3, :3], axis=0)
    turn = pose[:3, :3] / scale
    yaw = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    place = pose[:3, :3] @ pivot_cad + pose[:3, 3]
    translation = place - yaw_matrix(yaw) @ (scale * pivot_cad)
    tilt = math.acos(float(np.clip(turn[2, 2], -1.0, 1.0)))
    return Alignment(scale, translation, yaw, math.nan), tilt


SYMMETRY_PERIOD_RAD = {
    "__SYM_NONE": 2 * math.pi,
    "__SYM_ROTATE_UP_2": math.pi,
    "__SYM_ROTATE_UP_4": math.pi / 2,
    "__SYM_ROTATE_UP_INF": 0.0,
}


def compare(
    annotation: Annotation, placed: Alignment, tilt_rad: float, pivot_cad: np.ndarray, name: str
) -> dict[str, Any]:
    """One row of the alignment report: residual of the annotated pose, and the re-solved pose beside it.

    Args:
        annotation: with its keypoints.
        placed: the annotated pose, upright: the one that the scene uses.
        tilt_rad: what `upright` removed.
        pivot_cad: (3,) where the two poses' translations are compared.
        name: body name.
    """
    row: dict[str, Any] = {
        "name": name,
        "cad_id": annotation.cad_id,
        "n_keypoints": len(annotation.keypoints_cad),
        "symmetry": annotation.symmetry,
        "tilt_removed_deg": round(math.degrees(tilt_rad), 3),
    }
    if len(annotation.keypoints_cad):
        at = annotation.keypoints_cad @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]
        distance2 = ((at - annotation.keypoints_scan) ** 2).sum(axis=1)
        row["annotated_rms_m"] = round(float(np.sqrt(distance2.mean())), 5)
    try:
        solved = solve_alignment(annotation.keypoints_cad, annotation.keypoints_scan)
    except AlignmentError as error:
        return row | {"solved": False, "reason": str(error)}
    middle_placed = yaw_matrix(placed.yaw) @ (placed.scale * pivot_cad) + placed.translation
    middle_solved = yaw_matrix(solved.yaw) @ (solved.scale * pivot_cad) + solved.translation
    period = SYMMETRY_PERIOD_RAD.get(annotation.symmetry, 2 * math.pi)
    yaw_difference = abs(wrap_angle(solved.yaw - placed.yaw, period)) if period else 0.0
    return row | {
        "solved": True,
        "rms_m": round(solved.rms_m, 5),
        "translation_difference_m": round(float(np.linalg.norm(middle_solved - middle_placed)), 5),
        "yaw_difference_deg": round(math.degrees(yaw_difference), 3),
        "scale_ratio": [round(float(v), 4) for v in solved.scale / placed.scale],
    }
