"""Build the structure of a Sweet Home 3D drawing from its walls, rooms and openings.

Frame: metres, z up, x to the right of the plan, y opposite to the plan's. A wall's left side is to the left when
walking from its start to its end.
"""

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from typing import Any

import numpy as np
import shapely

from converters.read.homes.parts import HomePart
from converters.read.homes.sh3d_archive import called, metres, number, outline, point
from converters.read.homes.sh3d_models import WHITE, Look, Sheet, fitted
from converters.records.errors import EXTENT_M, SceneRejected
from converters.records.raw import Window

HEIGHT_M, LOW_M = 2.5, 1.2
"""Of a wall that says nothing; lower ones are built-in furniture to the map."""
ARC_STEP_RAD = math.radians(10)
SHORT_M, NEAR_M, THIN_M = 1e-3, 1e-6, 0.01
SHAFT_M, COVERED = 0.6, 0.1
"""Least width of what walls enclose and becomes floor without a room, and most of it that rooms may cover."""
PARALLEL = 0.8
"""Least cosine between a wall and the openings that cut it."""
SILL_M = 0.05
"""What begins lower is a doorway, and has a floor."""


@dataclasses.dataclass
class Wall:
    """Hold a straight wall, or a piece of a round one."""

    element: ElementTree.Element
    ends: np.ndarray
    """(2, 2) start and end, m."""
    thickness_m: float
    height_m: np.ndarray
    """(2,) at start and end."""
    base_m: float
    joins: list[str | None]
    corners: np.ndarray
    """(2, 2, 2): of the left and the right side, at start and end."""

    @property
    def along(self) -> np.ndarray:
        """Return the (2,) unit vector."""
        run = self.ends[1] - self.ends[0]
        return run / np.linalg.norm(run)

    @property
    def left(self) -> np.ndarray:
        """Return the (2,) unit vector to the left."""
        return self.along[::-1] * [-1.0, 1.0]

    @property
    def length_m(self) -> float:
        """Return the distance between its ends."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))

    def square(self) -> np.ndarray:
        """Return (2, 2, 2) corners, as `corners`, of the wall cut off square at its ends."""
        return np.stack([self.ends + s * self.left * self.thickness_m / 2 for s in (1, -1)])

    def polygon(self) -> Any:
        """Return its footprint."""
        return shapely.Polygon([*self.corners[0], *self.corners[1][::-1]])

    def ray(self, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return from one end: (2,) direction away, (2,) points on the sides to its left and right."""
        away = self.along if end == 0 else -self.along
        left = away[::-1] * [-1.0, 1.0] * self.thickness_m / 2
        return away, self.ends[end] + left, self.ends[end] - left


def read_walls(elements: list[ElementTree.Element], base_m: dict[str | None, float], note: Any) -> list[Wall]:
    """Return the walls of a drawing, mitred where they are joined."""
    walls: list[Wall] = []
    pieces: dict[str, list[int]] = {}
    for element in elements:
        name, thick = element.get("id") or f"#{len(walls)}", number(element, "thickness", 7.5) / 100
        start, end = point(element, "xStart", "yStart"), point(element, "xEnd", "yEnd")
        high = metres(element, "height", default=100 * HEIGHT_M)[0]
        tall = np.array([high, metres(element, "heightAtEnd", default=100 * high)[0]])
        if np.linalg.norm(end - start) < SHORT_M or not 0 < tall.max() < EXTENT_M:
            note(f"{called(element)}: has no length or height; it is left out")
            continue
        if thick < SHORT_M:
            note(f"{called(element)}: has no thickness; {100 * THIN_M:g} cm is taken")
            thick = THIN_M
        points = _round(start, end, number(element, "arcExtent", 0.0))
        if max(thick, *np.ptp(points, axis=0)) > EXTENT_M:
            raise SceneRejected(f"{called(element)}: is larger than {EXTENT_M:g} m; mend the drawing")
        share = np.linspace(0, 1, len(points))
        pieces.setdefault(name, [])
        names = [element.get("wallAtStart"), *[name] * (len(points) - 2), element.get("wallAtEnd")]
        for k in range(len(points) - 1):
            some = np.maximum(tall[0] + share[k : k + 2] * (tall[1] - tall[0]), 0.0)
            level_m = base_m[element.get("level")]
            wall = Wall(element, points[k : k + 2], thick, some, level_m, names[k : k + 2], np.zeros(0))
            wall.corners = wall.square()
            pieces[name].append(len(walls))
            walls.append(wall)
    for k, wall in enumerate(walls):
        for end in (0, 1):
            others = [walls[i] for i in pieces.get(wall.joins[end] or "", []) if i != k]
            at = wall.ends[end]
            near = [(float(np.linalg.norm(o.ends[e] - at)), n, e) for n, o in enumerate(others) for e in (0, 1)]
            if near and min(near)[0] < max(wall.thickness_m, SHORT_M):
                _mitre(wall, end, others[min(near)[1]], min(near)[2])
    for wall in walls:  # neighbours that are thicker than a wall is long would turn its sides around
        around = (wall.corners[:, 1] - wall.corners[:, 0]) @ wall.along < SHORT_M / 2
        wall.corners[around] = wall.square()[around]
    return walls


def _round(start: np.ndarray, end: np.ndarray, extent: float) -> np.ndarray:
    """Return (n, 2) points of a wall from start to end; a positive extent (rad) bulges to its left."""
    extent = math.remainder(extent, 2 * math.tau)
    if abs(extent) < math.radians(1) or abs(math.sin(extent / 2)) < NEAR_M:
        return np.stack([start, end])
    chord = end - start
    right = chord[::-1] * [1.0, -1.0]
    centre = (start + end) / 2 + right / 2 / math.tan(extent / 2)
    angle = -extent * np.linspace(0, 1, max(math.ceil(abs(extent) / ARC_STEP_RAD), 2) + 1)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.vstack([start, (centre + np.einsum("ijk,j->ki", turn, start - centre))[1:-1], end])


def _mitre(wall: Wall, end: int, other: Wall, other_end: int) -> None:
    away, left, right = wall.ray(end)
    turn, other_left, other_right = other.ray(other_end)
    cross = away[0] * turn[1] - away[1] * turn[0]
    if abs(cross) < 0.05:
        return
    for mine, foot, meets in ((0, left, other_right), (1, right, other_left)):
        gap = meets - foot
        corner = foot + away * (gap[0] * turn[1] - gap[1] * turn[0]) / cross
        if np.linalg.norm(corner - foot) <= 2 * max(wall.thickness_m, other.thickness_m):
            wall.corners[mine if end == 0 else 1 - mine, end] = corner


@dataclasses.dataclass(frozen=True)
class Opening:
    """Hold what a door or window cuts out of walls."""

    footprint: Any
    """Polygon in plan."""
    along: np.ndarray
    """(2,) unit, of its width."""
    middle: np.ndarray
    """(2,) of its footprint."""
    width_m: float
    bottom_m: float
    top_m: float
    shape: np.ndarray | None
    """(n, 2) in the unit square, y down; None: all of it."""

    def window(self) -> Window:
        """Return the box that it fills."""
        sizes = np.array([self.width_m, shapely.area(self.footprint) / self.width_m, self.top_m - self.bottom_m])
        middle = np.array([*self.middle, (self.bottom_m + self.top_m) / 2])
        return Window(middle, sizes / 2, math.atan2(self.along[1], self.along[0]))

    def within(self, wall: Wall) -> Any:
        """Return what it cuts out of a wall, in (along the wall, above its base); None: nothing."""
        cosine = float(self.along @ wall.along)
        if abs(cosine) < PARALLEL or self.top_m <= wall.base_m:
            return None
        common = shapely.intersection(self.footprint, wall.polygon())
        if shapely.area(common) < 1e-4:
            return None
        low, high = self.bottom_m - wall.base_m, self.top_m - wall.base_m
        low = -1.0 if low < SHORT_M else low
        if self.shape is None:
            run = (shapely.get_coordinates(common) - wall.ends[0]) @ wall.along
            return shapely.box(run.min(), low, run.max(), high)
        across = (self.shape[:, 0] - 0.5) * self.width_m * math.copysign(1, cosine)
        x = (self.middle - wall.ends[0]) @ wall.along + across
        cut = shapely.Polygon(np.stack([x, high + self.shape[:, 1] * (low - high)], axis=1))
        return cut if shapely.is_valid(cut) else shapely.make_valid(cut)


def wall_part(wall: Wall, openings: list[Opening], looks: dict[str, Look]) -> HomePart | None:
    """Return a wall without its openings."""
    sheet = Sheet()
    length = wall.length_m
    outer = shapely.Polygon([(0, 0), (length, 0), (length, wall.height_m[1]), (0, wall.height_m[0])])
    cuts = [cut for o in openings if (cut := o.within(wall)) is not None]
    region = outer if not cuts else shapely.difference(outer, shapely.union_all(cuts))
    _solid(sheet, region, (_side(wall, 0), _side(wall, 1)), looks, float(wall.height_m.min()))
    return sheet.part(f"wall {wall.element.get('id') or ''}")


def _side(wall: Wall, k: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return (n, 2) along and above a wall -> (n, 3) on its left (0) or right (1) side."""
    ends = wall.corners[k]
    off = (1 if k == 0 else -1) * wall.thickness_m / 2 * wall.left

    def place(flat: np.ndarray) -> np.ndarray:
        at = wall.ends[0] + flat[:, :1] * wall.along + off
        at = np.where(flat[:, :1] < NEAR_M, ends[0], np.where(flat[:, :1] > wall.length_m - NEAR_M, ends[1], at))
        return np.column_stack([at, flat[:, 1] + wall.base_m])

    return place


def _solid(sheet: Sheet, region: Any, sides: tuple[Any, Any], looks: dict[str, Look], top_m: float) -> None:
    """Add what lies between two sides: both, and all edges but those that stand on the floor."""
    for polygon in shapely.get_parts(region):
        if shapely.get_type_id(polygon) != 3 or shapely.area(polygon) < 1e-6:
            continue
        area = float(shapely.area(polygon))
        sheet.add(polygon, sides[0], fitted(looks["left"], area), turned=True)
        sheet.add(polygon, sides[1], fitted(looks["right"], area))
        oriented = shapely.orient_polygons(polygon)
        for ring in (oriented.exterior, *oriented.interiors):
            points = shapely.get_coordinates(ring)
            left, right = sides[0](points), sides[1](points)
            for k in range(len(points) - 1):
                if points[k : k + 2, 1].max() < NEAR_M:
                    continue
                above = points[k, 0] > points[k + 1, 0] and points[k : k + 2, 1].min() > top_m - NEAR_M
                corners = np.array([right[k], left[k], left[k + 1], right[k + 1]])
                sheet.quad(corners, looks["top" if above else "right"])


@dataclasses.dataclass(frozen=True)
class Room:
    """Hold a room's outline and what of it is visible."""

    name: str
    level: str | None
    plan: Any
    floor: Look | None
    ceiling: Look | None


def read_room(element: ElementTree.Element, look: Callable[[ElementTree.Element, str, str], Look]) -> Room | None:
    """Return a room; None where its outline encloses nothing."""
    points = [point(e) for e in element.findall("point")]
    plan = shapely.make_valid(shapely.Polygon(points)) if len(points) > 2 else shapely.Polygon()
    plan = shapely.union_all([p for p in shapely.get_parts(plan) if shapely.get_type_id(p) in (3, 6)])
    if shapely.area(plan) < 1e-4:
        return None
    if max(np.ptp(points, axis=0)) > EXTENT_M:
        raise SceneRejected(f"{called(element)}: is larger than {EXTENT_M:g} m; mend the drawing")
    looks = {what: look(element, f"{what}Color", f"{what}Texture") for what in ("floor", "ceiling")}
    shown = [a if element.get(f"{what}Visible", "true") == "true" else None for what, a in looks.items()]
    return Room(element.get("name") or "room", element.get("level"), plan, *shown)


def enclosed(walls: list[Wall], rooms: list[Room]) -> list[Room]:
    """Return what the walls of a level enclose without any room in it, but for narrow shafts."""
    stands = shapely.union_all([wall.polygon() for wall in walls])
    drawn = shapely.union_all([room.plan for room in rooms])
    inside = [shapely.Polygon(ring) for p in shapely.get_parts(stands) for ring in getattr(p, "interiors", ())]
    inside = [plan for plan in inside if not shapely.is_empty(shapely.buffer(plan, -SHAFT_M / 2))]
    bare = [p for p in inside if shapely.area(shapely.intersection(p, drawn)) < COVERED * shapely.area(p)]
    return [Room("room", None, plan, (WHITE, None), None) for plan in bare]


def level_parts(
    rooms: list[Room], walls: list[Wall], openings: list[Opening], heights_m: tuple[float, float], shafts: list[Any]
) -> list[HomePart]:
    """Return the floors and ceilings of one level, less the shafts in each; later rooms hide earlier ones."""
    sheet, (taken, tops), (floor_m, ceiling_m) = Sheet(), shafts, heights_m

    def level(height: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda flat: np.column_stack([flat, np.full(len(flat), height)])

    for room in reversed(rooms):
        if room.floor is not None:
            plan = shapely.difference(room.plan, taken)
            sheet.add(plan, level(floor_m), fitted(room.floor, float(shapely.area(plan))))
            taken = shapely.union(taken, room.plan)
        if room.ceiling is not None:
            plan = shapely.difference(room.plan, tops)
            sheet.add(plan, level(ceiling_m), fitted(room.ceiling, float(shapely.area(plan))), turned=True)
            tops = shapely.union(tops, room.plan)
    floors = [room for room in rooms if room.floor is not None]
    for wall in walls if floors else ():
        for opening in openings:
            cut = opening.within(wall) if abs(opening.bottom_m - floor_m) < SILL_M else None
            if cut is not None:
                run = shapely.get_coordinates(cut)[:, 0]
                through = shapely.LineString(wall.ends[0] + np.outer([run.min(), run.max()], wall.along))
                sill = shapely.difference(through.buffer(wall.thickness_m / 2, cap_style="flat"), taken)
                nearest = min(floors, key=lambda room: shapely.distance(room.plan, sill) if sill.area else 0.0)
                assert nearest.floor is not None
                sheet.add(sill, level(floor_m), fitted(nearest.floor, float(shapely.area(sill))))
                taken = shapely.union(taken, sill)
    part = sheet.part("floors and ceilings")
    return [] if part is None else [part]


def opening_of(element: ElementTree.Element, base_m: float) -> Opening:
    """Return what a `<doorOrWindow>` cuts out: the part of its depth that lies in the wall, and a little more."""
    width, depth, height = metres(element, "width", "depth", "height")
    angle = -number(element, "angle", 0.0)
    along, back = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    thick, off = number(element, "wallThickness", 1.0), number(element, "wallDistance", 0.0)
    centre = point(element)
    middle = centre + back * depth * (0.5 - off - thick / 2)
    run = shapely.LineString(middle + np.outer([-1, 1], along * width / 2))
    footprint = run.buffer(depth * thick / 2 + 0.01, cap_style="flat")
    bottom = base_m + number(element, "elevation", 0.0) / 100
    shape = outline(element.get("cutOutShape"))
    if shape is not None and element.get("modelMirrored") == "true":
        shape = shape * [-1.0, 1.0] + [1.0, 0.0]
    if shape is not None and np.isin(np.round(shape, 3), (0, 1)).all() and len(np.unique(shape.round(3), axis=0)) == 4:
        shape = None
    return Opening(footprint, along, middle, float(width), bottom, bottom + float(height), shape)
