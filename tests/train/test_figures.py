"""Figures from rows alone: what they show is what the rows say, and every one is drawn for a whole sweep."""

from __future__ import annotations

import json
import re

import matplotlib.pyplot as plt
import numpy as np
import pyarrow as pa
import pytest
from matplotlib.axes import Axes

from interactive_nav_common.figures import BLUE, GREEN
from interactive_nav_common.rows import write_parquet
from tests.train.synthetic import baseline_rows, paper_like, run_rows, write_results
from train.figures import __main__ as cli
from train.figures import curves, paths, scores, style, tables
from train.figures import results as figure_files
from train.figures.results import chosen_split
from train.runs.run_folder import paths_beside
from train.scoring.rows import BY_CATEGORY, COLUMNS
from train.scoring.statistics import claims


def xy(line) -> np.ndarray:
    """[n, 2] of a drawn line."""
    return np.asarray(line.get_xydata())


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = write_results(tmp_path_factory.mktemp("results"))
    # Two seeds of one cell with learning curves, and paths of two k_int in the same episodes.
    for seed in (0, 1):
        run = folder / "runs" / f"turtlebot-ppo-k_int0-seed{seed}"
        run.mkdir(parents=True)
        lines = [{"env_steps": t, "episode/success": t / 1000 + 0.1 * seed, "episode/ins_0.5": 0.5} for t in (100, 500)]
        (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        facts = {"robot": "turtlebot", "algorithm": "ppo", "k_int": 0.0, "seed": seed}
        (run / "summary.json").write_text(json.dumps(facts))
    for k_int in (0.0, 1.0):
        rows = run_rows("turtlebot", "ppo", k_int, 7, 0.5, (0.9, 0.9))
        path = folder / "rows" / f"turtlebot-ppo-k_int{k_int:g}-seed7-0123abcd.parquet"
        write_parquet(rows, path)
        (folder / "rows" / "_paths").mkdir(exist_ok=True)
        np.savez(paths_beside(path), **record(shift_m=k_int))  # type: ignore[arg-type]
    # One of them was evaluated in other episodes as well.
    other = folder / "rows" / "turtlebot-ppo-k_int1-seed7-fedcba98.parquet"
    write_parquet(run_rows("turtlebot", "ppo", 1.0, 7, 0.5, (0.9, 0.9)), other)
    np.savez(paths_beside(other), **record(shift_m=9.0))  # type: ignore[arg-type]
    return folder


def record(shift_m: float, episodes: int = 3) -> dict[str, np.ndarray]:
    """Paths as `train.evaluate` writes them: in episode i the robot drives i + 1 m and pushes a box `shift_m` x i."""
    track = np.stack([np.linspace(0, 1, 5), np.zeros(5)], -1) * (np.arange(episodes) + 1)[:, None, None]
    begin = np.tile([0.5, 0.5, 0.0], (episodes, 1, 1))
    end = begin + np.array([1.0, 0.0, 0.0]) * shift_m * np.arange(episodes)[:, None, None]
    return {
        "policies": np.array(["learned"]),
        "learned/scene_index": np.zeros(episodes, int),
        "learned/start_xy_w": track[:, 0],
        "learned/goal_xy_w": track[:, -1],
        "learned/robot_xy_w": track,
        "learned/object_start_w": begin,
        "learned/object_end_w": end,
        "learned/success": np.ones(episodes),
        "scene/0/name": np.array("den"),
        "scene/0/traversable": np.ones((40, 60), bool),
        "scene/0/furniture": np.zeros((40, 60), bool),
        "scene/0/resolution_m": np.array(0.1),
        "scene/0/origin_w": np.array([-1.0, -2.0]),
        "scene/0/object_names": np.array(["chair_0"]),
    }


def test_every_figure_of_a_sweep_is_drawn(results, tmp_path, capsys):
    assert cli.main([str(results), "-o", str(tmp_path)]) == 0
    assert sorted(path.stem for path in tmp_path.iterdir()) == [
        "effort_terms",
        "ins_over_alpha_fetch",
        "ins_over_alpha_turtlebot",
        "learning_curves",
        "path_effort_fetch",
        "path_effort_turtlebot",
        "robots",
        "seen_unseen",
        "trajectories_turtlebot_ppo",
    ]
    assert all(path.stat().st_size > 20_000 for path in tmp_path.iterdir())
    capsys.readouterr()


def test_trajectories_side_by_side_are_of_the_same_episodes(results, monkeypatch):
    drawn = []
    monkeypatch.setattr(figure_files, "_by_k_int", lambda chosen: drawn.append(chosen))
    dict(figure_files.figures_of(results))["trajectories_turtlebot_ppo"]()
    (chosen,) = drawn
    assert [path.stem[-8:] for path in chosen.values()] == ["0123abcd"] * 2 and sorted(chosen) == [0.0, 1.0]


def test_what_is_unfinished_is_passed_over(results):
    half = results / "rows" / "_paths" / ".partial-01234567-x.npz"
    half.touch()
    assert half not in figure_files.Results(results).records
    half.unlink()


def test_ins_over_alpha_shows_means_and_intervals_of_seeds():
    """SAC on TurtleBot at k_int = 0.1: P_eff 0.83, E_eff 0.699, seeds 0.01 apart, lowest to highest."""
    figure = scores.ins_over_alpha(paper_like(), "turtlebot", "test")
    by_title = {axis.get_title(): axis for axis in figure.axes if axis.get_visible()}
    assert list(by_title) == ["PPO", "SAC", "DDPG", "k$_{int}$ = 0", "k$_{int}$ = 0.1", "k$_{int}$ = 1"]
    ends = sorted((xy(line)[0, 1], xy(line)[-1, 1]) for line in by_title["SAC"].lines)
    np.testing.assert_allclose(ends, [(0.599, 0.83), (0.699, 0.83), (0.799, 0.63)], atol=1e-6)
    band = np.asarray(by_title["SAC"].collections[1].get_paths()[0].vertices)
    at_one = band[np.isclose(band[:, 0], 1.0), 1]
    assert (at_one.min(), at_one.max()) == pytest.approx((0.82, 0.84))
    # The three algorithms keep apart without colour, too.
    looks = {(str(line.get_marker()), str(line.get_color())) for line in by_title["k$_{int}$ = 0"].lines}
    assert len({marker for marker, _ in looks}) == len({colour for _, colour in looks}) == 3


def drawn_bars(axis: Axes) -> list[list[str]]:
    """Ends of error bars as tables print them: of those along x, then of those along y."""
    ends = []
    for container in axis.containers:
        for bar, side in zip(container[2], (0, 1)[-len(container[2]) :], strict=True):
            low, high = np.asarray(bar.get_segments()[0])[:, side]
            ends.append((side, f"[{low:.3f}, {high:.3f}]"))
    return [[text for side, text in ends if side == which] for which in (0, 1)]


def test_error_bars_are_the_intervals_of_the_tables():
    """Three seeds of P_eff 0.5, 0.6 and 0.9: bootstrap gives 0.5 to 0.9, Student's 0.15 to 1.18."""
    seeds = zip((0.5, 0.6, 0.9), (0.8, 0.7, 0.75), strict=True)
    rows = pa.concat_tables([run_rows("turtlebot", "ppo", 0.1, k, p, (e, e)) for k, (p, e) in enumerate(seeds)])
    printed = [re.findall(r"\[.*?\]", line) for line in tables.score_cells(rows).splitlines() if "| unseen |" in line]
    ((_, p_eff, e_eff, ins),) = printed
    assert (p_eff, e_eff) == ("[0.500, 0.900]", "[0.700, 0.800]")
    (plane,) = scores.efficiency_plane(rows, "turtlebot", "test").axes
    assert drawn_bars(plane) == [[p_eff], [e_eff]] and "steps of 0.05" in plane.get_title()
    assert drawn_bars(scores.robots_plane(rows, "test").axes[0]) == [[p_eff], [e_eff]]
    assert drawn_bars(scores.seen_and_unseen(rows).axes[0]) == [[], [ins, ins]]
    lines = [[{"env_steps": 1000, "episodes": 1000 * p, "episode/success": 1.0}] for p in (0.0005, 0.0006, 0.0009)]
    (axis,) = curves.cell_curves({("turtlebot", "ppo", 0.1): lines}).axes
    band = np.asarray(axis.collections[0].get_paths()[0].vertices)[:, 1]
    assert f"[{band.min():.3f}, {band.max():.3f}]" == p_eff


def test_the_plane_has_cells_in_front_of_what_never_learned():
    rows = pa.concat_tables([paper_like(), baseline_rows()], promote_options="permissive")
    figure = scores.efficiency_plane(rows, "turtlebot", "test")
    (axis,) = figure.axes
    drawn = np.concatenate([xy(line) for line in axis.lines])
    places = {(round(float(p), 3), round(float(e), 3)) for p, e in drawn}
    assert {(0.83, 0.699), (0.63, 0.799), (0.75, 0.575), (0.5, 0.76)} <= places
    assert {(0.9, 0.6), (0.8, 0.8), (0.6, 0.9), (0.85, 0.55)} <= places
    texts = {text.get_text() for text in axis.texts}
    assert texts == {"w=0", "w=0.5", "w=1", "follower"}


def test_what_lies_far_from_the_runs_is_named_beside_them():
    """All runs within 0.02 of each other: who never learned would squeeze them into one blot."""
    runs = [run_rows("turtlebot", a, 0.1, 0, p, (0.98, 0.98)) for a, p in (("ppo", 0.95), ("sac", 0.96))]
    known = baseline_rows()
    known = known.filter(pa.array([name == "follower" for name in known["policy"].to_pylist()]))
    rows = pa.concat_tables([*runs, known], promote_options="permissive")
    figure = scores.efficiency_plane(rows, "turtlebot", "test")
    (axis,) = figure.axes
    (told,) = [text.get_text() for text in axis.texts if "outside" in text.get_text()]
    assert told == "outside: follower (0.85, 0.55)"
    assert axis.get_ylim()[0] > 0.9 and "mean of 1 seed," in axis.get_title() and "steps of 0.01" in axis.get_title()
    assert [style.seeds_text(counts) for counts in ({3}, {1, 2}, set())] == ["3 seeds", "1-2 seeds", "0 seeds"]


def test_learning_curves_meet_at_the_steps_all_seeds_have():
    runs = [
        [{"env_steps": t, "s": v} for t, v in ((0, 0.0), (100, 1.0), (200, 1.0))],
        [{"env_steps": t, "s": v} for t, v in ((50, 0.0), (150, 1.0))] + [{"env_steps": 160}],
    ]
    steps, values = curves.common_curve(runs, "s")
    np.testing.assert_array_equal(steps, [50, 100, 150])
    np.testing.assert_allclose(values, [[0.5, 1.0, 1.0], [0.0, 0.5, 1.0]])
    assert curves.common_curve([[{"env_steps": 1}]], "s")[0].size == 0
    np.testing.assert_allclose(curves.running_mean(np.array([[1.0, 2.0, 6.0, 3.0]]), 3), [[1.5, 3.0, 11 / 3, 4.5]])
    np.testing.assert_array_equal(curves.running_mean(np.array([[1.0, 2.0, 6.0, 3.0]]), 1), [[1.0, 2.0, 6.0, 3.0]])


def test_goals_are_counted_by_the_steps_between_two_lines():
    lines = [
        {"env_steps": 1000, "episodes": 4.0, "episode/success": 0.5},
        {"env_steps": 3000},  # none ended: unknown, and its steps are its own
        {"env_steps": 3500, "episodes": 10.0, "episode/success": 0.9},
    ]
    rates = [line.get(curves.GOALS) for line in curves.with_goal_rate(lines)]
    assert rates == [pytest.approx(2.0), None, pytest.approx(18.0)]
    assert curves.GOALS not in lines[0]


def test_a_row_of_panels_is_as_high_as_its_own_tallest_scene():
    shapes = {0: (40, 80), 1: (120, 80), 2: (80, 80)}
    made = {f"scene/{k}/traversable": np.ones(shape, bool) for k, shape in shapes.items()}
    made |= {"learned/scene_index": np.array([0, 1, 2, 0])}
    assert [paths._aspect(made, "learned", i) for i in range(4)] == [0.5, 1.5, 1.0, 0.5]


def test_names_that_would_be_written_over_each_other_are_written_as_one():
    named = [("w=1", (0.9, 1.0)), ("w=0", (0.5, 0.5)), ("w=0.5", (0.51, 0.49)), ("w=0.9", (0.5, 0.6))]
    gathered = scores._gathered(named, np.array([1.0, 1.0]))
    assert gathered == [("w=1", (0.9, 1.0)), ("w=0, w=0.5", (0.51, 0.49)), ("w=0.9", (0.5, 0.6))]


def test_paths_side_by_side_are_of_the_same_episodes():
    one, other = record(0.0), record(1.0)
    other["learned/goal_xy_w"] = other["learned/goal_xy_w"] + np.array([[0, 0], [1, 1], [0, 0]])
    merged = paths.side_by_side({"k_int = 0": one, "k_int = 1": other})
    assert [str(name) for name in merged["policies"]] == ["k_int = 0", "k_int = 1"]
    np.testing.assert_array_equal(merged["k_int = 1/goal_xy_w"], one["learned/goal_xy_w"][[0, 2]])
    # Most was moved in the last one.
    assert list(paths.spread_episodes(merged, 1)) == [1] and list(paths.spread_episodes(merged, 5)) == [0, 1]
    figure = paths.trajectories(merged, episodes=[1])
    lines = [line for line in figure.axes[0].lines if len(xy(line)) == 5]
    assert [xy(line)[-1, 0] for line in lines] == [3.0, 3.0]
    assert lines[0].get_linestyle() != lines[1].get_linestyle()


def test_random_walks_are_thin_and_grey():
    one = record(0.0)
    merged = paths.side_by_side({"learned": one, "random": one})
    figure = paths.trajectories(merged, episodes=[0])
    learned, random = [line for line in figure.axes[0].lines if len(xy(line)) == 5]
    assert random.get_color() == "0.6" and random.get_linewidth() < learned.get_linewidth() / 2
    assert figure.axes[0].get_title() == "den, episode 0\nall reach it" and figure.get_figwidth() <= 7.2


def test_titles_of_many_policies_name_the_fewer_and_fit_above_their_panel():
    won = record(0.0, episodes=1)
    lost = won | {"learned/success": np.zeros(1)}
    planners = [f"namo:{w}" for w in ("0", "0.25", "0.5", "0.75", "1")]

    def title(losers: list[str]) -> str:
        merged = paths.side_by_side({name: lost if name in losers else won for name in ["avoider", *planners]})
        return paths.trajectories(merged).axes[0].get_title().partition("\n")[2]

    assert title(["avoider"]) == "missed by avoider"
    assert title(planners) == "reached by avoider"
    assert title(["avoider", *planners]) == "reached by none"
    assert title(planners[2:]) == "reached by avoider, namo:0, namo:0.25"
    assert title(["namo:0.25", "namo:0.75"]) == "missed by namo:0.25, namo:0.75"
    assert title(["avoider", "namo:0", "namo:1"]) == "reached by namo:0.25, namo:0.5,\nnamo:0.75"


def test_effort_terms_leave_a_few_episodes_outside_and_say_how_many():
    """98 of 100 episodes lie at 0.99, where the runs are: two at 0.5 and 0.6 would put all in one corner."""
    rows = pa.concat_tables([run_rows("turtlebot", "ppo", 0.1, seed, 0.9, (0.99, 0.99)) for seed in (0, 1)])
    terms = np.full(len(rows), 0.99)
    far = max(1, len(rows) // 100)
    terms[:far] = 0.5
    for name in scores.EFFORT:
        rows = rows.set_column(rows.column_names.index(name), name, pa.array(terms))
    (axis,) = scores.effort_terms(rows, "test").axes
    assert axis.get_xlim()[0] > 0.9 and axis.get_ylim()[0] > 0.9
    share = np.mean(terms[np.asarray(rows["split"].to_pylist()) == "test"] < 0.9)
    assert [text.get_text() for text in axis.texts] == [f"{100 * share:.0f} % of episodes lie outside"]


def test_goals_of_a_sweep_are_drawn_a_panel_a_robot():
    """1,000 steps and 3 goals, then 2,000 and 10: 3 and 5 goals in 1,000 steps."""
    lines = [
        {"env_steps": 1000, "episodes": 3.0, "episode/success": 1.0},
        {"env_steps": 3000, "episodes": 20.0, "episode/success": 0.5},
    ]
    figure = curves.cell_curves({("turtlebot", "ppo", 0.1): [lines, lines], ("fetch", "sac", 0.1): [lines]})
    assert [axis.get_title() for axis in figure.axes] == ["TurtleBot", "Fetch"]
    assert [xy(axis.lines[0]).tolist() for axis in figure.axes] == [[[1000, 3], [3000, 5]]] * 2


def test_tables_say_what_the_rows_say(results, capsys):
    assert cli.main([str(results), "--tables"]) == 0
    printed = capsys.readouterr().out
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in printed.splitlines() if line[:1] == "|"]
    found = {tuple(line[:4]): line[4:] for line in lines}
    assert found["TurtleBot", "SAC", "0.1", "unseen"] == [
        *("3", "60", "0.950 [0.950, 0.950]", "0.830 [0.820, 0.840]", "0.699 [0.689, 0.709]", "0.764 [0.754, 0.775]"),
    ]
    assert found["TurtleBot", "namo:0.5", "unseen", "20"][1].startswith("0.800 [")
    assert [line for line in lines if line[0] == "turtlebot-sac-k_int1-seed2"] == [
        ["turtlebot-sac-k_int1-seed2", "2,000", "1,000", "1.5", "toy", "0123456789", "toy"]
    ]
    assert "SAC is best overall" in printed and "Welch" in printed
    assert cli.main([str(results), "--table", "policies-that-never-learned"]) == 0
    assert (one := capsys.readouterr().out) in printed and one.count("##") == 1 and "namo" in one
    assert cli.main([str(results), "--table", "x"]) == 2
    assert "have scores" in capsys.readouterr().err


def test_tables_of_policies_that_never_learned_alone(tmp_path, capsys):
    rows = baseline_rows()
    at_walls = pa.array([1, 0] * (len(rows) // 2))
    write_parquet(rows.append_column("structure_steps", at_walls), tmp_path / "y.parquet")
    assert cli.main([str(tmp_path), "--tables"]) == 0
    printed = capsys.readouterr().out
    assert [line for line in printed.splitlines() if line[:2] == "##"] == ["## Policies that never learned"]
    assert "| TurtleBot | namo:0.5 | unseen | 20 | 0.950 [" in printed
    write_parquet(rows.drop_columns("policy"), tmp_path / "y.parquet")
    assert cli.main([str(tmp_path), "--tables"]) == 2
    assert "has no column 'policy', expected text there; evaluate the run again" in capsys.readouterr().err


def test_unseen_scenes_are_shown_where_there_are_any():
    rows = paper_like(("turtlebot",))
    assert chosen_split(rows, "auto") == "test" and chosen_split(rows, None) is None
    seen = rows.filter(pa.array([split == "train" for split in rows["split"].to_pylist()]))
    assert chosen_split(seen, "auto") == "train"


def test_a_users_policies_are_drawn_in_colours_that_no_other_has():
    names = ["follower", "mine", "avoider", "yours", "learned"]
    colours = style.policy_colours(names)
    assert set(colours) == set(names) and len(set(colours.values())) == 5
    assert colours["follower"] == GREEN and colours["learned"] == BLUE


def test_looks_keep_apart():
    names, k_ints = ("ppo", "td3", "a2c"), (0.0, 0.1, 1.0)
    looks = style.Looks({("fetch", name, k_int): [1] for name in names for k_int in k_ints})
    assert len({tuple(looks.algorithm(name).values()) for name in names}) == 3 and looks.seeds == "1 seed"
    assert [looks.fill(k_int) for k_int in k_ints] == ["none", "left", "full"]
    assert [looks.k_int(k_int)["linestyle"] for k_int in k_ints] == [":", "--", "-"]
    alone = style.Looks({("fetch", "ppo", 0.5): []})
    assert alone.k_int(0.5) == {"fillstyle": "full", "linestyle": "-"}
    assert style.in_order({"zeta", "ddpg", "ppo", "sac"}) == ["ppo", "sac", "ddpg", "zeta"]


def episodes_of(policy: str, success: list[float], **more: object) -> pa.Table:
    """Rows of one policy in the same tasks."""
    count = len(success)
    columns = {"policy": policy, "robot": "fetch", "scene": "rowan", "k_int": 1.0, **more}
    return pa.table({"episode": list(range(count)), "success": success, **{n: [v] * count for n, v in columns.items()}})


def test_success_where_touching_is_needed_by_hand():
    avoider = episodes_of("avoider", [1.0, 0.0, 1.0])
    learned = episodes_of("learned", [1.0, 0.0, 0.0, 1.0])  # the avoider never played the last one
    assert "| Fetch | 1 | 0.500 (2) | 0.000 (1) |" in tables.need_lines(pa.concat_tables([learned, avoider]))
    assert tables.need_lines(learned) == "" and tables.need_lines(pa.table({"policy": ["learned"]})) == ""
    told = learned.append_column("push_needed", pa.array([True, False, None, True]))
    assert "| Fetch | 1 | 0.000 (1) | 1.000 (2) |" in tables.need_lines(told)
    elsewhere = episodes_of("avoider", [1.0, 0.0], scene="willow")
    assert tables.need_lines(pa.concat_tables([learned, elsewhere])) == ""


def test_what_was_moved_by_hand():
    """Two episodes with 2 and 1 chairs: 1 of 3 touched, 0.6 m in all are 20 cm a chair; the shoe stands in one."""

    def told(category, objects, touched, moved_m):
        names = ("category", "objects", "touched", "contact_steps", "displacement_m", "force_sum_n")
        return dict(zip(names, (category, objects, touched, 9, moved_m, 5.0), strict=True))

    one, two = [told("chair", 2, 1, 0.5), told("coffee_table", 1, 0, 0.0)], [told("chair", 1, 0, 0.1)]
    learned = episodes_of("learned", [1.0, 1.0], split="test").append_column(
        "by_category", pa.array([one, two], BY_CATEGORY)
    )
    random = episodes_of("random", [1.0], split="train").append_column("by_category", pa.array([one], BY_CATEGORY))
    rows = pa.concat_tables([random, learned])
    assert tables.category_lines(rows, None).splitlines() == [
        "| robot | category | k_int = 1 | random |",
        "| --- | --- | --- | --- |",
        "| Fetch | chair | 33.3%, 20.0 | 50.0%, 25.0 |",
        "| Fetch | coffee table | 0.0%, 0.0 | 0.0%, 0.0 |",
    ]
    assert "random" not in tables.category_lines(rows, "test")
    assert tables.category_lines(rows.drop_columns("by_category"), None) == ""
    old = episodes_of("learned", [1.0], split="test").append_column("by_category", pa.nulls(1, BY_CATEGORY))
    assert tables.category_lines(old, None) == ""


def test_effort_without_walls_leaves_their_episodes_out():
    """Walls take from the dynamic term where k_int is 1: with them the claim fails, without them it holds."""
    free = paper_like()
    at_walls = np.array([(k == 1.0) * (i % 2) for i, k in enumerate(free["k_int"].to_pylist())], float)
    lost = free["effort_efficiency"].to_numpy() - 0.8 * at_walls
    rows = free.set_column(free.column_names.index("effort_efficiency"), "effort_efficiency", pa.array(lost))
    rows = rows.append_column("structure_steps", pa.array(at_walls))
    claim = "k_int = 1 gains effort efficiency and loses path efficiency"
    told = {f.compared: f.verdict for f in claims(rows, "test") if f.claim == claim and "E_eff" in f.compared}
    assert set(told.values()) == {"does not hold: lower"}
    lines = [line for line in tables.effort_lines(rows, "test").splitlines() if claim in line]
    assert len(lines) == 2 and all(line.endswith("| holds |") and "P_eff" not in line for line in lines)
    assert tables.effort_lines(free, "test") == ""  # rows that do not tell
    assert "## Effort without walls" in tables.document(rows, "test")


def test_a_scene_in_place_of_a_run_is_refused(tmp_path, capsys):
    np.savez(tmp_path / "maps.npz", height=np.zeros((2, 2)))  # an archive, but no recorded paths
    assert cli.main([str(tmp_path), "-o", str(tmp_path / "figures")]) == 2
    assert "nothing to draw" in capsys.readouterr().err


@pytest.mark.parametrize(
    "column", sorted({*COLUMNS.text, *COLUMNS.whole, *COLUMNS.numbers} - {*COLUMNS.may_be_missing})
)
def test_a_damaged_column_is_one_line_that_names_it(tmp_path, column, capsys):
    rows, path = paper_like(("fetch",)), tmp_path / "rows.parquet"
    at, text = rows.column_names.index(column), column in COLUMNS.text
    other = pa.array([1.5] * len(rows)) if text else pa.array(["a"] * len(rows))
    empty = rows[column].combine_chunks().to_pylist()
    empty[3] = None
    for damaged, told in (
        (rows.drop_columns(column), f"has no column '{column}', expected"),
        (rows.set_column(at, column, other), f"column '{column}' holds {other.type}, expected"),
        (rows.set_column(at, column, pa.array(empty, rows[column].type)), f"column '{column}' is empty in 1 rows"),
    ):
        write_parquet(damaged, path)
        for words in ([], ["--tables"]):
            assert cli.main([str(tmp_path), "-o", str(tmp_path / "out"), *words]) == 2
            assert capsys.readouterr().err.startswith(f"train.figures: {path}: {told}")


def test_categories_of_another_kind_are_one_line(tmp_path, capsys):
    rows = paper_like(("fetch",))
    write_parquet(rows.append_column("by_category", pa.array([1] * len(rows))), tmp_path / "rows.parquet")
    assert cli.main([str(tmp_path), "--tables"]) == 2
    assert "rows.parquet: column 'by_category' holds int64, expected list" in capsys.readouterr().err
