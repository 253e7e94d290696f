"""Demonstrations: what a file holds is what the environment did, and a clone of an expert is as good as the expert."""

from __future__ import annotations

import dataclasses
import io
import json
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from interactive_nav.task.rollout import episode_keys
from interactive_nav_common.errors import ConfigError
from tests.train.toy_env import ToyEnv
from tests.train.toy_pixels import ToyPixels
from tests.train.toy_run import build_toy, toy_config
from train import evaluate, export
from train.config import CloneConfig, PPOConfig, RunConfig
from train.learners.demonstrations import read_demonstrations, table_of, write_demonstrations
from train.runs.run import train_run
from train.runs.run_folder import RunFolder
from train.scoring.evaluation import BatchPlayer
from train.scoring.policies import make_baseline

EPISODES = 40


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A file of 40 episodes each of the follower, the expert, and of random actions."""
    path = tmp_path_factory.mktemp("demonstrations")
    folder = RunFolder(path / "run")
    folder.open(toy_config(path))
    words = ["--policies", "random,follower", "--episodes", str(EPISODES), "--seed", "3", "--record", "2"]
    out = ["--out", str(path / "rows.parquet"), "--demonstrations", str(path / "steps.parquet")]
    assert evaluate.main([str(folder.path), *words, *out], build_env=build_toy) == 0
    return path / "steps.parquet", path / "rows.parquet"


def test_stepping_the_environment_with_the_actions_gives_the_rows(recorded):
    table, rows = pq.read_table(recorded[0]), pq.read_table(recorded[1]).to_pylist()
    assert table["observation.state"].type == pa.list_(pa.float32(), 29)
    assert table["action"].type == pa.list_(pa.float32(), 2)
    env = ToyEnv()
    reset, step, keys = jax.jit(env.reset), jax.jit(env.step), episode_keys(3, EPISODES)
    expected_frames = []
    for number in (0, 17, EPISODES, EPISODES + 9):  # two of each policy, which play the same episodes
        episode = table.filter(pa.compute.field("episode_index") == number).to_pylist()
        row, state = rows[number], reset(keys[number % EPISODES])
        expected_frames.append(int(row["episode_steps"]))
        for frame, got in enumerate(episode):
            np.testing.assert_allclose(got["observation.state"], state.obs, atol=1e-5)
            state = step(state, np.array(got["action"], np.float32))
            assert got["next.reward"] == pytest.approx(float(state.reward), abs=1e-5)
            assert got["next.done"] == bool(state.done) == (frame == len(episode) - 1)
            assert (got["frame_index"], got["timestamp"]) == (frame, pytest.approx(0.1 * frame))
            assert got["success"] == bool(row["success"])
            assert (got["scene"], got["robot"], got["policy"]) == ("plane", "turtlebot", row["policy"])
        assert len(episode) == expected_frames[-1]
    assert len(set(expected_frames)) > 2 and len(table) == sum(row["episode_steps"] for row in rows)
    assert table["policy"].unique().to_pylist() == ["random", "follower"]


def test_metadata_describe_columns_units_and_rate(recorded):
    about = json.loads(pq.read_schema(recorded[0]).metadata[b"interactive_nav"])
    assert about["fps"] == 10.0 and about["robot"]["name"] == "turtlebot"
    assert about["inputs"]["velocity"]["unit"] == "m/s, rad/s"
    assert about["features"]["action"] == {
        **{"dtype": "float32", "shape": [2]},
        "names": ["wheel left rad/s", "wheel right rad/s"],
    }
    state = about["features"]["observation.state"]
    assert state["shape"] == [29] and len(state["names"]) == 29
    assert (state["names"][19], state["names"][20], state["names"][28]) == ("waypoints.19", "goal.0", "velocity.5")
    assert list(about["features"]) == pq.read_schema(recorded[0]).names


def test_images_come_back_as_they_were(tmp_path):
    env = ToyPixels()
    player = BatchPlayer(env, demonstrate=True)
    episodes = player.play(make_baseline("random", env), episode_keys(0, 2))
    assert player.played is not None
    write_demonstrations([table_of(env, player.played, episodes.metrics["success"], "random")], env, tmp_path / "a")
    observation, _ = read_demonstrations(tmp_path / "a", env, only_successful=False)
    first = jax.jit(env.reset)(episode_keys(0, 1)[0]).obs
    assert set(observation) == set(first)
    for name, value in first.items():
        assert observation[name].dtype == value.dtype and observation[name].shape[1:] == value.shape
        np.testing.assert_allclose(observation[name][0], value, atol=1e-5)


def clone_config(path, out_dir):
    config = toy_config(out_dir)
    sizes: dict[str, Any] = {"num_envs": 16, "unroll_length": 16, "grad_steps_per_update": 100, "batch_size": 256}
    clone = CloneConfig(demonstrations=str(path), policy_hidden_layer_sizes=(64, 64), **sizes)
    run = RunConfig(out_dir=str(out_dir), name="clone", num_timesteps=20 * 256, log_every_steps=1024)
    return dataclasses.replace(config, algorithm="clone", ppo=PPOConfig(), clone=clone, run=run)


@pytest.mark.heavy
def test_a_clone_of_an_expert_reaches_what_the_expert_reaches(recorded, tmp_path):
    result, folder, _ = train_run(clone_config(recorded[0], tmp_path), Console(file=io.StringIO()), build_env=build_toy)
    assert result.completed
    for sampled in ("--stochastic", "--no-stochastic"):
        words = ["--policies", "learned,follower", "--episodes", "100", "--seed", "8", sampled]
        assert evaluate.main([str(folder.path), *words], build_env=build_toy) == 0
        rows = pq.read_table(folder.path / "evaluation" / "episodes.parquet")
        success = {
            name: np.mean(rows.filter(pa.compute.field("policy") == name)["success"].to_numpy())
            for name in ("learned", "follower")
        }
        assert success["follower"] > 0.9 and abs(success["learned"] - success["follower"]) <= 0.05
    assert rows["algorithm"].unique().to_pylist() == ["clone", None]
    out = tmp_path / "policy.onnx"
    assert export.main([str(folder.path), "-o", str(out)], build_env=build_toy) == 0 and out.stat().st_size > 1000


def test_files_that_do_not_fit_are_refused(recorded, tmp_path):
    table = pq.read_table(recorded[0])
    other = table.schema.metadata[b"interactive_nav"].replace(b'"turtlebot"', b'"fetch"')
    pq.write_table(table.replace_schema_metadata({"interactive_nav": other}), tmp_path / "fetch.parquet")
    pq.write_table(table.replace_schema_metadata(None), tmp_path / "plain.parquet")
    none = table.filter(pa.compute.invert(table["success"]))
    pq.write_table(none, tmp_path / "failed.parquet")
    for name, message in (
        ("nowhere.parquet", "clone.demonstrations is .*nowhere.parquet', expected the file that"),
        ("fetch.parquet", "name of robot in the file: 'fetch', in the environment: 'turtlebot'"),
        ("plain.parquet", "not readable as demonstrations"),
        ("failed.parquet", "holds no step of a successful episode"),
    ):
        with pytest.raises(ConfigError, match=message):
            train_run(
                clone_config(tmp_path / name, tmp_path / f"{name}-runs"),
                Console(file=io.StringIO()),
                build_env=build_toy,
            )
