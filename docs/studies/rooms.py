"""`python -m docs.studies.rooms SCENE... -o rooms.png`: scenes in, a picture and a table of their rooms out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import reports_errors
from topological_nav.config import DataConfig
from topological_nav.figures.maps import floor_plan, plt, room_points, save
from topological_nav.scenes.space import METHODS, agreement, find_rooms, free_space, recorded_rooms


def compare(scene_folders: Sequence[Path], seed: int = 0, clearance_m: float = 0.2) -> list[dict[str, Any]]:
    """Rooms by every method, with their number known and chosen, for some scenes.

    Returns:
        One row a scene, method and way to choose the number: scene, method, chosen_by, count, known (number of
        recorded rooms or None), agreement (or None), rooms (`Rooms`), space (`FreeSpace`).
    """
    height_m = get_robot(DataConfig().robot).height_m
    rows = []
    for folder in scene_folders:
        scene = load_scene(folder)
        space, known = free_space(scene, height_m), recorded_rooms(scene.digest)
        for method in METHODS:
            for given in [known, None] if known is not None else [None]:
                rooms = find_rooms(space, method, None, given, seed, clearance_m)
                rows.append(
                    {
                        "scene": Path(folder).name,
                        "method": method,
                        "chosen_by": rooms.chosen_by,
                        "count": rooms.count,
                        "known": None if known is None else len(known),
                        "agreement": None if known is None else agreement(rooms, known),
                        "rooms": rooms,
                        "space": space,
                        "recorded": known,
                    }
                )
    return rows


def rooms_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """One row a scene, one column a method: the rooms found where their number is known, else where it is chosen.

    Args:
        rows: of `compare`.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    spaces = [next(r["space"] for r in rows if r["scene"] == scene) for scene in scenes]
    extents = [np.ptp(space.centres(0.0), axis=0) + 0.8 for space in spaces]
    heights = [extent[1] / extent[0] for extent in extents]
    figure, grid = plt.subplots(
        len(scenes),
        len(methods),
        figsize=(2.4 * len(methods), 2.4 * sum(heights) + 0.85 * len(scenes)),
        height_ratios=heights,
        squeeze=False,
        layout="constrained",
    )
    for line, scene in zip(grid, scenes, strict=True):
        for axis, method in zip(line, methods, strict=True):
            mine = [r for r in rows if r["scene"] == scene and r["method"] == method]
            shown, rooms = mine[0], mine[0]["rooms"]
            floor_plan(axis, shown["space"])
            room_points(axis, rooms.points_w, rooms.labels, s=3, linewidths=0)
            if shown["recorded"] is not None:
                for x0, y0, x1, y1 in shown["recorded"]:
                    axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, linewidth=0.9, edgecolor="k"))
            said = [
                f"{r['count']} rooms, {r['chosen_by']}"
                + ("" if r["agreement"] is None else f": ARI {r['agreement']:.2f}")
                for r in mine
            ]
            axis.set_title("\n".join([f"{scene}, {method}", *said]), fontsize=8)
    return figure


@reports_errors("docs.studies.rooms")
def main(argv: Sequence[str] | None = None) -> int:
    """Draws and prints; 0 when done, 2 on a user's error."""
    made = argparse.ArgumentParser(prog="python -m docs.studies.rooms", description=__doc__)
    made.add_argument("scenes", nargs="+", metavar="SCENE", help="scene folders")
    made.add_argument("-o", "--out", default="rooms.png", metavar="PATH", help="picture (default rooms.png)")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--clearance", type=float, default=0.2, metavar="M", help="of positions (default 0.2)")
    arguments = made.parse_args(argv)
    rows = compare([Path(s) for s in arguments.scenes], arguments.seed, arguments.clearance)
    save(rooms_figure(rows), Path(arguments.out), Path(arguments.out).suffix[1:] or "png")
    for row in rows:
        rand = "" if row["agreement"] is None else f"  adjusted Rand index {row['agreement']:.3f}"
        print(f"{row['scene']:<14}{row['method']:<10}{row['count']:>3} rooms ({row['chosen_by']}){rand}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
