"""Lay out a home: an outline, a corridor or hall, rooms of given weights, and walls (units as in `building`)."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from converters.generate.homes.building import CM, Rect, Wall, cut, draw_outline, snap, split
from converters.generate.homes.config import HomeConfig

SPREAD = 0.06
"""A cut is up to this share of the side away from where the weights have it."""
LONGEST = 2.3
"""Longer side of a room over its shorter one, at most; corridors excepted."""
WING_DEPTH_M = (2.2, 5.5)
"""From the main part of the home to a wing's far end, inside."""
OUTLINES = (("rectangle", 0.4), ("L", 0.4), ("T", 0.2))
CORRIDORS = (("through", 0.3), ("end", 0.4), ("hall", 0.3))
"""Forms of the corridor and how often: from one outer wall to the other; from one to a room across the end; a hall
between two columns of rooms, with a room behind it."""


def _chosen(table: tuple[tuple[str, float], ...], rng: np.random.Generator) -> str:
    names, odds = zip(*table, strict=True)
    return names[rng.choice(len(names), p=np.array(odds) / sum(odds))]


@dataclasses.dataclass(frozen=True)
class Layout:
    """Hold rooms and the walls between them."""

    rooms: list[Rect]
    """The corridor first, where there is one."""
    walls: list[Wall]
    corridor: int | None


class _Cutter:
    """Cut rectangles into rooms and gather the walls. Mutable, private to one layout."""

    def __init__(self, cfg: HomeConfig, rng: np.random.Generator):
        self.cfg, self.rng = cfg, rng
        self.rooms: list[Rect] = []
        self.walls: list[Wall] = []

    def thick(self) -> float:
        return snap(self.rng.uniform(*self.cfg.wall_thickness_m))

    def cut(self, rect: Rect, axis: int, at: float) -> tuple[Rect, Rect]:
        low, wall, high = cut(rect, axis, snap(at), self.thick())
        self.walls.append(wall)
        return low, high

    def fill(self, rect: Rect, weights: Sequence[float]) -> None:
        """Cut a rectangle into rooms of these weights."""
        rooms, walls = split(rect, weights, SPREAD, self.cfg, self.rng)
        self.rooms += rooms
        self.walls += walls

    def shared(self, rect: Rect, axis: int, weights: Sequence[float], k: int) -> tuple[Rect, Rect]:
        """Cut a rectangle across `axis` so that its low part suits the first k weights."""
        share = sum(weights[:k]) / sum(weights) + self.rng.uniform(-SPREAD / 2, SPREAD / 2)
        return self.cut(rect, axis, rect.span(axis)[0] + share * rect.size[axis])

    def with_corridor(self, rect: Rect, weights: Sequence[float], form: str) -> Rect:
        """Fill a rectangle and return the corridor in it."""
        rng, long = self.rng, int(rect.size[1] > rect.size[0])
        if form == "end" and len(weights) > 3:
            k = 1 if rng.random() < 0.7 else 2
            end, rest = self.shared(rect, long, weights, k)
            self.fill(end, weights[:k])
            return self.with_corridor(rest, weights[k:], "through")
        if form == "hall" and len(weights) > 2:
            k, hall_m = (len(weights) - 1) // 2, float(rng.uniform(1.8, 2.6))
            few, behind, many = weights[:k], weights[k], weights[k + 1 :]
            inner = rect.size[long] - hall_m
            at = rect.span(long)[0] + inner * sum(few) / (sum(few) + sum(many))
            low, rest = self.cut(rect, long, at)
            middle, high = self.cut(rest, long, rest.span(long)[0] + hall_m)
            depth = middle.size[1 - long]
            room_m = float(np.clip(behind / sum(weights) * rect.area_m2 / hall_m, 1.6, max(depth - 2.0, 1.6)))
            at_low = rng.random() < 0.5
            a, b = self.cut(middle, 1 - long, middle.span(1 - long)[0] + (room_m if at_low else depth - room_m))
            self.fill(low, few)
            self.rooms.append(a if at_low else b)
            self.fill(high, many)
            return b if at_low else a
        across, clear, k = 1 - long, snap(self.cfg.corridor_width_m), len(weights) // 2
        span = rect.size[across] - clear
        share = sum(weights[:k]) / sum(weights) + rng.uniform(-SPREAD / 2, SPREAD / 2)
        low, rest = self.cut(rect, across, rect.span(across)[0] + span * share)
        corridor, high = self.cut(rest, across, rest.span(across)[0] + clear)
        self.fill(low, weights[:k])
        self.fill(high, weights[k:])
        return corridor


def _wing(main: Rect, area_m2: float, form: str, cut_m: float, rng: np.random.Generator) -> tuple[Rect, Wall] | None:
    """Return a wing of a home, and the wall between it and the main part; None where its shape would be odd."""
    axis, way = int(rng.integers(2)), int(rng.integers(2))
    low, high = main.span(1 - axis)
    wide = snap((high - low) * rng.uniform(0.4, 0.65))
    depth = snap(area_m2 / wide)
    if not WING_DEPTH_M[0] <= depth <= WING_DEPTH_M[1] or wide < WING_DEPTH_M[0]:
        return None
    slack = high - low - wide
    start = snap(low + slack * (rng.uniform(0.3, 0.7) if form == "T" else int(rng.integers(2))))
    face = main.span(axis)[way]
    near, far = sorted((face, snap(face + (cut_m if way else -cut_m))))
    ends = (far, snap(far + depth)) if way else (snap(near - depth), near)
    wall = Rect.across(axis, near, far, start, snap(start + wide))
    return Rect.across(axis, *ends, start, snap(start + wide)), (axis, wall)


def lay_out(
    cfg: HomeConfig, rng: np.random.Generator, weights: Sequence[float], area_m2: float, corridor: bool
) -> Layout | None:
    """Draw rooms of these weights, in the order in which they lie; return None where one is too narrow."""
    form = _chosen(OUTLINES, rng) if len(weights) > 3 else "rectangle"
    cutter, wing = _Cutter(cfg, rng), 0
    if form != "rectangle":
        wing = 1 if rng.random() < 0.6 else 2
    main_m2 = area_m2 * sum(weights[wing:]) / sum(weights)
    main = draw_outline(main_m2, rng)
    if wing:
        attached = _wing(main, area_m2 - main_m2, form, cutter.thick(), rng)
        if attached is None:
            return None
        cutter.walls.append(attached[1])
        cutter.fill(attached[0], weights[:wing])
    if corridor:
        hall = cutter.with_corridor(main, weights[wing:], _chosen(CORRIDORS, rng))
        rooms = [hall, *cutter.rooms]
    else:
        cutter.fill(main, weights[wing:])
        rooms = cutter.rooms
    plain = rooms[1:] if corridor else rooms
    if min(min(r.size) for r in rooms) < min(cfg.min_room_side_m, cfg.corridor_width_m if corridor else math.inf):
        return None
    if min(min(r.size) for r in plain) < cfg.min_room_side_m or max(max(r.size) / min(r.size) for r in plain) > LONGEST:
        return None
    return Layout(rooms, cutter.walls, 0 if corridor else None)


class Stretch(NamedTuple):
    """Describe a stretch of outer wall beside a room."""

    axis: int
    """The wall faces along it."""
    way: int
    """Sign of the way into the room."""
    face: float
    start: float
    end: float

    @property
    def length_m(self) -> float:
        """Return its length."""
        return self.end - self.start

    def opening(self, start: float, end: float, thick_m: float) -> Rect:
        """Return the part of a wall so thick between two places along it."""
        low, high = sorted((self.face, snap(self.face - self.way * thick_m)))
        return Rect.across(self.axis, low, high, start, end)


def outer_stretches(room: Rect, walls: Sequence[Wall]) -> Iterator[Stretch]:
    """Yield the stretches of a room's sides behind which no other room lies."""
    for axis, way, face, start, end in room.sides():
        behind = (
            rect.span(1 - axis)
            for along, rect in walls
            if along == axis and abs(rect.span(axis)[int(way > 0)] - face) < CM / 2
        )
        at = start
        for low, high in sorted(behind):
            if high <= at or low >= end:
                continue
            if low > at:
                yield Stretch(axis, way, face, at, low)
            at = max(at, high)
        if at < end:
            yield Stretch(axis, way, face, at, end)


def outer_walls(layout: Layout, thick: float) -> list[Rect]:
    """Return the pieces of the wall around all rooms."""
    areas = [r.polygon for r in (*layout.rooms, *(rect for _, rect in layout.walls))]
    inside = shapely.union_all(areas, grid_size=CM / 10)
    ring = inside.buffer(thick, join_style="mitre") - inside
    xs, ys = (np.unique(np.round(shapely.get_coordinates(ring)[:, k], 2)) for k in (0, 1))
    pieces = []
    for y0, y1 in itertools.pairwise(ys):
        within = [shapely.contains_xy(ring, (a + b) / 2, (y0 + y1) / 2) for a, b in itertools.pairwise(xs)]
        for solid, run in itertools.groupby(range(len(within)), key=lambda i: within[i]):
            columns = list(run)
            if solid:
                pieces.append(Rect(float(xs[columns[0]]), float(y0), float(xs[columns[-1] + 1]), float(y1)))
    return pieces
