"""Compute areas, labels and samples of triangle meshes, and join, part and simplify them."""

import math
from collections.abc import Iterable, Iterator

import fast_simplification
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from converters.records.limits import SAMPLES, check_count

BLOCK, LARGE = 1_000_000, 10_000
"""Points that are sampled at a time; points on a face from which on it is a large one."""


def face_labels(labels: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m,) label of each face: the one that two corners share, else the first corner's."""
    a, b, c = labels[faces].T
    return np.where((b == c) & (a != b), b, a)


def face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m, 3) normals of the faces, twice as long as their areas (m2)."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def unit_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m, 3) unit normals of the faces; about zero without an area."""
    normal = face_vectors(vertices, faces)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def vertex_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (n, 3) sums of the `face_vectors` around each vertex."""
    return sum_at_vertices(face_vectors(vertices, faces), faces, len(vertices))


def sum_at_vertices(of_face: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Return (count, k) sums of values (m, k) of the faces around each vertex."""
    return np.stack([sum(np.bincount(c, column, count) for c in faces.T) for column in of_face.T], axis=1)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (n, 3) unit normals, weighted by face area; (0, 0, 1) where there are no faces."""
    out = vertex_vectors(vertices, faces)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 1e-12, out / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m,) areas, m2."""
    return np.linalg.norm(face_vectors(vertices, faces), axis=1) / 2


def sample_faces(
    vertices: np.ndarray, faces: np.ndarray, spacing_m: float, most_steps: int = math.isqrt(2 * BLOCK)
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (k, columns) on every face no further apart than the spacing, and (k,) the face of each.

    Points lie at even barycentric steps (no chance involved), or in even rows on faces with more than `most_steps` of
    these: long thin ones then need few. Vertices (n, 3 or more) may have more columns than x, y and z (m), such as
    texture coordinates.
    """
    if len(faces) == 0:
        return np.zeros((0, vertices.shape[1])), np.zeros(0, np.int64)
    count = count_samples(vertices, faces, spacing_m, most_steps)
    check_count(
        "a surface", count, SAMPLES, f"points at {spacing_m:g} m", "remove long thin faces, or split the source"
    )
    points, index = zip(*sampled(vertices, faces, spacing_m, most_steps), strict=True)
    return np.concatenate(points), np.concatenate(index)


def count_samples(
    vertices: np.ndarray, faces: np.ndarray, spacing_m: float, most_steps: int = math.isqrt(2 * BLOCK)
) -> float:
    """Return how many points `sample_faces` gives, about."""
    corners = vertices[faces]
    steps, short = _steps(corners, spacing_m).astype(float), _sides(corners).min(axis=1) / spacing_m
    return float(np.where(steps > most_steps, steps * (short / 2 + 1), steps**2 / 2).sum())


def sampled(
    vertices: np.ndarray, faces: np.ndarray, spacing_m: float, most_steps: int = math.isqrt(2 * BLOCK)
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the points of `sample_faces` and their faces, in blocks that fit the memory however large the faces are."""
    corners = vertices[faces]
    steps = _steps(corners, spacing_m)
    beyond = steps > most_steps
    for n in np.unique(steps[~beyond]):
        i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
        u, v = (i[i + j < n] + 1 / 3) / n, (j[i + j < n] + 1 / 3) / n
        weights = np.stack([1 - u - v, u, v], axis=1)
        chosen = np.flatnonzero(steps == n)
        for part in np.array_split(chosen, -(-len(chosen) * len(weights) // BLOCK)):
            large = len(weights) > LARGE  # matmul is faster there, and rounds otherwise
            points = weights @ corners[part] if large else np.einsum("kw,fwd->fkd", weights, corners[part])
            yield points.reshape(-1, vertices.shape[1]), np.repeat(part, len(weights))
    for face in np.flatnonzero(beyond):
        for points in _by_rows(corners[face], int(steps[face]), spacing_m):
            yield points, np.full(len(points), face)


def _by_rows(corners: np.ndarray, n: int, spacing_m: float) -> Iterator[np.ndarray]:
    """Points of one triangle in n rows along its shortest side: a long thin one needs few."""
    side = int(_sides(corners[None])[0].argmin())
    apex, first, last = corners[side - 2], corners[side], corners[side - 1]
    along = (np.arange(n) + 0.5) / n
    counts = np.maximum(np.ceil(along * np.linalg.norm((last - first)[:3]) / spacing_m).astype(int), 1)
    for rows in np.split(np.arange(n), np.flatnonzero(np.diff(np.cumsum(counts) * 4 // BLOCK)) + 1):
        row = np.repeat(rows, counts[rows])
        column = np.arange(len(row)) - np.repeat(np.cumsum(counts[rows]) - counts[rows], counts[rows])
        across = (column + 0.5) / counts[row]
        yield apex + along[row, None] * (first - apex + across[:, None] * (last - first))


def beyond_block(corners: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return (m,) bool: triangles (m, 3, 3) with more points, by even steps, than are sampled at a time."""
    return _steps(corners, spacing_m) > math.isqrt(2 * BLOCK)


def _sides(corners: np.ndarray) -> np.ndarray:
    """Return (m, 3) lengths of the sides of triangles, m, each from the corner before."""
    return np.linalg.norm((corners - np.roll(corners, 1, axis=1))[..., :3], axis=2)


def _steps(corners: np.ndarray, spacing_m: float) -> np.ndarray:
    return np.maximum(np.ceil(np.max(_sides(corners), axis=1) / spacing_m).astype(int), 1)


def weld(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group vertices (n, 3) at equal positions, to 1e-6 of the extent.

    Returns first (k,), the index of one vertex of each group, sorted by position, and group (n,) of each vertex.
    """
    step = max(float(np.ptp(vertices, axis=0).max(initial=0.0)), 1e-9) * 1e-6
    cell = np.round(vertices / step).astype(np.int64)
    cell -= cell.min(axis=0) if len(cell) else 0
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]  # each below 2**20 + 2: in the order of x, y, z
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    return first, group.reshape(-1)


def loose_parts(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the number (m,) of the connected part that each face belongs to.

    Faces connect where vertices lie at equal positions, so that a mesh split at its texture seams, or one whose
    triangles share no vertices, has the parts of the same mesh with shared vertices.
    """
    joined = weld(vertices)[1][faces]
    edges, count = np.vstack([joined[:, :2], joined[:, 1:]]), len(vertices)
    graph = sparse.coo_matrix((np.ones(len(edges), bool), edges.T), (count, count))
    return csgraph.connected_components(graph, directed=False)[1][joined[:, 0]]


def compacted(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices that some faces use, and the faces into these."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def stacked(parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Join vertices (n, k) and faces (m, 3) of several meshes."""
    vertices, faces = zip(*parts, strict=True)
    first = np.cumsum([0, *map(len, vertices)])
    return np.vstack(vertices), np.vstack([f + k for f, k in zip(faces, first, strict=False)])


def merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join vertices at equal positions (to 1e-6 of the extent) and drop faces that collapse.

    Returns vertices (n', 3), faces (m', 3) and (m',) the indices of the faces that stayed.
    """
    first, group = weld(vertices)
    faces = group[faces]
    keep = np.flatnonzero((faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0]))
    return vertices[first], faces[keep], keep


def simplify(vertices: np.ndarray, faces: np.ndarray, max_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplify by quadrics to at most about `max_faces` faces; equal positions are joined first."""
    vertices, faces, _ = merge_vertices(vertices, faces)
    if len(faces) > max_faces:
        points, triangles = fast_simplification.simplify(
            np.asarray(vertices, np.float64), faces.astype(np.int32), target_count=max_faces
        )[:2]
        vertices, faces, _ = merge_vertices(np.asarray(points, float), np.asarray(triangles, np.int64))
    return compacted(vertices, faces)
