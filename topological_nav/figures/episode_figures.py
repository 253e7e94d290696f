"""Plans, maps and paths in, pictures of episodes out."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from topological_nav.figures.maps import floor_plan, room_points, scene_axes
from topological_nav.maps.graph import TopologicalMap
from topological_nav.scenes.space import FreeSpace
from train.figures.style import BLUE, VERMILION, plt

WON, LOST = BLUE, VERMILION
FEW = 100
"""Episodes of which each start and goal is drawn; of more, only those of the lost."""
INK = 40.0
"""Paths drawn so many times over each other make a solid colour, however many there are."""


def map_lines(axis: Axes, made: TopologicalMap, passable: float) -> None:
    """Draws a map in the background: its nodes, and the edges that count as open."""
    open_ = made.p >= passable
    ways = np.stack([made.xy_w[made.edges[open_, 0]], made.xy_w[made.edges[open_, 1]]], 1)
    axis.add_collection(LineCollection(list(ways), colors="0.6", linewidths=0.5, zorder=1))
    room_points(axis, made.xy_w, made.room, s=10, linewidths=0, zorder=2, alpha=0.8)


def journeys_figure(
    scene: str,
    space: FreeSpace,
    panels: Mapping[str, tuple[TopologicalMap | None, Mapping[int, np.ndarray], Mapping[int, Mapping[str, Any]]]],
    passable: float,
) -> Figure:
    """Where contenders went in a scene, a panel each."""
    extent = np.ptp(space.centres(0.0), axis=0) + 0.8
    columns = len(panels) if extent[1] >= extent[0] or len(panels) == 1 else min(2, len(panels))
    lines = -(-len(panels) // columns)
    width = max(7.8 / columns, 3.9)
    size = (width * columns, (width * extent[1] / extent[0] + 0.5) * lines)
    figure = plt.figure(figsize=size, layout="constrained")
    axes = scene_axes(figure, len(panels), columns)
    for axis, (name, (made, tracks, rows)) in zip(axes, panels.items(), strict=True):
        floor_plan(axis, space)
        if made is not None:
            map_lines(axis, made, passable)
        for wins, colour in ((True, WON), (False, LOST)):  # what was lost lies above
            mine = {number: row for number, row in rows.items() if bool(row["success"]) == wins}
            alpha = max(0.01, min(0.65, INK / max(len(mine), 1)))  # of less, eight bits show nothing
            ways = [tracks[number] for number in mine if number in tracks]
            axis.add_collection(
                LineCollection(ways, colors=colour, linewidths=0.9, alpha=alpha, zorder=3), autolim=False
            )
            shown = list(mine.values()) if len(rows) <= FEW or not wins else []
            alpha = min(1.0, 2 * FEW / max(len(shown), 1))
            for end, marker, size in (("start", "o", 3.5), ("goal", "*", 7)):
                xy = [[row[f"{end}_{x}_w"] for row in shown] for x in "xy"]
                axis.plot(*xy, marker, color=colour, markersize=size, alpha=alpha, zorder=4)
        won = sum(bool(row["success"]) for row in rows.values())
        whose = "" if len(rows) <= FEW else " of the others"
        axis.set_title(
            f"{scene}, {name}: {won:,} of {len(rows):,} reached (blue; red: not)\n● start, ★ goal{whose}", fontsize=8
        )
    return figure


def plan_picture(space: FreeSpace, made: TopologicalMap, passable: float, height: int) -> tuple[np.ndarray, Any]:
    """[height, W, 3] u8 picture of plan and map, W even, and a function from world points [..., 2] to its pixels."""
    extent = np.ptp(space.centres(0.0), axis=0) + 0.8
    width = int(round(height * extent[0] / extent[1] / 2)) * 2
    figure = plt.figure(figsize=(width / 100, height / 100), dpi=100)
    axis = figure.add_axes((0, 0, 1, 1))
    floor_plan(axis, space)
    axis.set_aspect("auto")
    map_lines(axis, made, passable)
    memory = io.BytesIO()
    figure.savefig(memory, dpi=100, format="png")
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    plt.close(figure)
    picture = np.asarray(Image.open(memory).convert("RGB").resize((width, height)))
    scale = np.array([width / (x1 - x0), -height / (y1 - y0)])

    def pixels(xy_w: np.ndarray) -> np.ndarray:
        return (np.asarray(xy_w) - [x0, y1]) * scale

    return picture, pixels
