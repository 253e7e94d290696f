"""Compute a grid of floor, obstacles and traversable cells from a cleaned scan and objects' footprints.

The grid is turned to the building's main direction for fewer and flatter wall boxes; `resample` makes the stored,
axis-aligned map.
"""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import shapely
from scipy import ndimage
from shapely import MultiPoint, contains_xy

from converters.bodies.objects import PlacedObject, to_world
from converters.geometry.faces import beyond_block, face_labels, sampled, unit_normals
from converters.records.errors import SceneRejected
from converters.records.raw import CEILING, DOOR, FLOOR, STRUCTURE_LABELS, UNLABELLED, GivenMap
from interactive_nav_common.grids import label
from interactive_nav_common.rotations import yaw_matrix

RESOLUTION_M = 0.05
BAND_M = (0.02, 1.2)
"""Heights at which a robot meets obstacles."""
NOISE_M = 0.08
"""Reconstructed floors wave by a few centimetres: what is lower than this is floor, not obstacle."""
CLOSE_CELLS = 2
"""Gaps of up to twice this many cells in visible floor are floor."""
MAX_HOLE_M2 = 4.0
"""Larger holes inside visible floor are not taken for floor."""
BRIDGE_M = 1.2
"""Unseen floor so wide between two pieces of it is floor."""
MAX_CORNER_M2 = 0.5
"""Of unseen regions between floor and wall."""
MIN_OBSTACLE_CELLS = 3
MIN_FREE_M2 = 0.25
AWAY_SHARE = 0.4
"""Of what stands around a piece of floor, if so much faces away, it is the inside of a solid."""
MIN_APART_M2 = 2.25
"""Least area of floor that is cut off from the largest piece; smaller pieces are insides of cabinets or pillars."""
PAD_M = 0.4
HEIGHT_STEP_M = 0.1
"""Heights of low static furniture are rounded up to this: few boxes."""
LEAF_MARGIN_M, BOXED_M = 0.04, 0.01
"""Kept free around the space that a door's leaf sweeps; how far a leaf's box may stand out of its hulls."""
BEYOND_M = 0.5
"""Floor farther than this outside of the convex hull of all obstacles lies outside of the home."""
LEAST_BEYOND_M2 = 1.0
"""A home with less floor beyond its obstacles has no floor around it: scans end between walls."""
OPENINGS_M = (1.3, 2.0, 2.8)
"""Widths of discs that roll around a home and do not fit through its doorways, tried in order."""
LEAST_INSIDE_M2 = 3.0
"""Least floor of a home."""
RIGHT_SHARE, HOME_SHARE = 0.5, 0.25
"""Least share of the hull's floor that lies inside: to accept a width at once, and for a home without furniture."""


PIECE = 16_384
"""Points on a scan that are looked at together."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """A turned grid: cell [r, c] has its middle at `Rz(yaw) @ (origin + (c + 0.5, r + 0.5) * resolution)`."""

    yaw: float
    """rad."""
    origin: tuple[float, float]
    """m, in the turned frame."""
    shape: tuple[int, int]
    resolution_m: float

    def cells(self, points_w: np.ndarray, push: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return row, column and inside flag of (n, 2+) world points, pushed by so many cells."""
        turned = points_w[:, :2] @ yaw_matrix(self.yaw)[:2, :2]
        index = np.floor((turned - self.origin) / self.resolution_m + push).astype(np.int64)
        row, column = index[:, 1], index[:, 0]
        inside = (row >= 0) & (row < self.shape[0]) & (column >= 0) & (column < self.shape[1])
        return row, column, inside

    def values(self, mask: np.ndarray, points_w: np.ndarray) -> np.ndarray:
        """Return (n,) of a (rows, columns) mask at (n, 2+) world points; False outside."""
        row, column, inside = self.cells(points_w)
        inside[inside] = mask[row[inside], column[inside]]
        return inside

    def centres_w(self, rows: slice = slice(None), columns: slice = slice(None)) -> np.ndarray:
        """Return (rows, columns, 2) middles of the cells in the world, m."""
        row, column = np.meshgrid(
            *(np.arange(n)[at] for n, at in zip(self.shape, (rows, columns), strict=True)), indexing="ij"
        )
        turned = np.stack([column + 0.5, row + 0.5], axis=-1) * self.resolution_m + self.origin
        return turned @ yaw_matrix(self.yaw)[:2, :2].T

    def add_below(self, mask: np.ndarray, points_w: np.ndarray, margin_m: float) -> None:
        """Set the cells of a (rows, columns) mask whose middles lie in the hull of (n, 2+) points, with a margin."""
        shadow = MultiPoint(points_w[:, :2]).convex_hull.buffer(margin_m)
        row, column, _ = self.cells(shapely.get_coordinates(shadow))
        at = tuple(slice(max(int(k.min()), 0), max(int(k.max()) + 1, 0)) for k in (row, column))
        centres = self.centres_w(*at)
        mask[at] |= contains_xy(shadow, centres[..., 0], centres[..., 1])


@dataclasses.dataclass(frozen=True)
class FloorPlan:
    """What the scan says about each cell."""

    grid: Grid
    floor: np.ndarray
    """(rows, columns) bool: floor that is visible, or assumed."""
    occupied: np.ndarray
    """(rows, columns) bool: static structure in the robot's height band."""
    traversable: np.ndarray
    """(rows, columns) bool: floor, nothing static in the band, in a piece worth standing on."""
    wall_height_m: float
    leaf: np.ndarray | None = None
    """(rows, columns) bool: wall that a door's leaf touches as it turns, at the hinge mostly, cells being coarser than
    leaves. Not traversable, but no box may stand there. None: no such cell."""
    height_m: np.ndarray | None = None
    """(rows, columns) m: height of the structure in each cell; None: the wall's height everywhere."""
    unseen_m2: float = 0.0
    """Traversable floor that the scan does not show."""
    open_share: float = 0.0
    """Share of the traversable floor that lies beyond all obstacles: no walls enclose it."""


def swept_by_door(grid: Grid, placed: PlacedObject, margin_m: float = LEAF_MARGIN_M) -> np.ndarray:
    """Return (rows, columns) bool: cells that the leaf passes over its whole range, with a margin."""
    assert placed.hinge is not None
    mask = np.zeros(grid.shape, bool)
    flat = np.vstack([h.vertices for h in placed.hulls_b])
    low, high = placed.hinge.range_rad
    for angle in np.linspace(low, high, max(int((high - low) / math.radians(3)), 2)):
        turned = (flat - placed.hinge.origin) @ yaw_matrix(angle).T + placed.hinge.origin
        grid.add_below(mask, to_world(placed, turned), margin_m)
    return mask


def _drop_small(mask: np.ndarray, least_cells: int) -> np.ndarray:
    pieces, _ = label(mask)
    size = np.bincount(pieces.ravel())
    size[0] = 0
    return (size >= least_cells)[pieces]


def _fill_holes(floor: np.ndarray, occupied: np.ndarray, resolution_m: float) -> np.ndarray:
    """Add hidden regions enclosed by floor, and small ones between floor and wall: corners that furniture hid."""
    covered = floor | occupied
    enclosed = np.asarray(ndimage.binary_fill_holes(covered), bool) & ~covered
    holes, count = label(enclosed)
    result = floor.copy()
    for k in range(1, count + 1):
        hole = holes == k
        rim = ndimage.binary_dilation(hole, np.ones((3, 3))) & ~hole
        area, share = hole.sum() * resolution_m**2, floor[rim].mean()
        if (area <= MAX_HOLE_M2 and share > 0.7) or (area <= MAX_CORNER_M2 and share > 0.15):
            result |= hole
    return result


def _bridge(floor: np.ndarray, occupied: np.ndarray, resolution_m: float) -> np.ndarray:
    """Add hidden regions, up to `BRIDGE_M` wide, in which nothing stands and which part two pieces of floor."""
    line = np.ones((1, round(BRIDGE_M / resolution_m) + 1))
    between = np.logical_or(ndimage.binary_closing(floor, line), ndimage.binary_closing(floor, line.T))
    pieces, _ = label(_drop_small(floor, math.ceil(MIN_FREE_M2 / resolution_m**2)))
    gaps, count = label(between & ~floor & ~occupied)
    for k in range(1, count + 1):
        beside = pieces[np.asarray(ndimage.binary_dilation(gaps == k, np.ones((3, 3))), bool)]
        if np.count_nonzero(np.unique(beside)) > 1:
            floor = floor | (gaps == k)
    return floor


def _without_insides(free: np.ndarray, shown: "_Shown", resolution_m: float) -> np.ndarray:
    """Return the pieces of floor to stand on: the largest, and others that are not inside closed solids.

    The walls of a room face it; the sides of a solid face away from its inside.
    """
    pieces, count = label(free)
    size = np.bincount(pieces.ravel(), minlength=count + 1) * resolution_m**2
    size[0] = 0.0
    facing, around = np.zeros((2, count + 1))
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside = np.where(free, 0, np.roll(pieces, -step, axis)).ravel()  # the grid's margin is never free
        facing += np.bincount(beside, step * shown.facing[axis].ravel(), count + 1)
        around += np.bincount(beside, shown.solid.ravel(), count + 1)
    keep = (size >= MIN_APART_M2) & (facing >= -AWAY_SHARE * around)
    keep[np.argmax(size)] = bool(free.any())
    return keep[pieces]


def make_floor_plan(
    vertices_w: np.ndarray,
    faces: np.ndarray,
    labels: np.ndarray,
    objects: tuple[PlacedObject, ...],
    given: GivenMap | None,
    yaw: float,
    exact: bool = False,
) -> FloorPlan:
    """Compute floor and obstacles from the cleaned scan (floor at z = 0, NYU40 labels) after the cut.

    `given` is the source's traversable map; `yaw` of the grid is the building's `main_direction`, rad.
    """
    used = (vertices_w[np.unique(faces)] @ yaw_matrix(yaw))[:, :2]
    low = np.floor((used.min(axis=0) - PAD_M) / RESOLUTION_M) * RESOLUTION_M
    columns, rows = np.ceil((used.max(axis=0) + PAD_M - low) / RESOLUTION_M).astype(int)
    grid = Grid(yaw, (float(low[0]), float(low[1])), (int(rows), int(columns)), RESOLUTION_M)
    shown = _shown(grid, vertices_w, faces, face_labels(labels, faces))
    floor_visible = shown.floor >= 2
    occupied = _drop_small(shown.solid >= 3, MIN_OBSTACLE_CELLS)
    # Reconstruction holes in walls: join along rows and columns only, so that doorways stay open.
    for line in (np.ones((1, 4)), np.ones((4, 1))):
        occupied |= ndimage.binary_closing(occupied, line)

    under, swept = np.zeros((2, *grid.shape), bool)
    for placed in objects:
        for hull in placed.hulls_b:
            grid.add_below(under, to_world(placed, hull.vertices), RESOLUTION_M / 2)
        if placed.category == "door":
            swept |= swept_by_door(grid, placed, LEAF_MARGIN_M + BOXED_M * exact)
    # What is left of the door's scan in its sweep goes, walls stay.
    occupied &= ~swept | (shown.solid_wall >= 3)
    closed = ndimage.binary_closing(floor_visible, iterations=CLOSE_CELLS) | under | floor_visible
    if given is not None:
        shape: Any = given.traversable.shape
        upright = Grid(0.0, given.origin, shape, given.resolution_m)
        closed |= upright.values(given.traversable, grid.centres_w().reshape(-1, 2)).reshape(grid.shape)
    # What lies behind a line of obstacles (the inside of a wall, the far side of one that a chair's annotated
    # pose cuts) is no floor: it must connect to visible floor.
    floor = np.asarray(ndimage.binary_propagation(floor_visible & ~occupied, mask=closed & ~occupied), bool)
    floor = _fill_holes(floor, occupied, RESOLUTION_M)
    if given is None and not exact:
        floor = _bridge(floor, occupied, RESOLUTION_M)
    if given is None:
        floor &= ~floor_outside(floor, occupied, under, RESOLUTION_M)
    traversable = _drop_small(floor, math.ceil(MIN_FREE_M2 / RESOLUTION_M**2))
    traversable = _without_insides(traversable, shown, RESOLUTION_M)
    if not traversable.any():
        raise SceneRejected(
            "scan: no traversable floor is left (no floor label below 1.2 m of free height); "
            "check the floor's labels and height"
        )
    height, leaf = _heights(shown, occupied, 1 if exact else 5), swept & (~traversable if exact else occupied)
    unseen_m2 = float((traversable & ~floor_visible).sum()) * RESOLUTION_M**2
    open_share = float(beyond_obstacles(occupied, RESOLUTION_M)[traversable].mean())
    return FloorPlan(grid, floor, occupied, traversable, shown.wall_height_m, leaf, height, unseen_m2, open_share)


@dataclasses.dataclass(frozen=True)
class _Shown:
    """What points on the scan show in each cell: (rows, columns) counts of them, and heights in m."""

    floor: np.ndarray
    solid: np.ndarray
    """Neither floor nor ceiling, in the robot's band."""
    solid_wall: np.ndarray
    """Of those, walls and the like, no doors."""
    structure: np.ndarray
    """Walls, doors and the like, in the band."""
    top_m: np.ndarray
    """Of the highest that is no structure."""
    facing: np.ndarray
    """(2, rows, columns) along rows and columns: sum of the normals of what is solid."""
    wall_height_m: float
    """Of the tallest structure but a few stray points."""


def _shown(grid: Grid, vertices_w: np.ndarray, faces: np.ndarray, of_face: np.ndarray) -> _Shown:
    counts, top, heights = np.zeros((4, *grid.shape), np.int64), np.zeros(grid.shape), [np.zeros(0)]
    facing, turn = np.zeros((2, *grid.shape)), yaw_matrix(grid.yaw)[:2, 1::-1]
    kept, of_structure = np.flatnonzero(of_face != CEILING), np.isin(of_face, STRUCTURE_LABELS)
    unit = unit_normals(vertices_w, faces)[:, :2]
    spacing_m = grid.resolution_m / 3
    # A large face's points are pushed off the cells' borders: along a wall on one, rounding would share them out.
    large = beyond_block(vertices_w[faces[kept]], spacing_m)
    for chosen, push in ((kept[~large], 0.0), (kept[large], 1e-6)):
        # In blocks: the points on a large hall do not fit the memory, and blocks that fit the cache are the fastest.
        blocks = sampled(vertices_w, faces[chosen], spacing_m)
        pieces = ((p[k : k + PIECE], f[k : k + PIECE]) for p, f in blocks for k in range(0, len(f), PIECE))
        for points, face in pieces:
            face, z = chosen[face], points[:, 2]
            label, structural = of_face[face], of_structure[face]
            is_floor = label == FLOOR
            heights.append(z[structural & ~is_floor])
            high = (z > NOISE_M) & ~is_floor
            solid = high & (z < BAND_M[1])
            level = (is_floor & (np.abs(z) < 0.2)) | ((label == UNLABELLED) & (np.abs(z) < NOISE_M))
            top_of = high & ~structural
            used = np.flatnonzero(level | solid | top_of)
            row, column, inside = grid.cells(points[used], push)
            used, cell = used[inside], (row * grid.shape[1] + column)[inside]
            structural, solid, level, top_of = structural[used], solid[used], level[used], top_of[used]
            for count, shown in zip(
                counts, (level, solid, solid & structural & (label[used] != DOOR), solid & structural), strict=True
            ):
                count += np.bincount(cell[shown], minlength=count.size).reshape(count.shape)
            normal = unit[face[used[solid]]] @ turn
            for axis in range(2):
                facing[axis] += np.bincount(cell[solid], normal[:, axis], top.size).reshape(top.shape)
            np.maximum.at(top.reshape(-1), cell[top_of], z[used[top_of]])
    walls = np.concatenate(heights)
    tall = float(np.clip(np.percentile(walls, 98), BAND_M[1], 2.5)) if len(walls) else BAND_M[1]
    return _Shown(counts[0], counts[1], counts[2], counts[3], top, facing, round(tall, 3))


def _heights(shown: _Shown, occupied: np.ndarray, around: int) -> np.ndarray:
    """Return (rows, columns) m, the height of the structure in each cell; see `FloorPlan.height_m`.

    A cell is low if the robot's band shows no label such as wall or window and its highest point lies in the band. The
    highest neighbour counts, so that ragged edges do not lower a cabinet.
    """
    tall_m = shown.wall_height_m
    low = occupied & (shown.structure < 3) & (shown.top_m < BAND_M[1])
    top_m = ndimage.maximum_filter(np.where(low, shown.top_m, 0.0), around)
    low &= top_m > 0
    rounded = np.ceil(top_m / HEIGHT_STEP_M - 1e-9) * HEIGHT_STEP_M
    return np.where(low, np.minimum(rounded, tall_m), tall_m).round(3)


def beyond_obstacles(occupied: np.ndarray, resolution_m: float) -> np.ndarray:
    """Return (rows, columns) bool: cells over `BEYOND_M` outside of the convex hull of the occupied cells."""
    hull = MultiPoint(np.argwhere(occupied)).convex_hull
    if not hull.area:  # all on one line, or none
        return np.zeros(occupied.shape, bool)
    # A hair more: cells on the line are within, however it is rounded.
    around = hull.buffer(BEYOND_M / resolution_m + 1e-6, join_style="mitre", mitre_limit=math.inf)
    return ~shapely.intersects_xy(around, *np.indices(occupied.shape))


def floor_outside(floor: np.ndarray, occupied: np.ndarray, furniture: np.ndarray, resolution_m: float) -> np.ndarray:
    """Return the part of a floor outside the walls of a home; all masks are (rows, columns) bool.

    A disc too wide for doorways covers it from beyond all obstacles. Nothing is outside if no floor lies beyond the
    obstacles, or if the walls enclose too little floor or less than half of the movables' footprints.
    """
    cell_m2 = resolution_m**2
    beyond = beyond_obstacles(occupied, resolution_m)
    if (floor & beyond).sum() * cell_m2 < LEAST_BEYOND_M2:
        return np.zeros_like(floor)
    best, within = np.zeros_like(floor), (floor & ~beyond).sum()
    for width_m in OPENINGS_M:
        inside = _inside(floor, occupied, beyond, width_m / resolution_m)
        best = max(best, inside, key=np.count_nonzero)
        if inside.sum() >= RIGHT_SHARE * within:
            break
    under = floor & furniture
    is_home = 2 * (under & best).sum() >= under.sum() if under.any() else best.sum() >= HOME_SHARE * within
    return floor & ~best if is_home and best.sum() * cell_m2 >= LEAST_INSIDE_M2 else np.zeros_like(floor)


def _inside(floor: np.ndarray, occupied: np.ndarray, beyond: np.ndarray, width: float) -> np.ndarray:
    """Return the floor that a disc of `width` cells, which comes from beyond, does not cover nor cut off."""
    pad, radius = int(width) + 2, width / 2
    around = np.pad(beyond, pad, constant_values=True)
    fits = np.asarray(ndimage.distance_transform_edt(~np.pad(occupied, pad))) > radius
    middles = np.asarray(ndimage.binary_propagation(around & fits, mask=fits), bool)
    outside = np.asarray(ndimage.distance_transform_edt(~middles)) <= radius
    core = np.pad(floor, pad) & fits & ~outside & ~around
    inside = np.asarray(ndimage.binary_propagation(core, mask=np.pad(floor, pad) & ~outside), bool)
    return inside[pad:-pad, pad:-pad]


def resample(grid: Grid, mask: np.ndarray, resolution_m: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Resample a mask to an axis-aligned grid; a cell is true if its middle and corners are.

    Return the mask [rows along y, columns along x], and the x, y of the outer corner of cell [0, 0], m.
    """
    centres = grid.centres_w()[mask]
    low = np.floor((centres.min(axis=0) - grid.resolution_m) / resolution_m) * resolution_m
    high = centres.max(axis=0) + grid.resolution_m
    columns, rows = np.ceil((high - low) / resolution_m).astype(int) + 1
    result = np.ones((int(rows), int(columns)), bool)
    inset = 0.0 if grid.yaw else 0.25  # corner samples, drawn in a little where cells coincide
    for dy, dx in ((0.5, 0.5), *itertools.product((inset, 1 - inset), repeat=2)):
        r, c = np.indices(result.shape)
        sample = np.stack([c + dx, r + dy], axis=-1).reshape(-1, 2) * resolution_m + low
        result &= grid.values(mask, sample).reshape(result.shape)
    return result, (float(low[0]), float(low[1]))
