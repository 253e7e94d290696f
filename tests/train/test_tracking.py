"""Weights & Biases: offline the numbers of metrics.jsonl arrive, a continued run stays one, without it a clear line."""

from __future__ import annotations

import importlib
import io

import pytest
from rich.console import Console

from tests.train.toy_run import build_toy, toy_config
from train import tracking
from train.errors import ConfigError
from train.run import train_run
from train.run_folder import read_metrics


def quiet() -> Console:
    return Console(file=io.StringIO())


def logged(path) -> list[dict[str, float]]:
    """The history in an offline run's file."""
    import json

    from wandb.proto import wandb_internal_pb2
    from wandb.sdk.internal.datastore import DataStore

    store, found = DataStore(), []
    store.open_for_scan(str(path))
    while (data := store.scan_data()) is not None:
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            found.append({i.key or ".".join(i.nested_key): json.loads(i.value_json) for i in items})
    return found


def test_offline_runs_hold_every_logged_number(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    _, folder, _ = train_run(toy_config(tmp_path, updates=2, wandb=True), quiet(), build_env=build_toy)
    kept = (folder.path / tracking.ID_FILE).read_text().strip()
    (first,) = folder.path.glob("wandb/offline-run-*/*.wandb")
    assert kept in first.name
    lines = read_metrics(folder.metrics)
    for line, there in zip(lines, logged(first), strict=True):
        expected = {name: value for name, value in line.items() if name != "wall_s"}
        assert {name: there[name] for name in expected} == pytest.approx(expected, rel=1e-6)
    # The same run, continued: the same id, only the new steps.
    train_run(toy_config(tmp_path, updates=3, wandb=True), quiet(), build_env=build_toy)
    files = sorted(folder.path.glob("wandb/offline-run-*/*.wandb"))
    assert all(kept in path.name for path in files)
    assert (folder.path / tracking.ID_FILE).read_text().strip() == kept
    steps = [line["env_steps"] for path in files for line in logged(path)]
    assert sorted(steps) == [256, 512, 768]


def test_without_the_package_nothing_is_begun(tmp_path, monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ConfigError, match=r"Weights & Biases is not installed; pip install 'interactive-nav\[wandb\]'"):
        train_run(toy_config(tmp_path, wandb=True), quiet(), build_env=build_toy)
    assert not list(tmp_path.iterdir())


def test_not_logged_in_is_one_line(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")

    def refuse(**_):
        raise wandb.errors.UsageError("api_key not configured (no-tty).\n call wandb.login")

    monkeypatch.setattr(wandb, "init", refuse)
    with pytest.raises(ConfigError, match=r"run.wandb: api_key not configured.*; run `wandb login`, set WANDB_MODE"):
        tracking.Tracker(tmp_path, toy_config(tmp_path), {})
