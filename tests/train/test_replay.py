"""A run folder in; replays, a video and a map out, by the commands that a user types."""

from __future__ import annotations

import dataclasses
import importlib.util

import numpy as np
import pytest

import interactive_nav
import interactive_nav.record
from interactive_nav import episodes
from interactive_nav.pictures import replay
from interactive_nav.scenes.objects import body_names
from tests.train.toy_run import toy_config
from train import record
from train import replay as program
from train.config import EnvConfig, resolve
from train.runs.run_folder import RunFolder
from train.scoring import brought


@pytest.fixture(scope="module")
def run(tmp_path_factory, room):
    """A run that has not trained yet: baselines need no checkpoint."""
    config = toy_config(tmp_path_factory.mktemp("runs"))
    env = EnvConfig.of(scenes=(str(room),), backend="native", episode_steps=15, num_objects=1)
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    folder.open(resolve(dataclasses.replace(config, env=env), "native"))
    return folder.path


def test_one_command_makes_a_video_of_a_run(run, tmp_path, capsys):
    out = tmp_path / "out.mp4"
    pictures = ["--height", "120", "--every", "5", "-o", str(out)]
    asked = [str(run), "--episode", "2", "--policy", "random"]
    # Whoever only draws plays nothing, and says who does.
    assert interactive_nav.record.main([*asked, *pictures]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"python -m train.record {run} --episode 2 --policy random -o {out}" in line
    assert record.main([*asked, *pictures]) == 0
    size = out.stat().st_size
    assert size > 1000
    kept = replay.load_replay(replay.replay_path(run, "random", 2))
    assert (kept.policy, kept.episode, kept.num_steps) == ("random", 2, 15)
    printed = "".join(capsys.readouterr().out.split())  # the console breaks lines where it is narrow
    assert f"{out}:4framesofrandom,episode2" in printed
    out.unlink()
    assert interactive_nav.record.main([*asked, *pictures]) == 0  # the replay is there now
    assert out.stat().st_size == size


def test_planners_and_files_are_played_by_the_names_that_evaluations_have(run, tmp_path, monkeypatch, capsys):
    """An ONNX file is known by its stem; what plays it is tested with `train.export`."""
    assert (
        record.main([str(run), "--policy", "namo:0.5", "--height", "120", "--every", "15", "-o", f"{tmp_path}/a.gif"])
        == 0
    )
    assert replay.load_replay(replay.replay_path(run, "namo:0.5", 0)).policy == "namo:0.5"
    monkeypatch.setattr(brought, "OnnxPolicy", lambda place, env: lambda observations, first: np.zeros((len(first), 2)))
    words = ["--policy", "given/straight.onnx", "--height", "120", "--every", "15", "-o", f"{tmp_path}/b.gif"]
    assert interactive_nav.record.main([str(run), *words]) == 2
    assert "python -m train.record" in capsys.readouterr().err
    assert record.main([str(run), *words]) == 0
    kept = replay.load_replay(run / "replays" / "straight-episode0.npz")
    assert kept.policy == "straight" and not kept.action.any()


def test_what_cannot_be_drawn_is_not_played(run, tmp_path, capsys):
    out = tmp_path / "out.mp4"
    for words, message in (
        (["-o", str(out)], "holds no checkpoint"),
        (["-o", "x.avi"], "ends in '.avi', expected one of .mp4, .gif"),
        (["--height", "125"], "height is 125, expected a multiple of 12"),
        (["--every", "0"], "--every is 0, expected at least 1"),
    ):
        assert record.main([str(run), *words]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line
    assert not out.exists()


def test_paths_of_an_evaluation_are_no_replay(tmp_path, capsys):
    """They have no poses of bodies: the message says what they are, and what draws them."""
    paths = tmp_path / "evaluation" / "episodes.npz"
    paths.parent.mkdir()
    np.savez(paths, **{"policies": np.array(["learned"]), "learned/goal_xy_w": np.zeros((1, 2))})
    assert interactive_nav.record.main([str(paths), "-o", str(tmp_path / "out.gif")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "holds paths that an evaluation recorded, expected a replay" in line
    assert f"python -m train.figures {paths.parent}" in line and "damaged" not in line


@pytest.mark.parametrize("words", [[], ["env.backend=warp"]])
def test_a_run_of_a_gpu_is_played_without_one(run, tmp_path, monkeypatch, capsys, words):
    """Unless the command line itself asks for what is not here."""
    copy = RunFolder(tmp_path / "run")
    copy.path.mkdir()
    copy.config.write_text(RunFolder(run).config.read_text().replace("backend: native", "backend: warp"))
    usual = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "warp" else usual(name, *a))
    ended = program.main([str(copy.path), "--policies", "random", *words])
    said = capsys.readouterr()
    if words:
        assert ended == 2 and "backend=warp needs warp-lang" in said.err
    else:
        assert ended == 0
        assert f"{copy.path}: trained with backend warp, which is not here; played with native" in said.out
        assert replay.load_replay(replay.replay_path(copy.path, "random", 0)).num_steps == 15


def test_an_episode_starts_as_its_number_says_whoever_plays_it(run):
    assert program.main([str(run), "--episodes", "1,3", "--policies", "random,follower"]) == 0
    first, other, third = (
        replay.load_replay(replay.replay_path(run, *which)) for which in (("random", 1), ("follower", 1), ("random", 3))
    )
    np.testing.assert_array_equal(first.body_pos_w[0], other.body_pos_w[0])
    np.testing.assert_array_equal(first.goal_xy_w, other.goal_xy_w)
    assert not np.allclose(first.action[0], other.action[0])
    assert not np.allclose(first.goal_xy_w, third.goal_xy_w)


def test_an_episode_of_a_file_starts_as_the_file_says(run, room, tmp_path, capsys):
    path = tmp_path / "two.json"
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=1)
    made = dataclasses.replace(episodes.draw_episode_file(env, 2, seed=4), seed=5)  # keys alone would draw others
    episodes.save_episode_file(made, path)
    asked = [str(run), "--policies", "random", "--episode-file", str(path)]
    assert program.main([*asked, "--episodes", "1"]) == 0
    played, told = replay.load_replay(replay.replay_path(run, "random", 1)), made.episodes[1]
    np.testing.assert_allclose(played.robot_xy_w[0], told["start_xy_w"], atol=1e-6)
    np.testing.assert_allclose(played.goal_xy_w, told["goal_xy_w"], atol=1e-6)
    small = played.body_pos_w[0, played.bodies.index(body_names(played.small)[0]), :2]
    np.testing.assert_allclose(small, told["objects"][0][:2], atol=1e-5)
    capsys.readouterr()
    for words, message in (
        (["--episodes", "2"], "--episodes has 2, expected less than the file's 2"),
        (["--seed", "4"], "--seed has no effect with --episode-file"),
    ):
        assert program.main([*asked, *words]) == 2
        assert message in capsys.readouterr().err


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
