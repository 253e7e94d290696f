"""The exact structure of a furnished home: areas, openings, labels, texels and light."""

from __future__ import annotations

import dataclasses
import functools
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from converters.generate import GENERATOR_VERSION, Building, GenerationError, design_building, render_building
from converters.generate.homes.building import Plan, Rect
from converters.generate.homes.config import HomeConfig, home_config
from converters.generate.models.cad import Instance
from converters.generate.surface.modelled import model_building, space_of
from converters.generate.surface.scan import NYU40, Scan
from converters.generate.surface.sides import FLOOR_M, OTHER, entrance_place, sides_of
from converters.generate.surface.texture import assemble, polygon
from converters.generate.surface.write import annotate_items, write_scan
from converters.pipeline import ConvertConfig, _structure_visual
from converters.read.gibson import read_gibson
from converters.recipes import building_of
from converters.records.errors import SceneRejected
from converters.records.raw import CEILING, FLOOR, STRUCTURE_LABELS, WALL, WINDOW, RawScene, VisualMesh
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.categories import CATEGORIES

SEED = 5
CONFIG = home_config("furnished", {"floor_area_m2": (55.0, 65.0), "n_rooms": (5, 5)})
LAMP, ON_COUNTERS = 35, 40


@functools.cache
def home() -> Building:
    return design_building(SEED, CONFIG)


@functools.cache
def made() -> tuple[Scan, VisualMesh]:
    return render_building(home(), SEED, CONFIG, lambda stage, share: None)


def normals(scan: Scan) -> np.ndarray:
    """(m, 3) of faces, as long as twice their area."""
    a, b, c = (scan.vertices[scan.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def area_of(label: int, axis: int, sign: int, at: float | None = None) -> float:
    """Area of the faces of a label that look along an axis, of those at one height where it is given."""
    scan, n = made()[0], normals(made()[0])
    length = np.linalg.norm(n, axis=1)
    here = (scan.labels[scan.faces[:, 0]] == label) & (sign * n[:, axis] > 0.999 * length)
    if at is not None:
        here &= (np.abs(scan.vertices[scan.faces][:, :, axis] - at) < 1e-6).all(axis=1)
    return float(length[here].sum() / 2)


def test_artefacts_are_a_checked_setting_of_homes_that_recipes_reach():
    assert HomeConfig().artefacts == "none" and home_config("furnished", {"artefacts": "phone"}).artefacts == "phone"
    made_of = building_of("cluttered", {"artefacts": "phone"}, "train", "here")
    assert isinstance(made_of, HomeConfig) and made_of.artefacts == "phone"
    for wrong, told in (("fone", "'fone', expected one of none, phone"), (3, "3, expected one of none, phone")):
        with pytest.raises(GenerationError, match=f"here: artefacts is {told}"):
            building_of("cluttered", {"artefacts": wrong}, "train", "here")
    with pytest.raises(ConfigError, match="did you mean 'phone'"):
        home_config("furnished", {"artefacts": "phon"})
    assert GENERATOR_VERSION == 8


@pytest.mark.heavy
def test_floors_and_ceilings_are_the_plans_and_look_into_the_rooms():
    plan = home().plan
    rooms = sum(r.area_m2 for r in plan.rooms)
    doorways = sum(d.rect.area_m2 for d in plan.doorways)
    assert area_of(FLOOR, 2, 1, FLOOR_M) == pytest.approx(rooms + doorways, abs=1e-6)
    assert area_of(CEILING, 2, -1, plan.wall_height_m) == pytest.approx(rooms, abs=1e-6)
    assert area_of(CEILING, 2, 1) == 0 and area_of(FLOOR, 2, -1) == 0
    tops = sum(w.rect.area_m2 for w in plan.walls)
    assert area_of(WALL, 2, 1, plan.wall_height_m) == pytest.approx(tops, abs=1e-6)


def test_walls_are_cut_where_doorways_and_windows_are():
    scan, plan = made()[0], home().plan
    n = normals(scan)
    flat = scan.labels[scan.faces[:, 0]] == WALL
    for k, room in enumerate(plan.rooms):
        for side in sides_of(room, plan.doorways, plan.windows):
            on = flat & (np.abs(scan.vertices[scan.faces][:, :, side.axis] - side.face) < 1e-6).all(axis=1)
            on &= side.way * n[:, side.axis] > 0
            along = scan.vertices[scan.faces][:, :, 1 - side.axis]
            on &= (along.min(axis=1) > side.start - 1e-6) & (along.max(axis=1) < side.end + 1e-6)
            whole = (side.end - side.start) * plan.wall_height_m
            holes = sum((h.end - h.start) * (h.high - h.low) for h in side.holes())
            assert np.linalg.norm(n[on], axis=1).sum() / 2 == pytest.approx(whole - holes, abs=1e-6)
        assert sum(len(s.doorways) for s in sides_of(room, plan.doorways, ())) == sum(
            k in d.rooms for d in plan.doorways
        )
    # A doorway: at the height of a chest no face lies across it.
    points = scan.vertices[scan.faces].mean(axis=1)
    for d in plan.doorways:
        r = d.rect
        inside = (points[:, :2] > [r.x0 + 0.02, r.y0 + 0.02]) & (points[:, :2] < [r.x1 - 0.02, r.y1 - 0.02])
        assert not (inside.all(axis=1) & (points[:, 2] > 0.02) & (points[:, 2] < 2.0)).any()


def test_each_window_has_a_pane_in_its_wall_and_each_room_a_lamp_above_heads():
    scan, plan = made()[0], home().plan
    labels = scan.labels[scan.faces[:, 0]]
    panes = scan.vertices[scan.faces[labels == WINDOW]].reshape(-1, 3)
    for w in plan.windows:
        mine = panes[((panes > np.array(w.low) - 0.01) & (panes < np.array(w.high) + 0.01)).all(axis=1)]
        for axis in (2, int(w.rect.size[0] > w.rect.size[1]) * -1 + 1):
            assert mine[:, axis].min() == pytest.approx(w.low[axis]), axis
            assert mine[:, axis].max() == pytest.approx(w.high[axis]), axis
    lamps = scan.vertices[scan.faces[labels == LAMP]].reshape(-1, 3)
    assert lamps[:, 2].min() > 2.1
    for r in plan.rooms:
        assert ((lamps[:, 0] > r.x0) & (lamps[:, 0] < r.x1) & (lamps[:, 1] > r.y0) & (lamps[:, 1] < r.y1)).any()


def test_labels_are_of_structure_and_built_in_furniture_and_nothing_movable_is_drawn():
    scan = made()[0]
    per_face = scan.labels[scan.faces]
    assert (per_face == per_face[:, :1]).all()
    built_in = {NYU40[i.model.category] for i in home().plan.built_in}
    assert set(np.unique(scan.labels)) <= {*STRUCTURE_LABELS, LAMP, ON_COUNTERS} | built_in
    assert built_in <= set(np.unique(scan.labels))
    assert any(CATEGORIES[i.model.category].is_object for i in home().items) and (scan.owner == -1).all()
    # What stands on the floor is in its place.
    for item in home().plan.built_in:
        shape = item.model.surface
        placed = item.to_floor(shape.vertices if shape else np.concatenate([p.vertices for p in item.model.parts]))
        own = scan.vertices[scan.labels == NYU40[item.model.category]]
        assert min(np.linalg.norm(own - placed[0], axis=1)) < 1e-6


def test_what_is_on_walls_leaves_rooms_free():
    """Boards, curtains, pictures and towels stay within 6 cm of a wall; only cupboards above robots do not."""
    scan, plan = made()[0], home().plan
    furniture = [NYU40[i.model.category] for i in plan.built_in]
    here = np.isin(scan.labels, sorted({WALL, 16, 11, 38, WINDOW} - {*furniture})) & (scan.vertices[:, 2] < 1.4)
    p = scan.vertices[here]
    deep = np.full(len(p), -np.inf)
    for r in plan.rooms:
        inside = np.minimum.reduce([p[:, 0] - r.x0, r.x1 - p[:, 0], p[:, 1] - r.y0, r.y1 - p[:, 1]])
        deep = np.maximum(deep, inside)
    assert 0.01 < deep.max() <= 0.06 + 1e-9


def test_every_patch_has_texels_of_its_own_and_the_sheet_stays_small():
    scan, atlas = made()
    side = len(atlas.image)
    assert atlas.uv.min() >= 0 and atlas.uv.max() <= 1 and side <= 2048
    uv = atlas.uv[atlas.uv_faces]
    texels = np.abs(np.linalg.det(uv[:, 1:] - uv[:, :1])) * side**2
    length = np.linalg.norm(normals(scan), axis=1)
    floor = scan.labels[scan.faces[:, 0]] == FLOOR
    assert np.sqrt(texels[floor] / length[floor]) == pytest.approx(80, rel=1e-3)
    # No two floors on one texel.
    used = [(uv[k].min(axis=0), uv[k].max(axis=0)) for k in np.flatnonzero(floor).reshape(-1, 2)]
    for i, (low, high) in enumerate(used):
        assert all((low > other).any() or (high < first).any() for first, other in used[:i])
    buffer = io.BytesIO()
    Image.fromarray(atlas.image).save(buffer, "png", optimize=True)
    assert sum(r.area_m2 for r in home().plan.rooms) < 80 and buffer.tell() <= 700 * 1024


def test_corners_are_darker_than_the_middle_and_walls_cast_shadows():
    room = Rect(0.0, 0.0, 4.0, 3.0)
    plan = dataclasses.replace(home().plan, rooms=(room,), outer=Rect(-0.2, -0.2, 4.2, 3.2), walls=(), doorways=(),
                               windows=(), built_in=(), corridor=None, entrance=None)  # fmt: skip
    scan, atlas = model_building(_boxed(plan), [], ["bathroom"], np.random.default_rng(0))
    ceiling = np.flatnonzero(scan.labels == CEILING)
    uv = atlas.uv[ceiling]
    middle, corner = uv.mean(axis=0), uv[0] + 0.02 * (uv.mean(axis=0) - uv[0])
    value = [_texel(atlas, at).sum() for at in (middle, corner)]
    assert value[1] < 0.8 * value[0]
    space = space_of(_boxed(plan))
    at = np.array([[2.0, 1.5, 1.2], [2.0, 0.5, 1.2], [2.0, 1.5, 0.3]])
    assert space.at(at) == pytest.approx([1.2, 0.5, 0.3], abs=0.03)
    seen = space.visible(np.array([[0.2, 0.2, 1.0]] * 2), np.array([[3.8, 2.8, 1.0], [6.0, 2.8, 1.0]]))
    assert seen[0] == 1 and seen[1] == 0


def _texel(atlas: VisualMesh, uv: np.ndarray) -> np.ndarray:
    side = len(atlas.image)
    column, row = (uv * side).astype(int)
    return atlas.image[side - 1 - row, column].astype(int)


def _boxed(plan: Plan) -> Plan:
    """The plan with walls between its rooms' outside and its outline."""
    wall, o, r = type(home().plan.walls[0]), plan.outer, plan.rooms[0]
    boxes = [(o.x0, o.y0, r.x0, o.y1), (r.x1, o.y0, o.x1, o.y1), (r.x0, o.y0, r.x1, r.y0), (r.x0, r.y1, r.x1, o.y1)]
    height = plan.wall_height_m
    return dataclasses.replace(plan, walls=tuple(wall((a, b, 0.0), (c, d, height)) for a, b, c, d in boxes))


def test_the_front_door_is_where_the_plan_has_it():
    door = home().plan.entrance
    assert door is not None
    side, middle = entrance_place(sides_of(home().plan.rooms[door.rooms[0]], (), ()), door)
    assert abs(door.rect.centre[side.axis] - side.face) == pytest.approx(door.rect.size[side.axis] / 2)
    points = made()[0].vertices[made()[0].labels == OTHER]
    out, along = side.way * (points[:, side.axis] - side.face), points[:, 1 - side.axis] - middle
    leaf = points[(out > 0.005) & (out < 0.007) & (abs(along) < 0.5)]
    assert np.ptp(leaf, axis=0)[[1 - side.axis, 2]] == pytest.approx([0.92, 2.04], abs=0.001)


def test_the_same_seed_paints_the_same_bytes():
    again = render_building(home(), SEED, CONFIG, lambda stage, share: None)
    assert (again[1].image == made()[1].image).all() and (again[0].vertices == made()[0].vertices).all()
    assert (again[1].uv == made()[1].uv).all()


def test_a_built_in_models_own_picture_is_drawn_once_for_all_that_have_it():
    plain_model = home().plan.built_in[0].model
    image = np.zeros((256, 256, 3), np.uint8)
    image[:128, :, 0], image[128:, :, 2] = 255, 255
    corners = np.array([[-0.2, -0.1, 0.1], [0.2, -0.1, 0.1], [0.2, 0.1, 0.1], [-0.2, 0.1, 0.1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1]])
    model = dataclasses.replace(plain_model, look=lambda: VisualMesh(corners, faces, uv, faces, image))
    built = tuple(Instance(model, np.ones(3), 0.0, np.array([x, 0.0, 0.5])) for x in (0.0, 1.0))
    plan = dataclasses.replace(home().plan, built_in=built)
    scan, atlas = model_building(plan, home().items, home().uses, np.random.default_rng(0))
    mine = np.flatnonzero(scan.labels == NYU40[model.category])
    assert len(mine) == 8
    first, second = atlas.uv[mine[:4]], atlas.uv[mine[4:]]
    assert (first == second).all()
    assert (first.max(axis=0) - first.min(axis=0)) * len(atlas.image) == pytest.approx([128, 128])
    low, high = first.min(axis=0), first.max(axis=0)
    assert _texel(atlas, low + (high - low) * [0.5, 0.9]).tolist() == [255, 0, 0]
    assert _texel(atlas, low + (high - low) * [0.5, 0.1]).tolist() == [0, 0, 255]
    assert built[1].to_floor(corners) == pytest.approx(scan.vertices[mine[4:]])


def test_a_polygon_is_seen_from_where_it_shall_be_and_is_painted_in_place():
    corners = [(0, 0, 0), (2, 0, 0), (2, 0, 1), (0, 0, 1)]
    for towards in ((0, 1, 0), (0, -1, 0)):
        chart = polygon(corners, towards, WALL, lambda p: np.column_stack([p[:, 0] / 2, p[:, 2], 0 * p[:, 0]]))
        scan, atlas = assemble([chart], lambda points, normals: np.ones((len(points), 3)))
        assert (normals(scan) @ np.array(towards) > 0).all()
        for vertex, uv in zip(scan.vertices, atlas.uv, strict=True):
            inward = uv + 0.01 * (atlas.uv.mean(axis=0) - uv)
            assert _texel(atlas, inward) == pytest.approx([vertex[0] / 2 * 255, vertex[2] * 255, 0], abs=6)


def written(folder: Path) -> RawScene:
    write_scan(folder, *made(), home().floor_height_m)
    (folder / "floors.txt").write_text(f"{home().floor_height_m}\n")
    return read_gibson(folder)


def test_the_folder_says_that_it_shows_no_furniture_and_is_drawn_as_it_is(tmp_path):
    raw, (scan, atlas) = written(tmp_path), made()
    assert not raw.scan.furnished and (raw.scan.labels == scan.labels).all()
    config = ConvertConfig(structure_faces=len(scan.faces), structure_texture=2048)
    level = raw.scan.vertices - [0, 0, home().floor_height_m]
    drawn = _structure_visual(raw, level, np.ones(len(scan.faces), bool), None, (), config)  # pyright: ignore
    assert len(drawn.faces) == len(scan.faces) and (drawn.image == atlas.image).all()
    height = drawn.vertices[drawn.faces][:, :, 2]
    assert height[scan.labels[scan.faces[:, 0]] == FLOOR] == pytest.approx(FLOOR_M, abs=1e-9) and FLOOR_M > 0.001
    for value, told in ((np.array([1.0]), "float64"), (np.array([True, False]), "(2,)")):
        np.savez_compressed(tmp_path / "mesh_z_up.labels.npz", label=scan.labels, furnished=value)
        with pytest.raises(SceneRejected, match=rf"furnished is .*{re.escape(told)}.*expected one true or false"):
            read_gibson(tmp_path)


def test_annotations_of_a_home_whose_furniture_is_not_in_the_scan():
    items = list(home().items)
    found = annotate_items(items, made()[0], home().floor_height_m, CONFIG, SEED, np.random.default_rng(0))
    models = found[0]["aligned_models"]
    assert len(models) == len(items)
    assert all(m["keypoints_cad"]["n_keypoints"] >= 6 for m in models)
