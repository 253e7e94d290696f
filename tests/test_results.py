"""The committed results: complete, traceable, small, and what the results pages say of them."""

from __future__ import annotations

import collections
import dataclasses
import importlib.util
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pandas
import pytest
from rich.console import Console

from docs.studies.homes import navigator
from interactive_nav.config import WINDOW
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import PACKED_METRICS, read_metrics
from interactive_nav_common.rows import read_rows, where
from interactive_nav_common.statistics import estimate
from topological_nav.evaluate.scores import differences, markdown, summary, text
from topological_nav.tables import tables as topological_tables
from train.config_io import load_config
from train.figures import tables
from train.runs.run import config_to_play
from train.runs.run_folder import RunFolder
from train.sweep import spec

ROOT = Path(__file__).resolve().parents[1]
SWEPT = ROOT / "results" / "kint"
LIMIT_MIB = 15


def test_they_are_small():
    assert sum(path.stat().st_size for path in (ROOT / "results").rglob("*") if path.is_file()) < LIMIT_MIB * 2**20


def test_every_run_is_whole_and_says_where_it_comes_from():
    """DuckDB reads the folder as it is: each run played the same hundred episodes in each of ten scenes."""
    duckdb = pytest.importorskip("duckdb")
    found = duckdb.sql(
        f"""select run, count(*), count(distinct scene), sum(shortest_path_m), min(train_env_steps),
        max(train_env_steps), any_value(train_device), any_value(train_commit)
        from '{SWEPT}/rows/*.parquet' group by run"""
    ).fetchall()
    sweep = spec.load_sweep("kint")
    known = {run.name: run for run in sweep.runs}
    assert {name for name, *_ in found} == set(known) and len(known) == 54
    for name, count, scenes, shortest_m, least, most, device, commit in found:
        run = known[name]
        assert (count, scenes) == (1000, 10) and count == sweep.config.evaluate.episodes
        assert least == most >= run.config.run.num_timesteps, name
        assert "H200" in device and len(commit) >= 7, name
        robot = run.config.env.robot
        same = [total for other, _, _, total, *_ in found if known[other].config.env.robot == robot]
        assert shortest_m == pytest.approx(same[0], rel=1e-6), name
        kept = SWEPT / "runs" / name
        summary, versions = (json.loads((kept / f"{part}.json").read_text()) for part in ("summary", "versions"))
        assert summary["completed"] and summary["env_steps"] == most and summary["wall_s"] > 0
        assert versions["packages"]["mujoco-mjx"] and versions["commit"] == commit
        assert len(read_metrics(kept / PACKED_METRICS)) >= 10
    best = [path.parents[1] for path in SWEPT.glob("runs/*/checkpoints/*")]
    cells = {known[path.name].cell for path in best}  # PPO's policy of each robot with k_int 0
    assert len(cells) == len(best) == 2 and all("-ppo-" in path.name for path in best)
    assert all((path / "config.yaml").is_file() for path in best)


def test_runs_above_the_planners_played_the_same_episodes_as_these():
    kept = ROOT / "results" / "above"
    full, rest, planned = (pandas.read_parquet(kept / f"{x}.parquet") for x in ("episodes", "ablations", "planners"))
    rows, scale = pandas.concat([full, rest]), pandas.read_parquet(kept / "scale.parquet")
    assert {path.name for path in (kept / "runs").iterdir()} == {*rows.run, *scale.run}
    assert set(scale.groupby(["run", "checkpoint_steps"]).episode.nunique()) == {1000} and len(scale) == 8000
    assert scale.scene.nunique() == 100 and not scale.nonfinite.any()
    played = pandas.concat([rows, planned.assign(run=planned.policy)]).groupby(["robot", "run"])
    assert set(played.episode.nunique()) == set(played.size()) == {1000}
    for _, sums in played.shortest_path_m.sum().groupby("robot"):
        np.testing.assert_allclose(sums, sums.iloc[0], rtol=1e-6)
    assert rows.scene.nunique() == 100 and (rows.train_env_steps == rows.checkpoint_steps).all()
    assert set(full.train_env_steps) == {13_107_200}
    assert set(rows.train_device) == {"NVIDIA H200"} and not rows.nonfinite.any()
    for name, commits in rows.groupby("run").train_commit.unique().items():
        run = kept / "runs" / str(name)
        summary, versions = (json.loads((run / f"{x}.json").read_text()) for x in ("summary", "versions"))
        assert summary["completed"] and [summary["env_steps"]] == list(rows[rows.run == name].train_env_steps.unique())
        assert [versions["commit"]] == list(commits) and len(read_metrics(run / PACKED_METRICS)) >= 10
        assert versions["argv"][:3] == ["train", "--config", "turtlebot_above"]
    for robot in ("turtlebot", "fetch"):  # the packaged policies are those of seed 0
        packaged = ROOT / "train" / "policies" / f"{robot}_above"
        config, trained = (RunFolder(x).read_config() for x in (packaged, kept / "runs" / f"{robot}-seed0"))
        assert trained.network.memory == "gru" and trained.env.k_int == 0
        assert dataclasses.replace(config.env, scenes=trained.env.scenes) == trained.env
        assert (config.ppo, config.network) == (trained.ppo, trained.network)
        (meta,) = packaged.glob("checkpoints/000013107200/meta.json")
        assert json.loads(meta.read_text())["robot"] == robot
    # By hand, from the rows of one cell: the TurtleBot's success without masks.
    (without_masks,) = (x for _, x in rest.groupby("run") if "nomasks" in x.run.iloc[0])
    mean = without_masks.success.sum() / len(without_masks)
    page = (ROOT / "docs" / "results-planners.md").read_text()
    assert f"| the same without masks | {mean:.3f} |" in page
    # By hand: each home counts once, however many episodes it has.
    last, planner = (
        scale[scale.checkpoint_steps == 80_117_760],
        planned.query("policy == 'namo:1' and robot == 'turtlebot'"),
    )
    ours, theirs = ({name: part["ins_0.5"].mean() for name, part in x.groupby("scene")} for x in (last, planner))
    less = sum(ours[name] - theirs[name] for name in ours) / len(ours)
    assert f"| 80.1 | 100 | {last.success.mean():.3f} | {last['ins_0.5'].mean():.3f} | {less:.3f} [" in page


CONTROL = {"hook": "twist", "hand": "hand", "joints": "whole_body"}


def test_policies_that_open_doors_played_the_same_episodes_and_were_trained_by_the_preset():
    kept, presets = ROOT / "results" / "tasks", [load_config(name) for name in ("fetch_hook", "fetch_lift")]
    rows = pandas.read_parquet(kept / "episodes.parquet")
    unseen = rows[rows.homes == "sparse"]
    for _, played in unseen.groupby(["task", "robot"]):
        of_each = played.groupby(["policy", "run"]).shortest_path_m
        assert set(of_each.size()) == {100} and len(of_each) >= 3
        np.testing.assert_allclose(of_each.sum(), played.shortest_path_m.sum() / len(of_each), rtol=1e-6)
    assert {path.name for path in (kept / "runs").iterdir()} == set(rows[rows.policy == "learned"].run)
    learned = rows[rows.policy == "learned"].groupby("run").first()
    for path in (*kept.glob("runs/*/config.yaml"), ROOT / "train" / "policies" / "fetch_hook" / "config.yaml"):
        config = RunFolder(path.parent).read_config()
        preset = presets[config.env.control_mode in ("hand", "whole_body")]
        ours = {name: getattr(preset.env, name) for name in ("task", "backend", "control_mode", "scenes")}
        assert dataclasses.replace(config.env, **ours) == preset.env
        assert (config.ppo, config.network) == (preset.ppo, preset.network)
        if path.parent.name in learned.index:
            assert config.env.task == learned.task[path.parent.name]
            assert config.env.control_mode == CONTROL[learned.control[path.parent.name]]
    # By hand, from the rows of one cell.
    opened = unseen.query("task == 'clear' and policy == 'learned'").groupby("seed").success.sum()
    page = (ROOT / "docs" / "results-tasks.md").read_text()
    assert f"| `clear` | fetch, `learned` | {opened.sum() / 300:.3f} [" in page and len(opened) == 3


def test_runs_in_cluttered_homes_played_the_same_episodes_and_say_where_they_come_from():
    """Every run of the sweep, and every planner, the thousand of each split."""
    kept = ROOT / "results" / "cluttered"
    rows, planned = (read_rows([kept / x / "episodes.parquet"]) for x in ("rows", "baselines"))
    keys, wanted = ["run", "robot", "split", "policy"], [("episode", "count_distinct"), ("shortest_path_m", "sum")]
    parts, others = (x.group_by(keys).aggregate([("episode", "count"), *wanted]).to_pylist() for x in (rows, planned))
    cells = itertools.product(("0", "0.1", "1"), ("turtlebot", "fetch"), ("ppo", "sac", "ddpg"), range(3))
    assert collections.Counter(x["run"] for x in parts) == {f"k_int{k}-{r}-{a}-seed{s}": 2 for k, r, a, s in cells}
    assert {"avoider", "namo:0.25", "namo:0.5", "namo:0.75", "namo:1"} <= {x["policy"] for x in others}
    for part in parts + others:
        assert part["episode_count"] == part["episode_count_distinct"] == 1000
        same = next(x for x in parts if (x["robot"], x["split"]) == (part["robot"], part["split"]))
        assert part["shortest_path_m_sum"] == pytest.approx(same["shortest_path_m_sum"], rel=1e-6)
    facts = rows.group_by("run").aggregate(
        [("train_device", "max"), ("train_commit", "max"), ("train_env_steps", "min")]
    )
    for name, device, commit, steps in (tuple(row.values()) for row in facts.to_pylist()):
        summary, versions = (
            json.loads((kept / "runs" / name / f"{x}.json").read_text()) for x in ("summary", "versions")
        )
        assert summary["completed"] and summary["env_steps"] == steps >= (6_500_000 if "-ppo-" in name else 2_000_000)
        assert ("H200" in device or "H100" in device) and versions["commit"] == commit
        assert len(read_metrics(kept / "runs" / name / PACKED_METRICS)) >= 10


@pytest.mark.slow
@pytest.mark.parametrize("sweep", ["cluttered", "kint"])
def test_the_tables_are_those_of_the_rows(sweep):
    """To the byte what `python -m train.figures results/SWEEP --tables` prints."""
    kept = ROOT / "results" / sweep
    assert (kept / "tables.md").read_text() == tables.document(read_rows(sorted(kept.rglob("*.parquet"))), "test")


@pytest.mark.parametrize("rows", ["rows", "rows-policy"])
@pytest.mark.parametrize("size", ["cpu", "full"])
def test_the_topological_tables_are_those_of_their_rows(size, rows):
    folder = ROOT / "results" / "topological" / size
    played = read_rows(sorted((folder / rows).glob("*.parquet")))
    # The page has what they say of all scenes together, and the baseline's rows of the full size.
    page = {"cpu": "topological-log.md", "full": "topological-results.md"}[size]
    told, lines = (ROOT / "docs" / page).read_text(), markdown(summary(played), differences(played)).splitlines()
    everywhere = [cells for line in lines if (cells := line.strip("| ").split(" | "))[1:2] == ["all"]]
    assert "dense" in [cells[0] for cells in everywhere]
    for who, _, _, success, spl, rc, *_ in everywhere:
        assert (size == "cpu" and who == "expert") or all(score in told for score in (success, spl, rc)), who
    if (size, rows) == ("full", "rows"):
        assert [line for line in lines if line.startswith("| dense |") and line not in told] == []
    if (size, rows) == ("full", "rows-policy"):
        homes = [" | ".join(line.split(" | ")[1:8]) for line in lines if line.startswith("| dense |")]
        assert len(homes) == 13 and [home for home in homes if f"| {home} |" not in told] == []


@pytest.mark.parametrize(
    "name",
    ["ahead1", pytest.param("batch", marks=pytest.mark.heavy)]  # a minute of bootstrap over 8,000 episodes
    + [f"{which}{by}" for which in ("unadapted", "adapted") for by in ("", "-gl", "-policy", "-gl-policy")],
)
def test_the_further_topological_tables_are_those_of_their_rows(name):
    folder = ROOT / "results" / "topological" / "full"
    played = read_rows(sorted((folder / f"rows-{name}").glob("*.parquet")))
    # The page has the means over ten scenes, but a line for each of two: their mean's interval says nothing.
    page = "topological-transfer.md" if "adapted" in name else "topological-results.md"
    told, found = (ROOT / "docs" / page).read_text(), summary(played)
    scenes = [line for line in found if line.group not in ("seen", "unseen", "all")]
    for line in scenes if len(scenes) == 2 else found[-1:]:
        assert " | ".join(text(line.scores[score]) for score in ("success", "spl", "rc")) in told, line


def test_the_table_of_navigators_in_furnished_homes_is_that_of_its_rows():
    rows = read_rows([ROOT / "results" / "topological" / "homes" / "rows.parquet"])
    page = (ROOT / "docs" / "topological-homes.md").read_text()
    assert navigator.table(rows, navigator.CLUTTER) in page
    assert navigator.table(rows, navigator.LADDER) in page
    # By hand: of 347 episodes in nine homes, the learned policy lost two, and of the first twelve in the tenth one.
    ours = where(rows, variant="evaluation-policy")
    assert (len(ours), len(ours) - int(sum(ours["success"].to_pylist()))) == (359, 3)
    # The report's navigator lost 47 of 120 episodes; where ours reaches the goal as well, it drives 17.6 m, ours 6.5 m.
    theirs, again = (
        where(rows, variant=name).to_pandas().set_index(["scene", "episode"]) for name in ("ladder-0", "ladder-8")
    )
    assert theirs["success"].sum() == 73
    both = theirs.index[(theirs["success"] * again["success"]) > 0]
    assert len(both) == 72
    assert [round(one.loc[both, "path_m"].mean(), 1) for one in (theirs, again)] == [17.6, 6.5]
    # By hand: 120 episodes in each row; a glance wins 31 more of them than the row above. Something is touched
    # in 118 of 120 episodes among 30 small objects, and 119 and 117 of 120 reach the goal among 10 and 30.
    won = rows.group_by("variant").aggregate([("success", "sum"), ("success", "count")])
    won = won.to_pandas().set_index("variant")
    assert (won.loc[[f"ladder-{row}" for row in range(9)], "success_count"] == 120).all()
    assert won.loc["ladder-3", "success_sum"] - won.loc["ladder-2", "success_sum"] == 31
    assert sum(where(rows, variant="objects-30")["contact"].to_pylist()) == 118
    assert won.loc[["objects-10", "objects-30"], "success_sum"].tolist() == [119, 117]
    assert won.loc[["objects-10", "objects-30"], "success_count"].tolist() == [120, 120]
    # The prices on the page, over the episodes of both rows, home by home.
    episodes = rows.to_pandas().set_index(["scene", "episode"])

    def price(one: str, other: str, column: str) -> list[float]:
        mine, theirs = (episodes[episodes["variant"] == name][column] for name in (one, other))
        change = estimate((mine - theirs).dropna().groupby("scene").mean())
        return [change.mean, change.low, change.high]

    for one, other, column, expected in [
        ("hard-push", "hard", "duration_s", [-27, -47, -8]),
        ("hard-push", "hard", "success", [0.025, 0.000, 0.051]),
        ("metres-0", "evaluation-policy", "duration_s", [44, 14, 75]),
        ("metres-0", "evaluation-policy", "spl", [-0.12, -0.18, -0.06]),
        ("metres-0", "evaluation-policy", "success", [-0.04, -0.09, 0.01]),
        ("hard-metres-0", "hard", "duration_s", [48, 14, 82]),
        ("hard-metres-0", "hard", "spl", [-0.16, -0.24, -0.07]),
        ("hard-metres-0", "hard", "success", [-0.05, -0.11, 0.01]),
    ]:
        places = 0 if column == "duration_s" else 3 if one == "hard-push" else 2
        np.testing.assert_allclose(np.round(price(one, other, column), places), expected, atol=1e-9)
    first = episodes[episodes.index.get_level_values("episode") < 12].groupby("variant")["contact_s"].mean()
    assert (round(first["hard"], 1), round(first["hard-push"], 1)) == (7.2, 9.4)
    # Played again on an H200, ours wins the same ones of 108 episodes.
    before = ours.to_pandas().query("device != 'NVIDIA H200'").set_index(["scene", "episode"])["success"]
    shared = before.index.intersection(again.index)
    assert len(shared) == 108 and (before[shared] == again.loc[shared, "success"]).all()


def test_the_reports_tables_are_those_of_what_is_kept():
    kept, page = ROOT / "results" / "topological" / "report", (ROOT / "docs" / "topological-report.md").read_text()
    assert topological_tables(kept).split("\n## ", 1)[1] in page
    # By hand: 481 episodes in ten homes, each on the dense and the sparse map and by the baseline.
    learned = read_rows([kept / "evaluation-policy" / "rows" / "h200.parquet"])
    rows = where(learned, contender="dense").to_pandas()
    of_baseline = read_rows([kept / "evaluation" / "rows" / "h200.parquet"]).to_pandas()
    assert (len(learned), len(of_baseline)) == (962, 481)
    assert rows["success"].sum() == 169
    means = [round(float(part.groupby("scene")["success"].mean().mean()), 2) for part in (rows, of_baseline)]
    assert means == [0.36, 0.30]
    gain = next(row for row in differences(learned) if row[:2] == ("dense minus sparse map", "success"))
    assert f"{gain[2].with_ends(2)} in success" in page
    assert round(rows["localisations"].mean(), 1) == 2.4
    lost = rows.query("success == 0")
    assert [round(float(lost[name].mean()), 1) for name in ("path_m", "shortest_m")] == [22.5, 9.1]
    assert round(lost["contact_runs"].sum() / lost["runs"].sum(), 2) == 0.61
    # AlexNet and ResNet-18 on images of three homes that neither has seen.
    right = {run: json.loads((kept / run / "results.json").read_text())["confusion"] for run in ("alexnet", "passages")}
    assert {run: sum(row[k] for k, row in enumerate(table)) for run, table in right.items()} == {
        "alexnet": 1768,
        "passages": 1376,
    }


def test_the_topological_results_name_their_preset_and_no_folder_of_a_machine():
    for path in (ROOT / "results" / "topological").rglob("*"):
        if path.suffix == ".parquet":
            assert set(read_rows([path])["preset"].unique().to_pylist()) <= {"default", "report"}, path
            columns = read_rows([path]).select(["policy", "device", "commit"]).to_pydict()
            assert not [value for values in columns.values() for value in set(values) if value.startswith("/")], path
        elif path.is_file():
            assert not re.search(r"(?<![\w.-])/(tmp|root|home|work)/", path.read_text()), path


def test_what_learned_in_a_window_of_mjx_is_played_without_one():
    """Committed runs state the sizes of their windows; C MuJoCo simulates everything and takes none."""
    folder = RunFolder(Path(__file__).parents[1] / "results" / "kint" / "runs" / "k_int0-turtlebot-ppo-seed0")
    console = Console(quiet=True)
    native = config_to_play(folder, ["env.backend=native"], None, console)
    assert [getattr(native.env, name) for name in WINDOW] == [None] * 4
    warp = config_to_play(folder, ["env.backend=warp", "env.active_small=3"], None, console)
    assert [getattr(warp.env, name) for name in WINDOW] == [5, 3, 2, 32]
    with pytest.raises(ConfigError, match="active_doors is 3, which changes nothing here"):
        config_to_play(folder, ["env.backend=native", "env.active_doors=3"], None, console)


def test_room_for_what_is_awake_is_dropped_by_who_takes_none(tmp_path, monkeypatch):
    """Where the backend is asked for, and where it is all there is."""
    folder, console = RunFolder(tmp_path), Console(quiet=True)
    kept = (ROOT / "results" / "kint" / "runs" / "k_int0-turtlebot-ppo-seed0" / "config.yaml").read_text()
    folder.config.write_text(kept.replace("  sleep: true", "  active_dofs: 31\n  sleep: true"))
    assert config_to_play(folder, ["env.backend=warp"], None, console).env.active_dofs == 31
    assert config_to_play(folder, ["env.backend=native"], None, console).env.active_dofs is None
    with pytest.raises(ConfigError, match="active_dofs is 31, which changes nothing here"):
        config_to_play(folder, ["env.backend=native", "env.active_dofs=31"], None, console)
    usual = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "warp" else usual(name, *a))
    played = config_to_play(folder, [], None, console)
    assert (played.env.backend, played.env.active_dofs) == ("native", None)
