"""A scan with its patches in, the small holes that are left between them closed; each is a loop of open border.

An edge with an odd number of faces is border; such edges form closed loops (every vertex has an even number of
them), also where surfaces overlap or three faces meet. A loop that a patch borders is closed with the triangulation of
least area over its own vertices (Barequet and Sharir 1995, Filling gaps in the boundary of a polyhedron), whatever its
shape: after it no edge of the loop is open.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from converters.fill.join import FACING, REACH_M, SAME_M, edge_pieces, edges_of
from converters.geometry.faces import face_areas

HOLE_M2 = 0.3
"""Holes up to this size that patches surround are closed, and those inside the seen floor (`converters.fill.holes`)."""
HALF = 0.5
"""Share of a loop that is patch border from which patches surround it."""
MAX_EDGES = 1000
USED_M2 = 1e-3
"""What an inner edge costs that the mesh has already, as area: three faces would meet there."""
FLAT_M2 = 1e-2
"""What a triangle without area costs."""
LONG = 1e-4
"""Share of the squared lengths of the inner edges in the cost: of triangulations of equal area that of short edges."""


def without_flaps(faces: np.ndarray, may_go: np.ndarray) -> np.ndarray:
    """Which faces stay when those go that have border all around, some of it open: nothing is opened by that.

    Args:
        faces: (m, 3).
        may_go: (m,) bool.

    Returns:
        keep (m,) bool.
    """
    keep = np.ones(len(faces), bool)
    while True:
        index = np.flatnonzero(keep)
        edges = edges_of(faces[index])
        count = edges.count[edges.of_face]
        found = np.flatnonzero((count % 2 == 1).all(axis=1) & (count == 1).any(axis=1) & may_go[index])
        touched: set[int] = set()
        for k in found:
            own = set(edges.of_face[k].tolist())
            if not own & touched:  # two at one edge: the second stays, its edge is whole by then
                touched |= own
                keep[index[k]] = False
        if not touched:
            return keep


def without_dust(vertices: np.ndarray, faces: np.ndarray, patch_plane: np.ndarray) -> np.ndarray:
    """Which faces stay when patches go that no edge joins to the scan and that are narrower than `REACH_M`.

    Such are left over between the surfaces seen; what is near to one has been joined to it by now.

    Args:
        vertices: (n, 3) m.
        faces: (m, 3) scan and patches, one mesh.
        patch_plane: (m,) plane of each patch face, -1 for scan faces.

    Returns:
        keep (m,) bool.
    """
    edges = edges_of(faces)
    piece = edge_pieces(edges)
    length = np.linalg.norm(vertices[edges.ends[:, 0]] - vertices[edges.ends[:, 1]], axis=1) * (edges.count % 2)
    around = np.bincount(piece, length[edges.of_face].sum(axis=1))
    size = np.bincount(piece, face_areas(vertices, faces))
    # One with more surface than its outline can enclose is folded on itself.
    whole = (2 * size > REACH_M * around) & (2 * np.pi * size < around**2)
    return np.isin(piece, piece[patch_plane < 0]) | whole[piece]


def border_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Simple closed loops of edges with an odd number of faces, each as its vertices (k,) in order."""
    edges = edges_of(faces)
    around: dict[int, list[int]] = {}
    for a, b in edges.ends[edges.count % 2 == 1].tolist():
        around.setdefault(a, []).append(b)
        around.setdefault(b, []).append(a)
    loops = []
    for start in sorted(around):
        while around[start]:
            path, at = [start], {start: 0}
            while around[path[-1]]:
                here = path[-1]
                there = around[here].pop()
                around[there].remove(here)
                if there in at:  # what lies between is a loop by itself
                    loops.append(np.array(path[at[there] :], np.int64))
                    for v in path[at[there] + 1 :]:
                        del at[v]
                    path = path[: at[there] + 1]
                else:
                    at[there] = len(path)
                    path.append(there)
    return loops


def least_surface(points: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, float]:
    """Triangulation of a closed loop of least area over its own points.

    Args:
        points: (k, 3) in order, m; k >= 3.
        used: (k, k) bool; inner edges that cost `USED_M2`.

    Returns:
        triangles (k - 2, 3) indices of points, running the way the loop runs; area, m2.
    """
    n = len(points)
    off = points[:, None] - points
    toll = LONG * (off**2).sum(axis=2) + USED_M2 * used
    cost, best = np.zeros((n, n)), np.zeros((n, n), np.int64)
    for span in range(2, n):
        for i in range(n - span):
            j = i + span
            k = np.arange(i + 1, j)
            area = np.linalg.norm(np.cross(off[k, i], off[j, i]), axis=1) / 2
            inner = np.where(k > i + 1, toll[i, k], 0.0) + np.where(k < j - 1, toll[k, j], 0.0)
            total = area + FLAT_M2 * (area < 1e-10) + inner + cost[i, k] + cost[k, j]
            at = int(np.argmin(total))
            cost[i, j], best[i, j] = total[at], k[at]
    triangles, todo = [], [(0, n - 1)]
    while todo:
        i, j = todo.pop()
        if j - i > 1:
            k = int(best[i, j])
            triangles.append((i, k, j))
            todo += [(i, k), (k, j)]
    result = np.array(triangles, np.int64)
    return result, float(face_areas(points, result).sum())


class _Borders:
    """What lies at the edges of a mesh, for the loops that are closed in it."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, patch_plane: np.ndarray):
        """Looks up, for each edge, its number, its first face and the highest plane of its faces."""
        self.vertices, self.faces, self.edges = vertices, faces, edges_of(faces)
        self.number = {(int(a), int(b)): k for k, (a, b) in enumerate(self.edges.ends)}
        self.first = np.full(len(self.edges.ends), -1)
        self.first[self.edges.of_face[::-1].ravel()] = np.repeat(np.arange(len(faces))[::-1], 3)
        self.plane = np.full(len(self.edges.ends), -1)
        np.maximum.at(self.plane, self.edges.of_face.ravel(), np.repeat(patch_plane, 3))

    def cover(self, loop: np.ndarray) -> tuple[np.ndarray, int] | None:
        """Faces over a loop, the last edge of which need not exist, and their plane; None where it is left."""
        points = self.vertices[loop]
        ring = list(zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))
        k = np.array([self.number.get((min(a, b), max(a, b)), -1) for a, b in ring])
        length = np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1)
        plane = np.where(k >= 0, self.plane[k], -1)
        surrounded = k[-1] >= 0 and length[plane >= 0].sum() > HALF * length.sum()
        most = max(HOLE_M2 if surrounded else 0.0, REACH_M * length.sum() / 2)
        # No surface over a loop is smaller than its shadow.
        shadow = np.cross(points - points.mean(axis=0), np.roll(points, -1, axis=0) - points.mean(axis=0)).sum(axis=0)
        if np.linalg.norm(shadow) / 2 > most or len(loop) > MAX_EDGES:
            return None
        used = np.array([[(min(a, b), max(a, b)) in self.number for b in loop.tolist()] for a in loop.tolist()])
        triangles, area = least_surface(points, used)
        if area > most:
            return None
        # The new faces run along each edge against the face that is there.
        single = np.where(k >= 0, self.edges.count[k], 0) == 1
        against = sum(
            length[i] * (1 if _runs(self.faces[self.first[k[i]]], *ring[i]) else -1) for i in np.flatnonzero(single)
        )
        values, counts = np.unique(plane[plane >= 0], return_counts=True)
        return loop[triangles[:, ::-1] if against > 0 else triangles], int(values[np.argmax(counts)])


def close_loops(
    vertices: np.ndarray, faces: np.ndarray, patch_plane: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Closes the small holes that patches border, and the slits that run from them into the rim.

    Loops are closed that are narrow (2 x area / length, which is the width of a slit, up to `REACH_M`), or that are
    patch border for the most part and enclose up to `HOLE_M2`. Of a larger loop the narrow pockets are: what lies
    between two of its vertices that face each other within `REACH_M`. Patches that no edge joins to the scan keep
    their outline.

    Args:
        vertices: (n, 3) m.
        faces: (m, 3) scan and patches, one mesh.
        patch_plane: (m,) plane of each patch face, -1 for scan faces.

    Returns:
        faces (m', 3), the given face (m',) that each is or is part of, -1 for new ones, plane (m',).
    """
    at = _Borders(vertices, faces, patch_plane)
    piece = edge_pieces(at.edges)
    own_outline = set(np.unique(piece[~np.isin(piece, piece[patch_plane < 0])]).tolist())
    new: list[tuple[np.ndarray, int]] = []

    loops = border_loops(faces)
    around = [float(np.linalg.norm(vertices[v] - np.roll(vertices[v], -1, axis=0), axis=1).sum()) for v in loops]
    for number in np.argsort(around, kind="stable")[::-1]:
        loop = loops[number]
        k = np.array(
            [at.number[min(a, b), max(a, b)] for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)]
        )
        ours = (at.edges.count[k] == 1) & (at.plane[k] >= 0)
        if piece[at.first[k[0]]] in own_outline:  # the longest comes first
            own_outline.remove(piece[at.first[k[0]]])
            continue
        if not ours.any():
            continue
        if covered := at.cover(loop):
            new.append(covered)
            continue
        rest = np.ones(len(loop), bool)
        for i, j in _pockets(vertices[loop], ours):
            inside = np.arange(i, j + 1 if i < j else j + 1 + len(loop)) % len(loop)
            if rest[inside].all() and (covered := at.cover(loop[inside])):
                new.append(covered)
                rest[inside[1:-1]] = False
    if not new:
        return faces, np.arange(len(faces)), patch_plane
    new_plane = np.repeat([plane for _, plane in new], [len(laid) for laid, _ in new])
    every = np.vstack([faces, *(laid for laid, _ in new)])
    source = np.concatenate([np.arange(len(faces)), np.full(len(new_plane), -1)])
    plane = np.concatenate([patch_plane, new_plane.astype(patch_plane.dtype)])
    return _flip_flat(vertices, every, source, plane)


def _pockets(points: np.ndarray, ours: np.ndarray) -> list[tuple[int, int]]:
    """Stretches of a loop whose ends face each other within `REACH_M`, the longest first.

    Args:
        points: (n, 3) of the loop in order, m.
        ours: (n,) bool: edges, from each point to the next, one of which a pocket must hold.

    Returns:
        (start, end) each, from start on to end, which may be the smaller number.
    """
    n = len(points)
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    gone, held = np.concatenate([[0.0], np.cumsum(step)]), np.concatenate([[0], np.cumsum(ours)])
    found = []
    for i, j in KDTree(points).query_pairs(REACH_M, output_type="ndarray"):
        i, j = (int(i), int(j)) if i < j else (int(j), int(i))
        way, count = gone[j] - gone[i], held[j] - held[i]
        if way > gone[-1] / 2:
            i, j, way, count = j, i, gone[-1] - way, held[-1] - count
        if count and way > FACING * float(np.linalg.norm(points[i] - points[j])) and (j - i) % n > 1:
            found.append((way, i, j))
    return [(i, j) for _, i, j in sorted(found, reverse=True)]


def _runs(face: np.ndarray, a: int, b: int) -> bool:
    """Whether a face runs from a to b."""
    corners = face.tolist()
    return (a, b) in zip(corners, [*corners[1:], corners[0]], strict=True)


def _flip_flat(
    vertices: np.ndarray, faces: np.ndarray, source: np.ndarray, plane: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Takes new faces without area away: the face over the longest edge is split at the vertex on that edge."""
    for _ in range(20):
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        sides = np.stack([np.linalg.norm(b - c, axis=1), np.linalg.norm(c - a, axis=1), np.linalg.norm(a - b, axis=1)])
        height = 2 * face_areas(vertices, faces) / np.maximum(sides.max(axis=0), 1e-12)
        flat = np.flatnonzero((source < 0) & (height < SAME_M))
        if len(flat) == 0:
            break
        edges = edges_of(faces)
        keep = np.ones(len(faces), bool)
        added: list[tuple[list[int], int, int]] = []
        done: set[int] = set()
        for f in flat:
            k = int(np.argmax(sides[:, f]))
            middle, i, j = (int(faces[f, (k + s) % 3]) for s in range(3))
            e = edges.of_face[f, (k + 1) % 3]
            over = [int(g) for g in np.flatnonzero((edges.of_face == e).any(axis=1)) if g != f]
            if len(over) != 1 or over[0] in done or f in done:
                continue
            g = over[0]
            done |= {g, int(f)}
            keep[[f, g]] = False
            for gone in (i, j):
                corners = [middle if int(v) == gone else int(v) for v in faces[g]]
                if len(set(corners)) == 3:
                    added.append((corners, int(source[g]), int(plane[g])))
        if not done:
            break
        faces = np.vstack([faces[keep], np.array([c for c, _, _ in added], np.int64).reshape(-1, 3)])
        source = np.concatenate([source[keep], np.array([s for _, s, _ in added], np.int64)])
        plane = np.concatenate([plane[keep], np.array([p for _, _, p in added], plane.dtype)])
    return faces, source, plane
