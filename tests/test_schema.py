"""scene.json and maps.npz: round trips, and one clear line for each kind of bad file."""

import dataclasses
import json

import numpy as np
import pytest

from scenes_mjcf import schema


def test_round_trip(room, tmp_path):
    manifest, maps = schema.load_manifest(room), schema.load_maps(room)
    schema.save_manifest(manifest, tmp_path)
    schema.save_maps(maps, tmp_path)
    assert schema.load_manifest(tmp_path) == manifest
    again = schema.load_maps(tmp_path)
    np.testing.assert_array_equal(again.traversable, maps.traversable)
    assert again.origin_w == maps.origin_w and again.resolution_m == maps.resolution_m


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(licnce=d.pop("licence")), "unknown key 'licnce', did you mean 'licence'"),
        (lambda d: d.pop("gates"), "missing key 'gates'"),
        (lambda d: d.update(split="val"), "split is 'val', expected one of train, test"),
        (lambda d: d["objects"][0].update(category="lamp"), "category is 'lamp', expected one of chair"),
        (lambda d: d["objects"][0].update(mass_kg=0), "mass_kg is 0, expected a positive number"),
        (lambda d: d["objects"].append(d["objects"][0]), "two objects share a name"),
        (lambda d: d.update(name="/tmp"), "scene.json: name is '/tmp', expected one folder name"),
        (lambda d: d.update(schema_version=9), "schema_version is 9, expected 1"),
        (lambda d: d.update(objects=None), "objects is null, expected a list"),
        (lambda d: d.update(objects=[1, 2]), r"objects.0.: got 1, expected a mapping"),
        (lambda d: d["objects"][0].update(name=["a"]), r"objects.0.: name is \[\"a\"\], expected a string"),
        (lambda d: d["objects"][0].update(n_hulls=True), r"n_hulls is true, expected a whole number"),
        (lambda d: d["objects"][0].update(mass_kg="5"), r'mass_kg is "5", expected a number'),
        (lambda d: d.update(gates=[]), r"gates is \[\], expected a mapping"),
        (lambda d: d.update(warnings=None), "warnings is null, expected a list"),
        (lambda d: d.update(source="x" * 999), r'source is "x{50,80}\.\.\., expected a mapping'),
    ],
)
def test_bad_manifests_are_named(room, change, message):
    data = json.loads(json.dumps(dataclasses.asdict(schema.load_manifest(room))))
    change(data)
    with pytest.raises(schema.SceneError, match=message):
        schema.manifest_from_dict(data)


def test_missing_unreadable_and_empty_files(tmp_path):
    with pytest.raises(schema.SceneError, match="no such file; expected a scene folder"):
        schema.load_manifest(tmp_path)
    (tmp_path / "scene.json").write_text("{")
    with pytest.raises(schema.SceneError, match="not readable as JSON"):
        schema.load_manifest(tmp_path)
    (tmp_path / "maps.npz").write_bytes(b"PK")
    with pytest.raises(schema.SceneError, match="maps.npz: not readable"):
        schema.load_maps(tmp_path)
    schema.save_maps(schema.SceneMaps(np.zeros((4, 4), bool), 0.05, (0.0, 0.0), 0.0), tmp_path)
    with pytest.raises(schema.SceneError, match="traversable map is empty"):
        schema.load_maps(tmp_path)
    schema.save_maps(schema.SceneMaps(np.ones((4, 4), bool), 0.1, (0.0, 0.0), 0.0), tmp_path)
    with pytest.raises(schema.SceneError, match="resolution is 0.1 m, expected at most 0.05 m"):
        schema.load_maps(tmp_path)


@pytest.mark.parametrize("keep", [0, 3, 60, 300, -30])
def test_a_truncated_map_is_named(room, tmp_path, keep):
    (tmp_path / "maps.npz").write_bytes((room / "maps.npz").read_bytes()[:keep])
    with pytest.raises(schema.SceneError, match=r"maps.npz: not readable .*; convert the scene again"):
        schema.load_maps(tmp_path)


def test_a_damaged_or_odd_map_is_named(room, tmp_path):
    data = bytearray((room / "maps.npz").read_bytes())
    data[len(data) // 3 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 3)
    (tmp_path / "maps.npz").write_bytes(bytes(data))
    with pytest.raises(schema.SceneError, match="maps.npz: not readable"):
        schema.load_maps(tmp_path)
    np.savez(tmp_path / "maps.npz", traversable=np.ones((2, 2), bool), resolution=[1, 2], origin=[0, 0], floor_height=0)
    with pytest.raises(schema.SceneError, match="maps.npz: not readable"):
        schema.load_maps(tmp_path)


@pytest.mark.parametrize(("origin", "floor_height"), [((np.nan, 0.0), 0.0), ((0.0, np.inf), 0.0), ((0.0, 0.0), np.nan)])
def test_a_map_that_lies_nowhere_is_refused(tmp_path, origin, floor_height):
    np.savez(
        tmp_path / "maps.npz",
        traversable=np.ones((2, 2), bool),
        resolution=0.05,
        origin=origin,
        floor_height=floor_height,
    )
    with pytest.raises(schema.SceneError, match="maps.npz: origin is .*expected x, y and a height, finite"):
        schema.load_maps(tmp_path)
