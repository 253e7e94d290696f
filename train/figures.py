"""`python -m train.figures RESULTS_DIR -o figures/`: metrics, rows and recorded paths in, pictures out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter

from train.errors import RunFolderError, TrainError
from train.files import whole_file
from train.rows import interval
from train.run_folder import read_metrics

CURVES = (
    ("episode/success", "success"),
    ("episode/ins_0.5", "INS$_{0.5}$"),
    ("episode/sum_reward", "episode reward"),
)
COLOURS = {"learned": "#0072b2", "follower": "#009e73", "random": "#cc79a7", "avoider": "#d55e00"}
FURNITURE_COLOUR = "#ecd9b8"
MOVED_M = 0.02
"""Objects moved less than this are drawn once."""


def learning_curves(runs: Mapping[str, list[dict[str, Any]]]) -> Figure:
    """Success, INS_0.5 and reward of training episodes over environment steps, a line a run.

    Args:
        runs: name -> lines of its metrics.jsonl.
    """
    figure, axes = plt.subplots(1, len(CURVES), figsize=(4 * len(CURVES), 3.2), layout="constrained")
    for axis, (key, label) in zip(axes, CURVES, strict=True):
        for name, lines in runs.items():
            seen = [(line["env_steps"], line[key]) for line in lines if key in line]
            axis.plot(*np.array(seen).reshape(-1, 2).T, label=name, marker="." if len(seen) < 30 else None)
        if key != "episode/sum_reward":
            axis.set_ylim(-0.02, 1.02)
        axis.set_xlabel("environment steps")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.suptitle("training episodes (exploring policy), means over log intervals", fontsize=10)
    return figure


def trajectories(paths: Mapping[str, np.ndarray], most: int = 6) -> Figure:
    """Top views: where each policy's robot went in the same episodes, and what it moved.

    Args:
        paths: arrays that `train.evaluate` recorded.
        most: episodes to draw.
    """
    policies = [str(name) for name in paths["policies"]]
    count = min(most, len(paths[f"{policies[0]}/goal_xy_w"]))
    columns = min(count, 3)
    rows = -(-count // columns)
    aspect = _aspect(paths)
    size = (4.4 * columns, (4.0 * aspect + 0.9) * rows + 0.6)  # panels, their titles and labels, the legend
    figure, grid = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for axis in grid.flat[count:]:
        axis.set_axis_off()
    for i in range(count):
        _draw_episode(grid.flat[i], paths, policies, i)
    handles = [Line2D([], [], color=_colour(p, k), label=p) for k, p in enumerate(policies)]
    grey: dict[str, Any] = {"color": "0.35", "linestyle": ""}
    handles += [
        Line2D([], [], marker="o", markerfacecolor="w", label="start", markersize=8, **grey),
        Line2D([], [], marker="*", label="goal", markersize=11, **grey),
        Patch(color=FURNITURE_COLOUR, label="furniture at start, as far as it bars the robot"),
        Line2D([], [], marker="s", markerfacecolor="none", label="object at start", markersize=6, **grey),
        Line2D([], [], marker="s", label="object at end (coloured by who moved it)", markersize=6, **grey),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def frontier(rows: Mapping[str, Sequence[Any]], title: str) -> Figure:
    """Mean P_eff and E_eff of each policy, with 95 % intervals, and the line of the swept planner's weights.

    Args:
        rows: columns policy, path_efficiency and effort_efficiency, one entry an episode.
        title: of the figure.
    """
    names = np.asarray(rows["policy"])
    scores = {name: np.asarray(rows[name], float) for name in ("path_efficiency", "effort_efficiency")}
    figure, axis = plt.subplots(figsize=(6.4, 5.2), layout="constrained")
    swept: list[tuple[float, float, float]] = []
    for k, policy in enumerate(dict.fromkeys(names)):
        x, y = (values[names == policy] for values in scores.values())
        bars = [np.abs(np.array(interval(n, v)) - v.mean())[:, None] for n, v in zip(scores, (x, y), strict=True)]
        kind, _, weight = policy.partition(":")
        colour = "0.25" if kind == "namo" else _colour(policy, k)
        axis.errorbar(x.mean(), y.mean(), bars[1], bars[0], fmt="o", color=colour, capsize=2, linewidth=0.9)
        right = kind == "namo" or x.mean() < 0.2  # the avoider's point lies close to that of w = 1
        axis.annotate(
            f"w = {float(weight):g}" if kind == "namo" else policy,
            (x.mean(), y.mean()),
            xytext=(6, 5) if right else (-6, 5),
            textcoords="offset points",
            ha="left" if right else "right",
            fontsize=8,
            color=colour,
        )
        if kind == "namo":
            swept.append((float(weight), x.mean(), y.mean()))
    if len(swept) > 1:
        line = np.array(sorted(swept))
        axis.plot(line[:, 1], line[:, 2], color="0.25", linewidth=1.2, label="NAMO planner, weight w of pushing")
        axis.legend(loc="lower left", fontsize=8)
    low_x, low_y = axis.get_xlim()[0], axis.get_ylim()[0]
    for level in np.arange(0.1, 1.0, 0.1):
        p = np.linspace(0.0, 1.0, 50)
        axis.plot(p, 2 * level - p, color="0.85", linewidth=0.7, zorder=0)
    axis.set_xlim(min(low_x, 0.0) if low_x < 0.2 else low_x, 1.09)
    axis.set_ylim(low_y, 1.02)
    axis.set_xlabel("P$_{eff}$: shortest path over path driven, 0 on failure")
    axis.set_ylabel("E$_{eff}$: effort efficiency")
    axis.set_title(f"{title}\ngrey: equal INS$_{{0.5}}$, steps of 0.1", fontsize=9)
    return figure


def _draw_episode(axis: Axes, paths: Mapping[str, np.ndarray], policies: list[str], i: int) -> None:
    scene = int(paths[f"{policies[0]}/scene_index"][i])
    free = paths[f"scene/{scene}/traversable"]
    resolution_m, origin = float(paths[f"scene/{scene}/resolution_m"]), paths[f"scene/{scene}/origin_w"]
    rows, columns = free.shape
    extent = (origin[0], origin[0] + columns * resolution_m, origin[1], origin[1] + rows * resolution_m)
    kind = np.where(free, np.where(paths[f"scene/{scene}/furniture"], 1, 2), 0)
    colours = ListedColormap(["0.72", FURNITURE_COLOUR, "1.0"])
    axis.imshow(kind, origin="lower", extent=extent, cmap=colours, vmin=0, vmax=2, interpolation="nearest")
    begin = paths[f"{policies[0]}/object_start_w"][i, :, :2]
    # Empty slots and objects that found no place wait far outside the map.
    inside = ((begin > [extent[0], extent[2]]) & (begin < [extent[1], extent[3]])).all(-1)
    axis.scatter(*begin[inside].T, s=26, marker="s", facecolors="none", edgecolors="0.35", linewidths=0.9)
    for k, policy in enumerate(policies):
        colour = _colour(policy, k)
        end = paths[f"{policy}/object_end_w"][i, :, :2]
        moved = inside & (np.linalg.norm(end - begin, axis=-1) > MOVED_M)
        for a, b in zip(begin[moved], end[moved], strict=True):
            axis.plot(*np.stack([a, b]).T, color=colour, linewidth=0.8, linestyle=":")
        axis.scatter(*end[moved].T, s=26, marker="s", color=colour, linewidths=0, zorder=6)
        track = paths[f"{policy}/robot_xy_w"][i]
        track = track[np.isfinite(track[:, 0])]
        axis.plot(*track.T, color=colour, linewidth=1.6, alpha=0.85)
        if not paths[f"{policy}/success"][i]:
            axis.plot(*track[-1], marker="x", color=colour, markersize=7, markeredgewidth=2)
    start, goal = paths[f"{policies[0]}/start_xy_w"][i], paths[f"{policies[0]}/goal_xy_w"][i]
    axis.plot(*start, marker="o", markerfacecolor="w", markeredgecolor="k", markersize=8, zorder=5)
    axis.plot(*goal, marker="*", color="#e69f00", markeredgecolor="k", markersize=14, zorder=5)
    reached = [policy for policy in policies if paths[f"{policy}/success"][i]]
    axis.set_title(
        f"{paths[f'scene/{scene}/name']}, episode {i}\nreached by: {', '.join(reached) or 'none'}", fontsize=9
    )
    axis.set_aspect("equal")
    axis.tick_params(labelsize=7)
    axis.set_xlabel("x [m]", fontsize=8)
    axis.set_ylabel("y [m]", fontsize=8)


def _aspect(paths: Mapping[str, np.ndarray]) -> float:
    shapes = [paths[name].shape for name in paths if name.endswith("/traversable")]
    return float(np.clip(max(rows / columns for rows, columns in shapes), 0.5, 1.6))


def _colour(policy: str, index: int) -> str:
    return COLOURS.get(policy, f"C{index}")


def figures_of(results: Path) -> Iterator[tuple[str, Figure]]:
    """Every picture that the files under a folder give: (name, figure).

    Raises:
        RunFolderError: there is nothing to draw.
    """
    logs = sorted(results.rglob("metrics.jsonl"))
    records = sorted(path for path in results.rglob("*.npz") if "checkpoints" not in path.parts)
    records = [path for path in records if not path.parent.name.startswith("diverged-")]
    tables = sorted(path for path in results.rglob("*.parquet"))
    curves = {log.parent.name: lines for log in logs if (lines := read_metrics(log))}
    if not curves and not records and not tables:
        raise RunFolderError(
            f"{results}: nothing to draw (no metrics.jsonl, no rows, no recorded paths); expected a run folder"
        )
    if curves:
        yield "learning_curves", learning_curves(curves)
    for path in tables:
        rows = pq.read_table(path).to_pydict()
        if {"policy", "path_efficiency", "effort_efficiency"} <= rows.keys() and rows["policy"]:
            run = path.parent.parent.name if path.parent.name == "evaluation" else path.stem
            scenes = ", ".join(dict.fromkeys(rows["scene"]))
            episodes = len(rows["policy"]) // len(set(rows["policy"]))
            yield f"frontier_{run}", frontier(rows, f"{scenes}, {episodes} episodes a policy")
    for path in records:
        with np.load(path) as stored:
            first = f"{stored['policies'][0]}/goal_xy_w" if "policies" in stored.files else ""
            if first and len(stored[first]):
                run = path.parent.parent.name if path.parent.name == "evaluation" else path.stem
                yield f"trajectories_{run}", trajectories(dict(stored))


def main(argv: Sequence[str] | None = None) -> int:
    """Draws; 0 when done, 2 on a user's error."""
    parser = argparse.ArgumentParser(prog="python -m train.figures", description="Draws what runs have written.")
    parser.add_argument("results", metavar="RESULTS_DIR", help="a run folder, or a folder of run folders")
    parser.add_argument("-o", "--out", default="figures", metavar="DIR", help="where to (default figures/)")
    arguments = parser.parse_args(argv)
    try:
        for name, figure in figures_of(Path(arguments.results)):
            path = Path(arguments.out) / f"{name}.png"
            with whole_file(path) as partial:
                figure.savefig(partial, dpi=150, format="png")
            plt.close(figure)
            print(path)
    except TrainError as error:
        print(f"train.figures: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
