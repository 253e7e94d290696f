"""A tier and a number in, a set of scene folders out: side by side, resumable, on this machine or on many.

Each scene is made by a process of its own (`generate-scenes --only NAME`), so that one that fails costs no other, and
so that any machine that sees the folder can make it.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol

import yaml

from converters.generate.design.config import GenerationError
from converters.recipes import Recipes, Report, chosen, load_recipes, make_scenes, parse_recipes
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import write_text
from scenes_mjcf.schema import load_manifest
from scenes_mjcf.sets import FILE, Member, SceneSet, read_set, scene_digest, write_set

RECIPES = "recipes.yaml"
SEEDS = 100_000
"""First seed of a set where none is given; scenes that are committed have smaller ones."""
TEST_SHARE = 0.2
CONVERSION = {"structure_faces": 16000, "object_faces": 3000, "structure_texture": 1024, "object_texture": 256}
"""How large meshes and textures are."""


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


class Runner(Protocol):
    """Where commands run."""

    def run(self, command: list[str]) -> tuple[int, str]:
        """Runs a command and waits for it: its exit code and what it printed."""
        ...

    def close(self) -> None:
        """Ends what still runs."""
        ...


def tier_recipes(tier: str, count: int, seed: int = SEEDS) -> str:
    """The YAML of a set's recipes: the last fifth of its scenes is to test in, with CAD models of its own.

    Raises:
        GenerationError: an unknown tier, or no scene.
    """
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
    """Writes a set's recipes, unless they are there.

    Raises:
        GenerationError: `out` holds other recipes.
    """
    text, path = tier_recipes(tier, count, seed), out / RECIPES
    if path.is_file() and path.read_text(encoding="utf-8") != text:
        raise GenerationError(
            f"{path} holds other recipes than {count} of tier {tier} from seed {seed}; name another folder, or leave "
            "--tier and --count out to go on with those that are there"
        )
    out.mkdir(parents=True, exist_ok=True)
    write_text(path, text)


def list_set(recipes: Recipes, out: Path, tell: Callable[[str], None] = lambda line: None) -> SceneSet:
    """Writes `set.json` beside the scenes: which there are to be, and the digests of those that were made.

    A scene whose digest is not the one that the file already lists is told of and stays listed as it was: made
    elsewhere, it should be the same up to rounding.
    """
    path = out / FILE
    members = dict(read_set(path).scenes) if path.is_file() else {}
    for recipe in recipes.scenes:
        listed = members.get(recipe.name, Member(recipe.split, recipe.seed))
        if (out / recipe.name / "scene.json").is_file():
            digest = scene_digest(out / recipe.name)
            if listed.digest not in ("", digest):
                tell(f"{recipe.name}: not the scene that {path} lists")
            else:
                measures = load_manifest(out / recipe.name).measures
                listed = dataclasses.replace(listed, digest=digest, measures=measures)
        members[recipe.name] = listed
    tiers = {recipe.tier for recipe in recipes.scenes}
    scenes = SceneSet(tiers.pop() if len(tiers) == 1 else "mixed", members)
    write_set(scenes, path)
    return scenes


class LocalRunner:
    """Commands as processes of this machine."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[str]] = set()
        self._closed = threading.Event()

    def run(self, command: list[str]) -> tuple[int, str]:
        """Runs a command and waits for it: its exit code and what it printed."""
        if self._closed.is_set():
            return -1, "stopped"
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self._running.add(process)
        printed, _ = process.communicate()
        self._running.discard(process)
        return process.returncode, printed

    def close(self) -> None:
        """Ends what still runs."""
        self._closed.set()
        for process in list(self._running):
            process.terminate()


class RayRunner:
    """Commands on a Ray cluster's machines, all of which see this folder.

    Args:
        address: of the cluster, as `ray.init` takes it.
        cpus: cores of each command.

    Raises:
        ConfigError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, address: str, cpus: int):
        try:
            import ray
        except ImportError:
            raise ConfigError("--launcher ray: Ray is not installed; pip install 'interactive-nav[ray]'") from None
        self._ray, self._mine, self._started = ray, not ray.is_initialized(), []
        if self._mine:
            try:
                ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
            except (ConnectionError, ValueError, RuntimeError) as error:
                first = next(iter(str(error).splitlines()), "")
                raise ConfigError(
                    f"--launcher ray: no cluster at {address!r} ({first}); start one with `ray start --head`"
                ) from None
        self._there: Any = ray.remote(num_cpus=cpus, max_retries=0)(_command)

    def run(self, command: list[str]) -> tuple[int, str]:
        """Runs a command and waits for it: its exit code and what it printed."""
        self._started.append(self._there.remote(command, os.getcwd()))
        try:
            return self._ray.get(self._started[-1])
        except self._ray.exceptions.RayError as error:
            return -1, f"lost: {next(iter(str(error).splitlines()), '')}"

    def close(self) -> None:
        """Ends what still runs, and leaves the cluster."""
        for reference in self._started:
            self._ray.cancel(reference, force=True)
        if self._mine:
            self._ray.shutdown()


def _command(command: list[str], cwd: str) -> tuple[int, str]:
    done = subprocess.run(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return done.returncode, done.stdout


def make_runner(launcher: str, address: str | None, jobs: int, count: int) -> tuple[Runner, int]:
    """Where `count` commands run, and how many of them side by side."""
    return (RayRunner(address or "auto", 1), max(count, 1)) if launcher == "ray" else (LocalRunner(), jobs)


def _last_line(name: str, code: int, printed: str) -> str:
    lines = [line for line in printed.splitlines() if line.startswith((f"{name}:", "converters"))]
    return lines[-1] if lines else f"{name}: exit code {code}, {printed.strip()[-200:]}"


def run_side_by_side(
    commands: Mapping[str, list[str]], runner: Runner, side_by_side: int, report: Report, tell: Callable[[str], None],
    ended: Callable[[str, int, str], str] = _last_line, what: str = "scenes",
) -> list[str]:  # fmt: skip
    """Runs commands, several at a time; what was begun when a signal or an error comes is ended.

    Args:
        commands: by name of what each makes.
        runner: where.
        side_by_side: commands at a time.
        report: progress over all of them.
        tell: told one line each.
        ended: name, exit code and what was printed -> that line.
        what: they make.

    Returns:
        Names of those that did not exit with 0.
    """
    failed: list[str] = []
    count = len(commands)
    report(f"0/{count} {what}", 0.0)
    with ThreadPoolExecutor(side_by_side) as pool:
        try:
            waiting: dict[Future[tuple[int, str]], str] = {pool.submit(runner.run, c): n for n, c in commands.items()}
            while waiting:
                done, _ = wait(waiting, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in done:
                    name, (code, printed) = waiting.pop(future), future.result()
                    tell(ended(name, code, printed))
                    failed += [name] if code else []
                    report(f"{count - len(waiting)}/{count} {what}", 1 - len(waiting) / count)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            runner.close()
    return failed


def generate_scenes(wanted: Wanted, report: Report, tell: Callable[[str], None]) -> list[str]:
    """Makes the scenes that are not there yet, and lists them.

    Args:
        wanted: what the command line says.
        report: progress over all of them.
        tell: told one line a scene.

    Returns:
        Names of those that were not made, or do not pass every gate.

    Raises:
        GenerationError: unknown names, a folder of other recipes, or a single scene that cannot be made.
    """
    if wanted.tier and wanted.count is not None and wanted.seed is not None:
        begin_set(wanted.out, wanted.tier, wanted.count, wanted.seed)
    path = wanted.recipes or wanted.out / RECIPES
    recipes = load_recipes(path)
    todo = chosen(recipes, wanted.out, tuple(wanted.only), wanted.overwrite, tell)
    if len(todo) > 1 and (wanted.jobs > 1 or wanted.launcher == "ray"):
        runner, side_by_side = make_runner(wanted.launcher, wanted.ray_address, wanted.jobs, len(todo))
        words = [sys.executable, "-m", "converters", "generate-scenes", str(wanted.out), "--recipes", str(path)]
        words += ["--jobs", "1", *(["--overwrite"] if wanted.overwrite else []), "--only"]
        failed = run_side_by_side({r.name: [*words, r.name] for r in todo}, runner, side_by_side, report, tell)
    else:
        gates = make_scenes(todo, recipes.conversion, wanted.out, wanted.overwrite, wanted.jobs, report, tell)
        failed = [name for name, failing in gates.items() if failing]
    if not wanted.only and (wanted.tier or (wanted.out / FILE).is_file()):
        list_set(recipes, wanted.out, tell)
    return failed
