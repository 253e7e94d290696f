"""Draw fixed evaluation episodes into a versioned file, and read them back as starts.

`python -m interactive_nav.episodes make --robot turtlebot --scenes DIR ... --episodes N --seed S -o FILE`

A file identifies its scenes by digests (`Scene.task_digest`), so it means the same episodes on every machine and
backend. Other scenes, robots or objects are refused.
"""

import dataclasses
import functools
import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

import interactive_nav
from interactive_nav.config import Task
from interactive_nav.navigation.lookup import geodesic_at, goal_field
from interactive_nav.navigation.ways import Ways
from interactive_nav.scenes.scene import TASK_DIGEST
from interactive_nav.task.env import InteractiveNav
from interactive_nav.types import EpisodeStart
from interactive_nav_common.commands import Command, option, parse
from interactive_nav_common.config import AtLeastOne, Natural, NotNegative, Seed
from interactive_nav_common.errors import ConfigError, UserError, readable, reports_errors
from interactive_nav_common.files import write_text
from interactive_nav_common.records import Reader
from interactive_nav_common.signals import signals_wait
from interactive_nav_common.untrusted.reading import read_bytes, unpack

FORMAT = "interactive-nav-episodes"
VERSION = 1
LENGTH_TOLERANCE_M = 1e-3
"""L* of a file and of the environment may differ by rounding only."""


@dataclasses.dataclass(frozen=True)
class EpisodeFile:
    """N episodes, as they stand in a file."""

    robot: str
    seed: Seed
    scenes: tuple[tuple[str, str], ...]
    """(name, `Scene.task_digest`) of each scene."""
    objects: tuple[str, ...]
    """Categories of the small objects, in order."""
    objects_digest: str
    """`TASK_DIGEST` and SHA-256 of the small objects' boxes, masses, friction and categories, of those from folders
    of inertia, centre of mass and hulls too."""
    episodes: tuple[dict[str, Any], ...]
    """scene (index into scenes), start_xy_w, start_yaw_rad, goal_xy_w, objects ([x, y, yaw] each, or null for one
    that got no place), shortest_path_m, push_needed: whether there is no way round everything that can be moved, and
    target, of a task with one; metres and radians, world frame."""
    task: str = "reach"


@dataclasses.dataclass(frozen=True)
class _Episode:
    """An entry of `EpisodeFile.episodes`."""

    scene: Natural
    start_xy_w: tuple[float, float]
    start_yaw_rad: float
    goal_xy_w: tuple[float, float]
    objects: tuple[tuple[float, float, float] | None, ...]
    shortest_path_m: NotNegative
    push_needed: bool
    target: str | None = None
    """Name of the target's body."""


class EpisodeFileError(UserError):
    """An episode file that cannot be used; the message says what, where, what was expected and what to do."""


_FILES = Reader(EpisodeFileError, "make it again")


def draw_episode_file(env: InteractiveNav, episodes: int, seed: int) -> EpisodeFile:
    """Draw episodes; number i depends on the seed and i alone, and equals `env.reset` for that key.

    The environment is not batched; fewer than one episode raises `ConfigError`.
    """
    if episodes < 1:
        raise ConfigError(f"episodes is {episodes}, expected at least 1")
    keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.PRNGKey(seed)))(jnp.arange(episodes))
    with signals_wait():  # a compilation that is left crashes the interpreter at its end
        started = jax.jit(jax.vmap(lambda key: _with_length(env, env.draw_start(jax.random.split(key)[1]))))(keys)
        starts, lengths = jax.tree.map(np.asarray, started)
        qpos = np.asarray(jax.jit(jax.vmap(lambda start: env.initial_physics(start).qpos))(starts))
    ways = Ways(env, None)
    rows = []
    for i in range(episodes):
        scene, start, goal = int(starts.scene_index[i]), starts.start_xy_w[i], starts.goal_xy_w[i]
        small = zip(starts.small_xy_w[i], starts.small_yaw_rad[i], starts.small_placed[i], strict=True)
        rows.append(
            {
                "scene": scene,
                "start_xy_w": [*map(_short_float, start)],
                "start_yaw_rad": _short_float(starts.start_yaw_rad[i]),
                "goal_xy_w": [*map(_short_float, goal)],
                "objects": [[*map(_short_float, (*xy, yaw))] if placed else None for xy, yaw, placed in small],
                "shortest_path_m": _short_float(lengths[i]),
                "push_needed": not ways.exists(scene, qpos[i], start, goal),
            }
        )
        if starts.target is not None:
            rows[-1]["target"] = env.world.slots.names[scene][starts.target[i]]
    return EpisodeFile(
        robot=env.robot.name,
        seed=seed,
        scenes=tuple((scene.name, scene.task_digest) for scene in env.scenes),
        objects=tuple(o.category for o in env.world.small_objects),
        objects_digest=_objects_digest(env),
        episodes=tuple(rows),
        task=env.config.task,
    )


def _short_float(value: Any) -> float:
    """Return a 32-bit float by the fewest digits that distinguish it from its neighbours."""
    return float(str(np.float32(value)))


def _with_length(env: InteractiveNav, start: EpisodeStart) -> tuple[EpisodeStart, Any]:
    field = goal_field(env.tables, start.scene_index, start.goal_xy_w)
    return start, geodesic_at(env.tables, start.scene_index, field, start.start_xy_w)


def _objects_digest(env: InteractiveNav) -> str:
    """Return the digest of what in the small objects decides the task."""
    return TASK_DIGEST + hashlib.sha256(repr([o.task_parts for o in env.world.small_objects]).encode()).hexdigest()


def _short(digest: str) -> str:
    return digest.rpartition(":")[2][:12]


def _check_fits(file: EpisodeFile, env: InteractiveNav, where: str) -> dict[str, int]:
    """Return digest -> index of the environment's scenes; refuse another robot, other scenes or small objects."""
    if (of_file := (file.robot, file.task)) != (of_env := (env.robot.name, env.config.task)):
        made, here = (f"robot '{robot}' and task '{task}'" for robot, task in (of_file, of_env))
        raise EpisodeFileError(f"{where}: made for {made}, the environment has {here}; make the episodes again for it")
    ours = {scene.task_digest: i for i, scene in enumerate(env.scenes)}
    by_name = {scene.name: scene for scene in env.scenes}
    for name, digest in file.scenes:
        if digest in ours:
            continue
        if name in by_name:
            raise EpisodeFileError(
                f"{where}: scene '{name}' has digest {_short(digest)}, the environment's '{name}' has "
                f"{_short(by_name[name].task_digest)}: its content changed since; use the scene it was made from, or "
                "make the episodes again"
            )
        raise EpisodeFileError(
            f"{where}: needs scene '{name}' (digest {_short(digest)}), the environment has {', '.join(by_name)}; "
            "add it to --scenes"
        )
    if file.objects_digest != _objects_digest(env):
        raise EpisodeFileError(
            f"{where}: made with {len(file.objects)} small objects ({', '.join(file.objects) or 'none'}), the "
            f"environment has {len(env.world.small_objects)} or other models; set num_objects={len(file.objects)} and "
            "the same objects, or make the episodes again"
        )
    return ours


def starts_of(file: EpisodeFile, env: InteractiveNav, where: str = "episodes") -> EpisodeStart:
    """Return the file's episodes for `jax.vmap(env.reset_to)`; raise `EpisodeFileError` if `env` is not theirs."""
    scene_of_digest = _check_fits(file, env, where)
    rows, count = file.episodes, len(file.objects)
    small = [[o or [0.0, 0.0, 0.0] for o in row["objects"]] for row in rows]
    poses = np.asarray(small, np.float32).reshape(len(rows), count, 3)
    scene = [scene_of_digest[file.scenes[row["scene"]][1]] for row in rows]
    known, has = env.world.slots.names, file.task != "reach"
    wrong = [i for i, s in enumerate(scene) if has and rows[i].get("target") not in known[s]]
    if wrong:
        raise EpisodeFileError(
            f"{where}: episode {wrong[0]}: target is no body of its scene, expected one; make it again"
        )

    def f32(name: str) -> jax.Array:
        return jnp.asarray([row[name] for row in rows], jnp.float32)

    starts = EpisodeStart(
        scene_index=jnp.asarray(scene, jnp.int32),
        start_xy_w=f32("start_xy_w"),
        start_yaw_rad=f32("start_yaw_rad"),
        goal_xy_w=f32("goal_xy_w"),
        small_xy_w=jnp.asarray(poses[..., :2]),
        small_yaw_rad=jnp.asarray(poses[..., 2]),
        small_placed=jnp.asarray([[o is not None for o in row["objects"]] for row in rows], bool),
        target=jnp.asarray([known[s].index(rows[i]["target"]) for i, s in enumerate(scene)], jnp.int32)
        if has
        else None,
    )
    _, lengths = signals_wait()(jax.jit(jax.vmap(lambda start: _with_length(env, start))))(starts)
    wrong = np.abs(np.asarray(lengths) - np.asarray(f32("shortest_path_m"))) > LENGTH_TOLERANCE_M
    if wrong.any():
        i = int(np.argmax(wrong))
        raise EpisodeFileError(
            f"{where}: episode {i}: shortest_path_m is {rows[i]['shortest_path_m']:.3f} m, the environment finds "
            f"{float(lengths[i]):.3f} m; use the settings (nav_cell_m) and version it was made with, or make it again"
        )
    return starts


def save_episode_file(file: EpisodeFile, path: str | Path) -> None:
    """Write a file whole or not at all, packed where the name ends with `.gz`."""
    data = {"format": FORMAT, "version": VERSION, **dataclasses.asdict(file)}
    head = {k: v for k, v in data.items() if k != "episodes"}
    # One line an episode: readable, and small in a diff.
    lines = ",\n".join(json.dumps(row) for row in file.episodes)
    write_text(path, f'{json.dumps(head, indent=1)[:-2]},\n "episodes": [\n{lines}\n ]\n}}\n')


def load_episode_file(path: str | Path) -> EpisodeFile:
    """Read and check a file; raise `EpisodeFileError` if it cannot be used."""
    with readable(path, EpisodeFileError, "make one with 'python -m interactive_nav.episodes make'"):
        text = read_bytes(path)
        text = unpack(text, "gzip") if Path(path).suffix == ".gz" else text
    data = _FILES.decoded(text, "JSON", str(path))
    if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
        raise EpisodeFileError(f"{path}: not an episode file (format is not '{FORMAT}')")
    if (version := data.pop("version", None)) != VERSION:
        raise EpisodeFileError(f"{path}: version is {version!r}, expected {VERSION}; make it again")
    file = _FILES.record(data, EpisodeFile, str(path))
    if not file.episodes:
        raise EpisodeFileError(f"{path}: episodes is [], expected at least one; make it again")
    for i, row in enumerate(file.episodes):
        episode = _FILES.record(row, _Episode, f"{path}: episodes[{i}]")
        if episode.scene >= len(file.scenes) or len(episode.objects) != len(file.objects):
            raise EpisodeFileError(
                f"{path}: episodes[{i}] is in scene {episode.scene} with {len(episode.objects)} objects, expected one "
                f"of {len(file.scenes)} scenes and {len(file.objects)} objects; make it again"
            )
    return file


def load_episode_files(paths: Sequence[str | Path]) -> tuple[EpisodeFile, str]:
    """Return the episodes of several files, one after the other, as those of one; and the digest of the files."""
    files = [load_episode_file(path) for path in paths]
    first = files[0]
    for path, other in zip(paths, files, strict=True):
        if (other.robot, other.objects_digest, other.task) != (first.robot, first.objects_digest, first.task):
            raise EpisodeFileError(
                f"{path}: made for robot '{other.robot}' with {len(other.objects)} small objects, {paths[0]} for "
                f"'{first.robot}' with {len(first.objects)} or other models; play them one by one"
            )
    scenes = tuple(dict.fromkeys(scene for file in files for scene in file.scenes))
    rows = [row | {"scene": scenes.index(file.scenes[row["scene"]])} for file in files for row in file.episodes]
    contents = [Path(path).read_bytes() for path in paths]
    content = contents[0] if len(paths) == 1 else b"".join(hashlib.sha256(data).digest() for data in contents)
    return dataclasses.replace(first, scenes=scenes, episodes=tuple(rows)), hashlib.sha256(content).hexdigest()[:16]


class Make(Command):
    """Draw random episodes and write them to a file."""

    scenes: Annotated[tuple[str, ...], option(metavar="SCENE_DIR")]
    """Scene folders in which episodes take place."""
    out: Annotated[str, option("-o", metavar="FILE")]
    """Episode file to write."""
    robot: Annotated[str, option(metavar="NAME|FILE")] = "turtlebot"
    """Robot: a name, a URDF or MJCF file, or path.py:function."""
    episodes: AtLeastOne = 100
    """Number of episodes."""
    seed: int = 0
    """Random seed of the episodes."""
    num_objects: Natural = 10
    """Number of small objects in each episode."""
    task: Task = "reach"
    """Task of the episodes (the setting `env.task`)."""
    objects: Annotated[tuple[str, ...], option(metavar="OBJECT_DIR")] = ()
    """Folders of small objects to use (default: the built-in ones)."""


COMMANDS = {"make": Make}


@reports_errors("interactive_nav.episodes")
def main(argv: Sequence[str] | None = None) -> int:
    arguments = parse(COMMANDS, "python -m interactive_nav.episodes", argv)
    env = interactive_nav.make(
        arguments.robot,
        arguments.scenes,
        backend="native",
        num_objects=arguments.num_objects,
        objects=arguments.objects,
        task=arguments.task,
        **({"control_mode": "hand", "hook_force_n": 100.0} if arguments.task == "lift" else {}),
    )
    file = draw_episode_file(env, arguments.episodes, arguments.seed)
    save_episode_file(file, arguments.out)
    shortest = [row["shortest_path_m"] for row in file.episodes]
    print(
        f"{arguments.out}: {len(shortest)} episodes in {len(file.scenes)} scenes, shortest paths "
        f"{min(shortest):.2f} to {max(shortest):.2f} m"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
