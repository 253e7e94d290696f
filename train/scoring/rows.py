"""Episodes in, one row each in Parquet files out, those files read back, and means with their intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from rich.table import Table

from interactive_nav_common.statistics import RESAMPLES, mean_text

if TYPE_CHECKING:
    from train.scoring.rollout import Episodes

SCORES = {
    "success": "success",
    "path_efficiency": "P_eff",
    "effort_efficiency": "E_eff",
    "ins_0.5": "INS_0.5",
}


TYPES: dict[str, pa.DataType] = {
    **dict.fromkeys(("run", "robot", "algorithm", "policy", "backend", "device", "commit", "versions"), pa.string()),
    **dict.fromkeys(("train_device", "train_commit"), pa.string()),
    **dict.fromkeys(("seed", "checkpoint_steps", "evaluation_seed", "train_env_steps"), pa.int64()),
    **dict.fromkeys(("k_int", "evaluation_wall_s", "train_wall_s"), pa.float64()),
    "deterministic": pa.bool_(),
}
"""Of the constant columns, which are empty where they mean nothing (a yardstick has no seed)."""


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
        cells = (mean_text(name, rows[name].to_numpy()[policies == policy]) for name in SCORES)
        made.add_row(policy, *cells, str(int((policies == policy).sum())))
    return made
