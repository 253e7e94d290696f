"""Convert raw folders side by side, resumable, to a scene folder and a row of `conversions.parquet` each.

Each source has a process (`python -m converters.many JSON`), which writes the source's row: one that fails or is killed
costs no other.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from converters.clock import STAGES, peak_memory_mib
from converters.pipeline import ConvertConfig, Converted, convert_building
from converters.read.source import root_of
from converters.records.errors import StageFailed
from converters.sets import run_commands
from interactive_nav_common.errors import ConfigError, FileError, UserError, readable
from interactive_nav_common.files import check_name, write_text
from interactive_nav_common.jobs.processes import Launcher
from interactive_nav_common.rows import write_parquet
from interactive_nav_common.signals import interrupts_heard
from scenes_mjcf.schema import SceneError, load_manifest

ROWS = "conversions.parquet"
SCHEMA = pa.schema(
    {
        **dict.fromkeys(("name", "source", "digest"), pa.string()),
        "exit_code": pa.int32(),  # 0 done, 1 a gate failed, 2 unusable, negative: ended by this signal
        "error": pa.string(),
        **dict.fromkeys(("scenes", "gates_passed", "gates_failed", "warnings"), pa.list_(pa.string())),
        "movables": pa.int32(),
        "area_m2": pa.float64(),  # traversable, of all floors
        **dict.fromkeys(("seconds", *(f"{stage}_s" for stage in STAGES)), pa.float64()),
        "peak_memory_mib": pa.float64(),  # of the process, then of the largest decomposition that it started
        "worker_memory_mib": pa.float64(),
    }
)


def digest_of(source: Path, config: ConvertConfig, scenes: Sequence[Path] = ()) -> str:
    """Return a digest of the options that a result depends on, and of the names, sizes and times of its input files."""
    roots = [root for root in (source, config.library) if root is not None]
    paths = [(root, path) for root in roots for path in (root, *sorted(root.rglob("*"))) if path.is_file()]
    if source.is_file():
        root, named = root_of(source), set()
        for scene in scenes:
            with contextlib.suppress(SceneError):  # a damaged one has no digest of before, so it is converted again
                named |= set(load_manifest(scene).source.get("sha256", {}))
        paths += [(root, root / name) for name in sorted(named) if (root / name).is_file()]
    files = [(os.path.relpath(p, root), p.stat().st_size, p.stat().st_mtime_ns) for root, p in paths]
    options = {**dataclasses.asdict(config), "jobs": 0, "overwrite": False, "library": config.library is not None}
    return hashlib.sha256(repr((options, files)).encode()).hexdigest()[:16]


def convert_many(
    sources: Sequence[Path], into: Path, config: ConvertConfig, launcher: Launcher, side_by_side: int,
    report: Callable[[str, float], None], log: Callable[[str], None],
) -> list[str]:  # fmt: skip
    """Convert what has not been converted with these options; the row of each is written as it ends.

    Return the names of the sources without a scene, or with a gate that fails, whether tried now or before.
    """
    named = _named(sources)
    path = into / ROWS
    rows = {row["name"]: row for row in _rows(path)}
    jobs = max(1, config.jobs // side_by_side)
    commands, digests, bad = {}, {}, []
    into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=into, prefix=".rows-") as folder:
        for name, source in named.items():
            old = rows.get(name)
            scenes = [Path(into, scene) for scene in (old and old["scenes"]) or ()]
            ours = bool(scenes) and all(scene.is_dir() for scene in scenes)
            digests[name] = digest_of(source, config, scenes)
            same = old and ours and old["digest"] == digests[name] and old["exit_code"] in (0, 1)
            if old and same and not config.overwrite:
                log(f"{name}: is there, kept")
                bad += [name] if old["exit_code"] else []
                continue
            choices = {**dataclasses.asdict(config), "jobs": jobs, "overwrite": config.overwrite or ours}
            task = {"source": source, "target": into / name, "config": choices, "row": Path(folder, name)}
            commands[name] = [sys.executable, "-m", "converters.many", json.dumps(task, default=str)]

        with contextlib.closing(run_commands(commands, launcher, into, report, "sources")) as results:
            for name, code, printed in results:
                row_path = Path(folder, name)
                killed = f"killed by signal {-code}" if code < -1 else f"exit code {code}, {printed[-200:].strip()}"
                row = json.loads(row_path.read_text(encoding="utf-8")) if row_path.is_file() else {"error": killed}
                scenes = (rows.get(name) or {}).get("scenes")  # of before: they still stand
                rows[name] = {"scenes": scenes, "name": name, "source": str(named[name]), "exit_code": code, **row}
                new = [Path(into, scene) for scene in row.get("scenes") or ()]
                rows[name]["digest"] = digest_of(named[name], config, new) if new else digests[name]
                write_parquet(pa.Table.from_pylist(list(rows.values()), SCHEMA), path)
                log(_line(rows[name]))
                bad += [name] if code else []
    return bad


def _line(row: Mapping[str, Any]) -> str:
    """Return a conversion's row as one line."""
    if row.get("error") is not None:
        return f"{row['name']}: {row['error']}"
    gates = ", ".join(row["gates_failed"])
    verdict = f"gates that fail: {gates}" if gates else "every gate passes"
    return f"{row['name']}: {row['area_m2']:.1f} m² traversable in {row['seconds']:.0f} s, {verdict}"


def _named(sources: Sequence[Path]) -> dict[str, Path]:
    names = [
        source.stem.removesuffix(".scene_instance")
        if source.is_file()
        else os.path.abspath(source).rpartition(os.sep)[2]
        for source in sources
    ]
    for name, source in zip(names, sources, strict=True):
        check_name(name, f"--into: the name of {source}", ConfigError)
        if names.count(name) > 1:
            raise ConfigError(f"--into: two sources are named {name}, expected one; rename a folder")
    return dict(zip(names, sources, strict=True))


def _rows(path: Path) -> list[dict[str, Any]]:
    with readable(path, FileError, "remove it to convert all again", " as Parquet"):
        return pq.read_table(path).to_pylist() if path.is_file() else []


def measured(results: Sequence[Converted], seconds: float) -> dict[str, Any]:
    """Return the row of a conversion in this process; gates carry the scene's name where there are several scenes."""
    gates = [(g.name if len(results) == 1 else f"{r.folder.name}/{g.name}", g.passed) for r in results for g in r.gates]
    return {
        "scenes": [r.folder.name for r in results],
        "gates_passed": [name for name, passed in gates if passed],
        "gates_failed": [name for name, passed in gates if not passed],
        "warnings": list(dict.fromkeys(w for r in results for w in r.manifest.warnings)),
        "movables": sum(len(r.manifest.objects) for r in results),
        "area_m2": sum(r.manifest.floor_area_m2 for r in results),
        "seconds": seconds,
        **{f"{stage}_s": value for stage, value in results[0].stage_s.items()},
        "peak_memory_mib": peak_memory_mib(),
        "worker_memory_mib": max(r.worker_mib for r in results),
    }


@interrupts_heard()  # so that what is unfinished is removed
def main(task: str) -> int:
    """Convert one source and write its row; return the exit code of `python -m converters convert`."""
    words, start_s, code = json.loads(task), time.monotonic(), 2
    config = words["config"]
    places = {word: Path(config[word]) if config[word] else None for word in ("library", "root")}
    config = ConvertConfig(**{**config, **places})
    try:
        results = convert_building(Path(words["source"]), Path(words["target"]), config)
        row = measured(results, time.monotonic() - start_s)
        code = 1 if row["gates_failed"] else 0
    except (UserError, StageFailed, OSError) as error:
        row = {"error": " ".join(str(error).split()), "seconds": time.monotonic() - start_s}
    write_text(words["row"], json.dumps(row))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
