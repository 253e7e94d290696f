"""Labelled scan in, furniture instances with class, box and confidence out (section III-B's region proposals).

The labels are put into a voxel grid; connected voxels of one class are an instance. What a scan tears apart
(the seat of a swivel chair above its base: the thin column is missing) or names twice (table and desk) is
merged by footprint. Things of one class that touch are parted where their common footprint has a neck, and where it is
too long for one of its class; tables and desks also where two tops meet in a step, or make an outline that two
rectangles have and one has not.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree

from converters.geometry.boxes import upright_box
from converters.geometry.faces import face_labels, sample_faces
from converters.geometry.rotations import Y_UP_TO_Z_UP
from converters.records.raw import FLOOR, SYNSETS, UNLABELLED, WALL, ScanMesh
from interactive_nav_common.rotations import yaw_matrix

VOXEL_M = 0.03
"""Chairs that touch at 0.05 m stay apart at 0.03 m in the sample scan."""
MIN_VOXELS = 60
"""A component of 0.05 m2 of surface; what is smaller and lies on no other is noise."""
STACKED_SHARE = 0.5
"""Components of one class are one thing when their footprints share this much of the smaller."""
SAME_BOX_SHARE = 0.5
"""Instances of two classes are one thing when their boxes share this much of the smaller."""
NEAR_M = 0.05

LABEL_CATEGORIES = {5: "chair", 6: "sofa", 7: "table", 8: "door", 14: "desk", 39: "basket"}
"""NYU40 id -> category. 39 is 'otherfurniture', where ScanNet's waste baskets are."""

SIZES_M = {
    "chair": ((0.35, 1.0), (0.5, 1.4)),
    "sofa": ((0.7, 3.2), (0.5, 1.2)),
    "table": ((0.4, 3.0), (0.3, 1.1)),
    "desk": ((0.6, 2.6), (0.6, 1.4)),
    "door": ((0.6, 1.3), (1.7, 2.4)),
    "basket": ((0.15, 0.6), (0.15, 0.8)),
}
"""Category -> usual ranges of the longer horizontal side and of the height."""
LONGEST = {"chair": 1.6, "basket": 2.0, "door": math.inf}
"""Category -> greatest usual ratio of the sides, of things that stand in rows: a row of chairs is no chair."""
TOPS_M = {"table": (1.4, 3.2, 1.9), "desk": (1.2, 3.2, 1.9)}
"""Category -> greatest usual depth, m, greatest and middle ratio of length to depth, of a rectangular top. A long table
may be two, or one; what is longer than that, or deeper, is several put together."""
RECTANGULAR = 0.9
"""Least share of its smallest rectangle that a rectangular top fills as scanned; a round one fills 0.785."""
NOTCH_M = 0.2
"""Least sides of the corner that two tops put together leave free; smaller ones are what a scan lost."""
NOTCH_SHOWN = 0.5
"""Least share of that corner in which the scan shows the floor: otherwise it may hide more of the top."""
AROUND_M = 0.5
"""Where no floor is seen around a top either, the scan says nothing about corners."""
OUTLINE_RAD = math.radians(4.0)
"""Stretches of an outline within this run the same way."""
STEP_M = 0.08
"""Least difference in height of two tops put together."""
PART_DEPTH_M = 0.3
"""Least depth of a top."""
FLAT = ("door",)
"""Seen from above a line, whose breadth says nothing."""
NECK_SHARE = 0.6
"""Where a footprint is narrower than this share of the narrower side's width, two things touch."""
CORE_CELLS = 2.0
PART_SHARE = 0.7
"""A part of a piece is a thing from this share of the class's least usual width on."""


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
    """(3,) full sizes along the box's own axes."""
    yaw: float
    """rad, of the box's x axis; modulo 90 degrees."""
    n_voxels: int
    confidence: float
    """In [0, 1], see `_confidence`."""


@dataclasses.dataclass(frozen=True)
class _Piece:
    label: int
    points: np.ndarray
    voxels: np.ndarray
    """(n, 3) int."""


def _components(points: np.ndarray, label: int, origin: np.ndarray, voxel_m: float) -> list[_Piece]:
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
        result.append(_Piece(label, points[members], np.unique(index[members], axis=0)))
    return result


def _footprint(voxels: np.ndarray) -> set[tuple[int, int]]:
    """Columns of voxels, one voxel wider on each side."""
    cells = np.unique(voxels[:, :2], axis=0)
    around = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    return set(map(tuple, (cells[:, None] + around).reshape(-1, 2).tolist()))


def _join(pieces: list[_Piece]) -> _Piece:
    labels = np.concatenate([np.full(len(p.voxels), p.label) for p in pieces])
    voxels = np.unique(np.concatenate([p.voxels for p in pieces]), axis=0)
    return _Piece(int(np.bincount(labels).argmax()), np.concatenate([p.points for p in pieces]), voxels)


def _merge(pieces: list[_Piece], same: Any) -> list[_Piece]:
    """Joins pieces for which `same` holds, the largest first, until none is left to join."""
    pieces = sorted(pieces, key=lambda p: (-len(p.voxels), p.voxels[0].tolist()))
    merged = True
    while merged:
        merged = False
        for i in range(len(pieces)):
            for j in range(i + 1, len(pieces)):
                if same(pieces[i], pieces[j]):
                    pieces[i] = _join([pieces[i], pieces[j]])
                    del pieces[j]
                    merged = True
                    break
            if merged:
                break
    return pieces


def _stacked(one: _Piece, other: _Piece) -> bool:
    a, b = _footprint(one.voxels), _footprint(other.voxels)
    return len(a & b) > STACKED_SHARE * min(len(a), len(b))


def _same_box(one: _Piece, other: _Piece) -> bool:
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

    Args:
        mask: (rows, columns) bool.

    Returns:
        (rows, columns) number of the basin from 1 on, 0 outside.
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
        nearest = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
        assert nearest is not None
        final = np.where(final > 0, final[nearest[0], nearest[1]], 0)
    return final[1:-1, 1:-1]


def _wide(points: np.ndarray) -> tuple[float, float]:
    """Longer and shorter horizontal side of the upright box of points, m."""
    half = upright_box(points).half
    return 2 * float(max(half[:2])), 2 * float(min(half[:2]))


def _part(piece: _Piece, chosen: np.ndarray, of_point: np.ndarray, of_voxel: np.ndarray) -> list[_Piece]:
    """One piece for each of the chosen numbers; what has another number goes to the nearest of them."""
    if len(chosen) < 2:
        return [piece]
    middles = KDTree(piece.voxels[np.isin(of_voxel, chosen)])
    known = of_voxel[np.isin(of_voxel, chosen)]
    of_voxel = np.where(np.isin(of_voxel, chosen), of_voxel, known[middles.query(piece.voxels)[1]])
    nearest = KDTree(piece.points[np.isin(of_point, chosen)])
    known = of_point[np.isin(of_point, chosen)]
    of_point = np.where(np.isin(of_point, chosen), of_point, known[nearest.query(piece.points)[1]])
    return [_Piece(piece.label, piece.points[of_point == k], piece.voxels[of_voxel == k]) for k in chosen]


def _split_at_necks(piece: _Piece, origin: np.ndarray, voxel_m: float) -> list[_Piece]:
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
    return _part(piece, np.array(large), of_point, of_voxel)


def _split_row(piece: _Piece, origin: np.ndarray, voxel_m: float) -> list[_Piece]:
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
    return _part(piece, np.arange(count), of_point, of_voxel)


@dataclasses.dataclass(frozen=True)
class _Plan:
    """A piece seen from above, along its main direction."""

    axes: np.ndarray
    """(2, 2) columns: directions of rows and columns."""
    low: np.ndarray
    """(2,) m, of cell [0, 0] along the axes."""
    cell_m: float
    top: np.ndarray
    """(rows, columns) height of what is uppermost, m; nan where there is nothing."""

    @property
    def shape(self) -> np.ndarray:
        """(rows, columns) bool: the footprint."""
        return ~np.isnan(self.top)

    def cells(self, xy: np.ndarray) -> np.ndarray:
        """(n, 2) cells of (n, 2) points, which may lie outside."""
        return np.floor((xy @ self.axes - self.low) / self.cell_m).astype(np.int64)


def _main_yaw(xy: np.ndarray) -> float:
    """rad, modulo 90 degrees: the direction along which most of the outline of (n, 2) points runs."""
    outline = xy[ConvexHull(xy).vertices]
    edges = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(edges, axis=1)
    turn = np.exp(4j * np.arctan2(edges[:, 1], edges[:, 0]))  # the same for every quarter turn
    alike = np.real(turn[:, None] * turn.conj()) > math.cos(4 * OUTLINE_RAD)
    best = alike[int(np.argmax(alike @ length))]
    return float(np.angle((turn * length)[best].sum()) / 4)


def _plan(points: np.ndarray, cell_m: float) -> _Plan:
    axes = yaw_matrix(_main_yaw(points[:, :2]))[:2, :2]
    flat = points[:, :2] @ axes
    low = flat.min(axis=0)
    index = np.floor((flat - low) / cell_m).astype(np.int64)
    top = np.full(index.max(axis=0) + 1, -np.inf)
    np.maximum.at(top, tuple(index.T), points[:, 2])
    known = np.isfinite(top)
    # Cells without a sample, and holes: as high as what is nearest.
    padded = np.pad(known, 2)
    closed = ndimage.binary_fill_holes(ndimage.binary_closing(padded, np.ones((3, 3))))
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    assert closed is not None and nearest is not None
    return _Plan(axes, low, cell_m, np.where(closed[2:-2, 2:-2], top[tuple(nearest)], np.nan))


def _fill(mask: np.ndarray) -> float:
    """Share of a mask's own upright rectangle that it fills."""
    rows, columns = np.nonzero(mask)
    return len(rows) / float((np.ptp(rows) + 1) * (np.ptp(columns) + 1)) if len(rows) else 0.0


def _sides(mask: np.ndarray, cell_m: float) -> tuple[float, float]:
    """Longer and shorter side of a mask's own upright rectangle, m."""
    rows, columns = np.nonzero(mask)
    sides = sorted(((np.ptp(rows) + 1) * cell_m, (np.ptp(columns) + 1) * cell_m)) if len(rows) else [0.0, 0.0]
    return sides[1], sides[0]


def _usual_top(mask: np.ndarray, cell_m: float, category: str) -> bool:
    """Whether a mask is as large as the class's tops are, and rectangular."""
    long, short = _sides(mask, cell_m)
    least, most = SIZES_M[category][0]
    return PART_SHARE * least <= long <= most and short >= PART_DEPTH_M and _fill(mask) >= RECTANGULAR


def _two_levels(plan: _Plan) -> np.ndarray | None:
    """(rows, columns) part 1 or 2 of a footprint whose tops are at two heights, each one whole rectangle."""
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
    """(rows, columns) part 1 or 2 of an outline that one straight cut turns into two rectangles; None: it is none.

    Args:
        plan: of the piece.
        shown_floor: (rows, columns) bool: cells where the scan shows the floor; None: it shows none around the piece.
        category: of the piece.
    """
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
            sides = [_sides(p, plan.cell_m) for p in parts]
            boxes = np.zeros_like(shape)
            for p in parts:
                rows, columns = np.nonzero(p)
                boxes[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = True
            # Of two cuts that fit, as an L has them, the one with parts of usual proportions.
            odd = sum(abs(math.log(long / short / TOPS_M[category][2])) for long, short in sides)
            score = float(shape.sum() / boxes.sum()) - 0.1 * odd
            # What the two leave free of the common rectangle, without stripes along them.
            free = np.asarray(ndimage.binary_opening(~boxes & (index[axis] != cut), np.ones((notch, notch))))
            numbers, count = ndimage.label(free)  # pyright: ignore[reportGeneralTypeIssues]
            corners = [numbers == k for k in range(1, count + 1)]
            hidden = shown_floor is not None and not any(shown_floor[c].mean() >= NOTCH_SHOWN for c in corners)
            if corners and not hidden and score > best_score:
                across = np.flatnonzero(parts[0].any(axis=axis))
                between = (index[axis] == cut) & (index[1 - axis] >= across[0]) & (index[1 - axis] <= across[-1])
                best, best_score = np.where(shape, np.where(below | between, 1, 2), 0), score
    return best


def _too_large(plan: _Plan, category: str) -> np.ndarray | None:
    """(rows, columns) numbers of the equal parts of a rectangle too long, or too deep, for one top; None: it is not."""
    shape = plan.shape
    if _fill(shape) < RECTANGULAR:
        return None
    deepest, longest, usual = TOPS_M[category]
    long, short = _sides(shape, plan.cell_m)
    along = int(np.argmax(shape.shape))
    if short > deepest:
        along, count = 1 - along, math.ceil(short / deepest)
    elif long > longest * short or long > SIZES_M[category][0][1]:
        count = max(round(long / (usual * short)), 2)
    else:
        return None
    index = np.indices(shape.shape)[along]
    return np.where(shape, 1 + index * count // shape.shape[along], 0)


def _split_tops(piece: _Piece, floor_xy: np.ndarray, origin: np.ndarray, voxel_m: float) -> list[_Piece]:
    """The tables, or desks, that a piece consists of.

    Args:
        piece: of one class.
        floor_xy: (n, 2) places of floor that the scan shows, m.
        origin: of the voxels.
        voxel_m: side of a voxel.
    """
    category = LABEL_CATEGORIES[piece.label]
    if category not in TOPS_M:
        return [piece]
    plan = _plan(piece.points, voxel_m)
    part = None
    if category == "table":  # desks have corners and shelves of their own
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
    numbers = np.unique(part[part > 0])
    middles = (piece.voxels[:, :2] + 0.5) * voxel_m + origin[:2]
    of_point, of_voxel = (
        part[tuple(np.clip(plan.cells(xy), 0, np.array(part.shape) - 1).T)] for xy in (piece.points[:, :2], middles)
    )
    parts = _part(piece, numbers, of_point, of_voxel)
    if min(len(p.voxels) for p in parts) < MIN_VOXELS:
        return [piece]
    return [smaller for p in parts for smaller in _split_tops(p, floor_xy, origin, voxel_m)]


def _inside_range(value: float, limits: tuple[float, float]) -> float:
    """1 inside the range, falling with the ratio outside: half the lower limit gives 0.5."""
    return min(1.0, value / limits[0], limits[1] / max(value, 1e-9))


def _confidence(category: str, extent: np.ndarray, purity: float, n_voxels: int, voxel_m: float) -> float:
    """Product of three shares: size usual for the class, labels in the box that agree, and surface seen.

    `purity` is the class's share of the box's furniture voxels. Surface counts as enough when the voxels cover
    half of one side and the top of the box.
    """
    wide, high = SIZES_M[category]
    size = _inside_range(float(max(extent[:2])), wide) * _inside_range(float(extent[2]), high)
    surface = extent[0] * extent[1] + max(extent[0], extent[1]) * extent[2]
    seen = min(1.0, n_voxels * voxel_m**2 / max(0.5 * surface, 1e-9))
    return float(size * purity * seen)


def propose_instances(scan: ScanMesh, voxel_m: float = VOXEL_M) -> tuple[Proposal, ...]:
    """Instances of every furniture class, the most certain first.

    Args:
        scan: with NYU40 labels.
        voxel_m: side of a voxel; gaps narrower than one do not part two things.
    """
    points, face = sample_faces(scan.vertices, scan.faces, voxel_m / 2)
    label = face_labels(scan.labels, scan.faces)[face]
    origin = scan.vertices.min(axis=0)
    floor_xy = points[label == FLOOR, :2]
    pieces: list[_Piece] = []
    for wanted in LABEL_CATEGORIES:
        if (label == wanted).any():
            found = _merge(_components(points[label == wanted], wanted, origin, voxel_m), _stacked)
            found = [p for p in found if len(p.voxels) >= MIN_VOXELS]
            found = [part for p in found for part in _split_at_necks(p, origin, voxel_m)]
            found = [part for p in found for part in _split_tops(p, floor_xy, origin, voxel_m)]
            pieces += [part for p in found for part in _split_row(p, origin, voxel_m)]
    pieces = _merge(pieces, _same_box)
    other = ~np.isin(label, (UNLABELLED, WALL, 2, 22))
    other_voxels = np.unique(np.floor((points[other] - origin) / voxel_m).astype(np.int64), axis=0)
    proposals = []
    for piece in pieces:
        category = LABEL_CATEGORIES[piece.label]
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
    """Intersection over union of two axis-aligned boxes, each (low (3,), high (3,))."""
    shared = np.prod(np.maximum(np.minimum(one[1], other[1]) - np.maximum(one[0], other[0]), 0.0))
    total = np.prod(one[1] - one[0]) + np.prod(other[1] - other[0]) - shared
    return float(shared / total) if total > 0 else 0.0


def bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(low (3,), high (3,)) of (n, 3) points."""
    return points.min(axis=0), points.max(axis=0)


def _trs(scale: np.ndarray, yaw: float, translation: np.ndarray) -> dict[str, list[float]]:
    """Scan2CAD's scale, quaternion (w x y z) and translation in a y-up world; arguments are z up."""
    return {
        "scale": np.round([scale[0], scale[2], scale[1]], 6).tolist(),
        "rotation": np.round([math.cos(yaw / 2), 0.0, math.sin(yaw / 2), 0.0], 9).tolist(),
        "translation": np.round(Y_UP_TO_Z_UP.T @ translation, 6).tolist(),
    }


def as_scan2cad(scan_id: str, proposals: tuple[Proposal, ...], chosen: dict[int, Any] | None = None) -> list[dict]:
    """The proposals in the shape of Scan2CAD's annotation list, for an annotation tool to take further.

    A proposal without a model is a unit cube with `id_cad` "" and the box as its pose; keypoints are empty. Each
    has one key more, `proposal`, with what was measured.

    Args:
        scan_id: name of the scan.
        proposals: of it.
        chosen: proposal's index -> `Retrieval` (model and pose), where one was found.
    """
    synset = {category: key for key, category in SYNSETS.items()}
    models = []
    empty = {"n_keypoints": 0, "position": []}
    for k, proposal in enumerate(proposals):
        found = (chosen or {}).get(k)
        entry: dict[str, Any] = {
            "catid_cad": synset[proposal.category],
            "id_cad": "",
            "sym": "__SYM_NONE",
            "trs": _trs(proposal.extent_m, proposal.yaw, proposal.centre),
            "bbox": [0.5, 0.5, 0.5],
            "center": [0.0, 0.0, 0.0],
            "keypoints_cad": empty,
            "keypoints_scan": empty,
            "proposal": {
                "category": proposal.category,
                "confidence": proposal.confidence,
                "label": proposal.label,
                "n_voxels": proposal.n_voxels,
                "extent_m": np.round(proposal.extent_m, 4).tolist(),
            },
        }
        if found is not None:
            low, high = bounds(found.cad.vertices @ Y_UP_TO_Z_UP)
            entry |= {
                "catid_cad": synset[found.cad.category],
                "id_cad": found.cad.cad_id,
                "trs": _trs(found.pose.scale, found.pose.yaw, found.pose.translation),
                "bbox": np.round((high - low) / 2, 6).tolist(),
                "center": np.round((high + low) / 2, 6).tolist(),
            }
            entry["proposal"] |= {"retrieval_confidence": found.confidence, "residual_m": found.residual_m}
        models.append(entry)
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
    """(4, 2) corners of the box seen from above, counter-clockwise, m."""
    half = proposal.extent_m[:2] / 2
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    return square @ yaw_matrix(proposal.yaw)[:2, :2].T + proposal.centre[:2]
