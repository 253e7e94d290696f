"""`python -m docs.studies.policies.strips -o strips.webp --strip REPLAY CAPTION ...`: replays in, film strips out.

A strip is a row of views from above; the thing that the robot touched longest is outlined.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes

from interactive_nav.pictures.camera import SceneView
from interactive_nav.pictures.replay import Replay, load_replay
from interactive_nav.pictures.scene_model import ROBOT, SCENE
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav.scenes.slots import bodies_by_name
from interactive_nav_common import figures as style
from scenes_mjcf.look import CameraPose, Lens, straight_down
from topological_nav.scenes.space import shadow

LENS = Lens(480, 360, 20.0)
MARGIN_M = 0.4
GOAL_COLOUR, THING_COLOUR = "#00e08a", "#ffd400"
"""They stand out from floors and furniture."""
LABEL_BOX = {"facecolor": "0.1", "linewidth": 0, "boxstyle": "round,pad=0.2"}


def shadows_of(replay: Replay, scene: Scene, step: int) -> dict[str, Any]:
    """What each movable thing covers of the floor, by its body's name."""
    at = {name: (thing.rows, replay.bodies.index(name)) for name, thing in bodies_by_name(scene, replay.small).items()}
    pos_w, quat_w = replay.body_pos_w[step], replay.body_quat_w[step]
    return {name: shadow(boxes, pos_w[b], quat_w[b]) for name, (boxes, b) in at.items()}


def touched_longest(replay: Replay, scene: Scene) -> str | None:
    """The thing that was nearest to the robot in most steps in which it touched one; None where it touched none."""
    count = Counter()
    for step in (np.flatnonzero(replay.touches_movable) + 1).tolist():
        robot, shadows = shapely.Point(replay.robot_xy_w[step]), shadows_of(replay, scene, step)
        count[min(shadows, key=lambda name, s=shadows, r=robot: s[name].distance(r))] += 1
    return max(count, key=count.__getitem__, default=None)


def floor_seen(camera: CameraPose) -> tuple[float, float, float, float]:
    """Least and greatest x and y, m, of the floor below a camera that looks straight down through `LENS`."""
    y = camera.pos_w[2] * np.tan(np.radians(LENS.fov_deg / 2))
    x = y * LENS.width / LENS.height
    return camera.pos_w[0] - x, camera.pos_w[0] + x, camera.pos_w[1] - y, camera.pos_w[1] + y


def draw(axes: Sequence[Axes], replay: Replay, at_s: Sequence[float]) -> str | None:
    """Draws one replay, an axis a time; returns what it touched longest."""
    scene, robot, path = load_scene(replay.scene), get_robot(replay.robot), replay.robot_xy_w
    view = SceneView(robot, scene, replay.small, replay.segmentation_classes)
    thing = touched_longest(replay, scene)
    start, end = ([shadows_of(replay, scene, step)[thing]] if thing else [] for step in (0, -1))
    seen = np.vstack([path, replay.goal_xy_w, *(np.reshape(shape.bounds, (2, 2)) for shape in start + end)])
    low_w, high_w = seen.min(0) - MARGIN_M, seen.max(0) + MARGIN_M
    camera = straight_down(low_w, high_w, LENS.width / LENS.height, LENS.fov_deg)
    for axis, time_s in zip(axes, at_s, strict=True):
        step = min(round(time_s / replay.control_dt_s), replay.num_steps)
        view.place(replay.bodies, replay.body_pos_w[step], replay.body_quat_w[step])
        axis.imshow(view.textured(camera, LENS, (*SCENE, ROBOT)), extent=floor_seen(camera))
        axis.set_autoscale_on(False)
        now = [shadows_of(replay, scene, step)[thing]] if thing else []
        for shape, line in zip(start + now, ":-", strict=False):
            axis.plot(*shape.convex_hull.exterior.xy, color=THING_COLOUR, linewidth=1.4, linestyle=line)
        for colour, width in (("w", 2.2), (style.BLUE, 1.3)):
            axis.plot(*path[: step + 1].T, color=colour, linewidth=width)
        disc = shapely.Point(path[step]).buffer(robot.footprint_radius_m).exterior
        axis.fill(*disc.xy, facecolor=style.VERMILION, alpha=0.75, edgecolor="w", linewidth=1.2, zorder=5)
        axis.plot(*replay.goal_xy_w, marker="*", color=GOAL_COLOUR, markeredgecolor="k", markersize=13, zorder=6)
        time = f"{step * replay.control_dt_s:.0f} s"
        axis.text(0.03, 0.95, time, va="top", color="w", bbox=LABEL_BOX, zorder=7, transform=axis.transAxes)
        axis.set(xticks=[], yticks=[])
    return thing


def main(argv: Sequence[str] | None = None) -> None:
    """Writes the strips below each other."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--strip", nargs=2, action="append", required=True, metavar=("REPLAY", "CAPTION"))
    words.add_argument("-o", "--output", type=Path, required=True)
    words.add_argument("--at", type=float, nargs="+", default=[0, 10, 30, 100], metavar="S", help="times of the frames")
    given = words.parse_args(argv)
    figure = style.plt.figure(figsize=(9.6, 2.12 * len(given.strip) + 0.3), layout="constrained")
    parts = figure.subfigures(len(given.strip), 1, squeeze=False)[:, 0]
    for part, (path, caption) in zip(parts, given.strip, strict=True):
        replay = load_replay(path)
        told = f"{caption} ({Path(replay.scene).name}, episode {replay.episode})"
        part.suptitle(told, x=0.005, ha="left", fontsize=11.5)
        thing = draw(part.subplots(1, len(given.at), squeeze=False)[0], replay, given.at)
        print(f"{path}: touched {thing or 'nothing'} longest, success {replay.metrics['success']:.0f}")
    handles = [
        style.handle("robot", marker="o", color=style.VERMILION, linestyle="", markersize=9),
        style.handle("path so far", color=style.BLUE, linewidth=2),
        style.handle("goal", marker="*", color=GOAL_COLOUR, markeredgecolor="k", linestyle="", markersize=12),
        style.handle("touched longest", color=THING_COLOUR, linewidth=2),
        style.handle("there at the start", color=THING_COLOUR, linewidth=2, linestyle=":"),
    ]
    style.legend(figure, handles, frameon=False, fontsize=10)
    figure.savefig(given.output, dpi=110, pil_kwargs={"quality": 70, "method": 6})


if __name__ == "__main__":
    main()
