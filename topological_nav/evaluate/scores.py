"""Rows of episodes in; success rate, SPL, RC, AADC and duration with 95 % intervals, as tables, out.

RC is the share of successes with a contact, AADC the seconds in contact of a success, where a run with a contact
counts as a whole (5 s); both, and the duration, are over successes, as a failure's contacts grow with the time limit.
A scene's intervals are over its episodes (Wilson's for shares, bootstrap for means); those over scenes are Student's.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Iterable, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rich.table import Table

from interactive_nav_common import rows as tables
from interactive_nav_common.statistics import Contrast, Estimate, estimate, interval, welch

SCORES = {
    "success": "success",
    "spl": "SPL",
    "rc": "RC",
    "aadc_s": "AADC (s)",
    "duration_s": "duration (s)",
    "within": "within 1.5 m",
}
"""Name -> heading; `within` is the share of episodes that ended near the goal, whatever the navigator believed."""
HEADER = ("contender", "scene", "episodes", *SCORES.values())
EPISODE = ["scene", "episode"]
OF_SUCCESSES = {"rc": "contact", "aadc_s": "aadc_s", "duration_s": "duration_s"}


@dataclasses.dataclass(frozen=True)
class Score(Estimate):
    """A mean over so many episodes, or scenes, and its 95 % interval; NaN where there is nothing to average."""

    @classmethod
    def over(cls, means: Iterable[float]) -> Score:
        """Student's, see `estimate`."""
        return cls(*dataclasses.astuple(estimate(means)))

    def __str__(self) -> str:
        if not self.runs:
            return "-"
        digits = 2 if abs(self.mean) < 10 else 0
        if np.isnan(self.low):
            return f"{self.mean:.{digits}f}"
        return f"{self.mean:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"


NOTHING = Score(np.nan, np.nan, np.nan, 0)


def score(rows: pa.Table, name: str) -> Score:
    """One of `SCORES` over the rows' episodes."""
    values = rows[OF_SUCCESSES.get(name, name)].to_numpy().astype(float)
    if name in OF_SUCCESSES:
        values = values[rows["success"].to_numpy() > 0]
    if not len(values):
        return NOTHING
    share = name in ("success", "rc", "within")
    low, high = interval("success" if share else name, values)
    return Score(float(values.mean()), low, high, len(values))


def where(rows: pa.Table, **wanted: str) -> pa.Table:
    """Rows whose columns have these values."""
    return rows.filter(functools.reduce(operator.and_, (pc.field(name) == value for name, value in wanted.items())))


def over_scenes(rows: pa.Table, name: str) -> Score:
    """Mean over scenes of their scores; scenes without any (RC where nothing succeeded) are left out."""
    means = (score(where(rows, scene=scene), name).mean for scene in _in_order(rows, "scene"))
    return Score.over(m for m in means if not np.isnan(m))


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of the summary."""

    contender: str
    group: str
    """A scene, or over scenes: seen, unseen, all."""
    episodes: int
    scores: dict[str, Score]


def summary(rows: pa.Table) -> list[Line]:
    """Per contender: each scene, then the means over seen (train), unseen (test) and all scenes."""
    lines = []
    for contender in _in_order(rows, "contender"):
        mine = where(rows, contender=contender)
        scenes = _in_order(mine, "scene")
        for scene in scenes:
            part = where(mine, scene=scene)
            lines.append(Line(contender, scene, len(part), {name: score(part, name) for name in SCORES}))
        parts = {"seen": where(mine, split="train"), "unseen": where(mine, split="test"), "all": mine}
        if len(scenes) > 1:
            for group, part in parts.items():
                if len(part):
                    lines.append(Line(contender, group, len(part), {name: over_scenes(part, name) for name in SCORES}))
    return lines


def _in_order(rows: pa.Table, name: str) -> list[str]:
    return rows[name].unique().to_pylist()


@dataclasses.dataclass(frozen=True)
class Difference:
    """Two means compared."""

    compared: str
    score: str
    result: Score | Contrast


def differences(rows: pa.Table) -> list[Difference]:
    """Dense minus sparse map on the same episodes, scene by scene; unseen minus seen scenes, Welch's test."""
    results = []
    contenders = _in_order(rows, "contender")
    for name in ("success", "spl"):
        if {"dense", "sparse"} <= set(contenders):
            dense, sparse = (where(rows, contender=c).select([*EPISODE, name]) for c in ("dense", "sparse"))
            both = dense.join(sparse, EPISODE, join_type="inner", right_suffix="_sparse")
            both = both.append_column("gap", pc.subtract(both[name], both[f"{name}_sparse"]))
            gaps = both.group_by("scene").aggregate([("gap", "mean")])["gap_mean"]
            results.append(Difference("dense minus sparse map", name, Score.over(gaps.to_pylist())))
        for contender in contenders:
            mine = where(rows, contender=contender)
            sides = [
                np.array([score(where(part, scene=scene), name).mean for scene in _in_order(part, "scene")])
                for part in (where(mine, split="test"), where(mine, split="train"))
            ]
            if all(map(len, sides)):
                results.append(Difference(f"{contender}: unseen minus seen", name, welch(*sides)))
    return results


def console_table(lines: Sequence[Line]) -> Table:
    """For a terminal."""
    table = Table(caption="mean [95 % interval]; RC, AADC and duration of successes")
    for heading in HEADER:
        table.add_column(heading, justify="right" if heading in SCORES.values() else "left")
    for line in lines:
        table.add_row(*_cells(line))
    return table


def markdown(lines: Sequence[Line], compared: Sequence[Difference]) -> str:
    """For a file: the summary and the comparisons."""
    text = tables.markdown(HEADER, map(_cells, lines))
    header = ("Compared", "Score", "Difference [95 % interval]")
    lines_compared = [(d.compared, SCORES[d.score], d.result) for d in compared]
    return text + ("\n" + tables.markdown(header, lines_compared) if lines_compared else "")


def _cells(line: Line) -> list[str]:
    return [line.contender, line.group, str(line.episodes), *(str(line.scores[name]) for name in SCORES)]
