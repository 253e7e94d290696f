"""Compute geodesic distances and shortest paths of an occupancy grid by a graph of its convex corners.

Shortest paths are straight except at corners, so the distances between corners, and the corners visible from each
place, give every distance (`interactive_nav.navigation.lookup` does this inside jit).
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from interactive_nav_common import grids


def distance_field(traversable, resolution: float, goal_xy, origin: tuple[float, float] = (0.0, 0.0)):
    """Return the geodesic distance (m) of every cell centre to a goal: [rows, columns] f32, inf where unreachable.

    Paths consist of `MOVES_32` over free cells of `traversable`, [rows along y, columns along x] bool, whose outer
    corner [0, 0] is at `origin`, m, world. The goal's cell takes its distance from the goal point (2,), m, itself.
    Jit-able, and vmap-able over goals and maps. Raise `ValueError` for a map of other dimensions or a cell side
    (`resolution`, m) that is not positive.
    """
    if getattr(traversable, "ndim", 0) != 2:
        raise ValueError(f"traversable has shape {getattr(traversable, 'shape', None)}, expected [rows, columns]")
    if resolution <= 0:
        raise ValueError(f"resolution is {resolution} m, expected a positive cell side")
    (rows, columns), free, goal = traversable.shape, jnp.asarray(traversable, bool), jnp.asarray(goal_xy, jnp.float32)
    x = (origin[0] + (jnp.arange(columns) + 0.5) * resolution)[None] - goal[0]
    y = (origin[1] + (jnp.arange(rows) + 0.5) * resolution)[:, None] - goal[1]
    at_goal = (jnp.abs(x) <= resolution / 2) & (jnp.abs(y) <= resolution / 2)

    def shifted(array, move, fill):
        return jnp.pad(array, 3, constant_values=fill)[3 + move[0] :, 3 + move[1] :][:rows, :columns]

    moves = [(sign * r, sign * c) for r, c in grids.MOVES_32 for sign in (1, -1)]
    allowed = [jnp.stack([shifted(free, cell, False) for cell in grids.crossed_cells(move)]).all(0) for move in moves]

    def sweep(carry):
        field, _ = carry
        new = field
        for move, mask in zip(moves, allowed, strict=True):
            there = shifted(field, move, jnp.inf) + resolution * math.hypot(*move)
            new = jnp.where(mask, jnp.minimum(new, there), new)
        return new, jnp.any(new < field)

    first = jnp.where(at_goal & free, jnp.hypot(x, y), jnp.inf), jnp.asarray(True)
    return jax.lax.while_loop(lambda carry: carry[1], sweep, first)[0]


def navigation_grid(traversable: np.ndarray, resolution_m: float, radius_m: float, cell_m: float) -> np.ndarray:
    """Return the largest connected component of the `cell_m` squares at whose centre a body of `radius_m` fits.

    `traversable` is [rows, columns] bool, the result [ceil(rows * resolution / cell), ...] with the same origin.
    Erosion uses the map's resolution, so that a coarse grid does not widen walls.
    """
    return grids.largest_component(grids.sampled_clearance(traversable, resolution_m, cell_m) >= max(radius_m, 1e-6))


@dataclasses.dataclass(frozen=True)
class CornerGraph:
    """Hold all shortest paths among blocked squares: V corners, n nodes, at most K corners visible from a node.

    Nodes stand for cells of a coarser grid; a cell without free ground uses its nearest node, so that a robot pressed
    against a wall still has a distance and a path.
    """

    free: np.ndarray
    """[R, C] bool, fine cells, one 4-connected component without cells that touch only diagonally."""
    fine_m: float
    """Side of a fine cell."""
    cell_m: float
    """Side of a node's cell, a multiple of `fine_m`."""
    origin_w: tuple[float, float]
    """World x, y of the outer corner of cell [0, 0] of both grids."""
    node_of_cell: np.ndarray
    """[rows, columns] int32."""
    node_xy_w: np.ndarray
    """[n, 2] float32: a free point of each node's cell."""
    corner_xy_w: np.ndarray
    """[V, 2] float32: convex corners of the blocked squares."""
    visible: np.ndarray
    """[n, K] int32: corners that each node sees and a shortest path may bend at; V where there are fewer."""
    distance_m: np.ndarray
    """[V, V] float32 between corners."""
    next_corner: np.ndarray
    """[V, V] int32: the next corner on the way from the row's to the column's; a corner's is itself."""


_INSET = 0.2
"""Corners lie this share of a fine cell off their wall, so that sight along the wall is free."""
_SIGHT_STEP = 1.0
"""Samples of a line of sight lie at most this many fine cells apart; what slips between clips a corner."""


def _without_pinches(free: np.ndarray) -> np.ndarray:
    """Block one of two free cells that touch only at a corner, until none are left."""
    free = free.copy()
    while True:
        a, b, c, d = free[:-1, :-1], free[:-1, 1:], free[1:, :-1], free[1:, 1:]
        falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
        if not (falling.any() or rising.any()):
            return free
        free[:-1, :-1] &= ~falling
        free[:-1, 1:] &= ~rising


def _corners(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return convex corners of the blocked cells: points [V, 2] (column, row) in cells, and the signs [V, 2] that
    lead from each into its blocked cell."""
    padded = np.pad(free, 1)
    quads = [padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]]
    signs = [(-1, -1), (1, -1), (-1, 1), (1, 1)]
    one = sum((~q).astype(int) for q in quads) == 1
    points, into = [], []
    for quad, sign in zip(quads, signs, strict=True):
        r, c = np.nonzero(one & ~quad)
        points.append(np.stack([c, r], -1) - _INSET * np.asarray(sign))
        into.append(np.broadcast_to(sign, (len(r), 2)))
    return np.concatenate(points).astype(float), np.concatenate(into).astype(float)


_CELLS_APART = 2**0.5
"""The middles of two points' cells lie at most this much farther apart than the points, in cells."""


def sees(room: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [P] bool: which pairs of points [P, 2] (column, row) in cells see each other over free cells.

    `room` is [R, C] `clearance` in cells, 0 in blocked cells. Segments are halved, middle first, until the clearance
    around their middle covers them, so most blocked pairs cost few samples.
    """
    room = np.pad(room, 1)
    columns, clear, step = room.shape[1], room.ravel(), b - a
    length = np.linalg.norm(step, axis=-1)
    out = np.ones(len(a), bool)
    low, high = -1.0, np.asarray(room.shape[::-1], float) - 2.0
    pair, middle, half = np.arange(len(a)), np.full(len(a), 0.5), 0.5
    while len(pair):
        at = np.clip(a[pair] + middle[:, None] * step[pair], low, high)
        cell = np.floor(at).astype(np.intp) + 1
        index = cell[:, 1] * columns + cell[:, 0]
        out[pair[clear[index] == 0]] = False
        reach = length[pair] * half
        open_ = out[pair] & (2 * reach > _SIGHT_STEP) & (reach + _CELLS_APART >= clear[index])
        pair, middle, half = pair[open_], middle[open_], half / 2
        pair, middle = np.repeat(pair, 2), np.stack([middle - half, middle + half], -1).ravel()
    return out


def _visible_corners(
    room: np.ndarray, points: np.ndarray, corners: np.ndarray, into: np.ndarray, slack: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return visible pairs (point, corner) at whose corner a shortest path may bend.

    Paths from the quadrant opposite the blocked cell never bend there. `slack` (cells) widens the test for a point that
    stands for its surroundings.
    """
    firsts, seconds = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    if not len(corners):
        return firsts[0], seconds[0]
    block = max(1, 2_000_000 // max(len(corners), 1))
    for begin in range(0, len(points), block):
        part = points[begin : begin + block]
        towards = (part[:, None] - corners[None]) * into[None]
        i, j = np.nonzero(~(towards < -slack).all(-1) & ~(towards > slack).all(-1))
        ok = sees(room, part[i], corners[j])
        firsts.append(begin + i[ok])
        seconds.append(j[ok])
    return np.concatenate(firsts), np.concatenate(seconds)


def _nodes(room: np.ndarray, ratio: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the node of each coarse cell, `ratio` x `ratio` fine ones, and the nodes' points [n, 2] in fine cells."""
    rows, columns = (-(-n // ratio) for n in room.shape)
    margin = np.pad(room, [(0, n * ratio - m) for n, m in zip((rows, columns), room.shape, strict=True)])
    # The node of a cell is the middle of that of its fine cells that lies farthest from what is blocked.
    split = margin.reshape(rows, ratio, columns, ratio).swapaxes(1, 2).reshape(rows, columns, -1)
    best = split.argmax(-1)
    has_node = split.max(-1) > 0
    r, c = np.nonzero(has_node)
    chosen = best[has_node]
    points = np.stack([c * ratio + chosen % ratio + 0.5, r * ratio + chosen // ratio + 0.5], -1)
    nearest = grids.nearest_cell(has_node)
    index = np.full(has_node.shape, -1, np.int64)
    index[has_node] = np.arange(len(points))
    return index[nearest[0], nearest[1]], points


def corner_graph(free: np.ndarray, fine_m: float, cell_m: float, origin_w: tuple[float, float]) -> CornerGraph:
    """Prepare shortest paths on the largest component of a map of free cells [R, C] of side `fine_m`.

    `cell_m`, a node's side, is a whole multiple of it.
    """
    ratio = round(cell_m / fine_m)
    free = grids.largest_component(_without_pinches(np.asarray(free, bool)))
    room = grids.clearance(free, 1.0)
    node_of_cell, points = _nodes(room, ratio)
    corners, into = _corners(free)
    count = len(corners)
    i, j = _visible_corners(room, corners, corners, into, 2 * _INSET)
    both = scipy.sparse.csr_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    both = scipy.sparse.coo_matrix(both.multiply(both.T))
    i, j = both.row[both.row != both.col], both.col[both.row != both.col]
    lengths = np.linalg.norm(corners[i] - corners[j], axis=-1) * fine_m
    graph = scipy.sparse.csr_matrix((lengths, (i, j)), shape=(count, count))
    if count:
        distance, previous = scipy.sparse.csgraph.dijkstra(graph, return_predecessors=True)
        # Row: where from; the predecessor on the way from column to row is the next on the way from row to column.
        following = np.where(previous.T < 0, np.arange(count)[:, None], previous.T)
    else:
        distance, following = np.zeros((0, 0)), np.zeros((0, 0))
    i, j = _visible_corners(room, points, corners, into, ratio)
    per_node = np.bincount(i, minlength=len(points))
    visible = np.full((len(points), max(int(per_node.max()), 1)), count, np.int64)
    visible[i, np.arange(len(i)) - np.repeat(np.cumsum(per_node) - per_node, per_node)] = j
    return CornerGraph(
        free=free,
        fine_m=fine_m,
        cell_m=cell_m,
        origin_w=origin_w,
        node_of_cell=node_of_cell.astype(np.int32),
        node_xy_w=(np.asarray(origin_w) + points * fine_m).astype(np.float32),
        corner_xy_w=(np.asarray(origin_w) + corners * fine_m).astype(np.float32).reshape(-1, 2),
        visible=visible.astype(np.int32),
        distance_m=distance.astype(np.float32),
        next_corner=following.astype(np.int32),
    )
