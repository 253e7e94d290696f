"""Simulate the expert's drives into a folder, and read them: poses, commands, contacts, and images.

    DRIVES/drives.json             settings, scenes with digests, counts, versions of the format
           plan.npz                all planned drives: routes, starts, split
           batch-000.npz           results of some of them, in the order of the plan
           <scene>/images-000.npz  images of some of a scene's kept drives, one for each control step
           embedded-<digest>.npy   embeddings of all images by two networks, which `train policy` keeps
           preview.png             the drives on the floor plans, and images of some

A drive is kept if it reached its last node without contact, so that furniture is at rest as rendered. Plans depend on
scenes and settings alone. Existing files are skipped.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav import get_robot, load_scene
from interactive_nav.scenes.scene import Scene
from interactive_nav.task.rollout import Player
from interactive_nav_common.errors import ConfigError, FileError
from interactive_nav_common.files import alone_in, write_arrays
from interactive_nav_common.jobs.progress import Progress
from interactive_nav_common.rotations import wrap_angle
from scenes_mjcf.look import CameraPose
from topological_nav.config import DataConfig, DriveConfig, MapConfig
from topological_nav.data.folders import Folder, draw_missing, load_scenes, numbered, read_arrays, read_shards
from topological_nav.drives.expert import CONTROL_S, RECORDERS, Expert, Tasks, Terrain, drive_env, way_field
from topological_nav.maps.graph import angles, near_pairs, place_nodes
from topological_nav.scenes.rendering import camera_pose, episode_starts
from topological_nav.scenes.space import FreeSpace, free_space, scene_rooms

DRIVES = Folder(
    file="drives.json",
    version=1,
    base=DriveConfig(),
    none="holds no drives (no drives.json); make some: python -m topological_nav data --drives SCENE...",
    again="drive again",
)
read_drives_header = DRIVES.read
AGAIN = "data --drives"
LIMIT_M = 8.0
"""Range of fields of distance to go; beyond it they increase with the distance."""
CANDIDATES = 32
"""Starts to try around a node; the best is used if none is clear."""


@dataclasses.dataclass(frozen=True)
class Drives:
    """Hold the results of n drives: F control steps in all, drive after drive."""

    scene: np.ndarray
    """[n] i32."""
    test: np.ndarray
    """[n] bool."""
    first: np.ndarray
    """[n + 1] where each drive's steps begin."""
    pose_w: np.ndarray
    """[F, 3] f32 x, y (m) and heading at the start of each step."""
    command: np.ndarray
    """[F, 2] f32 m/s and rad/s."""
    touching: np.ndarray
    """[F, 2] bool: furniture, a wall was touched in the step."""
    gap_m: np.ndarray
    """[F] f32 that the expert predicted."""
    reached: np.ndarray
    """[n] bool."""
    broken: np.ndarray
    """[n] bool: physics failed."""
    goal_w: np.ndarray
    """[n, 2] m, the last node."""

    def __len__(self) -> int:
        return len(self.scene)

    def rows(self, which: np.ndarray | int) -> np.ndarray:
        """Return the indices [f] of the control steps of one or more drives, drive after drive."""
        return np.concatenate([np.arange(int(self.first[k]), int(self.first[k + 1])) for k in np.atleast_1d(which)])

    @property
    def steps(self) -> np.ndarray:
        """Return the control steps of each drive [n]."""
        return np.diff(self.first)

    @property
    def touched(self) -> np.ndarray:
        """Return which drives had a contact, [n] bool."""
        sums = np.concatenate([[0], np.cumsum(self.touching.any(1))])
        return sums[self.first[1:]] > sums[self.first[:-1]]

    @property
    def kept(self) -> np.ndarray:
        """Return which drives are rendered and used, [n] bool: they reached the goal without contact."""
        return ~self.broken & self.reached & ~self.touched

    @classmethod
    def joined(cls, parts: Sequence["Drives"]) -> "Drives":
        """Concatenate the drives of several folders, and renumber their scenes."""
        columns = {f.name: [getattr(part, f.name) for part in parts] for f in dataclasses.fields(cls)}
        scenes = np.cumsum([0, *(part.scene.max(initial=-1) + 1 for part in parts)])
        columns["scene"] = [scene + int(before) for scene, before in zip(columns["scene"], scenes, strict=False)]
        columns["first"] = [np.concatenate([[0], np.cumsum(np.concatenate([part.steps for part in parts]))])]
        return cls(**{name: np.concatenate(values) for name, values in columns.items()})


@dataclasses.dataclass(frozen=True)
class Routes:
    """Hold n drives of one scene."""

    nodes: np.ndarray
    """[n, legs + 1] i32 nodes in order; the last is repeated if a drive is shorter."""
    legs: np.ndarray
    """[n] i32 edges driven."""
    start_xy_w: np.ndarray
    """[n, 2] m."""
    start_yaw_rad: np.ndarray
    """[n]."""
    test: np.ndarray
    """[n] bool: for testing only."""


def drivable(space: FreeSpace, nodes_w: np.ndarray, to_go_m: np.ndarray, config: DriveConfig) -> np.ndarray:
    """Return pairs [E, 2] of nodes [N, 2] nearer than `edge_m` without a long detour by `to_go_m` of `way_field`."""
    edges = near_pairs(nodes_w, config.edge_m)
    column, row = space.inner_cells(nodes_w).T
    way = to_go_m[edges[:, 1], row[edges[:, 0]], column[edges[:, 0]]]
    straight = np.linalg.norm(nodes_w[edges[:, 0]] - nodes_w[edges[:, 1]], axis=1)
    return edges[way <= config.detour * straight]


def draw_routes(
    space: FreeSpace, nodes_w: np.ndarray, edges: np.ndarray, config: DriveConfig, rng: np.random.Generator
) -> Routes:
    """Draw a scene's drives along edges [E, 2] of `drivable` between nodes [N, 2].

    The first edge is uniform over the long enough ones, the next over those that turn less than `turn_deg`, if any. A
    share of the nodes is held out; drives that start there are for testing.
    """
    if not len(edges):
        raise ConfigError(f"no two of {len(nodes_w)} nodes are joined by a way to drive; use a larger edge_m or detour")
    heading = angles(nodes_w, edges)
    length = np.linalg.norm(nodes_w[edges[:, 1]] - nodes_w[edges[:, 0]], axis=1)
    begins = np.flatnonzero(length >= min(config.least_edge_m, length.max()))
    out_of = [np.flatnonzero(edges[:, 0] == node) for node in range(len(nodes_w))]
    begun = np.unique(edges[begins, 0])
    tests = rng.permutation(begun)[: round(config.test_share * len(begun))]
    nodes = np.empty((config.drives, config.legs + 1), np.int32)
    legs, yaw = np.empty(config.drives, np.int32), np.empty(config.drives)
    start = np.empty((config.drives, 2))
    for i in range(config.drives):
        way = [int(rng.choice(begins))]
        while len(way) < config.legs:
            onward = out_of[edges[way[-1], 1]]
            turn = np.abs(wrap_angle(heading[onward] - heading[way[-1]]))
            passed = {int(edges[way[0], 0]), *(int(edges[w, 1]) for w in way)}
            fresh = np.array([int(edges[e, 1]) not in passed for e in onward], bool)
            onward = onward[(turn < np.radians(config.turn_deg)) & fresh]
            if not len(onward):
                break
            way.append(int(rng.choice(onward)))
        legs[i] = len(way)
        visited = [edges[way[0], 0], *edges[way, 1]]
        nodes[i] = visited + [visited[-1]] * (config.legs - len(way))
        start[i] = _start(space, nodes_w[visited[0]], config, rng)
        off = np.radians(config.start_turn_deg) * rng.uniform(-1.0, 1.0)
        towards = nodes_w[visited[1]] - start[i]
        yaw[i] = np.arctan2(towards[1], towards[0]) + off
    return Routes(nodes, legs, start, wrap_angle(yaw), np.isin(nodes[:, 0], tests))


def _start(space: FreeSpace, node_w: np.ndarray, config: DriveConfig, rng: np.random.Generator) -> np.ndarray:
    """Draw a clear place [2] near a node, or the clearest of the candidates."""
    angle, share = rng.uniform(0, 2 * np.pi, CANDIDATES), np.sqrt(rng.uniform(0, 1, CANDIDATES))
    offset = config.start_off_m * share[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    tried = np.concatenate([node_w + offset, node_w[None]])
    room = space.at(tried)
    clear = np.flatnonzero(room >= config.start_clear_m)
    return tried[clear[0] if len(clear) else int(room.argmax())]


def plan_drives(scenes: Sequence[Scene], config: DriveConfig) -> tuple[Tasks, np.ndarray, Terrain]:
    """Return n drives, scene by scene, which of them are for testing [n], and the expert's terrain."""
    robot = get_robot(config.robot)
    spaces, fields, parts, tests = [], [], [], []
    for index, scene in enumerate(scenes):
        space = free_space(scene, robot.height_m)
        rooms = scene_rooms(scene, space, DataConfig(seed=config.seed))
        xy, _ = place_nodes(space, rooms, MapConfig(edge_m=config.edge_m), robot.body_width_m / 2, 50)
        field = way_field(space, xy, config, LIMIT_M)
        joined = drivable(space, xy, field, config)
        rng = np.random.default_rng([config.seed, 6, int(scene.digest[:8], 16)])
        try:
            routes = draw_routes(space, xy, joined, config, rng)
        except ConfigError as error:
            raise ConfigError(f"{scene.path}: {error}") from None
        ahead, where = routes.nodes[:, 1:], np.full(config.drives, index, np.int32)
        goals = ahead + sum(map(len, fields))
        parts.append(Tasks(where, goals, xy[ahead], routes.legs, routes.start_xy_w, routes.start_yaw_rad))
        tests.append(routes.test)
        spaces.append(space)
        fields.append(field)
    return Tasks.joined(parts), np.concatenate(tests), _terrain(spaces, fields)


def _terrain(spaces: Sequence[FreeSpace], fields: Sequence[np.ndarray]) -> Terrain:
    rows = max(space.clearance_m.shape[0] for space in spaces)
    columns = max(space.clearance_m.shape[1] for space in spaces)

    def padded(grids: Sequence[np.ndarray], mode: str) -> list[np.ndarray]:
        sizes = [[(0, rows - g.shape[-2]), (0, columns - g.shape[-1])] for g in grids]
        return [np.pad(g, [(0, 0)] * (g.ndim - 2) + s, mode=mode) for g, s in zip(grids, sizes, strict=True)]  # type: ignore[call-overload]

    return Terrain(
        jnp.asarray(np.stack(padded([s.clearance_m for s in spaces], "constant")), jnp.float32),
        jnp.asarray([s.origin_w for s in spaces], jnp.float32),
        jnp.asarray([s.resolution_m for s in spaces], jnp.float32),
        jnp.asarray(np.concatenate(padded(fields, "edge")), jnp.float32),
    )


def simulate_drives(
    scene_folders: Sequence[Path],
    out: Path,
    config: DriveConfig,
    progress: Progress = lambda *_: None,
) -> Drives:
    """Simulate drives that are missing."""
    scenes = load_scenes(scene_folders, config.engine)
    header = DRIVES.describe(config, [{"name": s.name, "digest": s.digest, "split": s.split} for s in scenes])
    with DRIVES.claimed(out, header):
        total = len(scenes) * config.drives
        files = numbered(out, "batch", np.arange(total), config.batch)
        if all(path.is_file() for path in (*dict(files), out / "plan.npz")):
            progress("drives", total, total)
            return load_drives(out)
        tasks, test, terrain = plan_drives(scenes, config)
        write_arrays(out / "plan.npz", scene=tasks.scene, test=test, goal_w=tasks.goals_w[:, -1])
        player: Player | None = None
        for path, mine in files:
            if not path.is_file():
                player = player or Player(drive_env(scene_folders, config), RECORDERS)

                def report(ended: int, _: int, mine: np.ndarray = mine) -> None:
                    progress("drives", int(mine[0]) + min(ended, len(mine) - 1), total)  # the padding's are no news

                # Padded by its last drive: one size, one program.
                part = tasks.take(np.minimum(mine[0] + np.arange(config.batch), total - 1))
                expert = Expert(terrain, jax.tree.map(jnp.asarray, part), player.env, config)
                starts = episode_starts(part.start_xy_w, part.start_yaw_rad, part.goals_w[:, 0], 0, part.scene)
                keys = jnp.zeros((len(part), 2), jnp.uint32)
                result = player.rollout(expert, keys, starts, on_progress=report)
                driven = {"steps": result.num_steps, **result.values}  # by control step [B, T, ...], or [B]
                driven = {name: values[: len(mine)] for name, values in driven.items()}
                on = np.arange(driven["pose_w"].shape[1]) < driven["steps"][:, None]  # not after its end
                write_arrays(path, **{n: row[on] if row.shape[:2] == on.shape else row for n, row in driven.items()})
            progress("drives", int(mine[-1]) + 1, total)
        return load_drives(out)


def draw_drives(scene_folders: Sequence[Path], out: Path, progress: Progress = lambda *_: None) -> None:
    """Render missing images of the kept drives."""
    with alone_in(out):
        header, config = read_drives_header(out)
        drives, robot = load_drives(out), get_robot(config.robot)

        def scene(folder: Path, digest: str) -> Scene:
            there = load_scene(folder)
            if there.digest != digest:
                raise FileError(f"{folder}: is not the scene that was driven in; drive again")
            return there

        def files(index: int, name: str) -> Iterator[tuple[Path, list[CameraPose], None]]:
            (out / name).mkdir(exist_ok=True)
            for path, rows in _image_files(out, name, index, drives, config):
                poses = [drives.pose_w[drives.rows(k)] for k in rows]
                yield path, [camera_pose(robot, p[:, :2], p[:, 2], np.zeros(len(p))) for p in poses], None

        drawn = [
            (about["name"], functools.partial(scene, folder, about["digest"]), files(index, about["name"]))
            for index, (about, folder) in enumerate(zip(header["scenes"], scene_folders, strict=True))
        ]
        draw_missing(drawn, int(drives.steps[drives.kept].sum()), config, progress)


def _image_files(out: Path, name: str, index: int, drives: Drives, config: DriveConfig) -> list[tuple[Path, Any]]:
    """Return each file of a scene's images and its drives [k]."""
    return numbered(out / name, "images", np.flatnonzero(drives.kept & (drives.scene == index)), config.shard)


def drive_images(folder: Path, most: int | None = None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield indices [k] of kept drives and images [F, H, W, 3] u8 of their steps by file, at most `most` drives."""
    header, config = read_drives_header(folder)
    drives = load_drives(folder)
    files = [
        part
        for index, about in enumerate(header["scenes"])
        for part in _image_files(Path(folder), about["name"], index, drives, config)
    ]
    files = files[:: max(1, len(files) // most)][:most] if most else files
    for (path, rows), images in zip(files, read_shards([path for path, _ in files], AGAIN), strict=True):
        shape = (int(drives.steps[rows].sum()), config.height, config.width, 3)
        if images.shape != shape:
            raise FileError(f"{path}: holds {images.shape}, expected {shape}; delete it and draw again")
        yield rows, images


def load_drives(folder: Path) -> Drives:
    """Read all drives of a folder."""
    folder = Path(folder)
    header, config = read_drives_header(folder)
    batches = numbered(folder, "batch", range(len(header["scenes"]) * config.drives), config.batch)
    parts = [read_arrays(path, AGAIN) for path, _ in batches]
    plan = read_arrays(folder / "plan.npz", AGAIN)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    first = np.concatenate([[0], np.cumsum(joined.pop("steps"))])
    joined |= {name: plan[name] for name in ("scene", "test", "goal_w")}
    return Drives(first=first, **joined)


def summary(drives: Drives) -> dict[str, float]:
    """Return counts, success and contacts.

    `reached`, `touched` and `kept` are shares of `drives`; `contact_s` is seconds of contact per drive; `seconds` the
    mean duration of those that reached; `m_s` mean speed; `turning` the share of steps that turn by 0.125 rad/s or
    more.
    """
    going = np.repeat(drives.kept, drives.steps)
    return {
        "drives": len(drives),
        "reached": float(drives.reached.mean()),
        "touched": float(drives.touched.mean()),
        "kept": float(drives.kept.mean()),
        "contact_s": float(drives.touching.any(1).sum() * CONTROL_S / len(drives)),
        "seconds": float(drives.steps[drives.reached].mean() * CONTROL_S) if drives.reached.any() else 0.0,
        "m_s": float(drives.command[going, 0].mean()) if going.any() else 0.0,
        "turning": float((np.abs(drives.command[going, 1]) >= 0.125).mean()) if going.any() else 0.0,
    }
