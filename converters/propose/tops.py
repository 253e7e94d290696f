"""A piece of tables or desks in, single ones out: where two tops meet in a step, or make two rectangles' outline."""

import dataclasses
import math

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull

from converters.propose.pieces import LABEL_CATEGORIES, MIN_VOXELS, PART_SHARE, SIZES_M, Piece, part_by_number
from interactive_nav_common.grids import label, nearest_cell
from interactive_nav_common.rotations import yaw_matrix
from scenes_mjcf.categories import TABLE

TOPS_M = {c.name: c.top_m for c in TABLE if c.top_m is not None}
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
    assert closed is not None
    return _Plan(axes, low, cell_m, np.where(closed[2:-2, 2:-2], top[tuple(nearest_cell(known))], np.nan))


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
    """(rows, columns) part 1 or 2 of an outline that one straight cut turns into two rectangles; None: it is none."""
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
            numbers, count = label(free)
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


def split_tops(piece: Piece, floor_xy: np.ndarray, origin: np.ndarray, voxel_m: float) -> list[Piece]:
    """The tables, or desks, that a piece consists of.

    `floor_xy`: (n, 2) places of floor that the scan shows, m.
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
    parts = part_by_number(piece, numbers, of_point, of_voxel)
    if min(len(p.voxels) for p in parts) < MIN_VOXELS:
        return [piece]
    return [smaller for p in parts for smaller in split_tops(p, floor_xy, origin, voxel_m)]
