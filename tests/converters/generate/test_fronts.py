"""Models are cut at doors and drawers: which open, about what, and what is left of them."""

import dataclasses

import numpy as np
import pytest

from converters.generate.homes.building import Plan, PlanBox, Rect
from converters.generate.homes.config import GenerationError
from converters.generate.homes.opening import KITCHEN, open_fronts
from converters.generate.models.cad import LIBRARY, cad_model, place
from converters.generate.models.fronts import carcass, opened, openings

OF = [
    ("BlendSwap-CC-0/drawersCabinet", ["drawer"] * 3),
    ("BlendSwap-CC-0/lowerCabinet", ["cabinet_door", "drawer"]),
    ("BlendSwap-CC-BY/kitchenIsland", ["cabinet_door", "cabinet_door", "drawer", "drawer"]),
    ("BlendSwap-CC-0/sinkCabinet", ["cabinet_door"]),
    ("stove_ceramic", ["cabinet_door", "drawer"]),
    ("fridge_american", ["cabinet_door", "cabinet_door"]),
    ("KatorLegaz/fridge", ["cabinet_door", "cabinet_door"]),
    ("BlendSwap-CC-0/wardrobeWithSlidingDoors", ["cabinet_door"] * 2),
    ("BlendSwap-CC-BY/wardrobe2", ["cabinet_door"] * 4),
    ("BlendSwap-CC-0/cupboard", []),  # one welded piece
    ("shower_curtain", []),
    ("BlendSwap-CC-BY/radiatorAndTowels", []),  # thinner than a drawer's box
]


@pytest.mark.parametrize(("name", "kinds"), OF)
def test_what_opens_of_a_model(name, kinds):
    assert [o.model.category for o in openings(name)] == kinds
    model, cut = cad_model(name), openings(name)
    left = carcass(model, cut)
    if model.surface is None:
        assert len(left.parts) == len(model.parts) - sum(len(o.pieces) for o in cut) + len(cut)
    else:
        trays = sum(12 * 4 for o in cut if o.model.category == "drawer")
        assert left.surface is not None
        shown = sum(len(o.model.surface.faces) for o in cut if o.model.surface is not None)
        assert len(left.surface.faces) + shown == len(model.surface.faces) + trays
    ids = {o.model.id_cad for o in cut} | {model.id_cad}
    assert len(ids) == len(cut) + 1


def test_every_kitchen_model_opens():
    names = [name for name, drawing in LIBRARY.items() if drawing.category in KITCHEN]
    assert len(names) == 19 and all(openings(name) for name in names)


def test_fronts_come_forward_and_keep_to_their_own_width():
    """The front of a piece that faces +x is to the right."""
    for name in ("BlendSwap-CC-0/lowerCabinet", "stove_ceramic", "fridge_american"):
        model = cad_model(name)
        item = place(model, np.full(3, model.unit_m), np.zeros(2), 0.0)
        x0, y0, _, y1 = item.footprint.bounds
        for opening in openings(name):
            front = dataclasses.replace(item, model=opening.model, hinge=opening.hinge)
            shut, wide = (np.concatenate(opened(front, share)) for share in (0.0, 1.0))
            assert wide[:, 0].max() > shut[:, 0].max() + 0.2 and wide[:, 2].min() > -1e-6
            assert wide[:, 1].min() > y0 - 0.06 and wide[:, 1].max() < y1 + 0.06 and wide[:, 0].min() > x0


def test_sliding_doors_slide_one_before_the_other():
    """Each of two that lap by 11 cm slides by the other's width less that, and leaves its half of the wardrobe open."""
    model = cad_model("BlendSwap-CC-0/wardrobeWithSlidingDoors")
    item = place(model, np.full(3, model.unit_m), np.zeros(2), 0.0)  # its right is +y
    one, two = (dataclasses.replace(item, model=o.model, hinge=o.hinge) for o in openings(model.name))
    for front, other in ((one, two), (two, one)):
        assert front.hinge is not None and front.hinge.slides
        assert front.hinge.range_rad[1] == pytest.approx(1.055 - 0.112, abs=2e-3)
        shut, wide, beside = (np.concatenate(opened(f, s)) for f, s in ((front, 0), (front, 1), (other, 0)))
        np.testing.assert_allclose(wide[:, [0, 2]], shut[:, [0, 2]], atol=1e-6)
        assert wide[:, 1].mean() == pytest.approx(beside[:, 1].mean(), abs=5e-3)
        assert shut[:, 0].min() > beside[:, 0].max() or shut[:, 0].max() < beside[:, 0].min()


def test_a_kitchen_front_before_a_wall_refuses_the_plan():
    model = cad_model("BlendSwap-CC-0/drawersCabinet")
    item = place(model, np.full(3, model.unit_m), np.zeros(2), 0.0)
    x = float(item.footprint.bounds[2])
    rooms, outer = (Rect(-3, -3, 3, 3),), Rect(-3.1, -3.1, 3.1, 3.1)
    for gap_m, reach_m in ((1.0, 0.338), (0.30, None), (0.15, 0.0)):
        wall = PlanBox.over(Rect(x + gap_m, -3, x + gap_m + 0.1, 3), 0.0, 2.5)
        plan = Plan(rooms, outer, (wall,), (), (), None, 2.5)
        if reach_m == 0:
            with pytest.raises(GenerationError, match="a front of the counter .*drawersCabinet opens by 0.14 m only"):
                open_fronts(plan, (item,), (), "kitchen")
            continue
        bodies, out = open_fronts(plan, (item,), (), "kitchen")
        assert len(out) == 3 and len(bodies) == 1
        for front in out:
            assert front.hinge is not None and 0.2 <= front.hinge.range_rad[1] <= 0.338
            assert reach_m is None or front.hinge.range_rad[1] == pytest.approx(reach_m)
            assert max(p[:, 0].max() for p in opened(front, 1.0)) <= x + gap_m
    assert open_fronts(plan, (item,), (), "none") == ((item,), ())
