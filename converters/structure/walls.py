"""Find the direction of the walls, and bound traversable cells by few boxes."""

import heapq
import math
from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from converters.geometry.boxes import OrientedBox
from converters.geometry.faces import face_labels, face_vectors
from converters.records.raw import CEILING, FLOOR, STRUCTURE_LABELS
from converters.structure.maps import FloorPlan
from interactive_nav_common.rotations import yaw_matrix

DEPTH_CELLS = 4
"""How far a box may reach into non-traversable cells: thick boxes merge ragged walls and are hard to tunnel."""
_Run = tuple[int, int, int, int, int, int, int, int]
"""1 along a column or 0 along a row, which one, start, stop; rows and columns of the rectangle grown from it."""


def main_direction(vertices_w: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> float:
    """Return the walls' direction, rad in [-pi/4, pi/4): the mode of normals by area, 0 if below 1 degree."""
    wall = np.isin(face_labels(labels, faces), [v for v in STRUCTURE_LABELS if v not in (FLOOR, CEILING)])
    normal = face_vectors(vertices_w, faces[wall])
    length = np.linalg.norm(normal, axis=1)
    steep = (length > 0) & (np.abs(normal[:, 2]) < 0.2 * length)
    if not steep.any():
        return 0.0
    angle = np.arctan2(normal[steep, 1], normal[steep, 0]) % (math.pi / 2)
    bins = 180
    histogram = np.bincount((angle / (math.pi / 2) * bins).astype(int) % bins, length[steep], bins)
    smooth = ndimage.gaussian_filter1d(histogram, 2.0, mode="wrap")
    peak = (np.argmax(smooth) + 0.5) / bins * math.pi / 2
    # Mean of the angles near the peak, on the circle of period 90 degrees.
    offset = (angle - peak + math.pi / 4) % (math.pi / 2) - math.pi / 4
    near = np.abs(offset) < math.radians(5)
    yaw = peak + float(np.average(offset[near], weights=length[steep][near]))
    yaw = (yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4
    return 0.0 if abs(yaw) < math.radians(1.0) else yaw


def border_cells(traversable: np.ndarray) -> np.ndarray:
    """Return (rows, columns) bool: cells that are not traversable but touch one that is, corners included."""
    return ndimage.binary_dilation(traversable, np.ones((3, 3))) & ~traversable


def cover_rectangles(needed: np.ndarray, allowed: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """Cover needed cells greedily with rectangles of allowed cells, none inside another.

    Yield (row0, row1, column0, column1), half-open.
    """
    assert not (needed & ~allowed).any()
    left = needed.copy()
    # Candidates: each run of allowed cells along a row, grown in rows, and the other way round. Border runs are
    # straight, so these contain the long rectangles. As cells are covered, gains only fall and first cells only move
    # on: the least of the heap is the best candidate if its rank has not changed since.
    heap: list[tuple[int, int, _Run]] = []

    def offer(run: _Run) -> None:
        """Queue a run by most gain, then by first cell, rows before columns; drop one without gain."""
        upright, line, start, stop, r0, r1, c0, c1 = run
        cells = np.flatnonzero((left.T if upright else left)[line, start:stop])
        if len(cells):
            at = (start + int(cells[0]), line) if upright else (line, start + int(cells[0]))
            heapq.heappush(heap, (-int(np.count_nonzero(left[r0:r1, c0:c1])), at[0] * left.shape[1] + at[1], run))

    for run in (run for upright, grid in enumerate((allowed, allowed.T)) for run in _runs(grid, upright)):
        offer(run)
    while heap:
        ranked = heapq.heappop(heap)
        r0, r1, c0, c1 = ranked[2][4:]
        offer(ranked[2])
        if not heap or heap[0] != ranked:
            continue
        # Without rows and columns at its edges that hold no needed cell.
        inside = needed[r0:r1, c0:c1]
        rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        yield r0 + int(rows[0]), r0 + int(rows[-1]) + 1, c0 + int(columns[0]), c0 + int(columns[-1]) + 1
        left[r0:r1, c0:c1] = False


def _runs(grid: np.ndarray, upright: int) -> Iterator[_Run]:
    """Find runs of allowed cells along the rows of a grid, and the rectangles grown from them."""
    blocked = np.cumsum(np.pad(~grid.T, ((1, 0), (0, 0))), axis=0)  # cells that are not allowed before each column
    for line, row in enumerate(grid):
        ends = np.flatnonzero(np.diff(row, prepend=False, append=False)).reshape(-1, 2)
        for start, stop in ends.tolist():  # with as many equal runs beside it as are allowed
            other = np.flatnonzero(blocked[stop] != blocked[start])
            at = int(np.searchsorted(other, line))
            low = int(other[at - 1]) + 1 if at > 0 else 0
            high = int(other[at]) if at < len(other) else blocked.shape[1]
            r0, r1, c0, c1 = (start, stop, low, high) if upright else (low, high, start, stop)
            yield upright, line, start, stop, r0, r1, c0, c1


def wall_boxes(plan: FloorPlan) -> tuple[OrientedBox, ...]:
    """Build boxes from the floor up around everything traversable, except where a door's leaf turns.

    A box may cover higher structure (which has separate boxes), never lower structure.
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
