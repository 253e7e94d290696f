"""Model a room's walls: faces with holes, boards, casings, panes, curtains and a front door.

A place is (along, out, z): metres along the wall, out of its face into the room, and above the floor.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Iterator

import numpy as np
import shapely

from converters.generate.homes.building import Doorway, PlanBox, Rect
from converters.generate.homes.plans import ENTRANCE_M
from converters.generate.surface.finishes import SKIRTING_M, Colouring
from converters.generate.surface.texture import Chart, plain, polygon
from converters.records.raw import FLOOR, WALL, WINDOW

Span = tuple[float, float]
OTHER, CURTAIN, PICTURE = 38, 16, 11
"""NYU40: other structure, curtain, picture."""
WHITE = np.array([0.95, 0.95, 0.94])
CASING_M, PROUD_M = 0.07, 0.015
"""Width of the board around a doorway, and how far it stands out."""
FLOOR_M = 0.004
"""Floors are drawn a little above the plane on which objects stand, or the two would flicker."""
CLOTHS = np.array([[0.86, 0.83, 0.76], [0.62, 0.66, 0.70], [0.70, 0.58, 0.48], [0.55, 0.60, 0.52], [0.80, 0.72, 0.66]])
ENTRANCES = np.array([[0.36, 0.22, 0.15], [0.88, 0.88, 0.86], [0.24, 0.33, 0.36], [0.55, 0.38, 0.24]])


@dataclasses.dataclass(frozen=True)
class Hole:
    """Describe an opening in a wall's face."""

    start: float
    end: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Side:
    """Describe one wall of a room."""

    axis: int
    """The wall faces along it."""
    way: int
    """Sign of the way into the room."""
    face: float
    start: float
    end: float
    doorways: tuple[Doorway, ...]
    windows: tuple[PlanBox, ...]

    @property
    def inward(self) -> np.ndarray:
        """Return the (3,) unit vector into the room."""
        return self.at(0, 1, 0) - self.at(0, 0, 0)

    def at(self, along: float, out: float, z: float) -> np.ndarray:
        """Return a place at the wall, (3,) of the scan frame."""
        across = self.face + self.way * out
        return np.array([across, along, z] if self.axis == 0 else [along, across, z])

    def along(self, rect: Rect) -> tuple[float, float]:
        """Return where a rectangle lies along the wall."""
        return rect.span(1 - self.axis)

    def corners(self, hole: Hole, out: float = 0.0) -> list[np.ndarray]:
        """Return the corners of an opening, or of any upright rectangle, at a distance out of the wall."""
        low, high = hole.low, hole.high
        return [
            self.at(a, out, z) for a, z in ((hole.start, low), (hole.end, low), (hole.end, high), (hole.start, high))
        ]

    def holes(self) -> list[Hole]:
        """Return the doorways and windows in it, in order."""
        holes = [Hole(*self.along(d.rect), 0.0, d.height_m) for d in self.doorways]
        holes += [Hole(*self.along(w.rect), w.low[2], w.high[2]) for w in self.windows]
        return sorted(holes, key=lambda h: h.start)

    def strip(self, start: float, end: float, depth_m: float) -> shapely.Polygon:
        """Return the floor before a stretch of the wall."""
        low, high = sorted((self.face, self.face + self.way * depth_m))
        return Rect.across(self.axis, low, high, start, end).polygon

    def slab(self, along: Span, out: Span, z: Span, label: int, paint: Colouring, texels_per_m: float = 40.0,
             skip: str = "b", thin: bool = True) -> list[Chart]:  # fmt: skip
        """Return a box at the wall without the faces in `skip` (f front, b back, l, r along, t top, u under)."""
        ranges = (along, out, z)
        faces = {"l": (0, 0), "r": (0, 1), "b": (1, 0), "f": (1, 1), "u": (2, 0), "t": (2, 1)}
        charts = []
        for name, (k, end) in faces.items():
            if name in skip:
                continue
            quad = list(itertools.product(*((r[end],) if d == k else r for d, r in enumerate(ranges))))
            corners = [self.at(*quad[n]) for n in (0, 2, 3, 1)]
            middle = self.at(*(sum(r) / 2 for r in ranges))
            towards = np.mean(corners, axis=0) - middle
            charts.append(polygon(corners, towards, label, paint, texels_per_m, lit_as=self.inward if thin else None))
        return charts


def _opens(side: Side, rect: Rect) -> bool:
    """Return whether an opening in a wall is in this side of it."""
    low, high = side.along(rect)
    face = rect.span(side.axis)[int(side.way > 0)]
    return abs(face - side.face) < 0.005 and low > side.start - 0.005 and high < side.end + 0.005


def windowed(side: Side, windows: Iterable[PlanBox]) -> Side:
    """Return a wall with those of the windows that are in it."""
    return dataclasses.replace(side, windows=tuple(w for w in windows if _opens(side, w.rect)))


def sides_of(room: Rect, doorways: Iterable[Doorway], windows: Iterable[PlanBox]) -> list[Side]:
    """Return the four walls of a room, each with what opens in it."""
    out = []
    for wall in room.sides():
        side = windowed(Side(*wall, (), ()), windows)
        through = tuple(d for d in doorways if d.axis == side.axis and _opens(side, d.rect))
        out.append(dataclasses.replace(side, doorways=through))
    return out


def wall_face(side: Side, height: float, paint: Colouring, texels_per_m: float = 80.0) -> list[Chart]:
    """Return the wall around its holes."""
    pieces, at = [], side.start
    for h in side.holes():
        pieces += [
            Hole(at, h.start, 0.0, height),
            Hole(h.start, h.end, 0.0, h.low),
            Hole(h.start, h.end, h.high, height),
        ]
        at = h.end
    pieces = [p for p in (*pieces, Hole(at, side.end, 0.0, height)) if min(p.end - p.start, p.high - p.low) > 1e-6]
    return [polygon(side.corners(p), side.inward, WALL, paint, texels_per_m) for p in pieces]


def skirting(side: Side) -> list[Chart]:
    """Return a board along its foot, between the casings."""
    charts, at = [], side.start
    for h in [h for h in side.holes() if h.low < 0.01] + [Hole(side.end + CASING_M, side.end, 0.0, 0.0)]:
        if h.start - CASING_M - at > 0.02:
            run = (at, h.start - CASING_M)
            charts += side.slab(run, (0.0, 0.012), (0.0, SKIRTING_M), WALL, plain(WHITE), 40.0, "bulr")
        at = h.end + CASING_M
    return charts


def casing(side: Side, hole: Hole) -> list[Chart]:
    """Return boards around a doorway on one side of its wall."""
    low = max(hole.start - CASING_M, side.start), hole.start
    high = hole.end, min(hole.end + CASING_M, side.end)
    top = (hole.high, hole.high + CASING_M)
    charts = []
    for run in (low, high):
        charts += side.slab(run, (0.0, PROUD_M), (0.0, top[1]), WALL, plain(WHITE), skip="bu")
    return charts + side.slab((hole.start, hole.end), (0.0, PROUD_M), top, WALL, plain(WHITE), skip="blr")


def _reveals(side: Side, hole: Hole, deep: float, sill_m: float) -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
    """Yield the faces inside of an opening, with where each looks: at its low and its high end, below and above."""
    along, up = side.at(1, 0, 0) - side.at(0, 0, 0), np.array([0, 0, 1])
    for a, towards in ((hole.start, along), (hole.end, -along)):
        yield (
            [side.at(a, o, z) for o, z in ((0, hole.low), (deep, hole.low), (deep, hole.high), (0, hole.high))],
            towards,
        )
    for z, towards in ((sill_m, up), (hole.high, -up)):
        yield (
            [side.at(a, o, z) for a, o in ((hole.start, 0), (hole.end, 0), (hole.end, deep), (hole.start, deep))],
            towards,
        )


def lining(doorway: Doorway, floor: Colouring) -> list[Chart]:
    """Return the sides, the floor and the upper side of a doorway."""
    axis, white = doorway.axis, plain(WHITE)
    side = Side(axis, 1, doorway.rect.span(axis)[0], *doorway.rect.span(1 - axis), (), ())
    hole = Hole(side.start, side.end, 0.0, doorway.height_m)
    faces = _reveals(side, hole, doorway.rect.size[axis], FLOOR_M)
    paints = ((WALL, white), (WALL, white), (FLOOR, floor), (WALL, white))
    return [polygon(*face, *paint) for face, paint in zip(faces, paints, strict=True)]


def outlook(side: Side, sky: np.ndarray, phase: float) -> Colouring:
    """Paint the view through a pane: sky over a line of trees and a lawn."""

    def colour(p: np.ndarray) -> np.ndarray:
        along, z = p[:, 1 - side.axis] + phase, p[:, 2]
        trees = 1.42 + 0.06 * np.sin(5.1 * along) + 0.035 * np.sin(13.7 * along + 2) + 0.018 * np.sin(37 * along)
        up = np.clip((z - 1.4) / 0.65, 0, 1)[:, None]
        out = np.array([0.93, 0.96, 0.98]) * (1 - up) + sky * up
        crown = np.clip((trees - z) / 0.25, 0, 1)[:, None]
        wood = np.array([0.42, 0.52, 0.36]) * (1 - crown) + np.array([0.30, 0.41, 0.25]) * crown
        lawn = np.clip((1.22 - z) / 0.32, 0, 1)[:, None]
        grass = np.array([0.55, 0.66, 0.38]) * (1 - lawn) + np.array([0.45, 0.58, 0.30]) * lawn
        for level, below in ((trees, wood), (1.22, grass)):
            share = np.clip((level - z) / 0.02 + 0.5, 0, 1)[:, None]
            out = out * (1 - share) + below * share
        return out

    return colour


def window(side: Side, box: PlanBox, pane: Colouring) -> list[Chart]:
    """Return reveals, frame with a mullion, pane and sill of one window, and its pane from outside."""
    a0, a1 = side.along(box.rect)
    z0, z1, deep = box.low[2], box.high[2], box.rect.size[side.axis]
    glass, white, hole = -0.6 * deep, plain(WHITE), Hole(a0, a1, z0, z1)
    charts = [polygon(*f, WALL, plain(0.86 * WHITE), 10.0, glows=True) for f in _reveals(side, hole, -deep, z0)]
    corners = side.corners(hole, glass)
    charts.append(polygon(corners, side.inward, WINDOW, pane, 60.0, glows=True))
    charts.append(polygon(corners, -side.inward, WINDOW, plain([0.35, 0.42, 0.47]), 4.0))
    bar, out = 0.055, (glass, glass + 0.045)
    if a1 - a0 > 0.95:
        m = (a0 + a1) / 2
        charts += side.slab((m - 0.03, m + 0.03), out, (z0 + bar, z1 - bar), WINDOW, white, skip="but")
    charts += side.slab((a0, a1), out, (z0, z0 + bar), WINDOW, white, skip="bulr")
    charts += side.slab((a0, a1), out, (z1 - bar, z1), WINDOW, white, skip="btlr")
    for run, skip in (((a0, a0 + bar), "butl"), ((a1 - bar, a1), "butr")):
        charts += side.slab(run, out, (z0 + bar, z1 - bar), WINDOW, white, skip=skip)
    return charts + side.slab((a0 - 0.02, a1 + 0.02), (0.0, 0.02), (z0 - 0.03, z0 + 0.001), WALL, white)


def curtains(side: Side, box: PlanBox, foot: float, colour: np.ndarray) -> list[Chart]:
    """Return a rod and two gathered curtains down to the height `foot`, at most 0.06 m from the wall."""
    a0, a1 = side.along(box.rect)
    a0, a1 = max(a0 - 0.16, side.start + 0.02), min(a1 + 0.16, side.end - 0.02)
    top = box.high[2] + 0.1
    rod = plain([0.35, 0.30, 0.26])
    charts = side.slab((a0 - 0.01, a1 + 0.01), (0.03, 0.05), (top, top + 0.02), CURTAIN, rod, skip="")
    wide, folds = min(0.36, 0.27 * (a1 - a0)), 10
    for start, step in ((a0, wide / folds), (a1, -wide / folds)):
        outs = [0.0, *(0.028 + 0.03 * (k % 2) for k in range(folds + 1)), 0.0]
        alongs = [start, *(start + k * step for k in range(folds + 1)), start + folds * step]
        for k in range(len(outs) - 1):
            a, b = alongs[k : k + 2]
            places = ((a, outs[k], foot), (b, outs[k + 1], foot), (b, outs[k + 1], top), (a, outs[k], top))
            corners = [side.at(*place) for place in places]
            # Out of the wall, or to the curtain's end where it returns to it.
            away = side.inward
            if (b - a) * np.sign(step) <= 0:
                away = side.at(a - sum(alongs[1:-1]) / (folds + 1), 0, 0) - side.at(0, 0, 0)
            shade = 0.86 if k % 2 else 1.04
            paint = plain(np.minimum(colour * shade, 1))
            charts.append(polygon(corners, away, CURTAIN, paint, 25.0, lit_as=side.inward))
    return charts


def _leaf(side: Side, middle: float, colour: np.ndarray) -> Colouring:
    """Paint a front door's leaf: four panels with bevelled rims."""

    def paint(p: np.ndarray) -> np.ndarray:
        x, z = np.abs(p[:, 1 - side.axis] - middle), p[:, 2]
        off = np.abs(z - 1.05)
        inside = np.minimum.reduce([x - 0.05, 0.36 - x, off - 0.12, 0.85 - off])
        tone = np.where((inside > 0) & (inside < 0.02), 0.72, np.where((inside > 0.02) & (inside < 0.035), 1.12, 1.0))
        return np.minimum(colour * tone[:, None], 1.0)

    return paint


def entrance_place(sides: Iterable[Side], front_door: Doorway) -> tuple[Side, float]:
    """Return the wall of a room that has the front door, and the door's middle along it."""
    side = next(s for s in sides if s.axis == front_door.axis and _opens(s, front_door.rect))
    return side, front_door.rect.centre[1 - side.axis]


def entrance(side: Side, middle: float, colour: np.ndarray) -> list[Chart]:
    """Return a closed front door with casing and handle."""
    low, high = middle - ENTRANCE_M[0] / 2, middle + ENTRANCE_M[0] / 2
    hole = Hole(low, high, 0.0, ENTRANCE_M[1])
    leaf = side.slab((low, high), (0.0, 0.006), (0.0, ENTRANCE_M[1]), OTHER, _leaf(side, middle, colour), 80.0, "bulrt")
    steel = plain([0.66, 0.66, 0.67])
    plate = side.slab((high - 0.1, high - 0.06), (0.006, 0.012), (0.93, 1.15), OTHER, steel)
    handle = side.slab((high - 0.2, high - 0.07), (0.03, 0.045), (1.04, 1.06), OTHER, steel, skip="")
    return [*casing(side, hole), *leaf, *plate, *handle]


def switch(side: Side, along: float, z: float) -> list[Chart]:
    """Return a plate of a light switch or socket."""
    run, heights = (along - 0.04, along + 0.04), (z - 0.04, z + 0.04)
    plate = side.slab(run, (0.0, 0.008), heights, WALL, plain([0.97, 0.97, 0.96]))
    inner = (along - 0.022, along + 0.022), (0.008, 0.011), (z - 0.026, z + 0.026)
    return plate + side.slab(*inner, WALL, plain([0.88, 0.88, 0.87]))
