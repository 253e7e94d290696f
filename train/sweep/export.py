"""Export rows (as one compact file), thinned curves, origins and the best checkpoints from a sweep's folder."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import whole_file, writing
from interactive_nav_common.records import PACKED_METRICS, mean_over_episodes, read_metrics, write_metrics
from interactive_nav_common.rows import read_notes, read_rows, write_parquet
from train.runs import STEP, checkpoint
from train.runs.checkpoint import CheckpointError
from train.runs.run_folder import PATHS, RunFolder, paths_beside
from train.scoring.statistics import run_means
from train.sweep.folder import SweepFolder
from train.sweep.spec import RunSpec

CURVE_LINES = 30
"""Lines of metrics that an exported run keeps."""
KEPT = ("env_steps", "wall_s", "env_steps_per_s", "episodes")
FILES = ("config.yaml", "versions.json", "summary.json")
ROWS = "episodes.parquet"
STEPS = {
    **dict.fromkeys(("path_efficiency", "effort_efficiency", "ins_0.5", "kinematic_effort", "dynamic_effort"), 2**-10),
    **dict.fromkeys(("robot_path_m", "displacement_m", "object_displacement_kg_m"), 2**-7),
    **dict.fromkeys(("reward/potential", "reward/interaction"), 2**-6),
    **dict.fromkeys(("evaluation_wall_s", "train_wall_s"), 2**-6),
    "shortest_path_m": 2**-9,
    "force_sum_n": 8,
}
"""Column, or field of a nested one -> what exported rows are rounded to multiples of."""
ORDER = ("robot", "split", "scene", "episode", "algorithm", "k_int", "seed")
"""Of exported rows: what an episode's runs have in common stands together, and takes a tenth less."""
UNSEEN_ONLY = {"by_category", "force_sum_n", "object_displacement_kg_m", "reward/potential", "reward/interaction"}


def export(folder: SweepFolder, out: Path, step: float = STEP) -> tuple[int, dict[tuple[Any, ...], str]]:
    """Copy a sweep's results over earlier ones of the same runs.

    Return the total bytes, and by cell the run whose checkpoint was kept: the highest mean INS_0.5, on test scenes if
    any.
    """
    runs = [run for run in folder.sweep.runs if (folder.runs / run.name / "metrics.jsonl").is_file()]
    if not runs:
        raise FileError(
            f"{folder.root}: no run of the sweep has started there; start it with the same command without --export"
        )
    with writing(out, "make room"):
        _merge_rows(folder, out / "rows")
        for run in runs:
            source, target = RunFolder(folder.runs / run.name), out / "runs" / run.name
            target.mkdir(parents=True, exist_ok=True)
            for name in FILES:
                if (source.path / name).is_file():
                    shutil.copy2(source.path / name, target / name)
            lines = thinned(read_metrics(source.metrics), CURVE_LINES)
            write_metrics(target / PACKED_METRICS, lines)
            shutil.rmtree(target / "checkpoints", ignore_errors=True)
        best = best_runs(folder, runs)
        for name in best.values():  # the policy of the checkpoint that was evaluated
            try:
                path, _ = checkpoint.find(folder.runs / name / "checkpoints", folder.sweep.config.evaluate.checkpoint)
            except CheckpointError:
                continue
            checkpoint.keep_policy(path, out / "runs" / name / "checkpoints" / path.name, step)
    return sum(path.stat().st_size for path in out.rglob("*") if path.is_file()), best


def _merge_rows(folder: SweepFolder, out: Path) -> None:
    """Merge the sweep's rows, and those of other runs in `out`, into one file, with paths beside it."""
    new = sorted(path for path in folder.rows.glob("*.parquet") if not path.name.startswith("."))
    if not new:
        return
    out.mkdir(parents=True, exist_ok=True)
    rows = without_train_details(rounded(read_rows(new)))
    replaced = {name for name in rows["run"].unique().to_pylist() if name}
    old = sorted(out.glob("*.parquet"))
    if old:
        kept = read_rows(old)
        others = pa.array([name not in replaced for name in kept["run"].to_pylist()])
        rows = pa.concat_tables([kept.filter(others), rows], promote_options="permissive")
    requests = {note for path in (*old, *new) for note in read_notes(path).get("asked", "").splitlines()}
    # Paths, then rows, then what is no longer wanted: rows are never without paths as new as they.
    paths = [paths_beside(path) for path in new if paths_beside(path).is_file()]
    for path in paths:
        with whole_file(out / PATHS / path.name) as partial:
            shutil.copy2(path, partial)
    rows = rows.sort_by([(name, "ascending") for name in ORDER if name in rows.column_names])
    write_parquet(rows, out / ROWS, {"asked": "\n".join(sorted(requests))} if requests else None, small=True)
    for path in old:
        if path.name != ROWS:
            path.unlink()
    for path in out.glob("_paths/*.npz"):
        if path.stem.rpartition("-")[0] in replaced and path.name not in {wanted.name for wanted in paths}:
            path.unlink()


def without_train_details(rows: pa.Table) -> pa.Table:
    """Return rows with `UNSEEN_ONLY` in test scenes only, if there are any: no table has the others, 44 % of a file."""
    if "split" not in rows.column_names or not pc.any(test := pc.equal(rows["split"], "test")).as_py():
        return rows
    places = pc.if_else(test, pa.array(range(len(rows))), None)
    for name in UNSEEN_ONLY & set(rows.column_names):
        rows = rows.set_column(rows.column_names.index(name), name, rows[name].take(places))
    return rows


def rounded(rows: pa.Table) -> pa.Table:
    """Return rows with numbers as multiples of `STEPS`; what is rounded already stays as it is."""
    return pa.table({name: _rounded(name, rows[name].combine_chunks()) for name in rows.column_names})


def _rounded(name: str, values: Any) -> pa.Array:
    kind = values.type
    if pa.types.is_list(kind):
        return pa.ListArray.from_arrays(values.offsets, _rounded(name, values.values), kind, mask=values.is_null())
    if pa.types.is_struct(kind):
        fields = [_rounded(field.name, values.field(field.name)) for field in kind]
        return pa.StructArray.from_arrays(fields, fields=list(kind), mask=values.is_null())
    return pc.round_to_multiple(values, STEPS[name]) if name in STEPS and pa.types.is_floating(kind) else values


def best_runs(folder: SweepFolder, runs: Sequence[RunSpec]) -> dict[tuple[Any, ...], str]:
    """Return cell -> its run of the highest mean INS_0.5; cells without rows are left out."""
    paths = sorted(folder.rows.glob("*.parquet")) if folder.rows.is_dir() else []
    rows = read_rows(paths) if paths else pa.table({})
    if "policy" not in rows.column_names:
        return {}
    means = {run.run: run.scores["ins_0.5"] for run in run_means(rows, "test") or run_means(rows)}
    best: dict[tuple[Any, ...], str] = {}
    for run in runs:
        if run.name in means and means[run.name] > means.get(best.get(run.cell, ""), float("-inf")):
            best[run.cell] = run.name
    return best


def thinned(lines: Sequence[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """Return at most this many lines of metrics, rounded, without losses; scores are means over their episodes."""
    size = -(-len(lines) // most)
    out = []
    for i in range(0, len(lines), max(size, 1)):
        group = lines[i : i + size]
        merged = {name: group[-1][name] for name in KEPT[:3] if name in group[-1]}
        merged["episodes"] = sum(line.get("episodes", 0.0) for line in group)
        for name in dict.fromkeys(name for line in group for name in line if name.startswith("episode/")):
            merged[name] = mean_over_episodes(group, name)
        out.append({name: value if isinstance(value, int) else float(f"{value:.5g}") for name, value in merged.items()})
    return out
