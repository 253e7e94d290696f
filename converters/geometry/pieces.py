"""A mesh of convex pieces in, few convex pieces out: what needs no decomposition."""

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from converters.geometry.faces import face_areas

MAX_PIECES = 16
"""Convex pieces of one object; the gates' limit (`hulls_per_object`)."""
SLIVER_SHARE = 0.1
"""Of a mesh's area that flat pieces may have."""
CONVEX_SHARE = 0.9
"""A piece that fills this share of its convex hull counts as convex."""


def convex_pieces(
    vertices: np.ndarray, faces: np.ndarray, most: int = MAX_PIECES, slack: float | None = None
) -> tuple[tuple[np.ndarray, np.ndarray], ...] | None:
    """Connected pieces of a mesh, if all of them are convex; the closest are joined, see `merge_pieces`.

    Pieces are connected through shared vertex indices, as V-HACD writes them (neighbours only touch).

    Args:
        vertices: (n, 3).
        faces: (m, 3).
        slack: how much joining may add, as a share of the mesh's bounding box.

    Returns:
        Vertices (n, 3) and faces (m, 3) of each piece's hull, or None where a piece is not convex.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    groups = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(faces)), min_len=1)
    points: list[np.ndarray] = []
    flat_m2 = 0.0
    for group in groups:
        own = vertices[np.unique(faces[group])]
        full = hull_volume(own)
        if full <= 0:
            flat_m2 += float(face_areas(vertices, faces[group]).sum())
            continue  # flat slivers
        if abs(trimesh.triangles.mass_properties(vertices[faces[group]]).volume) < CONVEX_SHARE * full:
            return None
        points.append(own)
    # Faces that share no vertices are flat pieces too, of a solid that only its source knows.
    if not points or flat_m2 > SLIVER_SHARE * float(face_areas(vertices, faces).sum()):
        return None
    points = merge_pieces(points, most, None if slack is None else slack * float(np.ptp(vertices, axis=0).prod()))
    hulls = [trimesh.convex.convex_hull(p) for p in points]
    return tuple((np.asarray(h.vertices, float), np.asarray(h.faces, np.int64)) for h in hulls)


def hull_volume(points: np.ndarray) -> float:
    """Of the convex hull; 0 for points in a plane."""
    try:
        return float(ConvexHull(points).volume) if len(points) > 3 else 0.0
    except QhullError:
        return 0.0


def box_volume(points: np.ndarray) -> float:
    """Of the box along the axes."""
    return float(np.ptp(points, axis=0).prod())


def merge_pieces(points: list[np.ndarray], most: int, slack: float | None = None) -> list[np.ndarray]:
    """Joins pairs of convex pieces, each time the pair whose common hull encloses least that neither does."""
    pieces, size = list(points), hull_volume if slack is None else box_volume
    volume = [size(p) for p in pieces]

    def cost(i: int, j: int) -> float:
        return size(np.vstack([pieces[i], pieces[j]])) - volume[i] - volume[j]

    alive = set(range(len(pieces)))
    needed = len(alive) > most or slack is not None
    costs = {(i, j): cost(i, j) for i in alive for j in alive if i < j} if needed else {}
    while costs:
        i, j = min(costs, key=lambda pair: (costs[pair], pair))
        if len(alive) <= most and (slack is None or costs[i, j] > slack):
            break
        joined = np.vstack([pieces[i], pieces[j]])
        pieces.append(joined[ConvexHull(joined).vertices])
        volume.append(size(joined))
        alive -= {i, j}
        costs = {pair: c for pair, c in costs.items() if not {i, j} & set(pair)}
        new = len(pieces) - 1
        costs |= {(k, new): cost(k, new) for k in alive}
        alive.add(new)
    return [pieces[k] for k in sorted(alive)]
