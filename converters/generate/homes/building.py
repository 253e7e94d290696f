"""Describe a home: rectangles, walls, doorways, its plan and its furniture.

Frame: x, y of the scan (z up), metres, heights above the floor. Horizontal coordinates are whole centimetres.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import shapely

from converters.generate.homes.config import HomeConfig
from converters.generate.models.cad import Instance

CM = 0.01
DOORWAY_MARGIN_M = 0.12
"""Least wall left between a doorway and the corner of a room."""
ENTRANCE_FREE_M = 1.0
"""Depth and width of the floor behind the front door that stays free."""


@dataclasses.dataclass(frozen=True)
class Rect:
    """Describe an axis-aligned rectangle on the floor."""

    x0: float
    y0: float
    x1: float
    y1: float

    @classmethod
    def across(cls, axis: int, low: float, high: float, start: float, end: float) -> "Rect":
        """Return the rectangle from `low` to `high` along an axis and from `start` to `end` along the other."""
        return cls(low, start, high, end) if axis == 0 else cls(start, low, end, high)

    def span(self, axis: int) -> tuple[float, float]:
        """Return the lowest and the highest coordinate along an axis."""
        return (self.x0, self.x1) if axis == 0 else (self.y0, self.y1)

    @property
    def size(self) -> tuple[float, float]:
        """Return the extent along x and y."""
        return self.x1 - self.x0, self.y1 - self.y0

    @property
    def area_m2(self) -> float:
        """Return the area."""
        return self.size[0] * self.size[1]

    @property
    def centre(self) -> tuple[float, float]:
        """Return the centre."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    @property
    def polygon(self) -> shapely.Polygon:
        """Return it as a polygon."""
        return shapely.box(self.x0, self.y0, self.x1, self.y1)

    def grown(self, x_m: float, y_m: float) -> "Rect":
        """Return a rectangle that reaches so much farther along x and y, both ways."""
        return Rect(self.x0 - x_m, self.y0 - y_m, self.x1 + x_m, self.y1 + y_m)

    def overlaps(self, other: "Rect") -> bool:
        """Return whether the two have floor in common."""
        return self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1

    def sides(self) -> list[tuple[int, int, float, float, float]]:
        """Return its four walls: axis, sign of the direction inwards, coordinate of the face, start and end."""
        return [
            (axis, way, face, *self.span(1 - axis))
            for axis in (0, 1)
            for way, face in zip((1, -1), self.span(axis), strict=True)
        ]


@dataclasses.dataclass(frozen=True)
class PlanBox:
    """Describe an axis-aligned box."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @classmethod
    def over(cls, rect: Rect, low_m: float, high_m: float) -> "PlanBox":
        """Return the box above a rectangle between two heights."""
        return cls((rect.x0, rect.y0, low_m), (rect.x1, rect.y1, high_m))

    @property
    def rect(self) -> Rect:
        """Return its footprint."""
        return Rect(self.low[0], self.low[1], self.high[0], self.high[1])


@dataclasses.dataclass(frozen=True)
class Doorway:
    """Describe an opening in the wall between two rooms."""

    rooms: tuple[int, int]
    """Indices of the rooms on its low and its high side along `axis`."""
    axis: int
    """0: one walks through it along x; 1: along y."""
    rect: Rect
    """The opening: as deep as the wall is thick."""
    height_m: float

    @property
    def width_m(self) -> float:
        """Return the clear width."""
        return self.rect.size[1 - self.axis]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Hold a floor plan."""

    rooms: tuple[Rect, ...]
    """Clear inside of each room."""
    outer: Rect
    """Outline of the building, outer walls included."""
    walls: tuple[PlanBox, ...]
    """Wall pieces, doorways cut out; those above a doorway start at its height."""
    doorways: tuple[Doorway, ...]
    windows: tuple[PlanBox, ...]
    """Glass: as deep as the outer wall."""
    corridor: int | None
    """Index of the corridor in `rooms`."""
    wall_height_m: float
    built_in: tuple[Instance, ...] = dataclasses.field(default=(), compare=False)
    """Furniture that stays: part of the static structure."""
    entrance: Doorway | None = None
    """The front door, which stays closed, in an outer wall; both of its rooms are the one behind it."""

    @property
    def entrance_zone(self) -> Rect | None:
        """Return the floor behind the front door that stays free."""
        if self.entrance is None:
            return None
        axis, (low, high) = self.entrance.axis, self.rooms[self.entrance.rooms[0]].span(self.entrance.axis)
        inwards = self.entrance.rect.span(axis)[1] <= low + CM / 2
        deep = (low, low + ENTRANCE_FREE_M) if inwards else (high - ENTRANCE_FREE_M, high)
        middle = self.entrance.rect.centre[1 - axis]
        return Rect.across(axis, *deep, middle - ENTRANCE_FREE_M / 2, middle + ENTRANCE_FREE_M / 2)

    def facades(self) -> list[tuple[int, int, float, float, float]]:
        """Return the building's outer faces: axis, sign of the way outwards, coordinate of the face, start and end."""
        pieces = [r.polygon for r in (*self.rooms, *(w.rect for w in self.walls), *(d.rect for d in self.doorways))]
        ring = shapely.get_coordinates(shapely.union_all(pieces, grid_size=CM / 10).simplify(CM / 2).exterior).round(2)
        faces = []
        for a, b in itertools.pairwise(ring if shapely.is_ccw(shapely.LinearRing(ring)) else ring[::-1]):
            axis = int(abs(b[1] - a[1]) < abs(b[0] - a[0]))
            along = b[1 - axis] - a[1 - axis]
            # Counter-clockwise the outside lies to the right: +x where one goes along +y, -y where along +x.
            way = int(np.sign(along)) * (1 if axis == 0 else -1)
            faces.append((axis, way, float(a[axis]), *sorted((float(a[1 - axis]), float(b[1 - axis])))))
        return faces


@dataclasses.dataclass(frozen=True)
class Building:
    """Hold the truth behind a generated scan."""

    plan: Plan
    items: tuple[Instance, ...]
    """What can be moved, the door leaves first."""
    floor_height_m: float
    """The floor in the scan's frame."""
    uses: tuple[str, ...] = ()
    """Use of each room, keys of `converters.generate.homes.plans.USES`."""
    measured: dict[str, Any] = dataclasses.field(default_factory=dict)
    """The achieved `furniture_share`, and robot -> `must_push_share` of pairs of places that need a push."""


def snap(value: float) -> float:
    """Round to a whole centimetre."""
    return round(value / CM) * CM


def draw_outline(area_m2: float, rng: np.random.Generator) -> Rect:
    """Draw a rectangle of this area, up to 1.6 times as long as wide, whose middle is near the origin."""
    aspect = rng.uniform(1.0, 1.6)
    width, depth = snap(np.sqrt(area_m2 * aspect)), snap(np.sqrt(area_m2 / aspect))
    if rng.random() < 0.5:
        width, depth = depth, width
    x0, y0 = snap(-width / 2 + rng.uniform(-0.7, 0.7)), snap(-depth / 2 + rng.uniform(-0.7, 0.7))
    return Rect(x0, y0, snap(x0 + width), snap(y0 + depth))


Wall = tuple[int, Rect]
"""The axis along which a stretch of wall is thin, and its footprint."""


def cut(rect: Rect, axis: int, at: float, thick: float) -> tuple[Rect, Wall, Rect]:
    """Cut a rectangle across `axis` into what lies below `at`, a wall, and the rest."""
    (low, high), along = rect.span(axis), rect.span(1 - axis)
    wall = Rect.across(axis, at, at + thick, *along)
    return Rect.across(axis, low, at, *along), (axis, wall), Rect.across(axis, at + thick, high, *along)


def split(
    rect: Rect, weights: Sequence[float], spread: float, cfg: HomeConfig, rng: np.random.Generator
) -> tuple[list[Rect], list[Wall]]:
    """Cut a rectangle into rooms with areas proportional to `weights`, mostly across its longer side.

    Each cut deviates at random by up to the share `spread` of the side.
    """
    n = len(weights)
    if n == 1:
        return [rect], []
    width, depth = rect.size
    axis = int(depth > width) if rng.random() < 0.85 else int(rng.random() < 0.5)
    n_low = n // 2 if rng.random() < 0.5 else n - n // 2
    share = sum(weights[:n_low]) / sum(weights) + rng.uniform(-spread, spread)
    thick = snap(rng.uniform(*cfg.wall_thickness_m))
    low, wall, high = cut(rect, axis, snap(rect.span(axis)[0] + share * rect.size[axis] - thick / 2), thick)
    rooms_low, walls_low = split(low, weights[:n_low], spread, cfg, rng)
    rooms_high, walls_high = split(high, weights[n_low:], spread, cfg, rng)
    return rooms_low + rooms_high, [wall, *walls_low, *walls_high]


def shared_wall(a: Rect, b: Rect, walls: Iterable[Wall]) -> Wall | None:
    """Return the stretch of wall between rooms a (low side) and b (high side)."""
    for axis, wall in walls:
        faces = a.span(axis)[1], b.span(axis)[0]
        if any(abs(face - edge) > CM / 2 for face, edge in zip(faces, wall.span(axis), strict=True)):
            continue
        starts, ends = zip(*(rect.span(1 - axis) for rect in (a, b, wall)), strict=True)
        if min(ends) - max(starts) > 0:
            return axis, Rect.across(axis, *faces, max(starts), min(ends))
    return None


def place_doorway(
    stretch: tuple[float, float], width_m: float, cfg: HomeConfig, rng: np.random.Generator
) -> tuple[float, float]:
    """Draw where on a stretch of wall a doorway of this width starts; return that and the width that fits."""
    start, end = stretch
    width = snap(min(width_m, end - start - 2 * DOORWAY_MARGIN_M))
    slack = end - start - 2 * DOORWAY_MARGIN_M - width
    # Doorways sit near a corner more often than in the middle: it leaves wall for furniture.
    at = snap(start + DOORWAY_MARGIN_M + slack * rng.beta(0.5, 0.5))
    if cfg.corner_doorways and rng.random() < cfg.corner_doorways:
        margin = min(cfg.corner_margin_m, (end - start - width) / 2)
        at = snap(start + margin if rng.random() < 0.5 else end - margin - width)
    return at, width


def wall_boxes(wall: Wall, doorways: list[Doorway], height: float) -> list[PlanBox]:
    """Return the pieces of one wall around its doorways, and the pieces above them."""
    axis, rect = wall
    deep, (at, last) = rect.span(axis), rect.span(1 - axis)
    holes = [(*d.rect.span(1 - axis), d) for d in doorways if d.axis == axis]
    boxes = []

    def piece(start: float, end: float, base: float) -> PlanBox:
        return PlanBox.over(Rect.across(axis, *deep, start, end), base, height)

    for start, end, d in sorted(holes, key=lambda hole: hole[0]):
        if abs(d.rect.span(axis)[0] - deep[0]) < CM / 2 and rect.span(1 - axis)[0] < start < last:
            boxes += [piece(at, start, 0.0), piece(start, end, d.height_m)]
            at = end
    return [*boxes, piece(at, last, 0.0)]


def doorway_zone(doorway: Doorway, reach_m: float, side_m: float = 0.05) -> Rect:
    """Return the doorway and the floor before it on both sides, which stay free of furniture."""
    return doorway.rect.grown(*((reach_m, side_m) if doorway.axis == 0 else (side_m, reach_m)))
