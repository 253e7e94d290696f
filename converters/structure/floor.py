"""Fit the floor's plane of a labelled scan by RANSAC, and level the scan's floor."""

import dataclasses
import math

import numpy as np

from converters.geometry.faces import face_areas, face_labels
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR

LIFT_M = 0.004
"""The picture's floor lies this far above the collision plane, so that the two do not flicker into one
another."""
LEVEL_M = 0.12
"""Floor-labelled vertices within this of the floor's plane are put on the level."""
TOLERANCE_M = 0.025
"""Reconstructed floors wave by this much about their plane."""
DRAWS = 300
MAX_TILT_DEG = 5.0
MIN_LABELS = 50
GIVEN_NEAR_M = 0.3
"""A height from the source's files is this near to the floor."""


@dataclasses.dataclass(frozen=True)
class FloorFit:
    """The plane z = height + slope . (x, y - centre)."""

    centre: np.ndarray
    """(2,) middle of the floor that agrees, m."""
    height_m: float
    """Of the plane at the centre."""
    slope: np.ndarray
    """(2,) rise a metre along x and y."""
    support: float
    """Share of the floor-labelled area that lies within `TOLERANCE_M` of the plane."""

    def height_at(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) z of the plane under (n, 2+) points."""
        return self.height_m + (points[:, :2] - self.centre) @ self.slope


def fit_floor(vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray, near_m: float | None = None) -> FloorFit:
    """Fit the floor's plane by RANSAC (Fischler and Bolles 1981) over the faces labelled floor.

    A draw is three such faces' middles, drawn by area; its support is the area within `TOLERANCE_M` of the plane
    through them. Planes steeper than `MAX_TILT_DEG` are no floors. The best is refined by least squares over its
    support, twice. Mislabelled furniture, steps and reflections below the floor do not move it as they move a mean, and
    not even half of them does as it would a median. The scan is z up, its labels are NYU40's.
    """
    labelled = int((labels == FLOOR).sum())
    if labelled < MIN_LABELS:
        raise SceneRejected(
            f"scan: {labelled} vertices carry the floor label ({FLOOR}), expected at least {MIN_LABELS}; "
            "label the floor or give its height in floors.txt"
        )
    chosen = faces[face_labels(labels, faces) == FLOOR]
    weight, middle = face_areas(vertices, chosen), vertices[chosen].mean(axis=1)
    used = weight > 0
    if near_m is not None:
        used &= np.abs(middle[:, 2] - near_m) < GIVEN_NEAR_M
    weight, middle = weight[used], middle[used]
    best, best_support = None, 0.0
    rng = np.random.default_rng(0)
    if len(weight) >= 3:
        draws = rng.choice(len(weight), (DRAWS, 3), p=weight / weight.sum())
        a, b, c = (middle[draws[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        flat = np.abs(normal[:, 2]) > math.cos(math.radians(MAX_TILT_DEG)) * np.linalg.norm(normal, axis=1)
        flat &= np.abs(normal[:, 2]) > 1e-9
        for n, origin in zip(normal[flat], a[flat], strict=True):
            agree = np.abs((middle - origin) @ (n / n[2])) < TOLERANCE_M
            support = float(weight[agree].sum())
            if support > best_support:
                best, best_support = agree, support
    if best is None:
        raise SceneRejected(
            f"scan: the {labelled} vertices with the floor label lie in no plane within {MAX_TILT_DEG:g} degrees of "
            "the level; check the labels and that z is up"
        )
    for _ in range(2):
        # The plane of the least weighted vertical residual.
        points, share = middle[best], weight[best]
        centre, root = share @ points[:, :2] / share.sum(), np.sqrt(share)[:, None]
        terms = np.column_stack([np.ones(len(points)), points[:, :2] - centre])
        height, *rise = np.linalg.lstsq(terms * root, points[:, 2] * root[:, 0], rcond=None)[0]
        height, slope = float(height), np.array(rise)
        best = np.abs(middle[:, 2] - height - (middle[:, :2] - centre) @ slope) < TOLERANCE_M
    return FloorFit(centre, height, slope, float(weight[best].sum() / weight.sum()))


def level_floor(vertices_w: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return (n, 3) vertices with tilt and waves of the reconstructed floor removed: the collision floor is level.

    The floor is near z = 0; a scan without enough of it is returned as it is.
    """
    result = vertices_w.copy()
    try:
        fit = fit_floor(vertices_w, faces, labels, near_m=0.0)
    except SceneRejected:
        return result
    near = np.abs(vertices_w[:, 2] - fit.height_at(vertices_w)) < LEVEL_M
    result[(labels == FLOOR) & near, 2] = LIFT_M
    return result
