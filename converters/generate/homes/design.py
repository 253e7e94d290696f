"""Draw the plan of a home, furnish it, and move light pieces until the shares that must be pushed are in range."""

import dataclasses
import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from converters.generate.homes import furnish
from converters.generate.homes.arrange import TABLES, Arrangement, GroupMember, anchored, group_of, least_of
from converters.generate.homes.building import Building
from converters.generate.homes.config import SHARE_TOLERANCE, GenerationError, HomeConfig, Range
from converters.generate.homes.floor import CELL_M, Standing
from converters.generate.homes.opening import open_fronts
from converters.generate.homes.plans import home_plan
from converters.generate.homes.space import rooms_joined, static_grid
from converters.generate.models.cad import place
from converters.geometry.density import ROBOTS, Ways, must_push_shares
from interactive_nav_common.grids import clearance

MOST_MOVES = 250
"""Moves tried."""
MOST_IN_VAIN = 60
"""Moves in a row that bring nothing, after which a plan is given up."""
BEFORE_M = (0.15, 0.85)
"""From a doorway's middle to a piece that narrows it, along the way through."""
PASSAGE_M = (0.15, 0.60)
"""Clearance in the middle of what is taken for a passage."""
DOUBT_M = (-0.02, 0.08)
"""Radii this much smaller and larger are measured: a gap counts as barred where the smaller does not pass and as open
where the larger does. Maps come out a centimetre or two off, and planners on a grid of 5 cm keep 6 to 8 cm away."""
ROUND_M = 0.02
"""Between a piece put into a passage and what stands there."""
LEAST_GAIN = 1e-4
"""A move that brings less is none."""


class Shares(NamedTuple):
    """Hold shares of pairs between which a robot must push, for a disc a little smaller than it and one larger."""

    least: float
    most: float

    def miss(self, wanted: Range) -> float:
        """Return how far they lie from a range: gaps that are nearly as wide as the robot count for neither side."""
        return max(wanted[0] - self.least, self.most - wanted[1], 0.0)


class Passages:
    """Hold a home's floor as robots see it. Mutable, private to one search."""

    def __init__(self, home: furnish.Home):
        self.home = home
        static = home.floor.inside & ~home.floor.fixed
        self.ways = {
            robot: [Ways.of(static, CELL_M, disc.radius_m + more) for more in DOUBT_M] for robot, disc in ROBOTS.items()
        }
        self.shares, self.room_m = self.measured()
        self.bars: dict[int, bool] = {}
        """Id of a piece -> whether it bars a passage as the furniture stands; others were not looked at."""

    def measured(self) -> tuple[dict[str, Shares], dict[str, np.ndarray]]:
        """Return by robot the shares of pairs between which it must push, and the clearance (m), as furnished now."""
        room_m = {robot: clearance(self.home.floor.free(robot), CELL_M) for robot in self.ways}
        shares = {
            robot: Shares(*(way.must_push_share(room_m[robot]) for way in ways)) for robot, ways in self.ways.items()
        }
        return shares, room_m

    def nearer(self) -> tuple[dict[str, Shares], dict[str, np.ndarray]] | None:
        """Return what is `measured` now if it is nearer to the wanted ranges than before, else None."""
        shares, room_m = self.measured()
        return (shares, room_m) if self.miss(shares) < self.miss() - LEAST_GAIN else None

    def miss(self, shares: dict[str, Shares] | None = None) -> float:
        """Return how far shares (those measured last) lie from the wanted ranges, summed."""
        shares = shares or self.shares
        return sum(shares[robot].miss(wanted) for robot, wanted in self.home.cfg.must_push.items())

    def light(self) -> list[Standing]:
        """Return what can be moved: light pieces, but none that its group needs."""
        standing = self.home.floor.standing
        groups = Counter((s.group, s.room) for s in standing)
        return [
            s for s in standing if s.item.model.category in TABLES.light and groups[s.group, s.room] > least_of(s.group)
        ]

    def trial(self, change: Callable[[], bool]) -> bool:
        """Keep a change of what stands where if it brings the shares nearer to the wanted ranges; undo it otherwise."""
        floor, cfg = self.home.floor, self.home.cfg
        standing = list(floor.standing)
        if change() and floor.share > cfg.furniture_share - SHARE_TOLERANCE:
            measured = self.nearer()
            if measured is not None:
                (self.shares, self.room_m), self.bars = measured, {}
                return True
        gone, come = _changed(standing, floor.standing)
        for pieces, by in ((come, -1), (gone, 1)):
            for piece in pieces:
                floor.cover(piece, by)
        floor.standing = standing
        return False

    def narrowing(self, rng: np.random.Generator) -> tuple[np.ndarray, int] | None:
        """Return a random place in a passage, half of the time before a doorway, and its room."""
        floor, plan = self.home.floor, self.home.plan
        if rng.random() < 0.5:
            d = plan.doorways[rng.integers(len(plan.doorways))]
            side = int(rng.integers(2))
            xy = np.array(d.rect.centre)
            xy[d.axis] += (1 if side else -1) * (d.rect.size[d.axis] / 2 + rng.uniform(*BEFORE_M))
            xy[1 - d.axis] += rng.uniform(-0.5, 0.5)
            return xy, d.rooms[side]
        room_m = self.room_m[sorted(self.ways)[rng.integers(len(self.ways))]]
        # The ridge of the clearance: as far from what stands left as from what stands right.
        ridge = (room_m > PASSAGE_M[0]) & (room_m < PASSAGE_M[1]) & (floor.room >= 0)
        across = [np.maximum(*(np.roll(room_m, way, axis) for way in (1, -1))) for axis in (0, 1)]
        cells = np.argwhere(ridge & (room_m >= np.minimum(*across)))
        if not len(cells):
            return None
        row, column = cells[rng.integers(len(cells))]
        xy = floor.low + (np.array([column, row]) + 0.5) * CELL_M + rng.uniform(-0.1, 0.1, 2)
        return xy, int(floor.room[row, column])


def _changed(before: list[Standing], now: list[Standing]) -> tuple[list[Standing], list[Standing]]:
    """Return pieces that stood and no longer do, and those that did not and now do."""
    was, stands = {id(s) for s in before}, {id(s) for s in now}
    return [s for s in before if id(s) not in stands], [s for s in now if id(s) not in was]


def adjust(home: furnish.Home) -> dict[str, float]:
    """Move light pieces until the shares that must be pushed lie in the wanted ranges; return them by robot."""
    rng, passages = home.rng, Passages(home)
    wanted = home.cfg.must_push
    in_vain = 0
    for _ in range(MOST_MOVES):
        if passages.miss() < LEAST_GAIN or in_vain == MOST_IN_VAIN:
            break
        shares = passages.shares
        too_low = any(shares[robot].least < low for robot, (low, _) in wanted.items())
        too_high = any(shares[robot].most > high for robot, (_, high) in wanted.items())
        if too_low and (not too_high or rng.random() < 0.5):
            _narrow(home, passages)
        else:
            _clear(home, passages)
        in_vain = in_vain + 1 if passages.shares is shares else 0
    floor = home.floor
    measured = must_push_shares(floor.inside & ~floor.fixed, {robot: floor.free(robot) for robot in ROBOTS}, CELL_M)
    if passages.miss() < LEAST_GAIN and all(low <= measured[robot] <= high for robot, (low, high) in wanted.items()):
        return measured
    missed = [robot for robot in wanted if passages.shares[robot].miss(wanted[robot]) >= LEAST_GAIN] or list(wanted)
    got = ", ".join(
        f"must_push_{k} is {list(wanted[k])}, got {passages.shares[k].least:.3f} to {passages.shares[k].most:.3f}"
        for k in missed
    )
    raise GenerationError(
        f"{got} (for discs 2 cm smaller to 8 cm larger than the robot) after up to {MOST_MOVES} moves: "
        "ask for a wider range or another furniture_share"
    )


def _narrow(home: furnish.Home, passages: Passages) -> None:
    """Try one light piece in a passage."""
    rng, floor = home.rng, home.floor
    place_at = passages.narrowing(rng)
    if place_at is None:
        return
    xy, room = place_at
    kept = furnish.kinds(furnish.room_set(home, room)).intersection(TABLES.strewn)
    alone = [s for s in passages.light() if ":" not in s.group and s.item.model.category in kept]
    piece, category = None, furnish.clutter_category(home, room)
    if alone and (floor.share > home.cfg.furniture_share or rng.random() < 0.7):
        piece = alone[rng.integers(len(alone))]
        model, scale = piece.item.model, piece.item.scale
    elif category in TABLES.strewn and floor.share < home.cfg.furniture_share + SHARE_TOLERANCE / 2:
        model, scale = home.models.draw(category, rng)
    else:
        return
    item = place(model, scale, xy, float(rng.uniform(-math.pi, math.pi)))

    def change() -> bool:
        if piece is not None:
            floor.remove(piece)
        if not home.takes([model.category], room):
            return False
        window, shadow = floor.raster([item.footprint.buffer(ROUND_M)])
        free = floor.inside[window] & (floor.covered[window] == 0) & ~floor.swept[window]
        if not (free | ~shadow).all():
            return False
        floor.add(item, room, model.category)
        return True

    passages.trial(change)


def _clear(home: furnish.Home, passages: Passages) -> None:
    """Try to put one light piece that bars a passage to where its room, or another, has space for it."""
    rng, floor = home.rng, home.floor
    light = [piece for piece in passages.light() if passages.bars.get(id(piece), True)]
    if not light:
        return
    piece = light[rng.integers(len(light))]
    model = piece.item.model
    group = group_of(model.category)
    alone = Arrangement(group, (anchored(group, GroupMember(model, piece.item.scale, 0.0, 0.0, 0.0), rng),), None)
    rooms = [piece.room, *(int(k) for k in rng.permutation(len(home.plan.rooms))[:3])]

    def change() -> bool:
        floor.remove(piece)
        if id(piece) not in passages.bars:
            passages.bars[id(piece)] = passages.nearer() is not None
        if not passages.bars[id(piece)]:
            return False
        takes = (room for room in rooms if home.takes([model.category], room))
        any(furnish.settle(home, model.category, alone, room, home.narrow_m) for room in takes)
        return True

    passages.trial(change)


MOST_PLANS = 8
"""Plans furnished before giving up."""
MOST_FULL, LARGE_M2 = 2, 150.0
"""Of these, plans into which less fits than wanted: one is enough where it is so large, for each takes its time."""


def design_home(cfg: HomeConfig, rng: np.random.Generator) -> Building:
    """Draw and furnish a home, its shares as the configuration demands."""
    floor_height_m = round(float(rng.uniform(*cfg.floor_height_m)), 3)
    refused: GenerationError | None = None
    full = 0
    for _ in range(MOST_PLANS):
        plan, uses = home_plan(cfg, rng)
        try:
            home = furnish.furnish_home(plan, uses, cfg, rng)
            shares = adjust(home)
        except GenerationError as error:
            refused = error
            full += isinstance(error, furnish.Full)
            if full == (1 if sum(r.area_m2 for r in plan.rooms) > LARGE_M2 else MOST_FULL):
                break
            continue
        items = [s.item for s in home.floor.standing]
        plan = dataclasses.replace(plan, built_in=tuple(item for item in items if item.model.built_in))
        if not rooms_joined(static_grid(plan), plan, furnish.WIDE_M - 0.02):
            refused = GenerationError("built-in furniture bars a room: ask for more area or fewer rooms")
            continue
        movable = tuple(item for item in items if not item.model.built_in)
        try:
            built_in, fronts = open_fronts(plan, plan.built_in, movable, cfg.opening)
        except GenerationError as error:
            refused = error
            continue
        plan = dataclasses.replace(plan, built_in=built_in)
        must_push = {robot: round(share, 4) for robot, share in shares.items()}
        measured = {"furniture_share": round(home.floor.share, 4), "must_push_share": must_push}
        return Building(plan, (*movable, *fronts), floor_height_m, tuple(uses), measured)
    assert refused is not None
    raise refused
