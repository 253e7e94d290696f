"""Draw what the topological report shows in its figures 8 to 11, 13 to 18 and 22 to 24, from a folder of runs."""

import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Wedge
from sklearn.metrics.pairwise import euclidean_distances

from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.errors import FileError
from interactive_nav_common.figures import BLUE, VERMILION, parts, plt, scene_axes
from interactive_nav_common.jobs.progress import Progress, say
from interactive_nav_common.records import RUNS
from topological_nav.adaptation import labelled
from topological_nav.data.domains import AdaptConfig
from topological_nav.drives.dataset import DRIVES, drive_images, load_drives, read_drives_header
from topological_nav.drives.driving import TrainedPolicy, load_policy
from topological_nav.drives.imitation import classes
from topological_nav.evaluate.contest import Contest, ContestScene, contest_scenes
from topological_nav.figures.maps import FREE, Driven, drive_episode, floor_plan, map_figure, save
from topological_nav.learn.training import load_trained
from topological_nav.maps.build import judged_by

FRAMES, WIDE, TRIED = 8, 6, 4
"""Images of a drive; images in a line around a place; episodes tried on each map, by default."""
STANDING_M_S = 0.1
"""Images of an episode are evenly apart on its way, where a second counts as so many metres."""


def picture(axis: Axes, image: np.ndarray, title: str, frame: Any = None) -> None:
    """Show an image with a title, in a frame of a colour."""
    axis.imshow(image)
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set(visible=frame is not None, color=frame, linewidth=2.5)
    axis.set_title(title, fontsize=8)


def strips(folder: Path, policy: str, scene: str) -> Iterator[tuple[str, Figure]]:
    """Yield what the policy sees on the drive that turns left most (8) and on the one that turns least (9)."""
    if (folder / scene / DRIVES.file).is_file():  # the home's own folder
        folder = folder / scene
    header, _ = read_drives_header(folder)
    driver, drives, names = load_policy(policy), load_drives(folder), [about["name"] for about in header["scenes"]]
    mine = np.flatnonzero(drives.kept & (np.array(names)[drives.scene] == scene)).tolist()
    if not mine:
        raise FileError(f"{folder}: has drives in {', '.join(names)}, none in '{scene}'; choose another --scene")
    turns = [drives.command[drives.rows(k), 1] for k in mine]
    left, straight = np.argmax([np.mean(t) for t in turns]), np.argmin([np.mean(np.abs(t)) for t in turns])
    for number, k in (("8", mine[left]), ("9", mine[straight])):
        rows, images = next(part for part in drive_images(folder) if k in part[0])
        end = int(drives.steps[rows[: list(rows).index(k) + 1]].sum())
        figure = strip_figure(driver, images[end - drives.steps[k] : end], drives.command[drives.rows(k)])
        figure.suptitle(f"{scene}, drive {k}: the policy's class probabilities; red: the expert's commands", fontsize=9)
        yield number, figure


def strip_figure(driver: TrainedPolicy, images: np.ndarray, commands: np.ndarray) -> Figure:
    """Draw images [T, H, W, 3] of a drive, the probabilities of the policy's classes, and commands [T, 2]."""
    figure, (above, below) = parts((9, 4.4), [1.0, 2.6])
    for axis, t in zip(above.subplots(1, FRAMES), np.linspace(0, len(images) - 1, FRAMES).astype(int), strict=True):
        picture(axis, images[t], f"{t / 10:.1f} s")
    axes, seconds = below.subplots(2, 1, sharex=True, height_ratios=[3, 5]), np.arange(len(images)) / 10
    names = (("forward, m/s", "linear_m_s"), ("turning, rad/s (left +)", "angular_rad_s"))
    for axis, p, command, (name, of) in zip(axes, driver.probabilities(images), commands.T, names, strict=True):
        values = np.asarray(driver.about[of])
        half = (values[1] - values[0]) / 2
        extent = (-0.05, seconds[-1] + 0.05, values[0] - half, values[-1] + half)
        shade = axis.imshow(p.T, origin="lower", aspect="auto", extent=extent, cmap="Blues", vmin=0, vmax=1)
        axis.plot(seconds, command, color=VERMILION, linewidth=1.3)
        same = classes(command, values) == p.argmax(1)
        axis.set_title(f"{name}: the likeliest class is the expert's in {same.mean():.0%} of the steps", fontsize=9)
        axis.set_yticks(values)
    axes[1].set_xlabel("seconds of the drive")
    below.colorbar(shade, ax=list(axes), label="probability")
    return figure


def rounds(venue: ContestScene) -> Iterator[tuple[str, Figure]]:
    """Yield the detector's answers at the node whose edges it judges least alike (10), and in another room (11), and
    both maps (18)."""
    graph = venue.map
    judged = (graph.p[graph.edges[:, 0] == node] for node in range(len(graph.xy_w)))
    apart = np.array([np.ptp(p) if len(p) else 0.0 for p in judged])
    first = int(apart.argmax())
    yield "10", round_figure(venue, first)
    yield "11", round_figure(venue, int(np.where(graph.room == graph.room[first], -1.0, apart).argmax()))
    yield "18", map_figure(venue.space, [graph, venue.map_of("sparse")])


def round_figure(venue: ContestScene, node: int) -> Figure:
    """Draw probabilities for all headings around a node as sectors over the plan, and the images beside them."""
    assert venue.networks is not None
    graph, detector = venue.map, venue.networks.detector
    count, ahead_m = graph.embeddings.shape[1], detector.about["data"]["passage_length_m"]
    heading, xy = 2 * np.pi * np.arange(count) / count, np.repeat(graph.xy_w[node : node + 1].astype(float), count, 0)
    images = venue.camera(xy, heading)
    p, (margin_m, points) = detector.passage(images, ahead_m), judged_by(detector)
    ends = xy + ahead_m * np.stack([np.cos(heading), np.sin(heading)], -1)
    free = venue.space.segment_free(xy, ends, points, margin_m)
    figure: Any = plt.figure(figsize=(10, 3.9), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=[1.0, 1.6])
    axis, grid, half = left.subplots(), scene_axes(right, count, WIDE), 180 / count
    floor_plan(axis, venue.space)
    axis.texts[0].remove()  # of the bar, which lies outside; the circle's radius is the scale
    for k, degrees in enumerate(np.rad2deg(heading)):
        look: Any = {"facecolor": FREE(p[k]), "edgecolor": "k" if free[k] else "0.7", "zorder": 3 + free[k]}
        axis.add_patch(Wedge(xy[0], ahead_m * p[k], degrees - half, degrees + half, **look))
        picture(grid[k], images[k], f"{degrees:.0f}°: {p[k]:.2f}", FREE(p[k]))
    axis.add_patch(Circle(xy[0], ahead_m, fill=False, color="0.4", ls="--", linewidth=0.8))
    axis.set(**{f"{of}lim": (at - 1.3 * ahead_m, at + 1.3 * ahead_m) for of, at in zip("xy", xy[0], strict=True)})
    left.colorbar(ScalarMappable(cmap=FREE), ax=axis, label="probability", orientation="horizontal", shrink=0.7)
    title = f"{graph.scene}, node {node}: probability that {ahead_m:g} m ahead are free (length of a sector; dashed: 1)"
    said = f"{((p >= 0.5) == free).mean():.0%} of the headings are judged as on the plan, where the black ones are free"
    figure.suptitle(f"{title}\n{said}", fontsize=9)
    return figure


def closest(queries: np.ndarray, seen: np.ndarray) -> tuple[int, int, float]:
    """Return which of embeddings [n, D] and which of [m, D] are nearest to each other, and their distance."""
    away = euclidean_distances(queries.astype(float), seen.astype(float))
    query, at = divmod(int(away.argmin()), away.shape[1])
    return query, at, float(away[query, at])


def episodes(venue: ContestScene, progress: Progress) -> Iterator[tuple[str, Figure]]:
    """Yield the first episode that is won (13 to 15), and the first that is lost (16, 17), on either map."""
    count, names = min(venue.contest.config.episodes or TRIED, len(venue.episodes)), {True: "13-15", False: "16-17"}
    for contender, number in ((of, k) for of in ("dense", "sparse") for k in range(count)):
        driven = drive_episode(venue, contender, number, venue.camera, progress)
        if name := names.pop(bool(driven.played.success[0]), ""):
            yield name, episode_figure(driven, contender)
        if not names:
            return
    outcome = " or ".join("won" if wins else "lost" for wins in names)
    raise FileError(f"none of {count} episodes on each map was {outcome}; try more with episodes=N")


def reason(driven: Driven) -> str:
    """Say what the navigator met in an episode that was lost, how near it came, and where its time went."""
    near_m = np.linalg.norm(driven.xy_w - driven.journey.goal_xy_w[0], axis=-1).min()
    looking, *turning, driving = np.bincount(driven.phase, minlength=5)[:5] / len(driven.phase)
    return (
        f"{'the physics gave up' if driven.played.broken[0] else 'out of time'}, never nearer than {near_m:.1f} m; "
        f"{driven.played.blocked[0]} times no open heading, {driven.played.lost[0]} times no way in the map; "
        f"{driving:.0%} of the time driving, {looking:.0%} looking about, {sum(turning):.0%} turning to edges"
    )


def episode_figure(driven: Driven, contender: str) -> Figure:
    """Draw an episode: its path, the goal, the images of the map and of the way closest to it, and frames."""
    venue, graph, networks = driven.venue, driven.map, driven.venue.networks
    assert networks is not None
    steps, views, goals = list(driven.views), np.stack(list(driven.views.values())), driven.goal_images
    queries, (_, count, size) = networks.localiser.embed(goals), graph.embeddings.shape
    query, at, away = closest(queries, graph.embeddings.reshape(-1, size))
    _, met, met_away = closest(queries[[query]], networks.localiser.embed(views))
    node, heading = at // count, 2 * np.pi * (at % count) / count
    mapped = venue.camera(graph.xy_w[[node]].astype(float), np.array([heading]))[0]
    figure: Any = plt.figure(figsize=(11, 5.0), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=[1.0, 1.35])
    axis, cells = left.subplots(), right.subplots(3, 4).ravel()
    driven.draw(axis, 72)
    axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, frameon=False)
    picture(cells[0], goals[query], "the goal", BLUE)
    picture(cells[1], mapped, f"closest of the map: {away:.2f}\n(node {node}, {np.rad2deg(heading):.0f}°)", BLUE)
    picture(cells[2], views[met], f"closest on the way: {met_away:.2f}\n({driven.time_s[steps[met]]:.0f} s)", BLUE)
    walked_m = np.linalg.norm(np.diff(driven.xy_w[steps], axis=0, prepend=driven.xy_w[:1]), axis=1).cumsum()
    gone = walked_m + STANDING_M_S * driven.time_s[steps]
    for k, i in enumerate(np.searchsorted(gone, np.linspace(0, gone[-1], len(cells) - 3))):
        picture(cells[3 + k], views[i], f"{k + 1}: {driven.time_s[steps[i]]:.0f} s")
        axis.annotate(str(k + 1), driven.xy_w[steps[i]], fontsize=8, fontweight="bold", zorder=6)
    why = "won" if driven.played.success[0] else f"lost, {reason(driven)}"
    figure.suptitle(textwrap.fill(f"The {contender} map: {why}", 150), fontsize=9)
    return figure


def errors(free: np.ndarray, p: np.ndarray) -> list[np.ndarray]:
    """Return the false positives and the false negatives among labels [N] and probabilities [N], the surest first."""
    missed = (~free & (p > 0.5), free & (p <= 0.5))
    return [rows[np.argsort(-np.abs(p[rows] - 0.5))] for rows in map(np.flatnonzero, missed)]


def transferred(run: Path, target: Path, detector: Path) -> Iterator[tuple[str, Figure]]:
    """Yield a target's labels (22), and the errors there of a detector as it was (23) and fine-tuned (24) by a run."""
    tuned, path = load_trained(run), run / "config.yaml"
    stored, known = RUNS.decoded(path.read_bytes(), "YAML", str(path)), to_dict(AdaptConfig())
    config = overlay(AdaptConfig(), {name: stored[name] for name in known if name in stored}, str(path))
    _, tested = labelled(target, tuned.about["lengths_m"], config)
    ahead_m = tested.lengths_m[tested.scored]
    detectors = {"before (C)": load_trained(detector), "fine-tuned (D)": tuned}
    judged = {name: of.passage(tested.images, ahead_m) for name, of in detectors.items()}
    yield "22-24", errors_figure(tested.images, tested.free[:, tested.scored], judged)


def errors_figure(images: np.ndarray, free: np.ndarray, judged: Mapping[str, np.ndarray]) -> Figure:
    """Draw labelled images [N, H, W, 3], and those whose label [N] the probabilities [N] of each detector miss."""
    some = np.concatenate([np.flatnonzero(label)[: FRAMES // 2] for label in (free, ~free)])
    lines = [("labels in the target domain", some, ["passage" if free[k] else "no passage" for k in some])]
    for name, p in judged.items():
        kinds = ("positives", ~free, "without"), ("negatives", free, "with")
        for (kind, of, how), rows in zip(kinds, errors(free, p), strict=True):
            title = f"{name}, false {kind}: {len(rows)} of {of.sum()} images {how} a passage"
            lines.append((title, rows, [f"{p[k]:.2f}" for k in rows]))
    figure, bands = parts((9, 1.45 * len(lines)), [1.0] * len(lines))
    for band, (title, rows, words) in zip(bands, lines, strict=True):
        band.suptitle(title, fontsize=9, x=0.01, ha="left")
        for axis in (axes := band.subplots(1, FRAMES))[len(rows) :]:
            axis.set_axis_off()
        for axis, k, word in zip(axes, rows, words, strict=False):
            picture(axis, images[k], word, BLUE if free[k] else VERMILION)
    return figure


def draw_report(contest: Contest, runs: Path, progress: Progress) -> None:
    """Draw the figures into the contest's folder; print a line for each, and for what is missing."""
    (venue,) = contest_scenes(contest)
    for numbers, drawn in (
        ("8 and 9", strips(runs / "drives", contest.policy, venue.scene.name)),
        ("10, 11 and 18", rounds(venue)),
        ("13 to 17", episodes(venue, progress)),
        ("22 to 24", transferred(runs / "adapted-passages", runs / "data-unseen", contest.detector)),
    ):
        try:
            for number, figure in drawn:
                save(figure, contest.out / f"figure-{number}.png")
                say(f"{contest.out}/figure-{number}.png")
        except (FileError, OSError) as error:
            say(f"without figures {numbers}: {error}")
