"""A configuration and a random stream in, a floor plan out: rooms, walls, doorways, windows, cupboards.

Frame: x, y of the scan (z up), metres; heights are above the floor. All horizontal coordinates are whole
centimetres, so that a map of 1 cm a pixel shows the walls exactly.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable

import networkx as nx
import numpy as np

from converters.generate.design.config import BuildingConfig, GenerationError
from converters.generate.design.instance import Instance
from converters.generate.design.parts import Parts

CM = 0.01
DOORWAY_MARGIN_M = 0.12
"""Least wall left between a doorway and the corner of a room."""


@dataclasses.dataclass(frozen=True)
class PlanBox:
    """An axis-aligned box."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def rect(self) -> Rect:
        """Its footprint."""
        return Rect(self.low[0], self.low[1], self.high[0], self.high[1])


@dataclasses.dataclass(frozen=True)
class Rect:
    """An axis-aligned rectangle on the floor."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def size(self) -> tuple[float, float]:
        """Extent along x and y."""
        return self.x1 - self.x0, self.y1 - self.y0

    @property
    def area_m2(self) -> float:
        """Area."""
        return self.size[0] * self.size[1]

    @property
    def centre(self) -> tuple[float, float]:
        """Centre."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2


@dataclasses.dataclass(frozen=True)
class Doorway:
    """An opening in the wall between two rooms."""

    rooms: tuple[int, int]
    """Indices of the rooms on its low and its high side along `axis`."""
    axis: int
    """0: one walks through it along x; 1: along y."""
    rect: Rect
    """The opening: as deep as the wall is thick."""
    height_m: float

    @property
    def width_m(self) -> float:
        """Clear width."""
        return self.rect.size[1 - self.axis]


@dataclasses.dataclass(frozen=True)
class Plan:
    """A floor plan."""

    rooms: tuple[Rect, ...]
    """Clear inside of each room."""
    outer: Rect
    """Outline of the building, outer walls included."""
    walls: tuple[PlanBox, ...]
    """Wall pieces, doorways cut out; those above a doorway start at its height."""
    doorways: tuple[Doorway, ...]
    windows: tuple[PlanBox, ...]
    """Glass: as deep as the outer wall."""
    fixtures: tuple[PlanBox, ...]
    """Built-in cupboards and counters: unmovable."""
    corridor: int | None
    """Index of the corridor in `rooms`."""
    wall_height_m: float
    door_height_m: float
    built_in: tuple[Instance, ...] = dataclasses.field(default=(), compare=False)
    """Furniture that stays: part of the static structure as the fixtures are."""


def snap(value: float) -> float:
    """Rounds to a whole centimetre."""
    return round(value / CM) * CM


@dataclasses.dataclass(frozen=True)
class _Wall:
    axis: int
    """The wall is thin along this axis."""
    rect: Rect


def _cut(rect: Rect, axis: int, at: float, thick: float) -> tuple[Rect, _Wall, Rect]:
    """Cuts a rectangle across `axis`: what lies below `at`, a wall, and the rest."""
    if axis == 0:
        return (
            Rect(rect.x0, rect.y0, at, rect.y1),
            _Wall(0, Rect(at, rect.y0, at + thick, rect.y1)),
            Rect(at + thick, rect.y0, rect.x1, rect.y1),
        )
    return (
        Rect(rect.x0, rect.y0, rect.x1, at),
        _Wall(1, Rect(rect.x0, at, rect.x1, at + thick)),
        Rect(rect.x0, at + thick, rect.x1, rect.y1),
    )


def _split(rect: Rect, parts: Parts, cfg: BuildingConfig, rng: np.random.Generator) -> tuple[list[Rect], list[_Wall]]:
    """Cuts a rectangle into rooms, always across its longer side (mostly)."""
    n = len(parts.weights)
    if n == 1:
        return [rect], []
    width, depth = rect.size
    axis = int(depth > width) if rng.random() < 0.85 else int(rng.random() < 0.5)
    n_low = n // 2 if rng.random() < 0.5 else n - n // 2
    few, many = parts.cut(n_low)
    share = parts.share(n_low) + rng.uniform(-parts.spread, parts.spread)
    low_edge = (rect.x0, rect.y0)[axis]
    thick = snap(rng.uniform(*cfg.wall_thickness_m))
    low, wall, high = _cut(rect, axis, snap(low_edge + share * rect.size[axis] - thick / 2), thick)
    rooms_low, walls_low = _split(low, few, cfg, rng)
    rooms_high, walls_high = _split(high, many, cfg, rng)
    return rooms_low + rooms_high, [wall, *walls_low, *walls_high]


def _layout(
    cfg: BuildingConfig, rng: np.random.Generator, parts: Parts | None
) -> tuple[Rect, list[Rect], list[_Wall], int | None]:
    """One try at rooms and inner walls; raises nothing, the caller checks the rooms."""
    n = int(rng.integers(cfg.n_rooms[0], cfg.n_rooms[1] + 1)) if parts is None else len(parts.weights)
    area = rng.uniform(*cfg.floor_area_m2)
    aspect = rng.uniform(1.0, 1.6)
    width, depth = snap(np.sqrt(area * aspect)), snap(np.sqrt(area / aspect))
    if rng.random() < 0.5:
        width, depth = depth, width
    x0, y0 = snap(-width / 2 + rng.uniform(-0.7, 0.7)), snap(-depth / 2 + rng.uniform(-0.7, 0.7))
    inside = Rect(x0, y0, snap(x0 + width), snap(y0 + depth))
    if n < cfg.corridor_from_rooms:
        rooms, walls = _split(inside, parts or Parts.even(n), cfg, rng)
        return inside, rooms, walls, None
    parts = Parts(parts.weights[1:], parts.spread) if parts is not None else Parts.even(n - 1)
    across = int(width >= depth)
    thick = snap(rng.uniform(*cfg.wall_thickness_m))
    clear = snap(cfg.corridor_width_m)
    n_low = (n - 1) // 2
    span = inside.size[across] - clear - 2 * thick
    few, many = parts.cut(n_low)
    share = parts.share(n_low) + rng.uniform(-parts.spread / 2, parts.spread / 2)
    at = snap((inside.x0, inside.y0)[across] + span * share)
    low, wall_low, rest = _cut(inside, across, at, thick)
    corridor, wall_high, high = _cut(rest, across, snap(at + thick + clear), thick)
    rooms_low, walls_low = _split(low, few, cfg, rng)
    rooms_high, walls_high = _split(high, many, cfg, rng)
    return inside, [corridor, *rooms_low, *rooms_high], [wall_low, wall_high, *walls_low, *walls_high], 0


def _shared(a: Rect, b: Rect, walls: Iterable[_Wall]) -> tuple[int, Rect] | None:
    """The stretch of wall between rooms a (low side) and b (high side), with the wall's thin axis."""
    for wall in walls:
        axis, r = wall.axis, wall.rect
        along = 1 - axis
        a_edge, b_edge = (a.x1, a.y1)[axis], (b.x0, b.y0)[axis]
        if abs(a_edge - (r.x0, r.y0)[axis]) > CM / 2 or abs(b_edge - (r.x1, r.y1)[axis]) > CM / 2:
            continue
        start = max((a.x0, a.y0)[along], (b.x0, b.y0)[along], (r.x0, r.y0)[along])
        end = min((a.x1, a.y1)[along], (b.x1, b.y1)[along], (r.x1, r.y1)[along])
        if end - start > 0:
            return axis, Rect(a_edge, start, b_edge, end) if axis == 0 else Rect(start, a_edge, end, b_edge)
    return None


def _doorways(
    rooms: list[Rect],
    walls: list[_Wall],
    corridor: int | None,
    cfg: BuildingConfig,
    rng: np.random.Generator,
    door_height: float,
) -> list[Doorway] | None:
    """Doorways that join all rooms, and some more; None where the plan does not allow that."""
    graph = nx.Graph()
    shared_walls: dict[tuple[int, int], tuple[int, Rect]] = {}
    graph.add_nodes_from(range(len(rooms)))
    need = cfg.doorway_width_m[1] + 2 * DOORWAY_MARGIN_M
    for i, j in itertools.permutations(range(len(rooms)), 2):
        shared = _shared(rooms[i], rooms[j], walls)
        if shared is None:
            continue
        axis, rect = shared
        if rect.size[1 - axis] >= need:
            weight = rng.random() + (0.0 if corridor in (i, j) else 1.0)
            graph.add_edge(i, j, weight=weight)
            shared_walls[i, j] = axis, rect
    if not nx.is_connected(graph):
        return None
    tree = set(nx.minimum_spanning_edges(graph, data=False))
    chosen = []
    for (i, j), (axis, rect) in sorted(shared_walls.items()):
        if (i, j) not in tree and (j, i) not in tree and rng.random() >= cfg.loop_probability:
            continue
        start, end = ((rect.y0, rect.y1), (rect.x0, rect.x1))[axis]
        width = rng.uniform(*cfg.doorway_width_m)
        if rng.random() < 0.4:
            width += rng.uniform(0, cfg.archway_extra_m)
        width = snap(min(width, end - start - 2 * DOORWAY_MARGIN_M))
        slack = end - start - 2 * DOORWAY_MARGIN_M - width
        # Doorways sit near a corner more often than in the middle: it leaves wall for furniture.
        at = snap(start + DOORWAY_MARGIN_M + slack * rng.beta(0.5, 0.5))
        if cfg.corner_doorways and rng.random() < cfg.corner_doorways:
            margin = min(cfg.corner_margin_m, (end - start - width) / 2)
            at = snap(start + margin if rng.random() < 0.5 else end - margin - width)
        hole = Rect(rect.x0, at, rect.x1, at + width) if axis == 0 else Rect(at, rect.y0, at + width, rect.y1)
        chosen.append(Doorway((i, j), axis, hole, door_height))
    return chosen


def _wall_boxes(wall: Rect, axis: int, doorways: list[Doorway], height: float) -> list[PlanBox]:
    """The pieces of one wall around its doorways, and the pieces above them."""
    along = 1 - axis
    holes = []
    for d in doorways:
        same = d.axis == axis and abs((d.rect.x0, d.rect.y0)[axis] - (wall.x0, wall.y0)[axis]) < CM / 2
        if same and (wall.x0, wall.y0)[along] < (d.rect.x0, d.rect.y0)[along] < (wall.x1, wall.y1)[along]:
            holes.append(d)
    holes.sort(key=lambda d: (d.rect.x0, d.rect.y0)[along])

    def piece(start: float, end: float, base: float) -> PlanBox:
        if axis == 0:
            return PlanBox((wall.x0, start, base), (wall.x1, end, height))
        return PlanBox((start, wall.y0, base), (end, wall.y1, height))

    boxes, at = [], (wall.x0, wall.y0)[along]
    for d in holes:
        start, end = (d.rect.x0, d.rect.y0)[along], (d.rect.x1, d.rect.y1)[along]
        boxes += [piece(at, start, 0.0), piece(start, end, d.height_m)]
        at = end
    return [*boxes, piece(at, (wall.x1, wall.y1)[along], 0.0)]


def _sides(room: Rect) -> list[tuple[int, int, float, float, float]]:
    """The four walls of a room: (axis, sign of the way into the room, coordinate of the face, start, end)."""
    return [
        (0, 1, room.x0, room.y0, room.y1),
        (0, -1, room.x1, room.y0, room.y1),
        (1, 1, room.y0, room.x0, room.x1),
        (1, -1, room.y1, room.x0, room.x1),
    ]


def _overlap(a: Rect, b: Rect) -> bool:
    return a.x0 < b.x1 and b.x0 < a.x1 and a.y0 < b.y1 and b.y0 < a.y1


def doorway_zone(doorway: Doorway, reach_m: float, side_m: float = 0.05) -> Rect:
    """The doorway and the floor before it on both sides, which must stay free of fixtures and furniture."""
    r = doorway.rect
    grow = (reach_m, side_m) if doorway.axis == 0 else (side_m, reach_m)
    return Rect(r.x0 - grow[0], r.y0 - grow[1], r.x1 + grow[0], r.y1 + grow[1])


def _fixtures(
    rooms: list[Rect], doorways: list[Doorway], cfg: BuildingConfig, rng: np.random.Generator
) -> list[PlanBox]:
    """Cupboards and counters in corners of rooms, away from doorways."""
    wanted = int(rng.integers(cfg.n_static[0], cfg.n_static[1] + 1))
    boxes: list[PlanBox] = []
    zones = [doorway_zone(d, 1.05, 0.15) for d in doorways]
    order = rng.permutation(len(rooms))
    for room in [rooms[i] for i in order] * 3:
        if len(boxes) == wanted:
            break
        if min(room.size) < 1.8:
            continue
        axis, way, face, start, end = _sides(room)[rng.integers(4)]
        counter = rng.random() < 0.5
        length = snap(min(rng.uniform(1.2, 2.0) if counter else rng.uniform(0.8, 1.3), end - start))
        depth, height = (0.60, 0.90) if counter else (0.45, snap(rng.uniform(1.6, 2.1)))
        at = start if rng.random() < 0.5 else end - length
        lo, hi = sorted((face, face + way * depth))
        rect = Rect(lo, at, hi, at + length) if axis == 0 else Rect(at, lo, at + length, hi)
        if any(_overlap(rect, z) for z in zones) or any(_overlap(rect, b.rect) for b in boxes):
            continue
        boxes.append(PlanBox((rect.x0, rect.y0, 0.0), (rect.x1, rect.y1, height)))
    return boxes


def _windows(
    inside: Rect,
    rooms: list[Rect],
    fixtures: list[PlanBox],
    thick: float,
    cfg: BuildingConfig,
    rng: np.random.Generator,
) -> list[PlanBox]:
    """Windows in outer walls, each before one room, none behind a cupboard."""
    wanted = int(rng.integers(cfg.n_windows[0], cfg.n_windows[1] + 1))
    outer_faces = {(0, 1): inside.x0, (0, -1): inside.x1, (1, 1): inside.y0, (1, -1): inside.y1}
    sides = [
        s for room in rooms for s in _sides(room)
        if abs(s[2] - outer_faces[s[0], s[1]]) < CM / 2 and s[4] - s[3] > 1.6
    ]  # fmt: skip
    boxes: list[PlanBox] = []
    for k in rng.permutation(len(sides)):
        if len(boxes) == wanted:
            break
        axis, way, face, start, end = sides[k]
        width = snap(rng.uniform(0.8, min(1.5, end - start - 0.6)))
        at = snap(rng.uniform(start + 0.3, max(start + 0.3, end - 0.3 - width)))
        lo, hi = sorted((face, face - way * thick))
        rect = Rect(lo, at, hi, at + width) if axis == 0 else Rect(at, lo, at + width, hi)
        near = Rect(rect.x0 - 0.3, rect.y0 - 0.3, rect.x1 + 0.3, rect.y1 + 0.3)
        if not any(_overlap(near, f.rect) for f in fixtures):
            boxes.append(PlanBox((rect.x0, rect.y0, 0.9), (rect.x1, rect.y1, 2.05)))
    return boxes


def make_plan(cfg: BuildingConfig, rng: np.random.Generator, max_tries: int = 2000, parts: Parts | None = None) -> Plan:
    """Draws a plan.

    Args:
        parts: how large each room is against the others, the corridor's weight (if there is to be one) first, which
            does not count; default: as many as `cfg` says, about equal.

    Returns:
        A plan whose rooms are all joined by doorways.
    """
    for _ in range(max_tries):
        inside, rooms, walls, corridor = _layout(cfg, rng, parts)
        plain = [r for i, r in enumerate(rooms) if i != corridor]
        if min(min(r.size) for r in plain) < cfg.min_room_side_m or max(max(r.size) / min(r.size) for r in plain) > 2.3:
            continue
        door_height = snap(rng.uniform(2.06, 2.12))
        doorways = _doorways(rooms, walls, corridor, cfg, rng, door_height)
        if doorways is None:
            continue
        height = snap(rng.uniform(*cfg.wall_height_m))
        thick = snap(cfg.wall_thickness_m[1])
        outer = Rect(*(snap(v) for v in (inside.x0 - thick, inside.y0 - thick, inside.x1 + thick, inside.y1 + thick)))
        boxes = [b for w in walls for b in _wall_boxes(w.rect, w.axis, doorways, height)]
        boxes += [
            PlanBox((outer.x0, outer.y0, 0.0), (inside.x0, outer.y1, height)),
            PlanBox((inside.x1, outer.y0, 0.0), (outer.x1, outer.y1, height)),
            PlanBox((inside.x0, outer.y0, 0.0), (inside.x1, inside.y0, height)),
            PlanBox((inside.x0, inside.y1, 0.0), (inside.x1, outer.y1, height)),
        ]
        fixtures = _fixtures(rooms, doorways, cfg, rng)
        windows = _windows(inside, plain, fixtures, thick, cfg, rng)
        return Plan(
            tuple(rooms), outer, tuple(boxes), tuple(doorways), tuple(windows), tuple(fixtures), corridor,
            height, door_height,
        )  # fmt: skip
    raise GenerationError(
        f"no plan found in {max_tries} tries for {cfg.n_rooms} rooms on {cfg.floor_area_m2} m2: "
        "fewer rooms, more area or a smaller min_room_side_m would make it possible"
    )
