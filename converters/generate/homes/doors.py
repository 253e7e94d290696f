"""Hang open leaves into doorways (scan x, y; heights above the floor) so that their sweeps do not overlap."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from converters.generate.homes.building import Doorway, Plan, doorway_zone
from converters.generate.homes.config import HomeConfig
from converters.generate.models.cad import CadModel, Instance, Models, stand_at
from converters.records.raw import ScannedHinge

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

    The hinge is at the jamb, `proud_m` before the wall's face, in the room on the high side of the doorway's axis if
    `high_side`. The closed leaf lies inside the opening.
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


class _Leaves:
    """Hold the leaves hung so far. Mutable, private to one home."""

    def __init__(self, plan: Plan, cfg: HomeConfig, rng: np.random.Generator):
        self.plan, self.cfg, self.rng = plan, cfg, rng
        self.models = Models(cfg.models, cfg.scale_jitter)
        self.zones = [doorway_zone(d, 0.75).polygon for d in plan.doorways]
        self.hung: dict[int, tuple[Instance, int]] = {}
        """Doorway -> its leaf and the room that it opens into."""
        self.sweeps: list[shapely.Polygon] = []

    def hang(self, k: int, at_walls: bool) -> bool:
        """Try to hang a leaf into doorway k where its sweep meets nothing; return whether it hangs."""
        plan, d, cfg, rng = self.plan, self.plan.doorways[k], self.cfg, self.rng
        model, _ = self.models.draw("door", rng)
        for side, jamb in rng.permutation([(0, 0), (0, 1), (1, 0), (1, 1)]):
            room, ends = d.rooms[int(side)], (bool(side), bool(jamb))
            if at_walls and (room == plan.corridor or wall_behind_m(d, *ends, plan) > SIDE_WALL_M):
                continue
            opened = math.radians(rng.uniform(*cfg.door_open_deg))
            lift_m = rng.uniform(*DOOR_BOTTOM_M)
            leaf, sweep = door_leaf(d, model, *ends, opened, plan, lift_m, cfg.leaf_wall_gap_m, cfg.leaf_proud_m)
            taken = [item.footprint for item, _ in self.hung.values()] + self.sweeps
            taken_by_leaf = [zone for j, zone in enumerate(self.zones) if j != k] if at_walls else []
            if any(map(sweep.intersects, taken)) or any(map(leaf.footprint.intersects, taken_by_leaf)):
                continue
            self.sweeps.append(sweep)
            self.hung[k] = leaf, room
            return True
        return False


def hang_doors(
    plan: Plan, cfg: HomeConfig, rng: np.random.Generator, first: Sequence[int] = (), always: Sequence[int] = ()
) -> tuple[list[tuple[Instance, int]], list[shapely.Polygon]] | None:
    """Hang up to `cfg.n_doors` leaves; the rooms in `first` come first, those in `always` get all of theirs.

    Return each leaf with the room that it opens into, and the swept floor, or None if too few fit.
    """
    leaves = _Leaves(plan, cfg, rng)
    low, high = (min(n, len(plan.doorways)) for n in cfg.n_doors)
    needed = [k for k, doorway in enumerate(plan.doorways) if set(always) & set(doorway.rooms)][:high]
    for k in needed:
        if not (leaves.hang(k, cfg.leaves_at_walls) or leaves.hang(k, at_walls=False)):
            return None
    order = [int(k) for k in rng.permutation(len(plan.doorways))]
    for k in sorted(order, key=lambda k: not set(first) & set(plan.doorways[k].rooms)):
        if len(leaves.hung) < high and k not in leaves.hung and plan.doorways[k].width_m <= 1.1:
            leaves.hang(k, cfg.leaves_at_walls)
    return None if len(leaves.hung) < low else (list(leaves.hung.values()), leaves.sweeps)
