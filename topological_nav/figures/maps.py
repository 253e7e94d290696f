"""Draw plans, rooms, maps and paths; record an episode as a picture, a log and a film."""

import dataclasses
import functools
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from PIL import Image

from interactive_nav.record import write_mp4
from interactive_nav_common import figures
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.figures import BLUE, GREEN, ORANGE, PINK, SKY, VERMILION, parts, plt, scene_axes
from interactive_nav_common.files import whole_file
from interactive_nav_common.jobs.progress import Progress
from topological_nav.data.dataset import images_at, load_plan, read_header
from topological_nav.evaluate.contest import FILM_HEIGHT, ContestScene
from topological_nav.evaluate.evaluation import DrivenEpisodes, NavigatorPlayer, Played
from topological_nav.maps.graph import TopologicalMap
from topological_nav.navigate.navigator import FACE, PHASES, State
from topological_nav.scenes.rendering import Camera, Snapshot
from topological_nav.scenes.space import FreeSpace

WON, LOST = BLUE, VERMILION
FEW = 100
"""Up to so many episodes, every start and goal is drawn; beyond, only those of failures."""
INK = 40.0
"""Number of overlapping paths that make a solid colour."""


def map_lines(axis: Axes, graph: TopologicalMap, passable: float) -> None:
    """Draw a map's nodes and open edges in the background."""
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
    """Draw the contenders' paths in a scene, a panel each."""
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
    axis.plot([left + 0.2, left + 2.2], [bottom - 0.3] * 2, color="k", linewidth=2, solid_capstyle="butt")
    axis.text(left + 2.35, bottom - 0.3, "2 m", va="center", fontsize=8)


def room_points(axis: Axes, points_w: np.ndarray, labels: np.ndarray, **style: Any) -> None:
    """Draw points in their rooms' colours."""
    axis.scatter(*points_w.T, c=[PALETTE[k % len(PALETTE)] for k in labels], **style)


def dataset_figure(folder: Path) -> Figure:
    """Draw a dataset's positions, a panel per scene, and level images of some positions below."""
    header, config = read_header(folder)
    scenes = [(s["name"], load_plan(folder, s["name"])) for s in header["scenes"]]
    places = [(name, plan, k) for name, plan in scenes for k in range(len(plan.xy_w))]
    shown = [places[k] for k in np.linspace(0, len(places) - 1, min(6, len(places))).astype(int)]
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
    for axis, (name, plan, k) in zip(grid, shown, strict=True):
        strip = images_at(folder, name, k, config)[1, :: max(config.headings // 9, 1)]
        axis.imshow(np.concatenate(list(strip), 1))
        axis.set_axis_off()
        axis.set_title(f"room {name}/{plan.room[k]}, level, turning left", fontsize=7, loc="left")
    return figure


def map_figure(space: FreeSpace, graphs: Sequence[TopologicalMap], route: Sequence[int] = ()) -> Figure:
    """Draw maps of a scene side by side, a route on top: edges from blocked to free, each direction on half of it."""
    extent = np.ptp(space.centres(0.0), axis=0)
    width = 7.2 if len(graphs) == 1 else 5.5
    size = (width * len(graphs), 1.2 + 0.97 * width * extent[1] / extent[0])
    figure, (axes,) = figures.panels(size, 1, len(graphs))
    for axis, graph in zip(axes, graphs, strict=True):
        floor_plan(axis, space)
        start, end = graph.xy_w[graph.edges[:, 0]], graph.xy_w[graph.edges[:, 1]]
        order = np.argsort(graph.p)
        ways = list(np.stack([start, (start + end) / 2], 1)[order])
        halves = LineCollection(ways, cmap=FREE, linewidths=1.1, zorder=2)
        halves.set_array(graph.p[order])
        halves.set_clim(0.0, 1.0)
        axis.add_collection(halves)
        room_points(axis, graph.xy_w, graph.room, s=130, linewidths=0, zorder=4)
        axis.scatter(graph.xy_w[:, 0], graph.xy_w[:, 1], s=70, c="w", linewidths=0, zorder=4)
        for node, xy in enumerate(graph.xy_w):
            if np.linalg.norm(graph.xy_w[:node] - xy, axis=-1).min(initial=1.0) > 0.25:  # else one over the other
                axis.text(xy[0], xy[1], str(node), ha="center", va="center", fontsize=6, zorder=5)
        if route:
            axis.plot(*graph.xy_w[list(route)].T, color="k", linewidth=2.6, zorder=3)
        axis.set_title(f"{graph.scene}: {len(graph.xy_w)} nodes, {len(graph.edges)} directed edges", fontsize=9)
    look: Any = {"label": "probability that the way is free", "orientation": "horizontal", "aspect": 20 * len(graphs)}
    figure.colorbar(ScalarMappable(cmap=FREE), ax=axes, shrink=0.6, pad=0.01, **look)
    return figure


FILM_EVERY_S = 0.5
FILM_RATE = 20.0
"""Frames per second of film, ten times as fast as real time."""


@dataclasses.dataclass(frozen=True)
class Driven:
    """Hold a recorded episode."""

    venue: ContestScene
    map: TopologicalMap
    journey: DrivenEpisodes
    """The episode."""
    played: Played
    goal_node: int
    time_s: np.ndarray
    """[t] of every control step."""
    xy_w: np.ndarray
    """[t, 2] m."""
    yaw_rad: np.ndarray
    """[t]."""
    phase: np.ndarray
    """[t] i8."""
    views: dict[int, np.ndarray]
    """Control step -> image, if filmed."""
    goal_images: np.ndarray
    """[K, ...]."""
    log: list[str]
    """Events, one per line."""

    @property
    def outcome(self) -> str:
        played = self.played
        what = "reached the goal" if played.success[0] else "did not reach the goal"
        return (
            f"{what} after {played.duration_s[0]:.0f} s and {played.path_m[0]:.1f} m (shortest "
            f"{self.journey.shortest_m[0]:.1f} m), {played.goal_m[0]:.2f} m from it, "
            f"{played.contact_runs[0]} of {played.runs[0]} runs with a contact"
        )

    def figure(self) -> Figure:
        """Draw the path over plan and map."""
        extent = np.ptp(self.venue.space.centres(0.0), axis=0) + 0.8
        figure, axis = plt.subplots(figsize=(8.0, 0.7 + 6.6 * extent[1] / extent[0]), layout="constrained")
        self.draw(axis)
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        return figure

    def draw(self, axis: Axes, width: int = 90) -> None:
        """Draw the labelled path over plan and map, with a title in lines of at most `width` letters."""
        title = f"{self.venue.scene.name}, episode {self.journey.number[0]}: {self.outcome}"
        axis.set_title(textwrap.fill(title, width), fontsize=9)
        floor_plan(axis, self.venue.space)
        map_lines(axis, self.map, self.venue.contest.config.passable)
        axis.plot(*self.xy_w.T, color=BLUE, linewidth=1.2, zorder=3)
        for name, colour in (("localise", ORANGE), ("swing", PINK), ("lean", VERMILION)):
            here = self.xy_w[self.phase == PHASES.index(name)]
            if len(here):
                axis.scatter(*here.T, s=22, color=colour, zorder=4, label=name, linewidths=0)
        axis.plot(*self.journey.start_xy_w[0], "o", color="k", markersize=7, zorder=5, label="start")
        axis.plot(*self.journey.goal_xy_w[0], "*", color=GREEN, markersize=14, zorder=5, label="goal")
        style: Any = {"mfc": "none", "mec": GREEN, "markersize": 11, "zorder": 5}
        axis.plot(*self.map.xy_w[self.goal_node], "s", label="goal's node", **style)

    def frames(self) -> Iterator[np.ndarray]:
        """Yield [H, W, 3] u8, even-sided: plan and map with the path so far, beside them the camera's image, if any."""
        extent = np.ptp(self.venue.space.centres(0.0), axis=0) + 0.8
        width = int(round(FILM_HEIGHT * extent[0] / extent[1] / 2)) * 2
        figure = plt.figure(figsize=(width / 100, FILM_HEIGHT / 100), dpi=100)
        axis, canvas = figure.add_axes((0, 0, 1, 1)), figure.canvas
        floor_plan(axis, self.venue.space)
        axis.set_aspect("auto")
        map_lines(axis, self.map, self.venue.contest.config.passable)
        axis.plot(*self.journey.goal_xy_w[0], "o", mfc="none", mec=GREEN, mew=2, markersize=9, zorder=4)
        (path,) = axis.plot([], color=BLUE, linewidth=1.5, zorder=3)
        (robot,) = axis.plot([], "o-", color=VERMILION, linewidth=2.2, markersize=9, markevery=[0], zorder=5)
        caption = axis.text(0.01, 0.99, "", fontsize=8, va="top", transform=axis.transAxes)
        for step in range(0, len(self.time_s), _film_every(self.venue)):
            here, yaw = self.xy_w[step], self.yaw_rad[step]
            path.set_data(*self.xy_w[: step + 1].T)
            robot.set_data(*np.transpose([here, here + 0.5 * np.array([np.cos(yaw), np.sin(yaw)])]))
            caption.set_text(f"{self.venue.scene.name}  {self.time_s[step]:.0f} s  {PHASES[self.phase[step]]}")
            canvas.draw()
            frame = np.array(canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
            if (view := self.views.get(step)) is not None:
                side = int(round(FILM_HEIGHT * view.shape[1] / view.shape[0] / 2)) * 2
                beside = Image.fromarray(view).resize((side, FILM_HEIGHT), Image.Resampling.BOX)
                frame = np.concatenate([frame, np.asarray(beside)], 1)
            yield frame
        plt.close(figure)


def drive_episode(
    venue: ContestScene, contender: str, number: int, camera: Camera | None, progress: Progress
) -> Driven:
    """Drive one of a scene's episodes; keep views of the camera, if any."""
    contest = venue.contest
    if not 0 <= number < len(venue.episodes):
        raise ConfigError(f"episode is {number}, expected 0 to {len(venue.episodes) - 1}; episodes=N makes more")
    journey = venue.episodes.take(np.array([number]))
    navigator = venue.navigator(contender)
    graph = navigator.map
    steps: list[tuple[float, np.ndarray, float, int]] = []
    views: dict[int, np.ndarray] = {}
    log: list[str] = []
    every = _film_every(venue)

    def watch(time_s: float, now: Snapshot, state: State) -> None:
        if camera and len(steps) % every == 0:
            views[len(steps)] = camera(now.xy_w[:1], now.yaw_rad[:1], now.qpos[:1])[0]
        steps.append((time_s, now.xy_w[0], now.yaw_rad[0], int(state.phase[0])))
        log.extend(f"{time_s:7.1f} s  {line}" for line in _log_lines(graph, state))

    player = NavigatorPlayer(venue.player, contest.config, navigator, venue.camera, watch)
    what, limit_s = f"{venue.scene.name}, simulated s", int(contest.config.limit_s)
    played = player.play(journey, lambda _, time_s: progress(what, int(time_s), limit_s))
    time_s, xy, yaw, phase = zip(*steps, strict=True)
    columns = (np.array(column) for column in (time_s, xy, yaw, phase))
    node, goals = int(player.state.goal[0]), player.goal_images[0]
    return Driven(venue, graph, journey, played, node, *columns, views=views, goal_images=goals, log=log)


def _log_lines(graph: TopologicalMap, state: State) -> Iterator[str]:
    node, edge = int(state.node[0]), int(state.edge[0])
    if state.localised[0] or state.glanced[0]:
        yield f"{'looked about' if state.localised[0] else 'glanced'}: at node {node}"
    still = bool(state.run_ended[0]) and not state.glanced[0] and state.phase[0] == FACE
    if still:
        yield f"glanced: still at node {node}"
    if state.blocked[0]:
        yield "no heading near the edge's is open"
    if state.lost[0]:
        yield f"the map has no way from node {node} to {int(state.goal[0])}"
    elif edge >= 0 and (state.localised[0] or state.glanced[0] or state.blocked[0] or still):
        degrees = np.rad2deg(graph.angle_rad[edge])
        yield f"next: node {graph.edges[edge, 1]}, heading {degrees:.0f} degrees, p {graph.p[edge]:.2f}"
    if state.run_started[0] and state.run[0] == 0:
        yield "drives"
    if state.arrived[0]:
        yield "is at the goal's node"
    if state.timed_out[0]:
        yield "out of time"


def _film_every(venue: ContestScene) -> int:
    return max(1, round(FILM_EVERY_S / venue.player.env.dt))


def film(driven: Driven, path: Path) -> int:
    """Write a film, the plan beside the camera's images; return the number of frames."""
    with whole_file(path) as partial:
        return write_mp4(driven.frames(), partial, FILM_RATE)
