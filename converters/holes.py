"""Floor plan, objects and wall planes in; the regions of floor and walls that furniture hid, out."""

from __future__ import annotations

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import KDTree
from shapely.geometry import Polygon
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
REACH_M = 0.6
"""Furniture this near a wall hides it."""
SHADOW_MARGIN_M = 0.15
SKIRT_M = 0.25
"""Width of the floor strip that joins a wall patch to the floor."""
SEEN_BORDER_SHARE = 0.35
"""Least share of a wall patch's border (its foot apart) that runs along seen wall: else it may be an opening."""


def floor_region(plan: FloorPlan, seen: BaseGeometry) -> BaseGeometry:
    """Floor that the plan says is there and the scan shows not or in part, in world x, y.

    Args:
        plan: of the floor.
        seen: union of the scan's floor faces, world x, y.
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
    flat = plane.flatten(vertices[np.unique(faces[inside])])
    seen = shapely.union_all(shapely.polygons(plane.flatten(vertices)[faces[inside]]))
    (low_u, low_v), (high_u, high_v) = flat.min(axis=0), flat.max(axis=0)
    extent = shapely.box(low_u, max(LIFT_M, low_v - 10), high_u, high_v)
    shadows, doors = [], []
    for placed in objects:
        points = to_world(placed, placed.vertices_b)
        distance = plane.distance(points)
        if np.abs(distance).min() > REACH_M and (distance.min() > 0) == (distance.max() > 0):
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


def skirts(plane: Plane, region: BaseGeometry, inner: np.ndarray) -> tuple[BaseGeometry, BaseGeometry]:
    """Floor strips in front of and behind the wall patches that stand on the floor, world x, y.

    Args:
        plane: of the wall.
        region: to be filled, in the plane's coordinates.
        inner: (2,) point on the room's side.

    Returns:
        Strip to add to the floor's region, strip to take out of it.
    """
    side = float(np.sign((inner - plane.origin[:2]) @ plane.normal[:2])) or 1.0
    add, cut = [], []
    for piece in polygons_of(region):
        foot = piece.intersection(shapely.box(piece.bounds[0], LIFT_M - 1e-6, piece.bounds[2], LIFT_M + 1e-6))
        if foot.is_empty:
            continue
        left, _, right, _ = foot.bounds
        if right - left < 1e-3:
            continue
        ends = [plane.lift(np.array([[u, LIFT_M]]))[0, :2] for u in (left, right)]
        for strips, direction in ((add, side), (cut, -side)):
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
    floor = floor_region(plan, seen)
    walls: list[tuple[Plane, BaseGeometry, float]] = []
    free = plan.grid.centres_w()[plan.traversable]
    for plane in planes:
        region = wall_region(plan, plane, vertices, faces, objects)
        if region.is_empty:
            continue
        middle = plane.lift(np.array([[region.centroid.x, 0.0]]))[0, :2]
        inner = free[int(np.argmin(np.linalg.norm(free - middle, axis=1)))]
        add, cut = skirts(plane, region, inner)
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
