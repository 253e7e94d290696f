"""Compute means of runs, intervals over seeds, and the tests of the paper's claims from rows of episodes.

A run's score is the mean over its fixed episodes, and intervals and tests are over runs with different seeds: episodes
of one run share a policy and are not independent.
"""

import collections
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from interactive_nav_common.rows import where
from interactive_nav_common.statistics import Contrast, correlation, estimate, paired_test, welch

ALPHAS = tuple(k / 10 for k in range(11))
LARGE = ("sofa", "table", "desk", "bed", "sideboard", "dresser", "bookcase")
MEDIUM = ("basket", "laundry_basket", "bin", "box", "bag", "stool")
SMALL = ("shoe", "pot", "toy")
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


Cells = dict[tuple[str, str, float], list[RunMean]]
"""Runs by robot, algorithm and k_int."""


def cells(means: Sequence[RunMean]) -> Cells:
    """Group runs by robot, algorithm and k_int."""
    return {cell: [run for run in means if run.cell == cell] for cell in dict.fromkeys(run.cell for run in means)}


def contrast(
    means: Sequence[RunMean], axis: str, left: Any, right: Any, score: Callable[[RunMean], float], **fixed: Any
) -> Contrast | None:
    """Compare two values of an axis; return None if a side has no runs.

    A seed's score is the mean over the settings of the other axes that both sides have.
    """
    others = [name for name in ("robot", "algorithm", "k_int") if name != axis]
    by_setting = collections.defaultdict(dict)
    for run in means:
        if all(getattr(run, name) == value for name, value in fixed.items()):
            by_setting[getattr(run, axis), *(getattr(run, name) for name in others)][run.seed] = score(run)
    common = [setting for side, *setting in by_setting if side == left and (right, *setting) in by_setting]
    if not common:
        return None

    def per_seed(side: Any) -> np.ndarray:
        each = [by_setting[side, *setting] for setting in common]
        return np.array([np.mean([of[seed] for of in each]) for seed in sorted(set.intersection(*map(set, each)))])

    a, b = per_seed(left), per_seed(right)
    return welch(a, b) if len(a) and len(b) else None


def train_test_contrast(rows: pa.Table) -> tuple[list[tuple[RunMean, RunMean]], Contrast | None]:
    """Return each run's means on the train and on the test scenes, and the paper's one-sample t test that INS_0.5 of a
    run is the same on both (difference test minus train, over runs)."""
    unseen = {run.run: run for run in run_means(rows, "test")}
    pairs = [(run, unseen[run.run]) for run in run_means(rows, "train") if run.run in unseen]
    if not pairs:
        return [], None
    return pairs, paired_test(np.array([test.ins(0.5) - train.ins(0.5) for train, test in pairs]))


@dataclasses.dataclass(frozen=True)
class Finding:
    """What our runs say to one comparison behind a claim."""

    claim: str
    compared: str
    result: str
    verdict: str


def _tested(
    claim: str, what: str, expected: str, test: Contrast | None, missing: str = "no runs to compare"
) -> Finding:
    """Judge a claim that expects higher, lower or same by a test; None: there are no runs."""
    if test is None or math.isnan(test.difference):
        return Finding(claim, what, "-", missing)
    verdict = {expected: "holds", "undecided": "undecided"}.get(test.verdict, f"does not hold: {test.verdict}")
    return Finding(claim, what, str(test), "too few runs to test" if math.isnan(test.p_value) else verdict)


def _compared(
    means: Sequence[RunMean], claim: str, what: str, expected: str, alpha: float, *sides: Any, **fixed: Any
) -> Finding:
    """Test a claim about INS_alpha (0: E_eff, 1: P_eff) of two values of an axis; see `contrast`."""
    axis, left, right = sides
    test = contrast(means, axis, left, right, lambda run: run.ins(alpha), **fixed)
    return _tested(claim, what, expected, test, f"no runs of {left} and {right} to compare")


def _of_sac(means: Sequence[RunMean], robot: str) -> Iterator[Finding]:
    """Compare SAC with the others. INS is linear in alpha: what holds at 0 and at 1 holds between."""
    algorithms = {run.algorithm for run in means}
    others = [a for a in ("ppo", "ddpg") if a in algorithms] or ["ppo"]
    for claim, alphas in (("SAC is best overall", (0.5,)), ("SAC is best whatever alpha", (0.0, 1.0))):
        for other in others:
            for alpha in alphas:
                what = f"{robot}: INS_{alpha:g}, SAC minus {other.upper()}, mean over k_int"
                yield _compared(means, claim, what, "higher", alpha, "algorithm", "sac", other, robot=robot)
    of_robot = {cell: runs for cell, runs in cells(means).items() if cell[0] == robot}
    best = collections.Counter(_best(of_robot, alpha) for alpha in ALPHAS[1:])
    wins = (f"{algorithm.upper()}, k_int = {k_int:g}: {count}" for (_, algorithm, k_int), count in best.most_common())
    yield Finding(
        "SAC with k_int = 0.1 is best at every alpha but 0",
        f"{robot}: cell of the highest mean INS at alpha 0.1, 0.2, ... 1",
        "; ".join(wins),
        _best_verdict(of_robot, ("sac", 0.1) in {cell[1:] for cell in of_robot}, set(best) == {(robot, "sac", 0.1)}),
    )


def _best(of_robot: Cells, alpha: float) -> tuple[str, str, float]:
    return max(of_robot, key=lambda cell: estimate(run.ins(alpha) for run in of_robot[cell]).mean)


def _best_verdict(of_robot: Cells, is_there: bool, holds: bool) -> str:
    """Judge a claim that one cell is the best of several."""
    if not is_there or len(of_robot) < 2:
        return "no runs to compare"
    return "holds" if holds else "does not hold"


def _of_objects(means: Sequence[RunMean]) -> Iterator[Finding]:
    """Compare what is pushed and what is avoided; nothing where rows have no categories."""
    if not any(run.objects for run in means):
        return
    claim = "Depending on the penalty a TurtleBot avoids large, medium or small objects"
    free = [run for run in means if (run.robot, run.k_int) == ("turtlebot", 0.0)]
    share = [
        [np.mean([run.of_objects("touched", kinds) for run in free if run.seed == seed]) for seed in seeds]
        for seeds in [sorted({run.seed for run in free})]
        for kinds in (LARGE, SMALL)
    ]
    what = "turtlebot: share of large less share of small objects that are touched, k_int = 0, mean over algorithms"
    yield _tested(claim, what, "lower", welch(*map(np.asarray, share)) if free else None)
    for kinds, name, high, low in ((MEDIUM, "medium", 0.1, 0.0), (SMALL, "small", 1.0, 0.1)):
        what = f"turtlebot: share of {name} objects that are touched, k_int = {high:g} minus {low:g}"
        test = contrast(
            means, "k_int", high, low, lambda run, kinds=kinds: run.of_objects("touched", kinds), robot="turtlebot"
        )
        yield _tested(claim, f"{what}, mean over algorithms", "lower", test)
    for kinds, name in ((("table", "coffee_table"), "tables"), (("sofa", "armchair"), "sofas")):
        test = contrast(
            means, "robot", "fetch", "turtlebot", lambda run, kinds=kinds: run.of_objects("displacement_m", kinds)
        )
        what = f"metres that each of the {name} is moved, Fetch minus TurtleBot, mean over algorithms and k_int"
        yield _tested("Fetch moves tables and sofas", what, "higher", test)


def _of_penalties(means: Sequence[RunMean], robot: str) -> Iterator[Finding]:
    """Test what k_int does to one robot's scores."""
    of_robot = {cell: runs for cell, runs in cells(means).items() if cell[0] == robot}
    best = _best(of_robot, 0.0)
    yield Finding(
        "k_int = 1 is best at alpha = 0",
        f"{robot}: cell of the highest mean INS_0",
        f"{best[1].upper()}, k_int = {best[2]:g}: {estimate(run.ins(0.0) for run in of_robot[best]).mean:.3f}",
        _best_verdict(of_robot, 1.0 in {cell[2] for cell in of_robot}, best[2] == 1.0),
    )
    for k, claim, expectations in (
        (1.0, "k_int = 1 gains effort efficiency and loses path efficiency", ("higher", "lower")),
        (0.1, "k_int = 0.1 keeps path efficiency at higher effort efficiency", ("higher", "same")),
    ):
        for alpha, name, expected in ((0.0, "E_eff", expectations[0]), (1.0, "P_eff", expectations[1])):
            what = f"{robot}: {name}, k_int = {k:g} minus 0, mean over algorithms"
            yield _compared(means, claim, what, expected, alpha, "k_int", k, 0.0, robot=robot)


def claims(rows: pa.Table, split: str | None) -> list[Finding]:
    """Return the paper's claims, one comparison a line; claims without runs say so.

    Cells with fewer runs than others are skipped, as unfinished. `split` selects scenes (None: all), except in the
    claim about train and test scenes.
    """
    runs = run_means(rows, split)
    most = max(map(len, cells(runs).values()), default=0)  # a seed counts only with all settings
    means = [run for whole in cells(runs).values() if len(whole) == most for run in whole]
    robots = sorted({run.robot for run in means})
    findings: list[Finding] = []
    for robot in robots:
        findings += _of_sac(means, robot)
    for robot in robots:
        findings += _of_penalties(means, robot)
    findings += _of_objects(means)
    for alpha, name, expected in ((0.0, "E_eff", "higher"), (1.0, "P_eff", "same")) if len(robots) > 1 else ():
        claim = "Fetch is more effort-efficient than TurtleBot at the same path efficiency"
        what = f"{name}, Fetch minus TurtleBot, mean over algorithms and k_int"
        findings.append(_compared(means, claim, what, expected, alpha, "robot", "fetch", "turtlebot"))
    for robot in robots:
        chosen = [run.scores for run in runs if run.robot == robot]
        r = correlation((s["kinematic_effort"] for s in chosen), (s["dynamic_effort"] for s in chosen))
        what = f"{robot}: Pearson's r over runs"
        findings.append(Finding("The two terms of E_eff are correlated", what, str(r), r.verdict))
    pairs, test = train_test_contrast(rows)
    what = f"INS_0.5, unseen minus seen scenes, one-sample t test over {len(pairs)} runs"
    claim, missing = "Seen and unseen scenes do not differ", "no runs with rows of train and of test scenes"
    return [*findings, _tested(claim, what, "same", test, missing)]
