"""Floor plan, objects and wall planes in; the regions of floor and walls that furniture hid, out."""

from __future__ import annotations

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import KDTree
from shapely.geometry import MultiPoint, Polygon
from shapely.geometry.base import BaseGeometry

from converters.alignment import yaw_matrix
from converters.fill import (
    WALL_TOLERANCE_M,
    Filled,
    Plane,
    fill_planes,
    floor_plane,
    polygons_of,
    seen_in_plane,
    wall_planes,
)
from converters.floor import LIFT_M
from converters.maps import FloorPlan, sample_faces
from converters.objects import PlacedObject, to_world
from converters.texture import ColourCloud
from converters.walls import cover_rectangles

FLOOR_TOLERANCE_M = 0.05
PATCH_SPACING_M = 0.03
"""Between the coloured points on patches."""
SMALL_HOLE_M2 = 0.3
"""Holes inside seen floor up to this size are closed whatever the plan says (mislabelled legs)."""
NOTCH_M = 0.3
"""Half the width up to which a notch in the seen floor's outline, under furniture, is floor."""
REACH_M = 0.6
"""Furniture this near a wall hides it."""
SHADOW_MARGIN_M = 0.15
COLUMN_M = 0.05
COLUMN_SEEN_M = 0.15
"""Height of wall seen in a column of `COLUMN_M` from which there is wall at all: the plane may run on past its end."""
COLUMN_GAP = 6
"""Columns: wider stretches without wall are openings."""
SKIRT_M = 0.25
"""Width of the floor strip that joins a wall patch to the floor."""
SEEN_BORDER_SHARE = 0.35
"""Least share of a wall patch's border (its foot apart) that runs along seen wall: else it may be an opening."""


def floor_region(plan: FloorPlan, seen: BaseGeometry, objects: tuple[PlacedObject, ...]) -> BaseGeometry:
    """Floor that the plan says is there and the scan shows not or in part, in world x, y.

    Args:
        plan: of the floor.
        seen: union of the scan's floor faces, world x, y.
        objects: under them, within the seen floor's outline, there is floor.
    """
    hidden = plan.floor & ~plan.floor_whole
    needed = ndimage.binary_dilation(hidden, np.ones((3, 3))) & plan.floor
    side = plan.grid.resolution_m
    boxes: list[BaseGeometry] = []
    for r0, r1, c0, c1 in cover_rectangles(needed, needed, disjoint=True) if needed.any() else []:
        corners = np.array([(c0, r0), (c1, r0), (c1, r1), (c0, r1)], float) * side + plan.grid.origin
        boxes.append(Polygon(corners @ yaw_matrix(plan.grid.yaw)[:2, :2].T))
    for polygon in polygons_of(seen):
        for ring in polygon.interiors:
            hole = Polygon(ring)
            if hole.area < SMALL_HOLE_M2:
                boxes.append(hole)
    outline = shapely.union_all([Polygon(p.exterior) for p in polygons_of(seen)])
    outline = outline.buffer(NOTCH_M, join_style="mitre").buffer(-NOTCH_M, join_style="mitre")
    for placed in objects:
        shadow = MultiPoint(to_world(placed, placed.vertices_b)[:, :2]).convex_hull.buffer(SHADOW_MARGIN_M)
        boxes.append(shadow.intersection(outline))
    return shapely.union_all(boxes) if boxes else Polygon()


def _passage(plan: FloorPlan, plane: Plane, along_m: float) -> bool:
    """True when the plan is traversable on both sides of the plane there: an opening, not a wall."""
    at = plane.origin + along_m * plane.u
    sides = np.array([at + d * plane.normal for d in (-0.3, -0.15, 0.0, 0.15, 0.3)])
    row, column, inside = plan.grid.cells(sides)
    return bool(inside.all() and plan.traversable[row, column].all())


def wall_region(
    plan: FloorPlan, plane: Plane, vertices: np.ndarray, faces: np.ndarray, objects: tuple[PlacedObject, ...]
) -> BaseGeometry:
    """What furniture hid of one wall, in the plane's coordinates (along the wall, height); doors hide nothing.

    The shadow of each near object on the wall, down to the floor and within the wall's seen length and height,
    less what the scan shows; pieces that touch too little seen wall, and openings that one can walk through, are
    left open.
    """
    inside = seen_in_plane(vertices, faces, plane, WALL_TOLERANCE_M)
    if len(inside) == 0:
        return Polygon()
    corners = plane.flatten(vertices)[faces[inside]]
    seen = shapely.union_all(shapely.polygons(corners))
    extent = _columns(corners)
    if extent.is_empty:
        return Polygon()
    shadows, doors = [], []
    for placed in objects:
        points = to_world(placed, placed.vertices_b)
        distance = plane.distance(points)
        if distance.max() < 0 or distance.min() > REACH_M or distance.mean() < -SHADOW_MARGIN_M:
            continue
        u, v = plane.flatten(points).T
        margin = SHADOW_MARGIN_M
        box = shapely.box(u.min() - margin, LIFT_M, u.max() + margin, v.max() + margin)
        (doors if placed.hinge is not None else shadows).append(box)
    if not shadows:
        return Polygon()
    region = shapely.union_all(shadows).intersection(extent)
    if doors:
        region = region.difference(shapely.union_all(doors))
    closed = []
    outline = seen.boundary.buffer(1e-4)
    for piece in polygons_of(shapely.make_valid(region.difference(seen))):
        left, _, right, _ = piece.bounds
        foot = shapely.box(left - 1, LIFT_M - 1, right + 1, LIFT_M + 1e-3)
        border = piece.exterior.difference(foot)
        if border.length == 0 or border.intersection(outline).length < SEEN_BORDER_SHARE * border.length:
            continue
        if any(_passage(plan, plane, u) for u in np.linspace(left, right, 5)[1:-1]) and piece.bounds[1] < 0.1:
            continue
        closed.append(piece)
    return shapely.union_all(closed) if closed else Polygon()


def _columns(corners: np.ndarray) -> BaseGeometry:
    """Region from the floor up to the seen wall's top, along the stretches where wall is seen at all.

    Args:
        corners: (m, 3, 2) of the wall's seen faces, plane coordinates.
    """
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2
    low, high = corners[..., 0].min(), corners[..., 0].max()
    count = max(int((high - low) / COLUMN_M), 1)
    column = np.clip(((corners[..., 0].mean(axis=1) - low) / COLUMN_M).astype(int), 0, count - 1)
    covered = np.bincount(column, area, count) / COLUMN_M > COLUMN_SEEN_M
    padded = np.pad(covered, COLUMN_GAP)
    covered = ndimage.binary_closing(padded, np.ones(2 * COLUMN_GAP + 1))[COLUMN_GAP:-COLUMN_GAP]
    top = float(corners[..., 1].max())
    runs, number = ndimage.label(covered)  # pyright: ignore[reportGeneralTypeIssues]
    boxes = []
    for k in range(1, number + 1):
        index = np.flatnonzero(runs == k)
        last = high if index[-1] == count - 1 else low + (index[-1] + 1) * COLUMN_M
        boxes.append(shapely.box(low + index[0] * COLUMN_M, LIFT_M, last, max(top, 2 * LIFT_M)))
    return shapely.union_all(boxes) if boxes else Polygon()


def skirts(plane: Plane, region: BaseGeometry) -> tuple[BaseGeometry, BaseGeometry]:
    """Floor strips in front of and behind the wall patches that stand on the floor, world x, y.

    Args:
        plane: of the wall; its normal looks into the room.
        region: to be filled, in the plane's coordinates.

    Returns:
        Strip to add to the floor's region, strip to take out of it.
    """
    add, cut = [], []
    for piece in polygons_of(region):
        foot = piece.intersection(shapely.box(piece.bounds[0], LIFT_M - 1e-6, piece.bounds[2], LIFT_M + 1e-6))
        if foot.is_empty:
            continue
        left, _, right, _ = foot.bounds
        if right - left < 1e-3:
            continue
        ends = [plane.lift(np.array([[u, LIFT_M]]))[0, :2] for u in (left, right)]
        for strips, direction in ((add, 1.0), (cut, -1.0)):
            off = direction * SKIRT_M * plane.normal[:2]
            strips.append(shapely.make_valid(Polygon([ends[0], ends[1], ends[1] + off, ends[0] + off])))
    return (
        shapely.union_all(add) if add else Polygon(),
        shapely.union_all(cut) if cut else Polygon(),
    )


def hidden_surfaces(
    plan: FloorPlan,
    planes: list[Plane],
    vertices: np.ndarray,
    faces: np.ndarray,
    objects: tuple[PlacedObject, ...],
) -> list[tuple[Plane, BaseGeometry, float]]:
    """Every plane with the region of it that ought to be surface: the floor first, then the walls.

    Args:
        plan: of the floor.
        planes: of the walls.
        vertices: (n, 3) of the levelled scan, m.
        faces: (m, 3) that stay.
        objects: as annotated; what they hid is filled.
    """
    ground = floor_plane(LIFT_M)
    inside = seen_in_plane(vertices, faces, ground, FLOOR_TOLERANCE_M)
    seen = shapely.union_all(shapely.polygons(vertices[faces[inside]][..., :2])) if len(inside) else Polygon()
    floor = floor_region(plan, seen, objects)
    walls: list[tuple[Plane, BaseGeometry, float]] = []
    for plane in planes:
        region = wall_region(plan, plane, vertices, faces, objects)
        if region.is_empty:
            continue
        add, cut = skirts(plane, region)
        floor = floor.difference(cut).union(add)
        walls.append((plane, region, WALL_TOLERANCE_M))
    return [(ground, floor, FLOOR_TOLERANCE_M), *walls]


def fill_holes(
    vertices: np.ndarray,
    faces: np.ndarray,
    labels: np.ndarray,
    plan: FloorPlan,
    objects: tuple[PlacedObject, ...],
    cloud: ColourCloud,
) -> tuple[Filled, ColourCloud]:
    """The cleaned scan with floor and walls closed where furniture hid them, and coloured points on the patches.

    Args:
        vertices: (n, 3) of the levelled scan, m.
        faces: (m, 3) that stay.
        labels: (n,) NYU40.
        plan: of the floor.
        objects: as annotated.
        cloud: coloured points of the cleaned scan; each patch takes the colours seen around it in its plane.
    """
    wanted = hidden_surfaces(plan, wall_planes(vertices, faces, labels), vertices, faces, objects)
    filled = fill_planes(vertices, faces, wanted)
    points, normals, colours = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for k, (plane, _, tolerance) in enumerate(wanted):
        patch = filled.faces[filled.patch_plane == k]
        near = np.abs(plane.distance(cloud.points)) < tolerance
        seen = np.flatnonzero(near & (np.abs(cloud.normals @ plane.normal) > 0.7))
        if len(patch) == 0 or len(seen) == 0:
            continue
        spots, _ = sample_faces(filled.vertices, patch, PATCH_SPACING_M)
        count = min(48, len(seen))
        distance, index = KDTree(cloud.points[seen]).query(spots, k=count)
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        weight = 1.0 / (distance + 0.05)
        shade = (cloud.colours[seen][index] * weight[..., None]).sum(axis=1) / weight.sum(axis=1, keepdims=True)
        points.append(spots)
        normals.append(np.tile(plane.normal, (len(spots), 1)))
        colours.append(shade)
    return filled, ColourCloud(np.vstack(points), np.vstack(normals), np.vstack(colours))
