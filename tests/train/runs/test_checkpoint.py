"""Damaged checkpoints are noticed and passed over; a run continues from the checkpoint and in the scenes it was of."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shutil
import types
import warnings

import flax.serialization
import numpy as np
import pytest
from rich.console import Console

from tests.train.toy_run import UPDATE_STEPS, build_toy, toy_config
from train.runs import checkpoint
from train.runs.checkpoint import CheckpointError
from train.runs.run import train_run

META = checkpoint.CheckpointMeta(0, 0.0, None, "ppo", "turtlebot", ("goal",), 3, 2)
LEARNER = {"w": np.zeros(300, np.float32)}


@pytest.fixture
def three(tmp_path):
    """Checkpoints at 100, 200 and 300 steps, the second the best, each with the weights of its number."""
    for steps, score in ((100, 0.1), (200, 0.9), (300, 0.5)):
        snapshot = types.SimpleNamespace(
            learner={"w": np.full(300, steps, np.float32)}, env_state={"x": np.arange(4, dtype=np.int32)}
        )
        checkpoint.save_snapshot(tmp_path, snapshot, dataclasses.replace(META, env_steps=steps, score=score), 3, 1.0)
    return tmp_path


def flip(path, bits=50) -> None:
    data = bytearray(path.read_bytes())
    for at in np.random.default_rng(0).choice(np.arange(100, len(data)), bits, replace=False):
        data[at] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("name", [checkpoint.LEARNER, checkpoint.ENV_STATE])
def test_flipped_bits_are_noticed_and_the_last_intact_checkpoint_is_used(three, name):
    assert checkpoint.find(three, "last")[1].env_steps == 300
    flip(three / "000000000300" / name)
    with pytest.warns(UserWarning, match=f"300/{name}: damaged: .*; the checkpoint at 200 steps is used"):
        path, meta = checkpoint.find(three, "last")
    assert meta.env_steps == 200 and checkpoint.load_learner(path, LEARNER)["w"][0] == 200
    with pytest.raises(CheckpointError, match="damaged"):
        checkpoint.find(three, "300")


def test_a_damaged_best_checkpoint_gives_way_to_the_next_best(three):
    flip(three / "000000000200" / checkpoint.LEARNER)
    with pytest.warns(UserWarning, match="the checkpoint at 300 steps is used"):
        assert checkpoint.find(three, "best")[1].env_steps == 300


def test_a_damaged_old_checkpoint_does_not_block_the_newest(three):
    (three / "000000000100" / checkpoint.META).write_text("{")
    assert [c.env_steps for c in checkpoint.list_checkpoints(three)] == [200, 300]
    with pytest.warns(UserWarning, match="000000000100/meta.json"):
        assert checkpoint.find(three, "last")[1].env_steps == 300


def test_without_an_intact_checkpoint_the_newest_fault_is_named(three):
    for path in three.iterdir():
        flip(path / checkpoint.LEARNER)
    with pytest.raises(CheckpointError, match="300/learner.msgpack: damaged"):
        checkpoint.find(three, "last")


def test_weights_that_are_not_finite_are_refused(three):
    """Without digests, as in checkpoints of earlier releases."""
    folder = three / "000000000300"
    weights = np.full(300, np.nan, np.float32)
    (folder / checkpoint.LEARNER).write_bytes(flax.serialization.to_bytes({"w": weights}))
    about = json.loads((folder / checkpoint.META).read_text()) | {"sha256": {}}
    (folder / checkpoint.META).write_text(json.dumps(about))
    assert checkpoint.find(three, "last")[0] == folder
    with pytest.raises(CheckpointError, match=r"\['w'\] has values that are not finite"):
        checkpoint.load_learner(folder, LEARNER)


def test_a_run_continues_from_the_checkpoint_that_is_named_and_past_a_damaged_one(tmp_path):
    quiet = Console(file=io.StringIO(), width=400)
    config = toy_config(tmp_path, updates=4, keep_checkpoints=5)
    _, folder, _ = train_run(config, quiet, build_env=build_toy)
    assert [c.env_steps for c in checkpoint.list_checkpoints(folder.checkpoints)] == [512, 1024]
    train_run(config, quiet, build_env=build_toy, resume_from="512")
    assert (folder.checkpoints / "aside-000000001024" / checkpoint.META).is_file()
    assert "renamed to aside-000000001024" in quiet.file.getvalue()
    assert [c.env_steps for c in checkpoint.list_checkpoints(folder.checkpoints)] == [512, 1024]
    flip(folder.checkpoints / "000000001024" / checkpoint.LEARNER)
    result, _, _ = train_run(config, quiet, build_env=build_toy)
    assert "the checkpoint at 512 steps is used" in quiet.file.getvalue()
    assert result.snapshot.env_steps == 4 * UPDATE_STEPS
    assert checkpoint.verify(folder.checkpoints / "000000001024").env_steps == 1024


def test_a_run_does_not_continue_in_a_scene_that_changed(tmp_path):
    quiet = Console(file=io.StringIO(), width=400)

    def build(digest: str):
        def built(config):
            env = build_toy(config)
            env.scenes = (types.SimpleNamespace(name="toy", task_digest=digest),)
            return env

        return built

    _, folder, _ = train_run(toy_config(tmp_path, updates=2), quiet, build_env=build("task-1:a"))
    assert checkpoint.find(folder.checkpoints, "last")[1].scenes == {"toy": "task-1:a"}
    train_run(toy_config(tmp_path, updates=3), quiet, build_env=build("task-1:a"))
    with pytest.raises(CheckpointError, match="scene 'toy' has changed since"):
        train_run(toy_config(tmp_path, updates=4), quiet, build_env=build("task-1:b"))


def test_an_exported_policy_has_a_digest_of_its_own(tmp_path):
    learner = {"params": {"policy": np.ones((3, 2), np.float32)}, "normalizer_params": {}}
    snapshot = types.SimpleNamespace(learner=learner, env_state=None)
    path = checkpoint.save_snapshot(tmp_path, snapshot, dataclasses.replace(META, env_steps=7), 1, 0.0)
    checkpoint.keep_policy(path, tmp_path / "exported" / path.name)
    kept, _ = checkpoint.find(tmp_path / "exported", "last")
    flip(kept / "policy.safetensors")
    with pytest.raises(CheckpointError, match="policy.safetensors: damaged"):
        checkpoint.verify(kept)


def test_a_checkpoint_that_training_removes_meanwhile_is_no_fault(three, monkeypatch):
    """An evaluation looks while a run trains: the oldest checkpoint goes between listing and reading."""
    verify = checkpoint.verify

    def slow(folder):
        if folder.name.endswith("100"):
            shutil.rmtree(folder)
        return verify(folder)

    monkeypatch.setattr(checkpoint, "verify", slow)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert checkpoint.find(three, "last")[1].env_steps == 300


def test_a_fifo_in_place_of_the_learner_is_refused(three):
    path = three / "000000000300" / checkpoint.LEARNER
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match="no regular file but a FIFO"):
        checkpoint.load_learner(path.parent, LEARNER)
