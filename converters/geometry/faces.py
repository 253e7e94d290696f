"""Compute areas, labels and samples of triangle meshes, and join, part and simplify them."""

import math
from collections.abc import Iterable, Iterator
from typing import Any

import fast_simplification
import igl
import numpy as np
import shapely
import trimesh
from scipy import sparse

from converters.records.errors import SAMPLES, check_count

CREASE_DEG = 40.0
"""Faces that meet at less than this are one smooth surface."""
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


def corner_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m, 3, 3) unit normals at face corners, smooth except at creases, weighted by area and angle."""
    corners, count, at = vertices[faces], faces.size, weld(vertices)[1][faces]
    after = np.roll(np.arange(count).reshape(-1, 3), -1, axis=1).ravel()
    start, end = at.ravel(), at.ravel()[after]
    _, edge = np.unique(np.hstack([start * count + end, end * count + start]), return_inverse=True)
    there, back = (
        sparse.csr_array((np.ones(count), (np.arange(count), e)), (count, 2 * count)) for e in np.split(edge, 2)
    )
    this, other = (there @ back.T).nonzero()
    unit = unit_normals(vertices, faces)
    smooth = (unit[this // 3] * unit[other // 3]).sum(axis=1) > math.cos(math.radians(CREASE_DEG))
    pairs = np.column_stack([this, after[other]])[smooth]
    group = trimesh.graph.connected_component_labels(pairs, count)
    to_next, to_last = (np.roll(corners, k, axis=1) - corners for k in (-1, 1))
    cosine = (to_next * to_last).sum(axis=2) / np.maximum(np.linalg.norm(to_next, axis=2), 1e-12)
    angle = np.arccos(np.clip(cosine / np.maximum(np.linalg.norm(to_last, axis=2), 1e-12), -1, 1))
    weighted = (angle[..., None] * face_vectors(vertices, faces)[:, None]).reshape(-1, 3)
    total = np.stack([np.bincount(group, column) for column in weighted.T], axis=1)[group]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-15, total / np.maximum(length, 1e-15), np.repeat(unit, 3, axis=0)).reshape(-1, 3, 3)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m,) areas, m2."""
    return np.linalg.norm(face_vectors(vertices, faces), axis=1) / 2


def sample_faces(
    vertices: np.ndarray, faces: np.ndarray, spacing_m: float, most_steps: int = math.isqrt(2 * BLOCK)
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (k, columns) on every face, no further apart than the spacing, and (k,) the face of each.

    Points lie at even barycentric steps, or in even rows on faces with more than `most_steps` of these. Vertices (n, 3
    or more) may have more columns than x, y and z (m), such as texture coordinates.
    """
    if len(faces) == 0:
        return np.zeros((0, vertices.shape[1])), np.zeros(0, np.int64)
    count = count_samples(vertices, faces, spacing_m, most_steps)
    check_count("a surface", count, SAMPLES, f"points at {spacing_m:g} m", "remove long thin faces or split the source")
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
    """Yield points of one triangle in n rows along its shortest side: a long thin one needs few."""
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
    """Group vertices (n, 3) at equal positions; return (k,) one index of each group, sorted, and (n,) the group."""
    step = max(float(np.ptp(vertices, axis=0).max(initial=0.0)), 1e-9) * 1e-6
    cell = np.round(vertices / step).astype(np.int64)
    cell -= cell.min(axis=0) if len(cell) else 0
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]  # each below 2**20 + 2: in the order of x, y, z
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    return first, group.reshape(-1)


def loose_parts(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the connected part (m,) of each face; faces connect where vertices have equal positions."""
    joined = weld(vertices)[1][faces]
    edges = np.vstack([joined[:, :2], joined[:, 1:]])
    return trimesh.graph.connected_component_labels(edges, len(vertices))[joined[:, 0]]


def compacted(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices that some faces use, and the faces into these."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def triangulated(region: Any) -> np.ndarray:
    """Return (m, 3, 2) triangles, counter-clockwise, of polygons of shapely with holes, between their own corners."""
    parts = shapely.orient_polygons(shapely.get_parts(shapely.constrained_delaunay_triangles(region)))
    return shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]


def stacked(parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Join vertices (n, k) and faces (m, 3) of several meshes."""
    return trimesh.util.append_faces(*zip(*parts, strict=True))


def merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join vertices at equal positions and drop collapsed faces; return vertices, faces and kept face indices (m',)."""
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


PLAIN_FACES = 12
"""A part of so few faces stays as it is: a box."""
PART_SAMPLES = 1500
"""Points of a part that its simplification is measured at, about."""
MOST_M, LEAST_AREA = 0.01, 0.97
"""How far a surface may be simplified."""
LOOSER, ROUNDS = 1.6, 3
"""A mesh with too many faces is simplified again with an error larger by this factor, at most so many times."""
RIM_ROUNDS = 5
"""Tries to meet a number of faces where faces on rims count too."""
LOSS_M = 0.03
"""Sampling of a surface whose loss is measured."""
LEAST_FACES = 24
"""Of a part, however many there are."""
SMALL_M = 0.6
"""Longest side of an object that may be drawn as its hull."""


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (n,) distances of points to the nearest faces of a mesh, m."""
    mesh = np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int64)
    return np.sqrt(igl.point_mesh_squared_distance(np.ascontiguousarray(points, float), *mesh)[0])


def _simplified(vertices: np.ndarray, faces: np.ndarray, most_m: float, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return one part with half its faces, a quarter and so on, as long as it keeps the surface."""
    area = float(face_areas(vertices, faces).sum())
    points = np.vstack([vertices, sample_faces(vertices, faces, max(np.sqrt(2 * area / PART_SAMPLES), 1e-4))[0]])
    points = points[:: max(len(points) // (2 * PART_SAMPLES), 1)]
    best = vertices, faces
    low, high = 0, len(faces)
    while high - low > max(4, high // 12):
        target = (low + high) // 2
        few = fast_simplification.simplify(vertices, faces.astype(np.int32), target_count=max(target, 2))
        tried = np.asarray(few[0], float), np.asarray(few[1], np.int64)
        reached = len(tried[1])
        if (
            0 < reached < len(best[1])
            and face_areas(*tried).sum() >= least * area
            and distances(points, *tried).max() <= most_m
            and distances(tried[0], vertices, faces).max() <= most_m
        ):
            best, high = tried, target
        else:
            low = target
    return best


def simplify_within(
    vertices: np.ndarray, faces: np.ndarray, most_m: float = MOST_M, least: float = LEAST_AREA
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh of few faces, each loose part within `most_m`, its area at least the share `least` of the old."""
    vertices, faces, _ = merge_vertices(vertices, faces)
    part = loose_parts(vertices, faces)
    pieces = [compacted(vertices, faces[part == k]) for k in np.unique(part)]
    return stacked(_simplified(*p, most_m, least) if len(p[1]) > PLAIN_FACES else p for p in pieces)


def simplify_to(vertices: np.ndarray, faces: np.ndarray, most_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplify within `MOST_M` and `LEAST_AREA`; within more, and then in any case, to so many faces."""
    most_m, low = MOST_M, simplify_within(vertices, faces)
    while len(low[1]) > most_faces and most_m < MOST_M * LOOSER**ROUNDS:
        most_m *= LOOSER
        low = simplify_within(*low, most_m)
    return simplify(*low, most_faces)


def surface_loss(
    vertices: np.ndarray, faces: np.ndarray, low_vertices: np.ndarray, low_faces: np.ndarray
) -> tuple[float, float]:
    """Return the share of a mesh's area that a simplified one has, and how far the mesh lies from it at most, m."""
    kept = face_areas(low_vertices, low_faces).sum() / face_areas(vertices, faces).sum()
    points = sample_faces(vertices, faces, LOSS_M)[0]
    return float(kept), float(distances(points, low_vertices, low_faces).max())


def simplify_open(vertices: np.ndarray, faces: np.ndarray, most_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplify a surface with holes to about this many faces, and keep the holes' rims.

    Each edge of a rim gets a temporary upright face, because quadrics alone would fray windows and doorways.
    """
    vertices, faces, _ = merge_vertices(vertices, faces)
    if len(faces) <= most_faces:
        return simplify(vertices, faces, most_faces)
    edges, owner = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), np.repeat(np.arange(len(faces)), 3)
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    edges, owner = edges[first[count == 1]], owner[first[count == 1]]
    start, end = vertices[edges].transpose(1, 0, 2)
    normal = unit_normals(vertices, faces[owner])
    tips = (start + end) / 2 + normal * np.linalg.norm(end - start, axis=1, keepdims=True)
    points = np.vstack([vertices, tips])
    whole = np.vstack([faces, np.c_[edges[:, ::-1], len(vertices) + np.arange(len(edges))]]).astype(np.int32)
    target, left = most_faces, faces
    for _ in range(RIM_ROUNDS):
        # Only the replay returns which corner went where, but its places are in single precision, kilometres off.
        moved, *_, collapses = fast_simplification.simplify(points, whole, target_count=target, return_collapses=True)
        place = fast_simplification.replay_simplification(points, whole, collapses)[2]
        corners = np.asarray(place, np.int64)[faces]
        left = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
        left = left[np.unique(np.sort(left, axis=1), axis=0, return_index=True)[1]]
        vertices = np.asarray(moved, float)
        if len(left) <= 1.02 * most_faces:
            break
        target = max(target * most_faces // len(left), 4)
    return simplify(vertices, left, len(left))


def simplify_parts(parts: tuple[tuple[np.ndarray, np.ndarray], ...], max_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return all parts as one mesh of about this many faces, shared out by the square roots of their areas.

    Faces that simple parts do not need go to the others. Parts beyond their share are simplified within `MOST_M` and
    `LEAST_AREA`, and further only if the total is too large. A small part of many loose pieces becomes its convex hull.
    """
    done = [merge_vertices(*part)[:2] for part in parts]
    weight = np.sqrt([face_areas(*part).sum() for part in done])
    most = _shares(done, weight, max_faces)
    done = [simplify_within(*part) if len(part[1]) > n else part for part, n in zip(done, most, strict=True)]
    for k, n in enumerate(_shares(done, weight, max_faces)):
        vertices, faces = simplify(*done[k], n)
        if len(faces) > 2 * n and np.ptp(vertices, axis=0).max() < SMALL_M:
            hull = trimesh.convex.convex_hull(vertices)
            vertices, faces = simplify(np.asarray(hull.vertices, float), np.asarray(hull.faces, np.int64), n)
        done[k] = vertices, faces
    return stacked(done)


def _shares(parts: list[tuple[np.ndarray, np.ndarray]], weight: np.ndarray, total: int) -> list[int]:
    """Return how many of so many faces each part gets: by its weight, or all that it has where that is less."""
    need = np.array([len(faces) for _, faces in parts])
    taken, left = np.zeros(len(need), bool), total
    while not taken.all():
        share = left * weight / max(weight[~taken].sum(), 1e-12)
        fits = ~taken & (need <= share)
        if not fits.any():
            return np.where(taken, need, np.maximum(share, LEAST_FACES)).astype(int).tolist()
        taken, left = taken | fits, left - int(need[fits].sum())
    return need.tolist()
