"""A triangle mesh and an error in; as few triangles as keep its surface out, every loose part for itself."""

from __future__ import annotations

import fast_simplification
import numpy as np
import trimesh
from scipy import sparse
from scipy.sparse import csgraph

from converters.geometry.faces import face_areas, merge_vertices, sample_faces

PLAIN_FACES = 12
"""A part of so few faces stays as it is: a box."""
SAMPLES = 1500
"""Points of a part that its simplification is measured at, about."""


def loose_parts(faces: np.ndarray, count: int) -> np.ndarray:
    """(m,) number of the connected part, by shared vertices, that each face is of.

    Args:
        faces: (m, 3).
        count: of the vertices.
    """
    edges = np.vstack([faces[:, :2], faces[:, 1:]])
    graph = sparse.coo_matrix((np.ones(len(edges), bool), edges.T), (count, count))
    return csgraph.connected_components(graph, directed=False)[1][faces[:, 0]]


def surface_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n,) distance of points to a triangle mesh, m."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return np.asarray(trimesh.proximity.closest_point(mesh, points)[1])


def _simplified(vertices: np.ndarray, faces: np.ndarray, most_m: float, least: float) -> tuple[np.ndarray, np.ndarray]:
    """One part with half its faces, a quarter and so on, as long as it keeps the surface."""
    area = float(face_areas(vertices, faces).sum())
    points = np.vstack([vertices, sample_faces(vertices, faces, max(np.sqrt(2 * area / SAMPLES), 1e-4))[0]])
    points = points[:: max(len(points) // (2 * SAMPLES), 1)]
    best = vertices, faces
    low, high = 0, len(faces)
    while high - low > max(4, high // 12):
        target = (low + high) // 2
        made = fast_simplification.simplify(vertices, faces.astype(np.int32), target_count=max(target, 2))[:2]
        tried = np.asarray(made[0], float), np.asarray(made[1], np.int64)
        reached = len(tried[1])
        if (
            0 < reached < len(best[1])
            and face_areas(*tried).sum() >= least * area
            and surface_distance(points, *tried).max() <= most_m
            and surface_distance(tried[0], vertices, faces).max() <= most_m
        ):
            best, high = tried, target
        else:
            low = target
    return best


def simplify_within(
    vertices: np.ndarray, faces: np.ndarray, most_m: float = 0.01, least: float = 0.97
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with as few faces as leave each loose part where it was.

    Args:
        vertices: (n, 3) m.
        faces: (m, 3).
        most_m: farthest that a point of either surface may lie from the other.
        least: share of each part's area that stays.

    Returns:
        vertices, faces; equal positions are joined.
    """
    vertices, faces, _ = merge_vertices(vertices, faces)
    part = loose_parts(faces, len(vertices))
    done, first = [], 0
    for k in np.unique(part):
        own, index = np.unique(faces[part == k], return_inverse=True)
        piece = vertices[own], index.reshape(-1, 3)
        if len(piece[1]) > PLAIN_FACES:
            piece = _simplified(*piece, most_m, least)
        done.append((piece[0], piece[1] + first))
        first += len(piece[0])
    return np.vstack([v for v, _ in done]), np.vstack([f for _, f in done])
