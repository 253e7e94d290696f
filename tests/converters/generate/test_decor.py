"""What hangs on walls, and the light that sees furniture, in a room by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely

from converters.generate.homes.building import Plan, PlanBox, Rect
from converters.generate.models.cad import LIBRARY, LOOKS, Instance, cad_model, drawn_parts, place
from converters.generate.models.parts import MATERIALS
from converters.generate.surface.decor import CUPBOARD_DEEP_M, CUPBOARD_M, HOOD_M, MIRROR_M, RAIL_M, decor
from converters.generate.surface.modelled import Daylight, space_of
from converters.generate.surface.sides import OTHER, sides_of
from converters.library.store import read_shape
from converters.pipeline import ConvertConfig
from converters.read.obj import texels
from converters.records.raw import OTHER_PROP

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
    assert {chart.label for chart in charts} <= {OTHER, OTHER_PROP}
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


@pytest.mark.parametrize("model", ["lowerCabinet", "lowerCabinet+Scopia/coffee_machine"])
def test_things_stand_on_most_counters_that_come_bare_and_no_later_look_depends_on_them(model):
    counter, rng, stood = at_north_wall("counter", 2.0, f"BlendSwap-CC-0/{model}"), np.random.default_rng(0), 0
    assert counter.model.surface is not None
    top_m = counter.to_floor(counter.model.surface.vertices)[:, 2].max()
    for _ in range(20):
        state, twin = rng.bit_generator.state, np.random.default_rng()
        charts, _ = decor(["kitchen"], [sides_of(ROOM, (), ())], [counter], HEIGHT_M, rng)
        twin.bit_generator.state = state
        twin.integers(5)  # the colour of the cupboards
        assert rng.bit_generator.state == twin.bit_generator.state
        things = [chart.vertices for chart in charts if chart.label == OTHER_PROP]
        stood += bool(things)
        for points in [np.vstack(things)] if things else []:
            assert points[:, 2].min() == pytest.approx(top_m, abs=1e-3) and points[:, 2].max() < top_m + 0.3
            assert (shapely.distance(counter.footprint, shapely.points(points[:, :2])) == 0).all()
    assert not stood if "+" in model else 8 <= stood < 20


@pytest.mark.parametrize("name", LOOKS.holds)
def test_books_are_drawn_inside_of_a_shelf_in_their_colours_and_nothing_else_of_it_changes(name):
    full, tinted, bare = cad_model(name), cad_model(f"{name}~walnut"), read_shape(name).visual
    assert full.surface is not None and tinted.surface is not None
    held = {part.material for part in drawn_parts(LOOKS.holds[name])}
    corners = full.surface.vertices[full.surface.faces] * full.unit_m
    bounds = np.ptp(bare.vertices, axis=0), np.ptp(corners.reshape(-1, 3), axis=0)
    np.testing.assert_allclose(*bounds, atol=1e-9)
    assert len(bare.faces) < len(corners) <= ConvertConfig().object_faces
    assert full.surface.image.shape == bare.image.shape
    for surface in (full.surface, tinted.surface):
        uv = surface.uv[surface.uv_faces[len(bare.faces) :]].mean(axis=1)
        shown = {tuple(colour) for colour in texels(surface.image, uv).tolist()}
        assert shown == {tuple(round(255 * c) for c in MATERIALS[m]) for m in held}
        old = texels(surface.image, surface.uv[surface.uv_faces[: len(bare.faces)]].mean(axis=1)).astype(int)
        if surface is full.surface:
            assert np.abs(old - texels(bare.image, bare.uv[bare.uv_faces].mean(axis=1))).mean() < 2


def test_the_floor_beneath_a_table_is_darker_and_the_far_corner_is_not():
    sides = [(-0.2, -0.2, 0.0, 3.2), (4.0, -0.2, 4.2, 3.2), (-0.2, -0.2, 4.2, 0.0), (-0.2, 3.0, 4.2, 3.2)]
    walls = tuple(PlanBox((a, b, 0.0), (c, d, HEIGHT_M)) for a, b, c, d in sides)
    plan = Plan((ROOM,), Rect(-0.2, -0.2, 4.2, 3.2), walls, (), (), None, HEIGHT_M)
    cad = cad_model("Scopia/white_kitchen_table")
    table = place(cad, np.full(3, cad.unit_m), np.array([2.0, 1.5]), 0.0)
    floor, up = np.array([[2.0, 1.5, 0.004], [0.4, 0.4, 0.004]]), np.array([[0.0, 0.0, 1.0]] * 2)
    none = np.zeros((0, 3))
    bare, furnished = (
        Daylight(space_of(plan, items), np.array([[2.0, 1.5, 2.2]]), none, none)(floor, up) for items in ((), (table,))
    )
    assert (furnished[0] < 0.8 * bare[0]).all()
    assert furnished[1] == pytest.approx(bare[1], rel=0.06)
