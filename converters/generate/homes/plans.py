"""Draw the plan of a home: an outline, rooms with uses, doorways that suit the uses, a front door and windows.

Frame and units as in `converters.generate.design.plan`.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import networkx as nx
import numpy as np
import shapely

from converters.generate.design.config import BuildingConfig, GenerationError
from converters.generate.design.plan import (
    CM,
    DOORWAY_MARGIN_M,
    ENTRANCE_FREE_M,
    Doorway,
    Plan,
    PlanBox,
    Rect,
    Wall,
    cut,
    place_doorway,
    shared_wall,
    snap,
    split,
    wall_boxes,
)
from interactive_nav_common.records import read_packaged


@dataclasses.dataclass(frozen=True)
class RoomUse:
    """Describe rooms of one use."""

    weight: float
    """Area against that of the other rooms."""
    least_side_m: float
    """Least length of its shorter side, m, so that its furniture fits."""
    through: int = 0
    """How readily people walk through it to other rooms; 0: they do not."""
    window: bool = False
    """Whether it must have a window."""
    beside: tuple[str, ...] = ()
    """It lies next to one of these, where the home has one."""
    most: int = 1
    """Rooms of this use in one home."""
    extra: float = 0.0
    """How often it is one of the rooms beyond the first four, against the others."""


USES = read_packaged(Path(__file__).with_name("rooms.yaml"), dict[str, RoomUse])
"""Use -> what it is like. A corridor is a hall."""
FIRST = ("living", "bedroom", "bathroom", "kitchen")
LARGE_M2 = 90.0
"""Area above which a home has two bedrooms and two bathrooms, where it has rooms enough."""
ORDER = ("kitchen", "dining", "living", "office", "hall", "storage", "bathroom", "bedroom")
"""Uses as they follow one another through a home, so that neighbours lie next to each other."""
PLANS = 2
"""Plans drawn, of which the one is taken whose rooms suit their uses best."""
PROGRAMMES, LAYOUTS = 120, 60
"""Sets of uses tried until there are so many plans, and layouts for each."""
EVENER = 0.75
"""Power of the weights: rooms cut from one rectangle cannot differ as much as they should."""
SPREAD = 0.06
"""A cut is up to this share of the side away from where the weights have it."""
LONGEST = 2.3
"""Longer side of a room over its shorter one, at most; corridors excepted."""
FORBIDDEN = 100.0
"""Misfit of a plan in which a room cannot be reached as it should, or lacks the outer wall that it needs."""
ENTRANCE_M = (0.92, 2.04)
"""Width and height of the front door's leaf."""
WINDOW_M = 1.1
"""Least stretch of outer wall for a window."""
WING_DEPTH_M = (2.2, 5.5)
"""From the main part of the home to a wing's far end, inside."""
OUTLINES = (("rectangle", 0.4), ("L", 0.4), ("T", 0.2))
CORRIDORS = (("through", 0.3), ("end", 0.4), ("hall", 0.3))
"""Forms of the corridor and how often: from one outer wall to the other; from one to a room across the end; a hall
between two columns of rooms, with a room behind it."""


def _chosen(table: tuple[tuple[str, float], ...], rng: np.random.Generator) -> str:
    names, odds = zip(*table, strict=True)
    return names[rng.choice(len(names), p=np.array(odds) / sum(odds))]


def programme(n_rooms: int, rng: np.random.Generator, area_m2: float = 0.0) -> list[str]:
    """Draw the uses of so many rooms, corridor not counted, in the order in which they lie."""
    uses = [*FIRST, *(("bedroom", "bathroom") if area_m2 > LARGE_M2 else ())][:n_rooms]
    if n_rooms == 3 and rng.random() < 0.5:
        uses[2] = "kitchen"
    while len(uses) < n_rooms:
        left = [u for u, use in USES.items() if use.extra and uses.count(u) < use.most]
        odds = np.array([USES[u].extra / (1 + uses.count(u)) for u in left])
        uses.append(left[rng.choice(len(left), p=odds / odds.sum())] if left else "bedroom")
    uses.sort(key=ORDER.index)
    return uses[::-1] if rng.random() < 0.5 else uses


@dataclasses.dataclass(frozen=True)
class Layout:
    """Hold rooms and the walls between them."""

    rooms: list[Rect]
    """The corridor first, where there is one."""
    walls: list[Wall]
    corridor: int | None


class _Cutter:
    """Cut rectangles into rooms and gather the walls. Mutable, private to one layout."""

    def __init__(self, cfg: BuildingConfig, rng: np.random.Generator):
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
    steps = sorted((face, snap(face + (cut_m if way else -cut_m))))
    ends = (steps[1], snap(steps[1] + depth)) if way else (snap(steps[0] - depth), steps[0])
    wall = Rect.across(axis, *steps, start, snap(start + wide))
    return Rect.across(axis, *ends, start, snap(start + wide)), (axis, wall)


def lay_out(
    cfg: BuildingConfig, rng: np.random.Generator, weights: Sequence[float], area_m2: float, corridor: bool
) -> Layout | None:
    """Draw rooms of these weights, in the order in which they lie; return None where one is too narrow."""
    form = _chosen(OUTLINES, rng) if len(weights) > 3 else "rectangle"
    cutter, wing = _Cutter(cfg, rng), 0
    if form != "rectangle":
        wing = 1 if rng.random() < 0.6 else 2
    main_m2 = area_m2 * sum(weights[wing:]) / sum(weights)
    aspect = rng.uniform(1.0, 1.6)
    width, depth = snap(math.sqrt(main_m2 * aspect)), snap(math.sqrt(main_m2 / aspect))
    if rng.random() < 0.5:
        width, depth = depth, width
    x0, y0 = snap(-width / 2 + rng.uniform(-0.7, 0.7)), snap(-depth / 2 + rng.uniform(-0.7, 0.7))
    main = Rect(x0, y0, snap(x0 + width), snap(y0 + depth))
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


def outer_stretches(room: Rect, walls: Sequence[Wall]) -> Iterator[tuple[int, int, float, float, float]]:
    """Yield the stretches of a room's sides behind which no other room lies: axis, way inwards, face, start, end."""
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
                yield axis, way, face, at, low
            at = max(at, high)
        if at < end:
            yield axis, way, face, at, end


@dataclasses.dataclass(frozen=True)
class Relations:
    """Hold what decides which uses suit the rooms of a layout."""

    rooms: list[Rect]
    joined: np.ndarray
    """(n, n) bool: the two share a stretch of wall wide enough for a doorway."""
    outer_m: np.ndarray
    """(n,) longest stretch of outer wall."""


def _relations(layout: Layout, need_m: float) -> tuple[Relations, dict[tuple[int, int], Wall]]:
    """Return a layout's relations, and the wall of each pair of rooms (low side first) that a doorway may join."""
    n = len(layout.rooms)
    shared, joined = {}, np.zeros((n, n), bool)
    for i, j in itertools.permutations(range(n), 2):
        wall = shared_wall(layout.rooms[i], layout.rooms[j], layout.walls)
        if wall is not None and wall[1].size[1 - wall[0]] >= need_m:
            shared[i, j] = wall
            joined[i, j] = joined[j, i] = True
    outer = [max((s[4] - s[3] for s in outer_stretches(r, layout.walls)), default=0.0) for r in layout.rooms]
    return Relations(layout.rooms, joined, np.array(outer)), shared


def misfit(relations: Relations, uses: Sequence[str]) -> float:
    """Return how badly uses suit rooms, 0 being perfect; from `FORBIDDEN` on the plan is of no use.

    That counts areas off by a factor, sides too short, no neighbour of the right use, and rooms that people reach only
    through rooms that they should not walk through or that lack an outer wall for their window.
    """
    rooms, joined = relations.rooms, relations.joined
    total, weight = sum(r.area_m2 for r in rooms), sum(USES[u].weight for u in uses)
    through = np.array([USES[u].through > 0 for u in uses])
    cost = 0.0
    for k, (room, name) in enumerate(zip(rooms, uses, strict=True)):
        use = USES[name]
        if name != "hall":
            cost += math.log(room.area_m2 / total * weight / use.weight) ** 2
            cost += 4.0 * max(0.0, use.least_side_m - min(room.size))
        wanted = [j for j, other in enumerate(uses) if other in use.beside]
        cost += 0.6 * (bool(wanted) and not any(joined[k, j] for j in wanted))
        cost += FORBIDDEN * (use.window and relations.outer_m[k] < WINDOW_M)
        cost += FORBIDDEN * (not through[k] and not (joined[k] & through).any())
    public = nx.from_numpy_array(joined[np.ix_(through, through)])
    cost += FORBIDDEN * (len(public) == 0 or not nx.is_connected(public))
    enters = [k for k, name in enumerate(uses) if name in ("hall", "living")]
    cost += FORBIDDEN * all(relations.outer_m[k] < ENTRANCE_M[0] + 0.4 for k in enters)
    largest = max(range(len(rooms)), key=lambda k: rooms[k].area_m2)
    return cost + 3.0 * ("living" in uses and uses[largest] != "living")


def assign_uses(relations: Relations, corridor: int | None, wanted: list[str]) -> tuple[list[str], float]:
    """Return the use of each room, key of `USES`, and how badly they suit (see `misfit`)."""
    plain = [k for k in range(len(relations.rooms)) if k != corridor]
    uses = ["hall"] * len(relations.rooms)
    for k, use in zip(plain, wanted, strict=True):
        uses[k] = use
    best, better = misfit(relations, uses), True
    while better:  # ends: the misfit falls with each exchange, and there are finitely many orders
        better = False
        for i, j in itertools.combinations(plain, 2):
            changed = list(uses)
            changed[i], changed[j] = uses[j], uses[i]
            cost = misfit(relations, changed)
            if cost < best - 1e-9:
                uses, best, better = changed, cost, True
    return uses, best


def _joins(
    uses: Sequence[str], shared: dict[tuple[int, int], Wall], loops: float, rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Choose the pairs of rooms that doorways join: all rooms people walk through, and one of these to each other."""
    graph = nx.Graph()
    for i, j in shared:
        through = USES[uses[i]].through, USES[uses[j]].through
        if min(through) > 0:
            graph.add_edge(i, j, weight=rng.random() - max(through))
    chosen = [tuple(sorted(pair)) for pair in nx.minimum_spanning_edges(graph, data=False)]
    chosen += [pair for pair in map(tuple, map(sorted, graph.edges)) if pair not in chosen and rng.random() < loops]
    for k, use in enumerate(uses):
        if USES[use].through:
            continue
        doors = [pair for pair in shared if k in pair and USES[uses[sum(pair) - k]].through]
        likes = [USES[uses[sum(pair) - k]].through + rng.random() for pair in doors]
        chosen.append(tuple(sorted(doors[int(np.argmax(likes))])))
    return [pair for pair in shared if tuple(sorted(pair)) in chosen]


def _doorways(
    layout: Layout,
    uses: Sequence[str],
    shared: dict[tuple[int, int], Wall],
    cfg: BuildingConfig,
    rng: np.random.Generator,
) -> list[Doorway]:
    """Draw the doorways; those of rooms that people do not walk through are narrow enough for a leaf, in a corner."""
    height, out = snap(rng.uniform(2.06, 2.12)), []
    for pair in sorted(_joins(uses, shared, cfg.loop_probability, rng)):
        axis, rect = shared[pair]
        private = [k for k in pair if not USES[uses[k]].through]
        low, high = rect.span(1 - axis)
        width = rng.uniform(*cfg.doorway_width_m)
        if not private and rng.random() < 0.4:
            width += rng.uniform(0, cfg.archway_extra_m)
        at, width = place_doorway((low, high), snap(width), cfg, rng)
        if private:
            margin = min(cfg.corner_margin_m, (high - low - width) / 2)
            ends = layout.rooms[private[0]].span(1 - axis)
            corners = [abs(low - ends[0]) < CM, abs(high - ends[1]) < CM]
            at_high = corners[1] if corners[0] != corners[1] else bool(rng.random() < 0.5)
            at = snap(high - margin - width if at_high else low + margin)
        out.append(Doorway(pair, axis, Rect.across(axis, *rect.span(axis), at, at + width), height))
    return out


def _entrance(layout: Layout, uses: Sequence[str], thick: float, rng: np.random.Generator) -> Doorway | None:
    """Draw the front door in an outer wall of the hall or else of the living room."""
    half = ENTRANCE_M[0] / 2 + 0.12
    for wanted in ("hall", "living"):
        stretches = [
            (k, *s)
            for k, use in enumerate(uses)
            if use == wanted
            for s in outer_stretches(layout.rooms[k], layout.walls)
            if s[4] - s[3] > 2 * half and layout.rooms[k].size[s[0]] >= ENTRANCE_FREE_M
        ]
        if stretches:
            k, axis, way, face, start, end = stretches[rng.integers(len(stretches))]
            middle = snap(rng.uniform(start + half, end - half))
            span = sorted((face, snap(face - way * thick)))
            opening = Rect.across(axis, *span, snap(middle - ENTRANCE_M[0] / 2), snap(middle + ENTRANCE_M[0] / 2))
            return Doorway((k, k), axis, opening, ENTRANCE_M[1])
    return None


def _windows(
    layout: Layout,
    uses: Sequence[str],
    entrance: Doorway | None,
    thick: float,
    cfg: BuildingConfig,
    rng: np.random.Generator,
) -> list[PlanBox]:
    """Draw windows: one for each room that needs one, then others until there are as many as wanted."""
    wanted = int(rng.integers(cfg.n_windows[0], cfg.n_windows[1] + 1))
    places = []
    for k, room in enumerate(layout.rooms):
        for axis, way, face, start, end in outer_stretches(room, layout.walls):
            gaps = [(start, end)]
            if entrance is not None and entrance.rooms[0] == k and entrance.axis == axis:
                low, high = entrance.rect.span(1 - axis)
                on_it = any(abs(v - face) < CM / 2 for v in entrance.rect.span(axis))
                gaps = [(start, low - 0.25), (high + 0.25, end)] if on_it else gaps
            places += [(k, axis, way, face, *gap) for gap in gaps if gap[1] - gap[0] >= WINDOW_M]
    order = [places[i] for i in rng.permutation(len(places))]
    order.sort(key=lambda p: p[4] - p[5])
    first = {p[0]: p for p in reversed(order) if USES[uses[p[0]]].window}
    rest = [p for p in order if p not in first.values() and uses[p[0]] != "storage"]
    rest = [rest[i] for i in rng.permutation(len(rest))]
    boxes = []
    for k, axis, way, face, start, end in [*first.values(), *rest[: max(wanted - len(first), 0)]]:
        widest = {"living": 2.2, "bathroom": 0.8, "hall": 0.9}.get(uses[k], 1.5)
        width = snap(rng.uniform(0.6 if widest < 1 else 0.8, max(min(widest, end - start - 0.3), 0.81)))
        at = snap(rng.uniform(start + 0.15, max(start + 0.15, end - 0.15 - width)))
        deep = sorted((face, snap(face - way * thick)))
        low_m = {"bathroom": 1.35, "kitchen": 1.05}.get(uses[k], 0.9)
        boxes.append(PlanBox.over(Rect.across(axis, *deep, at, at + width), low_m, 2.05))
    return boxes


def _outer_walls(layout: Layout, thick: float) -> list[Rect]:
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


def _built(
    layout: Layout,
    uses: Sequence[str],
    shared: dict[tuple[int, int], Wall],
    cfg: BuildingConfig,
    rng: np.random.Generator,
) -> Plan | None:
    """Return the plan of a layout whose rooms have these uses; None where no outer wall takes the front door."""
    doorways = _doorways(layout, uses, shared, cfg, rng)
    height, thick = snap(rng.uniform(*cfg.wall_height_m)), snap(cfg.wall_thickness_m[1])
    entrance = _entrance(layout, uses, thick, rng)
    if entrance is None:
        return None
    around = _outer_walls(layout, thick)
    corners = np.array([dataclasses.astuple(r) for r in around])
    outer = Rect(*(float(v) for v in (*corners[:, :2].min(axis=0), *corners[:, 2:].max(axis=0))))
    boxes = [b for w in layout.walls for b in wall_boxes(w, doorways, height)]
    boxes += [PlanBox.over(rect, 0.0, height) for rect in around]
    windows = _windows(layout, uses, entrance, thick, cfg, rng)
    rooms, panes = tuple(layout.rooms), tuple(windows)
    return Plan(rooms, outer, tuple(boxes), tuple(doorways), panes, (), layout.corridor, height, entrance=entrance)


def home_plan(cfg: BuildingConfig, rng: np.random.Generator) -> tuple[Plan, list[str]]:
    """Draw the plan of a home, and the use of each of its rooms."""
    drawn: list[tuple[float, int, Layout, list[str], dict[tuple[int, int], Wall]]] = []
    need = cfg.doorway_width_m[1] + 2 * DOORWAY_MARGIN_M
    for k in range(PROGRAMMES):
        area_m2 = float(rng.uniform(*cfg.floor_area_m2))
        n = int(rng.integers(cfg.n_rooms[0], cfg.n_rooms[1] + 1))
        n = max(n, min(cfg.n_rooms[1], 7)) if area_m2 > LARGE_M2 else n
        corridor = n >= cfg.corridor_from_rooms
        wanted = programme(n - corridor, rng, area_m2)
        lying = [wanted[i] for i in rng.permutation(len(wanted))] if k % 2 else wanted
        weights = [USES[use].weight ** EVENER for use in lying]
        for _ in range(LAYOUTS):
            layout = lay_out(cfg, rng, weights, area_m2, corridor)
            if layout is None:
                continue
            relations, shared = _relations(layout, need)
            uses, cost = assign_uses(relations, layout.corridor, lying)
            if cost < FORBIDDEN:
                drawn.append((cost, k, layout, uses, shared))
                break
        if len(drawn) == PLANS:
            break
    for _, _, layout, uses, shared in sorted(drawn, key=lambda d: d[:2]):
        plan = _built(layout, uses, shared, cfg, rng)
        if plan is not None:
            return plan, uses
    raise GenerationError(
        f"no plan in {PROGRAMMES * LAYOUTS} tries for {cfg.n_rooms} rooms on {cfg.floor_area_m2} m2: "
        "fewer rooms, more area or a smaller min_room_side_m would make it possible"
    )
