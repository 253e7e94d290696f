"""What drawing images smaller costs the topological navigator's networks, and what it saves.

    python -m docs.studies.supersample scenes_mjcf/rowan

Draws the same places at the size that the networks learned from and smaller, all averaged to the size that they look
at, and compares what the networks say with what they say of the largest. Without --localiser and --detector: the
package's networks.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.steps_per_second import timed
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav_common.rows import markdown
from topological_nav.data.folders import renderer_of
from topological_nav.learn.training import Networks, Trained, load_networks
from topological_nav.scenes.rendering import camera_pose
from topological_nav.scenes.space import free_space
from topological_nav.weights.export import packaged_weights

CLEARANCE_M = 0.35
"""Least distance of places from obstacles."""
AHEAD_M = (1.0, 2.0)
"""Lengths that the detector is asked about."""


class Compared(NamedTuple):
    """One way of drawing against the largest."""

    supersample: int
    images_per_s: float
    embedding: float
    """Mean distance of localisation embeddings."""
    mean_p: float
    largest_p: float
    """Difference of the probabilities that a way is free."""
    flips: float
    """Share of those on the other side of 0.5."""


def compare(
    scene: Scene, localiser: Trained, detector: Trained, places: int, seed: int = 0
) -> tuple[list[Compared], float]:
    """Compares every `supersample` from the networks' own down to 1.

    Args:
        scene: where.
        localiser: whose embedding localises.
        detector: of passages.
        places: looked at, one heading each.
        seed: of places and headings.

    Returns:
        A row each, the largest first; and the mean distance of the embeddings of different places.
    """
    data = Networks(localiser, detector).camera
    robot = get_robot(data.robot)
    rng = np.random.default_rng(seed)
    xy = free_space(scene, robot.height_m).sample(rng, places, CLEARANCE_M)
    pose = camera_pose(robot, xy, rng.uniform(-np.pi, np.pi, places), np.zeros(places))
    rows: list[Compared] = []
    largest: tuple[np.ndarray, np.ndarray] | None = None
    for by in range(data.supersample, 0, -1):
        renderer = renderer_of(scene, dataclasses.replace(data, supersample=by))
        renderer.draw(pose)  # compiles
        images, took_s = timed(renderer.draw, pose)
        rate = places / took_s
        embedding = localiser.embed(images)
        p = np.stack([detector.passage(images, np.full(places, ahead_m)) for ahead_m in AHEAD_M])
        largest = largest or (embedding, p)
        apart, off = np.linalg.norm(embedding - largest[0], axis=1), np.abs(p - largest[1])
        flips = ((p > 0.5) != (largest[1] > 0.5)).mean()
        rows.append(Compared(by, rate, float(apart.mean()), float(off.mean()), float(off.max()), float(flips)))
    assert largest is not None
    return rows, float(np.linalg.norm(largest[0][:-1] - largest[0][1:], axis=1).mean())


def main(argv: Sequence[str] | None = None) -> None:
    """Prints a row for every size."""
    made = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    made.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    made.add_argument("--localiser", type=Path, default=packaged_weights() / "rooms", metavar="RUN")
    made.add_argument("--detector", type=Path, default=packaged_weights() / "passages", metavar="RUN")
    made.add_argument("--places", type=int, default=36)
    arguments = made.parse_args(argv)
    networks = load_networks(arguments.localiser, arguments.detector)
    rows, typical = compare(load_scene(arguments.scene), *networks, arguments.places)
    header = ("supersample", "images/s", "embeddings apart", "p: mean difference", "largest", "other side of 0.5")
    lines = [(r.supersample, f"{r.images_per_s:.1f}", *(f"{value:.3f}" for value in r[2:])) for r in rows]
    print(markdown(header, lines), end="")
    print(f"embeddings of different places are {typical:.3f} apart")


if __name__ == "__main__":
    main()
