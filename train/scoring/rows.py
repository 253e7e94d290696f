"""Make a row of each played episode, check rows that are read back, and show means with their intervals."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rich.table import Table

from interactive_nav.types import OF_OBJECTS
from interactive_nav_common.errors import FileError
from interactive_nav_common.rows import Columns, Rows, console_table, where
from interactive_nav_common.statistics import RESAMPLES, over_episodes

SCORES = {"success": "success", "path_efficiency": "P_eff", "effort_efficiency": "E_eff", "ins_0.5": "INS_0.5"}


_OF_MOTION = ("clearance_m", "least_clearance_m", "turning_rad_per_m")
OF_TRAINING = ("train_device", "train_commit", "train_env_steps", "checkpoint_steps", "train_wall_s")
COLUMNS = Columns(
    text=("run", "robot", "policy", "scene", "split", "algorithm", "device", *OF_TRAINING[:2]),
    whole=("episode", "seed", "evaluation_seed", *OF_TRAINING[2:4]),
    numbers=("k_int", *SCORES, "kinematic_effort", "dynamic_effort", "structure_steps", *_OF_MOTION, *OF_TRAINING[4:]),
    may_be_empty=("algorithm", "seed", "k_int", *OF_TRAINING),
    may_be_missing=("device", "evaluation_seed", "structure_steps", *_OF_MOTION, *OF_TRAINING),
)
TYPES: dict[str, pa.DataType] = {
    **dict.fromkeys((*COLUMNS.text, "backend", "commit", "versions"), pa.string()),
    **dict.fromkeys(COLUMNS.whole, pa.int64()),
    **dict.fromkeys((*COLUMNS.numbers, "evaluation_wall_s"), pa.float64()),
    "deterministic": pa.bool_(),
}
"""Of the constant columns, which are empty where they mean nothing (a baseline has no seed)."""
_COUNTS, _SUMS = ("objects", "touched", "contact_steps"), ("displacement_m", "force_sum_n")
BY_CATEGORY = pa.list_(
    pa.struct({"category": pa.string(), **dict.fromkeys(_COUNTS, pa.int32()), **dict.fromkeys(_SUMS, pa.float32())})
)
"""Of the column `by_category`: how many objects of each category that a scene has were there and were touched, and,
summed over them, control steps in contact, path lengths of their centres of mass, and largest net forces of the
steps."""


@dataclasses.dataclass(frozen=True)
class Paths(Rows):
    """Where the robot went and what it moved, in the first E episodes; world frame, m."""

    scene_index: np.ndarray
    """[E] i32."""
    start_xy_w: np.ndarray
    """[E, 2]."""
    goal_xy_w: np.ndarray
    """[E, 2]."""
    robot_xy_w: np.ndarray
    """[E, T + 1, 2], NaN after the episode's end."""
    object_start_w: np.ndarray
    """[E, M, 3]."""
    object_end_w: np.ndarray
    """[E, M, 3]."""


@dataclasses.dataclass(frozen=True)
class PlayedEpisodes:
    """N finished episodes."""

    scene_index: np.ndarray
    """[N] i32."""
    metrics: dict[str, np.ndarray]
    """name -> [N], the environment's metrics at the step that ended the episode."""
    of_objects: dict[str, np.ndarray]
    """name of `OF_OBJECTS` -> [N, M]."""
    paths: Paths


def check_rows(rows: pa.Table, path: Path) -> None:
    """Refuse damaged rows of episodes; tables of something else, which have few of their columns, pass."""
    needed = {*COLUMNS.text, *COLUMNS.whole, *COLUMNS.numbers} - {*COLUMNS.may_be_missing}
    if 2 * len(needed & set(rows.column_names)) < len(needed):
        return
    COLUMNS.check(rows, path)
    dataclasses.replace(COLUMNS, may_be_empty=OF_TRAINING).check(rows.filter(pc.field("policy") == "learned"), path)
    if "by_category" in rows.column_names and not rows["by_category"].type.equals(BY_CATEGORY):
        raise FileError(f"{path}: column 'by_category' holds {rows['by_category'].type}, expected {BY_CATEGORY}")


def episode_table(
    episodes: PlayedEpisodes, scenes: Any, categories: Sequence[Sequence[str]], constants: dict[str, Any]
) -> pa.Table:
    """Return one row for each episode, `constants` first; `categories` [S][M] are those in slots, '' if empty."""
    count = len(episodes.scene_index)
    columns: dict[str, Any] = {name: pa.array([value] * count, TYPES.get(name)) for name, value in constants.items()}
    columns["scene"] = [scenes[i].name for i in episodes.scene_index]
    columns["split"] = [scenes[i].split for i in episodes.scene_index]
    columns |= {"episode": np.arange(count, dtype=np.int32), **episodes.metrics}
    entries = [_by_category(episodes, i, categories[int(scene)]) for i, scene in enumerate(episodes.scene_index)]
    return pa.table({**columns, "by_category": pa.array(entries, BY_CATEGORY)})


def _by_category(episodes: PlayedEpisodes, episode: int, categories: Sequence[str]) -> list[dict[str, Any]]:
    """Return one episode's entries of `by_category`, in alphabetical order."""
    path_m, steps, force_n = (episodes.of_objects[name][episode] for name in OF_OBJECTS)
    rows = []
    for category in sorted(set(categories) - {""}):
        of = np.array([other == category for other in categories])
        counts = (int(x.sum()) for x in (of, steps[of] > 0, steps[of]))
        sums = (float(x[of].sum()) for x in (path_m, force_n))
        rows.append(dict(zip(("category", *_COUNTS, *_SUMS), (category, *counts, *sums), strict=True)))
    return rows


def score_table(rows: pa.Table, title: str) -> Table:
    """Return a table of each policy's success, P_eff, E_eff and INS_0.5, with intervals."""
    caption = f"mean [95 % interval]: Wilson for success, bootstrap ({RESAMPLES:,} resamples) elsewhere"
    lines = []
    for policy in rows["policy"].unique().to_pylist():
        part = where(rows, policy=policy)
        scores = (over_episodes(name, part[name].to_numpy()).with_ends() for name in SCORES)
        lines.append((policy, *scores, str(len(part))))
    return console_table(("policy", *SCORES.values(), "episodes"), lines, title=title, caption=caption)
