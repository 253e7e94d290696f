"""Traversable cells in, few boxes that bound them out."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from converters.geometry.boxes import OrientedBox
from converters.structure.maps import FloorPlan
from interactive_nav_common.rotations import yaw_matrix

DEPTH_CELLS = 4
"""How far a box may reach into what is not traversable: thick boxes merge ragged walls and are hard to
tunnel."""


def border_cells(traversable: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: cells that are not traversable but touch one that is, corners included."""
    return ndimage.binary_dilation(traversable, np.ones((3, 3))) & ~traversable


def cover_rectangles(
    needed: np.ndarray, allowed: np.ndarray, disjoint: bool = False
) -> list[tuple[int, int, int, int]]:
    """Covers the needed cells with rectangles of allowed cells, the most useful first.

    Args:
        needed: (rows, columns) bool, every one of these ends up covered.
        allowed: (rows, columns) bool, contains `needed`; no rectangle leaves it.
        disjoint: rectangles must not overlap (fewer are found when they may).

    Returns:
        (row0, row1, column0, column1) half-open, none inside another.
    """
    assert not (needed & ~allowed).any()
    left = needed.copy()
    rectangles = []
    while left.any():
        best, best_gain = None, 0
        # Candidates: from each uncovered cell, the widest run of allowed cells along the row grown in rows,
        # and the other way round. Border runs are straight, so these contain the long rectangles.
        for row, column in np.argwhere(left):
            for rectangle in (_grow(allowed, row, column, False), _grow(allowed, row, column, True)):
                r0, r1, c0, c1 = rectangle
                gain = int(left[r0:r1, c0:c1].sum())
                if gain > best_gain:
                    best, best_gain = rectangle, gain
        assert best is not None
        r0, r1, c0, c1 = best
        rectangles.append(_shrink(left if disjoint else needed, best))
        left[r0:r1, c0:c1] = False
        if disjoint:
            allowed = allowed & ~_filled(allowed.shape, rectangles[-1])
    return rectangles


def _filled(shape: tuple[int, ...], rectangle: tuple[int, int, int, int]) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[rectangle[0] : rectangle[1], rectangle[2] : rectangle[3]] = True
    return mask


def _grow(allowed: np.ndarray, row: int, column: int, upright: bool) -> tuple[int, int, int, int]:
    """Largest run through the cell along one axis, then as many equal runs beside it as are allowed."""
    grid = np.asarray(allowed.T if upright else allowed)
    r, c = (column, row) if upright else (row, column)
    blocked = np.flatnonzero(np.logical_not(grid[r]))
    at = np.searchsorted(blocked, c)
    c0 = int(blocked[at - 1]) + 1 if at > 0 else 0
    c1 = int(blocked[at]) if at < len(blocked) else grid.shape[1]
    full = np.all(grid[:, c0:c1], axis=1).tolist()
    r0 = r1 = int(r)
    while r0 > 0 and full[r0 - 1]:
        r0 -= 1
    while r1 < grid.shape[0] and full[r1]:
        r1 += 1
    return (c0, c1, r0, r1) if upright else (r0, r1, c0, c1)


def _shrink(needed: np.ndarray, rectangle: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """The rectangle without rows and columns at its edges that hold no needed cell."""
    r0, r1, c0, c1 = rectangle
    rows = np.flatnonzero(needed[r0:r1, c0:c1].any(axis=1))
    columns = np.flatnonzero(needed[r0:r1, c0:c1].any(axis=0))
    return (r0 + int(rows[0]), r0 + int(rows[-1]) + 1, c0 + int(columns[0]), c0 + int(columns[-1]) + 1)


def wall_boxes(plan: FloorPlan) -> tuple[OrientedBox, ...]:
    """Boxes from the floor up around everything traversable, each as high as what stands there.

    No box stands where a door's leaf turns. A box may reach over what is higher than itself (that has boxes of its
    own), never over what is lower.
    """
    free = plan.traversable if plan.leaf is None else plan.traversable | plan.leaf
    needed = border_cells(free)
    near = np.asarray(ndimage.binary_dilation(needed, np.ones((3, 3)), iterations=DEPTH_CELLS), bool)
    allowed = ~free & near
    height = np.full(needed.shape, plan.wall_height_m) if plan.height_m is None else plan.height_m
    turn = yaw_matrix(plan.grid.yaw)
    side = plan.grid.resolution_m
    boxes = []
    for level in np.unique(height[needed])[::-1]:
        reach = (allowed | needed) & (height >= level)
        for r0, r1, c0, c1 in cover_rectangles(needed & (height == level), reach):
            middle = np.array([(c0 + c1) / 2, (r0 + r1) / 2, 0.0]) * side + [*plan.grid.origin, 0.0]
            centre = turn @ middle
            centre[2] = level / 2
            boxes.append(OrientedBox(centre, turn, np.array([(c1 - c0) * side, (r1 - r0) * side, level]) / 2))
    return tuple(boxes)
