"""Floor plan, objects and wall planes in; the regions of floor and walls that furniture hid, out."""

from __future__ import annotations

import math

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import KDTree
from shapely.geometry import MultiPoint, Polygon
from shapely.geometry.base import BaseGeometry

from converters.bodies.objects import PlacedObject, to_world
from converters.fill.patches import (
    BESIDE_M,
    WALL_TOLERANCE_M,
    Patches,
    Plane,
    fill_planes,
    floor_plane,
    polygons_of,
    seen_in_plane,
    wall_planes,
)
from converters.geometry.faces import sample_faces
from converters.records.visual import ColourCloud
from converters.structure.floor import LIFT_M
from converters.structure.maps import FloorPlan
from converters.structure.walls import cover_rectangles
from interactive_nav_common.rotations import yaw_matrix

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
RIM_M = 0.05
"""The uppermost part of a wall that is not filled: the scan's own edge is ragged."""
BACK_M = 0.25
"""So far behind a wall no floor is filled."""
CORNER_M = 0.15
"""Two walls that end this near to their common line meet in it."""
SAME_WALL = 0.9
"""Least cosine between the normals of two planes of one bent wall."""
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
    plan: FloorPlan,
    plane: Plane,
    seen: BaseGeometry,
    extent: BaseGeometry,
    ends: tuple[float, float],
    objects: tuple[PlacedObject, ...],
) -> BaseGeometry:
    """What furniture hid of one wall, in the plane's coordinates (along the wall, height); doors hide nothing.

    The shadow of each near object on the wall, down to the floor and within the wall's extent, less what the scan
    shows; pieces that touch too little seen wall, and openings that one can walk through, are left open.

    Args:
        plan: of the floor.
        plane: of the wall.
        seen: union of the faces that show it, plane coordinates.
        extent: where there is wall, seen or hidden, plane coordinates.
        ends: of the wall, along it, m.
        objects: as annotated.
    """
    shadows, doors = [], []
    for placed in objects:
        points = to_world(placed, placed.vertices_b)
        distance = plane.distance(points)
        if distance.max() < 0 or distance.min() > REACH_M or distance.mean() < -SHADOW_MARGIN_M:
            continue
        u, v = plane.flatten(points).T
        margin = SHADOW_MARGIN_M
        left, right = u.min() - margin, u.max() + margin
        # A strip between a shadow and a corner is hidden too.
        left = min(left, ends[0]) if abs(left - ends[0]) < CORNER_M else left
        right = max(right, ends[1]) if abs(right - ends[1]) < CORNER_M else right
        box = shapely.box(left, LIFT_M, right, v.max() + margin)
        (doors if placed.hinge is not None else shadows).append(box)
    if not shadows or extent.is_empty:
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


def wall_ends(planes: list[Plane], spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Where walls end: at the corner with another wall where that is near, so that both end in one line.

    Args:
        planes: of the walls.
        spans: least and greatest coordinate along each that is seen, m.

    Returns:
        The same, moved to corners.
    """
    ends = []
    for i, (plane, span) in enumerate(zip(planes, spans, strict=True)):
        moved = list(span)
        nearest = [CORNER_M, CORNER_M]
        for j, other in enumerate(planes):
            turn = float(plane.u @ other.normal)
            if i == j or abs(turn) < 0.5:
                continue
            along = float((other.origin - plane.origin) @ other.normal) / turn
            corner = plane.origin + along * plane.u
            at = float((corner - other.origin) @ other.u)
            if not spans[j][0] - CORNER_M < at < spans[j][1] + CORNER_M:
                continue
            for k in (0, 1):
                if abs(along - span[k]) < nearest[k]:
                    nearest[k], moved[k] = abs(along - span[k]), along
        ends.append((moved[0], moved[1]))
    return ends


def wall_extent(corners: np.ndarray, ends: tuple[float, float]) -> BaseGeometry:
    """Region from the floor up to the seen wall's top, along the stretches where wall is seen at all.

    A column in which too little is seen is as high as the lower of the seen ones beside it. All end `RIM_M` below, in
    what is seen: nothing is built on top of it.

    Args:
        corners: (m, 3, 2) of the wall's seen faces, plane coordinates.
        ends: of the wall, along it, m.
    """
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2
    low, high = ends
    count = max(math.ceil((high - low) / COLUMN_M), 1)
    edges = np.linspace(low, high, count + 1)
    middle = corners[..., 0].mean(axis=1)
    column = np.clip(np.searchsorted(edges, middle) - 1, 0, count - 1)
    inside = (middle > low - COLUMN_M) & (middle < high + COLUMN_M)
    seen = np.bincount(column[inside], area[inside], count) / COLUMN_M > COLUMN_SEEN_M
    if not seen.any():
        return Polygon()
    padded = np.pad(seen, COLUMN_GAP)
    covered = ndimage.binary_closing(padded, np.ones(2 * COLUMN_GAP + 1))[COLUMN_GAP:-COLUMN_GAP]
    # At a corner the last columns may be hidden altogether.
    first, last = np.flatnonzero(covered)[[0, -1]]
    covered[: first if first <= COLUMN_GAP else 0] = True
    covered[last if count - last <= COLUMN_GAP + 1 else count :] = True
    top = np.zeros(count)
    np.maximum.at(top, column[inside], corners[..., 1].max(axis=1)[inside])
    known = np.flatnonzero(seen)
    at = np.arange(count)
    before = known[np.clip(np.searchsorted(known, at, side="right") - 1, 0, len(known) - 1)]
    after = known[np.clip(np.searchsorted(known, at), 0, len(known) - 1)]
    top = np.minimum(top[before], top[after])
    boxes = [
        shapely.box(edges[k], LIFT_M, edges[k + 1], max(top[k] - RIM_M, 2 * LIFT_M)) for k in np.flatnonzero(covered)
    ]
    return shapely.union_all(boxes, grid_size=1e-9)


def floor_sides(plane: Plane, region: BaseGeometry, extent: BaseGeometry) -> tuple[BaseGeometry, ...]:
    """Floor in front of the wall patches that stand on it, what lies behind the wall, and before it, world x, y.

    Args:
        plane: of the wall; its normal looks into the room.
        region: to be filled, in the plane's coordinates.
        extent: of the wall, the same.

    Returns:
        Strip to add to the floor's region, strip to take out of it, strip that no other wall may take out of it.
    """
    strips = []
    for geometry, direction, width in ((region, 1.0, SKIRT_M), (extent, -1.0, BACK_M), (extent, 1.0, BACK_M)):
        strips.append([])
        for piece in polygons_of(geometry):
            foot = piece.intersection(shapely.box(piece.bounds[0], LIFT_M - 1e-6, piece.bounds[2], LIFT_M + 1e-6))
            for part in shapely.get_parts(foot):
                left, _, right, _ = part.bounds
                if not right - left > 1e-3:  # empty: not a number
                    continue
                ends = [plane.lift(np.array([[u, LIFT_M]]))[0, :2] for u in (left, right)]
                off = direction * width * plane.normal[:2]
                strips[-1].append(shapely.make_valid(Polygon([ends[0], ends[1], ends[1] + off, ends[0] + off])))
    return tuple(shapely.union_all(s) if s else Polygon() for s in strips)


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
    floor = floor_region(plan, _seen(vertices, faces, ground, FLOOR_TOLERANCE_M)[0], objects)
    shown = [_seen(vertices, faces, plane, WALL_TOLERANCE_M) for plane in planes]
    planes = [plane for plane, (_, corners) in zip(planes, shown, strict=True) if len(corners)]
    shown = [s for s in shown if len(s[1])]
    ends = wall_ends(planes, [(float(c[..., 0].min()), float(c[..., 0].max())) for _, c in shown])
    walls: list[tuple[Plane, BaseGeometry, float]] = []
    front, behind, before = [], [], []
    for plane, (seen, corners), end in zip(planes, shown, ends, strict=True):
        extent = wall_extent(corners, end)
        region = wall_region(plan, plane, seen, extent, end, objects)
        for strips, strip in zip((front, behind, before), floor_sides(plane, region, extent), strict=True):
            strips.append(strip)
        for other, built, _ in walls:  # of one bent wall two planes may be found
            region = region.difference(_beside(plane, other, built))
        if not region.is_empty:
            walls.append((plane, region, WALL_TOLERANCE_M))
    if walls:
        # The other face of a thin wall has its own floor before it.
        inside = shapely.union_all(behind).difference(shapely.union_all(before))
        floor = floor.union(shapely.union_all(front)).difference(inside)
    return [(ground, floor, FLOOR_TOLERANCE_M), *walls]


def _beside(plane: Plane, other: Plane, region: BaseGeometry) -> BaseGeometry:
    """The part of another wall's region that stands in a plane's place, in its coordinates."""
    if float(plane.normal @ other.normal) < SAME_WALL:
        return Polygon()
    moved = shapely.transform(region, lambda flat: plane.flatten(other.lift(flat)))
    low, bottom, high, top = moved.bounds if not moved.is_empty else (0.0,) * 4
    # Both are upright: the distance is linear along the wall.
    along = np.linspace(low, high, 200)
    near = np.abs(other.distance(plane.lift(np.stack([along, np.zeros_like(along)], axis=1)))) < BESIDE_M
    if not near.any():
        return Polygon()
    return shapely.make_valid(moved).intersection(shapely.box(along[near][0], bottom, along[near][-1], top))


def _seen(vertices: np.ndarray, faces: np.ndarray, plane: Plane, tolerance_m: float) -> tuple[BaseGeometry, np.ndarray]:
    """Union of the faces that show a plane, and their corners (m, 3, 2), in its coordinates."""
    corners = plane.flatten(vertices)[faces[seen_in_plane(vertices, faces, plane, tolerance_m)]]
    return (shapely.union_all(shapely.polygons(corners)) if len(corners) else Polygon()), corners


def fill_holes(
    vertices: np.ndarray,
    faces: np.ndarray,
    labels: np.ndarray,
    plan: FloorPlan,
    objects: tuple[PlacedObject, ...],
    cloud: ColourCloud,
    shown: tuple[np.ndarray, np.ndarray],
) -> tuple[Patches, ColourCloud]:
    """What furniture hid of floor and walls, and coloured points on it.

    Args:
        vertices: (n, 3) of the levelled scan, m.
        faces: (m, 3) that stay.
        labels: (n,) NYU40.
        plan: of the floor.
        objects: as annotated.
        cloud: coloured points of the cleaned scan; each patch takes the colours seen around it in its plane.
        shown: vertices and faces of the simplified scan, which draws back from holes: patches reach under its border.
    """
    wanted = hidden_surfaces(plan, wall_planes(vertices, faces, labels), vertices, faces, objects)
    filled = fill_planes(*shown, wanted)
    points, normals, colours = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for k, (plane, _, tolerance) in enumerate(wanted):
        patch = filled.faces[filled.plane == k]
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
