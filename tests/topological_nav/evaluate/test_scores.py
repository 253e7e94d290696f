"""Scores of rows written by hand."""

import math

import numpy as np
import pyarrow as pa
import pytest

from topological_nav.config import EvaluationConfig
from topological_nav.evaluate import scores
from topological_nav.evaluate.evaluation import DrivenEpisodes, Played, columns


def journeys(shortest) -> DrivenEpisodes:
    n = len(shortest)
    zero = np.zeros(n)
    return DrivenEpisodes(
        np.arange(n),
        np.zeros((n, 2)),
        zero,
        np.ones((n, 2)),
        zero.astype(int),
        zero.astype(int) + 1,
        np.array(shortest),
        np.ones((n, 2)),
    )


def played(**given) -> Played:
    n = len(next(iter(given.values())))
    zero = np.zeros(n)
    blank = {name: zero for name in Played.__dataclass_fields__ if name != "track_w"}
    return Played(**{**blank, **{k: np.array(v) for k, v in given.items()}}, track_w=[np.zeros((1, 2))] * n)  # type: ignore[arg-type]


def table(contender="dense", scene="cedar", split="train", **given) -> pa.Table:
    shortest = given.pop("shortest")
    made = columns(journeys(shortest), played(**given), EvaluationConfig())
    n = len(shortest)
    named = {"contender": [contender] * n, "scene": [scene] * n, "split": [split] * n, "episode": np.arange(n)}
    return pa.table({**named, **made})


FOUR = {
    "shortest": [4.0, 6.0, 5.0, 8.0],
    "success": [True, True, True, False],
    "path_m": [8.0, 6.0, 4.0, 90.0],
    "contact_s": [0.3, 0.0, 2.0, 50.0],
    "contact_runs": [2, 0, 1, 20],
    "duration_s": [30.0, 20.0, 40.0, 1800.0],
    "goal_m": [1.0, 1.4, 2.0, 7.0],
}


def test_scores_by_hand():
    rows = table(**FOUR)
    # Paths 4/8, 6/6, 5/4 cut to 1, and a failure.
    assert rows["spl"].to_pylist() == [0.5, 1.0, 1.0, 0.0]
    found = {name: scores.score(rows, name) for name in scores.SCORES}
    assert {name: s.mean for name, s in found.items()} == pytest.approx(
        {
            "success": 0.75,
            "spl": 0.625,
            "rc": 2 / 3,  # of the three successes two had a contact
            "aadc_s": 5.0,  # (2 + 0 + 1) runs of 5 s over three successes
            "duration_s": 30.0,
            "ad_s": 472.5,  # (30 + 20 + 40 + 1800) / 4
            "within": 0.5,  # the third believed to be at the goal's node, 2 m away
        }
    )
    assert [found[name].runs for name in ("success", "rc")] == [4, 3]
    # Wilson's interval of 3 in 4 (z = 1.96): centre (0.75 + z^2/8) / (1 + z^2/4).
    z = 1.959964
    centre, half = (0.75 + z**2 / 8) / (1 + z**2 / 4), z * math.sqrt(0.75 * 0.25 / 4 + z**2 / 64) / (1 + z**2 / 4)
    assert (found["success"].low, found["success"].high) == pytest.approx((centre - half, centre + half), abs=1e-6)
    assert found["spl"].low < 0.625 < found["spl"].high


def test_without_success_contacts_have_no_score():
    rows = table(shortest=[4.0], success=[False], path_m=[9.0], contact_s=[3.0], contact_runs=[2])
    assert scores.score(rows, "rc") == scores.NOTHING and scores.text(scores.NOTHING) == "-"
    assert scores.score(rows, "success").mean == 0.0


def all_rows() -> pa.Table:
    """Success by scene: dense 0.75, 1, 0.5 (unseen); sparse 0.25, 0.5."""

    def some(share, n=4):
        won = np.arange(n) < share * n
        return {"shortest": [4.0] * n, "success": won, "path_m": [8.0] * n}

    return pa.concat_tables(
        [
            table(scene="cedar", **some(0.75)),
            table(scene="alder", **some(1.0)),
            table(scene="willow", split="test", **some(0.5)),
            table("sparse", "cedar", **some(0.25)),
            table("sparse", "alder", **some(0.5)),
        ]
    )


def test_the_summary_has_scenes_and_means_over_them():
    lines = {(line.contender, line.group): line for line in scores.summary(all_rows())}
    assert list(lines) == [
        *(("dense", g) for g in ("cedar", "alder", "willow", "seen", "unseen", "all")),
        *(("sparse", g) for g in ("cedar", "alder", "seen", "all")),
    ]
    seen = lines["dense", "seen"].scores["success"]
    # Bootstrap of two scenes: one of four resamples holds the lower one twice, so the interval spans both.
    assert (seen.mean, seen.low, seen.high) == pytest.approx((0.875, 0.75, 1.0))
    assert lines["dense", "unseen"].scores["success"].mean == 0.5 and math.isnan(
        lines["dense", "unseen"].scores["spl"].low
    )
    assert lines["dense", "all"].scores["success"].mean == 0.75
    assert lines["dense", "all"].scores["spl"].mean == pytest.approx(0.375)
    assert lines["dense", "all"].episodes == 12


def test_differences_pair_what_both_played():
    found = {(what, name): result for what, name, result in scores.differences(all_rows())}
    gap = found["dense minus sparse map", "success"]
    assert gap.mean == pytest.approx(0.5) and gap.runs == 2  # 0.75 - 0.25 and 1 - 0.5; willow has one side only
    assert found["dense minus sparse map", "spl"].mean == pytest.approx(0.25)
    assert not [what for what, _ in found if "unseen" in what]  # of one unseen scene there is no interval


def test_unseen_scenes_are_compared_where_each_side_has_three():
    parts = [
        table(scene=f"{split}{k}", split=split, shortest=[4.0], success=[won], path_m=[8.0])
        for split, values in (("test", (False, True, True)), ("train", (True, True, False, True)))
        for k, won in enumerate(values)
    ]
    found = {(what, name): result for what, name, result in scores.differences(pa.concat_tables(parts))}
    assert found["dense: unseen minus seen", "success"].difference == pytest.approx(2 / 3 - 3 / 4)


def test_tables_say_the_same_on_paper():
    text = scores.markdown(scores.summary(all_rows()), scores.differences(all_rows()))
    assert "| dense | cedar | 4 | 0.75 [0.30, 0.95] | 0.38" in text
    assert "| dense minus sparse map | success | 0.50 [0.50, 0.50] |" in text
