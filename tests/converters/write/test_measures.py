"""Measures of floors and scenes whose values one can work out."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from converters.bodies.objects import PlacedObject
from converters.geometry.boxes import convex_hull
from converters.geometry.density import ROBOTS, Ways, must_push_shares
from converters.records.raw import VisualMesh
from converters.write.emit import SceneParts
from converters.write.manifest import measure_scene, navigation_complexity, shadow, specific_surface_1_m
from interactive_nav_common.grids import clearance
from scenes_mjcf.schema import SceneMaps, load_manifest

CELL_M = 0.05
APARTMENT = Path(__file__).parents[3] / "scenes_mjcf" / "apartment_0"


def two_rooms(left: int = 40, right: int = 20, gap: int = 20) -> np.ndarray:
    """Two rooms 2 m deep with an opening in the wall between them; cells."""
    free = np.ones((40, left + 2 + right), bool)
    free[:, left : left + 2] = False
    free[10 : 10 + gap, left : left + 2] = True
    return free


def box_at(x: float, y: float, size: tuple[float, float, float]) -> PlacedObject:
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation([0, 0, size[2] / 2])
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return PlacedObject(
        "box_0", "box", "x", vertices, faces, np.zeros((len(faces), 3), np.uint8), (convex_hull(vertices),), (),
        np.array([x, y, 0.0]), np.array([1.0, 0, 0, 0]), None,
    )  # fmt: skip


@pytest.mark.parametrize("at", [(-0.4, 1.0), (1.0, -0.4), (2.4, 1.0), (-5.0, 9.0)])
def test_a_thing_beside_the_map_shadows_nothing(at):
    maps = SceneMaps(np.ones((40, 40), bool), CELL_M, (0.0, 0.0), 0.0)
    assert not shadow([box_at(at[0], at[1], (0.4, 0.4, 0.4))], maps).any()
    assert shadow([box_at(1.0, 1.0, (0.4, 0.4, 0.4))], maps).sum() == 64


def for_all(free: np.ndarray) -> dict[str, np.ndarray]:
    return dict.fromkeys(ROBOTS, free)


def test_nothing_must_be_pushed_where_nothing_stands():
    assert must_push_shares(two_rooms(), for_all(two_rooms()), CELL_M) == {"turtlebot": 0.0, "fetch": 0.0}


def test_a_barred_opening_parts_the_pairs_of_two_rooms():
    static, free = two_rooms(), two_rooms()
    free[:, 40:42] = False
    for robot, share in must_push_shares(static, for_all(free), CELL_M).items():
        # Cells along a wall that are too near to it for the disc's middle.
        margin = math.ceil((ROBOTS[robot].radius_m + CELL_M / 2) / CELL_M) - 1
        a, b = (40 - 2 * margin) ** 2, (40 - 2 * margin) * (20 - 2 * margin)
        assert share == pytest.approx(2 * a * b / (a + b) ** 2)


def test_pairs_that_walls_part_do_not_count():
    static = two_rooms(gap=0)
    free = static.copy()
    free[:20, :20] = False
    assert Ways.of(static, CELL_M, 0.18).must_push_share(clearance(free, CELL_M)) == 0.0


def test_a_gap_between_the_robots_widths_bars_the_larger_one_only():
    shares = must_push_shares(two_rooms(gap=20), for_all(two_rooms(gap=10)), CELL_M)
    assert shares["turtlebot"] == 0.0 and shares["fetch"] > 0.2


@given(st.integers(0, 2**32 - 1))
def test_shares_are_shares_and_a_full_floor_has_none(seed):
    rng = np.random.default_rng(seed)
    free = rng.random((40, 40)) < 0.97
    for share in must_push_shares(np.ones_like(free), for_all(free), CELL_M).values():
        assert 0.0 <= share <= 1.0
    assert set(must_push_shares(free & False, for_all(free), CELL_M).values()) == {0.0}


def test_the_shadow_of_a_box_is_its_rectangle():
    maps = SceneMaps(np.ones((40, 60), bool), CELL_M, (-1.0, -0.5), 0.0)
    below = shadow([box_at(0.0, 0.5, (0.4, 0.6, 0.3))], maps)
    assert below.sum() == 8 * 12 and below[14:26, 16:24].all()
    lifted = dataclasses.replace(box_at(0.0, 0.5, (0.4, 0.6, 0.3)), position_w=np.array([0.0, 0.5, 0.5]))
    assert shadow([lifted], maps, 0.6).sum() == 8 * 12 and not shadow([lifted], maps, 0.4).any()


def test_a_cube_has_a_specific_surface_of_six_and_half_of_it_less():
    mesh = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    assert specific_surface_1_m([(vertices, faces)]) == pytest.approx(6.0)
    assert specific_surface_1_m([(2 * vertices, faces)]) == pytest.approx(3.0)
    assert specific_surface_1_m([(vertices, faces), (vertices / 2, faces)]) == pytest.approx(7.5)


def test_complexity_is_one_in_an_empty_room_and_more_round_a_wall():
    empty = np.ones((80, 80), bool)
    assert navigation_complexity(empty, CELL_M, 0.18) == pytest.approx(1.0823922, rel=1e-3)  # eight directions
    walled = empty.copy()
    walled[:60, 38:42] = False
    assert 2.0 < navigation_complexity(walled, CELL_M, 0.18) < 7.0
    assert navigation_complexity(np.zeros((9, 9), bool), CELL_M, 0.18) == 1.0


def test_a_scene_is_measured():
    maps = SceneMaps(np.ones((80, 80), bool), CELL_M, (0.0, 0.0), 0.0)
    thing = box_at(2.0, 2.0, (1.0, 1.0, 1.0))
    flat = np.zeros((1, 3), int)
    surface = VisualMesh(thing.vertices_b, thing.faces, np.zeros((1, 2)), flat, np.zeros((1, 1, 3), np.uint8))
    around = dataclasses.replace(surface, vertices=2.0 * surface.vertices + [2.0, 2.0, 0.0])
    measured = measure_scene(SceneParts("it", (thing,), (), (), around, (surface,)), maps)
    assert measured["movable_share"] == pytest.approx(1 / 16)
    assert measured["must_push_share"] == {"turtlebot": 0.0, "fetch": 0.0}
    assert measured["specific_surface_1_m"] == pytest.approx((24.0 + 6.0) / 8.0)
    assert measured["navigation_complexity"] > 1.08


def test_scenes_without_measures_still_read():
    manifest = load_manifest(APARTMENT)
    assert manifest.name == "apartment_0" and isinstance(manifest.measures, dict)


def test_the_converter_writes_them(tiny_scene):
    folder, converted = tiny_scene
    measures = load_manifest(folder).measures
    assert measures == converted.manifest.measures
    assert set(measures) == {"movable_share", "must_push_share", "specific_surface_1_m", "navigation_complexity"}
    assert 0 < measures["movable_share"] < 1 and measures["specific_surface_1_m"] > 1
