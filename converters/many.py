"""Convert raw folders, and generate sets of scenes, in parallel and resumably, on one machine or several.

Each source and each scene has a process: if it is killed, no other is lost.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from converters.clock import STAGES, Report, peak_memory_mib
from converters.generate.homes.config import GenerationError
from converters.pipeline import ConvertConfig, Converted, convert_building
from converters.read.source import root_of
from converters.recipes import Recipes, chosen, load_recipes, make_scenes, parse_recipes
from converters.records.errors import StageFailed
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError, FileError, UserError, readable, typed
from interactive_nav_common.files import check_name, write_text
from interactive_nav_common.jobs.processes import LOST, Job, Launcher, run_jobs
from interactive_nav_common.rows import write_parquet
from interactive_nav_common.signals import interrupts_heard
from scenes_mjcf import sets
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
    """Convert sources that have no result with these options yet, and write each one's row when it ends.

    Return the names of all sources without a scene or with a failed gate.
    """
    named: dict[str, Path] = {}
    for source in sources:
        name = source.stem.removesuffix(".scene_instance") if source.is_file() else Path(os.path.abspath(source)).name
        check_name(name, f"--into: the name of {source}", ConfigError)
        if named.setdefault(name, source) is not source:
            raise ConfigError(f"--into: two sources are named {name}, expected one; rename a folder")
    path = into / ROWS
    with readable(path, FileError, "remove it to convert all again", " as Parquet"):
        rows = {row["name"]: row for row in (pq.read_table(path).to_pylist() if path.is_file() else [])}
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
                line = row.get("error")
                if line is None:
                    failed = ", ".join(row["gates_failed"])
                    verdict = f"gates that fail: {failed}" if failed else "every gate passes"
                    line = f"{row['area_m2']:.1f} m² traversable in {row['seconds']:.0f} s, {verdict}"
                log(f"{name}: {line}")
                bad += [name] if code else []
    return bad


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


RECIPES = "recipes.yaml"
SEEDS = 100_000
"""First seed of a set where none is given; scenes that are committed have smaller ones."""
TEST_SHARE = 0.2
CONVERSION = {"structure_faces": 16000, "object_faces": 3000, "structure_texture": 1024, "object_texture": 256}
"""How large meshes and textures are."""
GRACE_S = 10.0
"""A process that is not wanted any more has this long to end itself."""


def begin_set(out: Path, tier: str, count: int, seed: int = SEEDS) -> None:
    """Write a set's recipes, unless they are there: the last fifth is to test in, with held-out CAD models."""
    if count < 1:
        raise GenerationError(f"count is {count}, expected at least 1")
    first_test = count - round(TEST_SHARE * count)
    scenes = {
        f"{tier}_{k:03d}": {"split": "test" if k >= first_test else "train", "seed": seed + k, "tier": tier}
        for k in range(count)
    }
    data = {"conversion": CONVERSION, "scenes": scenes}
    parse_recipes(data, f"tier {tier}")
    text, path = yaml.safe_dump(data, sort_keys=False), out / RECIPES
    if path.is_file() and path.read_text(encoding="utf-8") != text:
        raise GenerationError(
            f"{path} holds other recipes than {count} of tier {tier} from seed {seed}; name another folder, or leave "
            "--tier and --count out to go on with those that are there"
        )
    out.mkdir(parents=True, exist_ok=True)
    write_text(path, text)


def list_set(recipes: Recipes, out: Path, log: Callable[[str], None] = lambda line: None) -> sets.SceneSet:
    """Write `set.json`: the set's scenes and their digests; report and keep a listed digest that differs."""
    path = out / sets.FILE
    members = dict(sets.read_set(path).scenes) if path.is_file() else {}
    for recipe in recipes.scenes:
        listed = members.get(recipe.name, sets.Member(recipe.split, recipe.seed))
        if (out / recipe.name / "scene.json").is_file():
            digest = sets.scene_digest(out / recipe.name)
            if listed.digest not in ("", digest):
                log(f"{recipe.name}: not the scene that {path} lists")
            else:
                measures = load_manifest(out / recipe.name).measures
                listed = dataclasses.replace(listed, digest=digest, measures=measures)
        members[recipe.name] = listed
    tiers = {recipe.building.tier for recipe in recipes.scenes}
    scenes = sets.SceneSet(tiers.pop() if len(tiers) == 1 else "mixed", members)
    sets.write_set(scenes, path)
    return scenes


def make_launcher(launcher: str, address: str | None, jobs: int, count: int) -> tuple[Launcher, int]:
    """Return where `count` commands run, and how many of them side by side."""
    if launcher == "ray":
        from interactive_nav_common.jobs.on_ray import RayLauncher

        return RayLauncher(address or "auto"), max(count, 1)
    return Launcher(jobs), jobs


def run_commands(
    commands: Mapping[str, list[str]], launcher: Launcher, folder: Path, report: Report, what: str
) -> Generator[tuple[str, int, str], None, None]:
    """Run commands in parallel and yield each one's name, exit code and output; closing the generator ends them."""
    folder.mkdir(parents=True, exist_ok=True)
    report(f"0/{len(commands)} {what}", 0.0)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".jobs-") as logs:
        jobs = (Job(name, tuple(words), Path(logs, name).absolute()) for name, words in commands.items())
        with contextlib.closing(run_jobs(launcher, jobs, GRACE_S)) as results:
            for done, (job, code) in enumerate(results, 1):
                printed = job.log.read_text(errors="replace").partition("\n")[2] if code != LOST else "lost"
                yield job.name, -1 if code == LOST else code, printed
                report(f"{done}/{len(commands)} {what}", done / len(commands))


def generate_scenes(wanted: Any, report: Report, log: Callable[[str], None]) -> list[str]:
    """Generate and list missing scenes of a `GenerateScenes` command; return the names of those that fail."""
    if wanted.tier and wanted.count is not None and wanted.seed is not None:
        begin_set(wanted.out, wanted.tier, wanted.count, wanted.seed)
    path = wanted.recipes or wanted.out / RECIPES
    recipes = load_recipes(path)
    todo = chosen(recipes, wanted.out, wanted.only, wanted.overwrite, log)
    if len(todo) > 1 and (wanted.jobs > 1 or wanted.launcher == "ray"):
        launcher, _ = make_launcher(wanted.launcher, wanted.ray_address, wanted.jobs, len(todo))
        words = [sys.executable, "-m", "converters", "generate-scenes", str(wanted.out), "--recipes", str(path)]
        words += ["--jobs", "1", *(["--overwrite"] if wanted.overwrite else []), "--only"]
        commands, failed = {recipe.name: [*words, recipe.name] for recipe in todo}, []
        with contextlib.closing(run_commands(commands, launcher, wanted.out, report, "scenes")) as results:
            for name, code, printed in results:
                lines = [line.removeprefix("error: ") for line in printed.splitlines()]
                killed = f"{name}: exit code {code}, {printed.strip()[-200:]}"
                log(next((line for line in lines if line.startswith(f"{name}: ")), killed))
                failed += [name] if code else []
    else:
        gates = make_scenes(todo, recipes.conversion, wanted.out, wanted.overwrite, wanted.jobs, report, log)
        failed = [name for name, failing in gates.items() if failing]
    if not wanted.only and (wanted.tier or (wanted.out / sets.FILE).is_file()):
        list_set(recipes, wanted.out, log)
    return failed


def make_packaged(
    names: Sequence[str], wanted_set: Callable[..., Any], report: Report, log: Callable[[str], None]
) -> list[str]:
    """Generate scenes of the package's sets in the cache folder, unless the package has them.

    Cached folders with other scenes than the listed ones are replaced. Return the names of scenes that fail, miss a
    gate, or differ from the set's list.
    """
    scenes = {name: sets.packaged_set(name).scenes for name in sets.PACKAGED}
    words = [word for name, members in scenes.items() for word in (name, f"{name}/train", f"{name}/test", *members)]
    for word in (word for word in names if word not in words):
        raise GenerationError(f"no scene or set {word!r}{nearest(word, words)}; see 'python -m converters scenes list'")
    failed: list[str] = []
    for name, folder in sets.PACKAGED.items():
        members = scenes[name]
        named = [n for n, m in members.items() if {n, name, f"{name}/{m.split}"} & set(names)]
        wanted = {n: members[n] for n in named if not (folder / n / "scene.json").is_file()}
        for scene in (n for n in named if n not in wanted):
            log(f"{scene}: is there, {folder / scene}")
        out = sets.in_cache(folder)
        todo = tuple(n for n, m in wanted.items() if not sets.is_listed(out / n, m))
        others = [n for n in todo if (out / n).exists()]
        for scene in (n for n in wanted if n not in todo):
            log(f"{scene}: is there, {out / scene}")
        for scene in others:
            log(f"{scene}: in the cache is not the scene that the set {name} lists; made again")
        if not todo:
            continue
        if not (folder / RECIPES).is_file():
            log(f"{', '.join(todo)}: an earlier version of the generator wrote these scenes; the repository has them")
            failed += todo
            continue
        rest = wanted_set(out=out, recipes=folder / RECIPES, only=todo, overwrite=bool(others))
        failed += generate_scenes(rest, report, log)
        for scene in (n for n in todo if n not in failed and not sets.is_listed(out / n, wanted[n])):
            command = f"python -m converters generate-scenes FOLDER --recipes {typed(folder / RECIPES)} --only {scene}"
            log(f"{scene}: not the scene that the set {name} lists; as a scene of your own: {command}")
            failed.append(scene)
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
