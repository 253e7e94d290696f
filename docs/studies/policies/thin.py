"""`python -m docs.studies.policies.thin SCENE ...`: scenes in, a table of what the passage detector overlooks out.

One obstacle stands on the camera's axis in floor that is free for 2 m, its front 0.6, 1.0 or 1.5 m from the camera. The
table has the share of places that the detector judges free for 2 m.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from interactive_nav import get_robot, load_scene
from interactive_nav.scenes.objects import Box, SmallObject, body_names
from interactive_nav_common.config import overlay
from interactive_nav_common.statistics import over_episodes
from topological_nav.config import DataConfig
from topological_nav.data.folders import lens_of
from topological_nav.learn.training import Trained, camera_settings, load_trained
from topological_nav.maps.build import drawn_for, judged_by
from topological_nav.scenes.rendering import SceneRenderer, camera_pose
from topological_nav.scenes.space import FreeSpace, free_space
from topological_nav.weights.export import packaged_weights

AHEAD_M, DISTANCES_M = 2.0, (0.6, 1.0, 1.5)
ROOM_M = 0.35
"""Places are this far from everything, all along the way: an obstacle stands in free floor."""
GREY = (0.6, 0.6, 0.6, 1.0)
LEGS = tuple(Box((x, y, 0.225), (0.02, 0.02, 0.225)) for x in (0.02, 0.42) for y in (-0.2, 0.2))
BOXES = {
    "thin pole, 3 cm": (Box((0.015, 0.0, 0.6), (0.015, 0.015, 0.6)),),
    "four chair legs, 4 cm, 0.4 m apart": LEGS,
    "low board, 5 cm high, 0.8 m wide": (Box((0.05, 0.0, 0.025), (0.05, 0.4, 0.025)),),
    "low box, 15 cm high, 0.3 m wide": (Box((0.15, 0.0, 0.075), (0.15, 0.15, 0.075)),),
    "box of 0.4 m": (Box((0.2, 0.0, 0.2), (0.2, 0.2, 0.2)),),
}
"""Their fronts are at the origin; x leads away."""
OBSTACLES = tuple(SmallObject(name, "box", 0, 1.0, 0.5, boxes, GREY, ()) for name, boxes in BOXES.items())


def places(space: FreeSpace, count: int, rng: np.random.Generator, ahead_m: float, points: int) -> np.ndarray:
    """Places and headings [count, 3] whose way is free for `ahead_m`, with `ROOM_M` to the sides."""
    chosen: list[np.ndarray] = []
    centres = space.centres(ROOM_M)
    for _ in range(10**5):
        xy, yaw = centres[rng.integers(len(centres))], rng.uniform(-np.pi, np.pi)
        if space.segment_free(xy, xy + ahead_m * np.array([np.cos(yaw), np.sin(yaw)]), points, ROOM_M):
            chosen.append(np.array([*xy, yaw]))
        if len(chosen) == count:
            return np.array(chosen)
    raise SystemExit(f"{len(chosen)} places are free for {ahead_m:g} m, expected {count}; choose a larger scene")


def judged(scene_folder: Path, detector: Trained, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether the way is judged free for 2 m, [nothing and obstacles x distances, count] bool; and an image of each."""
    data = drawn_for(overlay(DataConfig(), camera_settings(detector), "network.json"), None)
    scene, robot = load_scene(scene_folder), get_robot(data.robot)
    renderer = SceneRenderer(scene, lens_of(data, robot), data.supersample, data.engine, OBSTACLES)
    rng, x = np.random.default_rng([0, 60]), robot.camera.pos_m[0]
    at = places(free_space(scene, robot.height_m), count, rng, x + AHEAD_M, judged_by(detector)[1])
    pose = camera_pose(robot, at[:, :2], at[:, 2], np.zeros(count))
    forward = np.stack([np.cos(at[:, 2]), np.sin(at[:, 2])], -1)
    half, nothing = at[:, 2] / 2, np.zeros(count)
    quat = np.stack([np.cos(half), nothing, nothing, np.sin(half)], -1)
    shown = [renderer.draw(pose)]
    for name in body_names(OBSTACLES):
        for away_m in DISTANCES_M:
            pos = np.concatenate([at[:, :2] + (x + away_m) * forward, np.zeros((count, 1))], -1)
            shown.append(renderer.draw(pose, ((name,), pos[:, None], quat[:, None])))
    images = np.stack(shown)
    p = detector.passage(images.reshape(-1, *images.shape[2:]), AHEAD_M).reshape(images.shape[:2])
    return p >= 0.5, images[:, 0]


def table(free: np.ndarray) -> str:
    """The shares judged free, with Wilson's intervals, as Markdown."""
    shares = [over_episodes("success", row.astype(float)).with_ends(2) for row in free]
    distances = " | ".join(f"{away_m:g} m" for away_m in DISTANCES_M)
    lines = [f"| On the axis | {distances} |", "|---" * (1 + len(DISTANCES_M)) + "|"]
    lines.append(f"| nothing | {' | '.join([shares[0]] * len(DISTANCES_M))} |")
    rows = zip(OBSTACLES, np.reshape(shares[1:], (-1, len(DISTANCES_M))).tolist(), strict=True)
    return "\n".join(lines + [f"| {thing.name} | {' | '.join(row)} |" for thing, row in rows])


def main(argv: Sequence[str] | None = None) -> None:
    """Prints the table, and writes a sheet of one place of each scene if requested."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("scenes", type=Path, nargs="+")
    words.add_argument("--detector", type=Path, default=packaged_weights() / "passages")
    words.add_argument("--places", type=int, default=24, help="in each scene")
    words.add_argument("-o", "--output", type=Path, help="images of the first place of each scene")
    given = words.parse_args(argv)
    detector = load_trained(given.detector)
    parts = [judged(scene, detector, given.places) for scene in given.scenes]
    free = np.concatenate([one for one, _ in parts], 1)
    print(f"{free.shape[1]} places\n\n{table(free)}")
    if given.output:
        Image.fromarray(np.concatenate([np.concatenate(list(images), 1) for _, images in parts])).save(given.output)


if __name__ == "__main__":
    main()
