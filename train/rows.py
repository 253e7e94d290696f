"""Episodes in, one row each in Parquet files out, those files read back, and means with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.table import Table
from scipy import stats

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import whole_file

if TYPE_CHECKING:
    from train.rollout import Episodes

SCORES = {
    "success": "success",
    "path_efficiency": "P_eff",
    "effort_efficiency": "E_eff",
    "ins_0.5": "INS_0.5",
}
CONFIDENCE = 0.95
RESAMPLES = 10_000


TYPES: dict[str, pa.DataType] = {
    **dict.fromkeys(("run", "robot", "algorithm", "policy", "backend", "device", "commit", "versions"), pa.string()),
    **dict.fromkeys(("train_device", "train_commit"), pa.string()),
    **dict.fromkeys(("seed", "checkpoint_steps", "evaluation_seed", "train_env_steps"), pa.int64()),
    **dict.fromkeys(("k_int", "evaluation_wall_s", "train_wall_s"), pa.float64()),
    "deterministic": pa.bool_(),
}
"""Of the constant columns, which are empty where they mean nothing (a yardstick has no seed)."""
IDENTITY = ("run", "robot", "policy", "evaluation_seed", "scene", "episode")
"""Columns that name an episode that was played."""


def episode_table(episodes: Episodes, scenes: Any, constants: dict[str, Any]) -> pa.Table:
    """One row an episode.

    Args:
        episodes: what was played.
        scenes: the environment's, with name and split.
        constants: columns that are the same in every row; they come first.
    """
    count = len(episodes.scene_index)
    columns: dict[str, Any] = {
        name: pa.array([value] * count, type=TYPES.get(name)) for name, value in constants.items()
    }
    columns["scene"] = [scenes[i].name for i in episodes.scene_index]
    columns["split"] = [scenes[i].split for i in episodes.scene_index]
    columns["episode"] = np.arange(count, dtype=np.int32)
    return pa.table({**columns, **episodes.metrics})


def write_parquet(table: pa.Table, path: Path, notes: dict[str, str] | None = None) -> None:
    """Writes rows whole or not at all.

    Args:
        table: the rows.
        path: of the file.
        notes: kept in the file beside them.

    Raises:
        FileError: the file cannot be written.
    """
    floats = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    others = [field.name for field in table.schema if not pa.types.is_floating(field.type)]
    with whole_file(path) as partial:
        pq.write_table(
            table.replace_schema_metadata(notes),
            partial,
            compression="zstd",
            compression_level=15,
            use_dictionary=others,  # type: ignore[arg-type]
            use_byte_stream_split=floats,  # type: ignore[arg-type]
        )


def read_notes(path: Path) -> dict[str, str]:
    """What `write_parquet` kept beside the rows; nothing where the file is damaged."""
    try:
        found = pq.read_schema(path).metadata or {}
    except (OSError, pa.ArrowInvalid):
        return {}
    return {key.decode(): value.decode() for key, value in found.items()}


def read_rows(paths: Sequence[Path]) -> pa.Table:
    """The rows of several files as one table; a column that a file lacks is empty there.

    An episode that stands in several files (`IDENTITY`) is taken once, from the last of them by name.

    Raises:
        FileError: a file is not readable as Parquet, or columns do not fit each other.
    """
    tables = []
    for path in sorted(paths):
        try:
            tables.append(pq.read_table(path).replace_schema_metadata(None))
        except (OSError, pa.ArrowInvalid) as error:
            raise FileError(f"{path}: not readable as Parquet ({error}); evaluate the run again") from None
    try:
        rows = pa.concat_tables(tables, promote_options="permissive")
    except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
        raise FileError(f"rows do not fit each other ({error}); draw their folders one by one") from None
    if not set(IDENTITY) <= set(rows.column_names):
        return rows
    order = rows.select(list(IDENTITY)).append_column("at", pa.array(np.arange(len(rows))))
    last = order.group_by(list(IDENTITY)).aggregate([("at", "max")])["at_max"].to_numpy()
    return rows.take(np.sort(last))


def interval(name: str, values: np.ndarray) -> tuple[float, float]:
    """95 % confidence interval of a mean: Wilson's for success (0 or 1), bootstrap percentiles elsewhere."""
    if name == "success":
        test = stats.binomtest(int(values.sum()), len(values))
        found = test.proportion_ci(CONFIDENCE, method="wilson")
        return float(found.low), float(found.high)
    if len(values) < 2 or np.ptp(values) == 0.0:  # nothing to resample
        return float(values.mean()), float(values.mean())
    found = stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(found.low), float(found.high)


def score_table(rows: pa.Table, title: str) -> Table:
    """Success, P_eff, E_eff and INS_0.5 of each policy, with intervals."""
    made = Table(
        title=title,
        caption=f"mean [95 % interval]: Wilson for success, bootstrap ({RESAMPLES:,} resamples) elsewhere",
    )
    made.add_column("policy")
    for label in (*SCORES.values(), "episodes"):
        made.add_column(label, justify="right")
    policies = np.asarray(rows["policy"].to_pylist())
    for policy in dict.fromkeys(policies):
        cells = []
        for name in SCORES:
            values = rows[name].to_numpy()[policies == policy]
            low, high = interval(name, values)
            cells.append(f"{values.mean():.3f} [{low:.3f}, {high:.3f}]")
        made.add_row(policy, *cells, str(int((policies == policy).sum())))
    return made
