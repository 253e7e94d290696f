"""A scan with its patches in, faces that close the cracks between them out.

A crack is open border of a patch (edges that no second face has) that runs within `REACH_M` of the scan's, or of
another patch's, open border. It is closed as a zip is: from where both borders meet, or from where they come closest,
triangles are laid from one to the other, the shortest new edge first, until the gap is wider than `REACH_M`. No vertex
is added or moved.
"""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Iterable, Iterator

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

SAME_M = 1e-5
"""Points closer than this are one vertex."""
REACH_M = 0.10
"""Gaps up to this width are cracks; beyond it there is nothing scanned to join."""
STEP_M = 0.04
"""Border edges near a crack are cut to this length, about the scan's own: a zip needs teeth on both sides."""
FACING = 2.0
"""Two places of the border face each other where the way along it is longer than this many times the straight one, as
from side to side of a slit, and as in a corner of less than 60 degrees."""
FOLDED = 0.95
"""Two faces whose directions away from their common edge have a greater cosine than this lie on one another."""


@dataclasses.dataclass(frozen=True)
class Edges:
    """Undirected edges of a mesh."""

    ends: np.ndarray
    """(k, 2) vertices, the lower number first."""
    count: np.ndarray
    """(k,) faces of each."""
    of_face: np.ndarray
    """(m, 3) edge from each corner to the next."""


def edges_of(faces: np.ndarray) -> Edges:
    """The edges of (m, 3) faces, each once."""
    every = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    ends, inverse, count = np.unique(every, axis=0, return_inverse=True, return_counts=True)
    return Edges(ends, count, inverse.reshape(-1, 3))


def edge_pieces(edges: Edges) -> np.ndarray:
    """(m,) number of the piece, connected over edges, that each face lies in."""
    m, e = len(edges.of_face), len(edges.ends)
    rows, columns = np.repeat(np.arange(m), 3), m + edges.of_face.ravel()
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(m + e, m + e))
    return connected_components(graph, directed=False)[1][:m]


def border_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges that only one face has.

    Returns:
        edges (k, 2), face (k,).
    """
    every = edges_of(faces)
    corner, owner = np.nonzero((every.count[every.of_face] == 1).T)
    return np.stack([faces[owner, corner], faces[owner, (corner + 1) % 3]], axis=1), owner


def on_segments(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which segment each point lies inside, ends excluded, to `SAME_M`.

    Args:
        points: (n, d).
        a: (k, d) starts.
        b: (k, d) ends.

    Returns:
        segment (n,) index or -1, share (n,) of the way from start to end.
    """
    segment, share = np.full(len(points), -1), np.zeros(len(points))
    if len(a) == 0 or len(points) == 0:
        return segment, share
    length = np.linalg.norm(b - a, axis=1)
    near = KDTree((a + b) / 2).query_ball_point(points, float(length.max()) / 2 + SAME_M)
    for i, found in enumerate(near):
        k = np.asarray(found, np.int64)
        k = k[length[k] > 2 * SAME_M]
        if len(k) == 0:
            continue
        along = ((points[i] - a[k]) * (b[k] - a[k])).sum(axis=1) / length[k] ** 2
        off = np.linalg.norm(a[k] + along[:, None] * (b[k] - a[k]) - points[i], axis=1)
        off[(along * length[k] < SAME_M) | ((1 - along) * length[k] < SAME_M)] = np.inf
        best = int(np.argmin(off))
        if off[best] < SAME_M:
            segment[i], share[i] = k[best], along[best]
    return segment, share


def split_at(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Splits faces along border edges so that every point lying inside such an edge becomes its vertex.

    Args:
        vertices: (n, 3), the points included (their indices are the last ones).
        faces: (m, 3).
        points: (k,) indices of the points.

    Returns:
        faces (m', 3), source (m',) face that each comes from.
    """
    if len(points) == 0:
        return faces, np.arange(len(faces))
    edges, owner = border_edges(faces)
    edge, share = on_segments(vertices[points], vertices[edges[:, 0]], vertices[edges[:, 1]])
    on_edge: dict[int, list[tuple[float, int]]] = {}
    for point, e, along in zip(points, edge, share, strict=True):
        if e >= 0:
            on_edge.setdefault(int(e), []).append((float(along), int(point)))
    by_face: dict[int, dict[tuple[int, int], list[int]]] = {}
    for e, found in on_edge.items():
        key = (int(edges[e, 0]), int(edges[e, 1]))
        by_face.setdefault(int(owner[e]), {})[key] = [p for _, p in sorted(found)]
    keep = np.ones(len(faces), bool)
    new, source = [], []
    for f, cuts in by_face.items():
        keep[f] = False
        corners = faces[f]
        ring: list[int] = []
        for k in range(3):
            i, j = int(corners[k]), int(corners[(k + 1) % 3])
            ring += [i, *cuts.get((i, j), [])]
        for triangle in _fan(vertices, ring):
            new.append(triangle)
            source.append(f)
    if not new:
        return faces, np.arange(len(faces))
    return np.vstack([faces[keep], np.array(new)]), np.concatenate([np.flatnonzero(keep), np.array(source)])


def _fan(vertices: np.ndarray, ring: list[int]) -> list[tuple[int, int, int]]:
    """Triangles over a triangle's outline with extra points on its edges: ears of the largest least angle."""
    ring, triangles = list(ring), []
    around = vertices[ring] - vertices[ring].mean(axis=0)
    left = float(np.linalg.norm(np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)))
    while len(ring) > 3:
        corner = vertices[ring]
        one, other = corner - np.roll(corner, 1, axis=0), np.roll(corner, -1, axis=0) - corner
        doubled = np.linalg.norm(np.cross(one, other), axis=1)
        longest = np.max([np.linalg.norm(v, axis=1) for v in (one, other, one + other)], axis=0)
        quality = doubled / np.maximum(longest**2, 1e-18)
        # What is left must still have area: never cut off the last corner that stands out.
        quality[left - doubled < 1e-6 * left] = -1.0
        k = int(np.argmax(quality))
        triangles.append((ring[k - 1], ring[k], ring[(k + 1) % len(ring)]))
        left -= float(doubled[k])
        del ring[k]
    triangles.append((ring[0], ring[1], ring[2]))
    return triangles


def points_on(vertices: np.ndarray, edges: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on edges at most so far apart, and the edge of each."""
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    count = np.maximum(np.ceil(np.linalg.norm(b - a, axis=1) / spacing_m).astype(int), 1)
    edge = np.repeat(np.arange(len(edges)), count)
    step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    share = ((step + 0.5) / count[edge])[:, None]
    return a[edge] * (1 - share) + b[edge] * share, edge


def cut_teeth(
    vertices: np.ndarray, faces: np.ndarray, patch_plane: np.ndarray, reach_m: float = REACH_M, step_m: float = STEP_M
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cuts border edges beside which other border runs into steps, and their faces with them.

    Args:
        vertices: (n, 3) m.
        faces: (m, 3) scan and patches, one mesh.
        patch_plane: (m,) plane of each patch face, -1 for scan faces.
        reach_m: how near other border counts.
        step_m: longest edge that stays.

    Returns:
        vertices (n', 3) with the given ones first, faces (m', 3), and the given face (m',) that each is part of.
    """
    edges, owner = border_edges(faces)
    spots, of = points_on(vertices, edges, step_m)
    near = np.zeros(len(spots), bool)
    surface = patch_plane[owner][of]
    for one in np.unique(surface):
        own = surface == one
        # Scan beside patches, patches beside anything of another plane: the scan's own outline is left alone.
        if own.all():
            continue
        tree = KDTree(spots[~own])
        near[own] = np.asarray(tree.query(spots[own], distance_upper_bound=reach_m + step_m)[0]) < np.inf
    chosen = np.unique(of[near])
    a, b = vertices[edges[chosen, 0]], vertices[edges[chosen, 1]]
    count = np.ceil(np.linalg.norm(b - a, axis=1) / step_m).astype(int)
    new = [start + (end - start) * k / n for start, end, n in zip(a, b, count, strict=True) for k in range(1, int(n))]
    if not new:
        return vertices, faces, np.arange(len(faces))
    result = np.vstack([vertices, new])
    cut, source = split_at(result, faces, np.arange(len(vertices), len(result)))
    return result, cut, source


SCAN, ZIP = -1, -2
"""Surfaces that an open edge may belong to, beside the numbers of the planes."""
Edge = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class _Side:
    """What lies on the one side of an open edge."""

    tip: int
    """Third corner of its face."""
    surface: int
    """`SCAN`, `ZIP`, or the plane of a patch."""
    plane: int
    """Plane whose patch it continues, or `SCAN`."""
    rising: bool
    """Whether the face runs along the edge from the lower vertex number to the higher."""


def _edge(i: int, j: int) -> Edge:
    return (i, j) if i < j else (j, i)


class _Zip:
    """Open edges while they are being joined."""

    def __init__(self, vertices: np.ndarray, reach_m: float, open_sides: dict[Edge, _Side], used: dict[Edge, int]):
        """Starts with the open edges, and how many faces each edge between their vertices has."""
        self.vertices, self.reach_m = vertices, reach_m
        self.open, self.used = open_sides, used
        self.around: dict[int, set[int]] = {}
        for i, j in open_sides:
            self.around.setdefault(i, set()).add(j)
            self.around.setdefault(j, set()).add(i)
        self.faces: list[tuple[int, int, int]] = []
        self.planes: list[int] = []

    def length(self, i: int, j: int) -> float:
        """Distance of two vertices, m."""
        return float(np.linalg.norm(self.vertices[i] - self.vertices[j]))

    def _folded(self, edge: Edge, tip: int) -> bool:
        """Whether a face on the edge with this tip would lie on the face that is there."""
        a, b = self.vertices[edge[0]], self.vertices[edge[1]]
        along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-12)
        one, other = self.vertices[self.open[edge].tip] - a, self.vertices[tip] - a
        one, other = one - (one @ along) * along, other - (other @ along) * along
        size = float(np.linalg.norm(one) * np.linalg.norm(other))
        return size < 1e-14 or float(one @ other) > FOLDED * size

    def cost(self, i: int, j: int, k: int) -> float:
        """Longest new edge of a triangle, m; infinite where it may not be laid.

        It must join surfaces that differ: the outline of the scan by itself stays as it is, and so does a patch's. What
        would lie folded on another face (surfaces that overlap by a little) is a late choice, and one that needs an
        edge which two faces have the last.
        """
        surfaces, longest, new, poor, shared = [], 0.0, 0, 0, 0
        for a, b, tip in ((i, j, k), (j, k, i), (k, i, j)):
            edge = _edge(a, b)
            if edge in self.open:
                if self.open[edge].tip == tip:
                    return np.inf  # the face that is there
                poor |= int(self._folded(edge, tip))
                surfaces.append(self.open[edge].surface)
            elif self.used.get(edge, 0):
                shared += 1
            else:
                longest, new = max(longest, self.length(a, b)), new + 1
                if longest > self.reach_m:
                    return np.inf
        if shared and (shared > 1 or new):
            return np.inf  # an edge of three faces, for nothing
        if new > 1 and not all(self.around[v] for v in (i, j, k)):
            return np.inf  # the border there is closed by now
        p, q, r = self.vertices[[i, j, k]]
        if new == 3 or np.linalg.norm(np.cross(q - p, r - p)) < 1e-10:
            return np.inf
        if len(surfaces) > 1 and len(set(surfaces)) == 1 and surfaces[0] != ZIP:
            return np.inf
        return longest + self.reach_m * (poor + 2 * shared)

    def lay(self, i: int, j: int, k: int) -> list[Edge]:
        """Adds the triangle; returns the edges that it opened."""
        corners = ((i, j, k), (j, k, i), (k, i, j))
        met = [(self.open[_edge(a, b)], a < b) for a, b, _ in corners if _edge(a, b) in self.open]
        against = sum(1 if side.rising == rises else -1 for side, rises in met)
        ends = [self.open[_edge(v, w)].plane for v in (i, j, k) for w in self.around[v]]
        plane = max(ends)
        self.faces.append((i, k, j) if against > 0 else (i, j, k))
        self.planes.append(plane)
        fresh = []
        for a, b, tip in corners:
            edge = _edge(a, b)
            self.used[edge] = self.used.get(edge, 0) + 1
            if self.open.pop(edge, None) is not None:
                self.around[a].discard(b)
                self.around[b].discard(a)
            elif self.used[edge] == 1:
                self.open[edge] = _Side(tip, ZIP, plane, (a < b) == (against <= 0))
                self.around[a].add(b)
                self.around[b].add(a)
                fresh.append(edge)
        return fresh

    def ears(self, edges: Iterable[Edge]) -> Iterator[tuple[int, int, int]]:
        """Triangles over an edge and an open edge that follows it."""
        for i, j in edges:
            for end, start in ((i, j), (j, i)):
                for tip in sorted(self.around[end] - {start}):
                    yield start, end, tip


def close_cracks(
    vertices: np.ndarray, faces: np.ndarray, patch_plane: np.ndarray, reach_m: float = REACH_M
) -> tuple[np.ndarray, np.ndarray]:
    """Faces that join the patches' open border to the border beside it.

    Args:
        vertices: (n, 3) m.
        faces: (m, 3) scan and patches, one mesh.
        patch_plane: (m,) plane of each patch face, -1 for scan faces.
        reach_m: widest gap that is closed.

    Returns:
        faces (k, 3) and the plane (k,) whose patch each continues.
    """
    edges, owner = border_edges(faces)
    plane = patch_plane[owner]
    own = plane >= 0
    if not own.any() or len(np.unique(plane)) < 2:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    patch_spots, _ = points_on(vertices, edges[own], STEP_M)
    reach = np.asarray(KDTree(patch_spots).query(vertices[edges].mean(axis=1))[0]) < 2 * reach_m + STEP_M
    edges, owner, plane = edges[reach], owner[reach], plane[reach]
    active = np.zeros(len(vertices), bool)
    active[edges] = True
    every = edges_of(faces)
    near = active[every.ends].all(axis=1)
    used = {(int(a), int(b)): int(n) for (a, b), n in zip(every.ends[near], every.count[near], strict=True)}
    tips = faces[owner].sum(axis=1) - edges.sum(axis=1)
    sides = {
        _edge(int(a), int(b)): _Side(int(tip), int(p), int(p), bool(a < b))
        for (a, b), tip, p in zip(edges, tips, plane, strict=True)
    }
    mesh = _Zip(vertices, reach_m, sides, used)
    heap: list[tuple[float, int, int, int]] = []

    def offer(triangles: Iterable[tuple[int, int, int]], penalty: float = 0.0) -> None:
        for triangle in triangles:
            cost = mesh.cost(*triangle)
            if cost < np.inf:
                heapq.heappush(heap, (cost + penalty, *triangle))

    offer(mesh.ears(list(sides)))
    # Where the borders run side by side and meet nowhere: from each edge to the nearest vertices of the other.
    # Their penalty puts them behind every triangle that goes on from one already laid.
    for one in np.unique(plane):
        theirs = np.unique(edges[plane != one])
        if len(theirs) == 0:
            continue
        mine = edges[plane == one]
        count_near = min(4, len(theirs))
        _, index = KDTree(vertices[theirs]).query(vertices[mine].mean(axis=1), k=count_near)
        near = theirs[np.asarray(index).reshape(len(mine), count_near)]
        offer(((int(a), int(b), int(t)) for (a, b), row in zip(mine, near, strict=True) for t in row), 10 * reach_m)
    while heap:
        cost, i, j, k = heapq.heappop(heap)
        if mesh.cost(i, j, k) < np.inf:
            offer(mesh.ears(mesh.lay(i, j, k)))
    return np.array(mesh.faces, np.int64).reshape(-1, 3), np.array(mesh.planes, np.int64)
