"""A run folder in; replays, a video and a map out, by the commands that a user types."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from interactive_nav import record, replay
from tests.train.toy_run import toy_config
from train import replay as program
from train.config import EnvConfig, resolve
from train.run_folder import RunFolder


@pytest.fixture(scope="module")
def run(tmp_path_factory, room):
    """A run that has not trained yet: yardsticks need no checkpoint."""
    config = toy_config(tmp_path_factory.mktemp("runs"))
    env = EnvConfig(scenes=(str(room),), backend="native", episode_steps=15, num_objects=1)
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    folder.open(resolve(dataclasses.replace(config, env=env), "native"))
    return folder.path


def test_one_command_makes_a_video_of_a_run(run, tmp_path, monkeypatch, capsys):
    called = []

    def in_this_process(words):
        called.append(words)
        return subprocess.CompletedProcess(words, program.main(words[3:]))

    monkeypatch.setattr(record.subprocess, "run", in_this_process)
    out = tmp_path / "out.mp4"
    arguments = ["--episode", "2", "--policy", "random", "--height", "120", "--every", "5", "-o", str(out)]
    assert record.main([str(run), *arguments]) == 0
    assert called[0][:3] == [sys.executable, "-m", "train.replay"]
    assert out.stat().st_size > 1000
    kept = replay.load(program.replay_path(run, "random", 2))
    assert (kept.policy, kept.episode, kept.num_steps) == ("random", 2, 15)
    printed = "".join(capsys.readouterr().out.split())  # the console breaks lines where it is narrow
    assert f"{out}:4framesofrandom,episode2" in printed
    # Without a checkpoint there is no learned policy: the program says so, and no video is left behind.
    out.unlink()
    assert record.main([str(run), "-o", str(out)]) == 2
    assert "no replay of episode 0 (python -m train.replay ended with 2)" in capsys.readouterr().err
    assert not out.exists()


def test_an_episode_starts_as_its_number_says_whoever_plays_it(run):
    assert program.main([str(run), "--episodes", "1,3", "--policies", "random,follower"]) == 0
    first, other, third = (
        replay.load(program.replay_path(run, *which)) for which in (("random", 1), ("follower", 1), ("random", 3))
    )
    np.testing.assert_array_equal(first.body_pos_w[0], other.body_pos_w[0])
    np.testing.assert_array_equal(first.goal_xy_w, other.goal_xy_w)
    assert not np.allclose(first.action[0], other.action[0])
    assert not np.allclose(first.goal_xy_w, third.goal_xy_w)


def test_wrong_use_is_one_line(run, tmp_path, capsys):
    for arguments, message in (
        ([str(tmp_path)], "is no run folder"),
        ([str(run), "--policies", "follwer"], "got 'follwer', expected a choice from learned"),
        ([str(run), "--episodes=-1"], "--episodes is '-1', expected numbers from 0 on"),
        ([str(run), "env.k_intt=1"], "k_int"),
    ):
        assert program.main(arguments) == 2
        line = capsys.readouterr().err
        assert line.startswith("train.replay: ") and message in line and line.count("\n") == 1
