"""Draw rows: the plane of policies and the planner's line, and of sweeps the paper's figures 5, 6 and 9 to 13."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from interactive_nav_common.figures import draw_means, handle, legend, panels
from interactive_nav_common.rows import where
from interactive_nav_common.statistics import correlation, over_episodes, over_runs, p_text
from train.figures import style
from train.scoring.statistics import RunMean, cells, learned_rows, run_means, train_test_contrast

ALPHAS = np.linspace(0.0, 1.0, 11)
DOTS = 3000
"""Episodes drawn at most as dots."""
FREE, WALLS = "0.7", "#e3b778"
"""Colours of episodes: that touched no wall, and that did."""
EFFORT = ("kinematic_effort", "dynamic_effort")
SPLITS = {"train": "seen (training) scenes", "test": "unseen (test) scenes", None: "all scenes"}


def frontier(rows: Mapping[str, Sequence[Any]], title: str) -> Figure:
    """Draw mean P_eff and E_eff of each policy, with 95 % intervals, and the line of the swept planner's weights."""
    names = np.asarray(rows["policy"])
    scores = {name: np.asarray(rows[name], float) for name in ("path_efficiency", "effort_efficiency")}
    figure, ((axis,),) = panels((6.4, 5.2))
    swept: list[tuple[float, float, float]] = []
    policies = list(dict.fromkeys(map(str, names)))
    colours = style.policy_colours([policy for policy in policies if policy.partition(":")[0] != "namo"])
    for policy in policies:
        x, y = (over_episodes(name, values[names == policy]) for name, values in scores.items())
        kind, _, weight = policy.partition(":")
        colour = colours.get(policy, "0.25")
        axis.errorbar(x.mean, y.mean, y.bar, x.bar, fmt="o", color=colour, capsize=2, linewidth=0.9)
        right = kind == "namo" or x.mean < 0.2  # the avoider's point lies close to that of w = 1
        axis.annotate(
            f"w = {float(weight):g}" if kind == "namo" else policy,
            (x.mean, y.mean),
            xytext=(8, 32 * float(weight) - 20) if kind == "namo" else (6 if right else -6, 5),
            ha="left" if right else "right",
            textcoords="offset points",
            fontsize=8,
            color=colour,
        )
        if kind == "namo":
            swept.append((float(weight), x.mean, y.mean))
    if len(swept) > 1:
        line = np.array(sorted(swept))
        axis.plot(line[:, 1], line[:, 2], color="0.25", linewidth=1.2, label="NAMO planner, weight w of pushing")
        axis.legend(loc="lower left", fontsize=8)
    low_x, low_y = axis.get_xlim()[0], axis.get_ylim()[0]
    equal_ins(axis)
    axis.set(xlim=(min(low_x, 0.0) if low_x < 0.2 else low_x, 1.12), ylim=(min(low_y, 0.8), 1.02))
    axis.set(xlabel="P$_{eff}$: shortest path over path driven, 0 on failure", ylabel="E$_{eff}$: effort efficiency")
    axis.set_title(f"{title}\ngrey: equal INS$_{{0.5}}$, steps of 0.1", fontsize=9)
    return figure


def equal_ins(axis: Axes, step: float = 0.1) -> None:
    """Draw lines of equal INS_0.5."""
    p = np.array([-1.0, 2.0])
    for level in np.arange(step, 1.0, step):
        axis.plot(p, 2 * level - p, color="0.85", linewidth=0.7, zorder=0)


def ins_over_alpha(rows: pa.Table, robot: str, split: str | None) -> Figure:
    """Draw INS_alpha over alpha (paper, figures 5 and 12): above a panel an algorithm, below a panel a k_int."""
    by_cell = cells(run_means(where(rows, robot=robot), split))
    looks = style.Looks(by_cell)
    wide = max(len(looks.algorithms), len(looks.k_ints))
    figure, grid = panels((2.9 * wide, 6.0), 2, wide, sharex=True, sharey=True)
    for axis in grid.flat:
        axis.set_visible(False)
    for (_, algorithm, k_int), runs in by_cell.items():
        points = [over_runs(run.ins(alpha) for run in runs) for alpha in ALPHAS]
        look = {**looks.algorithm(algorithm), **looks.k_int(k_int), "markevery": 5, "markersize": 5}
        places = (grid[0, looks.algorithms.index(algorithm)], grid[1, looks.k_ints.index(k_int)])
        for axis, title in zip(places, (algorithm.upper(), f"k$_{{int}}$ = {k_int:g}"), strict=True):
            axis.set_visible(True)
            axis.set_title(title)
            draw_means(axis, ALPHAS, points, **look)
    low, high = grid[0, 0].get_ylim()
    grid[0, 0].set_ylim(max(low, -0.02), min(high, 1.02))  # no score lies outside, though an interval may
    for axis in grid[:, 0]:
        axis.set_ylabel("INS$_α$")
    for axis in grid[1]:
        axis.set_xlabel("α: 0 effort only, 1 path only")
    for axis in grid[0]:
        axis.tick_params(labelbottom=True)
    legend(figure, [*looks.algorithm_handles(), *looks.k_int_handles()])
    figure.suptitle(
        f"{style.robot_name(robot)}, {SPLITS[split]}; mean of {looks.seeds}, 95 % bootstrap interval", fontsize=9
    )
    return figure


def efficiency_plane(rows: pa.Table, robot: str, split: str | None) -> Figure:
    """Draw path against effort efficiency of each cell (paper, figures 6 and 11), before those who never learned."""
    means = run_means(where(rows, robot=robot), split)
    looks = style.Looks(cells(means))
    figure, ((axis,),) = panels((5.6, 4.9))
    for algorithm in looks.algorithms:
        runs = [run for run in means if run.algorithm == algorithm]
        _chain(axis, runs, looks, looks.algorithm(algorithm))
    _baselines(axis, rows, robot, split)
    step = _finish_plane(axis)
    handles = [*looks.algorithm_handles(), *looks.k_int_handles(linestyle="")]
    planner = [handle("planner that knows all poses, weight w of pushing", color="0.45", marker=".")]
    legend(figure, handles + planner * any(text.get_text()[:2] == "w=" for text in axis.texts), 3)
    axis.set_title(
        f"{style.robot_name(robot)}, {SPLITS[split]}; mean of {looks.seeds}, 95 % bootstrap intervals\n"
        f"grey lines: equal INS$_{{0.5}}$, steps of {step:g}"
    )
    return figure


def robots_plane(rows: pa.Table, split: str | None) -> Figure:
    """Draw path against effort efficiency of each robot (paper, figure 9)."""
    means = run_means(rows, split)
    looks = style.Looks(cells(means))
    wide = len(looks.algorithms)
    figure, grid = panels((3.4 * wide + 0.6, 3.9), 1, wide, sharex=True, sharey=True)
    for axis, algorithm in zip(grid[0], looks.algorithms, strict=True):
        for robot in looks.robots:
            runs = [run for run in means if (run.algorithm, run.robot) == (algorithm, robot)]
            _chain(axis, runs, looks, looks.robot(robot))
        axis.set_title(algorithm.upper())
    _finish_plane(*grid[0])
    for axis in grid[0, 1:]:
        axis.set_ylabel("")
    robots = [handle(style.robot_name(name), **looks.robot(name)) for name in looks.robots]
    legend(figure, [*robots, *looks.k_int_handles(linestyle="")], 5)
    figure.suptitle(f"{SPLITS[split]}; mean of {looks.seeds}, 95 % bootstrap intervals", fontsize=9)
    return figure


def effort_terms(rows: pa.Table, split: str | None) -> Figure:
    """Draw the kinematic against the dynamic term of E_eff (paper, figure 10): runs large, some episodes as dots.

    Forces on walls count in the dynamic term, so episodes that touched a wall have another colour.
    """
    means = run_means(rows, split)
    looks = style.Looks(cells(means))
    episodes = learned_rows(rows, split)
    has_walls = "structure_steps" in episodes.column_names
    touched = episodes["structure_steps"].to_numpy() > 0 if has_walls else np.zeros(len(episodes), bool)
    wide = len(looks.robots)
    figure, grid = panels((3.6 * wide, 4.3), 1, wide)
    for axis, robot in zip(grid[0], looks.robots, strict=True):
        chosen = np.asarray(episodes["robot"].to_pylist()) == robot
        x, y = (episodes[name].to_numpy()[chosen] for name in EFFORT)
        shown = np.random.default_rng(0).permutation(len(x))[:DOTS]
        walls = touched[chosen][shown]
        for at, colour, above in ((~walls, FREE, 2), (walls, WALLS, 1)):
            axis.scatter(x[shown][at], y[shown][at], s=3, color=colour, linewidths=0, zorder=above)
        runs = [run for run in means if run.robot == robot]
        for run in runs:
            look = {**looks.algorithm(run.algorithm), "fillstyle": looks.fill(run.k_int), "linestyle": ""}
            axis.plot(*(run.scores[name] for name in EFFORT), markersize=6, zorder=3, **look)
        of_runs = correlation(*([run.scores[name] for run in runs] for name in EFFORT))
        axis.set_title(
            f"{style.robot_name(robot)}\nr over runs: {of_runs}\nr over episodes: {correlation(x, y)}", fontsize=8
        )
        axis.set(xlabel="kinematic term of E$_{eff}$", ylabel="dynamic term of E$_{eff}$")
        lows = [min(np.quantile(v, 0.02), *(r.scores[n] for r in runs)) for v, n in zip((x, y), EFFORT, strict=True)]
        for low, limit in zip(lows, (axis.set_xlim, axis.set_ylim), strict=True):
            limit(low - 0.05 * (1 - low), 1 + 0.05 * (1 - low))
        outside = np.mean((x < lows[0]) | (y < lows[1]))
        axis.text(0.02, 0.02, f"{100 * outside:.0f} % of episodes lie outside", transform=axis.transAxes, fontsize=8)
    kinds = ((FREE, "episode"), (WALLS, "episode that touched a wall"))[: 1 + bool(touched.any())]
    dots = [handle(name, color=c, marker=".", linestyle="", markersize=6) for c, name in kinds]
    legend(figure, [*looks.algorithm_handles(linestyle=""), *looks.k_int_handles(linestyle=""), *dots], 4)
    figure.suptitle(SPLITS[split] or "", fontsize=9)
    return figure


def seen_and_unseen(rows: pa.Table) -> Figure:
    """Draw INS_0.5 of each cell on training and on test scenes, with the test of the paper (figure 13)."""
    pairs, test = train_test_contrast(rows)
    assert test is not None, "there are rows of both"
    by_cell, unseen = (cells([pair[side] for pair in pairs]) for side in (0, 1))
    looks = style.Looks(by_cell)
    order = sorted(by_cell, key=lambda c: (looks.robots.index(c[0]), looks.algorithms.index(c[1]), c[2]))
    figure, ((axis,),) = panels((max(5.6, 0.62 * len(order) + 1.4), 3.9))
    for i, cell in enumerate(order):
        look = {**looks.algorithm(cell[1]), "capsize": 2, "markersize": 6}
        for runs, shift, fill in ((by_cell[cell], -0.14, "full"), (unseen[cell], 0.14, "none")):
            e = over_runs(run.ins(0.5) for run in runs)
            axis.errorbar(i + shift, e.mean, e.bar, fillstyle=fill, **look)
            x = np.full(len(runs), i + shift + 0.09 * np.sign(shift))
            axis.scatter(x, [run.ins(0.5) for run in runs], s=5, color="0.5", linewidths=0, zorder=1)
    robot_too = len(looks.robots) > 1
    labels = [f"{a.upper()}\n{k:g}" + (f"\n{style.robot_name(r)}" if robot_too else "") for r, a, k in order]
    axis.set_xticks(range(len(order)), labels, fontsize=7)
    axis.set(xlabel="algorithm, k$_{int}$" + (", robot" if robot_too else ""), ylabel="INS$_{0.5}$")
    axis.grid(axis="x", visible=False)
    p = "" if math.isnan(test.p_value) else f", one-sample t test p {p_text(test.p_value)}"
    axis.set_title(
        f"unseen minus seen: {test.difference:+.3f} over {len(pairs)} runs{p}\n"
        "markers: mean over seeds, 95 % bootstrap interval; dots: runs"
    )
    grey: dict[str, Any] = {"color": "0.3", "marker": "o", "linestyle": "", "markersize": 6}
    kinds = (("training scenes", "full"), ("unseen scenes", "none"))
    scenes = [handle(label, fillstyle=fill, **grey) for label, fill in kinds]
    legend(figure, [*looks.algorithm_handles(linestyle=""), *scenes])
    return figure


def _chain(axis: Axes, runs: Sequence[RunMean], looks: style.Looks, look: dict[str, Any]) -> None:
    """Draw a marker with intervals for each k_int, joined in its order."""
    places = []
    for k_int in sorted({run.k_int for run in runs}):
        scores = [run.scores for run in runs if run.k_int == k_int]
        p, e = (over_runs(score[name] for score in scores) for name in ("path_efficiency", "effort_efficiency"))
        bars: dict[str, Any] = {"capsize": 2, "elinewidth": 0.8, "markersize": 7, "linestyle": "", "zorder": 4}
        axis.errorbar(p.mean, e.mean, e.bar, p.bar, fillstyle=looks.fill(k_int), **look, **bars)
        places.append((p.mean, e.mean))
    axis.plot(*np.array(places).T, color=look["color"], linewidth=0.9, alpha=0.7, zorder=3)


def _baselines(axis: Axes, rows: pa.Table, robot: str, split: str | None) -> None:
    """Draw policies without learning in grey: the planner's weights as a line, the others as named points.

    Distant outliers are listed in a corner instead, to keep the scale of the runs.
    """
    rows, places = where(rows, robot=robot, split=split), {}
    for name in (name for name in rows["policy"].unique().to_pylist() if name != "learned"):
        part = where(rows, policy=name)
        places[name] = tuple(float(part[x].to_numpy().mean()) for x in ("path_efficiency", "effort_efficiency"))
    line = [(float(name.partition(":")[2]), *place) for name, place in places.items() if name.startswith("namo:")]
    drawn = [*(np.asarray(line.get_xydata(), float) for line in axis.lines), np.reshape([p[1:] for p in line], (-1, 2))]
    drawn = np.concatenate(drawn)
    drawn = drawn[np.isfinite(drawn).all(1)]
    low, high = drawn.min(0), drawn.max(0)
    reach = np.maximum(high - low, 0.1)
    far, named = [], []
    for name, place in places.items():
        kind, _, weight = name.partition(":")
        if kind != "namo" and not ((place >= low - reach) & (place <= high + reach)).all():
            far.append(f"{name} ({place[0]:.2f}, {place[1]:.2f})")
            continue
        label = f"w={float(weight):g}" if kind == "namo" else name
        axis.plot(*place, marker="." if kind == "namo" else "x", color="0.45", zorder=2)
        named.append((label, place))
    for label, place in _gathered(named, reach):
        long = "," in label  # to the left: on the right the axis ends
        look = {"ha": "right" if long else "left", "fontsize": 7, "color": "0.35", "zorder": 3.5}
        look["bbox"] = {"facecolor": "w", "edgecolor": "none", "pad": 0.5, "alpha": 0.8}
        axis.annotate(label, place, xytext=(-4 if long else 4, -9), textcoords="offset points", **look)
    if line:
        points = np.array(sorted(line))[:, 1:]
        axis.plot(*points.T, color="0.45", linewidth=1.0, zorder=2)
    if far:
        text = "outside: " + ", ".join(far)
        axis.text(0.02, 0.02, text, transform=axis.transAxes, fontsize=7, color="0.35")


def _gathered(
    named: Sequence[tuple[str, tuple[float, float]]], reach: np.ndarray
) -> list[tuple[str, tuple[float, float]]]:
    """Join the names of places that would be written over each other, beside the lowest of them."""
    groups: list[list[tuple[str, tuple[float, float]]]] = []
    for label, place in named:
        close = (g for g in groups if (np.abs(np.subtract(place, g[0][1])) < np.array([0.12, 0.04]) * reach).all())
        if group := next(close, None):
            group.append((label, place))
        else:
            groups.append([(label, place)])
    return [(", ".join(sorted(label for label, _ in g)), min((p for _, p in g), key=lambda p: p[1])) for g in groups]


def _finish_plane(*axes: Axes) -> float:
    """Add labels, limits that follow the data and lines of equal INS_0.5; return the step between these."""
    x, y = axes[0].get_xlim(), axes[0].get_ylim()
    more_x, more_y = 0.12 * (x[1] - x[0]), 0.12 * (y[1] - y[0])
    wide = x[1] - x[0] + y[1] - y[0]
    step = 0.1 if wide > 0.6 else 0.05 if wide > 0.3 else 0.01
    for axis in axes:
        equal_ins(axis, step)
        axis.set(xlabel="P$_{eff}$ (SPL)", xlim=(max(-0.02, x[0] - more_x), min(1.03, x[1] + more_x)))
        axis.set(ylabel="E$_{eff}$", ylim=(max(-0.02, y[0] - more_y), min(1.0 + 0.1 * more_y, y[1] + more_y)))
        axis.grid(visible=False)
    return step
