"""Two rooms above one another: each floor becomes a scene with its own faces, objects, map and height."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from converters.pipeline import ConvertConfig, convert, convert_building
from converters.read.gibson import read_gibson
from converters.read.surfaces import split_storeys, storey_of
from converters.records.errors import SceneRejected
from interactive_nav_common.errors import FileError
from scenes_mjcf.schema import load_manifest, load_maps
from tests.converters import tiny_raw

SMALL = ConvertConfig(structure_texture=64, object_texture=32)


def test_heights_belong_to_the_floor_they_stand_on():
    heights = (0.0, 3.0, 6.0)
    np.testing.assert_array_equal(
        storey_of(np.array([-5, 0, 2.7, 2.8, 3, 5.7, 5.8, 99]), heights), [0, 0, 0, 1, 1, 1, 2, 2]
    )


@pytest.fixture(scope="module")
def two_floors(tmp_path_factory):
    root = tiny_raw.write_two_floors(tmp_path_factory.mktemp("floors") / "house")
    half = np.zeros((800, 800), np.uint8)
    half[400:650, 400:550] = 255  # x from 0 to 1.5 m: the map of the upper floor only
    Image.fromarray(half).save(root / "floor_trav_1.png")
    return root


def test_each_floor_is_a_scene_of_its_own(two_floors):
    raw = read_gibson(two_floors)
    lower, upper = split_storeys(raw)
    vertices, faces, labels = tiny_raw.scan()
    for scene, height in ((lower, tiny_raw.FLOOR_M), (upper, tiny_raw.FLOOR_M + 3.0)):
        assert scene.floor_height_m == height and scene.storeys == ()
        np.testing.assert_allclose(scene.scan.vertices - [0, 0, height - tiny_raw.FLOOR_M], vertices, atol=1e-5)
        np.testing.assert_array_equal(scene.scan.faces, faces)
        np.testing.assert_array_equal(scene.scan.labels, labels)
        assert scene.scan.corner_uv is not None and scene.scan.corner_uv.shape == (len(faces), 3, 2)
    assert [a.category for a in lower.annotations] == ["table", "basket"]
    assert [a.category for a in upper.annotations] == ["basket"] and set(upper.cads) == {"basket-a"}
    assert lower.given_map is None and upper.given_map is not None and upper.given_map.traversable.sum() == 250 * 150
    assert (lower.name, upper.name) == ("house_0", "house_1")
    assert split_storeys(lower) == (lower,)


def test_a_building_becomes_one_folder_a_floor(two_floors, tmp_path, hull_cache):
    done = convert_building(two_floors, tmp_path / "home", SMALL, cache=hull_cache)
    assert [d.folder.name for d in done] == ["home_0", "home_1"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["home_0", "home_1"]
    for k, (names, height) in enumerate(((["table_0", "basket_0"], 0.3), (["basket_0"], 3.3))):
        folder = tmp_path / f"home_{k}"
        manifest = load_manifest(folder)
        assert manifest.name == f"home_{k}" and [o.name for o in manifest.objects] == names
        assert f"floor {k} of 2, at {height:g} m of the building's frame" in manifest.warnings
        maps = load_maps(folder)
        assert maps.floor_height_m == height
        # Upstairs the table is not annotated: its legs stay obstacles.
        assert 2.85 * 2.35 - 0.6 * k <= maps.traversable.sum() * 0.05**2 <= 3.0 * 2.5
    with pytest.raises(FileError, match="home_0: exists already"):
        convert_building(two_floors, tmp_path / "home", SMALL, cache=hull_cache)
    with pytest.raises(SceneRejected, match="has 2 floors, expected 1; use convert_building"):
        convert(two_floors, tmp_path / "flat", SMALL, cache=hull_cache)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["home_0", "home_1"]


def test_a_floor_that_fails_leaves_no_other(two_floors, tmp_path, hull_cache):
    labels = np.load(two_floors / "mesh_z_up.labels.npz")["label"]
    half = len(labels) // 2
    broken = tmp_path / "house"
    broken.mkdir()
    for path in two_floors.rglob("*"):
        if path.is_file():
            (broken / path.relative_to(two_floors)).parent.mkdir(parents=True, exist_ok=True)
            (broken / path.relative_to(two_floors)).write_bytes(path.read_bytes())
    upstairs_without_floor = np.where((labels == 2) & (np.arange(len(labels)) >= half), 1, labels)
    np.savez(broken / "mesh_z_up.labels.npz", label=upstairs_without_floor)
    (tmp_path / "scenes").mkdir()
    with pytest.raises(SceneRejected, match="no traversable floor"):
        convert_building(broken, tmp_path / "scenes" / "home", SMALL, cache=hull_cache)
    assert list((tmp_path / "scenes").iterdir()) == []


def test_structure_alone(gibson_raw, tmp_path, hull_cache):
    """No labels, no alignments: what a folder of the full Gibson set holds. The furniture stays as obstacles."""
    (gibson_raw / "mesh_z_up.labels.npz").unlink()
    (gibson_raw / "alignments.json").unlink()
    converted = convert(gibson_raw, tmp_path / "bare", SMALL, cache=hull_cache)
    manifest = load_manifest(tmp_path / "bare")
    assert manifest.objects == () and all(g.passed for g in converted.gates)
    assert "alignments.json is absent: structure only, all furniture stays part of it" in manifest.warnings
    assert "mesh_z_up.labels.npz is absent: floor, walls and ceiling are labelled by shape" in manifest.warnings
    area = load_maps(tmp_path / "bare").traversable.sum() * 0.05**2
    table, basket = 1.0 * 0.6, 0.3 * 0.3
    # Table legs and basket bar their cells; under the table top (0.6 m high) nothing stands either way.
    assert 2.8 * 2.3 - 2 * (table + basket) < area < 3.0 * 2.5 - basket


def test_an_empty_alignment_is_structure_alone(gibson_raw, tmp_path, hull_cache):
    empty = [tiny_raw.annotation()[0] | {"aligned_models": []}]
    (gibson_raw / "alignments.json").write_text(json.dumps(empty))
    convert(gibson_raw, tmp_path / "out", SMALL, cache=hull_cache)
    assert load_manifest(tmp_path / "out").objects == ()
