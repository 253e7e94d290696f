"""Compare rows of episodes with the paper's claims (section V), one comparison a line."""

import collections
import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from interactive_nav_common.statistics import Contrast, correlation, estimate, welch
from train.scoring.statistics import RunMean, cells, contrast, run_means, train_test_contrast

ALPHAS = tuple(k / 10 for k in range(11))
LARGE = ("sofa", "table", "desk", "bed", "sideboard", "dresser", "bookcase")
MEDIUM = ("basket", "laundry_basket", "bin", "box", "bag", "stool")
SMALL = ("shoe", "pot", "toy")
Cells = dict[tuple[str, str, float], list[RunMean]]
"""Runs by robot, algorithm and k_int."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """What our runs say to one comparison behind a claim."""

    claim: str
    compared: str
    result: str
    verdict: str


def _verdict(test: Contrast, expected: str) -> str:
    """Return what a contrast says to a claim that expects higher, lower or same."""
    if math.isnan(test.p_value):
        return "too few runs to test"
    return {expected: "holds", "undecided": "undecided"}.get(test.verdict, f"does not hold: {test.verdict}")


def _tested(
    claim: str, what: str, expected: str, test: Contrast | None, missing: str = "no runs to compare"
) -> Finding:
    """Judge a claim by a test; None: there are no runs."""
    if test is None or math.isnan(test.difference):
        return Finding(claim, what, "-", missing)
    return Finding(claim, what, str(test), _verdict(test, expected))


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
    """Return the cell of the highest mean INS."""
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
    claim = "Depending on the penalty a TurtleBot avoids large, medium or small things"
    free = [run for run in means if (run.robot, run.k_int) == ("turtlebot", 0.0)]
    share = [
        [np.mean([run.of_objects("touched", kinds) for run in free if run.seed == seed]) for seed in seeds]
        for seeds in [sorted({run.seed for run in free})]
        for kinds in (LARGE, SMALL)
    ]
    what = "turtlebot: share of large less share of small things that are touched, k_int = 0, mean over algorithms"
    yield _tested(claim, what, "lower", welch(*map(np.asarray, share)) if free else None)
    for kinds, name, high, low in ((MEDIUM, "medium", 0.1, 0.0), (SMALL, "small", 1.0, 0.1)):
        what = f"turtlebot: share of {name} things that are touched, k_int = {high:g} minus {low:g}"
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


def _of_splits(rows: pa.Table) -> Finding:
    """Compare train with test scenes."""
    pairs, test = train_test_contrast(rows)
    what = f"INS_0.5, unseen minus seen scenes, one-sample t test over {len(pairs)} runs"
    claim, missing = "Seen and unseen scenes do not differ", "no runs with rows of train and of test scenes"
    return _tested(claim, what, "same", test, missing)


def _of_whole_cells(means: Sequence[RunMean]) -> list[RunMean]:
    """Return runs of the cells that have the most: a seed counts only with all settings, and few would be left."""
    most = max(map(len, cells(means).values()), default=0)
    return [run for runs in cells(means).values() if len(runs) == most for run in runs]


def claims(rows: pa.Table, split: str | None) -> list[Finding]:
    """Return the paper's claims, one comparison a line; those whose runs are missing say so.

    Cells with fewer runs than others are not compared: of a sweep that goes on they are not finished. All but the claim
    about train and test scenes are about one `split` of the scenes; None: all.
    """
    runs = run_means(rows, split)
    means = _of_whole_cells(runs)
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
    return [*findings, _of_splits(rows)]
