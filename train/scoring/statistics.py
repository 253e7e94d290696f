"""Compute means of runs, intervals over seeds, and the tests behind the paper's claims from rows of episodes.

A run is the unit: its score is the mean over its fixed episodes, and intervals and tests are over runs that differ in
their seed. Episodes of one run share a policy and are no independent trials of an algorithm.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from interactive_nav_common.rows import where
from interactive_nav_common.statistics import Contrast, paired_test, welch

SCORES = ("success", "path_efficiency", "effort_efficiency", "kinematic_effort", "dynamic_effort", "ins_0.5")

Sums = Mapping[str, float]
"""Sums over episodes of the numbers of `by_category` (`train.scoring.rows`)."""


@dataclasses.dataclass(frozen=True)
class RunMean:
    """A run's means over its episodes in one part of the scenes."""

    run: str
    robot: str
    algorithm: str
    k_int: float
    seed: int
    episodes: int
    scores: Mapping[str, float]
    objects: Mapping[str, Sums]
    """By category; empty where rows do not have them."""

    @property
    def cell(self) -> tuple[str, str, float]:
        """Return all axes but the seed."""
        return self.robot, self.algorithm, self.k_int

    def ins(self, alpha: float) -> float:
        """Return the interactive navigation score: alpha P_eff + (1 - alpha) E_eff."""
        return alpha * self.scores["path_efficiency"] + (1.0 - alpha) * self.scores["effort_efficiency"]

    def of_objects(self, what: str, categories: Iterable[str]) -> float:
        """Return `touched` or `displacement_m` of `by_category` per object of some categories; NaN without any."""
        matching = [self.objects[name] for name in categories if name in self.objects]
        there = sum(sums["objects"] for sums in matching)
        return sum(sums[what] for sums in matching) / there if there else math.nan


def learned_rows(rows: pa.Table, split: str | None = None) -> pa.Table:
    """Return the rows of learned policies, in one part of the scenes or all."""
    return where(rows, policy="learned", split=split)


def objects_moved(rows: pa.Table, keys: list[str]) -> dict[tuple[Any, ...], Sums]:
    """Return (value of each key, category) -> sums over episodes of `by_category`; empty without that column."""
    if "by_category" not in rows.column_names:
        return {}
    rows = rows.filter(pc.is_valid(rows["by_category"]))
    nested = rows["by_category"].combine_chunks()
    entries = pa.Table.from_struct_array(pc.list_flatten(nested))
    for key in keys:
        entries = entries.append_column(key, rows[key].combine_chunks().take(pc.list_parent_indices(nested)))
    numbers = [name for name in entries.column_names if name not in ("category", *keys)]
    summed = entries.group_by([*keys, "category"]).aggregate([(name, "sum") for name in numbers]).to_pylist()
    return {
        tuple(row[key] for key in (*keys, "category")): {name: row[f"{name}_sum"] for name in numbers} for row in summed
    }


def run_means(rows: pa.Table, split: str | None = None) -> list[RunMean]:
    """Return the means of each learned run over its episodes in train or test scenes; None: all."""
    chosen = learned_rows(rows, split)
    objects = objects_moved(chosen, ["run"])
    names = [name for name in SCORES if name in chosen.column_names]
    keys = ["run", "robot", "algorithm", "k_int", "seed"]
    means = chosen.group_by(keys).aggregate([(name, "mean") for name in names] + [("episode", "count")]).to_pylist()
    runs = [
        RunMean(
            *(row[key] for key in keys),
            episodes=row["episode_count"],
            scores={name: row[f"{name}_mean"] for name in names},
            objects={category: sums for (run, category), sums in objects.items() if run == row["run"]},
        )
        for row in means
    ]
    return sorted(runs, key=lambda run: (run.robot, run.algorithm, run.k_int, run.seed, run.run))


def cells(means: Sequence[RunMean]) -> dict[tuple[str, str, float], list[RunMean]]:
    """Group runs by robot, algorithm and k_int."""
    groups: dict[tuple[str, str, float], list[RunMean]] = {}
    for run in means:
        groups.setdefault(run.cell, []).append(run)
    return groups


def contrast(
    means: Sequence[RunMean], axis: str, left: Any, right: Any, score: Callable[[RunMean], float], **fixed: Any
) -> Contrast | None:
    """Compare two values of an axis; return None where a side has no runs.

    Each seed counts once: its score is the mean over the settings of the other axes that both sides have.
    """
    chosen = [run for run in means if all(getattr(run, name) == value for name, value in fixed.items())]
    others = [name for name in ("robot", "algorithm", "k_int") if name != axis]

    def by_setting(value: Any) -> dict[tuple[Any, ...], dict[int, float]]:
        by_others: dict[tuple[Any, ...], dict[int, float]] = {}
        for run in chosen:
            if getattr(run, axis) == value:
                by_others.setdefault(tuple(getattr(run, name) for name in others), {})[run.seed] = score(run)
        return by_others

    sides = [by_setting(left), by_setting(right)]
    common = set(sides[0]) & set(sides[1])
    if not common:
        return None

    def per_seed(side: dict[tuple[Any, ...], dict[int, float]]) -> np.ndarray:
        seeds = set.intersection(*(set(side[setting]) for setting in common))
        return np.array([np.mean([side[setting][seed] for setting in common]) for seed in sorted(seeds)])

    a, b = map(per_seed, sides)
    return welch(a, b) if len(a) and len(b) else None


def train_test_contrast(rows: pa.Table) -> tuple[list[tuple[RunMean, RunMean]], Contrast | None]:
    """Return each run's means on the train and on the test scenes, and the paper's one-sample t test that INS_0.5 of a
    run is the same on both (difference test minus train, over runs)."""
    unseen = {run.run: run for run in run_means(rows, "test")}
    pairs = [(run, unseen[run.run]) for run in run_means(rows, "train") if run.run in unseen]
    if not pairs:
        return [], None
    return pairs, paired_test(np.array([test.ins(0.5) - train.ins(0.5) for train, test in pairs]))
