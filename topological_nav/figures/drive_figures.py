"""Draw drives and policies."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.figures import BLUE, RC, VERMILION, curves, panels, parts, plt, scene_axes
from topological_nav.drives.dataset import drive_images, load_drives, read_drives_header
from topological_nav.figures.maps import floor_plan
from topological_nav.scenes.space import free_space

SHOWN = 4
"""Drives whose images are shown."""
FRAMES = 8
"""Images of each."""
TURNS = LinearSegmentedColormap.from_list("turns", (BLUE, "0.6", VERMILION))


@plt.rc_context(RC)  # type: ignore[reportCallIssue]
def drives_figure(scene_folders: Sequence[Path], folder: Path) -> Figure:
    """Draw all drives on the floor plans, coloured by turning, images along some, and the shares of commands."""
    header, config = read_drives_header(folder)
    drives, robot = load_drives(folder), get_robot(config.robot)
    lines = -(-len(scene_folders) // min(4, len(scene_folders)))
    picked = _some(folder, SHOWN)
    heights = [3.8 * lines, 1.2 * len(picked) + 0.01, 2.4]
    figure, (above, middle, below) = parts((8, 3.8 * lines + 1.2 * len(picked) + 2.4), heights)
    axes, shade = scene_axes(above, len(scene_folders)), None
    for index, (about, scene_folder) in enumerate(zip(header["scenes"], scene_folders, strict=True)):
        axis, there = axes[index], np.flatnonzero(drives.scene == index)
        floor_plan(axis, free_space(load_scene(scene_folder), robot.height_m))
        for k in there[~drives.kept[there]]:
            axis.plot(*drives.pose_w[drives.rows(k), :2].T, color="0.35", linewidth=0.8, ls=":")
        pieces, turns = [], []
        for k in there[drives.kept[there]]:
            xy = drives.pose_w[drives.rows(k), :2]
            pieces.append(np.stack([xy[:-1], xy[1:]], 1))
            turns.append(drives.command[drives.rows(k)[:-1], 1])
        if pieces:
            shade = LineCollection(list(np.concatenate(pieces)), cmap=TURNS, linewidths=0.7)
            shade.set_array(np.concatenate(turns))
            shade.set_clim(-config.angular_rad_s, config.angular_rad_s)
            axis.add_collection(shade)
        hits = drives.rows(there)
        hits = hits[drives.touching[hits].any(1)]
        axis.scatter(*drives.pose_w[hits, :2].T, s=6, color="k", marker="x", zorder=4)
        axis.set_title(
            f"{about['name']}: {int(drives.kept[there].sum())} of {len(there)} drives kept\n"
            f"(reached {drives.reached[there].mean():.2f}, in contact {drives.touched[there].mean():.2f})"
        )
    if shade is not None:
        above.colorbar(shade, ax=list(axes), label="turning, rad/s (left +)", shrink=0.6, pad=0.01)
    if picked:
        grid = middle.subplots(len(picked), 1, squeeze=False)[:, 0]
        for axis, (k, images) in zip(grid, picked, strict=True):
            at = np.linspace(0, len(images) - 1, FRAMES).astype(int)
            axis.imshow(np.concatenate(list(images[at]), 1))
            labels = [f"{v:.1f}, {w:+.1f}" for v, w in drives.command[drives.first[k] + at]]
            axis.set_xticks((np.arange(FRAMES) + 0.5) * images.shape[2], labels, fontsize=8)
            axis.set(yticks=[], frame_on=False)
            axis.tick_params(length=0, grid_linewidth=0)
            axis.set_title(f"drive {k} in {header['scenes'][drives.scene[k]]['name']}: m/s, rad/s (left +)", loc="left")
    _shares(below.subplots(1, 3), drives)
    return figure


def _some(folder: Path, count: int) -> list[tuple[int, np.ndarray]]:
    """Return a few drives with their images, from files all over the folder."""
    files = [(int(rows[len(rows) // 2]), rows, images) for rows, images in _thin(drive_images(folder), count)]
    drives, out = load_drives(folder), []
    for k, rows, images in files:
        ends = np.cumsum(drives.steps[rows])
        at = int(np.flatnonzero(rows == k)[0])
        out.append((k, images[ends[at] - drives.steps[k] : ends[at]]))
    return out


def _thin(files, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return `count` of an iterable, evenly; it is gone through once and a few are held."""
    held, every = [], 1
    for i, item in enumerate(files):
        if i % every == 0:
            held.append(item)
        if len(held) == 2 * count:
            held, every = held[::2], 2 * every
    return held[:count]


def _shares(axes: Any, drives: Any) -> None:
    going = np.repeat(drives.kept, drives.steps)
    for axis, values, name, what in (
        (axes[0], drives.command[going, 0], "commanded m/s", "steps"),
        (axes[1], drives.command[going, 1], "commanded rad/s (left +)", "steps"),
        (axes[2], drives.steps[drives.kept] / 10.0, "seconds a drive", "drives"),
    ):
        if len(values):
            axis.hist(values, bins=21, color=BLUE, weights=np.full(len(values), 1 / len(values)))
        axis.set(xlabel=name, ylabel=f"share of {what}")


def policy_figure(lines: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> Figure:
    """Draw the curves of a policy's run, and how its commands on held-out drives compare with the expert's."""
    figure, (axes,) = panels((15, 3.6), 1, 4)
    curves(axes[0], lines, {"forward": "forward", "consistency": "consistency"})
    axes[0].set_yscale("log")
    axes[0].set_title("errors in feature space", fontsize=9)
    if "test" in results:
        for name, colour in (("linear", "tab:blue"), ("angular", "tab:orange")):
            axes[1].axhline(results["test"][name]["accuracy"], color=colour, ls="--", label=f"{name}, held out")
    curves(axes[1], lines, {f"{name}_accuracy": f"{name}, learned from" for name in ("linear", "angular")})
    axes[1].set_title("accuracy", fontsize=9)
    axes[1].set_ylim(0, 1)
    for axis, name, unit in ((axes[2], "linear", "m/s"), (axes[3], "angular", "rad/s")):
        if "test" not in results:
            axis.set_axis_off()
            continue
        counts = np.asarray(results["test"][name]["confusion"], float)
        share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        axis.imshow(share, cmap="Blues", vmin=0, vmax=1)
        for i, j in np.ndindex(*share.shape):
            axis.text(j, i, f"{share[i, j]:.2f}", ha="center", va="center", fontsize=7)
        values = [f"{v:+.2f}" for v in results["classes"][name]]
        axis.set_xticks(range(len(values)), values, fontsize=7)
        axis.set_yticks(range(len(values)), values, fontsize=7)
        axis.set(xlabel=f"policy, {unit}", ylabel="expert")
        axis.set_title(f"{name}, held-out steps", fontsize=9)
    return figure
