"""What is kept of a sweep: rounded rows, thinner curves, and the checkpoint of each cell's best run alone."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from interactive_nav_common.records import PACKED_METRICS, read_metrics
from interactive_nav_common.rows import read_notes, read_rows, write_parquet
from tests.train.sweep.test_sweep import write_sweep
from tests.train.synthetic import run_rows
from train.runs import checkpoint
from train.runs.run_folder import paths_beside
from train.sweep import export as export_module
from train.sweep import spec
from train.sweep.__main__ import main
from train.sweep.export import ORDER, rounded, thinned, without_train_details
from train.sweep.folder import SweepFolder


def test_curves_are_means_over_episodes():
    lines = [
        {"env_steps": 10, "wall_s": 1.0, "episodes": 1.0, "episode/success": 1.0, "loss/v": 9.0},
        {"env_steps": 20, "wall_s": 2.0, "episodes": 3.0, "episode/success": 0.0},
        {"env_steps": 30, "wall_s": 3.0, "episodes": 0.0},
        {"env_steps": 40, "wall_s": 4.123456, "episodes": 2.0, "episode/success": 0.123456},
    ]
    assert thinned(lines, 2) == [
        {"env_steps": 20, "wall_s": 2.0, "episodes": 4.0, "episode/success": 0.25},
        {"env_steps": 40, "wall_s": 4.1235, "episodes": 2.0, "episode/success": 0.12346},
    ]
    assert [line["env_steps"] for line in thinned(lines, 100)] == [10, 20, 30, 40]
    assert [line["env_steps"] for line in thinned(lines, 3)] == [20, 40] and thinned([], 5) == []


def test_rows_are_rounded_by_column_also_in_lists():
    """By hand; a half goes to the even neighbour. What has no step, is no float or is missing stays as it is."""
    entry = {"category": "toy", "touched": 3, "displacement_m": 1.5 / 128 + 1e-5, "force_sum_n": 20.0}
    near = {**entry, "displacement_m": 2 / 128, "force_sum_n": 16.0}
    f32, f64 = pa.float32(), pa.float64()
    entries = pa.list_(
        pa.struct({"category": pa.string(), "touched": pa.int32(), "displacement_m": f32, "force_sum_n": f32})
    )
    rows = pa.table(
        {
            "run": ["a", "b", "c"],
            "k_int": pa.array([0.1, 0.1, 0.1], f64),
            "ins_0.5": pa.array([0.3, 1.0, None], f32),
            "robot_path_m": pa.array([2.01, 0.25, 1 / 256], f32),
            "force_sum_n": pa.array([4.0, 12.0, 526777.0], f32),
            "train_wall_s": pa.array([7.005, float("inf"), None], f64),
            "episode_steps": pa.array([3, 4, 5], pa.int32()),
            "by_category": pa.array([[entry, entry], None, []], entries),
        }
    )
    told = rounded(rows)
    assert told.schema.equals(rows.schema) and told.to_pydict() == {
        **rows.to_pydict(),
        "ins_0.5": [307 / 1024, 1.0, None],
        "robot_path_m": [257 / 128, 0.25, 0.0],
        "force_sum_n": [0.0, 16.0, 526776.0],
        "train_wall_s": [448 / 64, float("inf"), None],
        "by_category": [[near, near], None, []],
    }
    assert rounded(told).equals(told) and rounded(pa.concat_tables([rows[2:], rows[:2]])).equals(
        pa.concat_tables([told[2:], told[:2]])
    )
    assert rounded(rows[:0]).equals(rows[:0])


def test_what_no_table_has_of_seen_homes_is_kept_of_unseen_ones_where_there_are_any():
    told = pa.array([[{"objects": 2}], [{"objects": 3}], None])
    rows = pa.table(
        {"by_category": told, "force_sum_n": [8.0, 16.0, 0.0], "split": ["train", "test", "test"], "n": [0, 1, 2]}
    )
    kept = without_train_details(rows)
    assert kept.schema.equals(rows.schema) and kept["by_category"].to_pylist() == [None, [{"objects": 3}], None]
    assert kept["force_sum_n"].to_pylist() == [None, 16.0, 0.0]
    left = ["by_category", "force_sum_n"]
    assert kept.drop(left).equals(rows.drop(left))
    assert without_train_details(rows[:1]).equals(rows[:1]) and without_train_details(rows[:0]).equals(rows[:0])
    assert without_train_details(rows.drop(left)).equals(rows.drop(left))


@pytest.fixture
def swept(tmp_path):
    """Two cells of two runs; seed 1 is the better one at k_int = 0, seed 0 at k_int = 1 (which has no checkpoint)."""
    folder = SweepFolder(spec.load_sweep(str(write_sweep(tmp_path))))
    folder.prepare()
    for run in folder.sweep.runs:
        home = folder.runs / run.name
        k_int, seed = run.values["env.k_int"], run.values["run.seed"]
        home.mkdir()
        (home / "summary.json").write_text("{}")
        (home / "metrics.jsonl").write_text(json.dumps({"env_steps": 5, "episodes": 1.0}) + "\n")
        rows = run_rows("turtlebot", "ppo", k_int, seed, 0.5 + 0.1 * (seed if k_int == 0.0 else -seed), (0.5, 0.5))
        rows = rows.set_column(0, "run", [[run.name] * len(rows)])
        write_parquet(rows, folder.rows / folder.request(run).file_name(run.name), {"trained_steps": "5"})
        if k_int == 0.0:
            meta = checkpoint.CheckpointMeta(5, 1.0, 0.5, "ppo", "turtlebot", ("goal",), 3, 2)
            state = {"x": np.zeros(4)}
            learner = {"params": {"w": np.full(3, seed, np.float32)}, "normalizer_params": {}}
            snapshot = type("S", (), {"learner": learner, "env_state": state})()
            checkpoint.save_snapshot(home / "checkpoints", snapshot, meta, 1, 1.0)
    return folder


def test_what_is_kept(swept, tmp_path, capsys):
    out = tmp_path / "results"
    old = out / "rows" / "k_int0-seed0-01234567.parquet"
    elsewhere = run_rows("fetch", "sac", 1.0, 3, 0.7, (0.5, 0.5))
    write_parquet(elsewhere, out / "rows" / "elsewhere-01234567.parquet", {"asked": "there"})
    superseded = run_rows("turtlebot", "ppo", 0.0, 0, 0.7, (0.5, 0.5))  # of an evaluation that the sweep lacks now
    superseded = superseded.set_column(0, "run", [["k_int0-seed0"] * len(superseded)])
    never = run_rows("turtlebot", "ppo", 0.0, 9, 0.7, (0.5, 0.5))
    never = never.set_column(0, "run", [["baselines"] * len(never)])
    write_parquet(never, swept.rows / "baselines-01234567.parquet", {"asked": "here"})
    (rows,) = swept.rows.glob("k_int1-seed0-*.parquet")
    paths_beside(rows).parent.mkdir()
    paths_beside(rows).write_bytes(b"where it went")
    for _ in range(2):  # again replaces
        old.parent.mkdir(parents=True, exist_ok=True)
        write_parquet(superseded, old)
        assert main([str(tmp_path / "small.yaml"), "--export", str(out)]) == 0
        printed = capsys.readouterr().out
        assert "checkpoint of k_int0-seed1" in printed and "k_int0-seed0" not in printed and "MiB" in printed
        (merged,) = (out / "rows").glob("*.parquet")  # with what another machine had brought
        assert len(read_rows([merged])) == (4 + 2) * 40 and read_notes(merged) == {"asked": "here\nthere"}
        found, given = (read_rows([path]).filter(pc.field("run") == "k_int1-seed0") for path in (merged, rows))
        order = [(name, "ascending") for name in ORDER]
        assert found.select(given.column_names).equals(rounded(given).sort_by(order))
        (kept,) = (out / "rows" / "_paths").iterdir()
        assert kept.name == paths_beside(rows).name and kept.read_bytes() == b"where it went"
        assert sorted(path.name for path in (out / "runs").iterdir()) == [run.name for run in swept.sweep.runs]
        assert read_metrics(out / "runs" / "k_int1-seed0" / PACKED_METRICS) == [{"env_steps": 5, "episodes": 1.0}]
        (kept,) = out.rglob("policy.safetensors")
        assert kept.parts[-4] == "k_int0-seed1" and not list(out.rglob(checkpoint.ENV_STATE))
        path, _ = checkpoint.find(out / "runs" / "k_int0-seed1" / "checkpoints", "best")
        learner = checkpoint.load_learner(path, {"params": {"w": np.zeros(3, np.float32)}, "normalizer_params": {}})
        np.testing.assert_array_equal(learner["params"]["w"], [1.0] * 3)
    # A policy that was kept alone, brought back into a sweep's folder, is kept as it is.
    path, _ = checkpoint.find(out / "runs" / "k_int0-seed1" / "checkpoints", "best")
    brought = swept.runs / "k_int0-seed1" / "checkpoints"
    shutil.rmtree(brought)
    shutil.copytree(path.parent, brought)
    assert main([str(tmp_path / "small.yaml"), "--export", str(tmp_path / "again")]) == 0
    (again,) = (tmp_path / "again").rglob("policy.safetensors")
    assert again.read_bytes() == (path / "policy.safetensors").read_bytes()


def test_a_sweep_that_never_began_exports_nothing(tmp_path, capsys):
    assert main([str(write_sweep(tmp_path)), "--export", str(tmp_path / "results")]) == 2
    assert "no run of the sweep has started there" in capsys.readouterr().err and not (tmp_path / "results").exists()


def test_rows_that_are_kept_are_never_without_their_paths(swept, tmp_path, monkeypatch):
    """Killed at any point, what lies there are the old rows or the new ones, each with its paths."""
    out = tmp_path / "results"
    (rows,) = swept.rows.glob("k_int1-seed0-*.parquet")
    paths_beside(rows).parent.mkdir()
    paths_beside(rows).write_bytes(b"where it went")
    old = out / "rows" / "k_int1-seed0-01234567.parquet"
    write_parquet(run_rows("turtlebot", "ppo", 1.0, 0, 0.7, (0.5, 0.5)), old)
    paths_beside(old).parent.mkdir()
    paths_beside(old).write_bytes(b"where it went before")

    def killed(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(export_module, "write_parquet", killed)
    with pytest.raises(KeyboardInterrupt):
        export_module.export(swept, out)
    assert old.is_file() and paths_beside(old).is_file()
    assert (out / "rows" / "_paths" / paths_beside(rows).name).read_bytes() == b"where it went"
    monkeypatch.undo()
    export_module.export(swept, out)
    assert [path.name for path in (out / "rows" / "_paths").iterdir()] == [paths_beside(rows).name]
    assert [path.name for path in (out / "rows").glob("*.parquet")] == ["episodes.parquet"]
