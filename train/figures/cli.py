"""`python -m train.figures RESULTS_DIR -o figures/`: metrics, rows and recorded paths in, pictures and tables out."""

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from interactive_nav_common.errors import FileError, regular, reports_errors
from interactive_nav_common.records import METRICS, PACKED_METRICS, read_metrics
from interactive_nav_common.rows import read_rows
from interactive_nav_common.untrusted.reading import read_npz
from interactive_nav_common.words import program
from train.figures import style  # first: it chooses matplotlib's backend
from train.figures.curves import cell_curves, learning_curves
from train.figures.paths import side_by_side, spread_episodes, trajectories
from train.figures.scores import efficiency_plane, effort_terms, frontier, ins_over_alpha, robots_plane, seen_and_unseen
from train.figures.tables import document
from train.scoring.row_files import PATHS
from train.scoring.rows import check_rows
from train.scoring.statistics import run_means

from matplotlib.figure import Figure  # isort: skip

SWEPT = {"run", "robot", "algorithm", "k_int", "seed", "policy", "split", "kinematic_effort", "dynamic_effort"}
EPISODES_DRAWN = 6


class Results:
    """The files under a folder of results, by what they hold."""

    def __init__(self, root: Path):
        self.root = root
        logs = sorted([*root.rglob(METRICS), *root.rglob(PACKED_METRICS)])
        self.curves = {log.parent: lines for log in logs if (lines := read_metrics(log))}
        # What begins with a dot is unfinished.
        records = [path for path in sorted(root.rglob("[!.]*.npz")) if "checkpoints" not in path.parts]
        self.records = [path for path in records if not path.parent.name.startswith("diverged-")]
        self.tables = sorted(root.rglob("[!.]*.parquet"))
        if not self.curves and not self.records and not self.tables:
            raise FileError(
                f"{root}: nothing to draw (no metrics.jsonl, no rows, no recorded paths); expected a run folder"
            )
        self.rows = read_rows(self.tables, check_rows) if self.tables else pa.table({})
        self.swept = set(self.rows.column_names) >= SWEPT and len(self._cells()) > 1
        """Learned runs of several cells or seeds."""

    def _cells(self) -> set[tuple[Any, ...]]:
        columns = [self.rows[name].to_pylist() for name in ("robot", "algorithm", "k_int", "seed", "policy")]
        return {row[:4] for row in zip(*columns, strict=True) if row[4] == "learned"}

    def facts(self, run: Path) -> tuple[tuple[str, str, float], int] | None:
        """(cell, seed) of a run folder; None where it does not say."""
        try:
            kept = json.loads(regular(run / "summary.json").read_text())
            return (kept["robot"], kept["algorithm"], float(kept["k_int"])), int(kept["seed"])
        except (OSError, ValueError, KeyError, TypeError):
            return None


def figures_of(results: Path, split: str | None = "auto") -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Every picture that the files under a folder give: (name, how to draw it).

    Args:
        results: a run folder, a sweep's folder, or any folder of their files.
        split: train or test scenes, None for all, auto: test where there are rows of them.
    """
    found = Results(results)
    facts = {run: known for run in found.curves if (known := found.facts(run))}
    if found.swept:
        yield from _of_sweep(found, chosen_split(found.rows, split))
    if len({seed_of for seed_of in facts.values()}) > 1:
        cells: dict[tuple[str, str, float], list[Any]] = {}
        for run, (cell, _) in facts.items():
            cells.setdefault(cell, []).append(found.curves[run])
        yield "learning_curves", lambda: cell_curves(cells)
    elif found.curves:
        yield "learning_curves", lambda: learning_curves({run.name: lines for run, lines in found.curves.items()})
    if found.swept:
        return
    for path in found.tables:
        rows = read_rows([path]).to_pydict()
        if {"policy", "path_efficiency", "effort_efficiency"} <= rows.keys() and rows["policy"]:
            scenes = ", ".join(dict.fromkeys(rows["scene"]))
            episodes = len(rows["policy"]) // len(set(rows["policy"]))
            title = f"{scenes}, {episodes} episodes a policy"
            yield f"frontier_{_name(path)}", lambda rows=rows, title=title: frontier(rows, title)
    for path in found.records:
        paths = _paths(path)
        if paths is not None:
            yield f"trajectories_{_name(path)}", lambda paths=paths: trajectories(paths)


def chosen_split(rows: pa.Table, split: str | None) -> str | None:
    """`auto` as test, train or all, by what there are rows of."""
    if split != "auto":
        return split
    return next((name for name in ("test", "train") if run_means(rows, name)), None)


def _of_sweep(found: Results, split: str | None) -> Iterator[tuple[str, Callable[[], Figure]]]:
    rows, means = found.rows, run_means(found.rows, split)
    robots = sorted({run.robot for run in means}, reverse=True)
    for robot in robots:
        yield f"ins_over_alpha_{robot}", lambda robot=robot: ins_over_alpha(rows, robot, split)
        yield f"path_effort_{robot}", lambda robot=robot: efficiency_plane(rows, robot, split)
    if len(robots) > 1:
        yield "robots", lambda: robots_plane(rows, split)
    yield "effort_terms", lambda: effort_terms(rows, split)
    if run_means(rows, "train") and run_means(rows, "test"):
        yield "seen_unseen", lambda: seen_and_unseen(rows)
    groups: dict[tuple[str, str, int, str], dict[float, Path]] = {}
    runs = {r["run"]: r for r in _a_row_a_run(rows) if r["policy"] == "learned"}
    for path in found.records:
        name, _, asked = path.stem.rpartition("-")  # the same digest: the same episodes
        r = runs.get(name)
        if r is not None and path.parent.name == PATHS:
            groups.setdefault((r["robot"], r["algorithm"], r["seed"], asked), {})[r["k_int"]] = path
    drawn = set()
    for key, by_k_int in sorted(groups.items()):
        if key[:2] not in drawn and len(by_k_int) == max(len(g) for k, g in groups.items() if k[:2] == key[:2]):
            drawn.add(key[:2])
            yield f"trajectories_{key[0]}_{key[1]}", lambda chosen=by_k_int: _by_k_int(chosen)


def _a_row_a_run(rows: pa.Table) -> list[dict[str, Any]]:
    names = ("run", "policy", "robot", "algorithm", "seed", "k_int")
    if not set(names) <= set(rows.column_names):
        return []
    return rows.select(names).group_by(list(names)).aggregate([]).to_pylist()


def _by_k_int(by_k_int: dict[float, Path]) -> Figure:
    records = {f"k_int = {k:g}": paths for k, path in sorted(by_k_int.items()) if (paths := _paths(path)) is not None}
    paths = side_by_side(records)
    return trajectories(paths, episodes=spread_episodes(paths, EPISODES_DRAWN))


def _paths(path: Path) -> dict[str, np.ndarray] | None:
    with read_npz(path, FileError, "evaluate the run again") as stored:
        first = f"{stored['policies'][0]}/goal_xy_w" if "policies" in stored.files else ""
        return dict(stored) if first and len(stored[first]) else None


def _name(path: Path) -> str:
    return path.parent.parent.name if path.parent.name == "evaluation" else path.stem


def parser() -> argparse.ArgumentParser:
    """The command line."""
    return program(Path(__file__).parents[1] / "words.yaml", "figures")


@reports_errors("train.figures")
def main(argv: Sequence[str] | None = None) -> int:
    """Draws; 0 when done, 2 on a user's error."""
    arguments = parser().parse_args(argv)
    split = None if arguments.split == "all" else arguments.split
    if arguments.tables:
        found = Results(Path(arguments.results))
        if not set(found.rows.column_names) >= SWEPT:
            raise FileError(
                f"{arguments.results}: no rows of policies; evaluate some first (python -m train.sweep FILE "
                "--only evaluate, or python -m train.evaluate)"
            )
        print(document(found.rows, chosen_split(found.rows, split)), end="")
        return 0
    drawn = False
    for name, draw in figures_of(Path(arguments.results), split):
        path = Path(arguments.out) / f"{name}.{arguments.format}"
        with style.plt.rc_context(style.RC):
            style.save(draw(), path, arguments.format)
        print(path)
        drawn = True
    if not drawn:
        raise FileError(f"{arguments.results}: nothing to draw (no rows and no recorded paths); expected a run folder")
    return 0
