"""Runs in half precision: the same loader, nearly the same predictions, refused where they do not fit."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import FileError
from interactive_nav_common.runs.weights import read_weights, write_weights
from topological_nav.__main__ import main
from topological_nav.data.dataset import load_passages, load_rooms
from topological_nav.drives.driving import load_policy
from topological_nav.learn.learning import weights_file
from topological_nav.learn.training import load_networks, load_trained, save_trained
from topological_nav.maps.build import NetworkSight
from topological_nav.maps.graph import load_map, save_map
from topological_nav.weights.export import level_images

pytestmark = pytest.mark.heavy


def words(made, out, *more):
    runs = ["--localiser", str(made.rooms), "--detector", str(made.passages)]
    return ["export", *runs, "--images", str(made.data), "-o", str(out), *more]


def test_matrices_are_stored_in_half_precision_and_nothing_but_weights(made, steered, exported):
    for task, run in (("rooms", made.rooms), ("passages", made.passages), ("policy", steered)):
        (before, _), (after, header) = (
            read_weights(weights_file(folder), FileError, "") for folder in (run, exported / task)
        )
        assert list(before) == list(after) and header["task"] == task
        assert (
            header["digest"] == json.loads((exported / task / "network.json").read_text())["export"]["weights_digest"]
        )
        for name, was in before.items():
            assert after[name].dtype == (np.float16 if was.ndim >= 2 else np.float32)
            np.testing.assert_array_equal(after[name], was.astype(after[name].dtype))
        names = {"weights.safetensors.xz", "network.json", "config.yaml", "versions.json", "results.json"}
        assert {path.name for path in (exported / task).iterdir()} == names
    assert {path.name for path in exported.iterdir()} == {"rooms", "passages", "policy", "maps", "export.json"}
    sizes = [weights_file(folder).stat().st_size for folder in (made.passages, exported / "passages")]
    assert sizes[1] < 0.95 * 0.5 * sizes[0]


def test_an_exported_network_computes_with_its_rounded_weights(made, exported):
    rooms, passages = load_rooms(made.data), load_passages(made.data)
    images = rooms.images[:4, 1].reshape(-1, 32, 32, 3)
    run, half_run = load_trained(made.rooms), load_trained(exported / "rooms")

    def rounded(x):
        x = np.asarray(x)
        return jax.numpy.asarray(x.astype(np.float16).astype(np.float32) if x.ndim > 1 else x)

    oracle = dataclasses.replace(run, variables=jax.tree.map(rounded, run.variables))
    np.testing.assert_array_equal(half_run.embed(images), oracle.embed(images))
    assert 0 < np.linalg.norm(half_run.embed(images) - run.embed(images), axis=-1).max() < 0.02
    judged = [load_trained(path).logits(passages.images) for path in (made.passages, exported / "passages")]
    p = 1 / (1 + np.exp(-np.array(judged, float)))
    assert 0 < np.abs(p[0] - p[1]).max() < 0.02
    about = json.loads((exported / "export.json").read_text())["compared"]
    assert about["largest_probability_difference"] < 0.02 and about["same_passage"] > 0.95
    assert half_run.about["digest"] == run.about["digest"]
    assert (run.stored, half_run.stored) == (run.about["digest"], f"{run.about['digest']}-fp16")


def test_maps_and_networks_fit_across_precisions(made, exported):
    maps = load_map(made.map), load_map(exported / "maps" / "painted.npz", load_scene(made.scene).digest)
    np.testing.assert_array_equal(maps[1].embeddings, maps[0].embeddings.astype(np.float16).astype(np.float32))
    assert maps[1].embeddings.dtype == np.float32
    np.testing.assert_array_equal(maps[1].p, maps[0].p)
    images = load_rooms(made.data).images[::7, 1, ::5].reshape(-1, 32, 32, 3)
    heading = np.tile(np.arange(0, 18, 5) * np.deg2rad(20), len(images) // 4)
    found = [
        NetworkSight(one, load_networks(home / "rooms", home / "passages")).distances(images, heading)
        for one in maps
        for home in (made.rooms.parent, exported)
    ]
    for other in found[1:]:
        assert other == pytest.approx(found[0], abs=0.02)
        assert (other.argmin(1) == found[0].argmin(1)).mean() > 0.9


def test_the_exported_policy_finds_its_networks_and_drives_the_same(made, steered, exported):
    images = load_rooms(made.data).images[:6, 1]
    said = []
    for policy in (load_policy(steered), load_policy(exported / "policy")):
        state, commands = policy.start(6), []
        for step in range(18):
            state, *command = policy.act(state, images[:, step])
            commands.append(command)
        said.append(np.array(commands))
    assert (said[0] == said[1]).mean() > 0.95 and len(np.unique(said[0])) > 1


def test_it_says_where_everything_comes_from(made, exported):
    about = json.loads((exported / "export.json").read_text())
    for task, run in (("rooms", made.rooms), ("passages", made.passages)):
        versions = json.loads((run / "versions.json").read_text())
        row = about["networks"][task]
        assert row["digest"] == load_trained(run).about["digest"] and row["device"] == versions["device"]["kind"]
        assert row["commit"] == (versions["commit"] or "toy")
        stored = json.loads((exported / task / "versions.json").read_text())
        assert stored["packages"] == versions["packages"] and not any("/tmp" in word for word in stored["argv"])
        assert (exported / task / "config.yaml").read_bytes() == (run / "config.yaml").read_bytes()
        assert (exported / task / "results.json").read_bytes() == (run / "results.json").read_bytes()
    made_map = load_map(made.map)
    assert about["maps"]["painted"] == {
        "scene_digest": made_map.digest,
        "nodes": len(made_map.xy_w),
        "edges": len(made_map.edges),
    }


def test_an_export_is_replaced_and_another_folder_is_not(made, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(words(made, out, "commit=toy")) == 0
    (out / "stale").write_text("of the last one")
    assert main(words(made, out, "commit=toy")) == 0
    assert {path.name for path in out.iterdir()} == {"rooms", "passages", "export.json"}
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine").write_text("kept")
    assert main(words(made, other, "commit=toy")) == 2
    assert "is something else than an export" in capsys.readouterr().err and (other / "mine").exists()


def test_predictions_that_differ_are_refused(made, tmp_path, capsys):
    assert main(words(made, tmp_path / "out", "tolerance=1e-9", "commit=toy")) == 2
    assert "fp16 changes the predictions: largest_embedding_distance" in capsys.readouterr().err


def test_what_does_not_belong_is_refused(made, tmp_path, capsys):
    def told(*line):
        assert main(list(line)) == 2
        return capsys.readouterr().err.splitlines()[-1]

    (tmp_path / "maps").mkdir()
    own = load_map(made.map)
    save_map(dataclasses.replace(own, about={**own.about, "detector": "0" * 64}), tmp_path / "maps" / "painted.npz")
    out = tmp_path / "out"
    assert "built with another detector" in told(*words(made, out, "--maps", str(tmp_path / "maps"), "commit=toy"))
    (tmp_path / "none").mkdir()
    assert "holds no map; make some" in told(*words(made, out, "--maps", str(tmp_path / "none"), "commit=toy"))
    assert "is no dataset or scene whose images" in told(*words(made, out), "--images", str(tmp_path))
    assert "expected a run of 'train rooms'" in told(*words(made, out), "--localiser", str(made.passages))
    nameless = tmp_path / "rooms"
    shutil.copytree(made.rooms, nameless)
    versions = json.loads((nameless / "versions.json").read_text())
    (nameless / "versions.json").write_text(json.dumps({**versions, "commit": None}))
    assert "names no commit; say commit=HASH" in told(*words(made, out), "--localiser", str(nameless))
    assert not out.exists()


def test_weights_that_were_not_exported_with_it_are_refused(made, exported, tmp_path):
    shutil.copytree(exported / "rooms", tmp_path / "rooms")
    tensors, header = read_weights(made.rooms / "weights.safetensors", FileError, "")
    write_weights(tmp_path / "rooms" / "weights.safetensors.xz", tensors, header)
    with pytest.raises(FileError, match=r"is not the file that was exported with its network.json"):
        load_trained(tmp_path / "rooms")


def test_a_network_trained_on_from_an_export_is_a_run_of_its_own(exported, tmp_path):
    begun = load_trained(exported / "rooms")
    saved = save_trained(tmp_path / "run", begun)
    assert "export" not in saved.about and saved.about["digest"] != begun.about["digest"]
    assert load_trained(tmp_path / "run").stored == saved.about["digest"]


def test_images_of_a_scene_are_drawn_around_free_places(made):
    networks = load_networks(made.rooms, made.passages)
    images = level_images(made.scene, networks, 2)
    assert images.shape == (2, 18, 32, 32, 3) and images.dtype == np.uint8
    assert images.std((1, 2, 3)).min() > 3
    np.testing.assert_array_equal(level_images(made.scene, networks, 2), images)
    level = load_rooms(made.data).images[:, 1]
    # Of a dataset: evenly from the first to the last.
    assert (level_images(made.data, networks, 2) == level[[0, -1]]).all()
