"""Scene folders in, a dataset folder out, and back: room images around positions, and passage images.

    DATASET/dataset.json           settings, scenes with digests and counts, versions
            <scene>/plan.npz       rooms, positions and passages with labels: all that is decided before drawing
            <scene>/rooms-000.npz  images of some positions: pitch by pitch, heading by heading
            <scene>/passages-000.npz
            preview.png            where the images were taken, and some of them

What is decided depends on scene and settings only. Drawing goes file by file and skips those that exist.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav.robots import RobotSpec, get_robot
from interactive_nav.scenes.scene import Scene
from interactive_nav_common.errors import readable
from interactive_nav_common.files import write_arrays
from topological_nav.config import DataConfig
from topological_nav.data.folders import Folder, draw_missing, load_scenes
from topological_nav.data.passages import Passages, draw_passages, held_out
from topological_nav.data.shards import numbered, read_arrays, read_shards
from topological_nav.errors import DatasetError, Progress, SpaceError
from topological_nav.scenes.rendering import camera_pose
from topological_nav.scenes.rooms import Rooms, agreement, recorded_rooms, scene_rooms
from topological_nav.scenes.space import FreeSpace, free_space, spread

DATASET = Folder(
    file="dataset.json",
    version=2,
    base=DataConfig(),
    none="is no dataset (no dataset.json); make one: python -m topological_nav data ...",
    again="make the dataset again",
)
read_header = DATASET.read


@dataclasses.dataclass(frozen=True)
class ScenePlan:
    """Where a scene's images are taken, with labels."""

    rooms: Rooms
    xy_w: np.ndarray
    """[p, 2] m, positions of room images."""
    room: np.ndarray
    """[p] i32."""
    test: np.ndarray
    """[p] bool: for testing only."""
    passages: Passages


@dataclasses.dataclass(frozen=True)
class RoomImages:
    """Room images of a dataset: P positions, three pitches, K headings."""

    images: np.ndarray
    """[P, 3, K, H, W, 3] u8."""
    label: np.ndarray
    """[P] i32 room among all scenes' rooms."""
    names: tuple[str, ...]
    """Of the labels: scene/room."""
    scene: np.ndarray
    """[P] i32."""
    xy_w: np.ndarray
    """[P, 2] m."""
    test: np.ndarray
    """[P] bool."""


@dataclasses.dataclass(frozen=True)
class PassageImages:
    """Passage images of a dataset."""

    images: np.ndarray
    """[N, H, W, 3] u8."""
    free: np.ndarray
    """[N, L] bool, for each of `lengths_m`; never true after false."""
    scene: np.ndarray
    """[N] i32."""
    test: np.ndarray
    """[N] bool."""
    lengths_m: tuple[float, ...]
    """[L] ascending."""
    scored: int
    """Which of them passages are balanced on and detectors scored by."""


def headings(config: DataConfig) -> np.ndarray:
    """[K] rad: evenly about a position, from the world's x axis on."""
    return 2 * np.pi * np.arange(config.headings) / config.headings


def plan_scene(scene: Scene, space: FreeSpace, config: DataConfig) -> ScenePlan:
    """Decides where a scene's images are taken.

    Positions are drawn uniformly; of a room that has more than its share, those farthest from each other stay.
    """
    rng = np.random.default_rng([config.seed, 2, int(scene.digest[:8], 16)])
    rooms = scene_rooms(scene, space, config)
    try:
        drawn = space.sample(rng, config.positions, config.clearance_m)
    except SpaceError as error:
        raise SpaceError(f"{scene.path}: {error}") from None
    label = rooms.of(drawn)
    kept, test = [], []
    for k in range(rooms.count):
        mine = np.flatnonzero(label == k)
        mine = mine[np.sort(spread(drawn[mine], config.max_per_room, rng))]
        kept.append(mine)
        test.append(held_out(len(mine), config.test_share, rng))
    rows = np.concatenate(kept)
    passages = draw_passages(space, rooms, config, rng)
    return ScenePlan(rooms, drawn[rows], label[rows], np.concatenate(test), passages)


def make_dataset(
    scene_folders: Sequence[Path], out: Path, config: DataConfig, progress: Progress = lambda *_: None
) -> dict[str, Any]:
    """Make a dataset in the folder `out`, or what is missing of it; return the content of dataset.json."""
    scenes = load_scenes(scene_folders, config.engine)
    robot = get_robot(config.robot)
    plans = [plan_scene(scene, free_space(scene, robot.height_m), config) for scene in scenes]
    header = DATASET.describe(config, [_about(scene, plan) for scene, plan in zip(scenes, plans, strict=True)])
    with DATASET.claimed(out, header):
        drawn = []
        for scene, plan in zip(scenes, plans, strict=True):
            (out / scene.name).mkdir(exist_ok=True)
            write_arrays(out / scene.name / "plan.npz", **_plan_arrays(plan))
            files = _shards(out / scene.name, plan, robot, config)
            drawn.append((scene.name, lambda scene=scene: scene, files))
        total = sum(len(p.xy_w) * 3 * config.headings + len(p.passages) for p in plans)
        draw_missing(drawn, total, config, progress)
        return header


def _shards(folder: Path, plan: ScenePlan, robot: RobotSpec, config: DataConfig):
    """Yields each file of a scene and the camera poses of its sheets."""
    pitch, heading = (a.ravel() for a in np.meshgrid(config.pitches_rad, headings(config), indexing="ij"))
    passages, each, level = plan.passages, len(pitch), np.zeros(len(pitch))
    rows = [np.arange(first, min(first + each, len(passages))) for first in range(0, len(passages), each)]
    sheets = {
        "rooms": [camera_pose(robot, xy, heading, pitch) for xy in plan.xy_w],
        "passages": [camera_pose(robot, passages.xy_w[r], passages.heading_rad[r], level[: len(r)]) for r in rows],
    }
    for kind, poses in sheets.items():
        yield from numbered(folder, kind, poses, config.shard)


def load_rooms(folder: Path) -> RoomImages:
    """The room images of a dataset."""
    header, config = read_header(folder)
    parts, first = [], 0
    for index, scene in enumerate(header["scenes"]):
        plan = load_plan(folder, scene["name"])
        images = _read_all(Path(folder) / scene["name"], "rooms", len(plan.xy_w) * 3 * config.headings, config)
        images = images.reshape(-1, 3, config.headings, config.height, config.width, 3)
        parts.append((images, plan.room + first, np.full(len(plan.xy_w), index, np.int32), plan.xy_w, plan.test))
        first += plan.rooms.count
    images, label, scene_index, xy, test = (np.concatenate(column) for column in zip(*parts, strict=True))
    names = tuple(f"{s['name']}/{k}" for s in header["scenes"] for k in range(s["rooms"]))
    return RoomImages(images, label, names, scene_index, xy, test)


def load_passages(folder: Path) -> PassageImages:
    """The passage images of a dataset."""
    header, config = read_header(folder)
    parts = []
    for index, scene in enumerate(header["scenes"]):
        plan = load_plan(folder, scene["name"]).passages
        images = _read_all(Path(folder) / scene["name"], "passages", len(plan), config)
        parts.append((images, plan.free, np.full(len(plan), index, np.int32), plan.test))
    images, free, scene, test = (np.concatenate(column) for column in zip(*parts, strict=True))
    return PassageImages(images, free, scene, test, config.passage_lengths_m, config.passage_column)


def load_plan(folder: Path, scene: str) -> ScenePlan:
    """Where a scene's images were taken."""
    path = Path(folder) / scene / "plan.npz"
    arrays = read_arrays(path)
    with readable(path, DatasetError, "run 'data' again"):
        rooms = Rooms(arrays["cluster_xy_w"], arrays["cluster_label"], *(str(w) for w in arrays["how"]))
        passages = Passages(*(arrays[f"passage_{f.name}"] for f in dataclasses.fields(Passages)))
        return ScenePlan(rooms, arrays["xy_w"], arrays["room"], arrays["test"], passages)


def _plan_arrays(plan: ScenePlan) -> dict[str, np.ndarray]:
    passages = {f"passage_{f.name}": getattr(plan.passages, f.name) for f in dataclasses.fields(Passages)}
    return {
        "xy_w": plan.xy_w,
        "room": plan.room,
        "test": plan.test,
        "cluster_xy_w": plan.rooms.points_w,
        "cluster_label": plan.rooms.labels,
        "how": np.asarray([plan.rooms.method, plan.rooms.chosen_by]),
        **passages,
    }


def _about(scene: Scene, plan: ScenePlan) -> dict[str, Any]:
    known = recorded_rooms(scene.digest)
    return {
        "name": scene.name,
        "digest": scene.digest,
        "split": scene.split,
        "rooms": plan.rooms.count,
        "rooms_chosen_by": plan.rooms.chosen_by,
        "rooms_agreement": None if known is None else round(agreement(plan.rooms, known), 4),
        "positions": len(plan.xy_w),
        "test_positions": int(plan.test.sum()),
        "passages": len(plan.passages),
        "test_passages": int(plan.passages.test.sum()),
    }


def _read_all(folder: Path, kind: str, count: int, config: DataConfig) -> np.ndarray:
    sheets = range(math.ceil(count / (3 * config.headings)))
    images = list(read_shards([path for path, _ in numbered(folder, kind, sheets, config.shard)]))
    shape = (config.height, config.width, 3)
    joined = np.concatenate(images) if images else np.zeros((0, *shape), np.uint8)
    if joined.shape != (count, *shape):
        raise DatasetError(
            f"{folder}: {kind} are {joined.shape}, expected {(count, *shape)}; delete them and make again"
        )
    return joined
