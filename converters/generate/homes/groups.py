"""Which furniture stands in which room, in which groups and where: tables, read by what places it.

Facts of which furniture homes have in which rooms, whether it stands at walls, in corners or in the middle, in which
groups (chairs pushed 0.1 m under tables and turned by up to 27 degrees, sofas 2.2 m from the television's bench, lamps
beside armchairs), follow the databases of ProcTHOR (github.com/allenai/procthor, Apache-2.0).
"""

from __future__ import annotations

import dataclasses


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


def _row(*categories: str) -> tuple[Satellite, ...]:
    return tuple(Satellite(c, "next", gap_m=(0.0, 0.01), turn_deg=0.0, needed=True) for c in categories)


_CHAIR_AT_DESK = Satellite("chair", "before", gap_m=(-0.14, 0.10), turn_deg=25, needed=True)
GROUPS: dict[str, Group] = {
    # To sleep.
    "bed": Group("bed", "wall", (
        Satellite("nightstand", "beside", (1, 2)),
        Satellite("bench", "before", gap_m=(0.05, 0.15), share=0.25),
    ), 0.45),
    "second bed": Group("bed", "corner", (Satellite("nightstand", "beside"),), 0.4),
    "wardrobe": Group("wardrobe", "wall", (), 0.5, most=2),
    "dresser": Group("dresser", "wall", (), 0.5, most=2),
    # To sit.
    "television": Group("tv_bench", "wall", (
        Satellite("sofa", "before", gap_m=(1.7, 2.5), turn_deg=1.5, needed=True),
        Satellite("coffee_table", "before", gap_m=(0.32, 0.45), host="sofa"),
        Satellite("armchair", "flank", (0, 2), (0.30, 0.45), 20, host="coffee_table"),
        Satellite("floor_lamp", "beside", gap_m=(0.05, 0.12), share=0.5, host="sofa"),
        Satellite("plant", "beside", gap_m=(0.05, 0.2), share=0.4),
    ), 1.5),
    "sofa": Group("sofa", "wall", (
        Satellite("coffee_table", "before", gap_m=(0.32, 0.45)),
        Satellite("armchair", "flank", (0, 1), (0.30, 0.45), 20, host="coffee_table"),
    )),
    "reading corner": Group("armchair", "corner", (
        Satellite("floor_lamp", "beside", gap_m=(0.05, 0.15), share=0.8),
    ), 0.3),
    "bench": Group("bench", "wall", (), 0.4),
    # To eat and cook.
    "dining table": Group("table", "free", (Satellite("chair", "around", (3, 6), (-0.16, 0.02), 15),)),
    "small table": Group("table", "wall", (Satellite("chair", "around", (2, 3), (-0.16, 0.02), 15),)),
    "kitchen row": Group("fridge", "corner", _row("counter", "sink", "counter", "stove", "counter"), 0.75),
    "sink row": Group("sink", "wall", _row("counter", "stove", "counter"), 0.6),
    "fridge": Group("fridge", "wall", (), 0.6),
    "sink": Group("sink", "wall", (), 0.6),
    "stove": Group("stove", "wall", (), 0.6),
    "counter": Group("counter", "wall", _row("counter"), 0.6, most=2),
    "counter alone": Group("counter", "wall", (), 0.6),
    # To work.
    "desk": Group("desk", "window", (_CHAIR_AT_DESK, Satellite("bin", "beside", gap_m=(0.04, 0.15), share=0.5))),
    "second desk": Group("desk", "wall", (_CHAIR_AT_DESK,)),
    # To wash.
    "tub": Group("tub", "corner", (), 0.45),
    "shower": Group("shower", "corner", (), 0.45),
    "toilet": Group("toilet", "wall", (Satellite("bin", "beside", gap_m=(0.08, 0.15), share=0.3),), 0.45),
    "washbasin": Group("washbasin", "wall", (), 0.5),
    "washer": Group("washer", "wall", (Satellite("laundry_basket", "beside", share=0.4),), 0.5, most=2),
    # To keep things.
    "bookcase": Group("bookcase", "wall", (), 0.4, most=3),
    "sideboard": Group("sideboard", "wall", (), 0.4, most=2),
    "shelf": Group("shelf", "wall", (), 0.5, most=4),
    "shoe rack": Group("shoe_rack", "wall", (), 0.3, most=2),
    # In corners and at walls.
    "plant": Group("plant", "corner", most=3),
    "lamp": Group("floor_lamp", "corner", most=2),
    "laundry": Group("laundry_basket", "corner"),
    "waste": Group("bin", "corner"),
    "stored boxes": Group("box", "corner", (
        Satellite("box", "next", (0, 2), gap_m=(0.02, 0.06), turn_deg=4),
    ), most=3),
    "stored suitcase": Group("suitcase", "wall", most=2),
    "chair aside": Group("chair", "wall", most=2),
    "radiator": Group("radiator", "window", most=4),
}  # fmt: skip
"""Name -> group."""

ROOM_SETS: dict[str, RoomSet] = {
    "living": RoomSet(
        (("television", 1.0), ("bookcase", 0.8), ("sideboard", 0.6), ("reading corner", 0.5), ("plant", 0.8),
         ("lamp", 0.4), ("desk", 0.2)),
        (("sofa", 1.0), ("bookcase", 2.0), ("sideboard", 1.5), ("reading corner", 1.5), ("plant", 1.5), ("lamp", 1.0),
         ("dresser", 0.7), ("small table", 0.7), ("desk", 0.5), ("stored boxes", 0.5), ("chair aside", 0.7)),
        (("box", 1.0), ("bag", 0.7), ("pouf", 1.5), ("stool", 0.5), ("cart", 0.4), ("plant", 0.5), ("suitcase", 0.2)),
        needs=("sofa", "tv_bench"),
    ),
    "dining": RoomSet(
        (("dining table", 1.0), ("sideboard", 0.9), ("plant", 0.6), ("bookcase", 0.3)),
        (("sideboard", 1.5), ("bookcase", 1.5), ("plant", 1.5), ("chair aside", 1.5), ("dresser", 0.7),
         ("reading corner", 0.7), ("bench", 0.5)),
        (("box", 1.0), ("bag", 0.7), ("cart", 1.0), ("stool", 0.7), ("plant", 0.7)),
    ),
    "kitchen": RoomSet(
        (("kitchen row", 1.0), ("sink row", 1.0), ("fridge", 1.0), ("sink", 1.0), ("stove", 1.0), ("counter", 0.6),
         ("small table", 0.8), ("waste", 0.9)),
        (("counter", 1.5), ("counter alone", 1.0), ("dining table", 1.0), ("small table", 1.0), ("shelf", 0.7),
         ("washer", 0.5), ("chair aside", 0.7), ("waste", 0.7), ("plant", 0.4)),
        (("bin", 1.0), ("bag", 1.0), ("box", 1.0), ("stool", 1.5), ("cart", 1.0)),
        needs=("fridge", "sink", "stove"),
    ),
    "bedroom": RoomSet(
        (("bed", 1.0), ("wardrobe", 0.9), ("dresser", 0.7), ("desk", 0.4), ("laundry", 0.4), ("plant", 0.3)),
        (("wardrobe", 1.5), ("dresser", 1.5), ("desk", 1.0), ("bookcase", 1.2), ("second bed", 0.8),
         ("reading corner", 1.0), ("shelf", 0.4), ("laundry", 1.0), ("plant", 0.7), ("lamp", 0.7),
         ("stored boxes", 0.7), ("bench", 0.4), ("chair aside", 0.8)),
        (("laundry_basket", 1.0), ("box", 1.0), ("bag", 1.0), ("suitcase", 1.0), ("drying_rack", 0.7), ("pouf", 0.8),
         ("stool", 0.3)),
        1.15,
        ("bed",),
    ),
    "bathroom": RoomSet(
        (("toilet", 1.0), ("washbasin", 1.0), ("tub", 0.6), ("shower", 0.5), ("washer", 0.5), ("laundry", 0.5)),
        (("shower", 1.0), ("washer", 1.0), ("shelf", 1.0), ("laundry", 1.0), ("waste", 1.0), ("washbasin", 0.3)),
        (("laundry_basket", 1.0), ("stool", 1.0), ("bin", 1.0), ("drying_rack", 0.5)),
        needs=("toilet", "washbasin"),
    ),
    "office": RoomSet(
        (("desk", 1.0), ("bookcase", 0.9), ("reading corner", 0.5), ("shelf", 0.3), ("waste", 0.5)),
        (("bookcase", 2.0), ("second desk", 1.2), ("sofa", 0.7), ("shelf", 1.0), ("dresser", 0.7),
         ("stored boxes", 1.0), ("plant", 1.0), ("lamp", 0.7), ("reading corner", 0.7),
         ("chair aside", 1.0)),
        (("box", 2.0), ("bag", 1.0), ("bin", 0.7), ("pouf", 0.5), ("cart", 0.4)),
        needs=("desk",),
    ),
    "hall": RoomSet(
        (("shoe rack", 0.9), ("bench", 0.3), ("dresser", 0.3), ("stored boxes", 0.3)),
        (("shoe rack", 1.5), ("sideboard", 0.6), ("plant", 1.0), ("stored boxes", 1.0), ("stored suitcase", 0.7),
         ("bookcase", 0.7), ("chair aside", 0.7)),
        (("box", 1.5), ("bag", 1.5), ("suitcase", 0.7), ("cart", 0.4), ("stool", 0.7)),
        0.45,
    ),
    "storage": RoomSet(
        (("shelf", 1.0), ("shelf", 0.8), ("stored boxes", 1.0), ("washer", 0.4), ("stored suitcase", 0.7)),
        (("shelf", 2.0), ("stored boxes", 2.0), ("stored suitcase", 1.0), ("washer", 0.7), ("wardrobe", 0.7)),
        (("box", 2.0), ("suitcase", 1.0), ("cart", 1.0), ("drying_rack", 1.0), ("laundry_basket", 0.7), ("bag", 1.0)),
        1.2,
    ),
}  # fmt: skip
"""Use of a room -> what it has. A home without a dining room may have its table in the living room."""
MOST: dict[str, tuple[int, int]] = {
    "bag": (2, 4), "box": (4, 8), "bin": (2, 4), "cart": (1, 2), "drying_rack": (1, 1), "laundry_basket": (1, 3),
    "plant": (3, 6), "pouf": (2, 3), "shoe_rack": (1, 2), "stool": (2, 3), "suitcase": (2, 3), "floor_lamp": (2, 4),
    "chair": (8, 14), "armchair": (3, 5), "sofa": (2, 3), "coffee_table": (2, 3), "table": (2, 3), "tv_bench": (1, 2),
    "fridge": (1, 1), "sink": (1, 1), "stove": (1, 1), "tub": (1, 2), "shower": (1, 2), "toilet": (1, 2),
    "washbasin": (2, 3), "washer": (1, 2),
}  # fmt: skip
"""Category -> most in one room and in a home of `PLENTY_M2`; more in a larger one. Of others, as `Group.most` says."""
PLENTY_M2 = 110.0

LIGHT = frozenset(
    ("chair", "stool", "pouf", "box", "bag", "bin", "plant", "laundry_basket", "suitcase", "cart", "drying_rack")
)
"""What a small robot can push: it may narrow a passage."""
LOW_M = 0.95
"""Furniture up to this height may stand before a window."""
