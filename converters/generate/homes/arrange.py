"""A group in, its pieces with models and poses against each other out.

Frame of a group: v points away from the wall behind the anchor (or to its front, where it has no wall), u to the right
of who looks along v; the anchor's middle has u = 0, the wall's face v = 0. A piece's turn is counter-clockwise seen
from above, 0 where it faces along v.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable

import numpy as np
import shapely

from converters.generate.design.instance import Instance, place
from converters.generate.homes.groups import TABLES, Group, Satellite
from converters.generate.models.cad import CadModel, Models
from scenes_mjcf.categories import CATEGORIES

WALL_GAP_M = (0.02, 0.06)
"""Between a wall and what stands at it; what is built in touches it."""
UNDER_STEP_M = 0.04
SEAT_M = 0.52
"""Of a table's side for each seat."""
TOUCH_M = 0.004
"""Parts this close are taken to touch: boxes that stand for them when physics runs are a little larger."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """One piece of furniture in its group's frame."""

    model: CadModel
    scale: np.ndarray
    u: float
    v: float
    turn_rad: float
    needed: bool = True
    """False: the group stands without it where it does not fit."""

    @functools.cached_property
    def size_m(self) -> tuple[float, float, float]:
        """Width, height, depth."""
        width, height, depth = 2 * self.model.half_extents * self.scale
        return float(width), float(height), float(depth)

    @functools.cached_property
    def half_m(self) -> tuple[float, float]:
        """Half extents along u and v, as it is turned."""
        c, s = abs(math.cos(self.turn_rad)), abs(math.sin(self.turn_rad))
        width, _, depth = self.size_m
        return (c * width + s * depth) / 2, (s * width + c * depth) / 2

    @property
    def corners_m(self) -> tuple[float, float, float, float]:
        """u0, v0, u1, v1 of the rectangle around it."""
        (hu, hv), u, v = self.half_m, self.u, self.v
        return u - hu, v - hv, u + hu, v + hv

    @property
    def built_in(self) -> bool:
        """It is part of the building."""
        return not CATEGORIES[self.model.category].is_object


@dataclasses.dataclass(frozen=True)
class Arrangement:
    """A group with models chosen."""

    group: Group
    pieces: tuple[Piece, ...]
    """The anchor first."""
    front: tuple[float, float, float, float] | None
    """u0, v0, u1, v1 of the floor that stays free."""

    def mirrored(self) -> Arrangement:
        """The same with left and right exchanged."""
        pieces = tuple(dataclasses.replace(p, u=-p.u, turn_rad=-p.turn_rad) for p in self.pieces)
        front = None if self.front is None else (-self.front[2], self.front[1], -self.front[0], self.front[3])
        return Arrangement(self.group, pieces, front)


def on_floor(origin: np.ndarray, facing_rad: float, u: float, v: float) -> np.ndarray:
    """(2,) place on the floor of a point of a group's frame."""
    c, s = math.cos(facing_rad), math.sin(facing_rad)
    return origin + np.array([s * u + c * v, -c * u + s * v])


def stand(piece: Piece, origin: np.ndarray, facing_rad: float) -> Instance:
    """A piece where it stands, its group's origin at (2,) `origin` of the floor and the v axis along `facing_rad`."""
    xy = on_floor(origin, facing_rad, piece.u, piece.v)
    return place(piece.model, piece.scale, xy, facing_rad + piece.turn_rad)


class Showroom(Models):
    """The CAD models that a home may use, as pieces of its groups. Mutable, private to one home."""

    def piece(self, category: str, rng: np.random.Generator) -> Piece:
        """A piece at the origin, facing along v."""
        model, scale = self.draw(category, rng)
        return Piece(model, scale, 0.0, 0.0, 0.0)

    def set_of(self, rng: np.random.Generator) -> Callable[[str], Piece]:
        """As `piece`, but each category of one model and size, as a table's chairs are; of boxes no two."""
        drawn: dict[str, Piece] = {}

        def piece(category: str) -> Piece:
            if category not in drawn or category == "box":
                drawn[category] = self.piece(category, rng)
            return drawn[category]

        return piece


def apart(a: Instance, b: Instance, gap_m: float = TOUCH_M) -> bool:
    """True where no part of one is nearer than a gap to a part of the other; a seat may be under a top."""
    if a.footprint.distance(b.footprint) >= gap_m:
        return True
    for p, q in itertools.product(_slabs(a), _slabs(b)):
        if p[1] < q[2] + gap_m and q[1] < p[2] + gap_m and p[0].distance(q[0]) < gap_m:
            return False
    return True


def _slabs(item: Instance) -> list[tuple[shapely.Geometry, float, float]]:
    """Outline, lowest and highest point of each part."""
    placed = [item.to_floor(part.vertices) for part in item.model.parts]
    return [(shapely.MultiPoint(p[:, :2]).convex_hull, p[:, 2].min(), p[:, 2].max()) for p in placed]


def _at(host: Piece, piece: Piece, right_m: float, ahead_m: float, turn_rad: float) -> Piece:
    """A piece so far to the right of and ahead of its host's middle, turned against it."""
    c, s = math.cos(host.turn_rad), math.sin(host.turn_rad)
    u, v = host.u + c * right_m - s * ahead_m, host.v + s * right_m + c * ahead_m
    return dataclasses.replace(piece, u=u, v=v, turn_rad=host.turn_rad + turn_rad)


def _pulled_out(host: Piece, others: list[Piece], poses: list[Piece]) -> Piece | None:
    """The first of several poses, the farthest under first, in which the parts leave each other alone."""
    placed = [stand(o, np.zeros(2), math.pi / 2) for o in (host, *others)]
    for pose in poses:
        item = stand(pose, np.zeros(2), math.pi / 2)
        if all(apart(item, other) for other in placed):
            return pose
    return None


def _facing(
    host: Piece, seat: Piece, side: int, slide_m: float, gap_m: float, turn_rad: float, others: list[Piece]
) -> Piece | None:
    """A piece at a side of its host (0 front, 1 left, 2 back, 3 right), facing it; as near as parts allow.

    `gap_m` is where it should be; under the host it is drawn out step by step until nothing touches.
    """
    width, _, depth = host.size_m
    reach = (depth if side % 2 == 0 else width) / 2 + seat.size_m[2] / 2
    gaps = np.arange(gap_m, max(gap_m, 0.25) + 1e-9, UNDER_STEP_M)
    away = side * math.pi / 2
    poses = []
    for gap in gaps:
        ahead, right = (reach + gap) * math.cos(away), -(reach + gap) * math.sin(away)
        right, ahead = right + slide_m * math.cos(away), ahead + slide_m * math.sin(away)
        poses.append(_at(host, seat, right, ahead, away + math.pi + turn_rad))
    return _pulled_out(host, others, poses)


def _seats(host: Piece, count: int, at_wall: bool, rng: np.random.Generator) -> list[tuple[int, float]]:
    """(side, slide along it) of seats round a table: long sides first, as many as fit beside each other."""
    width, _, depth = host.size_m
    places: list[tuple[int, float]] = []
    room = {side: max(1, int((width, depth)[side % 2] / SEAT_M)) for side in range(4)}
    order = (0, 2, 1, 3) if width >= depth else (1, 3, 0, 2)
    for side in (k for k in order if k != 2 or not at_wall):
        length = (width, depth)[side % 2]
        places += [(side, length * ((k + 0.5) / room[side] - 0.5)) for k in range(room[side])]
    left = list(places[: max(count, 2)])
    return [left[k] for k in rng.permutation(len(left))][:count]


def _satellites(
    satellite: Satellite,
    count: int,
    host: Piece,
    row: list[Piece],
    draw: Callable[[str], Piece],
    rng: np.random.Generator,
) -> list[Piece]:
    """The satellites of one kind, in the frame of the group."""

    def turned() -> float:
        return math.radians(rng.uniform(-satellite.turn_deg, satellite.turn_deg))

    out: list[Piece] = []
    sides = list(rng.permutation([1, -1]))
    seats = _seats(host, count, host.v > 0, rng) if satellite.relation == "around" else []
    for k in range(len(seats) or count):
        piece, gap = draw(satellite.category), float(rng.uniform(*satellite.gap_m))
        width, _, depth = piece.size_m
        if satellite.relation == "beside":
            sign = float(sides[k % 2])
            right = sign * ((host.size_m[0] + width) / 2 + gap)
            out.append(_at(host, piece, right, (depth - host.size_m[2]) / 2 + 0.01, turned()))
        elif satellite.relation == "next":
            last = (row + out)[-1]
            right = (last.size_m[0] + width) / 2 + gap
            out.append(_at(last, piece, right, (depth - last.size_m[2]) / 2, turned()))
        elif satellite.relation == "flank":
            found = _facing(host, piece, 1 if sides[k % 2] > 0 else 3, 0.0, gap, turned(), [])
            out += [found] if found else []
        else:
            side, slide = seats[k] if seats else (0, float(rng.normal(0, 0.04)) if gap < 0.2 else 0.0)
            found = _facing(host, piece, side, slide, gap, turned(), out)
            out += [found] if found else []
    return out


def _shorter(group: Group, fewer: int) -> tuple[Satellite, ...]:
    """The group's satellites without the last few of a row that are like the anchor or like another of the row."""
    left = list(group.satellites)
    for k in reversed(range(len(left))):
        like = [group.anchor, *(s.category for s in left[:k])]
        if fewer and left[k].relation == "next" and left[k].category in like:
            del left[k]
            fewer -= 1
    return tuple(left)


def arrange(name: str, show: Showroom, rng: np.random.Generator, fewer: int = 0) -> Arrangement | None:
    """Chooses models for a group and stands them against each other.

    Returns:
        The group; None where there is no model of its anchor.
    """
    group = TABLES.groups.get(name) or Group(name, "anywhere", most=99)
    if not show.has(group.anchor):
        return None
    draw = show.set_of(rng)
    anchor = draw(group.anchor)
    gap = 0.005 if anchor.built_in else float(rng.uniform(*WALL_GAP_M))
    turn = 0.0 if anchor.built_in else float(rng.normal(0, 0.012))
    turn = float(rng.uniform(-math.pi, math.pi)) if group.at == "anywhere" else turn
    anchor = dataclasses.replace(anchor, turn_rad=turn)
    if group.at in ("wall", "corner", "window"):
        anchor = dataclasses.replace(anchor, v=anchor.half_m[1] + gap)
    pieces, row = [anchor], [anchor]
    for satellite in _shorter(group, fewer):
        hosts = [p for p in pieces if p.model.category == (satellite.host or group.anchor)]
        count = int(rng.integers(satellite.count[0], satellite.count[1] + 1))
        if not (hosts and count and show.has(satellite.category) and rng.random() < satellite.share):
            continue
        made = _satellites(satellite, count, hosts[0], row, draw, rng)
        made = [dataclasses.replace(p, needed=satellite.needed) for p in made]
        pieces += made
        row += made if satellite.relation == "next" else []
    ahead = anchor.v + anchor.half_m[1]
    u0, u1 = min(p.u - p.half_m[0] for p in row), max(p.u + p.half_m[0] for p in row)
    return Arrangement(group, tuple(pieces), (u0, ahead, u1, ahead + group.front_m) if group.front_m else None)
