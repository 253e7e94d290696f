"""Level the floor of a labelled scan, and cut out the furniture that placed objects replace."""

import dataclasses
import math

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, KDTree

from converters.bodies.objects import PlacedObject, to_world
from converters.geometry.boxes import Hull
from converters.geometry.faces import face_areas, face_labels, loose_parts
from converters.records.errors import SceneRejected
from converters.records.raw import CATEGORY_LABELS, FLOOR, SMALL_LABELS, STRUCTURE_LABELS
from interactive_nav_common.rotations import matrix_from_quat

LIFT_M = 0.004
"""The picture's floor lies this far above the collision plane, so that the two do not flicker."""
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

    def height_at(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) z of the plane under (n, 2+) points."""
        return self.height_m + (points[:, :2] - self.centre) @ self.slope


def fit_floor(vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray, near_m: float | None = None) -> FloorFit:
    """Fit the floor's plane by RANSAC (Fischler and Bolles 1981) over the faces labelled floor.

    A draw is three such faces' middles, by area; its support is the area within `TOLERANCE_M`. Planes steeper than
    `MAX_TILT_DEG` are rejected. Least squares over the support refines the best one twice. Unlike a mean or median, it
    tolerates mislabelled furniture, steps and reflections below the floor. The scan is z up, with NYU40 labels.
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
    return FloorFit(centre, height, slope)


def level_floor(vertices_w: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return vertices (n, 3) without the tilt and waves of the floor near z = 0; unchanged if too little is visible."""
    result = vertices_w.copy()
    try:
        fit = fit_floor(vertices_w, faces, labels, near_m=0.0)
    except SceneRejected:
        return result
    near = np.abs(vertices_w[:, 2] - fit.height_at(vertices_w)) < LEVEL_M
    result[(labels == FLOOR) & near, 2] = LIFT_M
    return result


NEAR_LABEL_M = 0.15
"""Faces of an object's label this close to the model are the object's: alignments are off by several centimetres."""
NEAR_OTHER_M = 0.04
"""Any furniture face this close is the object's, whatever its label."""
LYING_ABOVE_M = 0.30
"""Small objects (bags, pillows) on another go with it up to this height above it."""
FLOOR_CLEARANCE_M = 0.10
"""A floor label higher than this is a mislabelled leg."""
DEBRIS_AREA_M2 = 0.02
"""A cut leaves pieces smaller than this hanging; they go too."""
INSTANCE_SHARE = 0.6
"""When this share of a connected same-label piece is cut, the rest of the piece is too."""


@dataclasses.dataclass(frozen=True)
class CutResult:
    """Outcome of the cut."""

    keep: np.ndarray
    """(m,) bool, faces of the scan that stay."""
    owner: np.ndarray
    """(m,) int64, index of the object that a removed face belonged to, -1 elsewhere."""


def depth_in_hulls(points: np.ndarray, hulls: tuple[Hull, ...]) -> np.ndarray:
    """Return (n,) signed distance-like values: negative inside a hull (largest plane value, least over hulls), m."""
    sides = (ConvexHull(hull.vertices).equations for hull in hulls)
    return np.min([(points @ side[:, :3].T + side[:, 3]).max(axis=1) for side in sides], axis=0)


def _faces_of(centres: np.ndarray, labels: np.ndarray, placed: PlacedObject) -> np.ndarray:
    """Return (m,) bool: faces that show this object, by place and label."""
    local = (centres - placed.position_w) @ matrix_from_quat(placed.quaternion_w)
    low, high = placed.vertices_b.min(axis=0), placed.vertices_b.max(axis=0)
    around = ((local > low - NEAR_LABEL_M) & (local < high + [NEAR_LABEL_M, NEAR_LABEL_M, LYING_ABOVE_M])).all(axis=1)
    index = np.flatnonzero(around)
    points, label = local[index], labels[index]
    mesh = trimesh.Trimesh(placed.vertices_b, placed.faces, process=False)
    distance = KDTree(trimesh.sample.sample_surface(mesh, 20000, seed=0)[0]).query(points, workers=1)[0]
    inside = depth_in_hulls(points, placed.hulls_b)
    near = (distance < NEAR_OTHER_M) | (inside < 0.02)
    over = ((points > low - 0.03) & (points < high + [0.03, 0.03, LYING_ABOVE_M])).all(axis=1)
    labelled = np.isin(label, CATEGORY_LABELS.get(placed.category, ()))
    structure = np.isin(label, STRUCTURE_LABELS) & ~labelled
    gone = (labelled & ((distance < NEAR_LABEL_M) | (inside < NEAR_LABEL_M / 2))) | (~structure & near)
    gone |= np.isin(label, SMALL_LABELS) & over
    # Legs that the labeller took for floor.
    gone |= (label == FLOOR) & (centres[index, 2] > FLOOR_CLEARANCE_M) & near
    if placed.category == "door":
        gone |= structure & (label != FLOOR) & (inside < 0.02)
    result = np.zeros(len(centres), bool)
    result[index[gone]] = True
    return result


def cut_furniture(
    vertices_w: np.ndarray,
    faces: np.ndarray,
    labels: np.ndarray,
    objects: tuple[PlacedObject, ...],
    furnished: bool = True,
) -> CutResult:
    """Decide which scan faces are annotated furniture (floor at z = 0, NYU40 labels); floor and walls stay.

    Removed are faces with the object's label, unlabelled ones, small objects on it, and other furniture faces that
    touch the model. Remains of a part that loses faces are removed below `DEBRIS_AREA_M2`.
    """
    if not furnished:
        return CutResult(np.ones(len(faces), bool), np.full(len(faces), -1, np.int64))
    label = face_labels(labels, faces)
    centres = vertices_w[faces].mean(axis=1)
    owner = np.full(len(faces), -1, np.int64)
    for k, placed in enumerate(objects):
        owner[_faces_of(centres, label, placed) & (owner < 0)] = k
    area = face_areas(vertices_w, faces)
    for category in sorted({o.category for o in objects}):
        index = np.flatnonzero(np.isin(label, CATEGORY_LABELS.get(category, ())))
        if not len(index):
            continue
        piece = loose_parts(vertices_w, faces[index])
        total, gone = (np.bincount(piece, area[index] * share) for share in (1, owner[index] >= 0))
        rest = index[(gone[piece] > INSTANCE_SHARE * total[piece]) & (owner[index] < 0)]
        if len(rest):
            members = [k for k, o in enumerate(objects) if o.category == category]
            middles = np.array([to_world(objects[k], objects[k].vertices_b).mean(axis=0) for k in members])
            owner[rest] = np.array(members)[KDTree(middles).query(centres[rest])[1]]
    keep = owner < 0
    kept = np.flatnonzero(keep)
    if len(kept) and not keep.all():
        part, piece = loose_parts(vertices_w, faces), loose_parts(vertices_w, faces[kept])
        loses = np.bincount(part, ~keep)[part[kept]] > 0
        keep[kept[loses & (np.bincount(piece, area[kept])[piece] < DEBRIS_AREA_M2)]] = False
    return CutResult(keep, owner)
