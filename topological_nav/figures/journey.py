"""Drive one episode of a scene with the navigator and keep everything it does for a picture, a log and a film."""

import dataclasses
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from interactive_nav.record import write_mp4
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.figures import plt
from interactive_nav_common.files import whole_file
from topological_nav.evaluate.contest import Contest, ContestScene, contest_scenes
from topological_nav.evaluate.evaluation import DrivenEpisodes, NavigatorPlayer, Played
from topological_nav.figures.maps import floor_plan, map_lines, plan_picture
from topological_nav.maps.graph import TopologicalMap
from topological_nav.navigate.state import FACE, PHASES, Events, State
from topological_nav.scenes.simulation import Snapshot

FILM_EVERY_S = 0.5
FILM_RATE = 20.0
"""Frames a second of film: ten times as fast as it was."""
FILM_HEIGHT = 480
BLUE, GREEN, RED = (31, 119, 180), (44, 160, 44), (214, 39, 40)
"""Of path, goal and robot in it."""


@dataclasses.dataclass(frozen=True)
class Driven:
    """An episode."""

    venue: ContestScene
    map: TopologicalMap
    journey: DrivenEpisodes
    """The one alone."""
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
    """Control step -> image, where it was filmed."""
    log: list[str]
    """Events, a line each."""

    @property
    def outcome(self) -> str:
        """Return the outcome in words."""
        played = self.played
        what = "reached the goal" if played.success[0] else "did not reach the goal"
        return (
            f"{what} after {played.duration_s[0]:.0f} s and {played.path_m[0]:.1f} m (shortest "
            f"{self.journey.shortest_m[0]:.1f} m), {played.goal_m[0]:.2f} m from it, "
            f"{played.contact_runs[0]} of {played.runs[0]} runs with a contact"
        )

    def figure(self) -> Figure:
        """Draw the path over plan and map."""
        space, passable = self.venue.space, self.venue.contest.config.passable
        extent = np.ptp(space.centres(0.0), axis=0) + 0.8
        figure, axis = plt.subplots(figsize=(8.0, 0.7 + 6.6 * extent[1] / extent[0]), layout="constrained")
        floor_plan(axis, space)
        map_lines(axis, self.map, passable)
        axis.plot(*self.xy_w.T, color="tab:blue", linewidth=1.2, zorder=3)
        for name, colour in (("localise", "tab:orange"), ("swing", "tab:purple"), ("lean", "tab:red")):
            here = self.xy_w[self.phase == PHASES.index(name)]
            if len(here):
                axis.scatter(*here.T, s=22, color=colour, zorder=4, label=name, linewidths=0)
        axis.plot(*self.journey.start_xy_w[0], "o", color="k", markersize=7, zorder=5, label="start")
        axis.plot(*self.journey.goal_xy_w[0], "*", color="tab:green", markersize=14, zorder=5, label="goal")
        style: Any = {"mfc": "none", "mec": "tab:green", "markersize": 11, "zorder": 5}
        axis.plot(*self.map.xy_w[self.goal_node], "s", label="goal's node", **style)
        axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        axis.set_title(
            textwrap.fill(f"{self.venue.scene.name}, episode {self.journey.number[0]}: {self.outcome}", 90), fontsize=9
        )
        return figure

    def frame(self, step: int, plan: np.ndarray, pixels: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return [H, W, 3] u8: the plan with the path so far, beside it the camera's image, if any."""
        image = Image.fromarray(plan)
        draw = ImageDraw.Draw(image)
        if step:
            draw.line([tuple(p) for p in pixels(self.xy_w[: step + 1])], fill=BLUE, width=2)
        x, y = pixels(self.journey.goal_xy_w[0])
        draw.ellipse((x - 7, y - 7, x + 7, y + 7), outline=GREEN, width=3)
        here, yaw = self.xy_w[step], self.yaw_rad[step]
        nose = here + 0.5 * np.array([np.cos(yaw), np.sin(yaw)])
        x, y = pixels(here)
        draw.ellipse((x - 6, y - 6, x + 6, y + 6), fill=RED)
        draw.line([(x, y), tuple(pixels(nose))], fill=RED, width=3)
        caption = f"{self.venue.scene.name}  {self.time_s[step]:.0f} s  {PHASES[self.phase[step]]}"
        draw.text((6, 4), caption, fill=(0, 0, 0))
        view = self.views.get(step)
        if view is None:
            return np.asarray(image)
        width = int(round(len(plan) * view.shape[1] / view.shape[0] / 2)) * 2
        beside = Image.fromarray(view).resize((width, len(plan)), Image.Resampling.NEAREST)
        return np.concatenate([np.asarray(image), np.asarray(beside)], 1)


def drive_episode(contest: Contest, number: int, filmed: bool, progress: Callable[[float], None]) -> Driven:
    """Drive one of the episodes of a contest's only scene, as the contest's only contender."""
    (venue,) = contest_scenes(contest)
    if not 0 <= number < len(venue.episodes):
        raise ConfigError(
            f"episode is {number}, expected 0 to {len(venue.episodes) - 1}; episodes=N makes more of the scene"
        )
    journey = venue.episodes.take(np.array([number]))
    navigator = venue.navigator(contest.contenders[0])
    graph = navigator.map
    steps: list[tuple[float, np.ndarray, float, int]] = []
    views: dict[int, np.ndarray] = {}
    log: list[str] = []
    every = _film_every(venue)

    def watch(time_s: float, now: Snapshot, state: State, events: Events) -> None:
        if filmed and not contest.truth and len(steps) % every == 0:
            views[len(steps)] = venue.camera(now.xy_w[:1], now.yaw_rad[:1], now.qpos[:1])[0]
        steps.append((time_s, now.xy_w[0], now.yaw_rad[0], int(state.phase[0])))
        log.extend(f"{time_s:7.1f} s  {line}" for line in _log_lines(graph, state, events))

    player = NavigatorPlayer(venue.player, contest.config, navigator, venue.camera, watch)
    played = player.play(journey, lambda _, time_s: progress(time_s))
    assert player.state is not None
    time_s, xy, yaw, phase = zip(*steps, strict=True)
    columns = (np.array(column) for column in (time_s, xy, yaw, phase))
    return Driven(venue, graph, journey, played, int(player.state.goal[0]), *columns, views=views, log=log)


def _log_lines(graph: TopologicalMap, state: State, events: Events) -> Iterator[str]:
    node, edge = int(state.node[0]), int(state.edge[0])
    if events.localised[0] or events.glanced[0]:
        yield f"{'looked about' if events.localised[0] else 'glanced'}: at node {node}"
    still = bool(events.run_ended[0]) and not events.glanced[0] and state.phase[0] == FACE
    if still:
        yield f"glanced: still at node {node}"
    if events.blocked[0]:
        yield "no heading near the edge's is open"
    if events.lost[0]:
        yield f"the map has no way from node {node} to {int(state.goal[0])}"
    elif edge >= 0 and (events.localised[0] or events.glanced[0] or events.blocked[0] or still):
        degrees = np.rad2deg(graph.angle_rad[edge])
        yield f"next: node {graph.edges[edge, 1]}, heading {degrees:.0f} degrees, p {graph.p[edge]:.2f}"
    if events.run_started[0] and state.run[0] == 0:
        yield "drives"
    if events.arrived[0]:
        yield "is at the goal's node"
    if events.timed_out[0]:
        yield "out of time"


def _film_every(venue: ContestScene) -> int:
    """Return the control steps from one frame to the next."""
    return max(1, round(FILM_EVERY_S / venue.player.env.dt))


def film(driven: Driven, path: Path) -> int:
    """Write a film, the plan beside the camera's images; return the number of frames."""
    plan, pixels = plan_picture(driven.venue.space, driven.map, driven.venue.contest.config.passable, FILM_HEIGHT)
    steps = range(0, len(driven.time_s), _film_every(driven.venue))
    with whole_file(path) as partial:
        return write_mp4((driven.frame(step, plan, pixels) for step in steps), partial, FILM_RATE)
