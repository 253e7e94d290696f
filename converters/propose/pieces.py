"""Group labelled points into connected pieces of one class, merged, and split at necks, in rows and by tops."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree

from converters.geometry.boxes import upright_box
from interactive_nav_common.grids import label, nearest_cell
from interactive_nav_common.rotations import yaw_matrix
from scenes_mjcf.categories import TABLE

MIN_VOXELS = 60
"""A component of 0.05 m2 of surface; what is smaller and lies on no other is noise."""
STACKED_SHARE = 0.5
"""Components of one class are one object when their footprints share this much of the smaller."""
SAME_BOX_SHARE = 0.5
"""Instances of two classes are one object when their boxes share this much of the smaller."""
SIZES_M = {c.name: c.sizes_m for c in TABLE if c.sizes_m is not None}
"""Of the categories that are looked for."""
LABEL_CATEGORIES = {c.labels[0]: c.name for c in sorted(TABLE, key=lambda c: c.labels) if c.name in SIZES_M}
"""NYU40 id -> category."""
LONGEST = {c.name: c.longest for c in TABLE if c.longest is not None}
FLAT = ("door",)
"""A line from above, whose breadth says nothing."""
NECK_SHARE = 0.6
"""Where a footprint is narrower than this share of the narrower side's width, two objects touch."""
CORE_CELLS, LEVELS = 2.0, 64
"""Distance to the outline from which on cells are inner ones; heights at which it is looked for necks."""
PART_SHARE = 0.7
"""A part of a piece is an object from this share of the class's least usual width on."""
TOPS_M = {c.name: c.top_m for c in TABLE if c.top_m is not None}
RECTANGULAR = 0.9
"""Least share of its smallest rectangle that a rectangular top fills as scanned; a round one fills 0.785."""
NOTCH_M = 0.2
"""Least sides of the corner that two tops put together leave free; smaller ones are what a scan lost."""
NOTCH_SHOWN = 0.5
"""Least share of that corner in which the scan shows the floor: otherwise it may hide more of the top."""
AROUND_M = 0.5
"""Where no floor is visible around a top either, the scan says nothing about corners."""
OUTLINE_RAD = math.radians(4.0)
"""Stretches of an outline within this run the same way."""
STEP_M = 0.08
"""Least difference in height of two tops put together."""
PART_DEPTH_M = 0.3
"""Least depth of a top."""


@dataclasses.dataclass(frozen=True)
class Proposal:
    """Describe one instance that an annotator, or retrieval, should find a CAD model for."""

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


def box_iou(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the intersection over union of two axis-aligned boxes, each (low (3,), high (3,))."""
    shared = np.prod(np.maximum(np.minimum(one[1], other[1]) - np.maximum(one[0], other[0]), 0.0))
    total = np.prod(one[1] - one[0]) + np.prod(other[1] - other[0]) - shared
    return float(shared / total) if total > 0 else 0.0


def bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (low (3,), high (3,)) of (n, 3) points."""
    return points.min(axis=0), points.max(axis=0)


@dataclasses.dataclass(frozen=True)
class Piece:
    """Hold connected voxels of one class, or several that were joined."""

    label: int
    points: np.ndarray
    index: np.ndarray
    """(n, 3) int: the voxel that each point lies in."""

    @functools.cached_property
    def voxels(self) -> np.ndarray:
        """Return (k, 3) int: each occupied voxel once."""
        return np.unique(self.index, axis=0)

    def part(self, chosen: np.ndarray) -> "Piece":
        """Return the piece of some of its points."""
        return Piece(self.label, self.points[chosen], self.index[chosen])


def components(points: np.ndarray, label: int, origin: np.ndarray, voxel_m: float) -> list[Piece]:
    """Return the 26-connected pieces of one class."""
    index = np.floor((points - origin) / voxel_m).astype(np.int64)
    at = tuple((index - index.min(axis=0)).T)
    grid = np.zeros(np.ptp(index, axis=0) + 1, bool)
    grid[at] = True
    pieces, count = ndimage.label(grid, np.ones((3, 3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    return [Piece(label, points, index).part(pieces[at] == k) for k in range(1, count + 1)]


def _footprint(voxels: np.ndarray) -> set[tuple[int, int]]:
    """Return columns of voxels, one voxel wider on each side."""
    cells = np.unique(voxels[:, :2], axis=0)
    around = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    return set(map(tuple, (cells[:, None] + around).reshape(-1, 2).tolist()))


def merge(pieces: list[Piece], same: Any) -> list[Piece]:
    """Join pieces for which `same` holds, the largest first, until none is left to join."""
    pieces = sorted(pieces, key=lambda p: (-len(p.voxels), p.voxels[0].tolist()))
    while pair := next((p for p in itertools.combinations(range(len(pieces)), 2) if same(*(pieces[k] for k in p))), ()):
        i, j = pair
        both = pieces[i], pieces.pop(j)
        most = max(both, key=lambda p: len(p.voxels)).label
        pieces[i] = Piece(most, *(np.concatenate([getattr(p, of) for p in both]) for of in ("points", "index")))
    return pieces


def stacked(one: Piece, other: Piece) -> bool:
    """Return whether two pieces of one class stand above each other: they are one object."""
    a, b = _footprint(one.voxels), _footprint(other.voxels)
    return len(a & b) > STACKED_SHARE * min(len(a), len(b))


def same_box(one: Piece, other: Piece) -> bool:
    """Return whether two pieces of different classes fill the same box: they are one object."""
    if one.label == other.label:
        return False  # joined, or split, already
    low = np.maximum(one.voxels.min(axis=0), other.voxels.min(axis=0))
    high = np.minimum(one.voxels.max(axis=0), other.voxels.max(axis=0)) + 1
    shared = np.prod(np.maximum(high - low, 0))
    size = min(np.prod(np.ptp(p.voxels, axis=0) + 1) for p in (one, other))
    return bool(shared > SAME_BOX_SHARE * size)


def _basins(mask: np.ndarray) -> np.ndarray:
    """Return (rows, columns) basin numbers around the peaks of the distance to the outline, the nearest one's outside.

    Basins are separate if the distance at the neck is below `NECK_SHARE` of that at either peak.
    """
    distance = ndimage.gaussian_filter(np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1))), 0.7)[1:-1, 1:-1]
    distance, (basin, _) = np.where(mask, distance, 0.0), label(mask)
    for level in np.linspace(0.0, distance.max(), LEVELS)[1:-1]:
        finer, count = label(distance > level)
        finer[level >= NECK_SHARE * np.asarray(ndimage.maximum(distance, finer, np.arange(count + 1)))[finer]] = 0
        for k in np.unique(basin[finer > 0]):
            inside = (basin == k) & (finer > 0)
            if np.ptp(finer[inside]):
                basin[basin == k] = 0
                basin[inside] = basin.max() + finer[inside]
    # Cells along the outline lie beside whichever came first: they go with the nearest inner ones.
    core = (basin > 0) & (distance >= CORE_CELLS)
    return basin[tuple(nearest_cell(core if core.any() else basin > 0))]


def _wide(points: np.ndarray) -> tuple[float, float]:
    """Return the longer and the shorter horizontal side of the upright box of points, m."""
    half = upright_box(points).half
    return 2 * float(max(half[:2])), 2 * float(min(half[:2]))


def part_by_number(piece: Piece, chosen: Sequence[int], of_point: np.ndarray) -> list[Piece]:
    """Return one piece for each of the chosen numbers; what has another number goes to the nearest of them."""
    if len(chosen) < 2:
        return [piece]
    among = np.isin(of_point, chosen)
    of_point = of_point[among][KDTree(piece.points[among]).query(piece.points)[1]]
    return [piece.part(of_point == k) for k in chosen]


def split_at_necks(piece: Piece) -> list[Piece]:
    """Split a piece into objects that touch where its footprint is narrow."""
    category = LABEL_CATEGORIES[piece.label]
    if category in FLAT:
        return [piece]
    at = tuple((piece.index[:, :2] - piece.index[:, :2].min(axis=0) + 1).T)
    mask = np.zeros(np.ptp(piece.index[:, :2], axis=0) + 3, bool)
    mask[at] = True
    # Gaps between slats and legs are part of the footprint; the space between two things is not closed by so little.
    mask = np.asarray(ndimage.binary_fill_holes(ndimage.binary_closing(mask, np.ones((3, 3)))), bool)
    of_point = _basins(mask)[at]
    parts = {k: piece.part(of_point == k) for k in np.unique(of_point).tolist()}
    least = PART_SHARE * SIZES_M[category][0][0]
    large = [k for k, p in parts.items() if len(p.voxels) >= MIN_VOXELS and _wide(p.points)[0] >= least]
    return part_by_number(piece, large, of_point)


def split_row(piece: Piece) -> list[Piece]:
    """Split a piece that is too long for one object into equal lengths, as many as have the usual shape."""
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
    along = (piece.points - box.centre) @ box.rotation[:, int(np.argmax(box.half[:2]))] / long + 0.5
    return part_by_number(piece, range(count), np.clip((along * count).astype(int), 0, count - 1))


@dataclasses.dataclass(frozen=True)
class _Plan:
    """Hold a piece from above, along its main direction."""

    axes: np.ndarray
    """(2, 2) columns: directions of rows and columns."""
    low: np.ndarray
    """(2,) m, of cell [0, 0] along the axes."""
    cell_m: float
    top: np.ndarray
    """(rows, columns) height of what is uppermost, m; nan where there is nothing."""

    @property
    def shape(self) -> np.ndarray:
        """Return (rows, columns) bool: the footprint."""
        return ~np.isnan(self.top)

    def cells(self, xy: np.ndarray) -> np.ndarray:
        """Return (n, 2) cells of (n, 2) points, which may lie outside."""
        return np.floor((xy @ self.axes - self.low) / self.cell_m).astype(np.int64)


def _plan(points: np.ndarray, cell_m: float) -> _Plan:
    # Along the direction, modulo 90 degrees, in which most of the outline runs.
    outline = points[ConvexHull(points[:, :2]).vertices, :2]
    edges = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(edges, axis=1)
    turn = np.exp(4j * np.arctan2(edges[:, 1], edges[:, 0]))  # the same for every quarter turn
    alike = np.real(turn[:, None] * turn.conj()) > math.cos(4 * OUTLINE_RAD)
    best = alike[int(np.argmax(alike @ length))]
    axes = yaw_matrix(float(np.angle((turn * length)[best].sum()) / 4))[:2, :2]
    flat = points[:, :2] @ axes
    low = flat.min(axis=0)
    index = np.floor((flat - low) / cell_m).astype(np.int64)
    top = np.full(index.max(axis=0) + 1, -np.inf)
    np.maximum.at(top, tuple(index.T), points[:, 2])
    hit = np.isfinite(top)
    # Cells without a sample, and holes: as high as what is nearest.
    padded = np.pad(hit, 2)
    closed = ndimage.binary_fill_holes(ndimage.binary_closing(padded, np.ones((3, 3))))
    assert closed is not None
    return _Plan(axes, low, cell_m, np.where(closed[2:-2, 2:-2], top[tuple(nearest_cell(hit))], np.nan))


def _rectangle(mask: np.ndarray, cell_m: float) -> tuple[float, float, float]:
    """Return the longer and the shorter side of a mask's upright rectangle, m, and the share of it that is filled."""
    rows, columns = np.nonzero(mask)
    short, long = sorted((np.ptp(rows) + 1, np.ptp(columns) + 1)) if len(rows) else (0, 0)
    return long * cell_m, short * cell_m, len(rows) / float(max(long * short, 1))


def _usual_top(mask: np.ndarray, cell_m: float, category: str) -> bool:
    """Return whether a mask is as large as the class's tops are, and rectangular."""
    long, short, share = _rectangle(mask, cell_m)
    least, most = SIZES_M[category][0]
    return PART_SHARE * least <= long <= most and short >= PART_DEPTH_M and share >= RECTANGULAR


def _two_levels(plan: _Plan) -> np.ndarray | None:
    """Return (rows, columns) part 1 or 2 of a footprint whose tops are two whole rectangles at two heights."""
    shape = plan.shape
    heights = np.sort(plan.top[shape])
    gap = int(np.argmax(np.diff(heights)))
    # The greatest jump between neighbouring heights; tops are level, so it is empty but for slants.
    if heights[gap + 1] - heights[gap] < STEP_M:
        return None
    upper = shape & (plan.top > (heights[gap] + heights[gap + 1]) / 2)
    parts = (upper, shape & ~upper)
    if not all(_usual_top(p, plan.cell_m, "table") for p in parts):
        return None
    return np.where(upper, 2, np.where(shape, 1, 0))


def _two_rectangles(plan: _Plan, shown_floor: np.ndarray | None, category: str) -> np.ndarray | None:
    """Return (rows, columns) part 1 or 2 of an outline that one straight cut turns into two rectangles, or None."""
    shape = plan.shape
    best, best_score = None, -math.inf
    margin, notch = (math.ceil(v / plan.cell_m) for v in (PART_DEPTH_M, NOTCH_M))
    index = np.indices(shape.shape)
    for axis in (0, 1):
        for cut in range(margin, shape.shape[axis] - margin + 1):
            below = index[axis] < cut
            parts = (shape & below, shape & (index[axis] > cut))  # the row between may hold some of both
            if not all(_usual_top(p, plan.cell_m, category) for p in parts):
                continue
            sides = [_rectangle(p, plan.cell_m)[:2] for p in parts]
            boxes = np.zeros_like(shape)
            for p in parts:
                boxes[ndimage.find_objects(p.astype(int))[0]] = True
            # Of two cuts that fit, as an L has them, the one with parts of usual proportions.
            odd = sum(abs(math.log(long / short / TOPS_M[category][2])) for long, short in sides)
            score = float(shape.sum() / boxes.sum()) - 0.1 * odd
            # What the two leave free of the common rectangle, without stripes along them.
            free = np.asarray(ndimage.binary_opening(~boxes & (index[axis] != cut), np.ones((notch, notch))))
            numbers, count = label(free)
            corners = [numbers == k for k in range(1, count + 1)]
            hidden = shown_floor is not None and not any(shown_floor[c].mean() >= NOTCH_SHOWN for c in corners)
            if corners and not hidden and score > best_score:
                across = np.flatnonzero(parts[0].any(axis=axis))
                between = (index[axis] == cut) & (index[1 - axis] >= across[0]) & (index[1 - axis] <= across[-1])
                best, best_score = np.where(shape, np.where(below | between, 1, 2), 0), score
    return best


def _too_large(plan: _Plan, category: str) -> np.ndarray | None:
    """Return (rows, columns) numbers of the equal parts of a rectangle too long or deep for one top, or None."""
    shape = plan.shape
    deepest, longest, usual = TOPS_M[category]
    long, short, share = _rectangle(shape, plan.cell_m)
    if share < RECTANGULAR:
        return None
    along = int(np.argmax(shape.shape))
    if short > deepest:
        along, count = 1 - along, math.ceil(short / deepest)
    elif long > longest * short or long > SIZES_M[category][0][1]:
        count = max(round(long / (usual * short)), 2)
    else:
        return None
    index = np.indices(shape.shape)[along]
    return np.where(shape, 1 + index * count // shape.shape[along], 0)


def split_tops(piece: Piece, floor_xy: np.ndarray, voxel_m: float) -> list[Piece]:
    """Split a piece into tables or desks; `floor_xy`: (n, 2) places of floor that the scan shows, m."""
    category = LABEL_CATEGORIES[piece.label]
    if category not in TOPS_M:
        return [piece]
    plan = _plan(piece.points, voxel_m)
    part = None
    if category == "table":  # desks have corners and shelves
        rim = math.ceil(AROUND_M / voxel_m)
        shown = np.zeros(np.array(plan.top.shape) + 2 * rim, bool)
        at = plan.cells(floor_xy) + rim
        shown[tuple(at[((at >= 0) & (at < shown.shape)).all(axis=1)].T)] = True
        shown = np.asarray(ndimage.binary_closing(shown, np.ones((3, 3))))
        shown = shown[rim:-rim, rim:-rim] if shown.any() else None
        part = _two_levels(plan)
        part = _two_rectangles(plan, shown, category) if part is None else part
    part = _too_large(plan, category) if part is None else part
    if part is None:
        return [piece]
    of_point = part[tuple(np.clip(plan.cells(piece.points[:, :2]), 0, np.array(part.shape) - 1).T)]
    parts = part_by_number(piece, np.unique(part[part > 0]).tolist(), of_point)
    if min(len(p.voxels) for p in parts) < MIN_VOXELS:
        return [piece]
    return [smaller for p in parts for smaller in split_tops(p, floor_xy, voxel_m)]
