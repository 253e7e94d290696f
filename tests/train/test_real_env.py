"""Training, resuming and scoring on the real environment: a room with one chair, on C MuJoCo."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from interactive_nav.pictures import replay
from interactive_nav_common.records import read_metrics
from tests.toys import write_room
from tests.train.toy_pixels import SMALL
from tests.train.toy_run import UPDATE_STEPS, toy_config
from train import evaluate
from train import replay as replay_program
from train.__main__ import main
from train.config import EnvConfig, TrainConfig
from train.runs import checkpoint
from train.runs.run import train_run


def best_steps(folder):
    return checkpoint.find(folder.checkpoints, "best")[1].env_steps


def train_again(root, name):
    """Two updates in a room, 16 environments for 32 steps with a limit of 12: its config, result and folder."""
    toy = toy_config(root / "runs", updates=2)
    room = root / "room" if (root / "room").is_dir() else write_room(root / "room")
    env = EnvConfig.of(scenes=(str(room),), backend="native", episode_steps=12, num_objects=2)
    config = TrainConfig(env=env, ppo=toy.ppo, run=dataclasses.replace(toy.run, name=name))
    return config, *train_run(config, Console(file=io.StringIO()))[:2]


def digests(folder):
    return [checkpoint.weights_digest(path) for path in sorted(folder.checkpoints.glob("[0-9]*"))]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    root = tmp_path_factory.mktemp("real")
    config, result, folder = train_again(root, "toy")
    return root, config, result, folder, digests(folder)


@pytest.mark.heavy
def test_a_seed_gives_the_same_policy_again(trained):
    """On C MuJoCo, with threads."""
    root, *_, first = trained
    assert digests(train_again(root, "again")[2]) == first and len(first) == 1


@pytest.mark.slow
def test_train_resume_and_evaluate(trained, tmp_path, capsys):
    _, config, result, folder, first = trained
    assert result.completed
    # Two time limits for each environment, if none succeeds.
    assert sum(line["episodes"] for line in read_metrics(folder.metrics)) >= 32
    more = dataclasses.replace(config, run=dataclasses.replace(config.run, num_timesteps=3 * UPDATE_STEPS))
    result, folder, _ = train_run(more, Console(file=io.StringIO()))
    assert [c.env_steps for c in checkpoint.list_checkpoints(folder.checkpoints)] == [512, 768]
    assert digests(folder)[0] == first[0] != digests(folder)[1]
    assert all(np.isfinite(value) for line in read_metrics(folder.metrics) for value in line.values())

    assert evaluate.main([str(folder.path), "--episodes", "6", "env.episode_steps=30"]) == 0
    rows = pq.read_table(folder.path / "evaluation" / "episodes.parquet").to_pydict()
    assert len(rows["policy"]) == 18 and set(rows["scene"]) == {"room"} and set(rows["backend"]) == {"native"}
    steps, success = np.array(rows["episode_steps"]), np.array(rows["success"])
    assert ((steps == 30) | (success == 1)).all() and (steps <= 30).all()
    assert (np.array(rows["nonfinite"]) == 0).all()
    # The paths that were recorded are the paths that were scored.
    with np.load(folder.path / "evaluation" / "episodes.npz") as paths:
        track = paths["follower/robot_xy_w"][0]
        track = track[np.isfinite(track[:, 0])]
        assert len(track) == steps[12] + 1
        travelled = np.linalg.norm(np.diff(track, axis=0), axis=-1).sum()
        assert travelled == pytest.approx(rows["robot_path_m"][12], rel=0.02)  # scored in 3-D
        assert paths["scene/0/object_names"].tolist()[-1] == "chair_0"

    # An episode played once more starts as the row that was scored.
    assert replay_program.main([str(folder.path), "--episodes", "3", "env.episode_steps=30"]) == 0
    again = replay.load_replay(replay.replay_path(folder.path, "learned", 3))
    assert again.label == f"toy, {best_steps(folder)} steps"
    assert again.metrics["shortest_path_m"] == pytest.approx(rows["shortest_path_m"][3])
    assert again.metrics["robot_path_m"] == pytest.approx(rows["robot_path_m"][3], rel=0.05)

    capsys.readouterr()
    assert evaluate.main([str(folder.path), "env.robot=turtlebott"]) == 2
    assert "train.evaluate: env: unknown robot 'turtlebott'" in capsys.readouterr().err
    assert evaluate.main([str(folder.path), "env.observations=goal,velocity"]) == 2
    assert "observations of the checkpoint: " in capsys.readouterr().err
    assert evaluate.main([str(folder.path), "--scenes", str(tmp_path / "absent")]) == 2
    assert str(tmp_path / "absent") in capsys.readouterr().err


@pytest.mark.heavy
@pytest.mark.slow
def test_a_policy_that_sees_trains_and_is_scored(tmp_path, capsys):
    room = write_room(tmp_path / "room")
    toy = toy_config(tmp_path / "runs", updates=1)
    env = EnvConfig.of(
        scenes=(str(room),),
        backend="native",
        episode_steps=6,
        num_objects=1,
        observations=("waypoints", "goal", "velocity", "depth", "segmentation"),
        image_size=32,
        image_dtype="uint8",
    )
    config = TrainConfig(env=env, network=SMALL, ppo=toy.ppo, run=toy.run)
    result, folder, _ = train_run(config, Console(file=io.StringIO()))
    assert result.completed
    meta = checkpoint.list_checkpoints(folder.checkpoints)[-1]
    images = {"pixels/depth": [32, 32, 1], "pixels/segmentation": [32, 32, 1]}
    assert meta.observation_size == {"state": [29], **images}
    assert evaluate.main([str(folder.path), "--episodes", "2", "--policies", "learned,follower"]) == 0
    rows = pq.read_table(folder.path / "evaluation" / "episodes.parquet").to_pydict()
    assert rows["policy"] == ["learned", "learned", "follower", "follower"]
    assert (np.array(rows["nonfinite"]) == 0).all()
    # Another eye does not fit what was learned.
    capsys.readouterr()
    assert evaluate.main([str(folder.path), "--episodes", "2", "env.image_size=36"]) == 2
    assert "observation size of the checkpoint: {'state': [29], 'pixels/depth': [32, 32, 1]" in capsys.readouterr().err


def test_a_run_that_cannot_begin_leaves_no_folder(tmp_path, capsys):
    out = tmp_path / "runs"
    arguments = ["--config", "demo", f"env.scenes=[{tmp_path / 'nowhere'}]", f"run.out_dir={out}"]
    assert main(arguments) == 2
    assert "no such file; expected a scene folder" in capsys.readouterr().err
    assert not out.exists()
