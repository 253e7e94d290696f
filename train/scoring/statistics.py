"""Rows of episodes in; means of runs, intervals over seeds, and the tests behind the paper's claims out.

A run is the unit: its score is the mean over its fixed episodes, and intervals and tests are over runs that differ in
their seed. Episodes of one run share a policy and are no independent trials of an algorithm.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from scipy import stats

from interactive_nav_common.statistics import CONFIDENCE, LEVEL, Contrast, _constant, estimate, p_text, welch

SCORES = ("success", "path_efficiency", "effort_efficiency", "kinematic_effort", "dynamic_effort", "ins_0.5")


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

    @property
    def cell(self) -> tuple[str, str, float]:
        """All but the seed."""
        return self.robot, self.algorithm, self.k_int

    def ins(self, alpha: float) -> float:
        """Interactive navigation score: alpha P_eff + (1 - alpha) E_eff."""
        return alpha * self.scores["path_efficiency"] + (1.0 - alpha) * self.scores["effort_efficiency"]


def learned_rows(rows: pa.Table, split: str | None = None) -> pa.Table:
    """Those of learned policies, in one part of the scenes or all."""
    kept = pc.field("policy") == "learned"
    return rows.filter(kept if split is None else kept & (pc.field("split") == split))


def run_means(rows: pa.Table, split: str | None = None) -> list[RunMean]:
    """Means of each learned run over its episodes.

    Args:
        rows: of `train.evaluate`.
        split: train or test scenes; None: all.
    """
    chosen = learned_rows(rows, split)
    names = [name for name in SCORES if name in chosen.column_names]
    keys = ["run", "robot", "algorithm", "k_int", "seed"]
    means = chosen.group_by(keys).aggregate([(name, "mean") for name in names] + [("episode", "count")]).to_pylist()
    found = [
        RunMean(
            *(row[key] for key in keys),
            episodes=row["episode_count"],
            scores={name: row[f"{name}_mean"] for name in names},
        )
        for row in means
    ]
    return sorted(found, key=lambda run: (run.robot, run.algorithm, run.k_int, run.seed, run.run))


def cells(means: Sequence[RunMean]) -> dict[tuple[str, str, float], list[RunMean]]:
    """Runs by robot, algorithm and k_int."""
    found: dict[tuple[str, str, float], list[RunMean]] = {}
    for run in means:
        found.setdefault(run.cell, []).append(run)
    return found


def contrast(
    means: Sequence[RunMean],
    axis: str,
    left: Any,
    right: Any,
    score: Callable[[RunMean], float],
    **where: Any,
) -> Contrast | None:
    """Compares two values of an axis.

    Each seed counts once: its score is the mean over the settings of the other axes that both sides have.

    Args:
        means: of runs.
        axis: robot, algorithm or k_int.
        left: value on the axis.
        right: value to subtract.
        score: of a run.
        **where: only runs with these values.

    Returns:
        None where a side has no runs.
    """
    chosen = [run for run in means if all(getattr(run, name) == value for name, value in where.items())]
    others = [name for name in ("robot", "algorithm", "k_int") if name != axis]

    def by_setting(value: Any) -> dict[tuple[Any, ...], dict[int, float]]:
        found: dict[tuple[Any, ...], dict[int, float]] = {}
        for run in chosen:
            if getattr(run, axis) == value:
                found.setdefault(tuple(getattr(run, name) for name in others), {})[run.seed] = score(run)
        return found

    sides = [by_setting(left), by_setting(right)]
    common = set(sides[0]) & set(sides[1])
    if not common:
        return None

    def per_seed(side: dict[tuple[Any, ...], dict[int, float]]) -> np.ndarray:
        seeds = set.intersection(*(set(side[setting]) for setting in common))
        return np.array([np.mean([side[setting][seed] for setting in common]) for seed in sorted(seeds)])

    a, b = per_seed(sides[0]), per_seed(sides[1])
    if not len(a) or not len(b):
        return None
    return welch(a, b)


def seen_unseen(rows: pa.Table) -> tuple[list[tuple[RunMean, RunMean]], Contrast | None]:
    """Each run's means on the train and on the test scenes, and the paper's one-sample t test that INS_0.5 of a run is
    the same on both (difference unseen minus seen, over runs)."""
    unseen = {run.run: run for run in run_means(rows, "test")}
    pairs = [(run, unseen[run.run]) for run in run_means(rows, "train") if run.run in unseen]
    if not pairs:
        return [], None
    differences = np.array([test.ins(0.5) - train.ins(0.5) for train, test in pairs])
    mean = float(differences.mean())
    if len(differences) < 2 or _constant(differences):
        return pairs, Contrast(mean, math.nan, math.nan, math.nan, len(pairs), len(pairs))
    test = stats.ttest_1samp(differences, 0.0)
    interval = test.confidence_interval(CONFIDENCE)
    return pairs, Contrast(mean, float(interval.low), float(interval.high), float(test.pvalue), len(pairs), len(pairs))


@dataclasses.dataclass(frozen=True)
class Correlation:
    """Pearson's r with its 95 % interval (Fisher's z) and p-value."""

    r: float
    low: float
    high: float
    p_value: float
    count: int

    @property
    def verdict(self) -> str:
        """Whether they are correlated, at the 5 % level."""
        if math.isnan(self.r):
            return "too few runs to test"
        if self.p_value >= LEVEL:
            return "undecided"
        return "holds" if self.r > 0 else "does not hold: negative"

    def __str__(self) -> str:
        if math.isnan(self.r):
            return f"not defined ({self.count} points)"
        return f"{self.r:.2f} [{self.low:.2f}, {self.high:.2f}], p {p_text(self.p_value)}, n = {self.count:,}"


def correlation(x: Iterable[float], y: Iterable[float]) -> Correlation:
    """Pearson's correlation; NaN for fewer than four points or where one does not vary."""
    a, b = np.asarray(list(x), float), np.asarray(list(y), float)
    if len(a) < 4 or _constant(a) or _constant(b):
        return Correlation(math.nan, math.nan, math.nan, math.nan, len(a))
    test = stats.pearsonr(a, b)
    interval = test.confidence_interval(CONFIDENCE)
    return Correlation(float(test.statistic), float(interval.low), float(interval.high), float(test.pvalue), len(a))


@dataclasses.dataclass(frozen=True)
class Finding:
    """What our runs say to one comparison behind a claim."""

    claim: str
    compared: str
    result: str
    verdict: str


def _verdict(test: Contrast, expected: str) -> str:
    """What a contrast says to a claim that expects higher, lower or same."""
    if expected == "same" and test.verdict == "undecided":
        return "no significant difference"
    if math.isnan(test.p_value):
        return "too few runs to test"
    return {expected: "holds", "undecided": "undecided"}.get(test.verdict, f"does not hold: {test.verdict}")


def _compared(
    means: Sequence[RunMean], claim: str, what: str, expected: str, alpha: float, *sides: Any, **where: Any
) -> Finding:
    """A claim about INS_alpha (0: E_eff, 1: P_eff) of two values of an axis; see `contrast`."""
    axis, left, right = sides
    test = contrast(means, axis, left, right, lambda run: run.ins(alpha), **where)
    if test is None:
        return Finding(claim, what, "-", f"no runs of {left} and {right} to compare")
    return Finding(claim, what, str(test), _verdict(test, expected))


def _of_penalties(means: Sequence[RunMean], robot: str) -> Iterator[Finding]:
    """What k_int does to one robot's scores."""
    by_cell = {
        cell: estimate(run.ins(0.0) for run in runs).mean for cell, runs in cells(means).items() if cell[0] == robot
    }
    best = max(by_cell, key=lambda cell: by_cell[cell])
    yield Finding(
        "k_int = 1 is best at alpha = 0",
        f"{robot}: cell of the highest mean INS_0",
        f"{best[1].upper()}, k_int = {best[2]:g}: {by_cell[best]:.3f}",
        "holds" if best[2] == 1.0 else "does not hold",
    )
    for k, claim, expectations in (
        (1.0, "k_int = 1 gains effort efficiency and loses path efficiency", ("higher", "lower")),
        (0.1, "k_int = 0.1 keeps path efficiency at higher effort efficiency", ("higher", "same")),
    ):
        for alpha, name, expected in ((0.0, "E_eff", expectations[0]), (1.0, "P_eff", expectations[1])):
            what = f"{robot}: {name}, k_int = {k:g} minus 0, mean over algorithms"
            yield _compared(means, claim, what, expected, alpha, "k_int", k, 0.0, robot=robot)


def _of_splits(rows: pa.Table) -> Finding:
    """Train against test scenes."""
    pairs, test = seen_unseen(rows)
    what = f"INS_0.5, unseen minus seen scenes, one-sample t test over {len(pairs)} runs"
    result, verdict = "-", "no runs with rows of train and of test scenes"
    if test is not None:
        result = str(test)
        verdict = "too few runs to test" if math.isnan(test.p_value) else _verdict(test, "same")
    return Finding("Seen and unseen scenes do not differ", what, result, verdict)


def claims(rows: pa.Table, split: str | None) -> list[Finding]:
    """The paper's claims (section V), one comparison a line; those whose runs are missing say so.

    Args:
        rows: of `train.evaluate`.
        split: of the scenes for all but the train/test claim; None: all.
    """
    means = run_means(rows, split)
    robots = sorted({run.robot for run in means})
    algorithms = {run.algorithm for run in means}
    found: list[Finding] = []
    for robot in robots:
        for other in [a for a in ("ppo", "ddpg") if a in algorithms] or ["ppo"]:
            claim, what = "SAC is best overall", f"{robot}: INS_0.5, SAC minus {other.upper()}, mean over k_int"
            found.append(_compared(means, claim, what, "higher", 0.5, "algorithm", "sac", other, robot=robot))
    for robot in robots:
        found += _of_penalties(means, robot)
    for alpha, name, expected in ((0.0, "E_eff", "higher"), (1.0, "P_eff", "same")) if len(robots) > 1 else ():
        claim = "Fetch is more effort-efficient than TurtleBot at the same path efficiency"
        what = f"{name}, Fetch minus TurtleBot, mean over algorithms and k_int"
        found.append(_compared(means, claim, what, expected, alpha, "robot", "fetch", "turtlebot"))
    for robot in robots:
        chosen = [run.scores for run in means if run.robot == robot]
        r = correlation((s["kinematic_effort"] for s in chosen), (s["dynamic_effort"] for s in chosen))
        what = f"{robot}: Pearson's r over runs"
        found.append(Finding("The two terms of E_eff are correlated", what, str(r), r.verdict))
    return [*found, _of_splits(rows)]
