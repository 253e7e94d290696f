"""Furnish a home's plan: what each room's use demands first, then more until it is full enough."""

import dataclasses
import functools
import itertools
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from converters.generate.homes import arrange
from converters.generate.homes.building import Plan, Rect
from converters.generate.homes.config import SHARE_TOLERANCE, GenerationError, HomeConfig
from converters.generate.homes.doors import hang_doors
from converters.generate.homes.floor import CELL_M, STRANDED_M2, Floor, Places
from converters.generate.models.cad import Models
from converters.geometry.density import ROBOTS

LOOKS = 8
"""Best places of a group to check for free paths before it is left out."""
REDRAWS = 3
"""Attempts at a group with other models before it is left out; rows get shorter too."""
FEWEST = 4
"""Most pieces to remove from a row."""
ALIKE, IN_ROWS = 2, ("counter", "door", "radiator")
"""Most copies of a model, except in these categories; a group contains several alike."""
BATHS = ("tub", "shower")
"""A home with a bathroom has one of these."""
MOST_BASES = 3
"""Attempts to furnish a plan's rooms with what each needs."""
NEEDS_FROM = 0.2
"""Share of the floor from which every room is furnished with what it needs; less may not suffice."""
PRIVATE = ("bathroom", "bedroom", "office")
"""Rooms that get doors first."""
MOST_ADDED = 500
"""Most attempts to add furniture to reach a share."""
CLUTTER_SHARE = 0.1
"""Share of additions that are small objects."""
WIDE_M = max(disc.radius_m for disc in ROBOTS.values()) + 0.02
"""Disc that furniture must let pass at first; afterwards, the disc of the settings."""


class Full(GenerationError):
    """Report that less furniture fits into a plan than is wanted."""


@dataclasses.dataclass
class Home:
    """Hold a home while it is furnished. Mutable, private to one attempt."""

    cfg: HomeConfig
    plan: Plan
    uses: list[str]
    floor: Floor
    models: Models
    rng: np.random.Generator

    @property
    def narrow_m(self) -> float:
        """Return the radius of the disc that gets to every room with the furniture as it stands."""
        return self.cfg.robot_radius_m + 0.02

    def fresh(self) -> Models:
        """Return the models, without those that stand in the home as often as people own the same object."""
        models = (s.item.model for s in self.floor.standing)
        often = Counter(m.name for m in models if m.category not in IN_ROWS)
        self.models.spent = {name for name, count in often.items() if count >= ALIKE}
        return self.models

    def count(self, group: str, room: int) -> int:
        """Return how many anchors of a group stand in a room."""
        return sum(s.group == group and s.room == room for s in self.floor.standing)

    def takes(self, categories: Sequence[str], room: int) -> bool:
        """Return whether a room may have such pieces, and neither it nor the home would have too many of a kind."""
        if not {c for c in categories if c in arrange.TABLES.strewn} <= kinds(room_set(self, room)):
            return False
        larger = max(self.floor.floor_cells * CELL_M**2 / arrange.PLENTY_M2, 1.0)
        for category, more in Counter(c for c in categories if c in arrange.TABLES.most).items():
            here = [s.room == room for s in self.floor.standing if s.item.model.category == category]
            in_room, in_home = arrange.TABLES.most[category]
            if sum(here) + more > in_room or len(here) + more > in_home * larger:
                return False
        return True

    def lacking(self) -> str:
        """Return the first room without what it needs, or the lack of a bath; empty where all is there."""
        for room, use in enumerate(self.uses):
            have = {s.item.model.category for s in self.floor.standing if s.room == room}
            without = [c for c in arrange.TABLES.rooms[use].needs if self.models.has(c) and c not in have]
            if without:
                return f"the {use} of {self.plan.rooms[room].area_m2:.1f} m2 has no place for: {', '.join(without)}"
        baths = [c for c in BATHS if self.models.has(c)]
        if baths and "bathroom" in self.uses and not any(s.item.model.category in baths for s in self.floor.standing):
            return f"no bathroom has a place for: {' or '.join(baths)}"
        return ""


def _preference(
    arrangement: arrange.Arrangement, places: Places, floor: Floor, room: int, rng: np.random.Generator
) -> np.ndarray:
    """Return (n,) how much a group likes each place."""
    liking = rng.uniform(0.0, 0.6, len(places.side))
    at, half = arrangement.group.at, arrangement.pieces[0].half_m[0]
    if at == "corner":
        return liking - 6.0 * np.minimum(places.ends.min(axis=1) - half, 0.5)
    if at == "window":
        before = floor.before_window(arrangement, places, room) > 0.7
        return np.where(before, liking + 2.0, -np.inf if arrangement.pieces[0].model.built_in else liking)
    if at == "free":
        return liking + 0.8 * np.minimum(places.ends.min(axis=1), 1.5)
    if at == "anywhere":  # most things lie near walls, some in the way
        return liking - (0.5 if rng.random() < 0.6 else 0.0) * places.ends.min(axis=1)
    # Flush with a corner, or well away from it: slits gather dust.
    slit = places.ends.min(axis=1) - half
    return liking - 0.5 * ((slit > 0.06) & (slit < 0.5))


def _on_floor(corners: tuple[float, float, float, float], origin: np.ndarray, side: int) -> Rect:
    """Return a rectangle u0, v0, u1, v1 of a group's frame, on the floor."""
    a, b = (arrange.on_floor(origin, side * math.pi / 2, *corner) for corner in (corners[:2], corners[2:]))
    (x0, y0), (x1, y1) = np.minimum(a, b), np.maximum(a, b)
    return Rect(x0, y0, x1, y1)


def settle(home: Home, name: str, arrangement: arrange.Arrangement, room: int, radius_m: float) -> bool:
    """Stand a group in the best place where it fits and the disc still gets round; return whether there is one."""
    floor, rng = home.floor, home.rng
    ranked = []
    # Models are not quite alike on both sides: what just fits under a table may touch it where all is mirrored.
    mirrored = arrangement.mirrored()
    loose = [arrange.stand(p, np.zeros(2), math.pi / 2) for p in mirrored.pieces if not p.model.built_in]
    both = all(arrange.apart(a, b) for a, b in itertools.combinations(loose, 2))
    for way in (arrangement, mirrored) if both else (arrangement,):
        places = floor.places(way, room, rng)
        fits = floor.fitting(way, room, places)
        needed = np.array([k == 0 or p.needed for k, p in enumerate(way.pieces)])
        possible = np.flatnonzero(fits[:, needed].all(axis=1))
        liking = _preference(way, places, floor, room, rng)[possible] + 0.7 * fits[possible].sum(axis=1)
        possible, liking = possible[liking > -np.inf], liking[liking > -np.inf]
        best = possible[np.argsort(-liking, kind="stable")[:LOOKS]]
        ranked += [(liking[possible == i][0], way, places.origin[i], int(places.side[i]), fits[i]) for i in best]
    ranked.sort(key=lambda r: -r[0])
    joined, stranded_m2 = floor.reach(room, radius_m) if ranked else (True, 0.0)
    for _, way, origin, side, fits in ranked[:LOOKS]:
        boxes = [_on_floor(p.corners_m, origin, side) for p, here in zip(way.pieces, fits, strict=True) if here]
        still, cut_off_m2 = floor.reach(room, radius_m, boxes)
        if (still or not joined) and cut_off_m2 <= stranded_m2 + STRANDED_M2:
            for k, piece in enumerate(way.pieces):
                if fits[k]:
                    group = name if k == 0 else f"{name}: {piece.model.category}"
                    floor.add(arrange.stand(piece, origin, side * math.pi / 2), room, group)
            if way.front is not None:
                floor.keep_front(_on_floor(way.front, origin, side))
            return True
    return False


def _few(home: Home, arrangement: arrange.Arrangement, room: int) -> arrange.Arrangement | None:
    """Return a group without the pieces that are too many of a kind; None where it needs one of them."""
    kept: list[arrange.GroupMember] = []
    for piece in arrangement.pieces:
        if home.takes([p.model.category for p in (*kept, piece)], room):
            kept.append(piece)
        elif piece.needed:
            return None
    return dataclasses.replace(arrangement, pieces=tuple(kept))


def try_group(home: Home, name: str, room: int, radius_m: float) -> bool:
    """Try several models of a group, and shorter rows, in a room; return whether one fits within all limits."""
    group = arrange.TABLES.groups.get(name)
    if not home.takes([group.anchor if group else name], room):
        return False
    rows = group is not None and any(s.relation == "next" for s in group.satellites)
    most = home.cfg.furniture_share + SHARE_TOLERANCE / 2
    for fewer in range(FEWEST + 1 if rows else REDRAWS if group else 1):
        arrangement = arrange.arrange(name, home.fresh(), home.rng, fewer if rows else 0)
        arrangement = arrangement and _few(home, arrangement, room)
        if arrangement is None:
            continue
        area_m2 = sum(p.size_m[0] * p.size_m[2] for p in arrangement.pieces)
        more = area_m2 / (home.floor.floor_cells * CELL_M**2)
        if home.floor.share + more <= most and settle(home, name, arrangement, room, radius_m):
            return True
    return False


def room_set(home: Home, room: int) -> arrange.RoomSet:
    """Return what a room has; the living room has the table where there is no dining room and the kitchen is small."""
    use = home.uses[room]
    chosen = arrange.TABLES.rooms[use]
    if use == "living" and "dining" not in home.uses:
        return dataclasses.replace(chosen, base=(chosen.base[0], ("dining table", 0.9), *chosen.base[1:]))
    if use == "living" and len(home.uses) <= 2:
        return dataclasses.replace(chosen, base=(("bed", 1.0), *chosen.base))
    return chosen


@functools.cache
def kinds(has: arrange.RoomSet) -> set[str]:
    """Return the categories of all furniture that a room may have."""
    groups = [arrange.TABLES.groups[name] for name, _ in (*has.base, *has.more)]
    pieces = {s.category for group in groups for s in group.satellites} | {group.anchor for group in groups}
    return pieces | {category for category, _ in has.clutter}


def stand_base(home: Home) -> None:
    """Stand what each room's use demands, the most important pieces of all rooms first."""
    rng = home.rng
    sets = [room_set(home, k) for k in range(len(home.uses))]
    for level in range(max(len(s.base) for s in sets)):
        for room in rng.permutation(len(sets)):
            if level < len(sets[room].base):
                name, share = sets[room].base[level]
                if rng.random() < share:
                    _ = try_group(home, name, int(room), WIDE_M) or try_group(home, name, int(room), home.narrow_m)
    for window in home.plan.windows:
        for room, rect in enumerate(home.plan.rooms):
            if home.uses[room] != "bathroom" and window.rect.overlaps(rect.grown(0.3, 0.3)):
                try_group(home, "radiator", room, home.narrow_m)


def stand_clutter(home: Home) -> None:
    """Put small objects about, so many for each ten square metres."""
    rng, cfg = home.rng, home.cfg
    areas = np.array([r.area_m2 for r in home.plan.rooms])
    count = int(round(rng.uniform(*cfg.clutter_per_10_m2) * areas.sum() / 10))
    for room in rng.choice(len(areas), size=count, p=areas / areas.sum()):
        _clutter(home, int(room))


def clutter_category(home: Home, room: int) -> str | None:
    """Draw a category of what lies about in a room; return None where there are no models of any."""
    models, table = home.fresh(), arrange.TABLES.rooms[home.uses[room]].clutter
    odds = [(c, w) for c, w in table if models.has(c) and home.takes([c], room)]
    if not odds:
        return None
    weights = np.array([w for _, w in odds])
    return odds[home.rng.choice(len(odds), p=weights / weights.sum())][0]


def _clutter(home: Home, room: int) -> bool:
    name = clutter_category(home, room)
    return name is not None and try_group(home, name, room, home.narrow_m)


def grow(home: Home) -> None:
    """Add furniture to the rooms that are emptiest for their use until the share is met."""
    rng, cfg, floor = home.rng, home.cfg, home.floor
    tired: set[tuple[int, str]] = set()
    radius_m = WIDE_M

    def fullness(room: int) -> float:
        return floor.room_share(room) / arrange.TABLES.rooms[home.uses[room]].appetite

    for _ in range(MOST_ADDED):
        if floor.share >= cfg.furniture_share - SHARE_TOLERANCE / 2:
            return
        for room in sorted(range(len(home.uses)), key=fullness):
            chosen = room_set(home, room)
            every = (*((g, 1.0) for g, _ in chosen.base), *chosen.more)
            every = [(g, w) for g, w in every if (room, g) not in tired]
            groups = [(g, w) for g, w in every if home.count(g, room) < arrange.TABLES.groups[g].most]
            more_clutter = (room, "clutter") not in tired
            if not groups and (radius_m == WIDE_M or not more_clutter):
                continue
            if not groups or (rng.random() < CLUTTER_SHARE and more_clutter):
                if not any(_clutter(home, room) for _ in range(4)):
                    tired.add((room, "clutter"))
                break
            weights = np.array([w for _, w in groups])
            name = groups[rng.choice(len(groups), p=weights / weights.sum())][0]
            if not try_group(home, name, room, radius_m):
                tired.add((room, name))
            break
        else:
            if radius_m < WIDE_M:
                break
            radius_m, tired = home.narrow_m, set()
    if abs(floor.share - cfg.furniture_share) > SHARE_TOLERANCE:
        least = min(range(len(home.uses)), key=fullness)
        without = ", ".join(sorted(name for room, name in tired if room == least)) or "anything"
        raise Full(
            f"furniture_share is {cfg.furniture_share}: nothing more fits at {floor.share:.2f} (the emptiest room, "
            f"{home.uses[least]} of {home.plan.rooms[least].area_m2:.1f} m2, at {floor.room_share(least):.2f}, "
            f"has no place for: {without}); ask for less, or for other rooms"
        )


def furnish_home(plan: Plan, uses: list[str], cfg: HomeConfig, rng: np.random.Generator) -> Home:
    """Furnish a plan, whose rooms have these uses."""
    lacking = ""
    for _ in range(MOST_BASES):
        private, bathrooms = ([k for k, use in enumerate(uses) if use in some] for some in (PRIVATE, ("bathroom",)))
        doors = hang_doors(plan, cfg, rng, private, bathrooms)
        if doors is None:
            raise GenerationError(
                f"n_doors is {cfg.n_doors}: too few doorways have a wall for a leaf to rest at, or a bathroom's "
                "door has no room to open; ask for more area or fewer rooms"
            )
        leaves, sweeps = doors
        models = Models(cfg.models, cfg.scale_jitter)
        home = Home(cfg, plan, uses, Floor(plan, sweeps), models, rng)
        for leaf, room in leaves:
            home.floor.add(leaf, room, "door")
        stand_base(home)
        lacking = home.lacking() if cfg.furniture_share >= NEEDS_FROM else ""
        if not lacking:
            stand_clutter(home)
            grow(home)
            return home
    raise GenerationError(f"{lacking}; ask for fewer rooms or more area")
