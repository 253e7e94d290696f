"""Labelled points in, pieces of one class out: connected voxels, merged, parted at necks and in rows."""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from converters.geometry.boxes import upright_box
from interactive_nav_common.grids import nearest_cell
from scenes_mjcf.categories import TABLE

MIN_VOXELS = 60
"""A component of 0.05 m2 of surface; what is smaller and lies on no other is noise."""
STACKED_SHARE = 0.5
"""Components of one class are one thing when their footprints share this much of the smaller."""
SAME_BOX_SHARE = 0.5
"""Instances of two classes are one thing when their boxes share this much of the smaller."""
SIZES_M = {c.name: c.sizes_m for c in TABLE if c.sizes_m is not None}
"""Of the categories that are looked for."""
LABEL_CATEGORIES = {c.labels[0]: c.name for c in sorted(TABLE, key=lambda c: c.labels) if c.name in SIZES_M}
"""NYU40 id -> category."""
LONGEST = {c.name: c.longest for c in TABLE if c.longest is not None}
FLAT = ("door",)
"""Seen from above a line, whose breadth says nothing."""
NECK_SHARE = 0.6
"""Where a footprint is narrower than this share of the narrower side's width, two things touch."""
CORE_CELLS = 2.0
PART_SHARE = 0.7
"""A part of a piece is a thing from this share of the class's least usual width on."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """Connected voxels of one class, or several that were joined."""

    label: int
    points: np.ndarray
    voxels: np.ndarray
    """(n, 3) int."""


def components(points: np.ndarray, label: int, origin: np.ndarray, voxel_m: float) -> list[Piece]:
    """26-connected pieces of one class."""
    index = np.floor((points - origin) / voxel_m).astype(np.int64)
    low = index.min(axis=0)
    grid = np.zeros(index.max(axis=0) - low + 1, bool)
    grid[tuple((index - low).T)] = True
    pieces, count = ndimage.label(grid, np.ones((3, 3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    piece = pieces[tuple((index - low).T)]
    result = []
    for k in range(1, count + 1):
        members = np.flatnonzero(piece == k)
        result.append(Piece(label, points[members], np.unique(index[members], axis=0)))
    return result


def _footprint(voxels: np.ndarray) -> set[tuple[int, int]]:
    """Columns of voxels, one voxel wider on each side."""
    cells = np.unique(voxels[:, :2], axis=0)
    around = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    return set(map(tuple, (cells[:, None] + around).reshape(-1, 2).tolist()))


def _join(pieces: list[Piece]) -> Piece:
    labels = np.concatenate([np.full(len(p.voxels), p.label) for p in pieces])
    voxels = np.unique(np.concatenate([p.voxels for p in pieces]), axis=0)
    return Piece(int(np.bincount(labels).argmax()), np.concatenate([p.points for p in pieces]), voxels)


def merge(pieces: list[Piece], same: Any) -> list[Piece]:
    """Joins pieces for which `same` holds, the largest first, until none is left to join."""
    pieces = sorted(pieces, key=lambda p: (-len(p.voxels), p.voxels[0].tolist()))
    while pair := next((p for p in itertools.combinations(range(len(pieces)), 2) if same(*(pieces[k] for k in p))), ()):
        i, j = pair
        pieces[i] = _join([pieces[i], pieces.pop(j)])
    return pieces


def stacked(one: Piece, other: Piece) -> bool:
    """Whether two pieces of one class stand above each other: they are one thing."""
    a, b = _footprint(one.voxels), _footprint(other.voxels)
    return len(a & b) > STACKED_SHARE * min(len(a), len(b))


def same_box(one: Piece, other: Piece) -> bool:
    """Whether two pieces of different classes fill the same box: they are one thing."""
    if one.label == other.label:
        return False  # joined, or parted, already
    low = np.maximum(one.voxels.min(axis=0), other.voxels.min(axis=0))
    high = np.minimum(one.voxels.max(axis=0), other.voxels.max(axis=0)) + 1
    shared = np.prod(np.maximum(high - low, 0))
    size = min(np.prod(np.ptp(p.voxels, axis=0) + 1) for p in (one, other))
    return bool(shared > SAME_BOX_SHARE * size)


def _basins(mask: np.ndarray) -> np.ndarray:
    """Basins around the local maxima of the distance to the outline, from the highest down (a watershed).

    A basin that meets a higher one where the distance is at least `NECK_SHARE` of its own greatest joins it.

    Returns (rows, columns) number of the basin from 1 on, 0 outside.
    """
    distance = np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1)))
    distance = np.where(np.pad(mask, 1), ndimage.gaussian_filter(distance, 0.7), 0.0)
    basin = np.zeros(distance.shape, np.int64)
    peak, parent = [0.0], [0]

    def root(k: int) -> int:
        while parent[k] != k:
            k = parent[k]
        return k

    rows, columns = np.nonzero(np.pad(mask, 1))
    for i in np.argsort(-distance[rows, columns], kind="stable"):
        r, c = int(rows[i]), int(columns[i])
        around = sorted(
            {root(int(k)) for k in basin[r - 1 : r + 2, c - 1 : c + 2].ravel() if k}, key=lambda k: -peak[k]
        )
        if not around:
            peak.append(float(distance[r, c]))
            parent.append(len(parent))
            basin[r, c] = len(parent) - 1
            continue
        for k in around[1:]:
            if distance[r, c] >= NECK_SHARE * peak[k]:
                parent[k] = around[0]
        basin[r, c] = around[0]
    final = np.array([root(k) for k in range(len(parent))])[basin]
    # Cells along the outline were flooded from whichever side came first: they go with the nearest inner ones.
    core = (final > 0) & (distance >= CORE_CELLS)
    if core.any():
        final = np.where(final > 0, final[tuple(nearest_cell(core))], 0)
    return final[1:-1, 1:-1]


def _wide(points: np.ndarray) -> tuple[float, float]:
    """Longer and shorter horizontal side of the upright box of points, m."""
    half = upright_box(points).half
    return 2 * float(max(half[:2])), 2 * float(min(half[:2]))


def part_by_number(piece: Piece, chosen: np.ndarray, of_point: np.ndarray, of_voxel: np.ndarray) -> list[Piece]:
    """One piece for each of the chosen numbers; what has another number goes to the nearest of them."""
    if len(chosen) < 2:
        return [piece]
    middles = KDTree(piece.voxels[np.isin(of_voxel, chosen)])
    known = of_voxel[np.isin(of_voxel, chosen)]
    of_voxel = np.where(np.isin(of_voxel, chosen), of_voxel, known[middles.query(piece.voxels)[1]])
    nearest = KDTree(piece.points[np.isin(of_point, chosen)])
    known = of_point[np.isin(of_point, chosen)]
    of_point = np.where(np.isin(of_point, chosen), of_point, known[nearest.query(piece.points)[1]])
    return [Piece(piece.label, piece.points[of_point == k], piece.voxels[of_voxel == k]) for k in chosen]


def split_at_necks(piece: Piece, origin: np.ndarray, voxel_m: float) -> list[Piece]:
    """The things of a piece that touch where its footprint is narrow."""
    category = LABEL_CATEGORIES[piece.label]
    if category in FLAT:
        return [piece]
    least = SIZES_M[category][0][0]
    low = piece.voxels[:, :2].min(axis=0) - 1
    mask = np.zeros(np.ptp(piece.voxels[:, :2], axis=0) + 3, bool)
    mask[tuple((piece.voxels[:, :2] - low).T)] = True
    # Gaps between slats and legs are part of the footprint; the space between two things is not closed by so little.
    mask = np.asarray(ndimage.binary_fill_holes(ndimage.binary_closing(mask, np.ones((3, 3)))), bool)
    basin = _basins(mask)
    of_voxel = basin[tuple((piece.voxels[:, :2] - low).T)]
    cell = np.floor((piece.points[:, :2] - origin[:2]) / voxel_m).astype(np.int64) - low
    of_point = basin[tuple(cell.T)]
    large = [
        k
        for k in np.unique(of_voxel[of_voxel > 0])
        if (of_voxel == k).sum() >= MIN_VOXELS and _wide(piece.points[of_point == k])[0] >= PART_SHARE * least
    ]
    return part_by_number(piece, np.array(large), of_point, of_voxel)


def split_row(piece: Piece, origin: np.ndarray, voxel_m: float) -> list[Piece]:
    """The things of a piece that is too long for one: equal lengths, as many as have the usual shape."""
    category = LABEL_CATEGORIES[piece.label]
    if category not in LONGEST:
        return [piece]
    (least, most), ratio = SIZES_M[category][0], LONGEST[category]
    long, short = _wide(piece.points)
    if long <= most and long <= ratio * short:
        return [piece]
    # Chairs and baskets are about as wide as deep.
    count = math.ceil(long / most) if math.isinf(ratio) else max(round(long / short), 2)
    if long / count < least or short > most:
        return [piece]
    box = upright_box(piece.points)
    axis = box.rotation[:2, int(np.argmax(box.half[:2]))]
    along = [
        (xy - box.centre[:2]) @ axis / long + 0.5
        for xy in (piece.points[:, :2], (piece.voxels[:, :2] + 0.5) * voxel_m + origin[:2])
    ]
    of_point, of_voxel = (np.clip((a * count).astype(int), 0, count - 1) for a in along)
    return part_by_number(piece, np.arange(count), of_point, of_voxel)
