"""Scenes and contenders in, a folder of rows out, one file a batch of episodes; a contest that was stopped goes on.

OUT/rows/<scene>-<contender>-<digest>-<first episode>.parquet   one row an episode (`evaluation.columns`)
    tracks/<the same>.npz                                       where the robots went
    <scene>.png, summary.md                                     drawn and told at the end

The digest is of everything that decides the rows: scene, episodes, settings, map, networks, policy. Another question
adds files; the same one finds its own and plays what is missing.
"""

import hashlib
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from interactive_nav_common.files import write_arrays
from interactive_nav_common.rows import Columns, read_rows, write_parquet
from interactive_nav_common.untrusted.reading import read_npz
from interactive_nav_common.versions import versions
from topological_nav.errors import Progress, RunError
from topological_nav.evaluate.contenders import DrivenEpisodes
from topological_nav.evaluate.contest import Contest, ContestScene
from topological_nav.evaluate.evaluation import Played, columns, play

CPU_BATCH = 8
"""Episodes played at a time on a CPU unless asked otherwise."""


def play_contest(contest: Contest, scenes: Sequence[ContestScene], tell: Progress = lambda *_: None) -> pa.Table:
    """Plays what is missing, and returns all rows."""
    # Everything that can be refused is refused before the first episode.
    plan = [(scene, name, _stem(scene, name)) for scene in scenes for name in contest.contenders]
    missing = [_missing(contest.out, stem, len(scene.episodes)) for scene, _, stem in plan]
    total = sum(len(scene.episodes) for scene, _, _ in plan)
    done = total - sum(map(len, missing))
    cpu = jax.default_backend() == "cpu"
    for (scene, name, _), numbers in zip(plan, missing, strict=True):
        if not len(numbers):
            continue
        contender, simulator = scene.contender(name)
        size = contest.config.batch or (CPU_BATCH if cpu else len(numbers))
        for first in range(0, len(numbers), size):
            rows = numbers[first : first + size]
            what, before = f"{scene.scene.name} {name}", done

            def told(over: int, _: float, what: str = what, before: int = before) -> None:
                tell(what, min(before + over, total - 1), total)

            episodes, began = scene.episodes.take(rows), time.perf_counter()
            played = play(contender, simulator, episodes, contest.config, told)
            _write(contest, scene, name, simulator.env, episodes, played, time.perf_counter() - began)
            done += len(rows)
            tell(what, done, total)
    return pa.concat_tables([_rows(contest.out, stem, len(scene.episodes)) for scene, _, stem in plan])


COLUMNS = Columns(
    text=("contender", "sight", "domain", "policy", "scene", "split"),
    whole=("episode", "runs", "contact_runs"),
    numbers=("success", "spl", "within", "contact", "aadc_s", "contact_s", "duration_s", "path_m", "goal_m"),
)


def _stem(scene: ContestScene, contender: str) -> str:
    asked = json.dumps(scene.asked(contender), sort_keys=True)
    return f"{scene.scene.name}-{contender}-{hashlib.sha256(asked.encode()).hexdigest()[:8]}"


def _files(out: Path, stem: str) -> list[Path]:
    return sorted((out / "rows").glob(f"{stem}-*.parquet"))


def _missing(out: Path, stem: str, count: int) -> np.ndarray:
    """Numbers of the episodes that no file has."""
    there = _rows(out, stem, count)["episode"].to_numpy() if _files(out, stem) else np.zeros(0, int)
    return np.setdiff1d(np.arange(count), there)


def _rows(out: Path, stem: str, count: int) -> pa.Table:
    """Rows of the first `count` episodes: the files may have more, of a time when more were asked for.

    An episode that two commands played at the same time counts as the first of the files has it.
    """
    rows = read_rows(_files(out, stem), COLUMNS.check)
    number, first = np.unique(rows["episode"].to_numpy(), return_index=True)
    return rows.take(first[number < count])


def _write(
    contest: Contest, scene: ContestScene, name: str, env: Any, episodes: DrivenEpisodes, played: Played, wall_s: float
) -> None:
    config, out, here = contest.config, contest.out, versions()
    navigates = name in ("dense", "sparse")
    constants = {
        "contender": name,
        "sight": ("truth" if scene.networks is None else "networks") if navigates else "none",
        "domain": scene.contest.domain if navigates else "none",
        "policy": scene.contest.policy if navigates else name,
        "scene": scene.scene.name,
        "split": scene.scene.split,
        "robot": env.robot.name,
        "seed": config.seed,
        "backend": env.backend,
        "device": here["device"]["kind"],
        "commit": here["commit"],
        "wall_s": wall_s,
    }
    table = {key: [value] * len(episodes) for key, value in constants.items()}
    table |= {"episode": episodes.number, **columns(episodes, played, config)}
    file = f"{_stem(scene, name)}-{episodes.number[0]:04d}"
    tracks = {str(n): np.asarray(t, np.float32) for n, t in zip(episodes.number, played.track_w, strict=True)}
    write_arrays(out / "tracks" / f"{file}.npz", **tracks)
    # Rows last: an episode counts as played once its row is there.
    notes = {"asked": json.dumps(scene.asked(name)), "versions": json.dumps(here["packages"])}
    write_parquet(pa.table(table), out / "rows" / f"{file}.parquet", notes)


def tracks_of(contest: Contest, scene: ContestScene, contender: str) -> dict[int, np.ndarray]:
    """Episode number -> [t, 2] m, of what has been played."""
    found: dict[int, np.ndarray] = {}
    for path in sorted((contest.out / "tracks").glob(f"{_stem(scene, contender)}-*.npz")):
        with read_npz(path, RunError, "delete it and evaluate again") as stored:
            found = {int(number): stored[number] for number in stored.files} | found
    return found
