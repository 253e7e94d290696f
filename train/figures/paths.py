"""Draw recorded paths: top views of where robots went and what they moved (paper, figures 7 and 8)."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from interactive_nav_common.figures import handle, legend, panels
from train.figures.style import policy_colours

FURNITURE_COLOUR = "#ecd9b8"
MOVED_M = 0.02
"""Objects moved less than this are drawn once."""
TITLE_WIDTH = 40
"""Characters of a line above a panel."""
LINES = ("-", (0, (4, 1.5)), (0, (1, 1)), "-.")
"""Line styles of the first, second, ... policy, which distinguish them without colour."""


def trajectories(paths: Mapping[str, np.ndarray], most: int = 6, episodes: Sequence[int] | None = None) -> Figure:
    """Draw where each policy's robot went in the same episodes (None: the first ones), and what it moved."""
    policies = [str(name) for name in paths["policies"]]
    count = len(paths[f"{policies[0]}/goal_xy_w"])
    chosen = list(range(min(most, count))) if episodes is None else list(episodes)
    count = len(chosen)
    columns = min(count, 3)
    # A row is as high as its tallest scene, with titles and labels; below them the legend.
    aspects = [_aspect(paths, policies[0], i) for i in chosen]
    heights = [2.2 * max(aspects[k : k + columns]) + 0.7 for k in range(0, count, columns)]
    size = (2.4 * columns, sum(heights) + 1.0)
    figure, grid = panels(size, len(heights), columns, height_ratios=heights)
    for axis in grid.flat[count:]:
        axis.set_axis_off()
    for axis, i in zip(grid.flat, chosen, strict=False):
        _draw_episode(axis, paths, policies, i)
    grey: dict[str, Any] = {"color": "0.35", "linestyle": ""}
    handles = [
        *(handle(policy, **pen) for policy, pen in _pens(policies).items()),
        handle("start", marker="o", markerfacecolor="w", markersize=8, **grey),
        handle("goal", marker="*", markersize=11, **grey),
        handle("not reached", marker="x", **grey),
        handle("object at start", marker="s", markerfacecolor="none", markersize=5, **grey),
        handle("object at end, coloured by who moved it", marker="s", markersize=5, **grey),
        Patch(color=FURNITURE_COLOUR, label="furniture at start"),
    ]
    legend(figure, handles, columns, fontsize=8, frameon=False)
    return figure


def _pens(policies: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return how each policy is drawn: random walks, which go everywhere, thin and grey."""
    colours = policy_colours(policies)
    pens: dict[str, dict[str, Any]] = {
        policy: {"color": colours[policy], "linestyle": LINES[k % len(LINES)], "linewidth": 1.6}
        for k, policy in enumerate(policies)
    }
    if "random" in pens:
        pens["random"] = {"color": "0.6", "linestyle": "-", "linewidth": 0.7}
    return pens


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
    axis.scatter(*begin[inside].T, s=14, marker="s", facecolors="none", edgecolors="0.35", linewidths=0.9)
    for policy, pen in _pens(policies).items():
        colour = pen["color"]
        end = paths[f"{policy}/object_end_w"][i, :, :2]
        moved = inside & (np.linalg.norm(end - begin, axis=-1) > MOVED_M)
        for a, b in zip(begin[moved], end[moved], strict=True):
            axis.plot(*np.stack([a, b]).T, color=colour, linewidth=0.8, linestyle=":")
        axis.scatter(*end[moved].T, s=14, marker="s", color=colour, linewidths=0, zorder=6)
        track = paths[f"{policy}/robot_xy_w"][i]
        track = track[np.isfinite(track[:, 0])]
        axis.plot(*track.T, **pen, alpha=0.9)
        if not paths[f"{policy}/success"][i]:
            axis.plot(*track[-1], marker="x", color=colour, markersize=6, markeredgewidth=1.5)
    start, goal = paths[f"{policies[0]}/start_xy_w"][i], paths[f"{policies[0]}/goal_xy_w"][i]
    axis.plot(*start, marker="o", markerfacecolor="w", markeredgecolor="k", markersize=6, zorder=5)
    axis.plot(*goal, marker="*", color="#e69f00", markeredgecolor="k", markersize=11, zorder=5)
    reached, missed = ([p for p in policies if bool(paths[f"{p}/success"][i]) is well] for well in (True, False))
    fewer = f"missed by {', '.join(missed)}"
    fewer = fewer if len(missed) < len(reached) else f"reached by {', '.join(reached) or 'none'}"
    outcome = textwrap.fill(fewer, TITLE_WIDTH) if missed else "all reach it"
    axis.set_title(f"{paths[f'scene/{scene}/name']}, episode {i}\n{outcome}", fontsize=8)
    axis.set_aspect("equal")
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.tick_params(labelsize=7)
    axis.set_xlabel("x [m]", fontsize=8)
    axis.set_ylabel("y [m]", fontsize=8)


def _aspect(paths: Mapping[str, np.ndarray], policy: str, episode: int) -> float:
    rows, columns = paths[f"scene/{int(paths[f'{policy}/scene_index'][episode])}/traversable"].shape
    return float(np.clip(rows / columns, 0.5, 1.6))


def side_by_side(records: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Join records of several runs by `train.evaluate` into one for `trajectories`, with labels as policies.

    Only episodes with equal starts in all of them remain, in the first one's scenes.
    """
    first = next(iter(records.values()))
    count = min(len(record["learned/goal_xy_w"]) for record in records.values())
    same = np.ones(count, bool)
    for record in records.values():
        for name in ("scene_index", "start_xy_w", "goal_xy_w"):
            mine, its = first[f"learned/{name}"][:count], record[f"learned/{name}"][:count]
            same &= np.isclose(mine, its).reshape(count, -1).all(1)
    merged = {name: value for name, value in first.items() if name.startswith("scene/")}
    merged["policies"] = np.array(list(records))
    for label, record in records.items():
        for name, value in record.items():
            if name.startswith("learned/"):
                merged[f"{label}/{name.removeprefix('learned/')}"] = value[:count][same]
    return merged


def spread_episodes(paths: Mapping[str, np.ndarray], most: int) -> Sequence[int]:
    """Return the episodes to draw: those in which most was moved come first, from as many scenes as there are."""
    policies = [str(name) for name in paths["policies"]]
    scene = paths[f"{policies[0]}/scene_index"]
    moved = np.zeros(len(scene))
    for policy in policies:
        begin, end = paths[f"{policy}/object_start_w"], paths[f"{policy}/object_end_w"]
        moved = np.maximum(moved, np.linalg.norm(end - begin, axis=-1).clip(max=5.0).sum(-1))
    order = np.argsort(-moved, kind="stable")
    rank = [(scene[order[:k]] == scene[i]).sum() for k, i in enumerate(order)]
    return sorted(order[np.argsort(rank, kind="stable")][:most])
