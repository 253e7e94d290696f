"""What is known of each category of things, in one table: a name in, its record out.

Whatever another module must know of every category (a class of a mask, a colour, a material, a library's key) is a
field here, so that a new category is one new row and no two places differ.
"""

from __future__ import annotations

import dataclasses
import difflib

Rgb = tuple[float, float, float]


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

    def segmentation_id(self, five: bool = False) -> int:
        """Class of the category's usual model.

        Args:
            five: the paper's five classes of furniture, not the code's four.
        """
        return self.own_segmentation_id if five and self.own_segmentation_id is not None else self.segmentation_ids[0]


# The original's small models: 6 and 8 are its baskets and 9 its toy (names in its demos); the released URDF of 7 calls
# itself a plant container, so 7 is a pot, which leaves 10 for the shoe. Its code has one class for desks and tables.
TABLE = (
    Category("structure", (0.87, 0.86, 0.84), (0,), is_object=False),
    Category("robot", (0.16, 0.20, 0.27), (1,), is_object=False),
    Category("chair", (0.36, 0.55, 0.75), (2,)),
    Category("desk", (0.68, 0.52, 0.36), (4,), own_segmentation_id=11),
    Category("door", (0.66, 0.60, 0.72), (5,)),
    Category("sofa", (0.45, 0.65, 0.53), (3,)),
    Category("table", (0.78, 0.62, 0.42), (4,)),
    Category("basket", (0.90, 0.58, 0.20), (6, 8)),
    Category("shoe", (0.80, 0.28, 0.30), (10,)),
    Category("pot", (0.55, 0.34, 0.56), (7,)),
    Category("toy", (0.93, 0.78, 0.24), (9,)),
    Category("other", (0.60, 0.60, 0.60), (0,)),  # what has no class is as the structure
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
