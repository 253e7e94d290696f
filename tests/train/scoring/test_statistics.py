"""Means of runs, intervals and tests against arithmetic by hand, and the claims on rows where each is known to hold."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pytest

from interactive_nav_common.statistics import (
    Estimate,
    correlation,
    estimate,
    over_runs,
    p_text,
    paired_difference,
    welch,
)
from tests.train.synthetic import K_INTS, baseline_rows, paper_like, run_rows
from train.scoring.rows import BY_CATEGORY
from train.scoring.statistics import LARGE, MEDIUM, SMALL, claims, contrast, run_means, train_test_contrast


def test_a_run_counts_once_whatever_its_episodes():
    rows = pa.concat_tables([run_rows("fetch", "sac", 0.1, 2, 0.6, (0.8, 0.5)), baseline_rows("fetch")])
    (train,) = run_means(rows, "train")
    assert (train.cell, train.seed, train.episodes) == (("fetch", "sac", 0.1), 2, 20)
    assert train.scores["path_efficiency"] == pytest.approx(0.6) and train.scores["success"] == pytest.approx(0.95)
    assert train.scores["effort_efficiency"] == pytest.approx(0.65)
    assert train.ins(0.25) == pytest.approx(0.25 * 0.6 + 0.75 * 0.65)
    (both,) = run_means(rows)
    assert both.episodes == 40


def test_t_interval_by_hand():
    """1, 2, 3: mean 2, deviation 1, t(0.975, 2) = 4.302653: half width 4.302653 / sqrt(3)."""
    e = estimate([1.0, 2.0, 3.0])
    half = 4.302653 / math.sqrt(3)
    assert (e.mean, e.low, e.high, e.runs) == pytest.approx((2.0, 2.0 - half, 2.0 + half, 3), abs=1e-5)
    assert e.with_ends() == "2.000 [-0.484, 4.484]" and math.isnan(estimate([0.5]).low)
    np.testing.assert_allclose(Estimate(0.5, 0.4, 0.8, 3).bar, [[0.1], [0.3]])


def test_welch_by_hand():
    """Means 2 and 5 with variances 1 and 4, three each: t = -3 / sqrt(5 / 3), 2.941 degrees of freedom."""
    c = welch(np.array([1.0, 2.0, 3.0]), np.array([3.0, 5.0, 7.0]))
    error = math.sqrt(1 / 3 + 4 / 3)
    freedom = (5 / 3) ** 2 / ((1 / 3) ** 2 / 2 + (4 / 3) ** 2 / 2)
    assert freedom == pytest.approx(2.941, abs=1e-3)
    # Half the interval is t(0.975, 2.941) = 3.2187 times the standard error (from tables, between 4.303 and 3.182).
    assert c.difference == pytest.approx(-3.0)
    assert 3.182 < (c.high - c.low) / 2 / error < 4.303
    assert c.low == pytest.approx(-3.0 - (c.high + 3.0))
    assert 0.1 < c.p_value < 0.2 and c.verdict == "undecided"  # t = -2.32: p is 0.10 at 3 and 0.15 at 2 degrees
    constant = welch(np.array([1.0, 1.0]), np.array([0.5, 0.5]))
    assert math.isnan(constant.p_value) and constant.verdict == "undecided" and "no test" in str(constant)


def test_seeds_are_the_sample_and_only_common_settings_are_compared():
    means = run_means(paper_like(noise=0.02), "test")
    # SAC minus PPO: P_eff + 0.08, both terms + 0.024: INS_0.5 + 0.052, whatever k_int.
    c = contrast(means, "algorithm", "sac", "ppo", lambda run: run.ins(0.5), robot="turtlebot")
    assert c is not None and (c.left, c.right) == (3, 3) and c.difference == pytest.approx(0.052)
    # Without PPO at k_int = 1, k_int = 1 of SAC is left out as well: their difference stays.
    partial = [run for run in means if not (run.algorithm == "ppo" and run.k_int == 1.0)]
    c = contrast(partial, "algorithm", "sac", "ppo", lambda run: run.ins(0.5), robot="turtlebot")
    assert c is not None and c.difference == pytest.approx(0.052)
    # A seed that one setting lacks is left out of that side.
    partial = [run for run in means if (run.algorithm, run.k_int, run.seed) != ("sac", 0.1, 2)]
    c = contrast(partial, "algorithm", "sac", "ppo", lambda run: run.ins(0.5), robot="turtlebot")
    assert c is not None and (c.left, c.right) == (2, 3)
    assert contrast(means, "algorithm", "td3", "ppo", lambda run: run.ins(0.5)) is None


def test_seen_against_unseen():
    """Differences of INS_0.5 of -0.01, -0.02 and -0.06: mean -0.03, deviation sqrt(0.0007), t = -1.964 at 2 degrees."""
    shifts = (-0.02, -0.04, -0.12)  # of P_eff, which is half of INS_0.5
    tables = [run_rows("turtlebot", "sac", 0.1, s, 0.7, (0.8, 0.8), unseen=shift) for s, shift in enumerate(shifts)]
    pairs, test = train_test_contrast(pa.concat_tables(tables))
    assert test is not None and len(pairs) == 3 and test.difference == pytest.approx(-0.03)
    half = 4.302653 * math.sqrt(0.0007) / math.sqrt(3)
    assert (test.low, test.high) == pytest.approx((-0.03 - half, -0.03 + half), abs=1e-6)
    t = 0.03 / (math.sqrt(0.0007) / math.sqrt(3))
    # Student's distribution at two degrees of freedom in closed form: p = 1 - t / sqrt(t^2 + 2).
    assert test.p_value == pytest.approx(1.0 - t / math.sqrt(t * t + 2.0), abs=1e-6)
    only_train = [table.filter(pa.compute.equal(table["split"], "train")) for table in tables]
    assert train_test_contrast(pa.concat_tables(only_train)) == ([], None)


def test_intervals_of_runs():
    e = over_runs([0.587, 0.033, 0.55])  # lowest thrice: 3.7 %
    assert (e.low, e.high) == (0.033, 0.587) and over_runs([0.5]).with_ends() == "0.500"


def test_paired_differences_by_hand():
    """0, 0, 3: a resample has k threes with k of three draws at 1 / 3: P(0) = 8 / 27 and P(3) = 1 / 27 exceed 2.5 %."""
    ahead = paired_difference([1.0, 2.0, 5.0], [1.0, 2.0, 2.0])
    assert (ahead.mean, ahead.low, ahead.high, ahead.runs) == (1.0, 0.0, 3.0, 3)
    assert ahead.with_ends() == "1.000 [0.000, 3.000]" and ahead.with_ends(0) == "1 [0, 3]"
    same = paired_difference([0.5, 0.75], [0.25, 0.5])
    assert (same.mean, same.low, same.high) == (0.25, 0.25, 0.25)
    # Of a hundred the mean of differences has nearly a normal distribution, of standard error 0.5 / 10.
    many = paired_difference(np.arange(100) % 2, np.zeros(100))
    assert many.mean == 0.5 and (many.low, many.high) == pytest.approx((0.5 - 0.098, 0.5 + 0.098), abs=0.006)


def test_correlation_by_hand():
    """x = 1..4, y = 2, 1, 4, 3: covariance sum 3, square sums 5 and 5: r = 0.6; z = atanh(0.6) +- 1.96."""
    r = correlation([1, 2, 3, 4], [2, 1, 4, 3])
    z = math.atanh(0.6)
    assert r.r == pytest.approx(0.6)
    assert (r.low, r.high) == pytest.approx((math.tanh(z - 1.959964), math.tanh(z + 1.959964)), abs=1e-5)
    assert r.verdict == "undecided" and str(r).startswith("0.60 [") and r.count == 4
    assert correlation([1, 2, 3, 4], [5, 5, 5, 5]).verdict == correlation([1], [1]).verdict == "too few runs to test"


def test_every_claim_holds_where_it_was_put_in():
    found = claims(paper_like(), "test")
    verdicts = {(f.claim, f.compared): f.verdict for f in found}
    assert len(verdicts) == len(found) == 2 * (2 + 4 + 1) + 2 * 5 + 2 + 2 + 1
    expected = {"holds", "undecided"}
    by_claim = {}
    for (claim, _), verdict in verdicts.items():
        by_claim.setdefault(claim, set()).add(verdict)
    assert by_claim == {
        "SAC is best overall": {"holds"},
        "SAC is best whatever alpha": {"holds"},
        "SAC with k_int = 0.1 is best at every alpha but 0": {"does not hold"},  # at 0.1 it is k_int = 1
        "k_int = 1 is best at alpha = 0": {"holds"},
        "k_int = 1 gains effort efficiency and loses path efficiency": {"holds"},
        "k_int = 0.1 keeps path efficiency at higher effort efficiency": expected,
        "Fetch is more effort-efficient than TurtleBot at the same path efficiency": expected,
        "The two terms of E_eff are correlated": {"holds"},
        "Seen and unseen scenes do not differ": {"too few runs to test"},  # the rows of both are the same
    }
    milder = paper_like().filter(pa.compute.field("k_int") < 1.0)
    path = pa.compute.add(milder["path_efficiency"], pa.compute.multiply(milder["k_int"], 0.01))
    milder = milder.set_column(milder.column_names.index("path_efficiency"), "path_efficiency", path)
    best = [f for f in claims(milder, "test") if f.claim == "SAC with k_int = 0.1 is best at every alpha but 0"]
    assert [(f.verdict, f.result) for f in best] == [("holds", "SAC, k_int = 0.1: 10")] * 2
    sac = next(f for f in found if "turtlebot: INS_0.5, SAC minus PPO" in f.compared)
    assert sac.result.startswith("+0.052 [")


def test_a_cell_that_is_not_finished_changes_no_claim():
    """Two seeds of DDPG at one k_int, and one at another: PPO and SAC are compared over their three as before."""
    done = paper_like().filter(pa.compute.field("algorithm") != "ddpg")
    begun = [run_rows("turtlebot", "ddpg", k_int, s, 0.3, (0.5, 0.5)) for k_int, s in ((0.0, 0), (0.0, 1), (1.0, 0))]
    before, after = claims(done, "test"), claims(pa.concat_tables([done, *begun]), "test")
    changed = [new.compared for old, new in zip(before, after, strict=True) if old != new]  # what is over all runs
    assert changed == ["turtlebot: Pearson's r over runs", after[-1].compared] and "over 39 runs" in changed[-1]


def test_claims_that_fail_say_so_and_missing_runs_too():
    """SAC is worse here, k_int changes nothing, and unseen scenes are harder in every run."""
    tables = []
    for algorithm, p in (("ppo", 0.8), ("sac", 0.6)):
        for k_int in K_INTS:
            for seed in range(3):
                wobble = 0.01 * (seed - 1)
                rows = run_rows("turtlebot", algorithm, k_int, seed, p + wobble, (0.7, 0.7), unseen=-0.1 + wobble)
                tables.append(rows)
    found = {f.compared: f for f in claims(pa.concat_tables(tables), "train")}
    assert found["turtlebot: INS_0.5, SAC minus PPO, mean over k_int"].verdict == "does not hold: lower"
    assert found["turtlebot: E_eff, k_int = 1 minus 0, mean over algorithms"].verdict == "too few runs to test"
    assert found["turtlebot: P_eff, k_int = 1 minus 0, mean over algorithms"].verdict == "undecided"
    assert found["turtlebot: cell of the highest mean INS_0"].verdict == "does not hold"
    best = found["turtlebot: cell of the highest mean INS at alpha 0.1, 0.2, ... 1"]
    assert best.verdict == "does not hold" and best.result == "PPO, k_int = 0: 10"
    seen = next(f for f in found.values() if f.claim == "Seen and unseen scenes do not differ")
    assert seen.verdict == "does not hold: lower" and "18 runs" in seen.compared
    only_ppo = [table for table in tables if table["algorithm"][0].as_py() == "ppo"]
    found = {f.compared: f for f in claims(pa.concat_tables(only_ppo), "train")}
    assert found["turtlebot: INS_0.5, SAC minus PPO, mean over k_int"].verdict == "no runs of sac and ppo to compare"
    assert found["turtlebot: cell of the highest mean INS at alpha 0.1, 0.2, ... 1"].verdict == "no runs to compare"
    assert found["turtlebot: cell of the highest mean INS_0"].verdict == "does not hold"
    found = {f.compared: f for f in claims(pa.concat_tables(only_ppo[:3]), "train")}  # k_int 0 alone
    assert found["turtlebot: cell of the highest mean INS_0"].verdict == "no runs to compare"


def things_touched(rows: pa.Table, wanted: bool) -> pa.Table:
    """Each run's things: what the paper says is touched or moved as wanted, else the other way round."""
    told = []
    for robot, k_int, seed in zip(*(rows[name].to_pylist() for name in ("robot", "k_int", "seed")), strict=True):
        entries = []
        for kinds, touched in ((LARGE, 10), (MEDIUM, 50 if k_int == 0 else 20), (SMALL, 30 if k_int == 1 else 60)):
            moved_m = (8.0 if (robot == "fetch") is wanted else 2.0) + seed
            touched = (touched if wanted else 70 - touched) + seed
            names = [*kinds, *(("coffee_table", "armchair") if kinds is LARGE else ())]
            entries += [(name, 100, touched, 0, moved_m, 0.0) for name in names]
        told.append([dict(zip((f.name for f in BY_CATEGORY.value_type), entry, strict=True)) for entry in entries])
    return rows.append_column("by_category", pa.array(told, BY_CATEGORY))


def test_claims_about_things():
    """Shares by hand: of 100 things 11 large and 61 small ones are touched, on average over the seeds."""
    for wanted, verdict in ((True, "holds"), (False, "does not hold: ")):
        found = claims(things_touched(paper_like(), wanted), "test")
        found = [f for f in found if f.claim.startswith(("Depending", "Fetch moves"))]
        assert len(found) == 5 and all(f.verdict.startswith(verdict) for f in found)
        assert found[0].result.startswith("-0.500 [" if wanted else "+0.500 [")
        assert found[3].result.startswith("+0.060 [" if wanted else "-0.060 [")


def test_p_values_are_written_as_papers_do():
    assert (p_text(0.0004), p_text(0.0312)) == ("< 0.001", "= 0.031")
