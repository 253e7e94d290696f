"""Patch the holes that furniture left in floor and walls of a cleaned scan, by plane pieces behind them.

Wall planes are fitted by RANSAC, as the levelled floor's is. A raster of each plane marks missing surface. A patch
reaches under the scan's border on all sides, so that no crack is visible; it never collides.
"""

import dataclasses

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import KDTree

from converters.bodies.objects import PlacedObject, to_world
from converters.geometry import faces as geometry
from converters.records.errors import CLOUD
from converters.records.raw import CEILING, FLOOR, STRUCTURE_LABELS, ColourCloud
from converters.structure.clean import LIFT_M
from converters.structure.maps import FloorPlan
from interactive_nav_common.grids import label
from interactive_nav_common.rotations import yaw_matrix

WALL_TOLERANCE_M, FLOOR_TOLERANCE_M = 0.04, 0.05
"""Reconstructed surfaces wave by this much about their plane."""
RANSAC_DRAWS, REFINED = 150, 10
MIN_WALL_M2 = 0.5
MAX_WALLS = 60
BESIDE_M = 0.10
"""Surface parallel to a plane and this near to it stands in its place."""
LONG_STEPS = 100
"""Steps of sampling along a drawn face beyond which it counts as long: simplified walls are slivers."""
OVERLAP, FREE = 5, 2
"""Cells that a patch reaches under the scan around it, and beyond where nothing is visible (past a corner)."""
BEHIND_M = 0.002
"""Of a patch from the rearmost scan around it: enough for depth buffers, and above the collision floor."""
SPACING_M = 0.03
"""Between the coloured points on patches."""
REACH_M = 0.6
"""Furniture this near a wall hides it."""
SHADOW_M = 0.15
"""So much farther than its outline it hides floor and wall."""
COLUMN_VISIBLE_M = 0.15
"""Height of wall visible in a column from which there is wall at all: the plane may extend past its end."""
FRONT_M = 0.15
OPENING, CORNER = 12, 6
"""Columns: wider stretches without wall are openings; so many may be hidden in a corner."""
VISIBLE_BORDER_SHARE = 0.35
"""Least share of a wall patch's border (its foot apart) that runs along visible wall: else it may be an opening."""


Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (n, 3), m, and faces (m, 3)."""


@dataclasses.dataclass(frozen=True)
class Plane:
    """A plane with two axes."""

    origin: np.ndarray
    """(3,) m."""
    u: np.ndarray
    """(3,) unit; horizontal for walls."""
    v: np.ndarray
    """(3,) unit; up for walls."""

    @property
    def normal(self) -> np.ndarray:
        """Return (3,) unit, u x v."""
        return np.cross(self.u, self.v)

    def flatten(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 2) coordinates in the plane of (n, 3) points."""
        return (points - self.origin) @ np.stack([self.u, self.v], axis=1)

    def lift(self, flat: np.ndarray) -> np.ndarray:
        """Return (n, 3) points of the plane from (n, 2) coordinates."""
        return self.origin + flat[:, :1] * self.u + flat[:, 1:] * self.v

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) signed distances, m."""
        return (points - self.origin) @ self.normal


def wall_planes(vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> list[Plane]:
    """Fit vertical planes of the walls by sequential RANSAC (Fischler and Bolles 1981), the largest first.

    A draw is one upright face: its middle and horizontal normal are a hypothesis; its support is the area of the faces
    within `WALL_TOLERANCE_M` with normals within 25 degrees. The best of `RANSAC_DRAWS` is refined by least squares
    while its support grows (Chum, Matas and Kittler 2003, Locally optimized RANSAC). Normals point into the room.
    """
    label = geometry.face_labels(labels, faces)
    area, normal = geometry.face_areas(vertices, faces), geometry.unit_normals(vertices, faces)
    left = np.isin(label, [v for v in STRUCTURE_LABELS if v not in (FLOOR, CEILING)]) & (np.abs(normal[:, 2]) < 0.3)
    middle = vertices[faces].mean(axis=1)
    flat = normal[:, :2] / np.maximum(np.linalg.norm(normal[:, :2], axis=1, keepdims=True), 1e-9)
    rng = np.random.default_rng(0)
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


def faces_in_plane(vertices: np.ndarray, faces: np.ndarray, plane: Plane) -> np.ndarray:
    """Return indices of the faces within `BESIDE_M` of the plane and of like direction, panels and pillars included."""
    candidates = np.flatnonzero(np.abs(plane.distance(vertices))[faces].max(axis=1) < BESIDE_M)
    normal = geometry.face_vectors(vertices, faces[candidates])
    along = normal @ plane.normal
    return candidates[(along > 0.7 * np.linalg.norm(normal, axis=1)) & (along > 1e-9)]


def _grown(mask: np.ndarray, cells: int) -> np.ndarray:
    return np.asarray(ndimage.binary_dilation(mask, np.ones((3,) * mask.ndim), cells), bool)


@dataclasses.dataclass(frozen=True)
class Shown:
    """What a scan shows of a plane: (rows, columns) of square cells, rows along the plane's second axis."""

    plane: Plane
    low: np.ndarray
    """(2,) m in the plane, corner of cell [0, 0]."""
    cell_m: float
    visible: np.ndarray
    """bool."""
    depth_m: np.ndarray
    """Of the rearmost, along the plane's normal; infinite where there is none."""

    @classmethod
    def of(cls, plane: Plane, points: np.ndarray, low: np.ndarray, shape: tuple[int, int], cell_m: float) -> "Shown":
        """Rasterise (n, 3) points, half a cell apart."""
        column, row = np.floor((plane.flatten(points) - low) / cell_m).astype(int).T
        inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        depth_m = np.full(shape, np.inf)
        np.minimum.at(depth_m, (row[inside], column[inside]), plane.distance(points[inside]))
        return cls(plane, low, cell_m, np.isfinite(depth_m), depth_m)

    def patches(self, hidden: np.ndarray) -> Mesh:
        """Return vertices (k, 3) m and faces (j, 3) that cover hidden cells; they look along the normal."""
        rearmost = ndimage.minimum_filter(self.depth_m, OVERLAP)
        rearmost = np.where(np.isfinite(rearmost), rearmost, 0.0) - BEHIND_M
        pieces, count = label((_grown(hidden, OVERLAP) & self.visible) | _grown(hidden, FREE))
        done = [(np.zeros((0, 3)), np.zeros((0, 3), np.int64))]
        for k in range(1, count + 1):
            cells = np.argwhere(pieces == k)[:, ::-1] * self.cell_m + self.low
            outline = shapely.union_all(shapely.box(*cells.T, *(cells + self.cell_m).T), grid_size=1e-6)
            outline = outline.simplify(self.cell_m).segmentize(1.5 * OVERLAP * self.cell_m)
            flat, index = np.unique(geometry.triangulated(outline).reshape(-1, 2), axis=0, return_inverse=True)
            cell = np.clip(np.floor((flat - self.low) / self.cell_m).astype(int), 0, np.array(pieces.shape[::-1]) - 1)
            points = self.plane.lift(flat) + rearmost[cell[:, 1], cell[:, 0], None] * self.plane.normal
            done.append((points, index.reshape(-1, 3)))
        return geometry.stacked(done)


def _beside(mask: np.ndarray, plan: FloorPlan, shown: Shown, above_m: float) -> np.ndarray:
    """Return (columns,) bool: a (rows, columns) mask of the plan, so far before the plane."""
    along = shown.low[0] + (np.arange(shown.visible.shape[1]) + 0.5) * shown.cell_m
    points = shown.plane.lift(np.column_stack([along, 0 * along])) + above_m * shown.plane.normal
    return plan.grid.values(mask, points)


def _extent(plan: FloorPlan, shown: Shown) -> np.ndarray:
    """Return (rows, columns) bool: from the floor to the visible wall's top, where wall is visible or in a corner.

    Columns with too little visible wall take the lower height of their visible neighbours.
    """
    rows, columns = shown.visible.shape
    walled = np.flatnonzero(shown.visible.sum(axis=0) * shown.cell_m > COLUMN_VISIBLE_M)
    if not len(walled):
        return np.zeros((rows, columns), bool)
    wall = np.isin(np.arange(columns), walled)
    wall = np.asarray(ndimage.binary_closing(np.pad(wall, OPENING), np.ones(2 * OPENING + 1)), bool)[OPENING:-OPENING]
    wall |= _grown(wall, CORNER) & _beside(plan.floor, plan, shown, FRONT_M)
    # Where one may stand on both sides there is an opening.
    wall &= ~np.all([_beside(plan.traversable, plan, shown, d * FRONT_M) for d in (-2, -1, 0, 1, 2)], axis=0)
    top = rows - shown.visible[::-1].argmax(axis=0)
    before = walled[np.clip(np.searchsorted(walled, np.arange(columns), side="right") - 1, 0, len(walled) - 1)]
    after = walled[np.clip(np.searchsorted(walled, np.arange(columns)), 0, len(walled) - 1)]
    row = np.arange(rows)[:, None]
    # The scan's upper edge is ragged: nothing is built there.
    return wall & (row >= OVERLAP) & (row < np.minimum(top[before], top[after]) - 2)


def hidden_wall(plan: FloorPlan, shown: Shown, objects: tuple[PlacedObject, ...]) -> np.ndarray:
    """Return (rows, columns) bool: each near object's shadow on a wall, down to the floor; doors hide nothing.

    Pieces that touch too little visible wall are left open.
    """
    shadow, doors = np.zeros((2, *shown.visible.shape), bool)
    for placed in objects:
        points = to_world(placed, placed.vertices_b)
        distance = shown.plane.distance(points)
        if distance.max() < 0 or distance.min() > REACH_M or distance.mean() < -SHADOW_M:
            continue
        index = (shown.plane.flatten(points) - shown.low) / shown.cell_m
        margin = SHADOW_M / shown.cell_m
        left, right = int(max(index[:, 0].min() - margin, 0)), int(max(index[:, 0].max() + margin, 0))
        mask = doors if placed.category == "door" else shadow
        mask[: int(max(index[:, 1].max() + margin, 0)) + 1, left : right + 1] = True
    hidden = shadow & ~doors & _extent(plan, shown) & ~shown.visible
    pieces, count = label(hidden)
    for k in range(1, count + 1):
        border = _grown(pieces == k, 1) & (pieces == 0)
        border[:OVERLAP] = False
        if shown.visible[border].mean() < VISIBLE_BORDER_SHARE:
            hidden &= pieces != k
    return hidden


def fill_holes(
    planes: list[Plane], plan: FloorPlan, objects: tuple[PlacedObject, ...], cloud: ColourCloud, scan: Mesh
) -> tuple[Mesh, list[ColourCloud]]:
    """Patch floor and walls behind furniture of the `scan` (vertices (n, 3) m, faces (m, 3)) that is drawn.

    Return vertices and faces of the patches, and coloured points on them.
    """
    cell_m, turn = plan.grid.resolution_m / 2, yaw_matrix(plan.grid.yaw)
    ground = Plane(turn @ [*plan.grid.origin, LIFT_M], turn[:, 0], turn[:, 1])
    done, clouds = [], []
    for plane in (ground, *planes):
        tolerance_m = FLOOR_TOLERANCE_M if plane is ground else WALL_TOLERANCE_M
        faces = scan[1][faces_in_plane(*scan, plane)]
        fine = geometry.count_samples(scan[0], faces, cell_m / 2, LONG_STEPS) < CLOUD
        points, _ = geometry.sample_faces(scan[0], faces, cell_m / 2 if fine else cell_m, LONG_STEPS)
        if plane is ground:
            # The scan's floor is level by now; what is drawn below it is a reflection.
            points = points[plane.distance(points) > -1e-6]
            # Floor of the plan, and around what stands on it, which may be hidden.
            shadow = np.zeros(plan.grid.shape, bool)
            for placed in objects:
                plan.grid.add_below(shadow, to_world(placed, placed.vertices_b), SHADOW_M)
            around = plan.floor | (shadow & ~plan.occupied)
            floor = np.asarray(ndimage.binary_propagation(plan.floor, mask=around), bool)
            floor |= ndimage.binary_closing(floor, np.ones((5, 5)))  # what the cut left of a leg stands on floor too
            floor = floor.repeat(2, axis=0).repeat(2, axis=1)
            shown = Shown.of(plane, points, np.zeros(2), floor.shape, cell_m)
            patch = shown.patches(floor & ~shown.visible)
        elif len(points):
            flat = plane.flatten(points)
            low = np.array([flat[:, 0].min() - (CORNER + OVERLAP) * cell_m, LIFT_M - OVERLAP * cell_m])
            columns, rows = np.ceil((flat.max(axis=0) - low) / cell_m).astype(int) + [CORNER + OVERLAP, 1]
            shown = Shown.of(plane, points, low, (rows, columns), cell_m)
            patch = shown.patches(hidden_wall(plan, shown, objects))
        else:
            continue
        near = np.abs(plane.distance(cloud.points)) < tolerance_m
        shows = np.flatnonzero(near & (np.abs(cloud.normals @ plane.normal) > 0.7))
        done.append(patch)
        if len(patch[1]) and len(shows):  # points on it, coloured as what is visible of its plane around them
            spots, _ = geometry.sample_faces(*patch, SPACING_M)
            count = min(48, len(shows))
            distance, index = KDTree(cloud.points[shows]).query(spots, k=count)
            weight = 1.0 / (distance.reshape(-1, count) + 0.05)
            shade = (cloud.colours[shows][index.reshape(-1, count)] * weight[..., None]).sum(axis=1)
            shade /= weight.sum(axis=1, keepdims=True)
            clouds.append(ColourCloud(spots, np.tile(plane.normal, (len(spots), 1)), shade))
    return geometry.stacked(done), clouds
