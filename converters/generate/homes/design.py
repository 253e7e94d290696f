"""Choose what each room of a plan is used for, and furnish the home; return it with its measures."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np

from converters.generate.design.config import BuildingConfig, GenerationError
from converters.generate.design.plan import Building, Plan, Rect, make_plan
from converters.generate.design.space import rooms_joined, static_grid
from converters.generate.homes.config import HomeConfig
from converters.generate.homes.furnish import WIDE_M, Full, furnish_home
from converters.generate.homes.passages import adjust
from interactive_nav_common.records import read_packaged


@dataclasses.dataclass(frozen=True)
class RoomUse:
    """Describe rooms of one use."""

    weight: float
    """Area against that of the other rooms."""
    least_side_m: float
    """Least length of its shorter side, m, so that its furniture fits."""
    beside: tuple[str, ...] = ()
    """It lies next to one of these, where the home has one."""
    most: int = 1
    """Rooms of this use in one home."""
    extra: float = 0.0
    """How often it is one of the rooms beyond the first four, against the others."""


USES = read_packaged(Path(__file__).with_name("rooms.yaml"), dict[str, RoomUse])
"""Use -> what it is like. A corridor is a hall."""
FIRST = ("living", "bedroom", "bathroom", "kitchen")
ORDER = ("kitchen", "dining", "living", "office", "hall", "storage", "bathroom", "bedroom")
"""Uses as they follow one another through a home, so that neighbours lie next to each other."""
PLANS = 6
"""Plans drawn, of which the one is taken whose rooms suit their uses best."""
PROGRAMMES, LAYOUTS = 40, 150
"""Sets of uses tried until there are so many, and layouts for each."""
EVENER = 0.75
"""Power of the weights: rooms cut from one rectangle cannot differ as much as they should."""


def programme(n_rooms: int, rng: np.random.Generator) -> list[str]:
    """Draw the uses of so many rooms, corridor not counted, in the order in which they lie."""
    uses: list[str] = list(FIRST[:n_rooms])
    if n_rooms == 3 and rng.random() < 0.5:
        uses[2] = "kitchen"
    while len(uses) < n_rooms:
        left = [u for u, use in USES.items() if use.extra and uses.count(u) < use.most]
        odds = np.array([USES[u].extra / (1 + uses.count(u)) for u in left])
        uses.append(left[rng.choice(len(left), p=odds / odds.sum())] if left else "bedroom")
    uses.sort(key=ORDER.index)
    return uses[::-1] if rng.random() < 0.5 else uses


def touching(a: Rect, b: Rect) -> bool:
    """Return whether two rooms share a stretch of wall wide enough for a doorway."""
    gap_x, gap_y = max(a.x0 - b.x1, b.x0 - a.x1), max(a.y0 - b.y1, b.y0 - a.y1)
    return (gap_x < 0.3 and gap_y < -0.8) or (gap_y < 0.3 and gap_x < -0.8)


def _misfit(rooms: list[Rect], uses: list[str], near: np.ndarray) -> float:
    """Return how badly uses suit rooms: areas off by a factor, sides too short, no neighbour of the right use."""
    total, weight = sum(r.area_m2 for r in rooms), sum(USES[u].weight for u in uses)
    cost = 0.0
    for k, (room, name) in enumerate(zip(rooms, uses, strict=True)):
        use = USES[name]
        cost += math.log(room.area_m2 / total * weight / use.weight) ** 2
        cost += 4.0 * max(0.0, use.least_side_m - min(room.size))
        wanted = [j for j, other in enumerate(uses) if other in use.beside]
        cost += 0.6 * (bool(wanted) and not any(near[k, j] for j in wanted))
    largest = max(range(len(rooms)), key=lambda k: rooms[k].area_m2)
    return cost + 3.0 * ("living" in uses and uses[largest] != "living")


def assign_uses(plan: Plan, wanted: list[str]) -> tuple[list[str], float]:
    """Return the use of each room of a plan, key of `USES`, and how badly they suit, 0 being perfect."""
    plain = [k for k in range(len(plan.rooms)) if k != plan.corridor]
    rooms, uses = [plan.rooms[k] for k in plain], list(wanted)
    near = np.array([[touching(a, b) for b in rooms] for a in rooms])
    best = _misfit(rooms, uses, near)
    better = True
    while better:  # ends: the misfit falls with each exchange, and there are finitely many orders
        better = False
        for i, j in itertools.combinations(range(len(uses)), 2):
            changed = list(uses)
            changed[i], changed[j] = uses[j], uses[i]
            cost = _misfit(rooms, changed, near)
            if cost < best - 1e-9:
                uses, best, better = changed, cost, True
    use_of = dict(zip(plain, uses, strict=True))
    return [use_of.get(k, "hall") for k in range(len(plan.rooms))], best


def home_plan(cfg: BuildingConfig, rng: np.random.Generator) -> tuple[Plan, list[str]]:
    """Draw the plan of a home, and the use of each of its rooms."""
    drawn, refused = [], None
    for k in range(PROGRAMMES):
        n = int(rng.integers(cfg.n_rooms[0], cfg.n_rooms[1] + 1))
        corridor = n >= cfg.corridor_from_rooms
        wanted = programme(n - corridor, rng)
        lying = [wanted[i] for i in rng.permutation(len(wanted))] if k % 2 else wanted
        weights = (*([1.0] * corridor), *(USES[use].weight ** EVENER for use in lying))
        try:
            plan = make_plan(cfg, rng, LAYOUTS, weights, 0.06)
        except GenerationError as error:
            refused = error
            continue
        uses, misfit = assign_uses(plan, lying)
        drawn.append((misfit, k, plan, uses))
        if len(drawn) == PLANS:
            break
    if not drawn:
        assert refused is not None
        raise refused
    _, _, plan, uses = min(drawn, key=lambda f: f[:2])
    return plan, uses


MOST_PLANS = 8
"""Plans furnished before giving up."""
MOST_FULL, LARGE_M2 = 2, 150.0
"""Of these, plans into which less fits than wanted: one is enough where it is so large, for each takes its time."""


def design_home(cfg: HomeConfig, rng: np.random.Generator) -> Building:
    """Draw and furnish a home, its shares as the configuration demands."""
    floor_height_m = round(float(rng.uniform(*cfg.shell.floor_height_m)), 3)
    refused: GenerationError | None = None
    full = 0
    for _ in range(MOST_PLANS):
        plan, uses = home_plan(cfg.shell, rng)
        try:
            home = furnish_home(plan, uses, cfg, rng)
            shares = adjust(home)
        except GenerationError as error:
            refused = error
            full += isinstance(error, Full)
            if full == (1 if sum(r.area_m2 for r in plan.rooms) > LARGE_M2 else MOST_FULL):
                break
            continue
        items = [s.item for s in home.floor.standing]
        plan = dataclasses.replace(plan, built_in=tuple(item for item in items if item.model.built_in))
        if not rooms_joined(static_grid(plan), plan, WIDE_M - 0.02):
            refused = GenerationError("built-in furniture bars a room: ask for more area or fewer rooms")
            continue
        movable = tuple(item for item in items if not item.model.built_in)
        must_push = {robot: round(share, 4) for robot, share in shares.items()}
        measured = {"furniture_share": round(home.floor.share, 4), "must_push_share": must_push}
        return Building(plan, movable, floor_height_m, tuple(uses), measured)
    assert refused is not None
    raise refused
