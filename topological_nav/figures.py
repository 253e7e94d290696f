"""Plans, rooms, images, curves and maps in, pictures out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from topological_nav.space import FreeSpace
from train.files import whole_file

PALETTE = [*plt.get_cmap("tab20").colors[::2], *plt.get_cmap("tab20").colors[1::2]]  # type: ignore[attr-defined]
"""Colours of rooms; after twenty they repeat."""


def save(figure: Figure, path: Path) -> None:
    """Writes a PNG whole or not at all, and forgets the figure."""
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=130, format="png")
    plt.close(figure)


def floor_plan(axis: Axes, space: FreeSpace) -> None:
    """Draws free space white and obstacles grey, cut to where there is free space."""
    rows, columns = space.clearance_m.shape
    (x0, y0), step = space.origin_w, space.resolution_m
    axis.imshow(
        space.clearance_m > 0,
        origin="lower",
        extent=(x0, x0 + columns * step, y0, y0 + rows * step),
        cmap=ListedColormap(["0.78", "1.0"]),
        interpolation="nearest",
    )
    free = space.centres(0.0)
    axis.set_xlim(free[:, 0].min() - 0.4, free[:, 0].max() + 0.4)
    axis.set_ylim(free[:, 1].min() - 0.4, free[:, 1].max() + 0.4)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])


def room_points(axis: Axes, points_w: np.ndarray, labels: np.ndarray, **style: Any) -> None:
    """Draws points in their rooms' colours."""
    axis.scatter(*points_w.T, c=[PALETTE[k % len(PALETTE)] for k in labels], **style)


def rooms_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """One row a scene, one column a method: the rooms found where their number is known, else where it is chosen.

    Args:
        rows: of `rooms.compare`.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    spaces = [next(r["space"] for r in rows if r["scene"] == scene) for scene in scenes]
    extents = [np.ptp(space.centres(0.0), axis=0) + 0.8 for space in spaces]
    heights = [extent[1] / extent[0] for extent in extents]
    figure, grid = plt.subplots(
        len(scenes),
        len(methods),
        figsize=(3.6 * len(methods), 3.6 * sum(heights) + 0.55 * len(scenes)),
        height_ratios=heights,
        squeeze=False,
        layout="constrained",
    )
    for line, scene in zip(grid, scenes, strict=True):
        for axis, method in zip(line, methods, strict=True):
            mine = [r for r in rows if r["scene"] == scene and r["method"] == method]
            shown, rooms = mine[0], mine[0]["rooms"]
            floor_plan(axis, shown["space"])
            room_points(axis, rooms.points_w, rooms.labels, s=5, linewidths=0)
            if shown["recorded"] is not None:
                for x0, y0, x1, y1 in shown["recorded"]:
                    axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, linewidth=0.9, edgecolor="k"))
            said = [
                f"{r['count']} rooms ({r['chosen_by']})"
                + ("" if r["agreement"] is None else f" ARI {r['agreement']:.2f}")
                for r in mine
            ]
            axis.set_title(f"{scene}, {method}\n" + "; ".join(said), fontsize=7.5)
    return figure
