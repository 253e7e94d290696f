"""Fixed episodes are fixed, their ends are frozen, and intervals are those of the books."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.train.toy_env import ToyConfig, ToyEnv
from train import rollout
from train.errors import RunFolderError
from train.policies import make_follower, make_random
from train.rollout import episode_keys, run_episodes
from train.rows import episode_table, interval, write_parquet


def test_an_episode_is_the_same_whatever_runs_beside_it(monkeypatch):
    """Twelve episodes, shrunk on the way, against the first five alone: equal number by number."""
    env = ToyEnv(ToyConfig(episode_steps=120))
    many = run_episodes(env, make_random(env), episode_keys(seed=3, episodes=12), record=12)
    monkeypatch.setattr(rollout, "SHRINK", 10**9)
    few = run_episodes(env, make_random(env), episode_keys(seed=3, episodes=5), record=5)
    for name, values in few.metrics.items():
        np.testing.assert_allclose(many.metrics[name][:5], values, rtol=1e-5)
    length = few.paths.robot_xy_w.shape[1]
    np.testing.assert_allclose(many.paths.robot_xy_w[:5, :length], few.paths.robot_xy_w, atol=1e-5)


def test_paths_end_where_the_episode_ends():
    env = ToyEnv(ToyConfig(episode_steps=120))
    played = run_episodes(env, make_follower(env), episode_keys(seed=1, episodes=6), record=4)
    paths = played.paths
    assert paths.robot_xy_w.shape[0] == 4 and played.metrics["success"].shape == (6,)
    for i in range(4):
        steps = int(played.metrics["episode_steps"][i])
        assert np.isfinite(paths.robot_xy_w[i, : steps + 1]).all()
        assert np.isnan(paths.robot_xy_w[i, steps + 1 :]).all()
        np.testing.assert_array_equal(paths.robot_xy_w[i, 0], paths.start_xy_w[i])
        # The last point is within the success distance of the goal, the one before it is not.
        left = np.linalg.norm(paths.robot_xy_w[i, : steps + 1] - paths.goal_xy_w[i], axis=-1)
        assert left[-1] < 0.333 <= left[-2]
        # The summed path is the metric.
        travelled = np.linalg.norm(np.diff(paths.robot_xy_w[i, : steps + 1], axis=0), axis=-1).sum()
        assert travelled == pytest.approx(played.metrics["robot_path_m"][i], rel=1e-4)


def test_wilson_interval_by_hand():
    """8 of 10: centre (p + z^2/2n) / (1 + z^2/n), half width z sqrt(pq/n + z^2/4n^2) / (1 + z^2/n)."""
    z2 = 1.959963985**2
    centre = (0.8 + z2 / 20) / (1 + z2 / 10)
    half = math.sqrt(z2) * math.sqrt(0.8 * 0.2 / 10 + z2 / 400) / (1 + z2 / 10)
    low, high = interval("success", np.array([1.0] * 8 + [0.0] * 2))
    assert (low, high) == pytest.approx((centre - half, centre + half), abs=1e-6)
    assert (low, high) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert interval("success", np.ones(10))[1] == 1.0


def test_bootstrap_interval_is_near_the_normal_one():
    """400 standard normal draws: mean +- 1.96 / 20."""
    values = np.random.default_rng(0).normal(size=400)
    low, high = interval("ins_0.5", values)
    half = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.01)
    assert interval("ins_0.5", np.full(5, 0.25)) == (0.25, 0.25)


def test_rows_and_file(tmp_path):
    paths = rollout.Paths(*(np.zeros(0) for _ in range(6)))
    played = rollout.Episodes(np.array([1, 0]), {"success": np.array([1.0, 0.0], np.float32)}, paths)
    scenes = (SimpleNamespace(name="a", split="train"), SimpleNamespace(name="b", split="test"))
    table = episode_table(played, scenes, {"run": "r", "k_int": 0.1})
    write_parquet(table, tmp_path / "deep" / "rows.parquet")
    assert pq.read_table(tmp_path / "deep" / "rows.parquet").to_pylist() == [
        {"run": "r", "k_int": 0.1, "scene": "b", "split": "test", "episode": 0, "success": 1.0},
        {"run": "r", "k_int": 0.1, "scene": "a", "split": "train", "episode": 1, "success": 0.0},
    ]
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="cannot be written"):
        write_parquet(table, tmp_path / "file" / "rows.parquet")
