"""Make and read datasets of scenes: room images around positions, and labelled passage images.

    DATASET/dataset.json           settings, scenes with digests and counts, versions
            <scene>/plan.npz       rooms, positions and passages with labels, determined by scene and settings alone
            <scene>/rooms-000.npz  images of some positions: pitch by pitch, heading by heading
            <scene>/passages-000.npz
            preview.png            positions of the images, and some of them

Rendering skips files that exist.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav import get_robot
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import pick
from interactive_nav.scenes.scene import Scene
from interactive_nav_common.errors import ConfigError, FileError, readable
from interactive_nav_common.files import write_arrays
from interactive_nav_common.jobs.progress import Progress
from interactive_nav_common.rows import Rows
from topological_nav.config import PITCHES, DataConfig
from topological_nav.data import folders
from topological_nav.data.objects import bodies, clear_of, fewer_at_furniture, strew
from topological_nav.scenes.rendering import camera_pose
from topological_nav.scenes.space import FreeSpace, Rooms, agreement, free_space, recorded_rooms, scene_rooms, spread

DATASET = folders.Folder(
    file="dataset.json",
    version=2,
    base=DataConfig(),
    none="is no dataset (no dataset.json); make one: python -m topological_nav data ...",
    again="make the dataset again",
)
read_header = DATASET.read


@dataclasses.dataclass(frozen=True)
class Passages(Rows):
    """Hold n views along straight paths, grouped by source."""

    xy_w: np.ndarray
    """[n, 2] m, sources."""
    heading_rad: np.ndarray
    """[n] towards the targets."""
    free: np.ndarray
    """[n, L] bool labels for `DataConfig.passage_lengths_m`; never true after false."""
    source: np.ndarray
    """[n] i32 index of the source."""
    room: np.ndarray
    """[n] i32 room of the source."""
    test: np.ndarray
    """[n] bool."""
    small_w: np.ndarray
    """[n, N, 3] x, y (m) and yaw of the source's small objects; NaN: absent."""


@dataclasses.dataclass(frozen=True)
class ScenePlan:
    """Hold the positions of a scene's images, with labels."""

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
    """Hold the room images of a dataset: P positions, those of L pitches, K headings."""

    images: np.ndarray
    """[P, L, K, H, W, 3] u8."""
    label: np.ndarray
    """[P] i32 room among all scenes' rooms."""
    names: tuple[str, ...]
    """Names of the labels: scene/room."""
    scene: np.ndarray
    """[P] i32."""
    xy_w: np.ndarray
    """[P, 2] m."""
    test: np.ndarray
    """[P] bool."""
    pitches: tuple[str, ...] = PITCHES
    """Those of the images, in this order."""

    def of(self, pitches: Sequence[str], positions: np.ndarray) -> np.ndarray:
        """Return the images [p, pitches, K, H, W, 3] at positions [P] bool with these pitches."""
        return self.images[np.ix_(positions, np.array([self.pitches.index(pitch) for pitch in pitches]))]


@dataclasses.dataclass(frozen=True)
class PassageImages:
    """Hold the passage images of a dataset."""

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
    """Index of the length that balances passages and scores detectors."""


def headings(config: DataConfig) -> np.ndarray:
    """Return K evenly spaced headings (rad), starting at the world's x axis."""
    return 2 * np.pi * np.arange(config.headings) / config.headings


def plan_scene(scene: Scene, space: FreeSpace, config: DataConfig) -> ScenePlan:
    """Choose uniform positions for a scene's images; a room with more than its share keeps the most distant ones."""
    rng = np.random.default_rng([config.seed, 2, int(scene.digest[:8], 16)])
    rooms = scene_rooms(scene, space, config)
    try:
        drawn = space.sample(rng, config.positions, config.clearance_m)
    except ConfigError as error:
        raise ConfigError(f"{scene.path}: {error}") from None
    label = rooms.of(drawn)
    kept, test = [], []
    for k in range(rooms.count):
        mine = np.flatnonzero(label == k)
        mine = mine if len(mine) >= config.least_per_room else mine[:0]
        mine = mine[np.sort(spread(drawn[mine], config.max_per_room, rng))]
        kept.append(mine)
        test.append(held_out(len(mine), config.test_share, rng))
    rows = np.concatenate(kept)
    passages = draw_passages(space, rooms, config, rng)
    return ScenePlan(rooms, drawn[rows], label[rows], np.concatenate(test), passages)


def make_dataset(
    scene_folders: Sequence[Path], out: Path, config: DataConfig, progress: Progress = lambda *_: None
) -> dict[str, Any]:
    """Make a dataset in the folder `out`, or its missing part; return the content of dataset.json."""
    scenes = folders.load_scenes(scene_folders, config.engine)
    robot = get_robot(config.robot)
    plans = [plan_scene(scene, free_space(scene, robot.height_m), config) for scene in scenes]
    header = DATASET.describe(config, [about_scene(scene, plan) for scene, plan in zip(scenes, plans, strict=True)])
    with DATASET.claimed(out, header):
        drawn = []
        for scene, plan in zip(scenes, plans, strict=True):
            write_plan(out / scene.name, plan)
            files = _shards(out / scene.name, plan, robot, config)
            drawn.append((scene.name, lambda scene=scene: scene, files))
        total = sum(len(p.xy_w) * 3 * config.headings + len(p.passages) for p in plans)
        folders.draw_missing(drawn, total, config, progress, pick(config.objects))
        return header


def write_plan(folder: Path, plan: ScenePlan) -> None:
    """Write the positions of a scene's images for `load_plan`."""
    folder.mkdir(parents=True, exist_ok=True)
    passages = {f"passage_{f.name}": getattr(plan.passages, f.name) for f in dataclasses.fields(Passages)}
    arrays = {name: getattr(plan, name) for name in ("xy_w", "room", "test")} | passages
    arrays |= {"cluster_xy_w": plan.rooms.points_w, "cluster_label": plan.rooms.labels}
    write_arrays(folder / "plan.npz", **arrays, how=np.asarray([plan.rooms.method, plan.rooms.chosen_by]))


def _shards(folder: Path, plan: ScenePlan, robot: RobotSpec, config: DataConfig):
    """Yield each file of a scene with the camera poses of its sheets, and the poses of its small objects."""
    up = math.radians(config.pitch_deg)
    pitch, heading = (a.ravel() for a in np.meshgrid([up, 0.0, -up], headings(config), indexing="ij"))
    passages, each, level = plan.passages, len(pitch), np.zeros(len(pitch))
    rows = [np.arange(first, min(first + each, len(passages))) for first in range(0, len(passages), each)]
    for path, places_w in folders.numbered(folder, "rooms", plan.xy_w, config.shard):
        yield path, [camera_pose(robot, xy, heading, pitch) for xy in places_w], None
    for path, sheets in folders.numbered(folder, "passages", rows, config.shard):
        poses = [camera_pose(robot, passages.xy_w[r], passages.heading_rad[r], level[: len(r)]) for r in sheets]
        yield path, poses, bodies(passages.small_w[np.concatenate(sheets)])


def load_rooms(folder: Path, pitches: Sequence[str] = PITCHES) -> RoomImages:
    """Read the room images of a dataset, of some pitches only if memory is to be saved."""
    header, config = read_header(folder)
    parts, first = [], 0
    for index, scene in enumerate(header["scenes"]):
        plan = load_plan(folder, scene["name"])
        images = _read_all(Path(folder) / scene["name"], "rooms", len(plan.xy_w), config, pitches)
        parts.append((images, plan.room + first, np.full(len(plan.xy_w), index, np.int32), plan.xy_w, plan.test))
        first += plan.rooms.count
    images, label, scene_index, xy, test = (np.concatenate(column) for column in zip(*parts, strict=True))
    names = tuple(f"{s['name']}/{k}" for s in header["scenes"] for k in range(s["rooms"]))
    return RoomImages(images, label, names, scene_index, xy, test, tuple(pitches))


def images_at(folder: Path, scene: str, position: int, config: DataConfig) -> np.ndarray:
    """Read the room images [3, K, H, W, 3] u8 of one of a scene's positions, which are a sheet of a file."""
    images = folders.read_shard(Path(folder) / scene / f"rooms-{position // config.shard:03d}.npz")
    images = images.reshape(-1, 3, config.headings, config.height, config.width, 3)
    return images[position % config.shard]


def load_passages(folder: Path) -> PassageImages:
    """Read the passage images of a dataset."""
    header, config = read_header(folder)
    parts = []
    for index, scene in enumerate(header["scenes"]):
        plan = load_plan(folder, scene["name"]).passages
        images = _read_all(Path(folder) / scene["name"], "passages", len(plan), config)
        parts.append((images, plan.free, np.full(len(plan), index, np.int32), plan.test))
    images, free, scene, test = (np.concatenate(column) for column in zip(*parts, strict=True))
    return PassageImages(images, free, scene, test, config.passage_lengths_m, config.passage_column)


def load_plan(folder: Path, scene: str) -> ScenePlan:
    """Read the positions of a scene's images."""
    path = Path(folder) / scene / "plan.npz"
    arrays = folders.read_arrays(path)
    with readable(path, FileError, "run 'data' again"):
        rooms = Rooms(arrays["cluster_xy_w"], arrays["cluster_label"], *(str(w) for w in arrays["how"]))
        passages = Passages(*(arrays[f"passage_{f.name}"] for f in dataclasses.fields(Passages)))
        return ScenePlan(rooms, arrays["xy_w"], arrays["room"], arrays["test"], passages)


def about_scene(scene: Any, plan: ScenePlan) -> dict[str, Any]:
    """Return what the description of a dataset says of a scene, of which it needs name, digest and split."""
    recorded = recorded_rooms(scene.digest)
    return {
        "name": scene.name,
        "digest": scene.digest,
        "split": scene.split,
        "rooms": plan.rooms.count,
        "rooms_chosen_by": plan.rooms.chosen_by,
        "rooms_agreement": None if recorded is None else round(agreement(plan.rooms, recorded), 4),
        "positions": len(plan.xy_w),
        "test_positions": int(plan.test.sum()),
        "passages": len(plan.passages),
        "test_passages": int(plan.passages.test.sum()),
    }


def _read_all(folder: Path, kind: str, count: int, config: DataConfig, pitches: Sequence[str] = ()) -> np.ndarray:
    """Return `count` images, or those of some pitches at `count` positions, in memory that is written once."""
    one, around = (config.height, config.width, 3), (3, config.headings) if pitches else ()
    kept = [PITCHES.index(pitch) for pitch in pitches]
    joined = np.empty((count, *((len(kept), config.headings) if pitches else ()), *one), np.uint8)
    sheets, done = range(count if pitches else math.ceil(count / (3 * config.headings))), 0
    for images in folders.read_shards([path for path, _ in folders.numbered(folder, kind, sheets, config.shard)]):
        read = len(images) // math.prod(around)
        if images.shape != (read * math.prod(around), *one) or done + read > count:
            raise FileError(f"{folder}: has {kind} of {images.shape}, expected {one}; delete them and make again")
        joined[done : done + read] = images.reshape(-1, *around, *one)[:, kept] if pitches else images
        done += read
    if done < count:
        raise FileError(f"{folder}: has {done} of {count} {kind}; delete them and make again")
    return joined


def draw_passages(space: FreeSpace, rooms: Rooms, config: DataConfig, rng: np.random.Generator) -> Passages:
    """Draw sources in every room, targets on a circle about each, and labels from the map.

    Free and blocked are balanced for `passage_length_m`, separately for training and testing, by dropping surplus
    passages at random. A room with fewer eligible places than sources uses them all. Labels regard small objects, too.
    """
    places = space.centres(config.passage_clearance_m)
    labels = rooms.of(places)
    xy, room, test = [], [], []
    for k in range(rooms.count):
        mine = np.flatnonzero(labels == k)
        picked = rng.choice(mine, min(config.passage_sources, len(mine)), replace=False)
        xy.append(places[picked])
        room.append(np.full(len(picked), k, np.int32))
        test.append(held_out(len(picked), config.test_share, rng))
    sources, room, test = np.concatenate(xy), np.concatenate(room), np.concatenate(test)
    n, each = len(sources), config.passage_targets
    phase = rng.uniform(0, 2 * np.pi, n)
    heading = (phase[:, None] + 2 * np.pi * np.arange(each) / each).ravel() % (2 * np.pi)
    start = np.repeat(sources, each, 0)
    bare = free_lengths(space, start, heading, config)
    small_w = strew(space, sources, config, rng)
    free = bare & clear_of(small_w, sources, heading.reshape(n, each), config).reshape(bare.shape)
    of_sources = (np.repeat(values, each, 0) for values in (np.arange(n, dtype=np.int32), room, test, small_w))
    every = Passages(start, heading, free, *of_sources)
    scored, rows = free[:, config.passage_column], np.arange(len(free))
    if config.objects:
        rows = fewer_at_furniture(bare[:, config.passage_column], scored, rng)
    kept = [balanced(rows[every.test[rows] == held], scored, rng) for held in (False, True)]
    return every.take(np.sort(np.concatenate(kept)))


def free_lengths(space: FreeSpace, xy_w: np.ndarray, heading_rad: np.ndarray, config: DataConfig) -> np.ndarray:
    """Return whether paths from places [n, 2] along headings [n] are free for `passage_lengths_m`: [n, L] bool.

    Because lengths are checked at different points, `passage_length_m` decides: if it is free, so are shorter ones; if
    it is blocked, so are longer ones; and so on outwards.
    """
    step = np.stack([np.cos(heading_rad), np.sin(heading_rad)], -1)
    points, margin_m, scored = config.passage_points, config.passage_margin_m, config.passage_column
    ways = [space.segment_free(xy_w, xy_w + length * step, points, margin_m) for length in config.passage_lengths_m]
    free = np.stack(ways, -1)
    free[:, : scored + 1] = np.logical_or.accumulate(free[:, scored::-1], 1)[:, ::-1]
    free[:, scored:] = np.logical_and.accumulate(free[:, scored:], 1)
    return free


def logits_at(logits: np.ndarray, lengths_m: Sequence[float], ahead_m: np.ndarray | float) -> np.ndarray:
    """Interpolate logits [n, L] of lengths [L] at others (clipped): [n] or [n, M], or one for all, which gives [n]."""
    ahead = np.asarray(ahead_m, float)
    ahead = np.broadcast_to(ahead, (len(logits), *ahead.shape[1:]))
    rows = [np.interp(lengths, lengths_m, row) for lengths, row in zip(ahead, logits, strict=True)]
    return np.reshape(rows, ahead.shape)


def balanced(rows: np.ndarray, labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return equally many rows with true and false labels; surplus ones are dropped at random."""
    yes, no = rows[labels[rows]], rows[~labels[rows]]
    count = min(len(yes), len(no))
    return np.sort(np.concatenate([rng.permutation(part)[:count] for part in (yes, no)]))


def held_out(count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """Draw which are for testing, [count] bool: the rounded share; of two or more, at least one and not all."""
    tests = 0 if count < 2 else int(np.clip(round(count * share), 1, count - 1))
    return np.isin(np.arange(count), rng.permutation(count)[:tests])
