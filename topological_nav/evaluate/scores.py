"""Compute success rate, SPL, RC, AADC and duration of episodes' rows, with 95 % intervals, as tables.

RC is the share of successes with a contact; AADC is the seconds in contact of a success, where a run with a contact
counts fully (5 s); `duration` is over successes too, AD over all episodes (simulated). Intervals in a scene are
Wilson's for shares and bootstrap for means; those over scenes are bootstrap, and Student's for differences.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from rich.table import Table

from interactive_nav_common import rows as tables
from interactive_nav_common.rows import where
from interactive_nav_common.statistics import Contrast, Estimate, estimate, over_episodes, over_runs, welch

SCORES = {
    "success": "success",
    "spl": "SPL",
    "rc": "RC",
    "aadc_s": "AADC (s)",
    "duration_s": "duration (s)",
    "ad_s": "AD (s)",
    "within": "within 1.5 m",
}
"""Name -> heading; `within` is the share of episodes that ended near the goal, whether or not the navigator knew."""
HEADER = ("contender", "scene", "episodes", *SCORES.values())
COLUMN = {"rc": "contact", "ad_s": "duration_s"}
"""Score -> its column, if the names differ."""
OF_SUCCESSES = ("rc", "aadc_s", "duration_s")
NOTHING = Estimate(np.nan, np.nan, np.nan, 0)


def score(rows: pa.Table, name: str) -> Estimate:
    """Return one of `SCORES` over the rows' episodes."""
    values = rows[COLUMN.get(name, name)].to_numpy().astype(float)
    if name in OF_SUCCESSES:
        values = values[rows["success"].to_numpy() > 0]
    return over_episodes("success" if name in ("rc", "within") else name, values) if len(values) else NOTHING


def by_scene(rows: pa.Table, name: str) -> dict[str, float]:
    """Return each scene's score, without scenes that have none (RC without a success)."""
    means = {scene: score(where(rows, scene=scene), name).mean for scene in rows["scene"].unique().to_pylist()}
    return {scene: mean for scene, mean in means.items() if not np.isnan(mean)}


@dataclasses.dataclass(frozen=True)
class Line:
    """Hold a line of the summary."""

    contender: str
    group: str
    """A scene, or a group of scenes: seen, unseen, all."""
    episodes: int
    scores: dict[str, Estimate]


def summary(rows: pa.Table) -> list[Line]:
    """Return each contender's scenes, then the means over seen (train), unseen (test) and all scenes."""
    lines = []
    for contender in rows["contender"].unique().to_pylist():
        played = where(rows, contender=contender)
        scenes = played["scene"].unique().to_pylist()
        for scene in scenes:
            part = where(played, scene=scene)
            lines.append(Line(contender, scene, len(part), {name: score(part, name) for name in SCORES}))
        for group, split in (("seen", "train"), ("unseen", "test"), ("all", None)) if len(scenes) > 1 else ():
            if len(part := where(played, split=split)):
                means = {name: over_runs(by_scene(part, name).values()) for name in SCORES}
                lines.append(Line(contender, group, len(part), means))
    return lines


def differences(rows: pa.Table) -> list[tuple[str, str, Estimate | Contrast]]:
    """Compare the same episodes on dense and sparse maps by scene, and unseen with seen scenes by Welch's test."""
    results = []
    contenders = rows["contender"].unique().to_pylist()
    for name in ("success", "spl"):
        if {"dense", "sparse"} <= set(contenders):
            dense, sparse = (by_scene(where(rows, contender=c), name) for c in ("dense", "sparse"))
            gaps = [dense[scene] - sparse[scene] for scene in dense if scene in sparse]
            results.append(("dense minus sparse map", name, estimate(gaps)))
        for contender in contenders:
            unseen, seen = (
                [*by_scene(where(rows, contender=contender, split=x), name).values()] for x in ("test", "train")
            )
            if min(len(unseen), len(seen)) > 2:  # an interval of two homes says nothing
                results.append((f"{contender}: unseen minus seen", name, welch(np.array(unseen), np.array(seen))))
    return results


def console_table(lines: Sequence[Line]) -> Table:
    """Format the summary for a terminal."""
    caption = "mean [95 % interval]; RC, AADC and duration of successes"
    return tables.console_table(HEADER, map(_cells, lines), left=3, caption=caption)


def markdown(lines: Sequence[Line], compared: Sequence[tuple[str, str, Estimate | Contrast]]) -> str:
    """Format the summary and the comparisons as Markdown."""
    summed = tables.markdown(HEADER, map(_cells, lines))
    header = ("Compared", "Score", "Difference [95 % interval]")
    lines_compared = [(what, SCORES[name], text(result)) for what, name, result in compared]
    return summed + ("\n" + tables.markdown(header, lines_compared) if compared else "")


def _cells(line: Line) -> list[str]:
    return [line.contender, line.group, str(line.episodes), *(text(line.scores[name]) for name in SCORES)]


def text(value: Estimate | Contrast) -> str:
    """Format a score or a comparison for tables; `-` if there is nothing to average."""
    if isinstance(value, Contrast):
        return str(value)
    return value.with_ends(2 if abs(value.mean) < 10 else 0) if value.runs else "-"
