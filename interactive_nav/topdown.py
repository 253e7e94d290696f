"""Run `python -m interactive_nav.topdown REPLAY... -o out.png`: draw maps of paths and moved objects.

One panel a replay, as in figures 7 and 8 of Interactive Gibson: objects in outline at the start and filled at the end,
arrows between, and the robot's path coloured by time or contact.
"""

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from shapely.plotting import patch_from_polygon

from interactive_nav.pictures.camera import COLOURS
from interactive_nav.pictures.replay import Replay, ReplayError, load_replay
from interactive_nav.record import check_replay_scene
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav.scenes.slots import bodies_by_name
from interactive_nav_common.commands import Command, option, parse, word
from interactive_nav_common.config import AtLeastOne
from interactive_nav_common.errors import ConfigError, reports_errors, typed
from interactive_nav_common.files import whole_file
from interactive_nav_common.rotations import matrix_from_quat, yaw_from_quat

COLOUR_BY = ("time", "contact")
TOUCH_COLOURS = {"nothing": "#0072b2", "an object": "#d55e00", "a wall": "#555555"}
MOVED_M = 0.02
"""Objects whose outline moved less than this count as not moved."""


def shadow(boxes: np.ndarray, pos_w: np.ndarray, quat_w: np.ndarray) -> Any:
    """Return what the boxes [n, 10] of a body at (3,) with quaternion (4,) cover of the floor, in world m."""
    corners = np.array(list(itertools.product((-1, 1), repeat=3))) * boxes[:, None, 7:10]
    points_b = boxes[:, None, :3] + corners @ matrix_from_quat(boxes[:, 3:7]).swapaxes(1, 2)
    points_w = points_b @ matrix_from_quat(quat_w).T + pos_w
    return shapely.union_all([shapely.MultiPoint(points[:, :2]).convex_hull for points in points_w])


def draw_topdown(axis: Axes, replay: Replay, scene: Scene, colour_by: str = "time") -> None:
    """Draw one replay, its path coloured by "time" (first step dark, last bright) or "contact"."""
    if colour_by not in COLOUR_BY:
        raise ConfigError(f"colour_by is {colour_by!r}, expected one of {', '.join(COLOUR_BY)}")
    check_replay_scene(replay, scene)
    maps = scene.maps
    extent = maps.extent_w
    axis.imshow(
        maps.traversable, origin="lower", extent=extent, cmap=ListedColormap(["0.75", "1.0"]), interpolation="nearest"
    )
    for name, thing in bodies_by_name(scene, replay.small).items():
        if name in replay.bodies:
            b = replay.bodies.index(name)
            _draw_object(axis, thing.category, thing.rows, replay.body_pos_w[:, b], replay.body_quat_w[:, b], extent)
    _draw_path(axis, replay, colour_by)
    robot = get_robot(replay.robot)
    for step, style in ((0, "--"), (-1, "-")):
        place, yaw = replay.robot_xy_w[step], yaw_from_quat(replay.body_quat_w[step, 0])
        x, y = map(float, place)
        axis.add_patch(Circle((x, y), robot.footprint_radius_m, fill=False, linestyle=style, zorder=6))
        nose = place + robot.footprint_radius_m * np.array([np.cos(yaw), np.sin(yaw)])
        axis.plot(*np.stack([place, nose]).T, color="k", linewidth=1, linestyle=style, zorder=6)
    (x, y), reach_m = map(float, replay.goal_xy_w), replay.success_distance_m
    axis.add_patch(Circle((x, y), reach_m, color="#009e73", alpha=0.35, linewidth=0, zorder=2))
    axis.plot(*replay.goal_xy_w, marker="*", color="#009e73", markeredgecolor="k", markersize=11, zorder=7)
    s = replay.metrics
    axis.set_title(
        f"{replay.policy}, {scene.name}, episode {replay.episode}: {'reached' if s['success'] else 'not reached'}\n"
        f"P_eff {s['path_efficiency']:.2f}  E_eff {s['effort_efficiency']:.2f}  INS_0.5 {s['ins_0.5']:.2f}",
        fontsize=8,
    )
    axis.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
    axis.tick_params(labelsize=6)
    axis.set_xlabel("x [m]", fontsize=7)
    axis.set_ylabel("y [m]", fontsize=7)


def panels(replays: Sequence[Replay], scenes: dict[str, Scene], colour_by: str = "time", columns: int = 3) -> Figure:
    """Return a figure of at most `columns` panels in a row, one a replay; replays name their paths of `scenes`."""
    columns = min(columns, len(replays))
    rows = -(-len(replays) // columns)
    shapes = [scenes[r.scene].maps.traversable.shape for r in replays]
    aspect = float(np.clip(max(n / m for n, m in shapes), 0.4, 1.6))
    size = (3.9 * columns + (0.6 if colour_by == "time" else 0.0), (3.5 * aspect + 0.75) * rows + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axis in grid.flat[len(replays) :]:
        axis.set_axis_off()
    for axis, replay in zip(grid.flat, replays, strict=False):
        draw_topdown(axis, replay, scenes[replay.scene], colour_by)
    handles: list[Any] = []
    if colour_by == "time":
        longest = max(r.num_steps * r.control_dt_s for r in replays)
        shades = ScalarMappable(Normalize(0, longest), "viridis")
        figure.colorbar(shades, ax=grid, label="time [s]", shrink=0.7, pad=0.01)
        for axis in grid.flat:
            for line in axis.collections:
                if isinstance(line, LineCollection):
                    line.set_clim(0, longest)
    else:
        handles += [Line2D([], [], color=c, linewidth=2, label=f"touches {what}") for what, c in TOUCH_COLOURS.items()]
    handles += [
        Patch(facecolor="none", edgecolor="0.4", linestyle=":", label="moved object, at start"),
        Patch(facecolor="0.8", edgecolor="0.3", label="object, at end"),
        Line2D([], [], marker="o", color="k", markerfacecolor="none", linestyle="", label="robot (start dashed)"),
        Line2D([], [], marker="*", color="#009e73", markeredgecolor="k", linestyle="", markersize=9, label="goal"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if columns > 1 else 2, fontsize=7, frameon=False)
    return figure


def _draw_object(axis: Axes, category: str, boxes: np.ndarray, pos: np.ndarray, quat: np.ndarray, extent: Any) -> None:
    before, after = (shadow(boxes, pos[i], quat[i]) for i in (0, -1))
    centre = np.array(before.centroid.coords[0])
    if not (extent[0] <= centre[0] <= extent[1] and extent[2] <= centre[1] <= extent[3]):
        return  # an object without a place waits outside
    colour = np.array(COLOURS[category])
    shades = {"facecolor": (*colour, 0.75), "edgecolor": (*(0.6 * colour), 1.0)}
    axis.add_patch(patch_from_polygon(after, linewidth=0.6, zorder=3, **shades))
    if before.hausdorff_distance(after) <= MOVED_M:
        return
    dark = 0.55 * colour
    axis.add_patch(patch_from_polygon(before, facecolor="none", edgecolor=dark, linewidth=0.9, linestyle=":", zorder=3))
    there = np.array(after.centroid.coords[0])
    if np.linalg.norm(there - centre) > MOVED_M:
        arrow = {"arrowstyle": "-|>", "color": dark, "lw": 1.0, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8}
        tip, tail = (float(there[0]), float(there[1])), (float(centre[0]), float(centre[1]))
        axis.annotate("", tip, tail, arrowprops=arrow, zorder=5)


def _draw_path(axis: Axes, replay: Replay, colour_by: str) -> None:
    path = replay.robot_xy_w
    segments = np.stack([path[:-1], path[1:]], 1)
    lines = LineCollection(list(segments), linewidths=2.0, zorder=4, capstyle="round")
    if colour_by == "time":
        lines.set_array(np.arange(1, len(path)) * replay.control_dt_s)
        lines.set_cmap("viridis")
    else:
        names = np.where(replay.touches_movable, "an object", np.where(replay.touches_structure, "a wall", "nothing"))
        lines.set_color([TOUCH_COLOURS[name] for name in names])
    axis.add_collection(lines)


def _files(sources: Sequence[str]) -> list[Path]:
    """Return the replay files of a list of files, folders of replays and run folders."""
    files: list[Path] = []
    for source in map(Path, sources):
        if source.is_dir():
            folder = source / "replays" if (source / "replays").is_dir() else source
            inside = sorted(folder.glob("*.npz"), key=lambda p: (p.stem.rpartition("-episode")[2].zfill(9), p.stem))
            if not inside:
                raise ReplayError(f"{source}: holds no replays; record some: python -m train.replay {typed(source)}")
            files += inside
        else:
            files.append(source)
    return files


class TopDown(Command):
    """Draw recorded episodes from above."""

    replays: Annotated[tuple[Path, ...], *word("REPLAY")]
    """Replay files (.npz), or run folders that contain replays."""
    out: Annotated[Path, option("-o", metavar="PATH")] = Path("topdown.png")
    """Picture to write."""
    colour_by: Literal["time", "contact"] = "time"
    """What the colour of the path shows: the time, or contact with objects."""
    columns: AtLeastOne = 3
    """Number of panels in a row."""


@reports_errors("interactive_nav.topdown")
def main(argv: Sequence[str] | None = None) -> int:
    arguments = parse(TopDown, "python -m interactive_nav.topdown", argv)
    replays = [load_replay(path) for path in _files(arguments.replays)]
    scenes = {path: load_scene(path) for path in dict.fromkeys(r.scene for r in replays)}
    figure = panels(replays, scenes, arguments.colour_by, arguments.columns)
    with whole_file(arguments.out) as partial:
        figure.savefig(partial, dpi=160)
    print(f"{arguments.out}: {len(replays)} episodes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
