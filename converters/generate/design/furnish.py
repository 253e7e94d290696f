"""Furnish a floor plan: choose which CAD model stands where, how large it is and which way it faces.

Frame: scan x, y; heights above the floor. Footprints never overlap; doorways, the sweep of the door leaves
and enough floor to drive into every room stay free; some chairs narrow a doorway on purpose, so that pushing
one aside pays.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence

import numpy as np
import shapely

from converters.generate.design.config import BuildingConfig, GenerationError
from converters.generate.design.plan import Doorway, Plan, doorway_zone
from converters.generate.design.space import GRID_M, free_grid, passes, room_mask, rooms_joined, without
from converters.generate.models.cad import CadModel, Instance, Models, place, stand_at
from converters.records.raw import ScannedHinge
from interactive_nav_common.grids import clearance

DOOR_GAP_M = 0.02
"""Between leaf and jamb, each side."""
DOOR_BOTTOM_M = (0.006, 0.010)
"""Between leaf and floor."""
AJAR_RAD = math.radians(3.0)
"""A leaf stands at least this far from the end of its swing."""


def door_leaf(
    doorway: Doorway, model: CadModel, high_side: bool, high_jamb: bool, open_rad: float, plan: Plan, lift_m: float,
    wall_gap_m: float = 0.08, proud_m: float = 0.0,
) -> tuple[Instance, shapely.Polygon]:  # fmt: skip
    """Hang an open leaf into a doorway; return it, and the floor that it sweeps from closed to fully open.

    The hinge line is the leaf's edge at the jamb, `proud_m` before the wall's face on the side it opens to: into the
    room on the high side of the doorway's axis where `high_side`. Closed, the leaf lies inside the opening.
    """
    axis, along = doorway.axis, 1 - doorway.axis
    closed, into, hinge = np.zeros(2), np.zeros(2), np.empty(2)
    closed[along] = -1.0 if high_jamb else 1.0
    into[axis] = 1.0 if high_side else -1.0
    hinge[axis] = doorway.rect.span(axis)[int(high_side)]
    hinge[along] = doorway.rect.span(along)[int(high_jamb)] + closed[along] * DOOR_GAP_M
    hinge += proud_m * into
    # Opening turns `closed` towards `into`; the sign says which way round that is, from above.
    sign = float(np.sign(closed[0] * into[1] - closed[1] * into[0]))
    width, height = doorway.width_m - 2 * DOOR_GAP_M, doorway.height_m - 0.02 - lift_m
    extents = 2 * model.half_extents
    scale = np.array([width / extents[0], height / extents[1], model.unit_m])
    corner = plan.rooms[doorway.rooms[int(high_side)]].span(along)[int(high_jamb)]
    # The wall beside the hinge stops the leaf: behind it only the margin to the corner is left.
    behind_m = abs(corner - hinge[along]) - wall_gap_m
    most = math.pi / 2 + math.asin(min(max(behind_m, 0.0) / width, 0.5))
    open_rad = min(open_rad, most - AJAR_RAD)
    # The first part is the leaf itself: the bounding box has the handles in it.
    slab = model.parts[0].vertices[:, 2]
    face_z = float(float(slab.mean()) - sign * float(np.ptp(slab) / 2))
    origin = (float(model.bounds[0, 0]), float(model.bounds[0, 1]), face_z)
    swing = (-open_rad, most - open_rad) if sign > 0 else (-(most - open_rad), open_rad)
    closed_rad = math.atan2(closed[1], closed[0])
    joint = ScannedHinge(np.array(origin), np.array([0.0, 1.0, 0.0]), swing)
    leaf = stand_at(model, scale, closed_rad + sign * open_rad, np.array(origin), hinge, lift_m)
    angles = closed_rad + sign * np.linspace(0.0, most, 24)
    fan = hinge + (width + 0.04) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return dataclasses.replace(leaf, hinge=joint), shapely.Polygon([hinge, *fan]).buffer(0.03)


def wall_behind_m(doorway: Doorway, high_side: bool, high_jamb: bool, plan: Plan) -> float:
    """Return the distance from the jamb to the room's side wall behind the hinge."""
    along, end = 1 - doorway.axis, int(high_jamb)
    return abs(plan.rooms[doorway.rooms[int(high_side)]].span(along)[end] - doorway.rect.span(along)[end])


SIDE_WALL_M = 0.35
"""A side wall this close behind the hinge leaves no way through behind an open leaf."""


class Effort:
    """Count the work left in places tried: the same on every machine, where seconds are not."""

    def __init__(self, places: int = 30_000):
        self.places = places

    def spend(self, places: int) -> bool:
        """Take from what is left; return False where nothing is."""
        self.places -= places
        return self.places > 0


CHECK_PLACES = 25
"""A look at where a disc gets on the grid takes as long as trying so many places."""


class _Room:
    """Hold what is taken so far: mutable, private to one furnishing attempt."""

    def __init__(self, plan: Plan, cfg: BuildingConfig, effort: Effort):
        self.plan = plan
        self.effort = effort
        self.rooms = [room.polygon for room in plan.rooms]
        self.taken = [fixture.rect.polygon for fixture in plan.fixtures]
        self.zones = [doorway_zone(d, 0.75).polygon for d in plan.doorways]
        self.sweeps: list[shapely.Polygon] = []
        self.hung: set[int] = set()
        """Doorways with a leaf."""
        self.placed: list[Instance] = []
        self.room_of: list[int] = []
        self.models = Models(cfg.models, cfg.scale_jitter)

    def fits(self, item: Instance, room: int, gap_m: float = 0.06, zones: bool = True) -> bool:
        shape = item.footprint
        if not self.effort.spend(1) or not self.rooms[room].buffer(-0.03).contains(shape):
            return False
        if _meets(shape.buffer(gap_m), self.taken) or _meets(shape, self.sweeps):
            return False
        return not (zones and _meets(shape, self.zones))

    def add(self, item: Instance, room: int) -> None:
        self.placed.append(item)
        self.room_of.append(room)
        self.taken.append(item.footprint)


def _meets(shape: shapely.Polygon, others: Iterable[shapely.Polygon]) -> bool:
    return any(shape.intersects(other) for other in others)


def _against_wall(
    state: _Room, room: int, model: CadModel, scale: np.ndarray, rng: np.random.Generator
) -> Instance | None:
    """Try places with the back to a wall."""
    r = state.plan.rooms[room]
    width, depth = 2 * model.half_extents[0] * scale[0], 2 * model.half_extents[2] * scale[2]
    for _ in range(60):
        side = int(rng.integers(4))
        facing = side * math.pi / 2  # into the room: +x, +y, -x, -y
        off = depth / 2 + rng.uniform(0.04, 0.10)
        along = rng.uniform(width / 2 + 0.05, max(r.size[1 - side % 2] - width / 2 - 0.05, width / 2 + 0.06))
        xy = np.array([r.x0 + along, r.y0 + along])
        xy[side % 2] = (r.x0 + off, r.y0 + off, r.x1 - off, r.y1 - off)[side]
        item = place(model, scale, xy, facing + rng.normal(0, 0.02))
        if state.fits(item, room):
            return item
    return None


def _in_the_open(
    state: _Room, room: int, model: CadModel, scale: np.ndarray, rng: np.random.Generator
) -> Instance | None:
    """Try places anywhere in a room, mostly square to its walls."""
    r = state.plan.rooms[room]
    for _ in range(80):
        xy = np.array([rng.uniform(r.x0, r.x1), rng.uniform(r.y0, r.y1)])
        facing = rng.integers(4) * math.pi / 2 + rng.normal(0, 0.06)
        item = place(model, scale, xy, facing)
        if state.fits(item, room, gap_m=0.25):
            return item
    return None


def _seat_at(
    state: _Room, host: Instance, room: int, model: CadModel, scale: np.ndarray, rng: np.random.Generator
) -> Instance | None:
    """Try places for a chair before a table or desk, facing it; at a desk only on its front."""
    depth = 2 * model.half_extents[2] * scale[2]
    half = host.model.half_extents * host.scale
    centre = host.to_floor(host.model.center[None])[0, :2]
    front = host.yaw_rad - math.pi / 2 + (math.pi if host.model.front < 0 else 0.0)
    turns = [0.0] if host.model.category == "desk" else list(rng.permutation(4) * math.pi / 2)
    for _ in range(6):
        for turn in turns:
            away = front + turn
            deep, wide = half[[2, 0]] if round(turn / (math.pi / 2)) % 2 == 0 else half[[0, 2]]
            reach = deep + depth / 2 + rng.uniform(0.07, 0.16)
            slide = rng.uniform(-0.25 * wide, 0.25 * wide)
            xy = centre + reach * np.array([math.cos(away), math.sin(away)])
            xy += slide * np.array([-math.sin(away), math.cos(away)])
            item = place(model, scale, xy, away + math.pi + rng.normal(0, 0.12))
            if state.fits(item, room, gap_m=0.04):
                return item
    return None


def _narrow(
    state: _Room, cfg: BuildingConfig, gap_m: tuple[float, float], rng: np.random.Generator, used: set[int], local: bool
) -> Instance | None:
    """Try to put a chair before a doorway so that the passage narrows to the wanted gap."""
    plan = state.plan
    low, high = gap_m
    before = free_grid(plan, state.placed)
    for k in rng.permutation(len(plan.doorways)):
        d = plan.doorways[k]
        masks = [room_mask(before, plan.rooms[i]) for i in d.rooms]
        here = masks[0] | masks[1] | room_mask(before, d.rect) if local else np.ones_like(before)
        if not state.effort.spend(CHECK_PLACES):
            return None
        if int(k) in used or not passes(clearance(before & here, GRID_M), masks, max(high, 2 * cfg.robot_radius_m)):
            continue
        model, scale = state.models.draw("chair", rng, cfg.passage_chairs)
        for _ in range(25):
            side = int(rng.integers(2))
            xy = np.array(d.rect.centre)
            half = d.rect.size[d.axis] / 2
            xy[d.axis] += (1 if side else -1) * (half + rng.uniform(0.3, 0.75))
            xy[1 - d.axis] += rng.uniform(-0.6, 0.6)
            item = place(model, scale, xy, rng.uniform(-math.pi, math.pi))
            if not state.fits(item, d.rooms[side], zones=False):
                continue
            state.effort.spend(CHECK_PLACES)
            room_m = clearance(without(before, [item]) & here, GRID_M)
            if passes(room_m, masks, low) and not passes(room_m, masks, high):
                used.add(int(k))
                state.add(item, d.rooms[side])
                return item
    return None


def _hang_leaf(state: _Room, k: int, cfg: BuildingConfig, rng: np.random.Generator) -> Instance | None:
    """Try to hang a leaf into doorway k where its sweep meets nothing."""
    plan, d = state.plan, state.plan.doorways[k]
    model, _ = state.models.draw("door", rng)
    for side, jamb in rng.permutation([(0, 0), (0, 1), (1, 0), (1, 1)]):
        room = d.rooms[int(side)]
        if cfg.leaves_at_walls and (
            room == plan.corridor or wall_behind_m(d, bool(side), bool(jamb), plan) > SIDE_WALL_M
        ):
            continue
        opened = math.radians(rng.uniform(*cfg.door_open_deg))
        lift_m = rng.uniform(*DOOR_BOTTOM_M)
        gaps_m = cfg.leaf_wall_gap_m, cfg.leaf_proud_m
        leaf, sweep = door_leaf(d, model, bool(side), bool(jamb), opened, plan, lift_m, *gaps_m)
        if _meets(sweep, (*state.taken, *state.sweeps)):
            continue
        if cfg.leaves_at_walls and _meets(leaf.footprint, (z for j, z in enumerate(state.zones) if j != k)):
            continue
        state.sweeps.append(sweep)
        state.hung.add(k)
        state.add(leaf, room)
        return leaf
    return None


def _hang_leaves(
    state: _Room, count: int, cfg: BuildingConfig, rng: np.random.Generator, first: Sequence[int] = ()
) -> bool:
    """Hang leaves into doorways, those of rooms `first` before others; return False where fewer than `count` fit."""
    order = rng.permutation(len(state.plan.doorways))
    for k in sorted(order, key=lambda k: not set(first) & set(state.plan.doorways[k].rooms)):
        if len(state.placed) == count:
            break
        if k not in state.hung and state.plan.doorways[k].width_m <= 1.1:
            _hang_leaf(state, int(k), cfg, rng)
    return len(state.placed) == count


def hang_doors(
    plan: Plan, cfg: BuildingConfig, rng: np.random.Generator, first: Sequence[int] = (), always: Sequence[int] = ()
) -> tuple[list[tuple[Instance, int]], list[shapely.Polygon]] | None:
    """Hang as many leaves as a plan has doorways for, up to `cfg.n_doors`; doorways of the rooms `first` come first.

    Doorways of the rooms `always` all get one, at a side wall or not. Return each leaf with the room that it opens
    into, and the floor that they sweep; None where too few fit.
    """
    state = _Room(plan, cfg, Effort())
    state.models = Models(cfg.models, cfg.scale_jitter, home=True)
    low, high = (min(n, len(plan.doorways)) for n in cfg.n_doors)
    needed = [k for k, doorway in enumerate(plan.doorways) if set(always) & set(doorway.rooms)][:high]
    anywhere = dataclasses.replace(cfg, leaves_at_walls=False)
    for k in needed:
        if not (_hang_leaf(state, k, cfg, rng) or _hang_leaf(state, k, anywhere, rng)):
            return None
    if not _hang_leaves(state, high, cfg, rng, first) and len(state.placed) < low:
        return None
    return list(zip(state.placed, state.room_of, strict=True)), state.sweeps


def _attempt(
    plan: Plan, cfg: BuildingConfig, rng: np.random.Generator, effort: Effort
) -> tuple[list[Instance], list[Instance]] | None:
    """Try once; return all furniture, and the blockers among it."""
    state = _Room(plan, cfg, effort)
    ranges = {c: getattr(cfg, f"n_{c}s") for c in ("chair", "table", "desk", "sofa", "door")}
    count = {c: int(rng.integers(low, high + 1)) for c, (low, high) in ranges.items()}
    if not _hang_leaves(state, count["door"], cfg, rng):
        return None
    roomy = [i for i in range(len(plan.rooms)) if i != plan.corridor]
    hosts: list[tuple[Instance, int]] = []
    for category in ("sofa", "desk", "table"):
        for _ in range(count[category]):
            model, scale = state.models.draw(category, rng)
            # Large pieces go first to large rooms that are still empty.
            score = {
                i: plan.rooms[i].area_m2 * rng.uniform(0.6, 1.4) / (1 + 1.5 * state.room_of.count(i)) for i in roomy
            }
            for room in sorted(roomy, key=lambda i: -score[i]):
                find = _in_the_open if category == "table" and rng.random() < 0.7 else _against_wall
                item = find(state, room, model, scale, rng)
                if item is not None:
                    state.add(item, room)
                    if category != "sofa":
                        hosts.append((item, room))
                    break
            else:
                return None
    used: set[int] = set()
    for _ in range(cfg.n_bottlenecks):
        if _narrow(state, cfg, cfg.bottleneck_gap_m, rng, used, local=False) is None:
            return None
    blockers = [_narrow(state, cfg, cfg.blocker_gap_m, rng, used, local=True) for _ in range(cfg.n_blockers)]
    if any(b is None for b in blockers):
        return None
    desks_first = sorted(hosts, key=lambda h: h[0].model.category)
    for n in range(count["chair"] - cfg.n_bottlenecks - cfg.n_blockers):
        model, scale = state.models.draw("chair", rng)
        item, room = None, 0
        if hosts:
            for host, room in [desks_first[(n + i) % len(hosts)] for i in range(len(hosts))]:
                item = _seat_at(state, host, room, model, scale, rng)
                if item is not None:
                    break
        for _ in range(6):
            if item is not None:
                break
            room = int(rng.choice(roomy))
            item = _in_the_open(state, room, model, scale, rng)
        if item is None:
            return None
        state.add(item, room)
    return state.placed, [b for b in blockers if b is not None]


def furnish_plan(
    plan: Plan, cfg: BuildingConfig, rng: np.random.Generator, effort: Effort, max_tries: int = 10
) -> list[Instance] | None:
    """Place doors, sofas, desks, tables and chairs; return None where this plan cannot take them."""
    for _ in range(max_tries):
        placed = _attempt(plan, cfg, rng, effort)
        if effort.places <= 0:
            return None
        if placed is None:
            continue
        items, blockers = placed
        blocking = {id(b) for b in blockers}
        standing = [i for i in items if id(i) not in blocking]
        if rooms_joined(free_grid(plan, standing), plan, cfg.robot_radius_m + 0.02):
            return items
    return None


def no_place(cfg: BuildingConfig, seed: int) -> GenerationError:
    """Return the error for a building that cannot take its furniture."""
    return GenerationError(
        f"seed {seed}: no way to furnish {cfg.n_rooms} rooms on {cfg.floor_area_m2} m2 with up to "
        f"{cfg.n_chairs[1]} chairs, {cfg.n_tables[1]} tables, {cfg.n_desks[1]} desks, {cfg.n_sofas[1]} "
        f"sofas and {cfg.n_doors[1]} doors: ask for fewer, or for more area"
    )
