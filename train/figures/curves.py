"""Draw learning curves of lines of metrics.jsonl."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from scipy.ndimage import uniform_filter1d

from interactive_nav_common.figures import draw_means, legend, panels
from interactive_nav_common.statistics import over_runs
from train.figures import style

CURVES = (("episode/success", "success"), ("episode/ins_0.5", "INS$_{0.5}$"), ("episode/sum_reward", "episode reward"))
GOALS = "goals_per_1000_steps"
GOALS_LABEL = "goals reached in 1,000 env steps"
"""Of sweeps: their runs may end before every environment has had the time of a whole episode, and until then the
episodes that end are those that succeed; goals reached in a number of steps count the others by their steps."""
SMOOTHED = 40
"""Curves of more points than this are drawn as running means over a twentieth of them."""


def learning_curves(runs: Mapping[str, list[dict[str, Any]]]) -> Figure:
    """Draw success, INS_0.5 and reward of training episodes over environment steps, a line a run."""
    figure, (axes,) = panels((4 * len(CURVES), 3.2), 1, len(CURVES))
    for axis, (key, label) in zip(axes, CURVES, strict=True):
        for name, lines in runs.items():
            points = _points(lines, key)
            axis.plot(*points.T, label=name, marker="." if len(points) < 30 else None)
        if key in ("episode/success", "episode/ins_0.5"):
            axis.set_ylim(-0.02, 1.02)
        _label(axis, label)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.suptitle("training episodes (exploring policy), means over log intervals", fontsize=10)
    return figure


def with_goal_rate(lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return lines with `GOALS` where episodes ended: of the steps since the line before, the first since 0."""
    out, before = [], 0.0
    for line in lines:
        steps, before = line["env_steps"] - before, line["env_steps"]
        goals = line.get("episodes", 0.0) * line.get("episode/success", 0.0)
        out.append({**line, GOALS: 1000.0 * goals / steps} if steps > 0 and "episodes" in line else dict(line))
    return out


def common_curve(runs: Sequence[Sequence[Mapping[str, Any]]], key: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps [T] that all runs have reached, and their values [runs, T], linear between logged points."""
    curves = [points for lines in runs if len(points := _points(lines, key))]
    if not curves:
        return np.zeros(0), np.zeros((0, 0))
    low, high = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
    steps = np.unique(np.concatenate([c[:, 0] for c in curves]))
    steps = steps[(steps >= low) & (steps <= high)]
    return steps, np.stack([np.interp(steps, *c.T) for c in curves])


def _points(lines: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """Return [n, 2] env steps and values of the lines that have them."""
    return np.array([(line["env_steps"], line[key]) for line in lines if key in line], float).reshape(-1, 2)


def running_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Return centred means over up to `width` points along the last axis, fewer at the ends."""
    size = 2 * (width // 2) + 1
    sums, counts = (uniform_filter1d(x, size, mode="constant") for x in (values, np.ones_like(values)))
    return sums / counts


def cell_curves(cells: Mapping[style.Cell, Sequence[Sequence[Mapping[str, Any]]]]) -> Figure:
    """Draw the goals that training reached over env steps, a panel a robot: a line a cell, with its seeds' interval."""
    looks = style.Looks(cells)
    figure, (axes,) = panels((3.6 * len(looks.robots), 3.6), 1, len(looks.robots), sharey=True)
    seeds = set()
    for (robot, algorithm, k_int), runs in sorted(cells.items()):
        steps, values = common_curve([with_goal_rate(lines) for lines in runs], GOALS)
        if not len(steps):
            continue
        seeds.add(len(values))
        values = running_mean(values, len(steps) // 20 if len(steps) > SMOOTHED else 1)
        look = {**looks.algorithm(algorithm), "markersize": 4, **looks.k_int(k_int)}
        look |= {"markevery": max(1, len(steps) // 6), "linewidth": 1.2}
        points = [over_runs(column) for column in values.T]
        draw_means(axes[looks.robots.index(robot)], steps, points, (0.0, np.inf), **look)
    for axis, robot in zip(axes, looks.robots, strict=True):
        axis.set_ylim(bottom=0.0)
        _label(axis, GOALS_LABEL if axis is axes[0] else "")
        axis.set_title(style.robot_name(robot))
    legend(figure, [*looks.algorithm_handles(markersize=4), *looks.k_int_handles(markersize=4)], 3)
    figure.suptitle(f"exploring policy, mean of {style.seeds_text(seeds)}, 95 % bootstrap interval", fontsize=9)
    return figure


def _label(axis: Any, label: str) -> None:
    axis.set_xlabel("environment steps")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.set_ylabel(label)
