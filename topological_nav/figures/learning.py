"""Draw training data and training: drives, learning curves, scores, domains."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from sklearn.metrics import ConfusionMatrixDisplay

from interactive_nav import get_robot, load_scene
from interactive_nav_common.figures import BLUE, ORANGE, RC, VERMILION, curves, panels, parts, plt, scene_axes
from topological_nav.drives.dataset import drive_images, load_drives, read_drives_header
from topological_nav.figures.maps import floor_plan
from topological_nav.scenes.space import free_space

SHOWN = 4
"""Drives with images."""
FRAMES = 8
"""Images per drive."""
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
    """Return a few drives with their images, each from a different file."""
    drives, out = load_drives(folder), []
    for rows, images in drive_images(folder, count):
        k, end = int(rows[len(rows) // 2]), int(drives.steps[rows[: len(rows) // 2 + 1]].sum())
        out.append((k, images[end - drives.steps[k] : end]))
    return out


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
    """Draw the curves of a policy's run, and compare its commands on held-out drives with the expert's."""
    figure, (axes,) = panels((15, 3.6), 1, 4)
    curves(axes[0], lines, {"forward": "forward", "consistency": "consistency"})
    axes[0].set_yscale("log")
    axes[0].set_title("errors in feature space", fontsize=9)
    for axis, name, unit, colour in ((axes[2], "linear", "m/s", "C0"), (axes[3], "angular", "rad/s", "C1")):
        if "test" not in results:
            axis.set_axis_off()
            continue
        axes[1].axhline(results["test"][name]["accuracy"], color=colour, ls="--", label=f"{name}, held out")
        counts = np.asarray(results["test"][name]["confusion"], float)
        share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        shown = ConfusionMatrixDisplay(share, display_labels=[f"{v:+.2f}" for v in results["classes"][name]])
        shown.plot(ax=axis, cmap="Blues", values_format=".2f", colorbar=False, im_kw={"vmin": 0, "vmax": 1})
        axis.set(xlabel=f"policy, {unit}", ylabel="expert")
        axis.set_title(f"{name}, held-out steps", fontsize=9)
    curves(axes[1], lines, {f"{name}_accuracy": f"{name}, learned from" for name in ("linear", "angular")})
    axes[1].set_title("accuracy", fontsize=9)
    axes[1].set_ylim(0, 1)
    return figure


def curves_figure(lines: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw loss and accuracy over epochs from lines of metrics.jsonl."""
    figure, ((axis,),) = panels((4.6, 3.2))
    curves(axis, lines, {"loss": "loss", "accuracy": "accuracy on training images"}, marker=".")
    axis.set_ylim(bottom=0)
    return figure


PAIRS = 6
"""Pairs of images."""
_STAGES = {"before": "0.6", "statistics": ORANGE, "after": BLUE}


@plt.rc_context(RC)  # type: ignore[reportCallIssue]
def features_figure(
    source: np.ndarray, target: np.ndarray, lines: Sequence[Mapping[str, Any]], results: Mapping[str, Any]
) -> Figure:
    """Draw images [n, H, W, 3] u8 of both domains, the adversarial losses, and localisation before and after."""
    figure, (above, below) = parts((8, 5.6), [1.0, 1.15])
    grid, (course, scores) = above.subplots(2, PAIRS), below.subplots(1, 2)
    for line, images, name in zip(grid, (source, target), ("as rendered", "target"), strict=True):
        for axis, row in zip(line, np.linspace(0, len(images) - 1, PAIRS).astype(int), strict=True):
            axis.imshow(images[row])
            axis.set_axis_off()
        line[0].set_title(name, loc="left")
    course.axhline(0.5, color="0.5", linewidth=0.8, zorder=0, label="accuracy by chance")
    labels = {"loss": "extractor's loss", "critic_loss": "critic's loss", "critic_accuracy": "critic's accuracy"}
    curves(course, lines, labels, marker=".")
    course.set(ylim=(0, max(1.0, course.get_ylim()[1])), title="adaptation: losses (nats), accuracy (share)")
    kinds = (("node", "nearest node"), ("room", "right room"))
    for k, (name, colour) in enumerate(_STAGES.items()):
        values = [results[name]["mean"][kind] for kind, _ in kinds]
        bars = scores.bar(np.arange(2) + 0.27 * (k - 1), values, 0.25, color=colour, label=name)
        scores.bar_label(bars, fmt="%.2f", fontsize=8)
    for x, (kind, _) in enumerate(kinds):
        best = results["source"]["mean"][kind]
        scores.plot([x - 0.45, x + 0.45], [best, best], "k--", linewidth=1, label="in the source" if not x else None)
    title = "share of the target's held-out images localised"
    scores.set(xticks=[0, 1], xticklabels=[label for _, label in kinds], ylim=(0, 1), title=title)
    scores.legend(loc="upper left")
    return figure
