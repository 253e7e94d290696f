"""Write the topological report's tables beside those of a folder of runs."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav_common.records import RUNS, read_packaged
from interactive_nav_common.rows import markdown, read_rows, where
from interactive_nav_common.statistics import estimate
from topological_nav.evaluate.contest import COLUMNS
from topological_nav.evaluate.scores import by_scene, score
from topological_nav.learn.learning import RESULTS

Row = Sequence[Any]
REPORT = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, dict[str, list[Any]]])
"""Title of a table -> the names of its keys and columns, and its rows."""
NOTE = """Each column of the report has ours to its right. F1 of tables III and VI is that of free passages. Seconds are
wall-clock time in the report, simulated time in ours. In table V the report's maps are Galatia's; ours are all scenes'
sparse and dense ones, driven by the learned policy, and cells are means over scenes.
"""


def tables(runs: Path) -> str:
    """Return all tables as Markdown."""
    parts = [NOTE]
    for (title, table), ours in zip(REPORT.items(), _ours(runs), strict=True):
        header = [*table["keys"], *(name for column in table["columns"] for name in (column, "ours"))]
        parts.append(f"## {title}\n\n{markdown(header, beside(table['rows'], ours, len(table['keys'])))}")
    return "\n".join(parts)


def beside(theirs: Sequence[Row], ours: Sequence[Row], keys: int) -> list[list[str]]:
    """Return cells of the report's rows, each value followed by ours with the same first `keys` cells."""
    left, right = ({tuple(row[:keys]): row[keys:] for row in rows} for rows in (theirs, ours))
    blank, lines = [np.nan] * (len(theirs[0]) - keys), []
    for key in dict.fromkeys([*left, *right]):
        pairs = zip(left.get(key, blank), right.get(key, blank), strict=True)
        lines.append([*map(str, key), *(_cell(value) for pair in pairs for value in pair)])
    return lines


def _cell(value: float) -> str:
    if np.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else f"{value:.3f}" if value <= 1 else f"{value:.1f}"


def passage_scores(confusion: Sequence[Sequence[int]]) -> list[float]:
    """Return accuracy, F1 of free passages, tn, fp, fn and tp; `confusion` has rows of blocked and free images."""
    (tn, fp), (fn, tp) = confusion
    return [(tn + tp) / (tn + fp + fn + tp), 2 * tp / max(2 * tp + fp + fn, 1), tn, fp, fn, tp]


def _ours(runs: Path) -> Iterator[list[Row]]:
    """Yield our rows of each table."""

    def read(run: str, file: str = RESULTS) -> Any:
        return RUNS.json(runs / run / file)

    pitches = (("Upward", "rooms-up", "up"), ("Neutral", "rooms", "level"), ("Downward", "rooms-down", "down"))
    groups = [(name, read(run)["groups"][pitch]) for name, run, pitch in pitches]
    yield [[name, group["accuracy"], group["macro_f1"]] for name, group in groups]
    pairs = [row for row in read("policy-grid", "grid.json") if "test" in row]
    tests = [(kind, row, row["test"][kind.lower()]) for kind in ("Angular", "Linear") for row in pairs]
    yield [[kind, row["alpha"], row["lambda"], test["macro_f1"], test["accuracy"]] for kind, row, test in tests]
    networks = (("Resnet18", "passages"), ("Alexnet", "alexnet"))
    yield [[name, *passage_scores(read(run)["confusion"])[:2]] for name, run in networks]
    names, lines, kept = ("success", "spl", "rc", "aadc_s", "ad_s"), [], {}
    for policy, run in (("learned", "evaluation-policy"), ("baseline", "evaluation")):
        kept[policy] = read_rows(list((runs / run / "rows").glob("*.parquet")), COLUMNS.check)
        for scene in kept[policy]["scene"].unique().to_pylist():
            rows = where(kept[policy], contender="dense", scene=scene)
            lines.append([f"{scene}, {policy} policy", *(score(rows, name).mean for name in names)])
    yield lines
    maps = [(label, where(kept["learned"], contender=name)) for label, name in (("bad", "sparse"), ("good", "dense"))]
    yield [[label, *(estimate(by_scene(rows, name).values()).mean for name in names)] for label, rows in maps]
    adapted = read("adapted-passages")
    yield [[name, *passage_scores(adapted[name]["confusion"])] for name in "ABCD"]
