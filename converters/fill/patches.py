"""Cleaned scan in; holes that furniture left in floor and walls closed with plane patches that join without cracks.

Wall planes are found by RANSAC, as the floor's was (`converters.structure.floor`), whose waves are taken out by now.
In each plane the patch is the difference between what ought to be surface there and what the scan shows. Its border
runs through the very vertices of the scan's border: a patch vertex that falls on a scan edge splits that face, one on
another patch's edge splits that edge, so that scan and patches are one mesh. Where the scan's border stands out of the
plane or ends before it, `converters.fill.join` closes what is left.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import shapely
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from converters.fill.join import SAME_M, border_edges, close_cracks, cut_teeth, on_segments, split_at
from converters.fill.loops import close_loops, without_dust, without_flaps
from converters.geometry.faces import face_areas, face_labels
from converters.records.raw import CEILING, FLOOR, STRUCTURE_LABELS

WALL_TOLERANCE_M = 0.04
"""Reconstructed walls wave by this much about their plane."""
RANSAC_DRAWS = 150
REFINED = 10
MIN_WALL_M2 = 0.5
MAX_WALLS = 60
BESIDE_M = 0.10
"""Surface parallel to a plane and this near to it stands in its place."""
IN_PLANE_M = 0.005
"""Border of surfaces across a plane, this near to it, is border in it."""
MIN_PATCH_M2 = 1e-6


@dataclasses.dataclass(frozen=True)
class Plane:
    """A plane with its own two axes."""

    origin: np.ndarray
    """(3,) m."""
    u: np.ndarray
    """(3,) unit; horizontal for walls."""
    v: np.ndarray
    """(3,) unit; up for walls."""

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit, u x v."""
        return np.cross(self.u, self.v)

    def flatten(self, points: np.ndarray) -> np.ndarray:
        """(n, 2) coordinates in the plane of (n, 3) points."""
        return (points - self.origin) @ np.stack([self.u, self.v], axis=1)

    def lift(self, flat: np.ndarray) -> np.ndarray:
        """(n, 3) points of the plane from (n, 2) coordinates."""
        return self.origin + flat[:, :1] * self.u + flat[:, 1:] * self.v

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(n,) signed distances, m."""
        return (points - self.origin) @ self.normal


def floor_plane(height_m: float) -> Plane:
    """The level plane, axes along x and y."""
    return Plane(np.array([0.0, 0.0, height_m]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))


def wall_planes(vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray, seed: int = 0) -> list[Plane]:
    """Vertical planes of the walls by sequential RANSAC (Fischler and Bolles 1981), the largest first.

    A draw is one upright face: its middle and the horizontal direction of its normal are a hypothesis; its
    support is the area of the faces within `WALL_TOLERANCE_M` whose normals agree within 25 degrees. The best
    of `RANSAC_DRAWS` is refined by least squares over its support, and over the support of that while it grows (Chum,
    Matas and Kittler 2003, Locally optimized RANSAC), which is then taken out. A plane's normal looks
    to the side that its faces look to: the room, as scans are made from inside.

    Args:
        vertices: (n, 3) m, z up.
        faces: (m, 3) that stay.
        labels: (n,) NYU40.
        seed: of the draws.
    """
    label = face_labels(labels, faces)
    area = face_areas(vertices, faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a) / np.maximum(2 * area, 1e-12)[:, None]
    left = np.isin(label, [v for v in STRUCTURE_LABELS if v not in (FLOOR, CEILING)]) & (np.abs(normal[:, 2]) < 0.3)
    middle = vertices[faces].mean(axis=1)
    flat = normal[:, :2] / np.maximum(np.linalg.norm(normal[:, :2], axis=1, keepdims=True), 1e-9)
    rng = np.random.default_rng(seed)
    planes = []
    while len(planes) < MAX_WALLS:
        index = np.flatnonzero(left)
        if area[index].sum() < MIN_WALL_M2:
            break
        best, best_support = None, 0.0
        draws = rng.choice(index, RANSAC_DRAWS, p=area[index] / area[index].sum())
        for d in np.unique(draws):
            near = np.abs((middle[index, :2] - middle[d, :2]) @ flat[d]) < WALL_TOLERANCE_M
            agree = near & (flat[index] @ flat[d] > 0.9)
            support = float(area[index[agree]].sum())
            if support > best_support:
                best, best_support = index[agree], support
        if best is None or best_support < MIN_WALL_M2:
            break
        # A face's normal is a poor direction for a long wall: the support of the plane through the support, and again.
        for _ in range(REFINED):
            weight = area[best] / area[best].sum()
            centre = weight @ middle[best, :2]
            spread = (middle[best, :2] - centre).T @ ((middle[best, :2] - centre) * weight[:, None])
            x, y = np.linalg.eigh(spread)[1][:, 1]
            if np.array([y, -x]) @ (weight @ flat[best]) < 0:  # the normal looks to where the scan's faces look
                x, y = -x, -y
            near = np.abs((middle[index, :2] - centre) @ [y, -x]) < WALL_TOLERANCE_M
            again = index[near & (flat[index] @ [y, -x] > 0.9)]
            if area[again].sum() < best_support * (1 + 1e-6):
                break
            best, best_support = again, float(area[again].sum())
        planes.append(Plane(np.array([*centre, 0.0]), np.array([x, y, 0.0]), np.array([0.0, 0.0, 1.0])))
        left[best] = False
    return planes


def seen_in_plane(vertices: np.ndarray, faces: np.ndarray, plane: Plane, tolerance_m: float) -> np.ndarray:
    """Indices of the faces that show the plane, those folded to a line in it left out.

    Every corner lies within the tolerance; or within `BESIDE_M` where the face is also parallel to the plane (panels
    and pillars that stand out of a wall, and what the reconstruction bent): a patch over it would be a second layer.
    """
    off = np.abs(plane.distance(vertices))[faces].max(axis=1)
    candidates = np.flatnonzero(off < max(tolerance_m, BESIDE_M))
    corners = vertices[faces[candidates]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = np.abs(normal @ plane.normal)
    shown = (off[candidates] < tolerance_m) | (along > 0.7 * np.linalg.norm(normal, axis=1))
    return candidates[shown & (along > 1e-9)]


def _union(vertices: np.ndarray, faces: np.ndarray, plane: Plane) -> BaseGeometry:
    triangles = shapely.polygons(plane.flatten(vertices)[faces])
    return shapely.union_all(triangles)


def polygons_of(geometry: BaseGeometry) -> list[Polygon]:
    """Its polygons, without lines, points and dust."""
    parts = [p for p in shapely.get_parts(geometry) if isinstance(p, Polygon)]
    nested = [q for g in shapely.get_parts(geometry) if g.geom_type == "GeometryCollection" for q in polygons_of(g)]
    return [p for p in parts if p.area > MIN_PATCH_M2] + nested


@dataclasses.dataclass(frozen=True)
class Filled:
    """The scan with its patches, one mesh."""

    vertices: np.ndarray
    """(n', 3): the given ones first, in their order."""
    faces: np.ndarray
    """(m', 3): scan faces (some split), then patches."""
    source_face: np.ndarray
    """(m',) the given face that each comes from, -1 for patches."""
    patch_plane: np.ndarray
    """(m',) index of the plane that a patch face lies in, -1 for scan faces."""


def _insert_on_rings(rings: list[np.ndarray], flat: np.ndarray) -> list[np.ndarray]:
    """Adds to each closed ring ((k, 2), last = first) those of the points that lie on its segments."""
    if len(flat) == 0:
        return rings
    tree = KDTree(flat)
    result = []
    for ring in rings:
        points = [ring[0]]
        for a, b in zip(ring[:-1], ring[1:], strict=True):
            length = float(np.linalg.norm(b - a))
            near = np.asarray(tree.query_ball_point((a + b) / 2, length / 2 + SAME_M), np.int64)
            if len(near) and length > 0:
                share = (flat[near] - a) @ (b - a) / length**2
                off = np.linalg.norm(a + share[:, None] * (b - a) - flat[near], axis=1)
                inside = (off < SAME_M) & (share > SAME_M / length) & (share < 1 - SAME_M / length)
                for s in np.sort(np.unique(np.round(share[inside], 9))):
                    points.append(a + s * (b - a))
            points.append(b)
        result.append(np.array(points))
    return result


def fill_planes(vertices: np.ndarray, faces: np.ndarray, wanted: list[tuple[Plane, BaseGeometry, float]]) -> Filled:
    """Adds the missing surface of each plane to the mesh.

    Args:
        vertices: (n, 3) of the scan, m.
        faces: (m, 3) that stay.
        wanted: plane, region of it that ought to be surface (in its coordinates), and the distance within which
            scan faces count as its surface.

    Returns:
        The joined mesh; patch faces look along the planes' normals.
    """
    total = len(vertices)
    edges, owner = border_edges(faces)
    patches: list[tuple[int, list[np.ndarray], Polygon]] = []
    borders: list[np.ndarray] = []
    for k, (plane, region, tolerance) in enumerate(wanted):
        inside = seen_in_plane(vertices, faces, plane, tolerance)
        close = np.abs(plane.distance(vertices)) < IN_PLANE_M  # a wall's lower edge borders the floor, too
        borders.append(edges[np.isin(owner, inside) | close[edges].all(axis=1)])
        seen = _union(vertices, faces[inside], plane) if len(inside) else Polygon()
        missing = shapely.make_valid(region.difference(seen))
        flat = plane.flatten(vertices[np.unique(borders[k])])
        for polygon in polygons_of(missing):
            rings = [np.asarray(r.coords) for r in (polygon.exterior, *polygon.interiors)]
            patches.append((k, _insert_on_rings(rings, flat), polygon))
    # Vertices that patches of other planes have on this plane (the line where floor and wall meet).
    lifted = {i: wanted[k][0].lift(np.vstack(rings)) for i, (k, rings, _) in enumerate(patches)}
    for i, (k, rings, polygon) in enumerate(patches):
        plane = wanted[k][0]
        others = [lifted[j] for j in lifted if patches[j][0] != k]
        if others:
            points = np.vstack(others)
            points = points[np.abs(plane.distance(points)) < SAME_M]
            patches[i] = (k, _insert_on_rings(rings, plane.flatten(points)), polygon)

    corners_of, patch_plane, spots = _triangulate(vertices, borders, wanted, patches)
    # New points at one place, from whichever patch, are one vertex.
    new_points, same = _merged(spots)
    corners_of = (
        np.where(corners_of < 0, total + same[np.maximum(-corners_of - 1, 0)], corners_of) if len(same) else corners_of
    )
    whole = (np.diff(np.sort(corners_of, axis=1), axis=1) > 0).all(axis=1)
    corners_of, patch_plane = corners_of[whole], patch_plane[whole]
    joined = np.vstack([vertices, new_points])
    split, source = split_at(joined, faces, np.arange(total, len(joined)))
    plane_of = np.concatenate([np.full(len(split), -1), patch_plane])
    source = np.concatenate([source, np.full(len(corners_of), -1)])
    joined, all_faces, cut = cut_teeth(joined, np.vstack([split, corners_of]), plane_of)
    plane_of, source = plane_of[cut], source[cut]
    more, more_plane = close_cracks(joined, all_faces, plane_of)
    all_faces, plane_of = np.vstack([all_faces, more]), np.concatenate([plane_of, more_plane])
    source = np.concatenate([source, np.full(len(more), -1)])
    keep = without_flaps(all_faces, plane_of >= 0)
    all_faces, plane_of, source = all_faces[keep], plane_of[keep], source[keep]
    keep = without_dust(joined, all_faces, plane_of)
    all_faces, plane_of, source = all_faces[keep], plane_of[keep], source[keep]
    all_faces, given, plane_of = close_loops(joined, all_faces, plane_of)
    return Filled(joined, all_faces, np.where(given >= 0, source[given], -1), plane_of)


def _merged(spots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points without duplicates (to `SAME_M`), and for each given one the index of what stands for it."""
    if len(spots) == 0:
        return spots.reshape(-1, 3), np.zeros(0, np.int64)
    pairs = KDTree(spots).query_pairs(SAME_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(spots),) * 2)
    group = connected_components(graph, directed=False)[1]
    first = np.unique(group, return_index=True)[1]
    return spots[first], group


def _triangulate(
    vertices: np.ndarray,
    borders: list[np.ndarray],
    wanted: list[tuple[Plane, BaseGeometry, float]],
    patches: list[tuple[int, list[np.ndarray], Polygon]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Constrained Delaunay triangles of every patch over its ring points.

    A ring point at a scan border vertex is that vertex; one inside a scan border edge lies on that edge, in
    space; any other lies in the plane.

    Returns:
        faces (k, 3): vertex indices, or -1 - i for new point i; plane (k,); new points (i, 3).
    """
    faces, planes = [], []
    spots: list[np.ndarray] = []
    for number in sorted({k for k, _, _ in patches}):
        plane, near = wanted[number][0], borders[number]
        corner = np.unique(near)
        tree = KDTree(plane.flatten(vertices[corner])) if len(corner) else None
        starts, ends = vertices[near[:, 0]], vertices[near[:, 1]]
        for _, rings, _ in (p for p in patches if p[0] == number):
            points = np.vstack([ring[:-1] for ring in rings])
            identity = np.full(len(points), -1, np.int64)
            known = np.zeros(len(points), bool)
            if tree is not None:
                distance, at = (np.asarray(v) for v in tree.query(points))
                known = distance < SAME_M
                identity[known] = corner[at[known]]
            edge, share = on_segments(points, plane.flatten(starts), plane.flatten(ends))
            on_plane = plane.lift(points)
            for i in np.flatnonzero(~known):
                spot = on_plane[i]
                if edge[i] >= 0:
                    spot = starts[edge[i]] + share[i] * (ends[edge[i]] - starts[edge[i]])
                spots.append(spot)
                identity[i] = -len(spots)
            outline = shapely.make_valid(shapely.Polygon(rings[0], rings[1:]))
            lookup = KDTree(points)
            for piece in polygons_of(outline):
                triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(piece))
                corners = np.array([np.asarray(t.exterior.coords)[:3] for t in triangles]).reshape(-1, 3, 2)
                distance, at = (np.asarray(v) for v in lookup.query(corners))
                e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
                turned = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0] < 0
                index = identity[at]
                index[turned] = index[turned][:, ::-1]
                fits = (distance < SAME_M).all(axis=1)
                faces.append(index[fits])
                planes.append(np.full(int(fits.sum()), number))
    if not faces:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
    return np.vstack(faces), np.concatenate(planes), np.array(spots).reshape(-1, 3)
