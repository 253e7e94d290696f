"""Draw a home's outline, rooms with uses, doorways, front door and windows (units as in `building`)."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import networkx as nx
import numpy as np

from converters.generate.homes.building import (
    CM,
    DOORWAY_MARGIN_M,
    ENTRANCE_FREE_M,
    Doorway,
    Plan,
    PlanBox,
    Rect,
    Wall,
    place_doorway,
    shared_wall,
    snap,
    wall_boxes,
)
from converters.generate.homes.config import GenerationError, HomeConfig
from converters.generate.homes.layouts import Layout, Stretch, lay_out, outer_stretches, outer_walls
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
FORBIDDEN = 100.0
"""Misfit of a plan in which a room cannot be reached as it should, or lacks the outer wall that it needs."""
ENTRANCE_M = (0.92, 2.04)
"""Width and height of the front door's leaf."""
WIDEST_M = {"living": 2.2, "bathroom": 0.8, "hall": 0.9}
"""Use -> width of its widest windows; of others 1.5 m."""
SILL_M = {"bathroom": 1.35, "kitchen": 1.05}
"""Use -> height of its window sills; of others 0.9 m."""
WINDOW_M = 1.1
"""Least stretch of outer wall for a window."""


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
    outer = [max((s.length_m for s in outer_stretches(r, layout.walls)), default=0.0) for r in layout.rooms]
    return Relations(layout.rooms, joined, np.array(outer)), shared


def misfit(relations: Relations, uses: Sequence[str]) -> float:
    """Return how badly uses suit rooms (area, sides, neighbours, access, windows): 0 is best, `FORBIDDEN` unusable."""
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
    layout: Layout, uses: Sequence[str], shared: dict[tuple[int, int], Wall], cfg: HomeConfig, rng: np.random.Generator
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
            (k, s)
            for k, use in enumerate(uses)
            if use == wanted
            for s in outer_stretches(layout.rooms[k], layout.walls)
            if s.length_m > 2 * half and layout.rooms[k].size[s.axis] >= ENTRANCE_FREE_M
        ]
        if stretches:
            k, stretch = stretches[rng.integers(len(stretches))]
            middle = snap(rng.uniform(stretch.start + half, stretch.end - half))
            ends = snap(middle - ENTRANCE_M[0] / 2), snap(middle + ENTRANCE_M[0] / 2)
            return Doorway((k, k), stretch.axis, stretch.opening(*ends, thick), ENTRANCE_M[1])
    return None


def _windows(
    layout: Layout,
    uses: Sequence[str],
    entrance: Doorway | None,
    thick: float,
    cfg: HomeConfig,
    rng: np.random.Generator,
) -> list[PlanBox]:
    """Draw windows: one for each room that needs one, then others until there are as many as wanted."""
    wanted = int(rng.integers(cfg.n_windows[0], cfg.n_windows[1] + 1))
    places: list[tuple[int, Stretch]] = []
    for k, room in enumerate(layout.rooms):
        for stretch in outer_stretches(room, layout.walls):
            gaps = [stretch]
            if entrance is not None and entrance.rooms[0] == k and entrance.axis == stretch.axis:
                low, high = entrance.rect.span(1 - stretch.axis)
                if any(abs(v - stretch.face) < CM / 2 for v in entrance.rect.span(stretch.axis)):
                    gaps = [stretch._replace(end=low - 0.25), stretch._replace(start=high + 0.25)]
            places += [(k, gap) for gap in gaps if gap.length_m >= WINDOW_M]
    order = [places[i] for i in rng.permutation(len(places))]
    order.sort(key=lambda p: -p[1].length_m)
    first = {k: stretch for k, stretch in reversed(order) if USES[uses[k]].window}
    rest = [(k, s) for k, s in order if first.get(k) != s and uses[k] != "storage"]
    rest = [rest[i] for i in rng.permutation(len(rest))]
    chosen: list[tuple[int, Stretch]] = [*first.items(), *rest[: max(wanted - len(first), 0)]]
    boxes = []
    for k, s in chosen:
        widest = WIDEST_M.get(uses[k], 1.5)
        width = snap(rng.uniform(0.6 if widest < 1 else 0.8, max(min(widest, s.length_m - 0.3), 0.81)))
        at = snap(rng.uniform(s.start + 0.15, max(s.start + 0.15, s.end - 0.15 - width)))
        boxes.append(PlanBox.over(s.opening(at, at + width, thick), SILL_M.get(uses[k], 0.9), 2.05))
    return boxes


def _built(
    layout: Layout, uses: Sequence[str], shared: dict[tuple[int, int], Wall], cfg: HomeConfig, rng: np.random.Generator
) -> Plan | None:
    """Return the plan of a layout whose rooms have these uses; None where no outer wall takes the front door."""
    doorways = _doorways(layout, uses, shared, cfg, rng)
    height, thick = snap(rng.uniform(*cfg.wall_height_m)), snap(cfg.wall_thickness_m[1])
    entrance = _entrance(layout, uses, thick, rng)
    if entrance is None:
        return None
    around = outer_walls(layout, thick)
    corners = np.array([dataclasses.astuple(r) for r in around])
    (x0, y0), (x1, y1) = corners[:, :2].min(axis=0).tolist(), corners[:, 2:].max(axis=0).tolist()
    boxes = [b for w in layout.walls for b in wall_boxes(w, doorways, height)]
    boxes += [PlanBox.over(rect, 0.0, height) for rect in around]
    windows = _windows(layout, uses, entrance, thick, cfg, rng)
    rooms, panes = tuple(layout.rooms), tuple(windows)
    outer = Rect(x0, y0, x1, y1)
    return Plan(rooms, outer, tuple(boxes), tuple(doorways), panes, layout.corridor, height, entrance=entrance)


def home_plan(cfg: HomeConfig, rng: np.random.Generator) -> tuple[Plan, list[str]]:
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
