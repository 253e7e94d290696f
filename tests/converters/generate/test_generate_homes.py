"""Furniture of furnished homes: sizes, stability and masses of every drawing."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import shapely
import trimesh

from converters.bodies.objects import FOOT_M
from converters.generate.models.cad import (
    HOME_TEST_MODELS,
    HOME_TRAIN_MODELS,
    LIBRARY,
    cad_model,
    drawn_parts,
)  # fmt: skip
from converters.generate.models.parts import (
    Part,
    ball,
    beam,
    block,
    fronts,
    hull,
    leaf,
    on_floor,
    oval,
    pillar,
    plate,
    rail,
    rectangle,
    shell,
    turned,
)  # fmt: skip
from converters.geometry.boxes import convex_hull, merge_pieces
from converters.read.annotations import MOST_PIECES, SLACK
from scenes_mjcf.categories import CATEGORIES, OBJECT_CATEGORIES

PACKAGED = sorted(name for name in LIBRARY if "/" in name)
NEW = sorted(name for name in set(LIBRARY) - set(PACKAGED) if LIBRARY[name].category != "door")
MOVABLE = [
    n for n in (*NEW, *PACKAGED) if CATEGORIES[LIBRARY[n].category].is_object and LIBRARY[n].category != "basket"
]
SIZES_M = {
    "armchair": ((0.6, 0.95), (0.7, 1.1), (0.6, 0.9)),
    "bag": ((0.25, 0.7), (0.25, 0.6), (0.12, 0.4)),
    "bed": ((0.9, 1.9), (0.75, 2.0), (2.0, 2.4)),
    "bench": ((0.9, 1.5), (0.4, 0.95), (0.3, 0.55)),
    "bin": ((0.2, 0.8), (0.25, 0.75), (0.2, 0.4)),
    "bookcase": ((0.6, 1.3), (0.8, 2.2), (0.25, 0.42)),
    "box": ((0.3, 1.0), (0.15, 0.9), (0.3, 0.6)),
    "cart": ((0.4, 0.85), (0.7, 1.0), (0.3, 0.65)),
    "chair": ((0.38, 0.7), (0.7, 1.1), (0.4, 0.7)),
    "coffee_table": ((0.7, 1.2), (0.3, 0.5), (0.5, 0.9)),
    "counter": ((0.3, 1.2), (0.88, 2.3), (0.58, 0.66)),
    "desk": ((1.0, 1.4), (0.7, 1.1), (0.55, 0.75)),
    "dresser": ((0.5, 1.6), (0.7, 1.3), (0.4, 0.6)),
    "drying_rack": ((0.6, 1.2), (0.9, 1.6), (0.4, 1.2)),
    "floor_lamp": ((0.25, 0.7), (1.2, 1.9), (0.25, 1.2)),
    "fridge": ((0.5, 0.95), (0.8, 1.9), (0.55, 0.8)),
    "laundry_basket": ((0.4, 0.7), (0.25, 0.7), (0.3, 0.5)),
    "nightstand": ((0.35, 0.55), (0.4, 0.7), (0.3, 0.5)),
    "plant": ((0.25, 1.0), (0.6, 1.7), (0.25, 1.0)),
    "pouf": ((0.35, 0.9), (0.3, 0.7), (0.35, 0.9)),
    "radiator": ((0.4, 1.3), (0.25, 1.8), (0.05, 0.2)),
    "shelf": ((0.7, 2.1), (1.8, 2.4), (0.28, 0.5)),
    "shoe_rack": ((0.5, 1.0), (0.45, 1.1), (0.2, 0.4)),
    "shower": ((0.8, 1.4), (1.95, 2.1), (0.8, 1.0)),
    "sideboard": ((1.0, 1.8), (0.7, 1.8), (0.35, 0.55)),
    "sink": ((0.7, 1.1), (1.0, 1.3), (0.58, 0.66)),
    "sofa": ((1.2, 2.1), (0.7, 0.95), (0.75, 0.95)),
    "stool": ((0.3, 0.5), (0.4, 1.0), (0.3, 0.55)),
    "stove": ((0.5, 1.0), (0.85, 2.3), (0.58, 0.68)),
    "suitcase": ((0.35, 0.8), (0.18, 1.0), (0.2, 0.55)),
    "table": ((0.75, 1.4), (0.7, 0.8), (0.6, 1.0)),
    "toilet": ((0.34, 0.7), (0.75, 2.0), (0.55, 0.75)),
    "tub": ((1.3, 1.8), (0.55, 0.9), (0.7, 1.4)),
    "tv_bench": ((1.0, 1.8), (0.35, 0.6), (0.35, 0.6)),
    "wardrobe": ((0.9, 2.0), (1.8, 2.4), (0.45, 0.7)),
    "washbasin": ((0.5, 1.3), (0.85, 2.0), (0.38, 0.55)),
    "washer": ((0.4, 0.7), (0.8, 1.8), (0.55, 0.65)),
}
"""Category -> least and greatest width, height and depth."""


@functools.cache
def parts_m(name: str) -> tuple[Part, ...]:
    """A model's parts in metres; the middle of its footprint at the origin, its base at y = 0, front +z."""
    model = cad_model(name)
    (x0, y0, z0), (x1, _, z1) = model.bounds
    move = np.array([(x0 + x1) / 2, y0, (z0 + z1) / 2])
    turn = model.unit_m
    return tuple(Part((p.vertices - move) * turn, p.faces, p.material) for p in model.parts)


def solids(parts) -> tuple[np.ndarray, np.ndarray]:
    """Volumes (n,), m3, and centres of mass (n, 3) of parts."""
    meshes = [trimesh.Trimesh(p.vertices, p.faces, process=False) for p in parts]
    return np.array([m.volume for m in meshes]), np.array([m.center_mass for m in meshes])


def stance(name: str) -> tuple[float, float]:
    """How far the centre of mass of what collides lies inside the edge of what it stands on, and how high, m."""
    vertices = np.concatenate([p.vertices for p in parts_m(name)])
    slack_m3 = SLACK * float(np.ptp(vertices, axis=0).prod())
    joined = merge_pieces([p.vertices for p in parts_m(name)], MOST_PIECES, slack_m3)
    volume, centre = solids([convex_hull(points) for points in joined])
    x, y, z = (volume[:, None] * centre).sum(axis=0) / volume.sum()
    low_m = FOOT_M if name in PACKAGED else 0.006  # the converter brings feet of a packaged model down to the floor
    ground = shapely.MultiPoint(vertices[vertices[:, 1] < low_m][:, [0, 2]]).convex_hull
    assert isinstance(ground, shapely.Polygon)
    inside = ground.contains(shapely.Point(x, z))
    return ground.exterior.distance(shapely.Point(x, z)) * (1 if inside else -1), y


@pytest.mark.parametrize("name", NEW)
def test_a_model_stands_on_the_floor_has_its_categorys_size_and_few_parts(name):
    drawing = LIBRARY[name]
    drawn = on_floor(drawn_parts(drawing.parts))
    most = 100 if name == "shelf_builtin" else 40  # with its books
    assert name.startswith(f"{drawing.category}_") and 2 < len(drawn) <= most
    lowest = min(p.vertices[:, 1].min() for p in drawn)
    assert 0 <= lowest < 0.003
    size_m = np.ptp(np.concatenate([p.vertices for p in parts_m(name)]), axis=0)
    for value, (low, high) in zip(size_m, SIZES_M[drawing.category], strict=True):
        assert low <= value <= high, (name, size_m)


def test_every_category_is_there_for_training_and_held_out():
    assert set(HOME_TRAIN_MODELS).isdisjoint(HOME_TEST_MODELS)
    small = {"basket", "shoe", "pot", "toy", "other", "cabinet_door", "drawer"}  # the last two are cut out of others
    built_in = {c.name for c in CATEGORIES.values() if not c.is_object} - {"structure", "robot"}
    assert len(built_in) == 12
    for names in (HOME_TRAIN_MODELS, HOME_TEST_MODELS):
        assert {LIBRARY[name].category for name in names} - {"basket"} == set(OBJECT_CATEGORIES) - small | built_in


@pytest.mark.parametrize("name", MOVABLE)
def test_a_movable_model_stands_by_itself(name):
    margin_m, height_m = stance(name)
    # Within 7 degrees of its rest it comes back: a floor 5 cm lower on one side of a 40 cm stool.
    assert margin_m > 0.035 and math.atan2(margin_m, height_m) > math.radians(7)


@pytest.mark.parametrize("name", [n for n in NEW if LIBRARY[n].category == "floor_lamp"])
def test_a_lamp_pushed_five_centimetres_at_half_its_height_does_not_topple(name):
    margin_m, height_m = stance(name)
    top_m = max(p.vertices[:, 1].max() for p in parts_m(name))
    tilt_rad = math.asin(0.05 / (top_m / 2))
    # Tilted about the edge, the centre of mass rises until it stands over it, at atan(margin / height).
    assert math.atan2(margin_m, height_m) > 1.3 * tilt_rad


@pytest.mark.parametrize("category", sorted({LIBRARY[name].category for name in NEW if name in MOVABLE}))
def test_masses_lie_about_their_range_before_they_are_clipped(category):
    material = CATEGORIES[category].material
    assert material is not None
    low, high = material.mass_range_kg
    drawn = [n for n in LIBRARY if LIBRARY[n].category == category and n not in PACKAGED]
    masses = [material.density_kg_m3 * solids(parts_m(n))[0].sum() for n in drawn]
    # Decomposition fills gaps: hulls hold a few times what the parts do where a thing is made of legs or wire.
    assert 0.2 * low < np.median(masses) < high
    assert max(masses) > 0.8 * low and min(masses) < 0.5 * (low + high)


def test_outlines_and_shells_have_the_volumes_of_geometry():
    def volume(*parts: Part) -> float:
        return float(solids(parts)[0].sum())

    assert volume(plate(rectangle(0, 0, 2.0, 1.0), 0.0, 0.5, "oak")) == pytest.approx(1.0)
    assert volume(plate(rectangle(0, 0, 2.0, 1.0, 0.1), 0.0, 0.5, "oak")) == pytest.approx(0.5 * (2.0 - 4 * 0.005))
    # A regular 16-gon in a circle of radius 1: 8 sin(pi / 8).
    assert volume(plate(oval(0, 0, 1.0, 1.0, 16), 0, 1, "oak")) == pytest.approx(8 * math.sin(math.pi / 8))
    assert volume(*turned((0, 0, 0), [(1.0, 0), (1.0, 1.0), (1.0, 3.0)], "oak", 4)) == pytest.approx(2 * 3.0)
    # Walls 0.1 thick along the diagonals: 0.1 / sqrt(2) along the sides of a square.
    inner = 1 - 2 * 0.1 / math.sqrt(2)
    assert volume(*shell(rectangle(0, 0, 1.0, 1.0), 0, 1, 0.1, "oak")) == pytest.approx(1 - inner**2)
    assert volume(ball((0, 0, 0), (0.5, 0.5, 0.5), "leaf", 16)) == pytest.approx(4 / 3 * math.pi * 0.125, rel=0.12)
    assert volume(leaf((0, 0, 0), (0, 0, 1.0), 0.4, "leaf", 0.01)) == pytest.approx(0.5 * 0.4 * 0.01, rel=1e-6)


def test_pieces_lie_where_they_are_put():
    assert block((1, 2, 3), (0.2, 0.4, 0.6), "oak").vertices.min(axis=0) == pytest.approx([0.9, 2.0, 2.7])
    assert np.ptp(rail(0.5, 1.0, 2.0, 0.01, "steel").vertices, axis=0)[0] == pytest.approx(1.0)
    assert np.ptp(beam(0.5, 1.0, 0.3, 0.01, "steel").vertices, axis=0)[2] == pytest.approx(0.6)
    assert pillar((0, 0.2, 0), 0.5, 0.1, "oak").vertices[:, 1].max() == pytest.approx(0.7)
    drawers = fronts((-0.4, 0.1), (0.4, 0.7), 0.25, 2, 3, "oak", "knob")
    assert len(drawers) == 12 and {round(float(p.vertices[:, 0].mean()), 3) for p in drawers} == {-0.2, 0.2}
    assert min(p.vertices[:, 1].min() for p in drawers) > 0.1 and len(fronts((0, 0), (1, 1), 0, 1, 1, "oak", "")) == 1
    sunk = on_floor([block((0, -0.1, 0), (1, 0.3, 1), "oak"), hull(np.eye(3).tolist() + [[0, 0, 0]], "oak")])
    assert sunk[0].vertices[:, 1].min() == 0 and solids(sunk)[0] == pytest.approx([0.2, 1 / 6])


def test_a_row_draws_what_its_shapes_are_called_to_draw():
    rows = (
        ["plate", ["oval", 0, 0, 0.2, 0.1, 8], 0, 0.3, "oak", ["rectangle", 0, 0, 0.5, 0.4]],
        ["turned", [0, 0, 0], [[0.1, 0], [0.2, 0.3], [0.1, 0.5]], "steel", {"sides": 6}],
    )
    drawn = drawn_parts(rows)
    outlines = oval(0, 0, 0.2, 0.1, 8), rectangle(0, 0, 0.5, 0.4)
    called = [plate(outlines[0], 0, 0.3, "oak", outlines[1]),
              *turned((0, 0, 0), [(0.1, 0), (0.2, 0.3), (0.1, 0.5)], "steel", 6)]  # fmt: skip
    assert [p.material for p in drawn] == [p.material for p in called] == ["oak", "steel", "steel"]
    assert all((a.vertices == b.vertices).all() for a, b in zip(drawn, called, strict=True))
