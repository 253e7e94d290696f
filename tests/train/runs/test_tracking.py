"""TensorBoard: values at their steps, a full disk. Weights & Biases: metrics.jsonl offline, one continued run."""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import flax.struct
import numpy as np
import pytest
from rich.console import Console
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.record_writer import RecordWriter

from interactive_nav_common.errors import ConfigError, FileError
from tests.train.toy_run import build_toy, toy_config
from train.learners.algorithms import ALGORITHMS
from train.learners.learner import Snapshot, TrainResult
from train.runs import tracking
from train.runs.run import train_run


def quiet() -> Console:
    return Console(file=io.StringIO())


def test_a_run_is_imported_without_tensorboard_which_would_bring_pytorch():
    script = "import sys, train.runs.run; print(sorted({'tensorboardX', 'torch'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "[]\n"


def scalars(path: Path) -> dict[tuple[int, str], float]:
    """(step, name) -> value of an event file: records of a length (u64), its check sum, content, its check sum."""
    data, at, found = path.read_bytes(), 0, {}
    while at < len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        event = Event.FromString(data[at + 12 : at + 12 + length])
        found |= {(event.step, value.tag): value.simple_value for value in event.summary.value}
        at += 16 + length
    return found


def test_events_hold_each_value_at_its_step(tmp_path):
    for steps in (0, 256):
        events = tracking.Events(tmp_path, steps)
        events.log(steps + 128, {"episodes": 3.0, "loss/policy": 0.25 + steps})
        events.close()
    first, second = map(scalars, sorted(tmp_path.iterdir()))
    assert first == {(128, "run/episodes"): 3.0, (128, "loss/policy"): 0.25}
    assert second == {(384, "run/episodes"): 3.0, (384, "loss/policy"): 256.25}


def test_events_that_meet_a_full_disk_are_one_error_and_the_run_can_be_begun_again(tmp_path, monkeypatch):
    config = toy_config(tmp_path, updates=1)
    with monkeypatch.context() as full:
        full.setattr("tensorboardX.record_writer.RecordWriter", lambda _: RecordWriter("/dev/full"))
        with pytest.raises(FileError, match=r"tensorboard: cannot be written \(No space left on device\); make room"):
            train_run(config, quiet(), build_env=build_toy)
    result, folder, _ = train_run(config, quiet(), build_env=build_toy)
    (events,) = folder.tensorboard.iterdir()
    assert result.completed and {step for step, name in scalars(events) if "/" in name} == {256}


def records(data: bytes) -> Iterator[bytes]:
    """The records of a W&B file: LevelDB's log format in blocks of 32 KiB, after a header of seven bytes."""
    at, parts = 7, []
    while at + 7 <= len(data):
        room = 32768 - at % 32768
        if room < 7:
            at += room
            continue
        _, length, kind = struct.unpack_from("<IHB", data, at)
        parts.append(data[at + 7 : at + 7 + length])
        at += 7 + length
        if kind in (1, 4):  # a whole record, or the last part of one
            yield b"".join(parts)
            parts = []


def logged(path: Path) -> list[dict[str, float]]:
    """The history in an offline run's file, once its last record is there: W&B's own process writes it."""
    from wandb.proto import wandb_internal_pb2  # pyright: ignore[reportMissingImports]

    for _ in range(200):
        read = []
        for data in records(path.read_bytes()):
            read.append(wandb_internal_pb2.Record())
            read[-1].ParseFromString(data)
        if read and read[-1].WhichOneof("record_type") == "exit":
            break
        time.sleep(0.1)
    else:
        raise AssertionError(f"{path} was never finished")
    histories = [record.history for record in read if record.WhichOneof("record_type") == "history"]
    return [{i.key or ".".join(i.nested_key): json.loads(i.value_json) for i in h.item} for h in histories]


@flax.struct.dataclass
class Envs:
    """As much of an environment's state as callbacks look at."""

    info: dict


class Logging:
    """A learner that learns nothing and logs what it is given."""

    def __init__(self, *lines: tuple[int, dict[str, float]]):
        self.lines = lines

    def train(self, env, config, callbacks) -> TrainResult:
        state = Envs({"episode_metrics": {config.run.best_metric: np.zeros(1)}})
        callbacks.on_start(Snapshot(0, {}, state), 1000)
        for env_steps, metrics in self.lines:
            callbacks.on_log(env_steps, {"env_steps_per_s": 10.0, **metrics})
        return TrainResult(Snapshot(self.lines[-1][0], {}, None), {"env_steps_per_s": 10.0}, True)


def test_offline_runs_hold_every_logged_number_and_go_on_as_one(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    steps = []
    for sitting in ((256, {"episode/success": 0.25}), (512, {"episode/success": 0.5})), ((768, {"loss/v": -1.5}),):
        monkeypatch.setitem(ALGORITHMS, "ppo", Logging(*sitting))
        _, folder, _ = train_run(toy_config(tmp_path, wandb=True), quiet(), build_env=build_toy)
        files = list(folder.path.glob("wandb/offline-run-*/*.wandb"))
        assert {path.stem for path in files} == {f"run-{(folder.path / tracking.ID_FILE).read_text().strip()}"}
        there = {line["env_steps"]: line for path in files for line in logged(path)}
        for env_steps, metrics in sitting:
            expected = {"env_steps": env_steps, "env_steps_per_s": 10.0, **metrics}
            assert {name: there[env_steps][name] for name in expected} == expected
        steps = sorted(there)
    assert steps[-1] == 768


def test_without_the_package_nothing_is_begun(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError, match="^run.wandb=true needs wandb, .* or set run.wandb=false"):
        train_run(toy_config(tmp_path, wandb=True), quiet(), build_env=build_toy)
    assert not list(tmp_path.iterdir())


def test_not_logged_in_is_one_line(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")

    def refuse(**_):
        raise wandb.errors.UsageError("api_key not configured (no-tty).\n call wandb.login")

    monkeypatch.setattr(wandb, "init", refuse)
    with pytest.raises(ConfigError, match=r"run.wandb: api_key not configured.*; run `wandb login`, set WANDB_MODE"):
        tracking.Tracker(tmp_path, toy_config(tmp_path), {})
