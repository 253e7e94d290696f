"""Which furniture stands in which room, in which groups and where: `groups.yaml`, read by what places it.

Facts of which furniture homes have in which rooms, whether it stands at walls, in corners or in the middle, in which
groups (chairs pushed 0.1 m under tables and turned by up to 27 degrees, sofas 2.2 m from the television's bench, lamps
beside armchairs), follow the databases of ProcTHOR (github.com/allenai/procthor, Apache-2.0).
"""

import dataclasses
from pathlib import Path

from interactive_nav_common.records import read_packaged


@dataclasses.dataclass(frozen=True)
class Satellite:
    """Furniture that stands where it does because of another piece of its group."""

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
    needed: bool = False
    """The group does not stand without it."""


@dataclasses.dataclass(frozen=True)
class Group:
    """An anchor and what belongs to it."""

    anchor: str
    at: str
    """`wall`: back to a wall; `corner`: that at a wall's end; `window`: that before a window, if there is one; `free`:
    square to the walls, away from them; `anywhere`: turned as it comes."""
    satellites: tuple[Satellite, ...] = ()
    front_m: float = 0.0
    """Depth of the floor before the anchor that stays free of other furniture, clutter excepted."""
    most: int = 1
    """Of these in one room."""


@dataclasses.dataclass(frozen=True)
class RoomSet:
    """What the rooms of one use have."""

    base: tuple[tuple[str, float], ...]
    """(group, share of the rooms that have it), in the order in which they are placed."""
    more: tuple[tuple[str, float], ...]
    """(group, weight) to add where more is asked for; groups of `base` that are not there are added too."""
    clutter: tuple[tuple[str, float], ...]
    """(category, weight) of what lies about."""
    appetite: float = 1.0
    """How much of its floor is covered, against the other rooms."""
    needs: tuple[str, ...] = ()
    """Categories without which it is no such room."""


@dataclasses.dataclass(frozen=True)
class Tables:
    """The file's."""

    groups: dict[str, Group]
    """Name -> group."""
    rooms: dict[str, RoomSet]
    """Use of a room -> what it has."""
    most: dict[str, tuple[int, int]]
    """Category -> most in one room and in a home of `PLENTY_M2`; more in a larger one. Of others, as `Group.most`
    says."""
    light: tuple[str, ...]
    """What a small robot can push: it may narrow a passage."""


TABLES: Tables = read_packaged(Path(__file__).with_suffix(".yaml"), Tables)
PLENTY_M2 = 110.0
LOW_M = 0.95
"""Furniture up to this height may stand before a window."""
