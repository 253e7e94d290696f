"""A room's four walls in, what is on them out: wall faces with holes, boards, casings, panes, curtains, a front door.

A place at a wall is (along, out, z): metres along the wall, out of its face into the room, above the floor.
"""

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np
import shapely

from converters.generate.design.plan import Doorway, PlanBox, Rect
from converters.generate.surface.charts import Chart, plain, polygon
from converters.generate.surface.finishes import SKIRTING_M, Colouring
from converters.generate.surface.scan import NYU40
from converters.records.raw import FLOOR, WALL, WINDOW

Span = tuple[float, float]
OTHER, CURTAIN, PICTURE = 38, 16, 11
"""NYU40: other structure, curtain, picture."""
WHITE = np.array([0.95, 0.95, 0.94])
CASING_M, PROUD_M = 0.07, 0.015
"""Width of the board around a doorway, and how far it stands out."""
FLOOR_M = 0.004
"""Floors are drawn a little above the plane that things stand on, or the two would flicker."""
ENTRANCE_M = (0.92, 2.04)
"""Width and height of the front door's leaf."""
CLOTHS = np.array([[0.86, 0.83, 0.76], [0.62, 0.66, 0.70], [0.70, 0.58, 0.48], [0.55, 0.60, 0.52], [0.80, 0.72, 0.66]])
ENTRANCES = np.array([[0.36, 0.22, 0.15], [0.88, 0.88, 0.86], [0.24, 0.33, 0.36], [0.55, 0.38, 0.24]])


@dataclasses.dataclass(frozen=True)
class Hole:
    """An opening in a wall's face."""

    start: float
    end: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Side:
    """One wall of a room."""

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
        """(3,) unit."""
        return self.at(0, 1, 0) - self.at(0, 0, 0)

    def at(self, along: float, out: float, z: float) -> np.ndarray:
        """(3,) of the scan frame."""
        across = self.face + self.way * out
        return np.array([across, along, z] if self.axis == 0 else [along, across, z])

    def along(self, rect: Rect) -> tuple[float, float]:
        """Where a rectangle lies along the wall."""
        return (rect.y0, rect.y1) if self.axis == 0 else (rect.x0, rect.x1)

    def holes(self) -> list[Hole]:
        """Doorways and windows in it, in order."""
        holes = [Hole(*self.along(d.rect), 0.0, d.height_m) for d in self.doorways]
        holes += [Hole(*self.along(w.rect), w.low[2], w.high[2]) for w in self.windows]
        return sorted(holes, key=lambda h: h.start)

    def strip(self, start: float, end: float, depth_m: float) -> shapely.Polygon:
        """Floor before a stretch of the wall."""
        (x0, y0), (x1, y1) = (self.at(a, out, 0)[:2] for a, out in ((start, 0.0), (end, depth_m)))
        return shapely.box(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))

    def slab(self, along: Span, out: Span, z: Span, label: int, paint: Colouring, texels_per_m: float = 40.0,
             skip: str = "b", thin: bool = True) -> list[Chart]:  # fmt: skip
        """A box at the wall: its faces but those in `skip` (f front, b back, l, r along, t top, u under).

        The edges of what is `thin` are as bright as its front.
        """
        ranges = (along, out, z)
        faces = {"l": (0, 0), "r": (0, 1), "b": (1, 0), "f": (1, 1), "u": (2, 0), "t": (2, 1)}
        made = []
        for name, (k, end) in faces.items():
            if name in skip:
                continue
            i, j = (d for d in range(3) if d != k)
            corners = []
            for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                place = [0.0] * 3
                place[k], place[i], place[j] = ranges[k][end], ranges[i][a], ranges[j][b]
                corners.append(self.at(*place))
            middle = self.at(*(sum(r) / 2 for r in ranges))
            towards = np.mean(corners, axis=0) - middle
            made.append(polygon(corners, towards, label, paint, texels_per_m, lit_as=self.inward if thin else None))
        return made


def sides_of(room: Rect, doorways: Iterable[Doorway], windows: Iterable[PlanBox]) -> list[Side]:
    """The four walls of a room, each with what opens in it."""
    out = []
    for axis, way, face, start, end in (
        (0, 1, room.x0, room.y0, room.y1), (0, -1, room.x1, room.y0, room.y1),
        (1, 1, room.y0, room.x0, room.x1), (1, -1, room.y1, room.x0, room.x1),
    ):  # fmt: skip
        side = Side(axis, way, face, start, end, (), ())

        def here(rect: Rect, side: Side = side) -> bool:
            faces = ((rect.x1, rect.x0) if side.axis == 0 else (rect.y1, rect.y0))[int(side.way < 0)]
            low, high = side.along(rect)
            return abs(faces - side.face) < 0.005 and low > side.start - 0.005 and high < side.end + 0.005

        mine = tuple(d for d in doorways if d.axis == axis and here(d.rect))
        out.append(dataclasses.replace(side, doorways=mine, windows=tuple(w for w in windows if here(w.rect))))
    return out


def pierced(start: float, end: float, height: float, holes: Iterable[Hole]) -> Iterator[Hole]:
    """The rectangles that are left of a wall's face."""
    at = start
    for h in holes:
        yield Hole(at, h.start, 0.0, height)
        yield Hole(h.start, h.end, 0.0, h.low)
        yield Hole(h.start, h.end, h.high, height)
        at = h.end
    yield Hole(at, end, 0.0, height)


def wall_face(side: Side, height: float, paint: Colouring, texels_per_m: float = 80.0) -> list[Chart]:
    """The wall around its holes."""
    pieces = [
        p for p in pierced(side.start, side.end, height, side.holes())
        if p.end - p.start > 1e-6 and p.high - p.low > 1e-6
    ]  # fmt: skip
    corners = [((p.start, p.low), (p.end, p.low), (p.end, p.high), (p.start, p.high)) for p in pieces]
    return [polygon([side.at(a, 0, z) for a, z in c], side.inward, WALL, paint, texels_per_m) for c in corners]


def skirting(side: Side) -> list[Chart]:
    """A board along its foot, between the casings."""
    charts, at = [], side.start
    for h in [h for h in side.holes() if h.low < 0.01] + [Hole(side.end + CASING_M, side.end, 0.0, 0.0)]:
        if h.start - CASING_M - at > 0.02:
            run = (at, h.start - CASING_M)
            charts += side.slab(run, (0.0, 0.012), (0.0, SKIRTING_M), WALL, plain(WHITE), 40.0, "bulr")
        at = h.end + CASING_M
    return charts


def casing(side: Side, hole: Hole) -> list[Chart]:
    """Boards around a doorway on one side of its wall."""
    low = max(hole.start - CASING_M, side.start), hole.start
    high = hole.end, min(hole.end + CASING_M, side.end)
    top = (hole.high, hole.high + CASING_M)
    charts = []
    for run in (low, high):
        charts += side.slab(run, (0.0, PROUD_M), (0.0, top[1]), WALL, plain(WHITE), skip="bu")
    return charts + side.slab((hole.start, hole.end), (0.0, PROUD_M), top, WALL, plain(WHITE), skip="blr")


def lining(doorway: Doorway, floor: Colouring) -> list[Chart]:
    """The floor, the sides and the upper side of a doorway."""
    r, height = doorway.rect, doorway.height_m
    side = Side(0, 1, r.x0, r.y0, r.y1, (), ()) if doorway.axis == 0 else Side(1, 1, r.y0, r.x0, r.x1, (), ())
    deep = r.size[doorway.axis]
    run = (side.start, side.end)
    inner = []
    for a, towards in ((run[0], 1), (run[1], -1)):
        corners = [side.at(a, o, z) for o, z in ((0, 0), (deep, 0), (deep, height), (0, height))]
        inner.append(polygon(corners, towards * (side.at(1, 0, 0) - side.at(0, 0, 0)), WALL, plain(WHITE)))
    for z, towards, label, paint in ((FLOOR_M, 1, FLOOR, floor), (height, -1, WALL, plain(WHITE))):
        corners = [side.at(a, o, z) for a, o in ((run[0], 0), (run[1], 0), (run[1], deep), (run[0], deep))]
        inner.append(polygon(corners, (0, 0, towards), label, paint))
    return inner


def outlook(side: Side, sky: np.ndarray, phase: float) -> Colouring:
    """What one sees through a pane: sky over a line of trees and a lawn."""

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
    """Reveals, frame with a mullion, pane and sill of one window; also what one sees of it from outside."""
    a0, a1 = side.along(box.rect)
    z0, z1, deep = box.low[2], box.high[2], box.rect.size[side.axis]
    glass, white = -0.6 * deep, plain(WHITE)
    charts = []
    for corners, towards in (
        ([(a0, 0, z0), (a0, -deep, z0), (a0, -deep, z1), (a0, 0, z1)], side.at(1, 0, 0) - side.at(0, 0, 0)),
        ([(a1, 0, z0), (a1, -deep, z0), (a1, -deep, z1), (a1, 0, z1)], side.at(0, 0, 0) - side.at(1, 0, 0)),
        ([(a0, 0, z0), (a1, 0, z0), (a1, -deep, z0), (a0, -deep, z0)], (0, 0, 1)),
        ([(a0, 0, z1), (a1, 0, z1), (a1, -deep, z1), (a0, -deep, z1)], (0, 0, -1)),
    ):
        charts.append(polygon([side.at(*c) for c in corners], towards, WALL, plain(0.86 * WHITE), 10.0, glows=True))
    corners = [side.at(a, glass, z) for a, z in ((a0, z0), (a1, z0), (a1, z1), (a0, z1))]
    charts.append(polygon(corners, side.inward, WINDOW, pane, 60.0, glows=True))
    charts.append(polygon(corners, -side.inward, WINDOW, plain([0.35, 0.42, 0.47]), 4.0))
    bar, out = 0.055, (glass, glass + 0.045)
    mullions = [(a0 + a1) / 2] if a1 - a0 > 0.95 else []
    for m in mullions:
        charts += side.slab((m - 0.03, m + 0.03), out, (z0 + bar, z1 - bar), WINDOW, white, skip="but")
    charts += side.slab((a0, a1), out, (z0, z0 + bar), WINDOW, white, skip="bulr")
    charts += side.slab((a0, a1), out, (z1 - bar, z1), WINDOW, white, skip="btlr")
    for run, skip in (((a0, a0 + bar), "butl"), ((a1 - bar, a1), "butr")):
        charts += side.slab(run, out, (z0 + bar, z1 - bar), WINDOW, white, skip=skip)
    return charts + side.slab((a0 - 0.02, a1 + 0.02), (0.0, 0.02), (z0 - 0.03, z0 + 0.001), WALL, white)


def curtains(side: Side, box: PlanBox, foot: float, colour: np.ndarray) -> list[Chart]:
    """A rod and two gathered curtains down to the height `foot`, at most 0.06 m from the wall."""
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
            ends = (alongs[k], outs[k]), (alongs[k + 1], outs[k + 1])
            corners = [
                side.at(a, o, z) for (a, o), z in ((ends[0], foot), (ends[1], foot), (ends[1], top), (ends[0], top))
            ]
            run = (alongs[k + 1] - alongs[k]) * np.sign(step)
            # Out of the wall, or to the curtain's own end where it returns to it.
            away = (
                side.inward
                if run > 0
                else (side.at(alongs[k] - sum(alongs[1:-1]) / (folds + 1), 0, 0) - side.at(0, 0, 0))
            )
            shade = 0.86 if k % 2 else 1.04
            paint = plain(np.minimum(colour * shade, 1))
            charts.append(polygon(corners, away, CURTAIN, paint, 25.0, lit_as=side.inward))
    return charts


def _leaf(side: Side, middle: float, colour: np.ndarray) -> Colouring:
    """A front door's leaf: four panels with bevelled rims."""

    def paint(p: np.ndarray) -> np.ndarray:
        x, z = np.abs(p[:, 1 - side.axis] - middle), p[:, 2]
        inside = np.minimum(
            np.minimum(x - 0.05, 0.36 - x), np.minimum(np.abs(z - 1.05) - 0.12, 0.85 - np.abs(z - 1.05))
        )
        tone = np.where((inside > 0) & (inside < 0.02), 0.72, np.where((inside > 0.02) & (inside < 0.035), 1.12, 1.0))
        return np.minimum(colour * tone[:, None], 1.0)

    return paint


def entrance_place(
    sides: Iterable[Side], outer: Iterable[bool], standing: shapely.Geometry
) -> tuple[Side, float] | None:
    """A wall and the middle of a front door on it, with floor before it; None: no outer wall has room for one."""
    half = ENTRANCE_M[0] / 2 + CASING_M + 0.03
    for depth_m in (0.95, 0.5, 0.15):
        for side, is_outer in zip(sides, outer, strict=True):
            if not is_outer:
                continue
            for middle in np.arange(side.start + half + 0.1, side.end - half - 0.1, 0.05).round(3):
                clear = all(h.end + 0.25 < middle - half or h.start - 0.25 > middle + half for h in side.holes())
                if clear and not side.strip(middle - half, middle + half, depth_m).intersects(standing):
                    return side, float(middle)
    return None


def entrance(side: Side, middle: float, colour: np.ndarray) -> list[Chart]:
    """A closed front door with casing and handle."""
    low, high = middle - ENTRANCE_M[0] / 2, middle + ENTRANCE_M[0] / 2
    hole = Hole(low, high, 0.0, ENTRANCE_M[1])
    leaf = side.slab((low, high), (0.0, 0.006), (0.0, ENTRANCE_M[1]), OTHER, _leaf(side, middle, colour), 80.0, "bulrt")
    steel = plain([0.66, 0.66, 0.67])
    plate = side.slab((high - 0.1, high - 0.06), (0.006, 0.012), (0.93, 1.15), OTHER, steel)
    handle = side.slab((high - 0.2, high - 0.07), (0.03, 0.045), (1.04, 1.06), OTHER, steel, skip="")
    return [*casing(side, hole), *leaf, *plate, *handle]


def switch(side: Side, along: float, z: float) -> list[Chart]:
    """A plate of a light switch or socket."""
    run, heights = (along - 0.04, along + 0.04), (z - 0.04, z + 0.04)
    plate = side.slab(run, (0.0, 0.008), heights, WALL, plain([0.97, 0.97, 0.96]))
    inner = (along - 0.022, along + 0.022), (0.008, 0.011), (z - 0.026, z + 0.026)
    return plate + side.slab(*inner, WALL, plain([0.88, 0.88, 0.87]))


def cupboard(box: PlanBox, colour: np.ndarray) -> list[Chart]:
    """A fixture: a box with fronts and a dark worktop where it is low."""
    low, high = np.array(box.low), np.array(box.high)

    def paint(p: np.ndarray) -> np.ndarray:
        seam = (np.mod(p[:, :2] - low[:2] + 0.003, 0.45) < 0.006).any(axis=1) & (p[:, 2] < high[2] - 0.001)
        value = colour * np.where(seam, 0.7, 1.0)[:, None]
        return np.where((p[:, 2] > high[2] - 0.04)[:, None] & (high[2] < 1.2), [0.35, 0.34, 0.33], value)

    side = Side(0, 1, low[0], low[1], high[1], (), ())
    return side.slab(
        (low[1], high[1]), (0.0, high[0] - low[0]), (low[2], high[2]), NYU40["cabinet"], paint, 80.0, "u", False
    )
