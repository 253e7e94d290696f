"""Draw plans, rooms, images, curves, maps and the paths of episodes."""

import functools
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from PIL import Image

from interactive_nav_common import figures
from interactive_nav_common.figures import (
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    SKY,
    VERMILION,
    parts,
    plt,
    scene_axes,
)
from topological_nav.data.dataset import load_plan, load_rooms, read_header
from topological_nav.maps.build import Built
from topological_nav.maps.graph import Route, TopologicalMap
from topological_nav.scenes.space import FreeSpace

WON, LOST = BLUE, VERMILION
FEW = 100
"""Episodes of which each start and goal is drawn; of more, only those of the lost."""
INK = 40.0
"""Paths drawn so many times over each other make a solid colour, however many there are."""


def map_lines(axis: Axes, graph: TopologicalMap, passable: float) -> None:
    """Draw a map in the background: its nodes, and the edges that count as open."""
    open_ = graph.p >= passable
    ways = np.stack([graph.xy_w[graph.edges[open_, 0]], graph.xy_w[graph.edges[open_, 1]]], 1)
    axis.add_collection(LineCollection(list(ways), colors="0.6", linewidths=0.5, zorder=1))
    room_points(axis, graph.xy_w, graph.room, s=10, linewidths=0, zorder=2, alpha=0.8)


def journeys_figure(
    scene: str,
    space: FreeSpace,
    panels: Mapping[str, tuple[TopologicalMap | None, Mapping[int, np.ndarray], Mapping[int, Mapping[str, Any]]]],
    passable: float,
) -> Figure:
    """Draw where contenders went in a scene, a panel each."""
    extent = np.ptp(space.centres(0.0), axis=0) + 0.8
    columns = len(panels) if extent[1] >= extent[0] or len(panels) == 1 else min(2, len(panels))
    lines = -(-len(panels) // columns)
    width = max(7.8 / columns, 3.9)
    size = (width * columns, (width * extent[1] / extent[0] + 0.5) * lines)
    figure = plt.figure(figsize=size, layout="constrained")
    axes = scene_axes(figure, len(panels), columns)
    for axis, (name, (graph, tracks, rows)) in zip(axes, panels.items(), strict=True):
        floor_plan(axis, space)
        if graph is not None:
            map_lines(axis, graph, passable)
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


def plan_picture(space: FreeSpace, graph: TopologicalMap, passable: float, height: int) -> tuple[np.ndarray, Any]:
    """Return a picture [height, W, 3] u8 of plan and map, W even, and a function from world points to its pixels."""
    extent = np.ptp(space.centres(0.0), axis=0) + 0.8
    width = int(round(height * extent[0] / extent[1] / 2)) * 2
    figure = plt.figure(figsize=(width / 100, height / 100), dpi=100)
    axis = figure.add_axes((0, 0, 1, 1))
    floor_plan(axis, space)
    axis.set_aspect("auto")
    map_lines(axis, graph, passable)
    memory = io.BytesIO()
    figure.savefig(memory, dpi=100, format="png")
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    plt.close(figure)
    picture = np.asarray(Image.open(memory).convert("RGB").resize((width, height)))
    scale = np.array([width / (x1 - x0), -height / (y1 - y0)])

    def pixels(xy_w: np.ndarray) -> np.ndarray:
        return (np.asarray(xy_w) - [x0, y1]) * scale

    return picture, pixels


PALETTE = (BLUE, ORANGE, GREEN, PINK, SKY, VERMILION, "#f0e442", "#332288", "0.3")
"""Colours of rooms; after nine they repeat."""
FREE = LinearSegmentedColormap.from_list("free", (VERMILION, "0.88", BLUE))
"""Colours of probabilities, from blocked to free, for colour-blind readers too."""
save = functools.partial(figures.save, dpi=130)


def floor_plan(axis: Axes, space: FreeSpace) -> None:
    """Draw free space white and obstacles grey, cut to where there is free space, with a bar of 2 m below."""
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
    (left, bottom), (right, top) = free.min(0) - 0.4, free.max(0) + 0.4
    axis.set(xlim=(left, right), ylim=(bottom - 0.6, top), aspect="equal", xticks=[], yticks=[])
    axis.spines[:].set_visible(False)
    axis.plot([left, left + 2.0], [bottom - 0.3] * 2, color="k", linewidth=2, solid_capstyle="butt")
    axis.text(left + 2.15, bottom - 0.3, "2 m", va="center", fontsize=8)


def room_points(axis: Axes, points_w: np.ndarray, labels: np.ndarray, **style: Any) -> None:
    """Draw points in their rooms' colours."""
    axis.scatter(*points_w.T, c=[PALETTE[k % len(PALETTE)] for k in labels], **style)


def dataset_figure(folder: Path) -> Figure:
    """Draw where a dataset's images were taken, a panel a scene, and level images of some positions below."""
    header, config = read_header(folder)
    scenes = [(s["name"], load_plan(folder, s["name"])) for s in header["scenes"]]
    rooms = load_rooms(folder)
    shown = np.linspace(0, len(rooms.xy_w) - 1, min(6, len(rooms.xy_w))).astype(int)
    lines = -(-len(scenes) // min(4, len(scenes)))
    heights = [3.4 * lines, 1.25 * len(shown)]
    figure, (above, below) = parts((12, sum(heights)), heights)
    for axis, (name, plan) in zip(scene_axes(above, len(scenes)), scenes, strict=True):
        axis.scatter(*plan.rooms.points_w.T, s=1, c="0.85", linewidths=0)
        for held, marker in ((False, "o"), (True, "^")):
            mine = plan.test == held
            room_points(axis, plan.xy_w[mine], plan.room[mine], s=22, marker=marker, edgecolors="k", linewidths=0.4)
        step = 0.35 * np.stack([np.cos(plan.passages.heading_rad), np.sin(plan.passages.heading_rad)], -1)
        ways = list(np.stack([plan.passages.xy_w, plan.passages.xy_w + step], 1))
        colours = np.where(plan.passages.free[:, config.passage_column], "tab:green", "tab:red")
        axis.add_collection(LineCollection(ways, colors=list(colours), linewidths=0.7))
        axis.set_aspect("equal")
        axis.tick_params(labelsize=6)
        axis.set_title(
            f"{name}: {len(plan.xy_w)} positions (▲ for testing), {len(plan.passages)} passages\n"
            f"(green free for {config.passage_length_m:g} m, red blocked)",
            fontsize=7,
        )
    grid = below.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axis, position in zip(grid, shown, strict=True):
        strip = rooms.images[position, 1, :: max(config.headings // 9, 1)]
        axis.imshow(np.concatenate(list(strip), 1))
        axis.set_axis_off()
        axis.set_title(f"room {rooms.names[rooms.label[position]]}, level, turning left", fontsize=7, loc="left")
    return figure


def map_figure(built: Built, route: Route | None = None) -> Figure:
    """Draw a map over the floor plan, a route on top: edges from blocked to free, each direction on its own half."""
    graph = built.map
    extent = np.ptp(built.space.centres(0.0), axis=0)
    figure, axis = plt.subplots(figsize=(7.2, 1.2 + 7.0 * extent[1] / extent[0]), layout="constrained")
    floor_plan(axis, built.space)
    start, end = graph.xy_w[graph.edges[:, 0]], graph.xy_w[graph.edges[:, 1]]
    order = np.argsort(graph.p)
    halves = LineCollection(list(np.stack([start, (start + end) / 2], 1)[order]), cmap=FREE, linewidths=1.1, zorder=2)
    halves.set_array(graph.p[order])
    halves.set_clim(0.0, 1.0)
    axis.add_collection(halves)
    room_points(axis, graph.xy_w, graph.room, s=130, linewidths=0, zorder=4)
    axis.scatter(graph.xy_w[:, 0], graph.xy_w[:, 1], s=70, c="w", linewidths=0, zorder=4)
    for node, xy in enumerate(graph.xy_w):
        if np.linalg.norm(graph.xy_w[:node] - xy, axis=-1).min(initial=1.0) > 0.25:  # else one over the other
            axis.text(xy[0], xy[1], str(node), ha="center", va="center", fontsize=6, zorder=5)
    if route is not None:
        axis.plot(*graph.xy_w[list(route.nodes)].T, color="k", linewidth=2.6, zorder=3)
    figure.colorbar(
        halves, ax=axis, label="probability that the way is free", orientation="horizontal", shrink=0.6, pad=0.01
    )
    axis.set_title(f"{graph.scene}: {len(graph.xy_w)} nodes, {len(graph.edges)} directed edges", fontsize=9)
    return figure
