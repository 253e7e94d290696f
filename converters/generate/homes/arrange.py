"""Choose models for a group of furniture and arrange them by the tables of `groups.yaml`.

Frame of a group: v points away from the wall behind the anchor (or to its front, if it has no wall), u to the right
when looking along v; the anchor's middle has u = 0, the wall's face v = 0. A piece's turn is counter-clockwise from
above, 0 if it faces along v. Rooms, places and groups follow the databases of ProcTHOR (github.com/allenai/procthor,
Apache-2.0).
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from converters.generate.models.cad import CadModel, Instance, Models, place
from interactive_nav_common.records import read_packaged


@dataclasses.dataclass(frozen=True)
class Satellite:
    """Describe furniture that stands where it does because of another piece of its group."""

    category: str
    relation: str
    """`beside`: back in line with the host's; `before`: in front of it, facing it; `around`: along its sides, facing
    it; `flank`: at its left and right, facing it; `next`: in a row with the piece before it, facing as it does."""
    count: tuple[int, int] = (1, 1)
    gap_m: tuple[float, float] = (0.03, 0.08)
    """From edge to edge; negative: pushed under the host, as far as their parts leave each other alone."""
    turn_deg: float = 3.0
    """Turned by up to this from where it should face."""
    share: float = 1.0
    """Of the groups that have it."""
    host: str = ""
    """Category of the piece that it belongs to; empty: the anchor."""
    least: int = 0
    """The group does not stand without so many."""
    role: str = ""
    """Of the models that it is one of, see `Drawing.role`."""


@dataclasses.dataclass(frozen=True)
class Group:
    """Describe an anchor and what belongs to it."""

    anchor: str
    at: str
    """`wall`: back to a wall; `corner`: that at a wall's end; `window`: that before a window, if there is one; `free`:
    square to the walls, away from them; `anywhere`: turned as it comes."""
    satellites: tuple[Satellite, ...] = ()
    front_m: float = 0.0
    """Depth of the floor before the anchor that stays free of other furniture, clutter excepted."""
    most: int = 1
    """Of these in one room."""
    role: str = ""
    """Of the anchor."""


@dataclasses.dataclass(frozen=True)
class RoomSet:
    """List what the rooms of one use have."""

    base: tuple[tuple[str, float], ...]
    """(group, share of the rooms that have it), in the order in which they are placed."""
    more: tuple[tuple[str, float], ...]
    """(group, weight) to add where more is wanted; groups of `base` that are not there are added too."""
    clutter: tuple[tuple[str, float], ...]
    """(category, weight) of what lies about."""
    appetite: float = 1.0
    """How much of its floor is covered, against the other rooms."""
    needs: tuple[str, ...] = ()
    """Categories without which it is no such room."""


@dataclasses.dataclass(frozen=True)
class Tables:
    """Hold the tables of `groups.yaml`."""

    groups: dict[str, Group]
    """Name -> group."""
    rooms: dict[str, RoomSet]
    """Use of a room -> what it has."""
    most: dict[str, tuple[int, int]]
    """Category -> most in one room and in a home of `PLENTY_M2`, more in a larger one; else `Group.most` applies."""
    light: tuple[str, ...]
    """Categories that a small robot can push."""
    strewn: tuple[str, ...]
    """Light categories that people leave in passages; the search moves the others only out of them."""


TABLES: Tables = read_packaged(Path(__file__).with_name("groups.yaml"), Tables)
PLENTY_M2 = 110.0


def least_of(standing: str) -> int:
    """Return how many pieces of a kind a group needs, by what `Standing.group` says of them."""
    name, _, category = standing.partition(": ")
    satellites = TABLES.groups[name].satellites if category else ()
    return sum(s.least for s in satellites if s.category == category)


LOW_M = 0.95
"""Furniture up to this height may stand before a window."""


WALL_GAP_M = (0.02, 0.06)
"""Between a wall and what stands at it; what is built in touches it."""
UNDER_STEP_M = 0.04
SEAT_M = 0.52
"""Of a table's side for each seat."""
TOUCH_M = 0.004
"""Parts this close are taken to touch: boxes that stand for them when physics runs are a little larger."""


@dataclasses.dataclass(frozen=True)
class GroupMember:
    """Describe one piece of furniture in its group's frame."""

    model: CadModel
    scale: np.ndarray
    u: float
    v: float
    turn_rad: float
    needed: bool = True
    """False: the group stands without it where it does not fit."""

    @functools.cached_property
    def size_m(self) -> tuple[float, float, float]:
        """Return width, height and depth."""
        width, height, depth = 2 * self.model.half_extents * self.scale
        return float(width), float(height), float(depth)

    @functools.cached_property
    def half_m(self) -> tuple[float, float]:
        """Return half extents along u and v, as it is turned."""
        c, s = abs(math.cos(self.turn_rad)), abs(math.sin(self.turn_rad))
        width, _, depth = self.size_m
        return (c * width + s * depth) / 2, (s * width + c * depth) / 2

    @property
    def corners_m(self) -> tuple[float, float, float, float]:
        """Return u0, v0, u1, v1 of the rectangle around it."""
        (hu, hv), u, v = self.half_m, self.u, self.v
        return u - hu, v - hv, u + hu, v + hv


@dataclasses.dataclass(frozen=True)
class Arrangement:
    """Hold a group with models chosen."""

    group: Group
    pieces: tuple[GroupMember, ...]
    """The anchor first."""
    front: tuple[float, float, float, float] | None
    """u0, v0, u1, v1 of the floor that stays free."""

    def mirrored(self) -> "Arrangement":
        """Return the same with left and right exchanged."""
        pieces = tuple(dataclasses.replace(p, u=-p.u, turn_rad=-p.turn_rad) for p in self.pieces)
        front = None if self.front is None else (-self.front[2], self.front[1], -self.front[0], self.front[3])
        return Arrangement(self.group, pieces, front)


def on_floor(origin: np.ndarray, facing_rad: float, u: float, v: float) -> np.ndarray:
    """Return the (2,) place on the floor of a point of a group's frame."""
    c, s = math.cos(facing_rad), math.sin(facing_rad)
    return origin + np.array([s * u + c * v, -c * u + s * v])


def stand(piece: GroupMember, origin: np.ndarray, facing_rad: float) -> Instance:
    """Return a piece where it stands, its group's origin at (2,) `origin` and the v axis along `facing_rad`."""
    xy = on_floor(origin, facing_rad, piece.u, piece.v)
    return place(piece.model, piece.scale, xy, facing_rad + piece.turn_rad)


def draw_set(models: Models, rng: np.random.Generator) -> Callable[..., GroupMember]:
    """Return a function that draws a piece of a category and role at the origin, facing along v.

    Pieces of one category share a model and size, except boxes, which all differ.
    """
    drawn: dict[str, GroupMember] = {}

    def piece(category: str, role: str = "") -> GroupMember:
        if category not in drawn or category == "box":
            drawn[category] = GroupMember(*models.draw(category, rng, role=role), 0.0, 0.0, 0.0)
        return drawn[category]

    return piece


def apart(a: Instance, b: Instance, gap_m: float = TOUCH_M) -> bool:
    """Return whether no part of one is nearer than a gap to a part of the other; a seat may be under a top."""
    if a.footprint.distance(b.footprint) >= gap_m:
        return True
    return not any(
        p[1] < q[2] + gap_m and q[1] < p[2] + gap_m and p[0].distance(q[0]) < gap_m
        for p, q in itertools.product(a.slabs, b.slabs)
    )


def _at(host: GroupMember, piece: GroupMember, right_m: float, ahead_m: float, turn_rad: float) -> GroupMember:
    """Return a piece so far to the right of and ahead of its host's middle, turned against it."""
    c, s = math.cos(host.turn_rad), math.sin(host.turn_rad)
    u, v = host.u + c * right_m - s * ahead_m, host.v + s * right_m + c * ahead_m
    return dataclasses.replace(piece, u=u, v=v, turn_rad=host.turn_rad + turn_rad)


def _facing(
    host: GroupMember,
    seat: GroupMember,
    side: int,
    slide_m: float,
    gap_m: float,
    turn_rad: float,
    others: list[GroupMember],
) -> GroupMember | None:
    """Return a piece that faces a side of its host (0 front, 1 left, 2 back, 3 right), `gap_m` away or little more."""
    width, _, depth = host.size_m
    reach = (depth if side % 2 == 0 else width) / 2 + seat.size_m[2] / 2
    away = side * math.pi / 2
    placed = [stand(o, np.zeros(2), math.pi / 2) for o in (host, *others)]
    for gap in np.arange(gap_m, max(gap_m, 0.25) + 1e-9, UNDER_STEP_M):
        ahead, right = (reach + gap) * math.cos(away), -(reach + gap) * math.sin(away)
        right, ahead = right + slide_m * math.cos(away), ahead + slide_m * math.sin(away)
        pose = _at(host, seat, right, ahead, away + math.pi + turn_rad)
        item = stand(pose, np.zeros(2), math.pi / 2)
        if all(apart(item, other) for other in placed):
            return pose
    return None


def _seats(host: GroupMember, count: int, at_wall: bool) -> list[tuple[int, float]]:
    """Return (side, offset along it) of up to this many seats, spread evenly: long sides first, then the ends.

    A table at a wall has its ends first.
    """
    width, _, depth = host.size_m
    order = [(1, 3), (0,)] if at_wall else [(0, 2), (1, 3)] if width >= depth else [(1, 3), (0, 2)]
    places = [
        side for pair in order for _ in range(max(1, int((width, depth)[pair[0] % 2] / SEAT_M))) for side in pair
    ][:count]
    sides = {side: places.count(side) for side in places}
    return [
        (side, (width, depth)[side % 2] * ((places[:k].count(side) + 0.5) / sides[side] - 0.5))
        for k, side in enumerate(places)
    ]


def _satellites(
    satellite: Satellite, count: int, host: GroupMember, row: list[GroupMember], draw: Callable[..., GroupMember],
    rng: np.random.Generator,
) -> list[GroupMember]:  # fmt: skip
    """Return the satellites of one kind, in the frame of the group."""

    def turned() -> float:
        return math.radians(rng.uniform(-satellite.turn_deg, satellite.turn_deg))

    out: list[GroupMember] = []
    sides = list(rng.permutation([1, -1]))
    seats = _seats(host, count, host.v > 0) if satellite.relation == "around" else []
    for k in range(len(seats) or count):
        piece, gap = draw(satellite.category, satellite.role), float(rng.uniform(*satellite.gap_m))
        width, _, depth = piece.size_m
        if satellite.relation == "beside":
            sign = float(sides[k % 2])
            right = sign * ((host.size_m[0] + width) / 2 + gap)
            out.append(_at(host, piece, right, (depth - host.size_m[2]) / 2 + 0.01, turned()))
        elif satellite.relation == "next":
            last = (row + out)[-1]
            right = (last.size_m[0] + width) / 2 + gap
            out.append(_at(last, piece, right, (depth - last.size_m[2]) / 2, turned()))
        else:
            if satellite.relation == "flank":
                side, slide, turn, near = 1 if sides[k % 2] > 0 else 3, 0.0, turned(), []
            else:
                side, slide = seats[k] if seats else (0, float(rng.normal(0, 0.04)) if gap < 0.2 else 0.0)
                turn, near = turned(), out
            pose = _facing(host, piece, side, slide, gap, turn, near)
            out += [pose] if pose else []
    return out


def _shorter(group: Group, fewer: int) -> tuple[Satellite, ...]:
    """Return the group's satellites without the last few of a row that are like the anchor or another of the row."""
    left = list(group.satellites)
    for k in reversed(range(len(left))):
        like = [group.anchor, *(s.category for s in left[:k])]
        if fewer and left[k].relation == "next" and left[k].category in like:
            del left[k]
            fewer -= 1
    return tuple(left)


def group_of(name: str) -> Group:
    """Return a group of the tables, or one of a single piece that stands anywhere."""
    return TABLES.groups.get(name) or Group(name, "anywhere", most=99)


def anchored(group: Group, piece: GroupMember, rng: np.random.Generator) -> GroupMember:
    """Return a piece as its group's anchor: turned, and away from the wall behind it by a small gap."""
    gap = 0.005 if piece.model.built_in else float(rng.uniform(*WALL_GAP_M))
    turn = 0.0 if piece.model.built_in else float(rng.normal(0, 0.012))
    turn = float(rng.uniform(-math.pi, math.pi)) if group.at == "anywhere" else turn
    piece = dataclasses.replace(piece, turn_rad=turn)
    return dataclasses.replace(piece, v=piece.half_m[1] + gap) if group.at in ("wall", "corner", "window") else piece


def arrange(name: str, models: Models, rng: np.random.Generator, fewer: int = 0) -> Arrangement | None:
    """Choose and arrange models for a group; return None if the anchor has no model or too few pieces fit."""
    group = group_of(name)
    if not models.has(group.anchor, group.role):
        return None
    draw = draw_set(models, rng)
    anchor = anchored(group, draw(group.anchor, group.role), rng)
    pieces, row = [anchor], [anchor]
    for satellite in _shorter(group, fewer):
        hosts = [p for p in pieces if p.model.category == (satellite.host or group.anchor)]
        count = int(rng.integers(satellite.count[0], satellite.count[1] + 1))
        if not (hosts and count and models.has(satellite.category, satellite.role) and rng.random() < satellite.share):
            continue
        new = _satellites(satellite, count, hosts[0], row, draw, rng)
        if len(new) < satellite.least:
            return None
        new = [dataclasses.replace(p, needed=k < satellite.least) for k, p in enumerate(new)]
        pieces += new
        row += new if satellite.relation == "next" else []
    ahead = anchor.v + anchor.half_m[1]
    u0, u1 = min(p.u - p.half_m[0] for p in row), max(p.u + p.half_m[0] for p in row)
    return Arrangement(group, tuple(pieces), (u0, ahead, u1, ahead + group.front_m) if group.front_m else None)
