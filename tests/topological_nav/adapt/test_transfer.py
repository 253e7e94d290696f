"""Transfer of the toy scene's networks to another camera, and of its map; all on the shared fixtures' dataset."""

import json
import shutil
import signal
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import ConfigError, FileError
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.records import read_metrics
from interactive_nav_common.runs.folder import run_epochs
from topological_nav import adaptation
from topological_nav.__main__ import main
from topological_nav.data.dataset import load_passages, load_rooms
from topological_nav.data.domains import AdaptConfig
from topological_nav.learn.training import load_trained, localisation
from topological_nav.maps.graph import load_map

SHORT = AdaptConfig(domain="light", epochs=2, hidden=16, fine_tune=40, test=20, fine_tune_epochs=2)


def weights(run):
    return load_trained(run).variables


def same(a, b):
    return all(jax.tree.leaves(jax.tree.map(lambda x, y: bool((np.asarray(x) == np.asarray(y)).all()), a, b)))


@pytest.fixture(scope="module")
def alexnet(made, tmp_path_factory):
    """A localiser that compiles fast: three epochs of AlexNet."""
    out = tmp_path_factory.mktemp("transfer") / "alexnet"
    words = ["network=alexnet", "width=4", "hidden=16", "epochs=3", "batch=32", "learning_rate=1e-3"]
    assert main(["train", "rooms", "--data", str(made.data), "-o", str(out), *words]) == 0
    return out


@pytest.fixture(scope="module")
def adapted(made, alexnet, tmp_path_factory):
    out = tmp_path_factory.mktemp("transfer") / "features"
    results = adaptation.adapt_features(alexnet, made.data, made.data, out, SHORT)
    assert results is not None
    return out, results


def test_localisation_on_nodes_of_the_same_domain_is_what_training_says(made):
    trained, rooms = load_trained(made.rooms), load_rooms(made.data)
    between = adaptation.localisation_between(trained, rooms, trained, rooms)
    within = localisation(trained, rooms)
    assert between["painted"] == within["painted"] and between["mean"] == pytest.approx(within["mean"])
    assert between["queries"] == 6 * rooms.test.sum()


def test_without_a_scene_in_common_there_is_nothing_to_score(made):
    trained, rooms = load_trained(made.rooms), load_rooms(made.data)
    other = rooms.__class__(**{**vars(rooms), "names": tuple(f"x{n}" for n in rooms.names)})
    with pytest.raises(FileError, match="no scene in common"):
        adaptation.localisation_between(trained, rooms, trained, other)


def test_the_sources_statistics_return_where_the_target_is_the_source(made):
    """Batch statistics of the images that they were learned from change little; of dark ones they move."""
    trained, rooms = load_trained(made.rooms), load_rooms(made.data)
    images = rooms.images[~rooms.test].reshape(-1, *rooms.images.shape[3:])
    moved = [adaptation.target_statistics(trained, x, 50).variables for x in (images, images // 4)]
    first = lambda v: np.asarray(jax.tree.leaves(v["batch_stats"])[0])  # noqa: E731
    own, near, far = (first(v) for v in (trained.variables, *moved))
    assert np.abs(near - own).max() < 0.3 * np.abs(far - own).max()
    assert same(trained.variables["params"], moved[1]["params"])


def test_the_game_moves_the_target_onto_the_source(monkeypatch):
    """An extractor of one weight must learn to undo a factor of 3."""
    monkeypatch.setattr(
        adaptation, "embed_training", lambda network, v, x: (x * v["params"]["gain"][None], v["batch_stats"])
    )
    config = AdaptConfig(learning_rate=0.02, critic_learning_rate=0.02, hidden=16, batch=50)
    rng = np.random.default_rng(0)
    source = rng.normal([1.0, 2.0], 0.1, (400, 2)).astype(np.float32)
    target = 3.0 * rng.normal([1.0, 2.0], 0.1, (400, 2)).astype(np.float32)
    variables = {"params": {"gain": jnp.ones(2)}, "batch_stats": {}}
    state, critic = adaptation.make_adapting(variables, 2, config)
    epoch: Any = adaptation.adversarial_epoch(None, critic, config)  # type: ignore[arg-type]
    accuracy = []
    for number in range(20):
        state, told = epoch(state, jnp.asarray(target), jnp.asarray(source), jax.random.PRNGKey(number))
        accuracy.append(float(told["critic_accuracy"]))
    assert max(accuracy[:3]) > 0.8  # told apart at first
    assert np.asarray(state.params["gain"]) == pytest.approx([1 / 3, 1 / 3], abs=0.1)
    assert abs(np.mean(accuracy[-5:]) - 0.5) < 0.2
    assert float(variables["params"]["gain"][0]) == 1.0  # the source's stays


def test_adapted_networks_are_runs_of_their_own(made, adapted, alexnet):
    out, results = adapted
    trained, source = load_trained(out), load_trained(alexnet)
    assert trained.about["adapted_from"] == source.about["digest"] != trained.about["digest"]
    assert trained.about["domain"]["contrast"] == 1.25
    assert not same(trained.variables["params"]["body"], source.variables["params"]["body"])
    # The heads stay the source's.
    assert same(trained.variables["params"]["last"], source.variables["params"]["last"])
    assert results == json.loads((out / "results.json").read_text())
    assert results["nodes"] == "of the source"
    rooms = load_rooms(made.data)
    assert results["target_images"] == 54 * (~rooms.test).sum()
    assert results["before"]["queries"] == results["after"]["queries"] == 6 * rooms.test.sum()
    # AlexNet has no batch normalisation: statistics alone change nothing.
    assert results["statistics"] == results["before"]
    assert [line["epoch"] for line in read_metrics(out / "metrics.jsonl")] == [1, 2]


@pytest.mark.heavy
def test_a_stopped_adaptation_goes_on_to_the_same_weights(made, alexnet, adapted, tmp_path, stop_after, capsys):
    out = tmp_path / "stopped"
    places = alexnet, made.data, made.data, out, SHORT
    stop_after(1)
    with pytest.raises(Stopped):
        adaptation.adapt_features(*places)
    (told,) = capsys.readouterr().out.splitlines()
    assert "epoch 1 of 2" in told and not (out / "network.json").exists()
    assert adaptation.adapt_features(*places) is not None
    assert same(weights(out), weights(adapted[0]))
    assert [line["epoch"] for line in read_metrics(out / "metrics.jsonl")] == [1, 2]


def counting(out, epochs, stop_after=None):
    """A learner that counts: 1, then twice as much and one more for every epoch."""
    told = []

    def epoch(learner, number, key):
        del number, key
        told.append(1)
        if len(told) == stop_after:
            signal.raise_signal(signal.SIGTERM)
        return {"n": 2 * learner["n"] + 1}, {"loss": learner["n"].astype(float)}

    start = {"n": np.array(1)}
    try:
        learner = run_epochs(out, "count", start, epoch, epochs, jax.random.PRNGKey(0))
    except Stopped as stopped:
        return f"stopped by signal {stopped.args[0]}", len(told)
    return int(learner["n"]), len(told)


def test_epochs_go_on_where_they_stopped_and_lines_that_were_lost_are_written_again(tmp_path):
    out = tmp_path / "stopped"
    out.mkdir()
    assert counting(out, 4, stop_after=2) == ("stopped by signal 15", 2)
    # As if killed after a line was written and before its checkpoint.
    with open(out / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"phase": "count", "epoch": 3, "loss": 99.0}) + "\n")
        file.write(json.dumps({"phase": "other", "epoch": 9, "loss": 1.0}) + "\n")
    assert counting(out, 4) == (31, 2)
    lines = [(line["phase"], line["epoch"], line["loss"]) for line in read_metrics(out / "metrics.jsonl")]
    assert lines == [("count", 1, 1.0), ("count", 2, 3.0), ("other", 9, 1.0), ("count", 3, 7.0), ("count", 4, 15.0)]
    assert counting(out, 4) == (31, 0)
    (out / "checkpoint.msgpack").write_bytes(b"no")
    with pytest.raises(FileError, match="not readable"):
        counting(out, 4)


@pytest.fixture(scope="module")
def configurations(made, tmp_path_factory):
    out = tmp_path_factory.mktemp("transfer") / "passages"
    results = adaptation.passage_configurations(made.passages, made.data, out, SHORT)
    assert results is not None
    return out, results


def test_the_four_configurations_differ_in_what_they_learned_from(made, configurations):
    out, results = configurations
    assert (results["fine_tuned_on"], results["tested_on"]) == (40, 20)
    for name in "ABCD":
        row = results[name]
        assert np.sum(row["confusion"], axis=1).tolist() == [10, 10]
        assert row["accuracy"] == pytest.approx(np.trace(row["confusion"]) / 20)
    lines = read_metrics(out / "metrics.jsonl")
    assert [(line["phase"], line["epoch"]) for line in lines] == [("B", 1), ("B", 2), ("D", 1), ("D", 2)]
    # D is what the run leaves: the source's weights, moved a little.
    mine, source = load_trained(out), load_trained(made.passages)
    assert mine.about["adapted_from"] == source.about["digest"] and mine.about["task"] == "passages"
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), mine.variables["params"], source.variables["params"])
    assert 0 < max(jax.tree.leaves(moved)) < 0.05


def test_what_learned_from_the_source_scores_there_as_before(made, tmp_path):
    """Configuration C in the source's own domain, on all its test images, is the run's own score."""
    config = AdaptConfig(domain="clean", fine_tune=2, test=10**6, fine_tune_epochs=1)
    results = adaptation.passage_configurations(made.passages, made.data, tmp_path / "clean", config)
    assert results is not None
    own = json.loads((made.passages / "results.json").read_text())
    assert results["tested_on"] == load_passages(made.data).test.sum()
    assert results["C"]["confusion"] == own["confusion"]
    assert results["C"]["macro_f1"] == pytest.approx(own["groups"]["all"]["macro_f1"])


@pytest.mark.heavy
def test_a_stopped_fine_tuning_goes_on_to_the_same_weights(made, configurations, tmp_path, stop_after):
    out = tmp_path / "stopped"
    places = made.passages, made.data, out, SHORT
    for epochs in (1, 4):  # the third after the one that the first sitting ran
        stop_after(epochs)
        with pytest.raises(Stopped):
            adaptation.passage_configurations(*places)
    results = adaptation.passage_configurations(*places)
    assert results == configurations[1]
    assert same(weights(out), weights(configurations[0]))


def test_a_map_of_collected_images_has_their_positions_as_nodes(made, tmp_path, capsys):
    out = tmp_path / "collected.npz"
    runs = ["--localiser", str(made.rooms), "--detector", str(made.passages)]
    words = ["adapt", "map", str(made.scene), "--target", str(made.data), *runs, "-o", str(out), "domain=clean"]
    assert main(words) == 0
    said = capsys.readouterr().out
    read, rooms = load_map(out, load_scene(made.scene).digest), load_rooms(made.data)
    assert read.xy_w == pytest.approx(rooms.xy_w[~rooms.test])
    assert (read.room == rooms.label[~rooms.test]).all()
    away = np.linalg.norm(read.xy_w[read.edges[:, 0]] - read.xy_w[read.edges[:, 1]], axis=1)
    assert away.max() < 2.5
    # In the source's own domain: the embeddings and scores of the runs themselves.
    trained = load_trained(made.rooms)
    level = rooms.images[~rooms.test][:, 1]
    assert read.embeddings[3] == pytest.approx(trained.embed(level[3]), abs=1e-5)
    detector = load_trained(made.passages)
    turns = np.rint(read.angle_rad / (2 * np.pi / 18)).astype(int) % 18
    logits = detector.logits(np.stack([level[a, turn] for a, turn in zip(read.edges[:, 0], turns, strict=True)]))
    expected = [np.interp(m, [0.6, 1.2, 1.8], of_edge) for m, of_edge in zip(away, logits, strict=True)]
    sure = np.abs(read.angle_rad / (2 * np.pi / 18) % 1 - 0.5) > 1e-3  # half way, either image will do
    assert sure.sum() > 200 and read.p[sure] == pytest.approx(1 / (1 + np.exp(-np.array(expected)[sure])), abs=1e-5)
    mean = localisation(trained, rooms)["mean"]
    assert f"held-out images localised: nearest node {mean['node']:.3f}, right room {mean['room']:.3f}" in said
    assert np.asarray(Image.open(out.with_suffix(".png")).convert("RGB")).std() > 10
    assert read.about["domain"]["zoom"] == 1.0


@pytest.mark.heavy
def test_commands_draw_and_go_on(made, alexnet, tmp_path, capsys):
    out = tmp_path / "features"
    words = ["adapt", "features", "--data", str(made.data), "--localiser", str(alexnet), "-o", str(out)]
    words += ["domain=blur", "epochs=1", "hidden=8"]
    assert main(words) == 0
    first = capsys.readouterr().out
    assert main(words) == 0  # nothing is left to do, and it says the same
    assert capsys.readouterr().out.splitlines() == [line for line in first.splitlines() if "epoch" not in line]
    folder = tmp_path / "passages"
    words = ["adapt", "passages", "--target", str(made.data), "--detector", str(made.passages), "-o", str(folder)]
    assert main([*words, "fine_tune_epochs=1", "fine_tune=32"]) == 0
    assert "D  the source's weights, fine-tuned" in capsys.readouterr().out
    for path in (out / "adaptation.png", folder / "configurations.png"):
        picture = np.asarray(Image.open(path).convert("RGB"))
        assert picture.shape[0] > 400 and picture.std() > 10


def adapted_from(out, source):
    """Whether a folder holds a run of its own, in full precision, that began with the source."""
    about, kinds = load_trained(out).about, {leaf.dtype for leaf in jax.tree.leaves(load_trained(out).variables)}
    begun = about["adapted_from"] == load_trained(source).about["digest"] != about["digest"]
    return begun and "export" not in about and kinds == {jnp.dtype("float32")}


@pytest.mark.heavy
def test_an_exported_detector_is_fine_tuned_and_makes_maps_like_the_runs(made, exported, tmp_path):
    """Weights in half precision, no optimiser state."""
    out, rooms, passages = tmp_path / "passages", exported / "rooms", exported / "passages"
    config = AdaptConfig(domain="clean", fine_tune=40, test=10**6, fine_tune_epochs=1)
    results = adaptation.passage_configurations(passages, made.data, out, config)
    assert results is not None and adapted_from(out, made.passages)
    own = json.loads((made.passages / "results.json").read_text())
    assert results["C"]["macro_f1"] == pytest.approx(own["groups"]["all"]["macro_f1"], abs=0.02)
    of = [
        adaptation.collected_map(made.scene, made.data, *networks, config).map
        for networks in ((rooms, passages), (made.rooms, made.passages), (rooms, out))
    ]
    assert of[0].p == pytest.approx(of[1].p, abs=0.02)
    assert of[0].embeddings == pytest.approx(of[1].embeddings, abs=0.02)
    assert of[2].p != pytest.approx(of[0].p, abs=1e-3)


@pytest.mark.heavy
def test_an_exported_embedding_is_adapted(made, exported, tmp_path):
    config = AdaptConfig(domain="clean", epochs=1, hidden=8)
    results = adaptation.adapt_features(exported / "rooms", made.data, made.data, tmp_path / "features", config)
    assert results is not None and adapted_from(tmp_path / "features", made.rooms)
    own = localisation(load_trained(exported / "rooms"), load_rooms(made.data))["mean"]
    assert results["source"] == results["before"] and results["before"]["mean"] == pytest.approx(own)


def test_what_does_not_fit_is_refused(made, adapted, painted, tmp_path, capsys):
    with pytest.raises(ConfigError, match="domain is 'fog', expected one of clean"):
        AdaptConfig(domain="fog")
    with pytest.raises(FileError, match="was trained for 'rooms', expected a run of 'train passages'"):
        adaptation.passage_configurations(made.rooms, made.data, tmp_path / "x", SHORT)
    other = tmp_path / "other"
    shutil.copytree(made.data, other)
    header = json.loads((other / "dataset.json").read_text())
    header["settings"]["passage_lengths_m"] = [1.2, 1.8, 2.5]
    (other / "dataset.json").write_text(json.dumps(header))
    with pytest.raises(FileError, match=r"detector judges \[0.6, 1.2, 1.8\]; make it again with passage_lengths_m="):
        adaptation.passage_configurations(made.passages, other, tmp_path / "y", SHORT)
    with pytest.raises(FileError, match="was trained for 'rooms'"):
        adaptation.collected_map(made.scene, made.data, made.rooms, made.rooms, SHORT)
    changed = tmp_path / "painted"
    shutil.copytree(painted, changed)
    (changed / "scene.xml").write_text((changed / "scene.xml").read_text() + "\n")
    with pytest.raises(FileError, match="holds images of painted as they were, not of 'painted' as it is"):
        adaptation.collected_map(changed, made.data, made.rooms, made.passages, SHORT)
    there = adapted[0]
    with pytest.raises(FileError, match="the run there has domain = 'light', this one 'blur'"):
        adaptation.adapt_features(made.rooms, made.data, made.data, there, AdaptConfig(domain="blur"))
    assert main(["adapt", "features", str(made.scene)]) == 2
    assert "adapt features takes no scene folder; leave out" in capsys.readouterr().err
