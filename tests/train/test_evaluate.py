"""From a run folder to rows, a table and pictures, through the command lines, on the toy."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import signal
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from interactive_nav.task.terms import EPISODE_METRICS
from interactive_nav_common.config import replace
from interactive_nav_common.errors import FileError, UserError
from interactive_nav_common.rows import write_parquet
from tests.train.toy_run import build_toy, toy_config
from train import evaluate
from train.config import RunConfig
from train.figures import __main__ as cli
from train.figures import curves
from train.runs import checkpoint
from train.runs.run import train_run
from train.runs.run_folder import RunFolder, paths_beside
from train.scoring import evaluation, session
from train.scoring.rows import score_table

SPARSE = str(Path(__file__).parents[2] / "scenes_mjcf" / "episodes" / "sparse-turtlebot-test.json.gz")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = toy_config(tmp_path_factory.mktemp("runs"), updates=2)
    _, folder, _ = train_run(config, Console(file=io.StringIO()), build_env=build_toy)
    return folder


@pytest.fixture(scope="module")
def evaluated(run):
    assert evaluate.main([str(run.path), "--episodes", "12", "--seed", "4"], build_env=build_toy) == 0
    return run.path / "evaluation" / "episodes.parquet"


def test_nobody_is_asked_to_follow_waypoints_that_are_not_seen(run, tmp_path, monkeypatch):
    heard = []

    def played(folder, config, player, asked, *_):
        heard.append(asked.policies)
        raise UserError("enough")

    monkeypatch.setattr(session, "evaluate", played)
    words = [str(run.path), "--out", str(tmp_path / "rows.parquet")]
    for more in ([], ["env.observations=[goal]"], ["env.observations=[goal]", "--policies", "follower"]):
        assert evaluate.main(words + more, build_env=build_toy) == 2
    assert heard == [("learned", "random", "follower"), ("learned", "random"), ("follower",)]


def test_rows(evaluated):
    rows = pq.read_table(evaluated)
    assert rows.num_rows == 36
    assert set(EPISODE_METRICS) <= set(rows.column_names)
    frame = rows.to_pydict()
    assert frame["policy"] == ["learned"] * 12 + ["random"] * 12 + ["follower"] * 12
    assert frame["episode"] == list(range(12)) * 3
    assert set(frame["run"]) == {"toy"} and set(frame["scene"]) == {"plane"} and set(frame["split"]) == {"train"}
    assert frame["algorithm"][:13] == ["ppo"] * 12 + [None]
    assert frame["checkpoint_steps"][:13] == [512] * 12 + [None]
    assert set(frame["k_int"]) == {0.1} and set(frame["evaluation_seed"]) == {4}
    # The same episodes for every policy: the shortest path belongs to the episode, not to who drives.
    shortest = np.array(frame["shortest_path_m"]).reshape(3, 12)
    np.testing.assert_array_equal(shortest[0], shortest[1])
    np.testing.assert_array_equal(shortest[0], shortest[2])
    assert np.unique(shortest[0]).size == 12
    # The follower arrives within the toy's 60 steps far more often than chance.
    success = np.array(frame["success"]).reshape(3, 12).mean(1)
    assert success[2] >= success[1] + 0.4
    ins = 0.5 * np.array(frame["path_efficiency"]) + 0.5 * np.array(frame["effort_efficiency"])
    np.testing.assert_allclose(frame["ins_0.5"], ins, rtol=1e-6)


def test_table_shows_means_and_intervals(evaluated):
    rows = pq.read_table(evaluated)
    console = Console(file=io.StringIO(), width=160)
    console.print(score_table(rows, "title"))
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    random_success = rows["success"].to_numpy()[12:24].mean()
    line = next(line for line in printed.splitlines() if " random " in line)
    assert f"{random_success:.3f} [" in line and " 12 " in line
    assert "Wilson" in printed and "bootstrap" in printed


def test_evaluation_is_repeatable_and_choosable(run, evaluated, tmp_path):
    out = tmp_path / "again.parquet"
    words = [
        str(run.path),
        "--episodes",
        "5",
        "--seed",
        "4",
        "--policies",
        "follower,learned",
        "--checkpoint",
        "last",
    ]
    assert evaluate.main([*words, "--out", str(out), "--record", "0"], build_env=build_toy) == 0
    first, again = pq.read_table(evaluated).to_pydict(), pq.read_table(out).to_pydict()
    np.testing.assert_allclose(again["robot_path_m"][:5], first["robot_path_m"][24:29], rtol=1e-5)
    np.testing.assert_allclose(again["robot_path_m"][5:], first["robot_path_m"][:5], rtol=1e-5)


@pytest.fixture(scope="module")
def second(run, tmp_path_factory):
    """Another run of the same kind: other numbers, another k_int and seed."""
    config = toy_config(tmp_path_factory.mktemp("runs"), updates=2, seed=5)
    run_config = dataclasses.replace(config.run, name="other")
    config = dataclasses.replace(config, env=replace(config.env, k_int=1.0), run=run_config)
    _, folder, _ = train_run(config, Console(file=io.StringIO()), build_env=build_toy)
    return folder


def test_runs_of_one_kind_are_evaluated_in_one_go_into_a_dataset(run, second, evaluated, tmp_path):
    """One environment, compiled once; a file a run, with the rows that it has alone; pandas and DuckDB read all."""
    pandas = pytest.importorskip("pandas")
    built = []

    def build(config):
        built.append(build_toy(config))
        return built[-1]

    traced = []
    usual = evaluation.BatchPlayer._play_chunk

    def counted(*arguments):
        traced.append(arguments)
        return usual(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation.BatchPlayer, "_play_chunk", counted)
        words = ["--policies", "learned", "--episodes", "12", "--seed", "4", "--dataset", str(tmp_path)]
        assert evaluate.main([str(run.path), str(second.path), *words], build_env=build) == 0
        once = len(traced)
        assert evaluate.main([str(run.path), *words], build_env=build) == 0
    assert len(built) == 2  # one for both runs, one for the second command
    assert once == len(traced) - once  # two runs traced the program as often as one
    frame = pandas.read_parquet(tmp_path)
    assert sorted(frame.groupby("run").size().to_dict().items()) == [("other", 12), ("toy", 12)]
    assert frame.groupby("run")[["k_int", "seed"]].first().to_dict("index") == {
        "other": {"k_int": 1.0, "seed": 5},
        "toy": {"k_int": 0.1, "seed": 0},
    }
    assert set(frame["train_env_steps"]) == {512} and set(frame["train_device"]) == {"cpu"}
    assert frame["versions"].str.contains("mujoco=").all() and (frame["evaluation_wall_s"] > 0).all()
    assert (frame["train_wall_s"] > 0).all()
    alone = pq.read_table(evaluated).to_pandas().query("policy == 'learned'")
    both = frame.query("run == 'toy'").sort_values("episode")
    np.testing.assert_allclose(both["robot_path_m"], alone["robot_path_m"], rtol=1e-5)
    duckdb = pytest.importorskip("duckdb")
    query = f"""select run, count(*), avg("ins_0.5") from '{tmp_path}/*.parquet' group by run order by run"""
    means = frame.groupby("run")["ins_0.5"].mean()
    assert duckdb.sql(query).fetchall() == [
        (name, 12, pytest.approx(means[name], rel=1e-6)) for name in ("other", "toy")
    ]
    # The same question replaces its file, another one adds to the folder.
    files = {path.name for path in tmp_path.glob("*.parquet")}
    assert len(files) == 2
    words[words.index("4")] = "9"
    assert evaluate.main([str(run.path), *words], build_env=build) == 0
    assert len({path.name for path in tmp_path.glob("*.parquet")} - files) == 1
    assert pandas.read_parquet(tmp_path).groupby("run").size().to_dict() == {"other": 12, "toy": 24}


def test_policies_that_never_learned_need_no_run_folder(tmp_path, monkeypatch):
    """The README's line: without --out the rows lie where those of a run of that name would."""
    monkeypatch.chdir(tmp_path)
    words = ["--scenes", "plane", "--policies", "random", "--episodes", "3"]
    assert evaluate.main(words, build_env=build_toy) == 0
    rows = tmp_path / "runs" / "baselines" / "evaluation" / "episodes.parquet"
    assert pq.read_table(rows)["policy"].to_pylist() == ["random"] * 3 and paths_beside(rows).is_file()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_is_stopped_keeps_the_policies_that_have_played(run, tmp_path, monkeypatch, capsys, number):
    """A signal in the second policy: the first one's rows are there; whole rows of before are not given up for them."""
    out, words = tmp_path / "rows.parquet", [str(run.path), "--episodes", "3", "--policies", "random,follower"]
    played = evaluation.BatchPlayer.play
    count = []

    def stopped(self, *arguments, **keywords):
        count.append(1)
        if len(count) % 2 == 0:
            signal.raise_signal(number)
        return played(self, *arguments, **keywords)

    with monkeypatch.context() as patch:
        patch.setattr(evaluation.BatchPlayer, "play", stopped)
        assert evaluate.main([*words, "--out", str(out)], build_env=build_toy) == 128 + number
    told = f"train.evaluate: stopped by {number.name}; kept: rows of random in "
    assert capsys.readouterr().err == f"{told}{out}\n"
    assert pq.read_table(out)["policy"].to_pylist() == ["random"] * 3
    assert evaluate.main([*words, "--out", str(out)], build_env=build_toy) == 0
    whole = out.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(evaluation.BatchPlayer, "play", stopped)
        assert evaluate.main([*words, "--out", str(out)], build_env=build_toy) == 128 + number
    begun = tmp_path / ".unfinished-rows.parquet"
    assert capsys.readouterr().err == f"{told}{begun}\n"
    assert out.read_bytes() == whole and pq.read_table(out).num_rows == 6
    assert pq.read_table(begun)["policy"].to_pylist() == ["random"] * 3 and paths_beside(begun).is_file()
    assert evaluate.main([*words, "--out", str(out)], build_env=build_toy) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rows.npz", "rows.parquet"]


def test_what_is_stopped_before_any_has_played_keeps_nothing_and_says_what_was_to_be_played(run, tmp_path, capsys):
    usual = signal.getsignal(signal.SIGTERM)

    def build(config):
        said.append(capsys.readouterr().out)
        signal.raise_signal(signal.SIGTERM)

    said: list[str] = []
    words = [str(run.path), "--episodes", "3", "--policies", "random,follower", "--out", str(tmp_path / "rows.parquet")]
    assert evaluate.main(words, build_env=build) == 143
    assert said == ["toy: 3 episodes by each of random, follower in toy; loading and compiling first\n"]
    assert capsys.readouterr().err == "train.evaluate: stopped by SIGTERM; kept: nothing, no policy had played all\n"
    assert signal.getsignal(signal.SIGTERM) is usual and list(tmp_path.iterdir()) == []


def test_rows_are_never_without_their_paths(run, tmp_path, monkeypatch):
    """Paths come first: whoever finds rows finds paths that are as new; a run that is only read is left as it is."""
    before = {path: path.stat().st_mtime_ns for path in run.path.rglob("*") if "evaluation" not in str(path)}
    seen = []

    def at_rows(rows, path, *others):
        seen.append((path.is_file(), paths_beside(path).is_file() and paths_beside(path).read_bytes()))
        write_parquet(rows, path, *others)

    monkeypatch.setattr(session, "write_parquet", at_rows)
    words = [str(run.path), "--policies", "random", "--episodes", "2", "--dataset", str(tmp_path)]
    for record in ("1", "2"):
        assert evaluate.main([*words, "--record", record], build_env=build_toy) == 0
    (rows,) = tmp_path.glob("*.parquet")
    assert [there for there, _ in seen] == [False, True]
    assert seen[0][1] != seen[1][1] == paths_beside(rows).read_bytes()
    assert before == {path: path.stat().st_mtime_ns for path in before}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--policies", "lerned"],
            "--policies: got 'lerned', expected a choice from learned, random, follower, avoider, namo:W",
        ),
        (["--policies", "namo:x"], "policy namo: got 'namo:x', expected a weight, as in namo:0.5"),
        (["--policies", "namo:2"], "policy namo: weight is 2.0, expected between 0 and 1"),
        (["--episode-file", "/nowhere.json"], "--episode-file: /nowhere.json: no such file"),
        (["--episode-file", SPARSE, "--episodes", "1001"], "--episodes is 1001, expected at most 1000"),
        (["--checkpoint", "7"], "no checkpoint '7'; expected best, last or one of 512"),
        (["--episode-file", SPARSE, "--balanced"], "--balanced has no effect with --episode-file, whose episodes are"),
        (["--episode-file", SPARSE, "--seed", "0"], "--seed has no effect with --episode-file"),
        (["--dataset", "d", "--out", "x.parquet"], "--out has no effect with --dataset, where each file has its name"),
        (["--episodes", "0"], "--episodes is 0, expected at least 1"),
        (["--seed", str(2**70)], "--seed is 1180591620717411303424, expected between -"),
        (["--record", "-1"], "--record is -1, expected 0 or more"),
        (["--policies", ","], "--policies is ',', expected at least one, such as learned"),
        (["--batch", "0"], "--batch is 0, expected at least 1"),
        (["another", "--out", "rows.parquet"], "--out is for one run; several write into a folder: --dataset DIR"),
        (["ppo.learning_rate=1"], "expected env.<setting>=value"),
        (["env.k_in=1"], "unknown key 'env.k_in', did you mean 'env.k_int'?"),
    ],
)
def test_mistakes_are_one_line_and_exit_2(run, capsys, words, message):
    assert evaluate.main([str(run.path), *words], build_env=build_toy) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train.evaluate: ") and message in line


def test_no_run_folder(tmp_path, capsys):
    assert evaluate.main([str(tmp_path)], build_env=build_toy) == 2
    assert "is no run folder (no config.yaml)" in capsys.readouterr().err
    (tmp_path / "config.yaml").write_text("\n")
    assert evaluate.main([str(tmp_path)], build_env=build_toy) == 2
    assert "config.yaml: is empty, expected the config of a run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("metrics.jsonl.gz", b"xx", "metrics.jsonl.gz: not readable"),
        ("evaluation/episodes.npz", b"PK\x03\x04", "episodes.npz: not readable"),
        ("metrics.jsonl", b"5\n\xff", ""),
    ],
)
def test_damaged_files_are_one_line_for_figures(run, evaluated, tmp_path, capsys, name, data, message):
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    (copy / name).write_bytes(data)
    assert cli.main([str(copy), "-o", str(tmp_path / "f")]) == (2 if message else 0)
    assert message in capsys.readouterr().err


def test_a_run_folder_with_damaged_files(tmp_path):
    folder = RunFolder(tmp_path)
    folder.config.write_bytes(bytes(range(256)))
    with pytest.raises(FileError, match=r"config.yaml: not readable as the config of a run \(UnicodeDecodeError"):
        folder.read_config()
    assert folder.origin()["env_steps"] is None
    for name in ("versions.json", "summary.json"):
        (tmp_path / name).write_text("[]")
        with pytest.raises(FileError, match=rf"{name}: got \[\], expected a mapping"):
            folder.origin()
    with pytest.raises(UserError, match="name is '..', expected one folder name"):
        RunConfig(name="..")


def test_checkpoint_of_another_robot(run, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    path, meta = checkpoint.find(copy / "checkpoints", "last")
    (path / checkpoint.META).write_text(json.dumps({**dataclasses.asdict(meta), "robot": "fetch"}))
    out = copy / "rows.parquet"
    assert evaluate.main([str(copy), "--out", str(out)], build_env=build_toy) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "robot of the checkpoint: 'fetch', of the environment: 'turtlebot'" in line
    assert not out.exists()


def test_figures(run, evaluated, tmp_path, capsys):
    assert cli.main([str(run.path), "-o", str(tmp_path / "f")]) == 0
    made = sorted(path.name for path in (tmp_path / "f").iterdir())
    assert made == ["frontier_toy.png", "learning_curves.png", "trajectories_toy.png"]
    assert all((tmp_path / "f" / name).stat().st_size > 10_000 for name in made)
    capsys.readouterr()
    (tmp_path / "empty").mkdir()
    assert cli.main([str(tmp_path / "empty")]) == 2
    assert "nothing to draw" in capsys.readouterr().err


def test_curves_show_what_was_logged():
    figure = curves.learning_curves({"a": [{"env_steps": 10, "episode/success": 0.25}, {"env_steps": 20}]})
    (line,) = figure.axes[0].lines
    np.testing.assert_array_equal(line.get_xydata(), [[10, 0.25]])
