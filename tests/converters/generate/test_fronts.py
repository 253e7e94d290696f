"""Models are cut at their doors and drawers: which open, about what, and what is left of the model."""

import dataclasses

import numpy as np
import pytest

from converters.generate.design.plan import Plan, PlanBox, Rect
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
]


@pytest.mark.parametrize(("name", "kinds"), OF)
def test_what_opens_of_a_model(name, kinds):
    assert [o.front.model.category for o in openings(name)] == kinds
    model, cut = cad_model(name), openings(name)
    left = carcass(model, cut)
    if model.surface is None:
        assert len(left.parts) == len(model.parts) - sum(len(o.pieces) for o in cut) + len(cut)
    else:
        trays = sum(12 * 4 for o in cut if o.front.hinge.slides)
        assert left.surface is not None
        shown = sum(len(o.front.model.surface.faces) for o in cut if o.front.model.surface is not None)
        assert len(left.surface.faces) + shown == len(model.surface.faces) + trays
    ids = {o.front.model.id_cad for o in cut} | {model.id_cad}
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
            shut, wide = (np.concatenate(opened(item, opening.front, share)) for share in (0.0, 1.0))
            assert wide[:, 0].max() > shut[:, 0].max() + 0.2 and wide[:, 2].min() > -1e-6
            assert wide[:, 1].min() > y0 - 0.06 and wide[:, 1].max() < y1 + 0.06 and wide[:, 0].min() > x0


def test_a_front_before_a_wall_stays_shut():
    model = cad_model("BlendSwap-CC-0/drawersCabinet")
    item = place(model, np.full(3, model.unit_m), np.zeros(2), 0.0)
    x = float(item.footprint.bounds[2])
    rooms, outer = (Rect(-3, -3, 3, 3),), Rect(-3.1, -3.1, 3.1, 3.1)
    for gap_m, fronts, reach in ((1.0, 3, 0.338), (0.30, 3, None), (0.15, 0, None)):
        wall = PlanBox.over(Rect(x + gap_m, -3, x + gap_m + 0.1, 3), 0.0, 2.5)
        plan = Plan(rooms, outer, (wall,), (), (), (), None, 2.5)
        bodies, out = open_fronts(plan, (item,), (), "kitchen")
        assert len(out) == fronts and len(bodies) == 1
        for front in out:
            assert front.hinge is not None and front.hinge.range_rad[1] <= 0.338
            assert reach is None or front.hinge.range_rad[1] == pytest.approx(reach)
            far = max(p[:, 0].max() for p in opened(item, dataclasses.replace(openings(model.name)[0].front,
                model=front.model, hinge=front.hinge), 1.0))  # fmt: skip
            assert far < x + gap_m + 0.006
    assert open_fronts(plan, (item,), (), "none") == ((item,), ())
