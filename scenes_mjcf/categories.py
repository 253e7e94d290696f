"""What is known of each category of things, in one table: a name in, its record out.

Whatever another module must know of every category (a class of a mask, a colour, a material, a library's key) is a
field here, so that a new category is one new row and no two places differ.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Literal

from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError

Rgb = tuple[float, float, float]
Range = tuple[float, float]
MaskClasses = Literal[4, 5, "all"]
"""How masks tell things apart: 4 or 5 classes of furniture, or `all`, every category for itself."""


@dataclasses.dataclass(frozen=True)
class Material:
    """Physical properties of one category."""

    density_kg_m3: float
    """Of the *decomposed hulls*, which enclose air between legs and in padding: lower than the material's
    own."""
    mass_range_kg: tuple[float, float]
    """What the real thing weighs; density x volume is clipped to it (hull volume varies with the
    decomposition)."""
    friction: float
    """Sliding coefficient against the floor."""


@dataclasses.dataclass(frozen=True)
class Category:
    """One category."""

    name: str
    colour: Rgb
    """In [0, 1], in colour and mask pictures alike."""
    segmentation_ids: tuple[int, ...]
    """Class in segmentation images, as Interactive Gibson's code has it (reference benchmark, section 1.4); several
    where models of the category differ in it, the usual one first."""
    own_segmentation_id: int | None = None
    """Class where the paper's five classes of furniture are told apart; None: the same."""
    is_object: bool = True
    """A scene may hold objects of it; else it is built in, part of the structure."""

    preview_colour: Rgb = (0.6, 0.6, 0.6)
    """In drawings of conversions, which tell categories apart more strongly."""
    words: tuple[str, ...] = ()
    """That tell the category in a model's name."""
    synset: str = ""
    """ShapeNet's or ImageNet's, or, where neither has the class, its name; empty: libraries have no class for it."""
    labels: tuple[int, ...] = ()
    """NYU40 ids that scans give it, its own first, which generated scans have."""
    material: Material | None = None
    """None: it has no mass."""
    sizes_m: tuple[Range, Range] | None = None
    """Usual ranges of the longer horizontal side and of the height; None: it is not looked for in scans."""
    longest: float | None = None
    """Greatest usual ratio of the sides, of things that stand in rows: a row of chairs is no chair."""
    top_m: tuple[float, float, float] | None = None
    """Greatest usual depth, m, greatest and middle ratio of length to depth, of a rectangular top. A long table may be
    two, or one; what is longer than that, or deeper, is several put together."""


# Masses. Averages of the reuse sector (Merseyside Recycling and Waste Authority with the Furniture Re-use Network,
# www.merseysidewda.gov.uk/average-weights): dining chair 7 kg, office chair 12, small or coffee table 14, medium 23,
# large 29, small desk 20, large 27, sofa of two seats 37, of three 42. A solid-core interior leaf of 0.91 x 2.03 m
# weighs 18 to 32 kg (engineerfix.com/how-much-does-a-solid-core-door-weigh), a hollow-core one about half. The ranges
# lie around these; a chair's is that of the dining chair, 4 to 8 kg. Waste baskets: own estimate, plastic to steel.
# Densities: the middle of the range divided by the hull volume of typical models (a chair's hulls hold about 0.05 m3,
# a table's 0.045 m3, a sofa's 0.5 m3, a basket's 0.009 m3; door hulls are half as thick again as the leaf).
# Friction: wood and plastic on wood, carpet or linoleum lie between 0.3 and 0.6; a door touches no floor.
# Furnished homes, from the same table: armchair 27 kg, bedside unit 14, blanket box or ottoman 11, bench of solid wood
# 30, bed with mattress 53 (single) to 91 (king), chest of drawers 27, sideboard 35, TV unit 17, bookcase 21, coffee
# table 14. Stools, bins, plants in wet soil, lamps, bags, boxes, suitcases (a packed one up to the 23 kg that airlines
# take), baskets with laundry, carts, racks: own estimates. Densities as above, over hulls of the generator's models;
# those of solid pieces hold what their parts do, of tables and stools thrice, of wire racks up to twenty times as much.
# Small things: a pair of trainers weighs 0.6 kg in 2.5 dm3 of hulls, a clay pot of 15 cm 0.7 kg in 0.8 dm3, a plastic
# toy is mostly hollow; other things lie between. Their friction: rubber soles, clay, plastic, anything.
ANY_MASS_KG = (0.01, math.inf)

# A new category has the class of what it is most like.
_HOMES = (
    Category("armchair", (0.92, 0.25, 0.95), (3,), preview_colour=(0.01, 0.05, 0.45), synset="armchair",
             labels=(5,), material=Material(140.0, (15.0, 40.0), 0.6)),
    Category("stool", (0.26, 0.90, 0.24), (2,), preview_colour=(0.07, 0.97, 0.03), synset="stool",
             labels=(5,), material=Material(150.0, (2.5, 7.0), 0.5)),
    Category("pouf", (0.30, 0.92, 0.97), (2,), preview_colour=(0.70, 1.00, 0.96), synset="pouf",
             labels=(39,), material=Material(75.0, (3.0, 12.0), 0.6)),
    Category("bench", (0.27, 0.25, 0.97), (3,), preview_colour=(0.96, 0.03, 0.95), synset="02828884",
             labels=(5,), material=Material(220.0, (8.0, 30.0), 0.5)),
    Category("coffee_table", (0.36, 0.44, 0.11), (4,), preview_colour=(0.35, 0.01, 0.04), synset="coffee_table",
             labels=(7,), material=Material(180.0, (8.0, 22.0), 0.5)),
    Category("bed", (0.13, 0.46, 0.52), (3,), preview_colour=(0.01, 0.96, 0.93), synset="02818832",
             labels=(4,), material=Material(50.0, (40.0, 95.0), 0.5)),
    Category("nightstand", (0.65, 0.95, 0.47), (4,), preview_colour=(0.00, 0.34, 0.01), synset="nightstand",
             labels=(32,), material=Material(250.0, (8.0, 20.0), 0.5)),
    Category("dresser", (0.97, 0.41, 0.53), (4,), preview_colour=(0.43, 0.98, 0.47), synset="dresser",
             labels=(17,), material=Material(80.0, (20.0, 50.0), 0.5)),
    Category("sideboard", (0.56, 0.17, 0.14), (4,), preview_colour=(0.26, 0.06, 0.99), synset="02933112",
             labels=(3,), material=Material(90.0, (25.0, 60.0), 0.5)),
    Category("tv_bench", (0.41, 0.11, 0.42), (4,), preview_colour=(0.93, 0.61, 0.99), synset="03290653",
             labels=(3,), material=Material(100.0, (12.0, 35.0), 0.5)),
    Category("bookcase", (0.22, 0.85, 0.64), (4,), preview_colour=(0.68, 0.96, 0.02), synset="02871439",
             labels=(10,), material=Material(100.0, (15.0, 45.0), 0.5)),
    Category("shoe_rack", (0.73, 0.20, 0.71), (4,), preview_colour=(0.96, 0.93, 0.66), synset="shoe_rack",
             labels=(39,), material=Material(100.0, (3.0, 20.0), 0.5)),
    Category("box", (0.58, 0.39, 0.95), (6,), preview_colour=(0.42, 0.00, 0.61), synset="02971356",
             labels=(29,), material=Material(70.0, (1.0, 12.0), 0.4)),
    Category("bag", (0.53, 0.68, 0.19), (6,), preview_colour=(0.40, 0.83, 0.87), synset="02773838",
             labels=(37,), material=Material(100.0, (0.5, 6.0), 0.5)),
    Category("bin", (0.52, 0.76, 0.90), (6,), preview_colour=(0.90, 0.01, 0.45), synset="bin",
             labels=(39,), material=Material(60.0, (0.8, 5.0), 0.4)),
    Category("plant", (0.98, 0.58, 0.89), (7,), preview_colour=(0.23, 0.33, 0.50), synset="03991062",
             labels=(40,), material=Material(180.0, (2.0, 25.0), 0.5)),
    Category("floor_lamp", (0.28, 0.58, 0.33), (7,), preview_colour=(0.01, 0.90, 0.43), synset="03636649",
             labels=(35,), material=Material(300.0, (3.0, 12.0), 0.5)),
    Category("laundry_basket", (0.23, 0.19, 0.62), (6,), preview_colour=(0.01, 0.25, 0.92), synset="03482405",
             labels=(40,), material=Material(50.0, (0.8, 5.0), 0.4)),
    Category("suitcase", (0.97, 0.75, 0.61), (6,), preview_colour=(0.35, 0.84, 0.10), synset="suitcase",
             labels=(37,), material=Material(100.0, (3.0, 20.0), 0.3)),
    Category("cart", (0.46, 0.94, 0.72), (4,), preview_colour=(0.01, 0.47, 0.38), synset="cart",
             labels=(39,), material=Material(110.0, (4.0, 14.0), 0.2)),
    Category("drying_rack", (0.77, 0.69, 0.97), (4,), preview_colour=(0.74, 0.29, 0.98), synset="drying_rack",
             labels=(39,), material=Material(40.0, (2.0, 6.0), 0.5)),
)  # fmt: skip
"""What furnished homes have beside the original's categories."""

_BUILT_IN = (
    Category("wardrobe", (0.70, 0.60, 0.48), (0,), is_object=False, labels=(3,)),
    Category("counter", (0.80, 0.78, 0.72), (0,), is_object=False, labels=(12,)),
    Category("sink", (0.74, 0.76, 0.78), (0,), is_object=False, labels=(34,)),
    Category("stove", (0.30, 0.30, 0.32), (0,), is_object=False, labels=(39,)),
    Category("fridge", (0.88, 0.90, 0.92), (0,), is_object=False, labels=(24,)),
    Category("tub", (0.93, 0.94, 0.95), (0,), is_object=False, labels=(36,)),
    Category("shower", (0.78, 0.88, 0.92), (0,), is_object=False, labels=(38,)),
    Category("toilet", (0.95, 0.95, 0.96), (0,), is_object=False, labels=(33,)),
    Category("washbasin", (0.90, 0.93, 0.96), (0,), is_object=False, labels=(34,)),
    Category("washer", (0.84, 0.86, 0.88), (0,), is_object=False, labels=(39,)),
    Category("radiator", (0.92, 0.90, 0.86), (0,), is_object=False, labels=(39,)),
    Category("shelf", (0.66, 0.50, 0.34), (0,), is_object=False, labels=(15,)),
)
"""What stands fast in them."""

# The original's small models: 6 and 8 are its baskets and 9 its toy (names in its demos); the released URDF of 7 calls
# itself a plant container, so 7 is a pot, which leaves 10 for the shoe. Its code has one class for desks and tables.
TABLE = (
    Category("structure", (0.87, 0.86, 0.84), (0,), is_object=False),
    Category("robot", (0.16, 0.20, 0.27), (1,), is_object=False),
    Category(
        "chair",
        (0.36, 0.55, 0.75),
        (2,),
        preview_colour=(0.90, 0.50, 0.15),
        words=("chair", "stool"),
        synset="03001627",
        labels=(5,),
        material=Material(115.0, (4.0, 8.0), 0.5),
        sizes_m=((0.35, 1.0), (0.5, 1.4)),
        longest=1.6,
    ),
    Category(
        "desk",
        (0.68, 0.52, 0.36),
        (4,),
        own_segmentation_id=11,
        preview_colour=(0.20, 0.50, 0.85),
        words=("desk",),
        synset="03179701",
        labels=(14, 7),
        material=Material(330.0, (15.0, 45.0), 0.5),
        sizes_m=((0.6, 2.6), (0.6, 1.4)),
        top_m=(1.2, 3.2, 1.9),
    ),
    Category(
        "door",
        (0.66, 0.60, 0.72),
        (5,),
        preview_colour=(0.75, 0.20, 0.25),
        words=("door",),
        synset="03221720",
        labels=(8,),
        material=Material(220.0, (12.0, 35.0), 0.4),
        sizes_m=((0.6, 1.3), (1.7, 2.4)),
        longest=math.inf,
    ),
    Category(
        "sofa",
        (0.45, 0.65, 0.53),
        (3,),
        preview_colour=(0.30, 0.60, 0.30),
        words=("sofa", "couch"),
        synset="04256520",
        labels=(6,),
        material=Material(85.0, (30.0, 60.0), 0.6),
        sizes_m=((0.7, 3.2), (0.5, 1.2)),
    ),
    Category(
        "table",
        (0.78, 0.62, 0.42),
        (4,),
        preview_colour=(0.55, 0.35, 0.75),
        words=("table",),
        synset="04379243",
        labels=(7, 14),
        material=Material(400.0, (10.0, 40.0), 0.5),
        sizes_m=((0.4, 3.0), (0.3, 1.1)),
        top_m=(1.4, 3.2, 1.9),
    ),
    Category(
        "basket",
        (0.90, 0.58, 0.20),
        (6, 8),
        preview_colour=(0.15, 0.65, 0.65),
        words=("basket", "bin", "hamper"),
        synset="02747177",  # ShapeNet's trash bin
        labels=(39, 40),  # otherfurniture, where ScanNet's waste baskets are, and otherprop
        material=Material(115.0, (0.5, 2.0), 0.4),
        sizes_m=((0.15, 0.6), (0.15, 0.8)),
        longest=2.0,
    ),
    Category(
        "shoe",
        (0.80, 0.28, 0.30),
        (10,),
        preview_colour=(0.85, 0.40, 0.65),
        words=("shoe", "sandal", "boot", "sneaker", "loafer", "slipper", "heel"),
        material=Material(250.0, ANY_MASS_KG, 0.7),
    ),
    Category(
        "pot",
        (0.55, 0.34, 0.56),
        (7,),
        preview_colour=(0.50, 0.50, 0.15),
        words=("pot", "planter", "plantcontainer", "flowerpot", "vase"),
        material=Material(900.0, ANY_MASS_KG, 0.5),
    ),
    Category(
        "toy",
        (0.93, 0.78, 0.24),
        (9,),
        preview_colour=(0.95, 0.80, 0.20),
        words=("toy", "doll", "teddy", "truck", "robot"),
        material=Material(200.0, ANY_MASS_KG, 0.4),
    ),
    # What has no class is as the structure.
    Category("other", (0.60, 0.60, 0.60), (0,), material=Material(300.0, ANY_MASS_KG, 0.5)),
    *_HOMES,
    *_BUILT_IN,
)
CATEGORIES = {category.name: category for category in TABLE}
OBJECT_CATEGORIES = tuple(category.name for category in TABLE if category.is_object)
"""What scene.json may call an object."""


@dataclasses.dataclass(frozen=True)
class Segmentation:
    """How masks number what they show."""

    ids: Mapping[str, int]
    """Category -> class, of its usual model."""
    names: tuple[str, ...]
    """Class -> category."""
    colours: tuple[Rgb, ...]
    """Class -> colour."""
    divisor: int
    """A class divided by it is what an observation holds."""


def _furniture_classes(five: bool) -> Segmentation:
    rows: dict[int, tuple[str, Rgb]] = {}
    for category in TABLE:
        own = category.own_segmentation_id
        for k, number in enumerate(category.segmentation_ids if own is None else (own,)):
            # Further models of a category are paler.
            red, green, blue = (1.0 - (1.0 - value) * 0.6**k for value in category.colour)
            rows.setdefault(number, (category.name, (red, green, blue)))
    assert sorted(rows) == list(range(len(rows))), "classes are numbered without gaps, each for one category"
    names, colours = zip(*(rows[number] for number in range(len(rows))), strict=True)
    own_ids = {c.name: c.own_segmentation_id for c in TABLE if five and c.own_segmentation_id is not None}
    # The original divides by 11, so that desks apart from tables are 1.
    divisor = max(number for category in TABLE for number in category.segmentation_ids) + 1
    return Segmentation({c.name: c.segmentation_ids[0] for c in TABLE} | own_ids, names, colours, divisor)


def _every_category() -> Segmentation:
    names = ("structure", "robot", *OBJECT_CATEGORIES)
    ids = {category.name: names.index(category.name) if category.name in names else 0 for category in TABLE}
    return Segmentation(ids, names, tuple(CATEGORIES[name].colour for name in names), len(names))


SEGMENTATIONS: dict[MaskClasses, Segmentation] = {
    4: _furniture_classes(five=False),
    5: _furniture_classes(five=True),
    "all": _every_category(),
}
"""The setting `segmentation_classes` -> how masks are numbered; class 4 of the first two is a desk's too where desks
have no class of their own."""


def class_id(category: str, classes: MaskClasses = 4) -> int:
    """Segmentation id of an object category.

    Args:
        category: such as chair.
        classes: the setting `segmentation_classes`.

    Raises:
        ConfigError: a category without an id.
    """
    ids = SEGMENTATIONS[classes].ids
    if category not in ids:
        near = nearest(category, list(ids))
        raise ConfigError(f"category '{category}' has no segmentation id{near}; known: {', '.join(ids)}")
    return ids[category]
