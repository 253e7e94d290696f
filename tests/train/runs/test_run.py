"""Run folders: what is in them, and that a run survives whatever ends it."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rich.console import Console

from interactive_nav_common import versions
from interactive_nav_common.errors import ConfigError, FileError
from interactive_nav_common.files import release, take_lock, write_json
from interactive_nav_common.records import mean_over_episodes, read_metrics
from tests.train.toy_env import ToyConfig, ToyEnv
from tests.train.toy_run import UPDATE_STEPS, build_toy, toy_config
from train import __main__ as program
from train.config import resolve
from train.config_io import from_yaml
from train.learners.learner import DivergedError
from train.runs import checkpoint, run, run_folder
from train.runs.checkpoint import CheckpointError, check_fits
from train.runs.run import failures, train_run
from train.runs.run_folder import RunFolder, claim


def quiet() -> Console:
    return Console(file=io.StringIO(), width=200)


def learner_of(folder: RunFolder, template: Any) -> Any:
    return checkpoint.load_learner(checkpoint.find(folder.checkpoints, "last")[0], template)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    console = quiet()
    config = toy_config(tmp_path_factory.mktemp("runs"), updates=5)
    result, folder, stopped_by = train_run(config, console, build_env=build_toy)
    assert stopped_by is None
    return result, folder, config, console.file.getvalue()  # type: ignore[attr-defined]


def test_folder_of_a_finished_run(finished):
    result, folder, config, printed = finished
    assert result.completed and result.snapshot.env_steps == 5 * UPDATE_STEPS
    # A checkpoint every two updates and one at the end; all three are kept.
    assert [c.env_steps for c in checkpoint.list_checkpoints(folder.checkpoints)] == [512, 1024, 1280]
    assert [line["env_steps"] for line in read_metrics(folder.metrics)] == [256, 512, 768, 1024, 1280]
    assert {"loss/total_loss", "env_steps_per_s", "episodes", "wall_s"} <= read_metrics(folder.metrics)[0].keys()
    assert list(folder.tensorboard.glob("events.out.tfevents.*"))
    written = from_yaml(folder.config.read_text())
    settings = dataclasses.asdict(written.ppo)
    assert written == resolve(config, "native") and settings.pop("final_learning_rate") is None
    assert None not in settings.values()
    versions = json.loads((folder.path / "versions.json").read_text())
    assert versions["packages"]["brax"] == "0.14.2" and versions["device"]["platform"] == "cpu"
    summary = json.loads((folder.path / "summary.json").read_text())
    assert summary["env_steps"] == 1280 and summary["completed"] and summary["run"] == "toy"
    assert "100 %" in printed and "steps/s" in printed and "success" in printed and "s left" in printed
    assert not list(folder.checkpoints.glob(".*"))


def test_fewer_steps_for_an_environment_than_an_episode_may_have_are_told(finished, tmp_path):
    console = quiet()
    train_run(toy_config(tmp_path, updates=3), console, build_env=build_toy)  # 3 * 256 steps of 16 environments
    told = "48 steps for each environment, and an episode has up to 60: none that fails comes to its end"
    assert told in console.file.getvalue() and "none that fails" not in finished[3]  # type: ignore[attr-defined]


def test_finished_run_is_not_trained_again(finished):
    result, folder, config, _ = finished
    before = folder.metrics.read_text()
    again, _, _ = train_run(config, quiet(), build_env=build_toy)
    assert again.completed and again.snapshot.env_steps == result.snapshot.env_steps
    assert folder.metrics.read_text() == before


def test_resume_through_files_equals_uninterrupted_run(finished, tmp_path):
    """Two updates, then the same command with five: checkpoint and metrics equal those of five at once."""
    result, folder, _, _ = finished
    train_run(toy_config(tmp_path, updates=2), quiet(), build_env=build_toy)
    half = RunFolder(tmp_path / "toy")
    with open(half.metrics, "a") as file:  # a killed run's lines beyond its checkpoint, the last cut short
        file.write('{"env_steps": 700}\n{"env_st')
    (half.checkpoints / ".000000000768.part-123-0123abcd").mkdir()
    os.utime(half.checkpoints / ".000000000768.part-123-0123abcd", (0, 0))
    resumed, half, _ = train_run(toy_config(tmp_path, updates=5), quiet(), build_env=build_toy)
    jax.tree.map(np.testing.assert_array_equal, resumed.snapshot.learner, result.snapshot.learner)
    saved = learner_of(half, result.snapshot.learner)
    jax.tree.map(np.testing.assert_array_equal, saved, result.snapshot.learner)
    clocks = ("wall_s", "env_steps_per_s", "compile_s")
    lines = [
        [{k: v for k, v in line.items() if k not in clocks} for line in read_metrics(f.metrics)] for f in (half, folder)
    ]
    assert lines[0] == lines[1]
    assert not list(half.checkpoints.glob(".*"))


def test_another_config_in_the_same_folder_is_refused(finished):
    _, folder, config, _ = finished
    other = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, learning_rate=1e-2))
    with pytest.raises(FileError, match="has ppo.learning_rate = 0.0003, this one 0.01; set run.name"):
        train_run(other, quiet(), build_env=build_toy)
    assert from_yaml(folder.config.read_text()) == resolve(config, "native")


def test_a_run_that_another_process_trains_is_refused(finished, tmp_path, monkeypatch, capsys):
    """The lock is another's as long as it lives, and no longer; whoever only reads needs none."""
    _, folder, config, _ = finished
    copy = RunFolder(tmp_path / "toy")
    shutil.copytree(folder.path, copy.path)
    before = {path: path.read_bytes() for path in copy.path.rglob("*") if path.is_file()}
    monkeypatch.setattr(train_run, "__defaults__", (build_toy, "last"))
    held = take_lock(copy.lock)
    assert program.main(["--resume", str(copy.path), "run.num_timesteps=9999"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train: ") and f"process {os.getpid()} on " in line and "set run.name" in line
    release(held)
    assert {path: path.read_bytes() for path in before} == before
    assert program.main(["--resume", str(copy.path)]) == 0


def test_only_the_newest_and_the_best_checkpoints_stay(tmp_path):
    meta = checkpoint.CheckpointMeta(0, 0.0, None, "ppo", "turtlebot", ("goal",), 3, 2)
    scores = {100: None, 200: 0.9, 300: 0.5, 400: 0.7, 500: 0.8}
    for steps, score in scores.items():
        snapshot = type("S", (), {"learner": {"w": np.full(3, steps, np.float32)}, "env_state": {"x": np.arange(4)}})()
        checkpoint.save_snapshot(tmp_path, snapshot, dataclasses.replace(meta, env_steps=steps, score=score), 2, 1.0)
    assert [c.env_steps for c in checkpoint.list_checkpoints(tmp_path)] == [200, 400, 500]
    assert checkpoint.find(tmp_path, "best")[1].env_steps == 200
    assert checkpoint.find(tmp_path, "last")[1].env_steps == 500
    path, _ = checkpoint.find(tmp_path, "400")
    np.testing.assert_array_equal(checkpoint.load_learner(path, {"w": np.zeros(3, np.float32)})["w"], [400.0] * 3)
    # Environments are kept with the newest only; another size of them is as good as none.
    newest, _ = checkpoint.find(tmp_path, "last")
    assert checkpoint.load_env_state(path, {"x": np.zeros(4, np.int32)}) is None
    kept = checkpoint.load_env_state(newest, {"x": np.zeros(4, np.int32)})
    assert kept is not None
    np.testing.assert_array_equal(kept["x"], np.arange(4))
    assert checkpoint.load_env_state(newest, {"x": np.zeros(5, np.int32)}) is None
    with pytest.raises(CheckpointError, match="no checkpoint '300'; expected best, last or one of 200, 400, 500"):
        checkpoint.find(tmp_path, "300")
    with pytest.raises(CheckpointError, match=r"\['w'\] has shape \(3,\), expected \(4,\)"):
        checkpoint.load_learner(path, {"w": np.zeros(4)})
    (path / checkpoint.LEARNER).write_bytes(b"\x00garbage")
    with pytest.raises(CheckpointError, match="not a checkpoint of this learner"):
        checkpoint.load_learner(path, {"w": np.zeros(3)})
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        checkpoint.find(tmp_path / "none", "best")


def test_a_checkpoint_that_goes_is_gone_for_readers_at_once(tmp_path, monkeypatch):
    """An evaluation may look while a run trains: it never finds half a checkpoint."""
    meta = checkpoint.CheckpointMeta(0, 0.0, None, "ppo", "turtlebot", ("goal",), 3, 2)
    snapshot = type("S", (), {"learner": {"w": np.zeros(3)}, "env_state": None})()
    usual, seen = shutil.rmtree, []

    def slow(path, *words, **named):
        if path.exists():
            seen.append([c.env_steps for c in checkpoint.list_checkpoints(tmp_path)])
        usual(path, *words, **named)

    monkeypatch.setattr(checkpoint.shutil, "rmtree", slow)
    for steps in (100, 200):
        checkpoint.save_snapshot(tmp_path, snapshot, dataclasses.replace(meta, env_steps=steps), 1, 1.0)
    assert seen == [[200]] and [path.name for path in tmp_path.iterdir()] == ["000000000200"]


def test_a_signal_after_the_last_update_leaves_a_summary(tmp_path, monkeypatch):
    def signalled(path, content):
        if path.name == "summary.json":
            signal.raise_signal(signal.SIGTERM)
        write_json(path, content)

    usual = signal.signal(signal.SIGTERM, lambda *_: pytest.fail("too late to be collected"))
    monkeypatch.setattr(run, "write_json", signalled)
    try:
        result, folder, stopped_by = train_run(toy_config(tmp_path, updates=2), quiet(), build_env=build_toy)
    finally:
        signal.signal(signal.SIGTERM, usual)
    assert result.completed and stopped_by == signal.SIGTERM
    assert folder.origin()["completed"] and folder.origin()["env_steps"] == 2 * UPDATE_STEPS


def test_a_run_that_goes_on_no_longer_tells_how_it_ended_before(finished, tmp_path):
    """Killed in the middle, its rows would else be of fewer steps than their checkpoint."""
    _, folder, config, _ = finished
    copy = RunFolder(tmp_path / "toy")
    shutil.copytree(folder.path, copy.path)
    more = dataclasses.replace(config.run, out_dir=str(tmp_path), num_timesteps=7 * UPDATE_STEPS)
    seen = []

    def watched(self, env_steps):
        seen.append(copy.origin()["env_steps"])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run.FolderCallbacks, "on_update", watched)
        train_run(dataclasses.replace(config, run=more), quiet(), build_env=build_toy)
    assert seen == [None, None] and copy.origin()["env_steps"] == 7 * UPDATE_STEPS


def test_score_of_a_checkpoint_weighs_episodes_alike():
    lines = [
        {"episodes": 1.0, "episode/success": 1.0},
        {"episodes": 3.0, "episode/success": 0.2},
        {"episodes": 0.0},
    ]
    assert mean_over_episodes(lines, "episode/success") == pytest.approx(0.4)  # (1 + 3 * 0.2) / 4
    assert mean_over_episodes(lines[2:], "episode/success") is None


def test_checkpoint_of_another_robot_is_refused():
    env = ToyEnv()
    config = toy_config("x").env
    meta = checkpoint.CheckpointMeta(0, 0.0, None, "ppo", "turtlebot", config.observations, 29, 2)
    check_fits(meta, Path("c"), config, env)
    with pytest.raises(CheckpointError, match="robot of the checkpoint: 'fetch'.*'turtlebot'"):
        check_fits(dataclasses.replace(meta, robot="fetch"), Path("c"), config, env)
    with pytest.raises(CheckpointError, match="size of the checkpoint: 9, of the environment: 29"):
        check_fits(dataclasses.replace(meta, observation_size=9), Path("c"), config, env)


def test_large_environments_are_left_out_of_checkpoints(tmp_path):
    config = toy_config(tmp_path, updates=2, env_state_limit_mb=0.0)
    _, folder, _ = train_run(config, quiet(), build_env=build_toy)
    path, _ = checkpoint.find(folder.checkpoints, "last")
    assert not (path / checkpoint.ENV_STATE).exists()
    more = dataclasses.replace(config, run=dataclasses.replace(config.run, num_timesteps=3 * UPDATE_STEPS))
    result, _, _ = train_run(more, quiet(), build_env=build_toy)
    assert result.snapshot.env_steps == 3 * UPDATE_STEPS


def test_folder_trouble_is_found_before_training(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be written"):
        train_run(toy_config(tmp_path / "file"), quiet(), build_env=lambda _: pytest.fail("too late"))
    usage = type("Usage", (), {"free": 10_000_000})
    monkeypatch.setattr(run_folder.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(FileError, match="10 MB free on its disk, expected 64 MB"):
        train_run(toy_config(tmp_path), quiet(), build_env=lambda _: pytest.fail("too late"))
    with pytest.raises(FileError, match="10 MB free on its disk, expected 164 MB"):
        claim(tmp_path, 100.0)


def test_damaged_files_of_a_checkpoint_and_of_a_run_are_one_line_each(finished, tmp_path):
    shutil.copytree(finished[1].path, tmp_path / "toy")
    folder = RunFolder(tmp_path / "toy")
    path, _ = checkpoint.find(folder.checkpoints, "last")
    whole = (path / checkpoint.ENV_STATE).read_bytes()
    (path / checkpoint.ENV_STATE).write_bytes(whole[: len(whole) // 2])
    about = json.loads((path / checkpoint.META).read_text()) | {"sha256": {}}  # as of an earlier release
    (path / checkpoint.META).write_text(json.dumps(about))
    with pytest.raises(CheckpointError, match="env_state.npz: not readable .*; remove it"):
        train_run(toy_config(tmp_path, updates=6), quiet(), build_env=build_toy)
    for wrong, told in (("x", '"x"'), (1.5, "1.5"), (-1, "-1"), (None, "null")):
        (path / checkpoint.META).write_text(json.dumps(about | {"env_steps": wrong}))
        with pytest.raises(CheckpointError, match=f"meta.json: env_steps is {told}, expected a whole number"):
            checkpoint.read_meta(path)
    (folder.path / "versions.json").write_text('{"device": "cpu"}')
    with pytest.raises(FileError, match='versions.json: device is "cpu", expected a mapping'):
        folder.origin()
    folder.summary.write_text('{"env_steps": "7"}')
    with pytest.raises(FileError, match='summary.json: env_steps is "7", expected a whole number'):
        folder.origin()


def test_many_claim_one_folder_at_once(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: claim(tmp_path / "sweep"), range(2000)))
    assert list((tmp_path / "sweep").iterdir()) == []


def test_disk_that_fills_up_leaves_the_last_checkpoint(tmp_path, monkeypatch):
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    meta = checkpoint.CheckpointMeta(100, 0.0, None, "ppo", "turtlebot", ("goal",), 3, 2)
    snapshot = type("S", (), {"learner": {"w": np.zeros(3)}, "env_state": None})()
    checkpoint.save_snapshot(tmp_path, snapshot, meta, 2, 1.0)
    monkeypatch.setattr(checkpoint.os, "fsync", full)
    with pytest.raises(FileError, match="cannot write the checkpoint \\(No space left on device\\)"):
        checkpoint.save_snapshot(tmp_path, snapshot, dataclasses.replace(meta, env_steps=200), 2, 1.0)
    assert [c.env_steps for c in checkpoint.list_checkpoints(tmp_path)] == [100]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000000100"]


def test_checkpoints_have_no_score_before_every_environment_had_time_for_an_episode(tmp_path):
    """16 environments and a limit of 60 steps: what ends in the first 960 env steps are the short episodes. Those that
    failed begin together again, so that a score is of 960 env steps after the first 960."""

    def short(_):
        return ToyEnv(ToyConfig(episode_steps=20))

    config = toy_config(tmp_path, updates=8, keep_checkpoints=9)
    _, folder, _ = train_run(config, quiet(), build_env=short)
    lines = read_metrics(folder.metrics)
    saved = {c.env_steps: c.score for c in checkpoint.list_checkpoints(folder.checkpoints)}
    assert list(saved) == [512, 1024, 1536, 2048] and [*saved.values()][:3] == [None] * 3
    assert all(line["episodes"] > 0 for line in lines if line["env_steps"] in (512, 768))  # in no score
    later = [line for line in lines if line["env_steps"] > 2048 - 960]
    assert saved[2048] == pytest.approx(mean_over_episodes(later, "episode/ins_0.5"))
    assert len(later) == 4  # updates of 256: the checkpoint's own interval holds two
    # Without room for the environments all begin anew, and the wait with them.
    config = toy_config(tmp_path, updates=16, keep_checkpoints=9, env_state_limit_mb=0.0)
    (folder.checkpoints / "000000002048" / checkpoint.ENV_STATE).unlink()
    train_run(config, quiet(), build_env=short)
    saved = {c.env_steps: (c.score, c.began_together) for c in checkpoint.list_checkpoints(folder.checkpoints)}
    assert saved[3584] == (None, 2048) and saved[4096][1] == 2048 and saved[4096][0] is not None


def test_unknown_best_metric_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="run.best_metric is 'sucess', expected one of .*success"):
        train_run(toy_config(tmp_path, best_metric="sucess"), quiet(), build_env=build_toy)


def test_nan_guard_saves_the_batch_and_stops(tmp_path):
    """A reward that is NaN at an episode's 20th step: updates take 16 steps, so the second one meets it."""
    toy = toy_config(tmp_path, updates=5)
    with pytest.raises(DivergedError) as caught:
        train_run(toy, quiet(), build_env=lambda _: ToyEnv(ToyConfig(episode_steps=60), nan_at_step=20))
    message = str(caught.value)
    assert "diverged after env step 256" in message and "total_loss" in message and "\n" not in message
    saved = tmp_path / "toy" / "diverged-000000000256"
    assert str(saved) in message
    with np.load(saved / "batch.npz") as batch:
        rewards = batch[".reward"]
        assert rewards.shape == (32, 8) and np.isnan(rewards).any()
    assert (saved / checkpoint.LEARNER).stat().st_size > 1000


def _start(tmp_path: Path, *words: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "tests.train.toy_run", str(tmp_path), *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _wait_for_checkpoint(folder: RunFolder, after: int, process: subprocess.Popen) -> None:
    until = time.monotonic() + 120
    while time.monotonic() < until:
        assert process.poll() is None, process.communicate()
        saved = checkpoint.list_checkpoints(folder.checkpoints)
        if saved and saved[-1].env_steps > after:
            return
        time.sleep(0.1)
    raise AssertionError("no checkpoint in 120 s")


@pytest.mark.slow
def test_sigterm_saves_and_kill_loses_one_interval_at_most(tmp_path, monkeypatch):
    usual = run.FolderCallbacks.on_update

    def signalled(self, env_steps):
        usual(self, env_steps)
        if env_steps == 3 * UPDATE_STEPS:
            signal.raise_signal(signal.SIGTERM)

    console = quiet()
    with monkeypatch.context() as patch:
        patch.setattr(run.FolderCallbacks, "on_update", signalled)
        _, folder, stopped_by = train_run(toy_config(tmp_path, updates=10_000), console, build_env=build_toy)
    assert stopped_by == signal.SIGTERM
    out = console.file.getvalue()  # type: ignore[attr-defined]
    assert "stopped at" in out and "the same command continues" in out
    lines, saved = read_metrics(folder.metrics), checkpoint.list_checkpoints(folder.checkpoints)
    assert saved[-1].env_steps == lines[-1]["env_steps"] == 3 * UPDATE_STEPS
    assert json.loads((folder.path / "summary.json").read_text())["completed"] is False

    # Killed without warning: what is lost lies after the last checkpoint, at most two updates of 256.
    reached = saved[-1].env_steps
    process = _start(tmp_path)
    try:
        _wait_for_checkpoint(folder, reached + 4 * UPDATE_STEPS, process)
    finally:
        process.kill()
        process.communicate()
    lines, saved = read_metrics(folder.metrics), checkpoint.list_checkpoints(folder.checkpoints)
    assert lines[-1]["env_steps"] - saved[-1].env_steps <= 2 * UPDATE_STEPS
    steps = [line["env_steps"] for line in lines]
    assert steps == sorted(set(steps))
    # And it goes on from there, to an end.
    total = saved[-1].env_steps + 2 * UPDATE_STEPS
    result, _, _ = train_run(toy_config(tmp_path, updates=total // UPDATE_STEPS), quiet(), build_env=build_toy)
    assert result.completed and result.snapshot.env_steps == total
    assert [line["env_steps"] for line in read_metrics(folder.metrics)] == list(range(256, total + 1, 256))


def test_failures_are_summed_over_logged_episodes(tmp_path):
    folder = RunFolder(tmp_path)
    assert failures(folder) == {}
    lines = [
        {"env_steps": 10, "episodes": 4, "episode/overflow_steps": 0.25, "episode/nonfinite": 0.0},
        {"env_steps": 20, "episodes": 2, "episode/overflow_steps": 1.5, "episode/unconverged_steps": 2.0},
    ]
    folder.metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
    # 4 x 0.25 + 2 x 1.5 = 4 and 2 x 2 = 4; what is 0 is left out.
    assert failures(folder) == {"overflow_steps": 4.0, "unconverged_steps": 4.0}


def test_a_run_tells_its_command_without_the_machines_folders(monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/train/__main__.py", "--config", "demo"])
    assert versions.command() == ["train", "--config", "demo"]
    monkeypatch.setattr("sys.argv", ["/somewhere/my_sweep.py"])
    assert versions.command() == ["my_sweep.py"]


def test_the_environment_may_tell_the_commit(monkeypatch):
    monkeypatch.setenv("GIT_COMMIT", "abc1234")
    assert versions.commit() == "abc1234"
    monkeypatch.delenv("GIT_COMMIT")
    assert versions.commit() != "abc1234"
