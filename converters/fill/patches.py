"""Cleaned scan in; holes that furniture left in floor and walls covered with plane patches, out.

Wall planes are found by RANSAC, as the floor's was (`converters.structure.floor`), whose waves are taken out by now.
In each plane the patch is the difference between what ought to be surface there and what the scan shows. It lies
behind the scan and reaches under its border on all sides, so that no crack shows from within the room. The picture's
mesh never collides: nothing needs to be joined.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import shapely
from scipy.spatial import KDTree
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

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
MIN_PATCH_M2 = 1e-6
OVERLAP_M = 0.10
"""So far a patch reaches under the scan around it: as far as a seen surface may lie off its plane."""
FREE_M = 0.06
"""So far it reaches beyond its region where nothing was seen: behind a wall, under a floor, past a corner."""
SLIT_M = 0.01
"""Narrower pieces are no holes: the scan's faces and the region's outline are ragged."""
OUTLINE_M = 0.02
"""A patch's own outline is simplified to this: the scan hides it."""
BEHIND_M = 0.002
"""Of a patch's border from the rearmost scan around it: enough for depth buffers, and above the collision floor."""


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
class Patches:
    """Triangles that cover what the scan does not show; they look along their planes' normals."""

    vertices: np.ndarray
    """(k, 3) m."""
    faces: np.ndarray
    """(j, 3)."""
    plane: np.ndarray
    """(j,) index of the plane that each face lies in."""


def patches_of(
    vertices: np.ndarray, faces: np.ndarray, plane: Plane, region: BaseGeometry, tolerance_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """What the scan does not show of a plane's region, with an overlap; vertices (k, 3) and faces (j, 3).

    Args:
        vertices: (n, 3) of the scan, m.
        faces: (m, 3) that stay.
        plane: its normal looks into the room.
        region: that ought to be surface, plane coordinates.
        tolerance_m: distance within which scan faces count as the plane's surface.
    """
    shown = faces[seen_in_plane(vertices, faces, plane, tolerance_m)]
    seen = _union(vertices, shown, plane) if len(shown) else Polygon()
    spots, depth = plane.flatten(vertices[np.unique(shown)]), plane.distance(vertices[np.unique(shown)])
    missing = shapely.make_valid(region.difference(seen)).buffer(-SLIT_M / 2).buffer(SLIT_M / 2, quad_segs=1)
    around = shapely.union_all([*polygons_of(seen), *polygons_of(region)], grid_size=1e-6)
    points, triangles = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
    for polygon in polygons_of(missing):
        under = polygon.buffer(OVERLAP_M, quad_segs=1).intersection(around)
        grown = shapely.union_all([*polygons_of(under), polygon.buffer(FREE_M, quad_segs=1)], grid_size=1e-6)
        grown = grown.simplify(OUTLINE_M).segmentize(1.5 * OVERLAP_M)
        for piece in polygons_of(shapely.make_valid(grown)):
            corners = np.array(
                [t.exterior.coords[:3] for t in shapely.get_parts(shapely.constrained_delaunay_triangles(piece))]
            ).reshape(-1, 3, 2)
            e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            turned = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0] < 0
            corners[turned] = corners[turned][:, ::-1]
            flat, index = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
            triangles.append(index.reshape(-1, 3) + sum(map(len, points)))
            near = KDTree(spots).query_ball_point(flat, OVERLAP_M) if len(spots) else [[]] * len(flat)
            back = np.array([depth[at].min() if at else 0.0 for at in near]) - BEHIND_M
            points.append(plane.lift(flat) + back[:, None] * plane.normal)
    return np.vstack(points), np.vstack(triangles)


def fill_planes(vertices: np.ndarray, faces: np.ndarray, wanted: list[tuple[Plane, BaseGeometry, float]]) -> Patches:
    """The missing surface of each plane.

    Args:
        vertices: (n, 3) of the scan, m.
        faces: (m, 3) that stay.
        wanted: plane, region of it that ought to be surface (in its coordinates), and the distance within which
            scan faces count as its surface.
    """
    found = [patches_of(vertices, faces, *plane) for plane in wanted]
    first = np.cumsum([0, *(len(points) for points, _ in found)])
    return Patches(
        np.vstack([points for points, _ in found]),
        np.vstack([triangles + start for (_, triangles), start in zip(found, first, strict=False)]),
        np.repeat(np.arange(len(found)), [len(triangles) for _, triangles in found]),
    )
