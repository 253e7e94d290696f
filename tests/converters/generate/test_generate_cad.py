"""The CAD library and the volume code: drawings in, properties of models and surfaces checked."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from converters.generate.homes.config import HomeConfig
from converters.generate.homes.plans import home_plan
from converters.generate.models.cad import (
    HOME_TEST_MODELS,
    HOME_TRAIN_MODELS,
    LIBRARY,
    LOOKS,
    Models,
    _painted,
    cad_model,
    place,
    tints,
)
from converters.generate.models.parts import MATERIALS, bar, box
from converters.generate.surface.scan import (
    Scan,
    Volume,
    building_solids,
    fuse,
    solid_from_box,
    solid_from_mesh,
    surface_nets,
)
from converters.generate.surface.texture import assemble, pack_rows, paint, piece_charts
from converters.generate.surface.write import write_cad
from converters.read.annotations import read_cad
from converters.read.files import SourceFolder
from converters.records.raw import VisualMesh
from interactive_nav_common.rotations import Y_UP_TO_Z_UP
from scenes_mjcf.categories import CATEGORIES
from scenes_mjcf.look import GLASS

DRAWN = sorted(name for name in LIBRARY if "/" not in name)


@pytest.mark.parametrize("name", [*DRAWN, *sorted(set(LIBRARY) - set(DRAWN))[::9]])
def test_model_is_normalised_and_made_of_closed_convex_parts(name):
    model = cad_model(name)
    assert np.linalg.norm(2 * model.half_extents) == pytest.approx(1.0, abs=1e-4)
    assert np.abs(model.center).max() <= 0.031  # off the box centre, but not by much
    assert len(model.id_cad) == 32 and model.catid == CATEGORIES[model.category].synset
    for part in model.parts:
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
        assert part.material in MATERIALS
        # Convex: no vertex lies outside any face's plane.
        solid = solid_from_mesh(part.vertices, part.faces, 1, part.material, 0)
        assert solid.distance(part.vertices).max() < 1e-4


def test_held_out_models_are_apart_and_drawn_doors_are_in_both_splits():
    assert set(HOME_TRAIN_MODELS).isdisjoint(HOME_TEST_MODELS)
    for names, mine in ((HOME_TRAIN_MODELS, "plant_snake"), (HOME_TEST_MODELS, "plant_monstera")):
        packaged = {LIBRARY[n].category for n in names if "/" in n}
        assert mine in names and "door" not in packaged and {"chair", "sofa", "bed", "table"} <= packaged
    doors = [[n for n in names if LIBRARY[n].category == "door"] for names in (HOME_TRAIN_MODELS, HOME_TEST_MODELS)]
    assert doors == [["door_panel", "door_flush", "door_three"], ["door_dark", "door_battens"]]
    assert len({cad_model(n).id_cad for n in LIBRARY}) == len(LIBRARY)


@pytest.mark.parametrize("name", ["Scopia/puff", "Scopia/armchair2", "bag_tote", "plant_snake"])
def test_a_tint_is_the_same_model_in_another_colour(name):
    model, tinted = cad_model(name), cad_model(f"{name}~navy")
    assert tinted.name == f"{name}~navy" and tinted.id_cad != model.id_cad and tinted.unit_m == model.unit_m
    for part, other in zip(model.parts, tinted.parts, strict=True):
        np.testing.assert_array_equal(part.vertices, other.vertices)
    if tinted.surface is None:
        changed = {(a.material, b.material) for a, b in zip(model.parts, tinted.parts, strict=True)}
        main = {"bag_tote": "linen", "plant_snake": "ceramic"}[name]
        assert (main, "navy") in changed and all(a == b for a, b in changed - {(main, "navy")})
    else:
        assert model.surface is not None
        image = tinted.surface.image.reshape(-1, 3).astype(float)
        hue = np.array(MATERIALS["navy"]) / np.linalg.norm(MATERIALS["navy"])
        like = image @ hue / np.maximum(np.linalg.norm(image, axis=1), 1)
        assert np.mean(like > 0.98) > 0.4  # its cloth; other parts stay as they are
        assert cad_model(f"{name}~navy").surface is tinted.surface


def test_a_tint_keeps_legs_and_shades():
    # A grey square of two shades with a red leg, turned blue: light stays lighter than dark, red stays.
    image = np.full((2, 4, 3), 120, np.uint8)
    image[:, 1], image[:, 3] = 140, (200, 20, 20)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    uv = np.array([[0.1, 0.5], [0.35, 0.5], [0.6, 0.5], [0.9, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 1, 1]])
    surface = VisualMesh(corners, faces, uv, np.array([[0] * 3, [1] * 3, [2] * 3, [3] * 3]), image)
    painted = _painted(surface, np.array([0.1, 0.2, 0.6]))
    assert (painted[:, 3] == image[:, 3]).all() and (painted[:, 1] > painted[:, 0]).all()
    np.testing.assert_allclose(painted[0, 0] / 255, [0.1, 0.2, 0.6], atol=0.06)


def test_tints_and_roles_name_what_there_is():
    assert {m for names in LOOKS.tints.values() for m in names} <= set(MATERIALS)
    assert set(LOOKS.tints) <= set(CATEGORIES)
    # Six differ, so that models which look different still do; a chair in one of the first two is not white or brown.
    assert all(len(set(p)) == 6 and set(p) <= set(MATERIALS) for p in LOOKS.palettes)
    assert not {m for p in LOOKS.palettes for m in p[:2]} & {"white", "walnut", "charcoal"}
    assert {n for names in LOOKS.roles.values() for n in names} <= set(LIBRARY)


def test_homes_have_six_models_of_each_of_the_commonest_categories():
    # Of 43 homes, commonest first.
    common = (
        *("radiator", "chair", "door", "counter", "plant", "bag", "bin", "stool", "laundry_basket", "nightstand"),
        *("box", "bed", "bookcase", "suitcase", "wardrobe", "pouf", "armchair", "toilet", "washbasin", "dresser"),
    )
    for category in common:
        assert sum(len(tints(n)) for n in HOME_TRAIN_MODELS if LIBRARY[n].category == category) >= 6, category


def test_models_of_a_home_are_apart_by_role_and_what_is_spent_is_not_drawn():
    rng, models = np.random.default_rng(0), Models(HOME_TRAIN_MODELS, 0.0)
    drawn = [models.draw("chair", rng, role="office")[0].name for _ in range(24)]
    assert {name.partition("~")[0] for name in drawn} == {"Scopia/office_chair", "Scopia/tubular_chair"}
    assert len(set(drawn)) >= 10
    plain = {models.draw("chair", rng)[0].name.partition("~")[0] for _ in range(60)}
    assert len(plain) > 15 and not plain & {n for names in LOOKS.roles.values() for n in names}
    models.spent = {"bag_tote", *tints("bag_backpack")}
    bags = {models.draw("bag", rng)[0].name for _ in range(40)}
    assert "bag_tote" not in bags and {n.partition("~")[0] for n in bags} == {"bag_tote", "BlendSwap-CC-0/handbag"}
    assert models.has("table", "bar") and not models.has("table", "child bar")
    tint = models.draw("counter", rng)[0].name.partition("~")[2]
    assert {models.draw("counter", rng)[0].name.partition("~")[2] for _ in range(8)} == {tint}
    assert models.draw("sink", rng)[0].name.partition("~")[2] == tint


def test_a_library_model_is_written_with_its_texture_and_its_hulls(tmp_path):
    model = cad_model("Scopia/chair")
    write_cad(tmp_path / "cad", model)
    read = read_cad(SourceFolder(tmp_path), model.catid, model.id_cad)
    assert model.surface is not None and read.surface is not None and read.pieces is not None
    np.testing.assert_array_equal(read.surface.texture, model.surface.image)
    assert len(read.surface.faces) == len(model.surface.faces) and len(read.pieces) == len(model.parts)
    for (vertices, _), part in zip(read.pieces, model.parts, strict=True):
        np.testing.assert_allclose(
            np.sort(vertices, axis=0), np.sort(part.vertices @ Y_UP_TO_Z_UP.T, axis=0), atol=2e-6
        )


def test_written_obj_loads_with_the_same_bounds(tmp_path):
    model = cad_model("dresser_tall")
    write_cad(tmp_path, model)
    (path,) = tmp_path.rglob("model_normalized.obj")
    assert path.parts[-3] == model.id_cad
    mesh = trimesh.load(path, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    np.testing.assert_allclose(mesh.bounds, model.bounds, atol=1e-5)
    assert len(mesh.faces) == sum(len(p.faces) for p in model.parts)


def test_bar_has_the_volume_of_a_prism():
    # A square prism of circumradius r has the base area 2 r^2: here 2 * 0.1^2 * 0.5 = 0.01.
    part = bar((0, 0, 0), (0, 0.5, 0), 0.1, "oak", sides=4)
    assert trimesh.Trimesh(part.vertices, part.faces).volume == pytest.approx(0.01)


def test_signed_distance_of_a_tilted_box_is_exact_beside_its_faces():
    part = box((0, 1.0, 0), (0.4, 0.2, 0.6), "oak", tilt_rad=0.0)
    solid = solid_from_mesh(part.vertices, part.faces, 5, "oak", 0)
    assert len(solid.normals) == 6  # twelve triangles, six planes
    points = np.array([[0.0, 1.0, 0.0], [0.3, 1.0, 0.0], [0.0, 1.0, 0.5]])
    np.testing.assert_allclose(solid.distance(points), [-0.1, 0.1, 0.2], atol=1e-9)


def test_surface_nets_of_a_box_is_closed_outward_and_about_the_right_size():
    solid = solid_from_box((0, 0, 0), (1.0, 0.6, 0.4), 1, "paint")
    volume = fuse([solid], np.full(3, -0.11), np.array([1.11, 0.71, 0.51]), 0.02)
    vertices, faces = surface_nets(volume)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    # 1.0 * 0.6 * 0.4 = 0.24; rounded edges take a little.
    assert 0.235 < mesh.volume < 0.2405
    assert np.abs(solid.distance(vertices)).max() < 0.02


def test_union_of_overlapping_solids_is_one_surface():
    a = solid_from_box((0, 0, 0), (0.5, 0.5, 0.5), 1, "paint")
    b = solid_from_box((0.3, 0, 0), (0.9, 0.5, 0.5), 1, "paint")
    mesh = trimesh.Trimesh(*surface_nets(fuse([a, b], np.full(3, -0.11), np.full(3, 1.01), 0.025)))
    assert mesh.body_count == 1
    assert mesh.volume == pytest.approx(0.9 * 0.5 * 0.5, rel=0.02)


def test_sample_reads_the_nearest_voxel():
    sdf = np.arange(8, dtype=np.float32).reshape(2, 2, 2)
    volume = Volume(sdf, np.array([1.0, 0.0, 0.0]), 0.5)
    # index (1, 0, 1) is 1 * 4 + 0 * 2 + 1 = 5
    np.testing.assert_array_equal(volume.sample(np.array([[1.6, 0.1, 0.4], [1.0, 0.0, 0.0]])), [5, 0])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 30)), min_size=1, max_size=40))
def test_packed_rectangles_do_not_overlap(sizes):
    table = np.array(sizes)
    corner, used = pack_rows(table, 64)
    sheet = np.zeros((used, 64), int)
    for (x, y), (w, h) in zip(corner, table, strict=True):
        assert x + w <= 64 and y + h <= used
        sheet[y : y + h, x : x + w] += 1
    assert sheet.max() == 1 and sheet.sum() == table.prod(axis=1).sum()


def test_a_scan_shows_a_library_model_in_the_colours_of_its_texture():
    name = next(n for n in HOME_TRAIN_MODELS if cad_model(n).surface is not None)
    model = cad_model(name)
    surface = model.surface
    assert surface is not None
    plan, uses = home_plan(HomeConfig(), np.random.default_rng(0))
    item = place(model, model.unit_m * np.array([1.05, 0.95, 1.0]), np.array(plan.rooms[0].centre), 0.7)
    solids = building_solids(plan, [item])
    own = next(k for k, s in enumerate(solids) if s.item is item)
    points = item.to_floor(surface.vertices[surface.faces].mean(axis=1))
    faces = np.arange(3 * len(points)).reshape(-1, 3)
    scan = Scan(item.to_floor(surface.vertices[surface.faces].reshape(-1, 3)), faces, np.zeros(faces.size, np.uint8),
                np.full(faces.size, own), tuple(solids))  # fmt: skip
    got = paint(scan, plan.rooms, uses, points, np.arange(len(points)), np.random.default_rng(0))
    uv = surface.uv[surface.uv_faces].mean(axis=1)
    height, width = surface.image.shape[:2]
    at = np.clip([(1 - uv[:, 1]) * height, uv[:, 0] * width], 0, [[height - 1], [width - 1]]).astype(int)
    want = surface.image[at[0], at[1]] / 255
    brightness = got.sum(axis=1) / np.maximum(want.sum(axis=1), 1e-3)
    off = np.abs(got / np.maximum(brightness, 1e-3)[:, None] - want).max(axis=1)
    assert np.median(off) < 0.03 and 0.6 < np.median(brightness) < 1.2


def test_glass_is_drawn_in_its_one_colour_however_dark_it_is():
    pane = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]), np.array([[0, 1, 2], [0, 2, 3]])
    charts = [*piece_charts(*pane, 38, "glass"), *piece_charts(*pane, 38, "white")]
    _, atlas = assemble(charts, lambda points, normals: np.full((len(points), 3), 0.5))
    middle = (np.array([1, -1]) * atlas.uv.reshape(2, 4, 2).mean(axis=1) + [0, 1]) * len(atlas.image)
    glass, white = (atlas.image[int(row), int(column)] for column, row in middle)
    assert tuple(glass) == GLASS == tuple(round(255 * v) for v in MATERIALS["glass"])
    assert np.abs(white - 127.5 * np.array(MATERIALS["white"])).max() < 3
