"""Simplify a triangle mesh to as few triangles as keep its surface within an error, each loose part by itself."""

import fast_simplification
import numpy as np
import trimesh
from scipy.spatial import KDTree

from converters.geometry.faces import (
    compacted,
    face_areas,
    loose_parts,
    merge_vertices,
    sample_faces,
    simplify,
    stacked,
    unit_normals,
)

PLAIN_FACES = 12
"""A part of so few faces stays as it is: a box."""
SAMPLES = 1500
"""Points of a part that its simplification is measured at, about."""
MOST_M, LEAST_AREA = 0.01, 0.97
"""How far a surface may be simplified."""
LOOSER, ROUNDS = 1.6, 3
"""What exceeds a number of faces is simplified to an error larger by this factor, so many times."""
SPREAD, NEAREST, WORST = 6000, 8, 200
"""Samples of a mesh, about, that a distance is sought at; how many of them; distances that are computed exactly."""
RIM_ROUNDS = 5
"""Tries to meet a number of faces where faces on rims count too."""
LOSS_M = 0.03
"""Sampling of a surface whose loss is measured."""
LEAST_FACES = 24
"""Of a part, however many there are."""
SMALL_M = 0.6
"""Longest side of a thing that may be drawn as its hull."""


class Surface:
    """A triangle mesh that distances are measured to."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Vertices (n, 3) m and faces (m, 3)."""
        self._mesh = vertices, faces
        self._spacing_m = max(float(np.sqrt(2 * face_areas(vertices, faces).sum() / SPREAD)), 1e-4)
        samples, self._face = sample_faces(vertices, faces, self._spacing_m)
        self._tree = KDTree(samples, balanced_tree=False)  # as exact, and sooner built

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) distances of points, m, to the nearest of the faces whose samples are nearest.

        At most the samples' spacing too large, which is a share of the mesh's size.
        """
        vertices, faces = self._mesh
        index = self._tree.query(points, k=min(NEAREST, self._tree.n))[1].reshape(len(points), -1)
        corners = vertices[faces[self._face[index]]].reshape(-1, 3, 3)
        near = trimesh.triangles.closest_point(corners, np.repeat(points, index.shape[1], axis=0))
        return np.linalg.norm(near.reshape(*index.shape, 3) - points[:, None], axis=2).min(axis=1)

    def farthest(self, points: np.ndarray, most_m: float = 0.0) -> float:
        """Return the largest distance of points, m; exact where it is beyond `most_m`."""
        # None is farther than its nearest sample, nor nearer by more than the spacing: which can be the farthest?
        above = np.asarray(self._tree.query(points)[0])
        if above.max() <= most_m:
            return float(above.max())
        points = points[above > max(most_m, float(above.max()) - self._spacing_m)]
        about = self.distance(points)
        beyond = np.argsort(-about)[:WORST]
        if about[beyond[0]] <= most_m:
            return float(about[beyond[0]])
        mesh = trimesh.Trimesh(*self._mesh, process=False)
        return float(trimesh.proximity.closest_point(mesh, points[beyond])[1].max())


def _simplified(vertices: np.ndarray, faces: np.ndarray, most_m: float, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return one part with half its faces, a quarter and so on, as long as it keeps the surface."""
    area = float(face_areas(vertices, faces).sum())
    points = np.vstack([vertices, sample_faces(vertices, faces, max(np.sqrt(2 * area / SAMPLES), 1e-4))[0]])
    points = points[:: max(len(points) // (2 * SAMPLES), 1)]
    best, surface = (vertices, faces), Surface(vertices, faces)
    low, high = 0, len(faces)
    while high - low > max(4, high // 12):
        target = (low + high) // 2
        few = fast_simplification.simplify(vertices, faces.astype(np.int32), target_count=max(target, 2))
        tried = np.asarray(few[0], float), np.asarray(few[1], np.int64)
        reached = len(tried[1])
        if (
            0 < reached < len(best[1])
            and face_areas(*tried).sum() >= least * area
            and Surface(*tried).farthest(points, most_m) <= most_m
            and surface.farthest(tried[0], most_m) <= most_m
        ):
            best, high = tried, target
        else:
            low = target
    return best


def simplify_within(
    vertices: np.ndarray, faces: np.ndarray, most_m: float = MOST_M, least: float = LEAST_AREA
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh with as few faces as leave each loose part within `most_m` and its area above a share `least`.

    Equal positions are joined.
    """
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
    return float(kept), Surface(low_vertices, low_faces).farthest(sample_faces(vertices, faces, LOSS_M)[0])


def simplify_open(vertices: np.ndarray, faces: np.ndarray, most_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplify a surface with holes to at most about so many faces, and keep the holes' rims.

    Quadrics do not see a rim: windows and doorways would fray. So each edge of a rim gets a face that stands upright on
    it, and takes part, but is not in the result.
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
    whole = np.vstack([faces, np.column_stack([edges[:, ::-1], len(vertices) + np.arange(len(edges))])]).astype(
        np.int32
    )
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
    """Return all parts as one mesh of about so many faces, shared out by the roots of their areas.

    What plain parts leave of their shares goes to the others; one that has too many faces still is simplified within
    `MOST_M` and `LEAST_AREA`, and further only where all together have too many then. A level plane that is simplified
    as part of a larger mesh loses its outline; by itself it has few enough faces to stay. A small thing of many loose
    pieces, which cannot be simplified so far, becomes its convex hull.
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
