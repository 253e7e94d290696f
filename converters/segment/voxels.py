"""Turn a scan's surface into occupied voxels with features, and scores of points into those of vertices.

Voxels count from `Voxels.origin`, `BELOW_M` under the floor, in the scan's frame, z up.
"""

import dataclasses
import math

import numpy as np

from converters.geometry.faces import face_areas, sum_at_vertices, unit_normals
from converters.read.obj import texels
from converters.records.errors import CLOUD
from converters.records.raw import ScanMesh, TexturedMesh

VOXEL_M = 0.04
BELOW_M = 4.5 * VOXEL_M
LAYERS = 80
"""Voxels from `BELOW_M` under the floor up: what lies higher has no class."""
CLASSES: dict[str, tuple[int, ...]] = {
    **{"wall": (1, 11, 19, 30), "floor": (2, 20), "ceiling": (22,), "window": (9, 13, 16, 28), "door": (8,)},
    **{"chair": (5,), "table": (7,), "desk": (14,), "sofa": (6,), "bed": (4,)},
    **{"cabinet": (3, 10, 12, 15, 17, 24, 32), "lamp": (35,), "basket": (39,), "other": (40,)},
}
"""Class -> NYU40 ids that mean it, the first is written; an id of no class is `other`, 0 has none."""
NAMES = tuple(CLASSES)
NYU40 = np.array([ids[0] for ids in CLASSES.values()])
"""Class -> id."""
UNKNOWN = 255
"""Class of what has no label."""
FEATURES = 7
"""Of an occupied voxel: mean normal, mean colour, whether there is colour; int8, of which 127 is 1."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """Hold points of a surface."""

    points: np.ndarray
    """(n, 3) m."""
    normals: np.ndarray
    """(n, 3) unit, or zero."""
    colours: np.ndarray | None
    """(n, 3) 0 to 255, or None."""
    face: np.ndarray
    """(n,) the face that each lies on."""

    def rows(self, chosen: np.ndarray) -> "Surface":
        """Return some of the points."""
        colours = None if self.colours is None else self.colours[chosen]
        return Surface(self.points[chosen], self.normals[chosen], colours, self.face[chosen])


@dataclasses.dataclass(frozen=True)
class Voxels:
    """Hold occupied voxels."""

    origin: np.ndarray
    """(3,) m, lowest corner of voxel (0, 0, 0)."""
    index: np.ndarray
    """(k, 3) int64, from 0; the last below `LAYERS`."""
    features: np.ndarray
    """(k, FEATURES) int8."""
    of_point: np.ndarray
    """(n,) int64: row of the voxel that each point lies in, -1 beyond the layers."""


def classes_of(labels: np.ndarray) -> np.ndarray:
    """Return (n,) uint8 classes of NYU40 ids."""
    table = np.full(256, NAMES.index("other"), np.uint8)
    table[0] = UNKNOWN
    for k, ids in enumerate(CLASSES.values()):
        table[list(ids)] = k
    return table[np.clip(labels, 0, 255)]


def sample_surface(scan: TexturedMesh, spacing_m: float = VOXEL_M / 2) -> Surface:
    """Sample points all over a scan, at least one a face, evenly and without chance; a scan of one colour has none."""
    area = face_areas(scan.vertices, scan.faces)
    spacing_m = max(spacing_m, math.sqrt(area.sum() / CLOUD))
    count = np.maximum(np.ceil(area / spacing_m**2), 1).astype(np.int64)
    face = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count) + 1
    u, v = (1 / 3 + step * 0.7548776662) % 1, (1 / 3 + step * 0.5698402910) % 1  # R2, Roberts 2018
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    weight = np.where((count == 1)[face, None], 1 / 3, np.stack([1 - u - v, u, v], axis=1))
    colours = None
    if scan.texture is not None and scan.corner_uv is not None:
        colours = texels(scan.texture, np.einsum("nc,ncd->nd", weight, scan.corner_uv[face])).astype(float)
    elif isinstance(scan, ScanMesh) and scan.vertex_colours is not None:
        colours = np.einsum("nc,ncd->nd", weight, scan.vertex_colours[scan.faces[face]])
    if colours is not None and not np.ptp(colours, axis=0).any():
        colours = None
    normals = unit_normals(scan.vertices, scan.faces)[face]
    return Surface(np.einsum("nc,ncd->nd", weight, scan.vertices[scan.faces[face]]), normals, colours, face)


def voxelise(surface: Surface, floor_m: float) -> Voxels:
    """Average the features of the points of each voxel."""
    low = surface.points[:, :2].min(axis=0) if len(surface.points) else np.zeros(2)
    origin = np.array([*low, floor_m - BELOW_M])
    index = np.floor((surface.points - origin) / VOXEL_M).astype(np.int64)
    inside = (index[:, 2] >= 0) & (index[:, 2] < LAYERS)
    shape = (*(index[inside, :2].max(axis=0, initial=0) + 1), LAYERS)
    flat, row = np.unique(np.ravel_multi_index(tuple(index[inside].T), shape), return_inverse=True)
    of_point = np.full(len(index), -1)
    of_point[inside] = row
    colours = np.full((len(index), 3), 127.5) if surface.colours is None else surface.colours
    given = np.hstack([127 * surface.normals, colours - 127.5])[inside]
    mean = np.column_stack([np.bincount(row, column, len(flat)) for column in given.T])
    mean = mean / np.bincount(row, minlength=len(flat))[:, None]
    has = np.full((len(flat), 1), 0 if surface.colours is None else 127)
    features = np.clip(np.round(np.hstack([mean, has])), -127, 127).astype(np.int8)
    return Voxels(origin, np.column_stack(np.unravel_index(flat, shape)), features, of_point)


def at_vertices(scores: np.ndarray, surface: Surface, faces: np.ndarray, count: int) -> np.ndarray:
    """Return (count, classes) scores of the vertices: sums of (n, classes) over the points of all faces around each."""
    of_face = np.stack([np.bincount(surface.face, column, len(faces)) for column in scores.T], axis=1)
    return sum_at_vertices(of_face, faces, count)


def intersection_over_union(truth: np.ndarray, predicted: np.ndarray) -> dict[str, float]:
    """Return class -> IoU of (n,) classes, of those that the truth has; what is `UNKNOWN` there does not count."""
    labelled = truth != UNKNOWN
    confusion = np.bincount(truth[labelled].astype(int) * 256 + predicted[labelled], minlength=65536).reshape(256, 256)
    union = confusion.sum(axis=0) + confusion.sum(axis=1) - confusion.diagonal()
    return {name: float(confusion[k, k] / union[k]) for k, name in enumerate(NAMES) if confusion[k].any()}
