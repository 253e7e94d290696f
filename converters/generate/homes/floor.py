"""Rasterise furniture and the floor that must stay free, and find where a group fits.

Rasters are (rows along +y, columns along +x), cells of `CELL_M`, [0, 0] at the lower left of the building's outline.
"""

import dataclasses
import functools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import shapely

from converters.generate.homes.arrange import LOW_M, Arrangement
from converters.generate.homes.building import Plan, Rect, doorway_zone
from converters.generate.models.cad import Instance
from converters.geometry.density import ROBOTS
from interactive_nav_common.grids import clearance, label

CELL_M = 0.025
DOORWAY_ZONE_M, DOORWAY_SIDE_M = 0.75, 0.15
"""Before a doorway and beside its edges, free of furniture at first."""
GAP_M = 0.03
"""Between pieces of different groups, at least."""
STEP_M = 0.05
"""Between places tried along a wall; those in the open are two such steps apart."""
WINDOW_STRIP_M = 0.25
"""Before a window, where tall furniture does not stand."""
BEYOND_M = 0.8
"""Floor behind a doorway that is looked at, as if nothing stood there."""
STRANDED_M2 = 0.2
"""Floor where a robot fits but does not get to that a group may cut off."""


@dataclasses.dataclass
class Standing:
    """Describe a piece that stands; mutable, as pieces are moved into passages."""

    item: Instance
    room: int
    group: str
    """Key of `GROUPS`, a category where it stands alone, "door" for a leaf."""
    window: tuple[slice, slice]
    """Rows and columns of the raster around it."""
    shadow: np.ndarray
    """(rows, columns of `window`) bool: what it covers, from above."""
    below: dict[str, np.ndarray]
    """Robot -> what of it is in the robot's way: what lies higher is not."""


@dataclasses.dataclass(frozen=True)
class Places:
    """Hold where a group could stand: one place a row."""

    origin: np.ndarray
    """(n, 2) of the group's frame."""
    side: np.ndarray
    """(n,) direction of its v axis, quarter turns from +x."""
    ends: np.ndarray
    """(n, 2) distance to both ends of the wall behind it, or to the walls around, m."""


class Floor:
    """Hold the floor of a home. Mutable, private to one home."""

    def __init__(self, plan: Plan, sweeps: list[shapely.Polygon]):
        self.plan = plan
        o = plan.outer
        self.low = np.array([o.x0, o.y0])
        self.shape = (math.ceil(o.size[1] / CELL_M), math.ceil(o.size[0] / CELL_M))
        self.room = np.full(self.shape, -1, np.int16)
        for k, rect in enumerate(plan.rooms):
            self.room[self.cells(rect)] = k
        self.inside = self.room >= 0
        for doorway in plan.doorways:
            self.inside[self.cells(doorway.rect)] = True
        self.covered = np.zeros(self.shape, np.uint8)
        """Pieces above each cell."""
        self.below = {robot: np.zeros(self.shape, np.uint8) for robot in ROBOTS}
        """Robot -> pieces in its way in each cell."""
        self.fixed = np.zeros(self.shape, bool)
        """Built-in furniture."""
        self.kept = np.zeros(self.shape, bool)
        """Before doorways."""
        for doorway in plan.doorways:
            self.kept[self.cells(doorway_zone(doorway, DOORWAY_ZONE_M, DOORWAY_SIDE_M))] = True
        self.swept = np.zeros(self.shape, bool)
        """What door leaves sweep."""
        for sweep in sweeps:
            window, inside = self.raster([sweep])
            self.swept[window] |= inside
        if plan.entrance_zone is not None:  # the front door opens inwards
            self.swept[self.cells(plan.entrance_zone)] = True
        self.front = np.zeros(self.shape, bool)
        """Before furniture that one steps up to."""
        self.glass = np.zeros(self.shape, bool)
        for box in plan.windows:
            self.glass[self.cells(box.rect.grown(WINDOW_STRIP_M, WINDOW_STRIP_M))] = True
        self.bare = self.glass.copy()
        """Before windows without a radiator."""
        self.standing: list[Standing] = []
        rows, columns = self.shape
        rooms = [self.cells(rect.grown(BEYOND_M, BEYOND_M)) for rect in plan.rooms]
        self._views = [(slice(r.start, min(r.stop, rows)), slice(c.start, min(c.stop, columns))) for r, c in rooms]
        """By room: what is looked at to furnish it."""
        self._lasting: dict[Any, np.ndarray] = {}
        """By room, layers: sums without `covered`."""
        self._passing: list[dict[Any, Any]] = [{} for _ in rooms]
        """By room: those with it; `_middles`."""

    def cells(self, rect: Rect) -> tuple[slice, slice]:
        """Return the rows and columns of the cells whose middles lie in a rectangle."""
        edges = (np.array([rect.y0, rect.y1, rect.x0, rect.x1]) - self.low[[1, 1, 0, 0]]) / CELL_M
        r0, r1, c0, c1 = np.maximum(np.round(edges), 0).astype(int)
        return slice(r0, r1), slice(c0, c1)

    def raster(self, shapes: list[shapely.Geometry]) -> tuple[tuple[slice, slice], np.ndarray]:
        """Return the window of cells around shapes, and which of them have their middle inside of one."""
        window = self.around(shapes)
        return window, self.rastered(shapes, window)

    def around(self, shapes: list[shapely.Geometry]) -> tuple[slice, slice]:
        """Return the rows and columns of the window of cells around shapes."""
        bounds = np.array([s.bounds for s in shapes])
        x0, y0 = bounds[:, :2].min(axis=0)
        x1, y1 = bounds[:, 2:].max(axis=0)
        window = self.cells(Rect(x0, y0, x1, y1).grown(CELL_M, CELL_M))
        window = tuple(slice(s.start, min(s.stop, n)) for s, n in zip(window, self.shape, strict=True))
        return window[0], window[1]

    def rastered(self, shapes: list[shapely.Geometry], window: tuple[slice, slice]) -> np.ndarray:
        """Return which cells of a window have their middle inside of a shape."""
        ends = zip(window, self.low[::-1], strict=True)
        ys, xs = ((np.arange(s.start, s.stop) + 0.5) * CELL_M + low for s, low in ends)
        inside = np.zeros((len(ys), len(xs)), bool)
        for shape in shapes:
            inside |= shapely.contains_xy(shape, *np.meshgrid(xs, ys))
        return inside

    # -- what stands ----------------------------------------------------

    def add(self, item: Instance, room: int, group: str) -> Standing:
        """Stand a piece on the floor."""
        window = self.around(item.outlines())
        masks = [(self.rastered([outline], window), low_m) for outline, low_m, _ in item.slabs]
        shadow = np.any([mask for mask, _ in masks], axis=0)
        below = {
            robot: np.any([mask & (low_m < disc.height_m) for mask, low_m in masks], axis=0)
            for robot, disc in ROBOTS.items()
        }
        piece = Standing(item, room, group, window, shadow, below)
        self.standing.append(piece)
        self.cover(piece, 1)
        if item.model.category == "radiator":
            for zone in (box.rect.grown(WINDOW_STRIP_M, WINDOW_STRIP_M) for box in self.plan.windows):
                if item.footprint.intersects(zone.polygon):
                    self.bare[self.cells(zone)] = False
            self._lasting.clear()
        return piece

    def keep_front(self, rect: Rect) -> None:
        """Keep the floor before furniture that one steps up to free."""
        self.front[self.cells(rect)] = True
        self._lasting.clear()

    def cover(self, piece: Standing, by: int) -> None:
        """Count a piece in (1) or out (-1) of what is covered."""
        self.covered[piece.window] += np.where(piece.shadow, np.uint8(by % 256), np.uint8(0))
        for robot, below in piece.below.items():
            self.below[robot][piece.window] += np.where(below, np.uint8(by % 256), np.uint8(0))
        if piece.item.model.built_in:
            self.fixed[piece.window] |= piece.shadow
        for view, passing in zip(self._views, self._passing, strict=True):
            if all(a.start < b.stop and b.start < a.stop for a, b in zip(view, piece.window, strict=True)):
                passing.clear()

    def remove(self, piece: Standing) -> None:
        """Take away a piece that is not built in."""
        assert not piece.item.model.built_in
        self.standing = [s for s in self.standing if s is not piece]
        self.cover(piece, -1)

    def free(self, robot: str) -> np.ndarray:
        """Return (rows, columns) bool: floor on which nothing is in a robot's way."""
        return self.inside & (self.below[robot] == 0)

    @functools.cached_property
    def floor_cells(self) -> int:
        """Return the number of cells inside of the walls, doorways included."""
        return int(self.inside.sum())

    @property
    def share(self) -> float:
        """Return the share of the floor that furniture covers."""
        return float(np.count_nonzero(self.inside & (self.covered > 0)) / self.floor_cells)

    def room_share(self, room: int) -> float:
        """Return the same of one room."""
        here = self.covered[self.cells(self.plan.rooms[room])]
        return float((here > 0).mean())

    # -- where groups fit -----------------------------------------------

    def _sums(self, room: int, *layers: str) -> tuple[np.ndarray, np.ndarray]:
        """Return a room's lower left cell and running sums of its cells in any layer: "wall", "covered" or a raster."""
        rows, columns = self.cells(self.plan.rooms[room])
        window = slice(max(rows.start - 8, 0), rows.stop + 8), slice(max(columns.start - 8, 0), columns.stop + 8)
        memo, key = self._passing[room] if "covered" in layers else self._lasting, (room, *layers)
        if key not in memo:
            rasters = (getattr(self, name)[window] if name != "wall" else self.room[window] != room for name in layers)
            cells = functools.reduce(np.logical_or, rasters).astype(bool)
            memo[key] = np.zeros(np.add(cells.shape, 1), np.int32)
            memo[key][1:, 1:] = cells.cumsum(0, dtype=np.int32).cumsum(1)
        return np.array([window[1].start, window[0].start]) * CELL_M + self.low, memo[key]

    def places(self, arrangement: Arrangement, room: int, rng: np.random.Generator) -> Places:
        """Return all places of a room where a group might stand, before looking at what stands there."""
        r, at = self.plan.rooms[room], arrangement.group.at
        if at in ("free", "anywhere"):
            n = (int(r.size[0] / STEP_M / 2), int(r.size[1] / STEP_M / 2))
            xs, ys = np.meshgrid(*(np.arange(k) * 2 * STEP_M + rng.uniform(0, 2 * STEP_M) for k in n))
            origin = np.stack([r.x0 + xs.ravel(), r.y0 + ys.ravel()], axis=1)
            side = rng.integers(4, size=len(origin))
            return Places(origin, side, np.minimum(origin - [r.x0, r.y0], [r.x1, r.y1] - origin))
        rows, half = [], arrangement.pieces[0].half_m[0]
        for side in range(4):
            length = r.size[1 - side % 2]
            along = np.arange(half + 0.01, length - half, STEP_M)
            along = np.append(along, max(length - half - 0.01, 0.0))
            origin = np.stack([r.x0 + along, r.y0 + along], 1)
            origin[:, side % 2] = (r.x0, r.y0, r.x1, r.y1)[side]
            rows.append((origin, np.full(len(along), side), np.stack([along, length - along], 1)))
        return Places(*(np.concatenate(part) for part in zip(*rows, strict=True)))

    def hindered(
        self, boxes: np.ndarray, places: Places, low: np.ndarray, sums: np.ndarray, gap_m: float = 0.0
    ) -> np.ndarray:
        """Return (n,) how many cells of a layer lie in a rectangle of the group's frame, for all places."""
        c, s = np.array([1, 0, -1, 0])[places.side], np.array([0, 1, 0, -1])[places.side]
        corners = [places.origin + np.stack([s * u + c * v, -c * u + s * v], 1) for u, v in (boxes[:2], boxes[2:])]
        lowest, highest = np.minimum(*corners) - gap_m - low, np.maximum(*corners) + gap_m - low
        c0, r0 = np.clip(np.floor(lowest / CELL_M + 0.3), 0, None).astype(int).T
        c1, r1 = np.clip(np.ceil(highest / CELL_M - 0.3), 0, None).astype(int).T
        rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
        out = sums[-1, -1] * ((c1 > columns) | (r1 > rows) | (lowest.min(axis=1) < 0))
        r0, r1, c0, c1 = np.minimum(r0, rows), np.minimum(r1, rows), np.minimum(c0, columns), np.minimum(c1, columns)
        return sums[r1, c1] - sums[r0, c1] - sums[r1, c0] + sums[r0, c0] + out

    def fitting(self, arrangement: Arrangement, room: int, places: Places) -> np.ndarray:
        """Return (n, pieces) bool: which pieces of a group have room at each place where those that it needs have."""
        fits = np.zeros((len(places.side), len(arrangement.pieces)), bool)
        left = np.arange(len(places.side))
        front = arrangement.front

        def clear(box: np.ndarray, layers: tuple[str, ...], gap_m: float = 0.0) -> np.ndarray:
            at = Places(places.origin[left], places.side[left], places.ends[left])
            return self.hindered(box, at, *self._sums(room, *layers), gap_m) == 0

        if front is not None:
            left = left[clear(np.array(front), ("wall", "covered"))]
        # Those that the group needs first: where one of them has no room, the others need not be looked at.
        for k, piece in sorted(enumerate(arrangement.pieces), key=lambda of: of[0] > 0 and not of[1].needed):
            box = np.array(piece.corners_m)
            # A scan's annotations are a centimetre off: what stood in an alcove without play would be wedged there.
            beside = 0.0 if piece.model.built_in else GAP_M
            high = piece.size_m[1] > LOW_M and piece.model.category != "sink"  # a tap may stand before a window
            high &= piece.size_m[0] > 0.4 or piece.model.built_in
            here = clear(box + [-beside, 0, beside, 0], ("wall",)) & clear(box, ("covered",), GAP_M)
            here &= clear(box, ("swept", "kept", "front", *(("glass",) if high else ())))
            fits[left, k] = here
            left = left[here] if k == 0 or piece.needed else left
        return fits

    def before_window(self, arrangement: Arrangement, places: Places, room: int) -> np.ndarray:
        """Return (n,) the share of the anchor's width that stands before a window without a radiator."""
        half = arrangement.pieces[0].half_m[0]
        strip = np.array([-half, 0.0, half, WINDOW_STRIP_M - 2 * CELL_M])
        return self.hindered(strip, places, *self._sums(room, "bare")) * CELL_M**2 / (2 * half * strip[3])

    # -- whether one still gets through ---------------------------------

    def reach(self, room: int, radius_m: float, boxes: Iterable[Rect] = ()) -> tuple[bool, float]:
        """Return whether a disc gets between all of a room's doorways, and the area (m2) cut off from them."""
        passing = self._passing[room]
        if radius_m not in passing:
            passing[radius_m] = self._middles(room, radius_m)
        middles, doors = passing[radius_m]
        middles, more = middles.copy(), math.ceil(radius_m / CELL_M) + 1
        row, column = (np.arange(n) for n in middles.shape)
        for y, x in (self._in_view(room, box) for box in boxes):
            if y.start < y.stop and x.start < x.stop:
                near = tuple(slice(max(s.start - more, 0), s.stop + more) for s in (y, x))
                dy = np.maximum(y.start - row, row - y.stop + 1)[near[0], None].clip(0)
                dx = np.maximum(x.start - column, column - x.stop + 1)[near[1]].clip(0)
                middles[near] &= np.maximum(np.sqrt(dy**2 + dx**2) - 0.5, 0.0) * CELL_M >= radius_m  # as `clearance`
        region = label(middles)[0]
        at = [int(region[door]) for door in doors]
        main = at[0] if at else int(np.bincount(region.ravel())[1:].argmax() + 1) if region.any() else 0
        return main > 0 and set(at) <= {main}, float(((region > 0) & (region != main)).sum() * CELL_M**2)

    def _in_view(self, room: int, rect: Rect) -> tuple[slice, slice]:
        """Return the rows and columns of a room's view, counted from its corner, that lie in a rectangle."""
        both = zip(self.cells(rect), self._views[room], strict=True)
        y, x = (slice(*(min(max(k, v.start), v.stop) - v.start for k in (s.start, s.stop))) for s, v in both)
        return y, x

    def _middles(self, room: int, radius_m: float) -> tuple[np.ndarray, list[tuple[int, int]]]:
        """Return where in a room's view a disc's middle may be, (rows, columns) bool, and the cells of its doorways."""
        view = self._views[room]
        corner, inside = [s.start for s in view], self.room[view] == room
        free = inside.copy()
        doorways = [d for d in (*self.plan.doorways, self.plan.entrance) if d is not None and room in d.rooms]
        for doorway in doorways:  # the floor behind a doorway counts as free
            free[self._in_view(room, doorway_zone(doorway, BEYOND_M, 0.0))] = True
        free &= ~inside | (self.covered[view] == 0)
        doors = [(np.array(d.rect.centre) - self.low)[::-1] // CELL_M - corner for d in doorways]
        return clearance(free, CELL_M) >= radius_m, [(int(row), int(column)) for row, column in doors]
