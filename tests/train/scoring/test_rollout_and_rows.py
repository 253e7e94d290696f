"""Fixed episodes are fixed, their ends are frozen, and intervals are those of the books."""

from __future__ import annotations

import dataclasses
import math
import signal
from types import SimpleNamespace

import jax
import numpy as np
import pyarrow as pa
import pytest

from interactive_nav.task import rollout
from interactive_nav.task.rollout import HostPolicy, episode_keys
from interactive_nav_common.errors import FileError
from interactive_nav_common.rows import read_notes, read_rows, write_parquet
from interactive_nav_common.statistics import Estimate, over_episodes
from tests.train.toy_env import ToyConfig, ToyEnv
from train.runs.run_folder import EvaluationRequest, files_of_run
from train.scoring.evaluation import BatchPlayer
from train.scoring.policies import make_follower, make_random
from train.scoring.rows import Paths, PlayedEpisodes, episode_table


def test_an_episode_is_the_same_whatever_runs_beside_it(monkeypatch):
    """Twelve episodes, in ever smaller batches, against the first five alone: equal number by number."""
    monkeypatch.setattr(rollout, "FEWEST", 2)
    env = ToyEnv(ToyConfig(episode_steps=120))
    many = BatchPlayer(env).play(make_random(env), episode_keys(seed=3, episodes=12), record=12)
    monkeypatch.setattr(rollout, "FEWEST", 10**9)
    few = BatchPlayer(env).play(make_random(env), episode_keys(seed=3, episodes=5), record=5)
    for name, values in few.metrics.items():
        np.testing.assert_allclose(many.metrics[name][:5], values, rtol=1e-5)
    length = few.paths.robot_xy_w.shape[1]
    np.testing.assert_allclose(many.paths.robot_xy_w[:5, :length], few.paths.robot_xy_w, atol=1e-5)


@pytest.mark.parametrize(
    ("size", "running", "left"),
    [(100, 51, 100), (100, 50, 50), (100, 26, 50), (100, 14, 25), (100, 13, 13), (100, 3, 13), (16, 1, 16)]
    + [(400, 301, 400), (400, 300, 300), (400, 226, 300), (400, 225, 225), (400, 114, 225), (400, 113, 113)],
)
def test_a_batch_has_the_smallest_of_its_sizes_that_holds_what_runs(size, running, left):
    """By hand: 100, 50, 25, 13, which is no more than 16; and 400, 300, 225, from where it is by half."""
    over = np.ones(size, bool)
    still = np.random.default_rng(size + running).choice(size, running, replace=False)
    over[still] = False
    kept = rollout.going_on(over)
    assert len(kept) == left == len(set(kept.tolist()))
    assert kept[:running].tolist() == sorted(still.tolist()) and over[kept[running:]].all()


def test_paths_end_where_the_episode_ends():
    env = ToyEnv(ToyConfig(episode_steps=120))
    played = BatchPlayer(env).play(make_follower(env), episode_keys(seed=1, episodes=6), record=4)
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


class Signalled(ToyEnv):
    """The toy, stepped by a callback as physics on the host is; within the third one a signal comes."""

    steps = 0

    def step(self, state, action):
        def on_host(action):
            self.steps += 1
            if self.steps == 3:
                signal.raise_signal(signal.SIGINT)
            return np.asarray(action)

        return super().step(state, jax.pure_callback(on_host, action, action, vmap_method="expand_dims"))


class Ahead(HostPolicy):
    def act(self, state, episode, running, step):
        return np.ones((len(episode), 2), np.float32)


def test_a_signal_within_a_callback_comes_after_it():
    """Raised within it, it would be an error of JAX's."""
    env = Signalled(ToyConfig(episode_steps=120))
    with pytest.raises(KeyboardInterrupt):
        BatchPlayer(env).play(Ahead(), episode_keys(seed=1, episodes=2))
    assert env.steps == 3


class TwoScenes(ToyEnv):
    """The toy in two scenes; a reset may be told which."""

    def reset(self, rng, scene=None):
        state = super().reset(rng)
        index = jax.random.randint(rng, (), 0, 2) if scene is None else scene
        nav = state.info["nav"].replace(scene_index=index)
        return state.replace(info={**state.info, "nav": nav})  # type: ignore[attr-defined]


def test_batches_do_not_change_episodes():
    """Twelve episodes in batches of five (the last one padded) equal twelve at once, paths included."""
    env = TwoScenes(ToyConfig(episode_steps=60))
    keys, scenes, player = episode_keys(seed=3, episodes=12), np.arange(12, dtype=np.int32) % 2, BatchPlayer(env)
    told: list[tuple[int, int]] = []
    whole = player.play(make_random(env), keys, record=8, scene_index=scenes)
    parts = player.play(
        make_random(env), keys, record=8, scene_index=scenes, batch=5, on_progress=lambda *now: told.append(now)
    )
    np.testing.assert_array_equal(whole.scene_index, [0, 1] * 6)
    np.testing.assert_array_equal(parts.scene_index, whole.scene_index)
    for name, values in whole.metrics.items():
        assert values.shape == (12,)
        np.testing.assert_allclose(parts.metrics[name], values, rtol=1e-5, err_msg=name)
    for field in dataclasses.fields(whole.paths):
        expected = getattr(whole.paths, field.name)
        np.testing.assert_allclose(getattr(parts.paths, field.name), expected, atol=1e-5, err_msg=field.name)
    assert told[-1][0] == 12 and [finished for finished, _ in told] == sorted(finished for finished, _ in told)


def test_batches_that_do_not_fit_are_halved(monkeypatch):
    env, notes, sizes = ToyEnv(ToyConfig(episode_steps=60)), [], []
    player = BatchPlayer(env)
    usual = player._chunk

    def small_memory(policy, carry, keys, step):
        sizes.append(len(keys))
        if len(keys) > 3:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 12 bytes.")
        return usual(policy, carry, keys, step)

    monkeypatch.setattr(player, "_chunk", small_memory)
    monkeypatch.setattr(rollout, "FEWEST", 10**9)
    keys = episode_keys(seed=3, episodes=12)
    played = player.play(make_random(env), keys, on_note=notes.append)
    assert sizes[:3] == [12, 6, 3] and set(sizes[3:]) == {3} and len(notes) == 2
    assert "12 episodes at a time do not fit into the device's memory, going on with 6" in notes[0]
    whole = BatchPlayer(env).play(make_random(env), keys)
    np.testing.assert_allclose(played.metrics["robot_path_m"], whole.metrics["robot_path_m"], rtol=1e-5)

    def broken(*_):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")

    monkeypatch.setattr(player, "_chunk", broken)
    with pytest.raises(jax.errors.JaxRuntimeError, match="something else"):
        player.play(make_random(env), keys)


def test_wilson_interval_by_hand():
    """8 of 10: centre (p + z^2/2n) / (1 + z^2/n), half width z sqrt(pq/n + z^2/4n^2) / (1 + z^2/n)."""
    z2 = 1.959963985**2
    centre = (0.8 + z2 / 20) / (1 + z2 / 10)
    half = math.sqrt(z2) * math.sqrt(0.8 * 0.2 / 10 + z2 / 400) / (1 + z2 / 10)
    share = over_episodes("success", np.array([1.0] * 8 + [0.0] * 2))
    low, high = share.low, share.high
    assert (low, high) == pytest.approx((centre - half, centre + half), abs=1e-6)
    assert (low, high) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert over_episodes("success", np.ones(10)).high == 1.0


def test_bootstrap_interval_is_near_the_normal_one():
    """400 standard normal draws: mean +- 1.96 / 20."""
    values = np.random.default_rng(0).normal(size=400)
    mean = over_episodes("ins_0.5", values)
    low, high = mean.low, mean.high
    half = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.01)
    assert over_episodes("ins_0.5", np.full(5, 0.25)) == Estimate(0.25, 0.25, 0.25, 5)


def test_rows_and_file(tmp_path):
    paths = Paths(*(np.zeros(0) for _ in range(6)))
    of_objects = {
        "object_path_m": np.array([[0.5, 0.0, 0.25, 0.0], [0.0] * 4], np.float32),
        "object_contact_steps": np.array([[3, 0, 2, 0], [0] * 4]),
        "object_force_sum_n": np.array([[8.0, 0.0, 4.0, 0.0], [0.0] * 4], np.float32),
    }
    played = PlayedEpisodes(np.array([1, 0]), {"success": np.array([1.0, 0.0], np.float32)}, of_objects, paths)
    scenes = (SimpleNamespace(name="a", split="train"), SimpleNamespace(name="b", split="test"))
    categories = (("toy", "", "chair", ""), ("toy", "chair", "chair", ""))
    table = episode_table(played, scenes, categories, {"run": "r", "k_int": 0.1})
    write_parquet(table, tmp_path / "deep" / "rows.parquet")

    def entry(category, *values):
        names = ("objects", "touched", "contact_steps", "displacement_m", "force_sum_n")
        return {"category": category, **dict(zip(names, values, strict=True))}

    moved = [entry("chair", 2, 1, 2, 0.25, 4.0), entry("toy", 1, 1, 3, 0.5, 8.0)]
    still = [entry("chair", 1, 0, 0, 0.0, 0.0), entry("toy", 1, 0, 0, 0.0, 0.0)]
    row = {"run": "r", "k_int": 0.1}
    assert read_rows([tmp_path / "deep" / "rows.parquet"]).to_pylist() == [
        {**row, "scene": "b", "split": "test", "episode": 0, "success": 1.0, "by_category": moved},
        {**row, "scene": "a", "split": "train", "episode": 1, "success": 0.0, "by_category": still},
    ]
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be written"):
        write_parquet(table, tmp_path / "file" / "rows.parquet")


def test_rows_of_many_files_are_one_table(tmp_path):
    one = pa.table({"run": ["a"] * 2, "policy": ["learned"] * 2, "evaluation_seed": [1] * 2, "scene": ["s"] * 2})
    one = one.append_column("episode", pa.array([0, 1])).append_column("success", pa.array([1.0, 0.0]))
    one = one.append_column("robot", pa.array(["turtlebot"] * 2))
    write_parquet(one, tmp_path / "a.parquet", {"asked": "x"})
    # The same episodes again: the later file counts. And a column that the other lacks.
    again = one.set_column(5, "success", pa.array([0.5, 0.5])).append_column("lifted", pa.array([1.0, 0.0]))
    write_parquet(again, tmp_path / "b.parquet")
    write_parquet(one.set_column(1, "policy", pa.array(["random"] * 2)), tmp_path / "c.parquet")
    rows = read_rows([tmp_path / f"{name}.parquet" for name in "cab"]).to_pydict()
    assert rows["policy"] == ["learned"] * 2 + ["random"] * 2
    assert rows["success"] == [0.5, 0.5, 1.0, 0.0] and rows["lifted"] == [1.0, 0.0, None, None]
    # Another robot's episodes of the same policy are others.
    write_parquet(one.set_column(6, "robot", pa.array(["fetch"] * 2)), tmp_path / "e.parquet")
    rows = read_rows([tmp_path / f"{name}.parquet" for name in "ae"]).to_pydict()
    assert rows["robot"] == ["turtlebot"] * 2 + ["fetch"] * 2
    assert read_notes(tmp_path / "a.parquet") == {"asked": "x"} and read_notes(tmp_path / "b.parquet") == {}
    (tmp_path / "d.parquet").write_bytes(b"PAR1 not")
    assert read_notes(tmp_path / "d.parquet") == {}
    with pytest.raises(FileError, match="d.parquet: not readable as Parquet"):
        read_rows([tmp_path / "d.parquet"])


def test_a_question_names_its_file(tmp_path):
    asked = EvaluationRequest(("alder",), ("learned",), 10, 1, True, "best", False)
    same = EvaluationRequest(("alder",), ("learned",), 10, 1, True, "best", False)
    other = dataclasses.replace(asked, episodes=11)
    assert asked.file_name("a") == same.file_name("a") != other.file_name("a")
    for name in (asked.file_name("a"), other.file_name("a"), asked.file_name("a-b"), "a.parquet", "a-xy.parquet"):
        (tmp_path / name).write_text("")
    assert {path.name for path in files_of_run(tmp_path, "a")} == {asked.file_name("a"), other.file_name("a")}
