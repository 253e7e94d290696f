"""Look up the record of an object category in the one table, `categories.yaml`.

Every property of a category that any module needs (mask class, colour, material, key in a library) is a field here,
so that a new category is one new row.
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from interactive_nav_common.records import read_packaged

Rgb = tuple[float, float, float]
Range = tuple[float, float]
MaskClasses = Literal[4, 5, "all"]
"""How masks distinguish objects: 4 or 5 classes of furniture, or `all`, every category for itself."""


@dataclasses.dataclass(frozen=True)
class Material:
    """Physical properties of one category."""

    density_kg_m3: float
    """Of the *decomposed hulls*, which enclose air between legs and in padding: lower than the material's
    own."""
    mass_range_kg: tuple[float, float]
    """Weight of real ones; density x volume is clipped to it (hull volume varies with the
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
    """Class with the paper's five classes of furniture; None: the same."""
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
    """Greatest usual ratio of the sides, of objects in rows: a row of chairs is no chair."""
    most_m: Range | None = None
    """Greatest horizontal side and height of the largest of its kind: what is larger is something else, whatever its
    name; None: any size."""
    top_m: tuple[float, float, float] | None = None
    """Greatest usual depth, m, greatest and middle ratio of length to depth, of a rectangular top. A long table may be
    two, or one; what is longer than that, or deeper, is several put together."""


ANY_MASS_KG = (0.01, math.inf)
TABLE: tuple[Category, ...] = read_packaged(Path(__file__).with_suffix(".yaml"), tuple[Category, ...])
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
    """Return the segmentation id of an object category with so many `segmentation_classes`."""
    return SEGMENTATIONS[classes].ids[category]
