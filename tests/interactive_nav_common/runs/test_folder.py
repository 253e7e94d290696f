"""A run's folder is of one set of settings, and its epochs go on from the last checkpoint."""

import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav_common.errors import FileError
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.records import METRICS, read_metrics
from interactive_nav_common.runs.folder import (
    CHECKPOINT,
    CONFIG,
    VERSIONS,
    claimed,
    refuse_changes,
    run_epochs,
)
from interactive_nav_common.runs.weights import read_state, restored, write_state


def test_other_settings_are_refused_with_both_values(tmp_path):
    with claimed(tmp_path, {"seed": 1, "data": {"width": 3}}):
        pass
    assert (tmp_path / CONFIG).read_text() == "seed: 1\ndata:\n  width: 3\n" and (tmp_path / VERSIONS).is_file()
    with pytest.raises(FileError, match="the run there has seed = 1, this one 2; choose another"):
        claimed(tmp_path, {"seed": 2}).__enter__()
    with pytest.raises(FileError, match="the run there has data = 'another', this one 'this one'"):
        claimed(tmp_path, {"seed": 1, "data": {"width": 4}}).__enter__()
    with pytest.raises(FileError, match="run: the dataset there has legs = 3, this one 2; delete it"):
        refuse_changes(tmp_path / "run", {"legs": 3, "more": 1}, {"legs": 2}, "delete it", "dataset")


def test_a_state_is_read_back_in_its_types(tmp_path):
    state = {"w": jnp.arange(3, dtype=jnp.float32), "n": (jnp.int32(2), jnp.zeros((0, 2)))}
    assert read_state(tmp_path / "s.msgpack") is None
    write_state(tmp_path / "s.msgpack", {"phase": "labels", "epoch": 4, "learner": state})
    saved = read_state(tmp_path / "s.msgpack")
    assert saved is not None and (saved["phase"], saved["epoch"]) == ("labels", 4)
    back = restored(jax.tree.map(jnp.zeros_like, state), saved["learner"], tmp_path)
    assert jax.tree.all(jax.tree.map(lambda a, b: a.dtype == b.dtype and bool((a == b).all()), state, back))
    with pytest.raises(FileError, match="does not fit the network"):
        restored({"other": jnp.zeros(3)}, saved["learner"], tmp_path)


def test_stopped_epochs_go_on_with_the_same_keys(tmp_path):
    def epoch(state, number, key):
        if number == stop_at:
            signal.raise_signal(signal.SIGTERM)
        state = state + jax.random.normal(key, state.shape) * (number + 1)
        return state, {"loss": jnp.abs(state).mean()}

    key, stop_at = jax.random.PRNGKey(5), None
    for name in ("whole", "part", "bad"):
        (tmp_path / name).mkdir()
    whole = run_epochs(tmp_path / "whole", "count", jnp.zeros(4), epoch, 5, key)
    stop_at = 1
    with pytest.raises(Stopped):
        run_epochs(tmp_path / "part", "count", jnp.zeros(4), epoch, 5, key)
    assert [line["epoch"] for line in read_metrics(tmp_path / "part" / METRICS)] == [1, 2]
    part = run_epochs(tmp_path / "part", "count", jnp.zeros(4), epoch, 5, key)
    assert np.array_equal(whole, part) and (tmp_path / "part" / CHECKPOINT).is_file()
    losses = [[line["loss"] for line in read_metrics(tmp_path / name / METRICS)] for name in ("whole", "part")]
    assert losses[0] == losses[1] and len(losses[0]) == 5
    with pytest.raises(FileError, match="the loss of epoch 1 is nan; try a smaller learning_rate"):
        run_epochs(tmp_path / "bad", "count", jnp.zeros(1), lambda s, n, k: (s, {"loss": jnp.array(jnp.nan)}), 1, key)
