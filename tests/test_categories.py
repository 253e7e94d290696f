"""The table of categories: what readers, scans and masks take from it, the original's categories first."""

from __future__ import annotations

import math
from collections import Counter

from converters.generate.surface.scan import NYU40
from converters.propose.pieces import LABEL_CATEGORIES
from converters.records.raw import CATEGORY_LABELS, SYNSETS
from scenes_mjcf.categories import CATEGORIES, OBJECT_CATEGORIES, TABLE

FIRST = ("chair", "desk", "door", "sofa", "table", "basket", "shoe", "pot", "toy", "other")


def test_names_are_once_and_the_first_ten_objects_stay_the_first():
    assert max(Counter(category.name for category in TABLE).values()) == 1
    assert OBJECT_CATEGORIES[:10] == FIRST and len(OBJECT_CATEGORIES) == 33
    assert len(TABLE) == 47 and not any(
        CATEGORIES[name].is_object for name in ("wardrobe", "toilet", "fridge", "shelf")
    )


def test_generated_scans_label_things_as_scannet_does():
    assert [NYU40[c] for c in ("wall", "floor", "cabinet", "chair", "sofa", "table", "door", "desk")] == [
        1, 2, 3, 5, 6, 7, 8, 14,
    ]  # fmt: skip
    new = {"bed": 4, "bookcase": 10, "counter": 12, "shelf": 15, "dresser": 17, "fridge": 24, "box": 29,
           "nightstand": 32, "toilet": 33, "sink": 34, "floor_lamp": 35, "tub": 36, "bag": 37, "wardrobe": 3,
           "armchair": 5}  # fmt: skip
    assert {name: NYU40[name] for name in new} == new
    assert all(CATEGORY_LABELS[name][0] == NYU40[name] for name in OBJECT_CATEGORIES[10:])


def test_libraries_tell_movable_categories_apart():
    keys = [category.synset for category in TABLE if category.synset]
    assert len(set(keys)) == len(keys) == len(SYNSETS)
    assert all(CATEGORIES[name].synset for name in OBJECT_CATEGORIES[10:])
    assert SYNSETS["02818832"] == "bed" and SYNSETS["04379243"] == "table" and SYNSETS["armchair"] == "armchair"


def test_what_is_looked_for_in_scans_is_what_it_was():
    assert LABEL_CATEGORIES == {5: "chair", 6: "sofa", 7: "table", 8: "door", 14: "desk", 39: "basket"}


def test_new_categories_have_plausible_masses_and_friction():
    for name in OBJECT_CATEGORIES[10:]:
        material = CATEGORIES[name].material
        assert material is not None, name
        low, high = material.mass_range_kg
        assert 0.4 < low < high < 100 and math.isfinite(high) and high / low <= 13, name
        assert 0.1 < material.friction < 0.8 and 10 < material.density_kg_m3 < 500, name
