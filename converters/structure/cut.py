"""Decide which faces of a scan placed objects replace, and which object each removed vertex showed."""

import dataclasses

import numpy as np
import trimesh
from scipy.spatial import KDTree

from converters.bodies.objects import PlacedObject, to_world
from converters.geometry.boxes import Hull
from converters.geometry.faces import face_areas, face_labels, face_vectors, loose_parts
from converters.records.raw import CATEGORY_LABELS, FLOOR, SMALL_LABELS, STRUCTURE_LABELS
from interactive_nav_common.rotations import matrix_from_quat

NEAR_LABEL_M = 0.15
"""Faces of an object's label this close to the model are the object's: alignments are off by several centimetres."""
NEAR_OTHER_M = 0.04
"""Any furniture face this close is the object's, whatever its label."""
LYING_ABOVE_M = 0.30
"""Small things (bags, pillows) on an object go with it up to this height above it."""
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
    best = np.full(len(points), np.inf)
    for hull in hulls:
        a, normal = hull.vertices[hull.faces[:, 0]], face_vectors(hull.vertices, hull.faces)
        length = np.linalg.norm(normal, axis=1)
        normal, a = normal[length > 1e-12] / length[length > 1e-12, None], a[length > 1e-12]
        best = np.minimum(best, (points @ normal.T - (normal * a).sum(axis=1)).max(axis=1))
    return best


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
    """Decide which scan faces are annotated furniture.

    Floor and walls stay, whatever stands against them: only faces with the object's label, with no
    label or of small things lying on it, and other furniture faces that touch the model, go. Of a part that loses
    faces, pieces smaller than `DEBRIS_AREA_M2` go too; a part that loses none stays whole, however small it is.
    The scan's floor is at z = 0, its labels are NYU40's.
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
