"""The volumetric network: voxels by hand, labels at vertices, files that the readers take."""

from __future__ import annotations

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from converters.__main__ import main
from converters.propose import retrieval
from converters.propose.proposals import scan2cad_model
from converters.propose.retrieval import read_library
from converters.read.meshes import beside
from converters.read.source import read_source
from converters.records.errors import SceneRejected
from converters.records.raw import ScanMesh
from converters.segment.labelling import label_scan, load_scores, score_source, score_voxels
from converters.segment.voxels import (
    NAMES,
    UNKNOWN,
    Surface,
    at_vertices,
    classes_of,
    intersection_over_union,
    sample_surface,
    voxelise,
)
from tests.converters import tiny_raw

FLOOR, WALL, OTHER = (NAMES.index(name) for name in ("floor", "wall", "other"))


def square(size_m: float = 1.0) -> ScanMesh:
    """A level square of two triangles, coloured from black to white along x."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * size_m
    colours = np.repeat([[0], [255], [255], [0]], 3, axis=1).astype(np.uint8)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return ScanMesh(vertices, faces, labels=np.zeros(4, int), vertex_colours=colours)


def test_ids_become_classes_and_what_is_not_known_stays_so():
    assert classes_of(np.array([0, 1, 2, 11, 39, 38, 5])).tolist() == [
        *(UNKNOWN, WALL, FLOOR, WALL, NAMES.index("basket"), OTHER, NAMES.index("chair"))
    ]


def test_a_surface_is_sampled_evenly_with_its_own_colours():
    found = sample_surface(square(), spacing_m=0.05)
    assert len(found.points) == 400 and np.bincount(found.face).tolist() == [200, 200]
    assert found.normals.tolist() == [[0, 0, 1]] * 400
    assert found.colours is not None and np.allclose(found.colours[:, 0], 255 * found.points[:, 0])
    quadrant = (found.points[:, :2] > 0.5) @ [1, 2]
    assert np.abs(np.bincount(quadrant) - 100).max() <= 6
    grey = dataclasses.replace(square(), vertex_colours=np.full((4, 3), 160, np.uint8))
    assert sample_surface(grey).colours is None


def test_voxels_by_hand():
    points = np.array([[0.0, 0.0, 1.0], [0.02, 0.03, 1.0], [0.05, 0.0, 1.0], [0.0, 0.0, 9.0]])
    normals = np.array([[0.0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 0, 1]])
    colours = np.array([[127.5, 0, 255], [127.5, 0, 255], [255, 255, 255], [0, 0, 0.0]])
    found = voxelise(Surface(points, normals, colours, np.zeros(4, int)), floor_m=1.0)
    assert found.origin.tolist() == pytest.approx([0.0, 0.0, 0.82])
    assert found.index.tolist() == [[0, 0, 4], [1, 0, 4]]
    assert found.of_point.tolist() == [0, 0, 1, -1]
    assert found.features.tolist() == [[64, 0, 64, 0, -127, 127, 127], [0, 0, -127, 127, 127, 127, 127]]


def test_scores_of_points_come_together_at_vertices():
    surface = sample_surface(square(), spacing_m=0.5)
    assert surface.face.tolist() == [0, 0, 1, 1]
    scores = np.array([[0, 1], [0, 1], [3, 0], [3, 0]])
    assert at_vertices(scores, surface, square().faces, 4).tolist() == [[6, 2], [0, 2], [6, 2], [6, 0]]


def test_iou_by_hand():
    truth = np.array([WALL, WALL, FLOOR, FLOOR, UNKNOWN])
    found = np.array([WALL, FLOOR, FLOOR, FLOOR, OTHER])
    assert intersection_over_union(truth, found) == {"wall": 0.5, "floor": 2 / 3}


def by_normal(index, features, shape):
    """Scores of a stand-in for a network: level is floor, steep is wall."""
    out = np.zeros((1, *shape, 80, len(NAMES)), np.float32)
    x, y, z = np.asarray(index)[0].T
    level = np.abs(np.asarray(features)[0, :, 2]) > 90
    out[0, x, y, z, FLOOR], out[0, x, y, z, WALL] = level, ~level
    return jnp.asarray(out)


def test_every_voxel_of_a_long_building_is_scored_once():
    surface = sample_surface(square(8.0), spacing_m=0.02)
    found = score_voxels(voxelise(surface, 0.0), by_normal)
    assert 40000 <= len(found) <= 40401 and (found[:, FLOOR] == 1).all()


def test_the_packaged_network_tells_floor_from_wall(room):
    scores, raw = load_scores(), read_source(room)
    labels = np.where(raw.scan.vertices[:, 2] < -1.2, 2, 1)
    found = score_source(dataclasses.replace(raw, scan=dataclasses.replace(raw.scan, labels=labels)), scores, print)
    assert found["iou"].keys() == {"wall", "floor"} and min(found["iou"].values()) > 0.8
    assert (found["objects"], found["matched"], found["matched_true"]) == (0, 0, 0)


@pytest.fixture
def room(tmp_path):
    box = trimesh.creation.box((4, 3, 2.5)).subdivide_to_size(0.2)
    box.invert()
    box.update_faces(box.triangles_center[:, 2] < 1.2)  # without a ceiling
    box.remove_unreferenced_vertices()
    path = tmp_path / "room.ply"
    box.export(path)
    return path


def test_labels_of_a_room_are_read_back(room):
    raw = read_source(room)
    labels = label_scan(raw, by_normal)
    assert len(labels) == len(raw.scan.vertices) and set(labels.tolist()) == {1, 2}
    np.savez(beside(room, "labels.npz"), label=labels)
    assert np.array_equal(read_source(room).scan.labels, labels)
    np.savez(beside(room, "labels.npz"), label=labels[:-1])
    with pytest.raises(SceneRejected, match="labels for the"):
        read_source(room)


def test_the_command_writes_what_the_reader_takes_and_replaces_nothing(room, capsys):
    words = ["segment", str(room)]
    assert main(words) == 0
    with np.load(beside(room, "labels.npz")) as file:
        assert np.array_equal(read_source(room).scan.labels, file["label"])
    assert main(words) == 2
    assert "give --overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert main(["segment-score", str(room)]) == 0
    assert "mIoU 1.000; wall 1.000, floor 1.000" in capsys.readouterr().out


def test_one_command_makes_a_scene_of_an_unlabelled_mesh_by_the_packaged_weights(room, tmp_path, capsys):
    main(["convert", str(room), str(tmp_path / "scene"), "--segment", "structure_texture=64"])
    scan = read_source(room).scan
    for there, label in ((scan.vertices[:, 2] < -1.2, 2), (np.abs(scan.vertices[:, 2]) < 0.9, 1)):
        assert (scan.labels[there] == label).mean() > 0.8, label
    assert json.loads((tmp_path / "scene" / "scene.json").read_text())["objects"] == []
    before = beside(room, "labels.npz").read_bytes()
    main(["convert", str(room), str(tmp_path / "scene"), "--segment", "structure_texture=64", "--overwrite"])
    assert "is there, kept" in capsys.readouterr().out and beside(room, "labels.npz").read_bytes() == before


def test_models_that_one_command_fitted_are_kept_and_edited(room, tmp_path, capsys):
    floor_m = float(read_source(room).scan.vertices[:, 2].min())
    np.savez(beside(room, "labels.npz"), label=np.where(read_source(room).scan.vertices[:, 2] < floor_m + 0.05, 2, 1))
    words = ["convert", str(room), str(tmp_path / "scene"), "--segment", "--overwrite", "structure_texture=64"]
    main(words)
    kept = room.with_name("room.ply.proposals.json")
    (scan,) = json.loads(kept.read_text())
    assert scan["aligned_models"] == [] and f"{kept.name}: 0 models" in capsys.readouterr().out.replace("\n", "")
    chair = read_library(None)["Scopia_kids_desk_chair"]
    pose = np.ones(3), 0.3, np.array([0.2, -0.1, floor_m - chair.vertices[:, 2].min()])
    model = scan2cad_model("chair", chair.cad_id, pose, chair.vertices) | {"proposal": {"retrieval_confidence": 0.5}}
    edited = json.dumps([scan | {"aligned_models": [model]}])
    kept.write_text(edited)
    main(words)
    made = json.loads((tmp_path / "scene" / "scene.json").read_text())
    assert kept.read_text() == edited and f"{kept.name}: is there, kept" in capsys.readouterr().out.replace("\n", "")
    (row,) = made["alignment"]
    assert (row["cad_id"], row["retrieved_confidence"]) == (chair.cad_id, 0.5) and row["settle_shift_m"] < 0.02
    for wrong in (2.0, float("nan"), "much"):
        model["proposal"] = {"retrieval_confidence": wrong}
        kept.write_text(json.dumps([scan | {"aligned_models": [model]}]))
        assert main(words) == 2 and "aligned_models[0]" in capsys.readouterr().err


def test_files_beside_a_mesh_carry_its_whole_name_and_shorter_names_are_read_where_one_mesh_could_be_meant(room):
    labels = np.ones(len(read_source(room).scan.vertices), np.uint8)
    labels[:7] = 2
    np.savez(room.with_name("room.labels.npz"), label=labels)
    assert np.array_equal(read_source(room).scan.labels, labels)
    assert beside(room, "proposals.json").name == "room.ply.proposals.json"
    other = room.with_name("room.obj")
    trimesh.load(room).export(other)
    assert [beside(path, "labels.npz").name for path in (room, other)] == ["room.ply.labels.npz", "room.obj.labels.npz"]
    assert any("room.ply: has no labels" in warning for warning in read_source(room).warnings)
    other.unlink()
    np.savez(room.with_name("room.ply.labels.npz"), label=3 - labels)
    assert np.array_equal(read_source(room).scan.labels, 3 - labels)


@pytest.mark.heavy
def test_a_scene_in_which_nothing_moves_names_the_next_step_and_segment_what_it_gave_up(
    room, tmp_path, capsys, monkeypatch
):
    few = dict([row for row in retrieval.read_index().items() if row[1].category == "chair"][:2])
    monkeypatch.setattr(retrieval, "read_index", lambda: few)  # each model that is fitted takes a second
    monkeypatch.setattr(retrieval, "MIN_CONFIDENCE", 1.0)  # of two models one is likelier than of all
    words = ["convert", str(room), str(tmp_path / "scene"), "structure_texture=64", "--overwrite"]
    hand = f"python -m converters annotate {room} -o DIR"
    assert main(words) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    first = "no movable object: add --segment to recognise furniture in the scan, or place models by hand with: "
    assert last == first + hand
    x, _, z = read_source(room).scan.vertices.T
    labels = np.where(z < z.min() + 0.05, 2, 1)
    labels[(x > x.max() - 0.05) & (z > z.min() + 0.1)] = 5
    labels[(x < x.min() + 0.05) & (z > z.min() + 0.1)] = 4
    np.savez(beside(room, "labels.npz"), label=labels)
    assert main([*words, "--segment"]) == 0
    said = capsys.readouterr().out.splitlines()
    for line in ("no sure model, so part of the structure: 1 chair", "labelled, and never given a model: bed"):
        assert f"{room}: {line}" in said
    assert f"{room}: place models by hand with: {hand}" in said
    assert said[-1] == f"no movable object: place models by hand with: {hand}"


@pytest.mark.heavy
def test_models_fitted_in_a_building_stand_beside_its_mesh_floor_by_floor(tmp_path, hull_cache, monkeypatch, capsys):
    monkeypatch.setattr("converters.pipeline.cache_folder", lambda: hull_cache)
    house = tiny_raw.write_two_floors(tmp_path / "house")
    (people,) = json.loads((house / "alignments.json").read_text())
    (house / "alignments.json").unlink()
    words = ["convert", str(house), str(tmp_path / "scene"), "--segment", "--overwrite", "structure_texture=64"]
    main(words)
    kept = house / "mesh_z_up.proposals.json"
    (scan,) = json.loads(kept.read_text())
    found = sorted((m["id_cad"], *m["trs"]["translation"]) for m in scan["aligned_models"])
    known = sorted((m["id_cad"], *m["trs"]["translation"]) for m in people["aligned_models"])
    # Upstairs stands a table too, which people left out.
    assert [row[0] for row in found] == ["basket-a", "basket-a", "table-a", "table-a"]
    from_scan = people["trs"]["translation"]
    assert np.allclose([row[1:] for row in found[:3]], np.array([row[1:] for row in known]) - from_scan, atol=0.05)
    assert made_of(tmp_path) == [["basket_0", "table_0"]] * 2
    baskets = [m for m in scan["aligned_models"] if m["id_cad"] == "basket-a"]
    kept.write_text(json.dumps([scan | {"aligned_models": baskets}]))
    main(words)
    assert f"{kept.name}: is there, kept" in capsys.readouterr().out.replace("\n", "")
    assert made_of(tmp_path) == [["basket_0"]] * 2


def made_of(folder):
    """Names of what moves on each floor."""
    scenes = [json.loads((folder / f"scene_{k}" / "scene.json").read_text()) for k in range(2)]
    return [sorted(row["name"] for row in scene["objects"]) for scene in scenes]
