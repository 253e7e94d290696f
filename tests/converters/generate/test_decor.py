"""What hangs on walls, and the light that sees furniture, in a room by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from converters.generate.design.plan import Plan, PlanBox, Rect
from converters.generate.models.cad import LIBRARY, Instance, cad_model, place
from converters.generate.surface.decor import CUPBOARD_DEEP_M, CUPBOARD_M, HOOD_M, MIRROR_M, RAIL_M, decor
from converters.generate.surface.modelled import Daylight, space_of
from converters.generate.surface.sides import OTHER, sides_of

ROOM, HEIGHT_M = Rect(0.0, 0.0, 4.0, 3.0), 2.5
WINDOW = PlanBox((0.5, 3.0, 0.9), (1.5, 3.2, 2.1))


def at_north_wall(category: str, x: float, model: str = "") -> Instance:
    """A piece with its back to the wall y = 3."""
    model = model or next(n for n, d in LIBRARY.items() if d.category == category)
    cad = cad_model(model)
    deep = 2 * cad.half_extents[2] * cad.unit_m
    return place(cad, np.full(3, cad.unit_m), np.array([x, 3.0 - deep / 2]), -np.pi / 2)


def boxes_of(use: str, items: list[Instance], windows: tuple[PlanBox, ...] = ()) -> list[PlanBox]:
    charts, boxes = decor([use], [sides_of(ROOM, (), windows)], items, HEIGHT_M, np.random.default_rng(0))
    assert {chart.label for chart in charts} <= {OTHER}
    return boxes


def test_cupboards_hang_above_counters_and_a_hood_above_the_stove_but_before_no_window():
    row = [at_north_wall("counter", 1.0), at_north_wall("stove", 3.0, "stove_ceramic")]
    cupboard, hood, chimney = boxes_of("kitchen", row)
    x0, _, x1, _ = row[0].footprint.bounds
    assert (cupboard.low, cupboard.high) == (
        pytest.approx((x0, 3.0 - CUPBOARD_DEEP_M, CUPBOARD_M[0])),
        pytest.approx((x1, 3.0, CUPBOARD_M[1])),
    )
    assert hood.low[2] == HOOD_M[0] and (hood.low[0] + hood.high[0]) / 2 == pytest.approx(3.0)
    assert chimney.high[2] == HEIGHT_M
    assert len(boxes_of("kitchen", row, (WINDOW,))) == 2
    assert boxes_of("bedroom", row) == []
    turned = dataclasses.replace(row[0], yaw_rad=row[0].yaw_rad + np.pi)
    assert boxes_of("kitchen", [turned]) == []  # its front, not its back, is at the wall


def test_a_bathroom_has_a_mirror_above_its_washbasin_and_a_towel_where_nothing_stands():
    basin = at_north_wall("washbasin", 1.0)
    mirror, rail, towel = boxes_of("bathroom", [basin])
    assert mirror.low[2] == MIRROR_M[0] and (mirror.low[0] + mirror.high[0]) / 2 == pytest.approx(1.0)
    assert rail.low[2] == RAIL_M and towel.low[2] > 0.5
    for box in (rail, towel):
        assert not box.rect.polygon.intersects(basin.footprint)
        deep = max(box.low[0] - 0.0, box.low[1] - 0.0, 4.0 - box.high[0], 3.0 - box.high[1], 0.0)
        assert deep > 0.0 and min(box.low[0], box.low[1], 4.0 - box.high[0], 3.0 - box.high[1]) < 0.06
    assert [b.low[2] for b in boxes_of("bathroom", [basin], (WINDOW,))][0] == RAIL_M  # no mirror in a window


def test_the_floor_beneath_a_table_is_darker_and_the_far_corner_is_not():
    sides = [(-0.2, -0.2, 0.0, 3.2), (4.0, -0.2, 4.2, 3.2), (-0.2, -0.2, 4.2, 0.0), (-0.2, 3.0, 4.2, 3.2)]
    walls = tuple(PlanBox((a, b, 0.0), (c, d, HEIGHT_M)) for a, b, c, d in sides)
    plan = Plan((ROOM,), Rect(-0.2, -0.2, 4.2, 3.2), walls, (), (), (), None, HEIGHT_M)
    cad = cad_model("table_apron")
    table = place(cad, np.full(3, cad.unit_m), np.array([2.0, 1.5]), 0.0)
    floor, up = np.array([[2.0, 1.5, 0.004], [0.4, 0.4, 0.004]]), np.array([[0.0, 0.0, 1.0]] * 2)
    none = np.zeros((0, 3))
    bare, furnished = (
        Daylight(space_of(plan, items), np.array([[2.0, 1.5, 2.2]]), none, none)(floor, up) for items in ((), (table,))
    )
    assert (furnished[0] < 0.8 * bare[0]).all()
    assert furnished[1] == pytest.approx(bare[1], rel=0.06)
