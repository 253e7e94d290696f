"""Episodes in, one row each in a Parquet file out, and means with their intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.table import Table
from scipy import stats

from train.files import whole_file
from train.rollout import Episodes

SCORES = {
    "success": "success",
    "path_efficiency": "P_eff",
    "effort_efficiency": "E_eff",
    "ins_0.5": "INS_0.5",
}
CONFIDENCE = 0.95
RESAMPLES = 10_000


def episode_table(episodes: Episodes, scenes: Any, constants: dict[str, Any]) -> pa.Table:
    """One row an episode.

    Args:
        episodes: what was played.
        scenes: the environment's, with name and split.
        constants: columns that are the same in every row; they come first.
    """
    count = len(episodes.scene_index)
    columns: dict[str, Any] = {name: pa.array([value] * count) for name, value in constants.items()}
    columns["scene"] = [scenes[i].name for i in episodes.scene_index]
    columns["split"] = [scenes[i].split for i in episodes.scene_index]
    columns["episode"] = np.arange(count, dtype=np.int32)
    return pa.table({**columns, **episodes.metrics})


def write_parquet(table: pa.Table, path: Path) -> None:
    """Writes rows whole or not at all.

    Raises:
        RunFolderError: the file cannot be written.
    """
    with whole_file(path) as partial:
        pq.write_table(table, partial)


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
