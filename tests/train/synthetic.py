"""Rows of a sweep that never ran, with statistics that are known by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from interactive_nav_common.rows import write_parquet

ALGORITHMS = ("ppo", "sac", "ddpg")
K_INTS = (0.0, 0.1, 1.0)
SEEDS = (0, 1, 2)


def run_rows(
    robot: str, algorithm: str, k_int: float, seed: int, p_eff: float, terms: tuple[float, float], **more: object
) -> pa.Table:
    """Forty episodes of one run whose mean scores are exactly those given, on train and on test scenes alike.

    Args:
        p_eff: mean P_eff; episodes differ by up to 0.1, symmetrically.
        terms: mean kinematic and dynamic term of E_eff; episodes differ by up to 0.05.
        **more: `unseen`, added to P_eff on test scenes (default 0).
    """
    wave = np.linspace(-1.0, 1.0, 20)
    unseen = float(more.get("unseen", 0.0))  # type: ignore[arg-type]
    parts = []
    for split, scene, shift in (("train", "alder", 0.0), ("test", "rowan", unseen)):
        p = p_eff + shift + 0.1 * wave
        kinematic, dynamic = terms[0] + 0.05 * wave, terms[1] + 0.05 * wave
        e = 0.5 * (kinematic + dynamic)
        count = len(wave)
        parts.append(
            pa.table(
                {
                    "run": [f"{robot}-{algorithm}-k_int{k_int:g}-seed{seed}"] * count,
                    "robot": [robot] * count,
                    "algorithm": pa.array([algorithm] * count, pa.string()),
                    "policy": ["learned"] * count,
                    "k_int": [k_int] * count,
                    "seed": pa.array([seed] * count, pa.int64()),
                    "evaluation_seed": [7] * count,
                    "device": ["toy"] * count,
                    "checkpoint_steps": [1000] * count,
                    "train_env_steps": [2000] * count,
                    "train_wall_s": [90.0] * count,
                    "train_device": ["toy"] * count,
                    "train_commit": ["0123456789abcdef"] * count,
                    "scene": [scene] * count,
                    "split": [split] * count,
                    "episode": np.arange(count) + (0 if split == "train" else count),
                    "success": (wave > -0.9).astype(float),
                    "path_efficiency": p,
                    "effort_efficiency": e,
                    "kinematic_effort": kinematic,
                    "dynamic_effort": dynamic,
                    "ins_0.5": 0.5 * (p + e),
                }
            )
        )
    return pa.concat_tables(parts)


def paper_like(robots: Sequence[str] = ("turtlebot", "fetch"), noise: float = 0.01) -> pa.Table:
    """A sweep in which every claim of the paper holds; seeds differ by `noise` times -1, 0, 1."""
    tables = []
    for robot in robots:
        for a, algorithm in enumerate(ALGORITHMS):
            for k, k_int in enumerate(K_INTS):
                for seed in SEEDS:
                    best = {"sac": 0.08, "ppo": 0.0, "ddpg": -0.05}[algorithm]
                    p = 0.75 + best - (0.2 if k_int == 1.0 else 0.0) + noise * (seed - 1) * (1 if a % 2 else -1)
                    gain = (0.0, 0.1, 0.2)[k] + (0.05 if robot == "fetch" else 0.0) + 0.3 * best
                    terms = (0.60 + gain + noise * (seed - 1), 0.55 + gain + noise * (seed - 1))
                    tables.append(run_rows(robot, algorithm, k_int, seed, p, terms))
    return pa.concat_tables(tables)


def baseline_rows(robot: str = "turtlebot") -> pa.Table:
    """Policies that never learned: P_eff falls and E_eff rises with the planner's weight."""
    tables = []
    for name, p, e in (("namo:0", 0.9, 0.6), ("namo:0.5", 0.8, 0.8), ("namo:1", 0.6, 0.9), ("follower", 0.85, 0.55)):
        rows = run_rows(robot, "none", 0.0, 0, p, (e, e))
        count = len(rows)
        for column, values in (
            ("policy", pa.array([name] * count)),
            ("run", pa.array(["baselines"] * count)),
            ("algorithm", pa.nulls(count, pa.string())),
            ("seed", pa.nulls(count, pa.int64())),
        ):
            rows = rows.set_column(rows.column_names.index(column), column, values)
        tables.append(rows)
    return pa.concat_tables(tables)


def write_results(folder: Path) -> Path:
    """A results folder with all of it."""
    write_parquet(paper_like(), folder / "rows.parquet")
    write_parquet(baseline_rows(), folder / "baselines.parquet")
    return folder
