"""Networks learn a toy scene; runs repeat, go on, and refuse what does not fit."""

import json
import shutil
import signal

import jax
import numpy as np
import pytest

from interactive_nav_common.config import overridden
from interactive_nav_common.errors import FileError
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.records import read_metrics
from topological_nav.__main__ import main
from topological_nav.config import NetworkTrainConfig
from topological_nav.data.dataset import load_passages, load_rooms
from topological_nav.learn import training
from topological_nav.learn.learning import compiled_epoch, in_batches, padded_size

WORDS = ("network=alexnet", "width=4", "hidden=16", "epochs=2", "batch=32", "learning_rate=1e-3")
"""AlexNet compiles in a third of ResNet-18's time."""


def weights(run) -> dict:
    return training.load_trained(run).variables["params"]


def same(a, b) -> bool:
    return all(jax.tree.leaves(jax.tree.map(lambda x, y: bool((np.asarray(x) == np.asarray(y)).all()), a, b)))


def test_rooms_of_different_colour_are_told_apart(made):
    results = json.loads((made.rooms / "results.json").read_text())
    assert set(results["groups"]) == {"up", "level", "down", "all"}
    # Two colours; only in the gap between the rooms both are seen.
    assert results["groups"]["all"]["accuracy"] >= 0.85
    assert results["groups"]["all"]["macro_f1"] >= 0.85
    rooms = load_rooms(made.data)
    assert results["groups"]["level"]["images"] == 6 * rooms.test.sum()
    assert results["trained_on"] == 3 * 18 * (~rooms.test).sum()
    assert results["localisation"]["painted"]["room"] >= 0.85


def test_passages_are_told_better_than_by_chance(made):
    results = json.loads((made.passages / "results.json").read_text())
    assert results["groups"]["all"]["accuracy"] >= 0.7  # balanced: guessing gives 0.5
    confusion, passages = np.array(results["confusion"]), load_passages(made.data)
    assert confusion.sum(1).tolist() == [passages.test.sum() / 2] * 2
    assert np.trace(confusion) / confusion.sum() == pytest.approx(results["groups"]["all"]["accuracy"])
    # The scored length is one of all; what is free so far is of the dataset.
    lengths = results["lengths"]
    assert [row["ahead_m"] for row in lengths] == [0.6, 1.2, 1.8]
    assert lengths[1]["accuracy"] == pytest.approx(results["groups"]["all"]["accuracy"])
    free = passages.free[passages.test].mean(0)
    assert [row["free"] for row in lengths] == pytest.approx(free.tolist())
    trained = training.load_trained(made.passages)
    assert trained.about["lengths_m"] == [0.6, 1.2, 1.8] and trained.about["outputs"] == 3
    logits = trained.logits(passages.images[passages.test])
    assert (np.diff(logits, axis=1) <= 0).all() and lengths[1]["free"] == 0.5
    asked = trained.passage(passages.images[passages.test], np.array([[1.2, 0.9]]).repeat(len(logits), 0))
    between = np.stack([logits[:, 1], 0.5 * (logits[:, 0] + logits[:, 1])], -1)
    assert asked == pytest.approx(1 / (1 + np.exp(-between)), abs=1e-6)


def test_scores_of_lengths_by_hand():
    logits = np.array([[1.0, -1.0], [2.0, 1.0], [-1.0, -2.0], [0.5, 0.4]])
    free = np.array([[1, 0], [1, 0], [1, 0], [1, 1]])
    assert training.length_scores(logits, free, (1.0, 2.0)) == [
        {"ahead_m": 1.0, "free": 1.0, "accuracy": 0.75},
        {"ahead_m": 2.0, "free": 0.25, "accuracy": 0.75},
    ]


def test_a_detector_that_does_not_say_its_lengths_is_refused(made, tmp_path):
    run = tmp_path / "old"
    shutil.copytree(made.passages, run)
    about = json.loads((run / "network.json").read_text())
    del about["lengths_m"]
    (run / "network.json").write_text(json.dumps(about))
    with pytest.raises(FileError, match="it names no lengths_m for which it judges passages.*; train again"):
        training.load_trained(run)


@pytest.fixture(scope="module")
def whole(made, tmp_path_factory):
    """An uninterrupted run."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    config = overridden(NetworkTrainConfig(), WORDS)
    assert training.train("rooms", made.data, out, config) is not None
    return out, config


@pytest.mark.heavy
def test_a_stopped_run_ends_where_an_uninterrupted_one_does(made, whole, tmp_path, stop_after):
    """Stopped after the first epoch; the second call ends it."""
    out, config = tmp_path / "run", whole[1]
    stop_after(1)
    with pytest.raises(Stopped):
        training.train("rooms", made.data, out, config)
    assert len(read_metrics(out / "metrics.jsonl")) == 1
    with pytest.raises(FileError, match="holds no trained network; finish it"):
        training.load_trained(out)
    assert training.train("rooms", made.data, out, config) is not None
    assert same(weights(out), weights(whole[0]))
    lines = [read_metrics(run / "metrics.jsonl") for run in (out, whole[0])]
    strip = [[{k: v for k, v in line.items() if k != "seconds"} for line in run] for run in lines]
    assert strip[0] == strip[1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_while_scoring_is_one_line_and_the_same_command_scores(
    made, whole, tmp_path, capsys, monkeypatch, number
):
    """No epoch is run again."""
    command = ["train", "rooms", "--data", str(made.data), "-o", str(tmp_path / "run"), *WORDS]
    with monkeypatch.context() as patch:
        patch.setattr(training, "_scores", lambda *_: signal.raise_signal(number))
        assert main(command) == 128 + number
    assert capsys.readouterr().err == "topological_nav: stopped; give the same command again\n"
    assert not (tmp_path / "run" / "results.json").exists()
    assert main(command) == 0 and "epoch" not in capsys.readouterr().out
    results = [json.loads((run / "results.json").read_text()) for run in (tmp_path / "run", whole[0])]
    assert results[0] == results[1] and len(read_metrics(tmp_path / "run" / "metrics.jsonl")) == 2


def test_a_finished_run_is_left_as_it_is(made, whole, capsys):
    before = (whole[0] / "weights.safetensors").read_bytes()
    assert training.train("rooms", made.data, whole[0], whole[1]) is not None
    assert capsys.readouterr().out == "" and (whole[0] / "weights.safetensors").read_bytes() == before


def test_other_settings_are_refused(made, whole):
    config = overridden(whole[1], ["width=8"])
    with pytest.raises(FileError, match="the run there has width = 4, this one 8; choose another folder"):
        training.train("rooms", made.data, whole[0], config)


def test_a_backbone_is_taken_from_another_run(made, whole, tmp_path):
    config = overridden(NetworkTrainConfig(), [*WORDS, f"init={whole[0]}", "epochs=1", "learning_rate=1e-9"])
    assert training.train("passages", made.data, tmp_path / "run", config) is not None
    # A step of 1e-9 leaves the backbone where it was.
    pairs = zip(*(jax.tree.leaves(weights(r)["body"]) for r in (tmp_path / "run", whole[0])), strict=True)
    assert all(np.allclose(a, b, atol=1e-6) for a, b in pairs)
    wider = overridden(NetworkTrainConfig(), [*WORDS, f"init={whole[0]}", "width=8"])
    with pytest.raises(FileError, match="does not fit: its backbone differs .* or width; it is alexnet of width 4"):
        training.train("passages", made.data, tmp_path / "wider", wider)


def test_images_of_another_size_are_refused(whole):
    with pytest.raises(FileError, match=r"images are \(16, 16, 3\), expected \(32, 32, 3\)"):
        training.load_trained(whole[0]).logits(np.zeros((2, 16, 16, 3), np.uint8))


def test_damaged_weights_are_refused(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "run")
    path = tmp_path / "run" / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(FileError, match="weights.safetensors: not readable .* train again"):
        training.load_trained(tmp_path / "run")


def test_one_program_an_epoch_does_what_one_an_update_does(monkeypatch):
    """The way of accelerators against that of CPUs, on sums: each update adds its row, told is the running sum."""

    def steps(images, key):
        del key
        return (images,)

    def update(learner, images, labels, row):
        learner = learner + row[0] * labels
        return learner, {"sum": learner}

    rows, two = jax.numpy.arange(1.0, 4.0), jax.numpy.float32(2.0)
    ends = []
    for backend in ("cpu", "gpu"):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        ends.append(compiled_epoch(steps, update)(jax.numpy.float32(0.0), rows, two, jax.random.PRNGKey(0)))
    # 2, 6, 12: the last is 12, the mean 20 / 3.
    for learner, told in ends:
        assert float(learner) == 12.0 and float(told["sum"]) == pytest.approx(20 / 3)


@pytest.mark.parametrize("count", [1, 8, 9, 64, 65, 150])
def test_any_number_of_images_goes_through_fixed_batches(count):
    images = np.arange(count, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 2, 3), np.uint8)
    rows = in_batches(lambda x: x.mean((1, 2, 3))[:, None], images)
    assert rows[:, 0].tolist() == list(range(count))


def test_batches_of_few_sizes_hold_any_number(monkeypatch):
    sizes = {"cpu": [1, 2, 4, 8, 64, 128], "gpu": [16, 16, 16, 16, 64, 256]}
    for backend, expected in sizes.items():
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert [padded_size(n) for n in (1, 2, 3, 8, 64, 65)] == expected
