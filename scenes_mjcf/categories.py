"""What is known of each category of things, in one table: a name in, its record out.

Whatever another module must know of every category (a class of a mask, a colour, a material, a library's key) is a
field here, so that a new category is one new row and no two places differ.
"""

from __future__ import annotations

import dataclasses
import difflib
import math

Rgb = tuple[float, float, float]
Range = tuple[float, float]


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
    """A scene may hold objects of it."""

    preview_colour: Rgb = (0.6, 0.6, 0.6)
    """In drawings of conversions, which tell categories apart more strongly."""
    words: tuple[str, ...] = ()
    """That tell the category in a model's name."""
    synset: str = ""
    """ShapeNet's; empty: libraries have no class for it."""
    labels: tuple[int, ...] = ()
    """NYU40 ids that scans give it, its own first."""
    material: Material | None = None
    """None: it has no mass."""
    sizes_m: tuple[Range, Range] | None = None
    """Usual ranges of the longer horizontal side and of the height, of what is looked for in scans."""
    longest: float | None = None
    """Greatest usual ratio of the sides, of things that stand in rows: a row of chairs is no chair."""
    top_m: tuple[float, float, float] | None = None
    """Greatest usual depth, m, greatest and middle ratio of length to depth, of a rectangular top. A long table may be
    two, or one; what is longer than that, or deeper, is several put together."""

    def segmentation_id(self, five: bool = False) -> int:
        """Class of the category's usual model.

        Args:
            five: the paper's five classes of furniture, not the code's four.
        """
        return self.own_segmentation_id if five and self.own_segmentation_id is not None else self.segmentation_ids[0]


# Masses. Averages of the reuse sector (Merseyside Recycling and Waste Authority with the Furniture Re-use Network,
# www.merseysidewda.gov.uk/average-weights): dining chair 7 kg, office chair 12, small or coffee table 14, medium 23,
# large 29, small desk 20, large 27, sofa of two seats 37, of three 42. A solid-core interior leaf of 0.91 x 2.03 m
# weighs 18 to 32 kg (engineerfix.com/how-much-does-a-solid-core-door-weigh), a hollow-core one about half. The ranges
# lie around these; a chair's is that of the dining chair, 4 to 8 kg. Waste baskets: own estimate, plastic to steel.
# Densities: the middle of the range divided by the hull volume of typical models (a chair's hulls hold about 0.05 m3,
# a table's 0.045 m3, a sofa's 0.5 m3, a basket's 0.009 m3; door hulls are half as thick again as the leaf).
# Friction: wood and plastic on wood, carpet or linoleum lie between 0.3 and 0.6; a door touches no floor.
# Small things: a pair of trainers weighs 0.6 kg in 2.5 dm3 of hulls, a clay pot of 15 cm 0.7 kg in 0.8 dm3, a plastic
# toy is mostly hollow; other things lie between. Their friction: rubber soles, clay, plastic, anything.
ANY_MASS_KG = (0.01, math.inf)

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
)
CATEGORIES = {category.name: category for category in TABLE}
OBJECT_CATEGORIES = tuple(category.name for category in TABLE if category.is_object)
"""What scene.json may call an object."""


def _classes() -> tuple[tuple[str, Rgb], ...]:
    rows: dict[int, tuple[str, Rgb]] = {}
    for category in TABLE:
        own = category.own_segmentation_id
        for k, number in enumerate(category.segmentation_ids if own is None else (own,)):
            # Further models of a category are paler.
            red, green, blue = (1.0 - (1.0 - value) * 0.6**k for value in category.colour)
            rows.setdefault(number, (category.name, (red, green, blue)))
    assert sorted(rows) == list(range(len(rows))), "classes are numbered without gaps, each for one category"
    return tuple(rows[number] for number in range(len(rows)))


CLASSES = tuple(name for name, _ in _classes())
"""Class of a segmentation image -> category; 4, where desks have no class of their own, is theirs too."""
CLASS_COLOURS = tuple(colour for _, colour in _classes())
"""Class -> colour."""


def class_id(category: str, five: bool = False) -> int:
    """Segmentation id of an object category.

    Args:
        category: such as chair.
        five: desks apart from tables.

    Raises:
        ValueError: a category without an id.
    """
    if category not in CATEGORIES:
        near = difflib.get_close_matches(category, CATEGORIES, 1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise ValueError(f"category '{category}' has no segmentation id; {hint}known: {', '.join(CATEGORIES)}")
    return CATEGORIES[category].segmentation_id(five)
