"""Generate sets of scene folders side by side, resumable, on this machine or on many.

Each scene has a process (`generate-scenes --only NAME`), so that one that fails costs no other, and so that any machine
that reaches the folder can run it.
"""

import contextlib
import dataclasses
import sys
import tempfile
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path

import yaml

from converters.clock import Report
from converters.generate.design.config import GenerationError
from converters.recipes import Recipes, chosen, load_recipes, make_scenes, parse_recipes
from interactive_nav_common.config import nearest
from interactive_nav_common.files import write_text
from interactive_nav_common.jobs.processes import LOST, Job, Launcher, LocalLauncher, run_jobs
from scenes_mjcf.schema import load_manifest
from scenes_mjcf.sets import (
    FILE,
    PACKAGED,
    Member,
    SceneSet,
    in_cache,
    is_listed,
    packaged_set,
    read_set,
    scene_digest,
    write_set,
)

RECIPES = "recipes.yaml"
SEEDS = 100_000
"""First seed of a set where none is given; scenes that are committed have smaller ones."""
TEST_SHARE = 0.2
CONVERSION = {"structure_faces": 16000, "object_faces": 3000, "structure_texture": 1024, "object_texture": 256}
"""How large meshes and textures are."""
GRACE_S = 10.0
"""A process that is not wanted any more has this long to end itself."""


@dataclasses.dataclass(frozen=True)
class Wanted:
    """Words of `python -m converters generate-scenes`."""

    out: Path
    recipes: Path | None
    tier: str | None
    count: int | None
    seed: int | None
    only: Sequence[str]
    overwrite: bool
    jobs: int
    launcher: str
    ray_address: str | None


def tier_recipes(tier: str, count: int, seed: int = SEEDS) -> str:
    """Return the YAML of a set's recipes: the last fifth of its scenes is to test in, with held-out CAD models."""
    if count < 1:
        raise GenerationError(f"count is {count}, expected at least 1")
    first_test = count - round(TEST_SHARE * count)
    scenes = {
        f"{tier}_{k:03d}": {"split": "test" if k >= first_test else "train", "seed": seed + k, "tier": tier}
        for k in range(count)
    }
    data = {"conversion": CONVERSION, "scenes": scenes}
    parse_recipes(data, f"tier {tier}")
    return yaml.safe_dump(data, sort_keys=False)


def begin_set(out: Path, tier: str, count: int, seed: int = SEEDS) -> None:
    """Write a set's recipes, unless they are there."""
    text, path = tier_recipes(tier, count, seed), out / RECIPES
    if path.is_file() and path.read_text(encoding="utf-8") != text:
        raise GenerationError(
            f"{path} holds other recipes than {count} of tier {tier} from seed {seed}; name another folder, or leave "
            "--tier and --count out to go on with those that are there"
        )
    out.mkdir(parents=True, exist_ok=True)
    write_text(path, text)


def list_set(recipes: Recipes, out: Path, log: Callable[[str], None] = lambda line: None) -> SceneSet:
    """Write `set.json` beside the scenes: which there are to be, and the digests of those that are there.

    A scene whose digest is not the one that the file already lists is reported and stays listed as it was: generated
    elsewhere, it should be the same up to rounding.
    """
    path = out / FILE
    members = dict(read_set(path).scenes) if path.is_file() else {}
    for recipe in recipes.scenes:
        listed = members.get(recipe.name, Member(recipe.split, recipe.seed))
        if (out / recipe.name / "scene.json").is_file():
            digest = scene_digest(out / recipe.name)
            if listed.digest not in ("", digest):
                log(f"{recipe.name}: not the scene that {path} lists")
            else:
                measures = load_manifest(out / recipe.name).measures
                listed = dataclasses.replace(listed, digest=digest, measures=measures)
        members[recipe.name] = listed
    tiers = {recipe.tier for recipe in recipes.scenes}
    scenes = SceneSet(tiers.pop() if len(tiers) == 1 else "mixed", members)
    write_set(scenes, path)
    return scenes


def make_launcher(launcher: str, address: str | None, jobs: int, count: int) -> tuple[Launcher, int]:
    """Return where `count` commands run, and how many of them side by side."""
    if launcher == "ray":
        from interactive_nav_common.jobs.on_ray import RayLauncher

        return RayLauncher(address or "auto"), max(count, 1)
    return LocalLauncher(jobs), jobs


def _last_line(name: str, code: int, printed: str) -> str:
    lines = [line for line in printed.splitlines() if line.startswith((f"{name}:", "converters"))]
    return lines[-1] if lines else f"{name}: exit code {code}, {printed.strip()[-200:]}"


def run_commands(
    commands: Mapping[str, list[str]], launcher: Launcher, folder: Path, report: Report, what: str
) -> Generator[tuple[str, int, str], None, None]:
    """Run commands, several at a time; yield the name, exit code and output of each as it ends.

    Closed early, by a signal or an error, it ends what runs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    report(f"0/{len(commands)} {what}", 0.0)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".jobs-") as logs:
        jobs = (Job(name, tuple(words), Path(logs, name).absolute()) for name, words in commands.items())
        with contextlib.closing(run_jobs(launcher, jobs, GRACE_S)) as results:
            for done, (job, code) in enumerate(results, 1):
                printed = job.log.read_text(errors="replace").partition("\n")[2] if code != LOST else "lost"
                yield job.name, -1 if code == LOST else code, printed
                report(f"{done}/{len(commands)} {what}", done / len(commands))


def generate_scenes(wanted: Wanted, report: Report, log: Callable[[str], None]) -> list[str]:
    """Generate and list the scenes that are not there yet; return the names of those that fail, or fail a gate."""
    if wanted.tier and wanted.count is not None and wanted.seed is not None:
        begin_set(wanted.out, wanted.tier, wanted.count, wanted.seed)
    path = wanted.recipes or wanted.out / RECIPES
    recipes = load_recipes(path)
    todo = chosen(recipes, wanted.out, tuple(wanted.only), wanted.overwrite, log)
    if len(todo) > 1 and (wanted.jobs > 1 or wanted.launcher == "ray"):
        launcher, _ = make_launcher(wanted.launcher, wanted.ray_address, wanted.jobs, len(todo))
        words = [sys.executable, "-m", "converters", "generate-scenes", str(wanted.out), "--recipes", str(path)]
        words += ["--jobs", "1", *(["--overwrite"] if wanted.overwrite else []), "--only"]
        commands, failed = {r.name: [*words, r.name] for r in todo}, []
        with contextlib.closing(run_commands(commands, launcher, wanted.out, report, "scenes")) as results:
            for name, code, printed in results:
                log(_last_line(name, code, printed))
                failed += [name] if code else []
    else:
        gates = make_scenes(todo, recipes.conversion, wanted.out, wanted.overwrite, wanted.jobs, report, log)
        failed = [name for name, failing in gates.items() if failing]
    if not wanted.only and (wanted.tier or (wanted.out / FILE).is_file()):
        list_set(recipes, wanted.out, log)
    return failed


def make_packaged(names: Sequence[str], jobs: int, report: Report, log: Callable[[str], None]) -> list[str]:
    """Generate scenes of the package's sets in the cache folder, unless the package has them.

    Replace cached folders that hold a scene other than the listed one. Return the names of scenes that fail, miss a
    gate, or differ from the set's list.
    """
    sets = {name: packaged_set(name).scenes for name in PACKAGED}
    words = [word for name, members in sets.items() for word in (name, f"{name}/train", f"{name}/test", *members)]
    for word in (word for word in names if word not in words):
        raise GenerationError(f"no scene or set {word!r}{nearest(word, words)}; 'scenes list' shows them")
    failed: list[str] = []
    for name, folder in PACKAGED.items():
        members = sets[name]
        named = [n for n, m in members.items() if {n, name, f"{name}/{m.split}"} & set(names)]
        wanted = {n: members[n] for n in named if not (folder / n / "scene.json").is_file()}
        for scene in (n for n in named if n not in wanted):
            log(f"{scene}: is there, {folder / scene}")
        out = in_cache(folder)
        todo = tuple(n for n, m in wanted.items() if not is_listed(out / n, m))
        others = [n for n in todo if (out / n).exists()]
        for scene in (n for n in wanted if n not in todo):
            log(f"{scene}: is there, {out / scene}")
        for scene in others:
            log(f"{scene}: in the cache is not the scene that the set {name} lists; made again")
        if not todo:
            continue
        rest = Wanted(out, folder / RECIPES, None, None, None, todo, bool(others), jobs, "local", None)
        failed += generate_scenes(rest, report, log)
        for scene in (n for n in todo if n not in failed and not is_listed(out / n, wanted[n])):
            command = f"python -m converters generate-scenes FOLDER --recipes {folder / RECIPES} --only {scene}"
            log(f"{scene}: not the scene that the set {name} lists; as a scene of your own: {command}")
            failed.append(scene)
    return failed
