"""Compute on grids of square cells, [rows along y, columns along x]: clearance, components, graphs and paths.

Cells are connected where they share a side. A move between two cells is allowed where every cell that its segment
touches is free, so what a graph of moves connects is what `label` connects.
"""

import functools
import math
from collections.abc import Iterable

import numpy as np
import scipy.sparse
from scipy import ndimage

MOVES_4 = ((0, 1), (1, 0))
"""(row, column) moves between cells that share a side; the opposite ones are the same edges."""
MOVES_16 = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
"""The same with 16 directions."""
MOVES_32 = (
    *((0, 1), (1, -3), (1, -2), (1, -1), (1, 0), (1, 1), (1, 2), (1, 3)),
    *((2, -3), (2, -1), (2, 1), (2, 3), (3, -2), (3, -1), (3, 1), (3, 2)),
)
"""The same with 32: in open space paths are at most 1/cos(9.2 deg) - 1 = 1.3 % too long, where 8 err by 8.2 %."""


def clearance(free: np.ndarray, cell_m: float) -> np.ndarray:
    """Return the distance (m) from each cell's centre to the border of the nearest cell that is not free.

    It is 0 for cells that are not free; cells beyond the grid are not. A disc of no larger radius fits at the centre.
    """
    padded = np.zeros(np.add(free.shape, 2), bool)
    padded[1:-1, 1:-1] = free
    distance = np.asarray(ndimage.distance_transform_edt(padded), float)[1:-1, 1:-1]
    return np.maximum(distance - 0.5, 0.0) * cell_m


def sampled_clearance(free: np.ndarray, resolution_m: float, cell_m: float) -> np.ndarray:
    """Return `clearance` at the centres of `cell_m` squares, bilinear: [ceil(rows * resolution / cell), ...] m."""
    rows, columns = (math.ceil(n * resolution_m / cell_m - 1e-9) for n in free.shape)
    r = (np.arange(rows) + 0.5) * cell_m / resolution_m - 0.5
    c = (np.arange(columns) + 0.5) * cell_m / resolution_m - 0.5
    grid = np.meshgrid(r, c, indexing="ij")
    return ndimage.map_coordinates(clearance(free, resolution_m), grid, order=1, cval=0.0)


def cell_centres(cells: np.ndarray, cell_m: float, origin_w: tuple[float, float]) -> np.ndarray:
    """Return the world positions [n, 2] m of the centres of the cells that are set, row by row."""
    rows, columns = np.nonzero(cells)
    return np.asarray(origin_w) + (np.stack([columns, rows], -1) + 0.5) * cell_m


def value_near(values: np.ndarray, cell_m: float, origin_w: tuple[float, float], xy_w: np.ndarray) -> np.ndarray:
    """Return the values [..., n] of the cells that hold world points [n, 2], or are nearest to those off the grid."""
    columns, rows = np.floor((np.asarray(xy_w) - origin_w) / cell_m).astype(int).T
    return values[np.clip(rows, 0, values.shape[0] - 1), np.clip(columns, 0, values.shape[1] - 1)]


def nearest_cell(mask: np.ndarray) -> np.ndarray:
    """Return the (row, column) of the nearest set cell of each cell: [2, rows, columns]."""
    return np.asarray(ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True))


def label(mask: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the number of each cell's connected component, from 1 (0 where not set), and how many there are."""
    numbers = np.zeros(mask.shape, np.int32)
    count = ndimage.label(mask, output=numbers)
    assert isinstance(count, int)
    return numbers, count


def largest_component(mask: np.ndarray) -> np.ndarray:
    """Return the largest connected component, bool; no cell where none is set."""
    numbers, count = label(mask)
    return numbers == 1 + int(np.argmax(np.bincount(numbers.ravel())[1:])) if count else np.zeros(mask.shape, bool)


@functools.cache
def crossed_cells(move: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """Return the cells (row, column offsets) that the segment between two cell centres passes through or touches.

    Both end cells are included. A diagonal through a corner includes the two cells beside the corner, so that a path
    cannot slip between two blocked cells.
    """
    dr, dc = move
    length, reach = math.hypot(dr, dc), 0.5 * (abs(dr) + abs(dc)) / math.hypot(dr, dc)
    return tuple(
        (r, c)
        for r in range(min(0, dr), max(0, dr) + 1)
        for c in range(min(0, dc), max(0, dc) + 1)
        # Distance of the cell's centre from the line against the cell's half width along the normal.
        if abs(r * dc - c * dr) / length <= reach + 1e-9
    )


def grid_graph(
    free: np.ndarray, cost: np.ndarray, cell_m: float, moves: Iterable[tuple[int, int]], corners: bool = True
) -> scipy.sparse.csr_matrix:
    """Return the undirected graph of moves between free cells: [cells, cells] of costs, cells numbered row by row.

    `cost` [rows, columns] is per metre; a move's is the mean of the cells that it crosses, with `corners` the two
    beside a diagonal among them. `moves` are (row, column) of at most 3 cells, one way each.
    """
    rows, columns = free.shape
    index, pad = np.arange(rows * columns).reshape(rows, columns), 3
    open_, price = np.pad(free, pad), np.pad(cost, pad)
    first, second, weight = [], [], []
    for move in moves:
        ok, mean, cells = np.ones(free.shape, bool), np.zeros(free.shape), crossed_cells(move)
        priced = cells if corners or abs(move[0]) != abs(move[1]) else ((0, 0), move)
        for r, c in cells:
            part = (slice(pad + r, pad + r + rows), slice(pad + c, pad + c + columns))
            ok &= open_[part]
            mean += price[part] / len(priced) if (r, c) in priced else 0.0
        at = np.nonzero(ok)
        first.append(index[at])
        second.append(index[at[0] + move[0], at[1] + move[1]])
        weight.append(cell_m * math.hypot(*move) * mean[at])
    entries = (np.concatenate(weight), (np.concatenate(first), np.concatenate(second)))
    return scipy.sparse.csr_matrix(entries, shape=(rows * columns,) * 2)


def follow(previous: np.ndarray, start: int, end: int | None = None) -> list[int]:
    """Return the nodes from `start` back along Dijkstra's predecessors [n]; none where `end` is not reached."""
    path = [int(start)]
    while path[-1] != end and previous[path[-1]] >= 0:
        path.append(int(previous[path[-1]]))
    return path if end is None or path[-1] == end else []
