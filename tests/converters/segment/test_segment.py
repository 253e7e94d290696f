"""The volumetric network: voxels by hand, labels at vertices, files that the readers take, a few steps of training."""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from converters.__main__ import main
from converters.generate import GenerationError
from converters.propose import retrieval
from converters.propose.proposals import scan2cad_model
from converters.propose.retrieval import read_library
from converters.read.meshes import beside
from converters.read.source import read_source
from converters.records.errors import SceneRejected
from converters.records.raw import ScanMesh
from converters.segment import labelling
from converters.segment.labelling import VoxelNet, label_scan, load_network, save_network, score_homes, score_voxels
from converters.segment.samples import Crop, building_surface, make_crop, read_crops
from converters.segment.train import HELD_OUT_SEED, SegmentConfig, batch_of, make_step, score_crops, turned
from converters.segment.voxels import (
    FEATURES,
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

TINY = SegmentConfig(widths=(16, 24), side=16, most_voxels=1200, batch=1)
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


def test_a_crop_turned_by_a_quarter_turns_its_normals_too():
    features = np.zeros((1, FEATURES), np.int8)
    features[0, :2] = 127, 3
    crop = Crop(np.array([[5, 2, 9]], np.uint8), features, np.array([1], np.uint8))
    once = turned(crop, 16, 1, mirror=False)
    assert once.index.tolist() == [[13, 5, 9]] and once.features[0, :2].tolist() == [-3, 127]
    back = turned(turned(once, 16, 3, mirror=True), 16, 0, mirror=True)
    assert back.index.tolist() == [[5, 2, 9]] and back.features[0, :2].tolist() == [127, 3]


def stair() -> Crop:
    """A level plate with normals up and an upright one with normals along x."""
    grid = np.stack(np.meshgrid(np.arange(16), np.arange(16), indexing="ij"), axis=-1).reshape(-1, 2)
    plate = np.column_stack([grid, np.full(256, 5)])
    upright = np.column_stack([np.zeros(256, int), grid[:, 0], 6 + grid[:, 1]])
    features = np.zeros((512, FEATURES), np.int8)
    features[:256, 2], features[256:, 0] = 127, 127
    classes = np.repeat([FLOOR, WALL], 256).astype(np.uint8)
    return Crop(np.concatenate([plate, upright]).astype(np.uint8), features, classes)


def test_a_few_steps_learn_one_sample_by_heart_and_weights_keep_it(tmp_path):
    net = VoxelNet(TINY.widths)
    start, step = make_step(net, TINY)
    state = start(jax.jit(net.init)(jax.random.key(0), jnp.zeros((1, 8, 8, 8, FEATURES + 2)))["params"])
    batch, losses = batch_of([stair()], TINY, None), []
    for _ in range(25):
        state, loss = step(state, 3e-3, *batch)
        losses.append(float(loss))
    assert losses[-1] < 0.2 * losses[0]
    assert score_crops(net, state[0], [stair()], TINY) == {"wall": 1.0, "floor": 1.0}
    save_network(tmp_path / "weights.safetensors", net, {"params": state[0]})
    kept, variables = load_network(tmp_path / "weights.safetensors")
    assert kept.widths == (16, 24)
    assert score_crops(kept, variables["params"], [stair()], TINY) == {"wall": 1.0, "floor": 1.0}


@pytest.mark.heavy
def test_crops_of_a_scanned_home_are_seen_in_part():
    surface, classes = building_surface(3, "sparse", "train")
    assert {NAMES[k] for k in np.unique(classes)} >= {"wall", "floor", "sofa", "door"}
    crops = [make_crop(surface, classes, np.random.default_rng(k), 64) for k in range(4)]
    assert all(c.index.max() < 80 and (c.index[:, :2] < 64).all() for c in crops)
    assert len({len(c.index) for c in crops}) == 4
    again = make_crop(surface, classes, np.random.default_rng(2), 64)
    assert np.array_equal(again.index, crops[2].index) and np.array_equal(again.features, crops[2].features)


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


def test_as_many_buildings_are_scored_as_were_asked_for(monkeypatch):
    asked = []

    def building(seed, tier, split):
        asked.append((seed, tier))
        if seed == 8:
            raise GenerationError("its shares are missed")
        surface = sample_surface(square(), spacing_m=0.1)
        return surface, np.full(len(surface.points), FLOOR if seed == 7 else WALL, np.uint8)

    monkeypatch.setattr(labelling, "building_surface", building)
    # All that is level is found as floor: right in the first of two buildings of one size.
    found = score_homes(7, 2, by_normal, lambda stage, share: None)
    assert asked == [(7, "furnished"), (8, "cluttered"), (9, "cluttered")]
    assert found == {"wall": 0.0, "floor": 0.5}


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


def test_the_command_writes_what_the_reader_takes_and_replaces_nothing(room, tmp_path, capsys):
    net = VoxelNet((8,))
    save_network(tmp_path / "w.npz", net, jax.jit(net.init)(jax.random.key(0), jnp.zeros((1, 8, 8, 8, FEATURES + 2))))
    words = ["segment", str(room), "--weights", str(tmp_path / "w.npz")]
    assert main(words) == 0
    with np.load(beside(room, "labels.npz")) as file:
        assert np.array_equal(read_source(room).scan.labels, file["label"])
    assert main(words) == 2
    assert "give --overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert main([*words[:3], str(tmp_path / "none.npz"), "--overwrite"]) == 2
    assert "segment-train" in capsys.readouterr().err


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


@pytest.mark.heavy
def test_training_goes_on_where_it_stopped(tmp_path):
    # The home of seed 30 is a sparse one; what is held out is there already, and is kept.
    kept, held_out = tmp_path / f"run/held_out/{HELD_OUT_SEED}.npz", stair()
    kept.parent.mkdir(parents=True)
    np.savez(kept, lengths=[len(held_out.index)], **vars(held_out))
    words = ["buildings=1", "held_out=1", "crops=2", "side=32", "widths=[8,8]", "batch=1", "workers=1", "save_s=0.5"]
    words += ["seed=30", "most_voxels=4000"]
    assert main(["segment-train", str(tmp_path / "run"), *words, "steps=2"]) == 0
    crops = read_crops(tmp_path / "run/crops/30.npz")
    assert len(crops) == 2 and all(len(c.index) == len(c.classes) for c in crops)
    assert main(["segment-train", str(tmp_path / "run"), *words, "steps=4"]) == 0
    rows = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    steps = [row["step"] for row in rows]
    assert steps == sorted(steps) and steps[-1] == 4 and 2 in steps and np.isfinite(rows[-1]["loss"])
    assert rows[-1]["iou"].keys() == {"wall", "floor", "mean"}
    assert load_network(tmp_path / "run/weights.safetensors")[0].widths == (8, 8)
