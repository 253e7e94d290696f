"""Draw what the files under a folder of results give: metrics, rows and recorded paths."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from interactive_nav_common.errors import FileError, regular
from interactive_nav_common.figures import Figure
from interactive_nav_common.records import METRICS, PACKED_METRICS, read_metrics
from interactive_nav_common.rows import read_rows
from interactive_nav_common.untrusted.reading import read_npz
from train.figures.curves import cell_curves, learning_curves
from train.figures.paths import side_by_side, spread_episodes, trajectories
from train.figures.scores import efficiency_plane, effort_terms, frontier, ins_over_alpha, robots_plane, seen_and_unseen
from train.runs.run_folder import PATHS
from train.scoring.rows import check_rows
from train.scoring.statistics import run_means

SWEPT = {"run", "robot", "algorithm", "k_int", "seed", "policy", "split", "kinematic_effort", "dynamic_effort"}
EPISODES_DRAWN = 6


class Results:
    """The files under a folder of results, by their content."""

    def __init__(self, root: Path):
        self.root = root
        files = [root] if root.is_file() else sorted(root.rglob("*.*"))
        # Names with a dot in front are of unfinished files.
        files = [path for path in files if not path.name.startswith(".")]
        logs = [path for path in files if path.name in (METRICS, PACKED_METRICS)]
        self.curves = {log.parent: lines for log in logs if (lines := read_metrics(log))}
        records = [path for path in files if path.suffix == ".npz" and "checkpoints" not in path.parts]
        self.records = [path for path in records if not path.parent.name.startswith("diverged-")]
        self.tables = [path for path in files if path.suffix == ".parquet"]
        if not self.curves and not self.records and not self.tables:
            raise FileError(f"{root}: nothing to draw: no metrics.jsonl, rows or recorded paths; expected a run folder")
        self.rows = read_rows(self.tables, check_rows) if self.tables else pa.table({})
        runs = run_means(self.rows) if set(self.rows.column_names) >= SWEPT else []
        self.swept = len({(run.cell, run.seed) for run in runs}) > 1
        """Learned runs of several cells or seeds."""

    def facts(self, run: Path) -> tuple[tuple[str, str, float], int] | None:
        """Return (cell, seed) of a run folder; None where it does not say."""
        try:
            kept = json.loads(regular(run / "summary.json").read_text())
            return (kept["robot"], kept["algorithm"], float(kept["k_int"])), int(kept["seed"])
        except (OSError, ValueError, KeyError, TypeError):
            return None


def figures_of(results: Path | Results, split: str | None = "auto") -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Yield (name, how to draw it) for every picture of a folder or file; `split`: train, test, None (all) or auto."""
    files = results if isinstance(results, Results) else Results(results)
    facts = {run: fact for run in files.curves if (fact := files.facts(run))}
    if files.swept:
        yield from _of_sweep(files, chosen_split(files.rows, split))
    if len({seed_of for seed_of in facts.values()}) > 1:
        cells: dict[tuple[str, str, float], list[Any]] = {}
        for run, (cell, _) in facts.items():
            cells.setdefault(cell, []).append(files.curves[run])
        yield "learning_curves", lambda: cell_curves(cells)
    elif files.curves:
        yield "learning_curves", lambda: learning_curves({run.name: lines for run, lines in files.curves.items()})
    if files.swept:
        return
    for path in files.tables:
        rows = read_rows([path]).to_pydict()
        if {"policy", "path_efficiency", "effort_efficiency"} <= rows.keys() and rows["policy"]:
            scenes = ", ".join(dict.fromkeys(rows["scene"]))
            episodes = len(rows["policy"]) // len(set(rows["policy"]))
            title = f"{scenes}, {episodes} episodes a policy"
            yield f"frontier_{_name(path)}", lambda rows=rows, title=title: frontier(rows, title)
    for path in files.records:
        paths = _paths(path)
        if paths is not None:
            yield f"trajectories_{_name(path)}", lambda paths=paths: trajectories(paths)


def chosen_split(rows: pa.Table, split: str | None) -> str | None:
    """Return `auto` as test, train or all, by the rows that there are."""
    if split != "auto":
        return split
    return next((name for name in ("test", "train") if run_means(rows, name)), None)


def _of_sweep(files: Results, split: str | None) -> Iterator[tuple[str, Callable[[], Figure]]]:
    rows, means = files.rows, run_means(files.rows, split)
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
    runs = {run.run: run for run in run_means(rows)}
    for path in files.records:
        name, _, request = path.stem.rpartition("-")  # the same digest: the same episodes
        if name in runs and path.parent.name == PATHS:
            run = runs[name]
            groups.setdefault((run.robot, run.algorithm, run.seed, request), {})[run.k_int] = path
    drawn = set()
    for key, by_k_int in sorted(groups.items()):
        if key[:2] not in drawn and len(by_k_int) == max(len(g) for k, g in groups.items() if k[:2] == key[:2]):
            drawn.add(key[:2])
            yield f"trajectories_{key[0]}_{key[1]}", lambda chosen=by_k_int: _by_k_int(chosen)


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
