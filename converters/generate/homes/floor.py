"""Keep what stands in a home and what must stay free on a raster: look up where a group fits, all places at once.

Rasters are (rows, columns), rows along +y and columns along +x, cells of `CELL_M`, cell [0, 0] at the lower left
corner of the building's outline.
"""

import dataclasses
import math
from collections.abc import Iterable

import numpy as np
import shapely

from converters.generate.design.plan import Plan, Rect, doorway_zone
from converters.generate.homes.arrange import LOW_M, Arrangement
from converters.generate.models.cad import Instance
from converters.geometry.density import ROBOTS
from interactive_nav_common.grids import clearance, label

CELL_M = 0.025
DOORWAY_ZONE_M = 0.75
"""Before a doorway, free of furniture at first."""
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
            self.kept[self.cells(doorway_zone(doorway, DOORWAY_ZONE_M))] = True
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

    def cells(self, rect: Rect) -> tuple[slice, slice]:
        """Return the rows and columns of the cells whose middles lie in a rectangle."""
        edges = (np.array([rect.y0, rect.y1, rect.x0, rect.x1]) - self.low[[1, 1, 0, 0]]) / CELL_M
        r0, r1, c0, c1 = np.maximum(np.round(edges), 0).astype(int)
        return slice(r0, r1), slice(c0, c1)

    def raster(self, shapes: list[shapely.Geometry]) -> tuple[tuple[slice, slice], np.ndarray]:
        """Return the window of cells around shapes, and which of them have their middle inside of one."""
        bounds = np.array([s.bounds for s in shapes])
        x0, y0 = bounds[:, :2].min(axis=0)
        x1, y1 = bounds[:, 2:].max(axis=0)
        window = self.cells(Rect(x0, y0, x1, y1).grown(CELL_M, CELL_M))
        window = tuple(slice(s.start, min(s.stop, n)) for s, n in zip(window, self.shape, strict=True))
        return (window[0], window[1]), self.rastered(shapes, (window[0], window[1]))

    def rastered(self, shapes: list[shapely.Geometry], window: tuple[slice, slice]) -> np.ndarray:
        """Return which cells of a window have their middle inside of a shape."""
        ys, xs = (
            (np.arange(s.start, s.stop) + 0.5) * CELL_M + low for s, low in zip(window, self.low[::-1], strict=True)
        )
        inside = np.zeros((len(ys), len(xs)), bool)
        for shape in shapes:
            inside |= shapely.contains_xy(shape, *np.meshgrid(xs, ys))
        return inside

    # -- what stands ----------------------------------------------------

    def add(self, item: Instance, room: int, group: str) -> Standing:
        """Stand a piece on the floor."""
        window, shadow = self.raster(item.outlines())
        below = {
            robot: self.rastered(item.outlines((-math.inf, disc.height_m)), window) for robot, disc in ROBOTS.items()
        }
        piece = Standing(item, room, group, window, shadow, below)
        self.standing.append(piece)
        self.cover(piece, 1)
        if item.model.category == "radiator":
            for zone in (box.rect.grown(WINDOW_STRIP_M, WINDOW_STRIP_M) for box in self.plan.windows):
                if item.footprint.intersects(zone.polygon):
                    self.bare[self.cells(zone)] = False
        return piece

    def cover(self, piece: Standing, by: int) -> None:
        """Count a piece in (1) or out (-1) of what is covered."""
        self.covered[piece.window] += np.where(piece.shadow, np.uint8(by % 256), np.uint8(0))
        for robot, below in piece.below.items():
            self.below[robot][piece.window] += np.where(below, np.uint8(by % 256), np.uint8(0))
        if piece.item.model.built_in:
            self.fixed[piece.window] |= piece.shadow

    def remove(self, piece: Standing) -> None:
        """Take away a piece that is not built in."""
        assert not piece.item.model.built_in
        self.standing = [s for s in self.standing if s is not piece]
        self.cover(piece, -1)

    def free(self, robot: str) -> np.ndarray:
        """Return (rows, columns) bool: floor on which nothing is in a robot's way."""
        return self.inside & (self.below[robot] == 0)

    @property
    def floor_cells(self) -> int:
        """Return the number of cells inside of the walls, doorways included."""
        return int(self.inside.sum())

    @property
    def share(self) -> float:
        """Return the share of the floor that furniture covers."""
        return float((self.covered[self.inside] > 0).sum() / self.floor_cells)

    def room_share(self, room: int) -> float:
        """Return the same of one room."""
        here = self.covered[self.cells(self.plan.rooms[room])]
        return float((here > 0).mean())

    # -- where groups fit -----------------------------------------------

    def _room_sums(self, room: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the lower left corner of a room's window and running sums of what hinders there."""
        rows, columns = self.cells(self.plan.rooms[room])
        window = slice(max(rows.start - 8, 0), rows.stop + 8), slice(max(columns.start - 8, 0), columns.stop + 8)
        layers = {"wall": self.room[window] != room, "taken": self.covered[window] > 0}
        layers |= {name: getattr(self, name)[window] for name in ("kept", "front", "glass", "bare", "swept")}
        sums = {k: np.pad(layer.cumsum(0, dtype=np.int32).cumsum(1), ((1, 0), (1, 0))) for k, layer in layers.items()}
        return np.array([window[1].start, window[0].start]) * CELL_M + self.low, sums

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

    def fitting(self, arrangement: Arrangement, room: int, places: Places, strict: bool = True) -> np.ndarray:
        """Return (n, pieces) bool: which pieces of a group have room at each place."""
        low, sums = self._room_sums(room)

        def clear(box: np.ndarray, layers: Iterable[str], gap_m: float = 0.0) -> np.ndarray:
            return np.all([self.hindered(box, places, low, sums[layer], gap_m) == 0 for layer in layers], axis=0)

        fits = np.ones((len(places.side), len(arrangement.pieces)), bool)
        for k, piece in enumerate(arrangement.pieces):
            box = np.array(piece.corners_m)
            # A scan's annotations are a centimetre off: what stood in an alcove without play would be wedged there.
            beside = 0.0 if piece.model.built_in else GAP_M
            high = piece.size_m[1] > LOW_M and piece.model.category != "sink"  # a tap may stand before a window
            high &= piece.size_m[0] > 0.4 or piece.model.built_in
            fits[:, k] = clear(box + [-beside, 0, beside, 0], ["wall"]) & clear(box, ["taken"], GAP_M)
            fits[:, k] &= clear(box, ["swept", *(("kept", "front") if strict else ()), *(("glass",) if high else ())])
        if arrangement.front is not None and strict:
            fits[:, 0] &= clear(np.array(arrangement.front), ("wall", "taken"))
        return fits

    def before_window(self, arrangement: Arrangement, places: Places, room: int) -> np.ndarray:
        """Return (n,) the share of the anchor's width that stands before a window without a radiator."""
        low, sums = self._room_sums(room)
        half = arrangement.pieces[0].half_m[0]
        strip = np.array([-half, 0.0, half, WINDOW_STRIP_M - 2 * CELL_M])
        return self.hindered(strip, places, low, sums["bare"]) * CELL_M**2 / (2 * half * strip[3])

    # -- whether one still gets through ---------------------------------

    def reach(self, room: int, radius_m: float, boxes: list[Rect] | None = None) -> tuple[bool, float]:
        """Return what a disc reaches of a room with the furniture where it stands.

        That is whether it gets from each doorway of the room to each other one inside of the room, and the area, m2, in
        which its middle could be but to which it does not get from there.
        """
        rows, columns = self.cells(self.plan.rooms[room].grown(BEYOND_M, BEYOND_M))
        corner = np.array([rows.start, columns.start])

        def here(rect: Rect) -> tuple[slice, slice]:
            window = zip(self.cells(rect), corner, free.shape, strict=True)
            y, x = (slice(max(s.start - low, 0), min(max(s.stop - low, 0), n)) for s, low, n in window)
            return y, x

        inside = self.room[rows, columns] == room
        free = inside.copy()
        doorways = [d for d in (*self.plan.doorways, self.plan.entrance) if d is not None and room in d.rooms]
        for doorway in doorways:  # the floor behind a doorway counts as free
            free[here(doorway_zone(doorway, BEYOND_M, 0.0))] = True
        free &= ~inside | (self.covered[rows, columns] == 0)
        for box in boxes or []:
            free[here(box)] = False
        region = label(clearance(free, CELL_M) >= radius_m)[0]
        at = []
        for doorway in doorways:
            x, y = doorway.rect.centre
            row, column = (np.array([y, x]) - self.low[::-1]) // CELL_M - corner
            at.append(int(region[int(row), int(column)]))
        main = at[0] if at else int(np.bincount(region.ravel())[1:].argmax() + 1) if region.any() else 0
        return main > 0 and set(at) <= {main}, float(((region > 0) & (region != main)).sum() * CELL_M**2)
