"""Generate, convert and draw every scene of a recipe file, reproducibly to the byte.

A recipe names a seed, a split (which decides the CAD models), a tier and deviations from the tier's defaults.
"""

import dataclasses
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from converters.check.preview import preview
from converters.clock import Report
from converters.generate import generate_building
from converters.generate.homes.config import (
    SHARE_TOLERANCE,
    SPARSE,
    TIERS,
    GenerationError,
    HomeConfig,
    home_config,
    home_fields,
)
from converters.generate.models.cad import MODELS
from converters.pipeline import ConvertConfig, Converted, convert
from converters.records.errors import StageFailed
from interactive_nav_common.config import Natural, nearest
from interactive_nav_common.errors import ConfigError, UserError, readable, typed
from interactive_nav_common.files import check_name, part_folder, publish
from interactive_nav_common.records import Reader
from interactive_nav_common.untrusted.reading import read_bytes

T = TypeVar("T")
_CONVERSION = ("structure_faces", "object_faces", "structure_texture", "object_texture", "seed")
MOST_SEEDS, NEXT_SEED = 5, 1_000_000
"""Seeds that a home's recipe stands for, and between them: of six one gives no plan that meets its shares."""
KEPT = "is there, kept"
"""End of the line about a scene that exists."""
GENERATE, CONVERT = 0.55, 0.35
"""Shares of one scene's time, hulls cached, the rest is drawing: weights of the progress bar."""


@dataclasses.dataclass(frozen=True)
class SceneRecipe:
    """Everything that determines one scene."""

    name: str
    split: Literal["train", "test"]
    seed: int
    building: HomeConfig


@dataclasses.dataclass(frozen=True)
class Recipes:
    """Content of a recipe file."""

    scenes: tuple[SceneRecipe, ...]
    conversion: dict[str, Any]
    """Settings of `ConvertConfig` that all scenes share: how large meshes and textures may be."""


@dataclasses.dataclass(frozen=True)
class _Recipe:
    """A scene as a recipe file describes it."""

    split: Literal["train", "test"]
    seed: Natural
    tier: str = SPARSE
    building: dict[str, Any] | None = None


@dataclasses.dataclass(frozen=True)
class _File:
    """A recipe file; `shared` only holds anchors."""

    scenes: dict[str, _Recipe]
    conversion: dict[str, Any] | None = None
    shared: Any = None


_RECIPES = Reader(GenerationError, "scenes_mjcf/cluttered/recipes.yaml shows the form")


def _refuse_unknown(given: Iterable[str], fields: Iterable[str], where: str) -> None:
    fields = tuple(fields)
    for key in (key for key in given if key not in fields):
        keys = ", ".join(sorted(fields))
        raise GenerationError(f"{where}: unknown key '{key}'{nearest(str(key), fields)}; known keys: {keys}")


def _value(value: Any, hint: Any, where: str) -> Any:
    """Return a setting as its field takes it: one number stands for a range of that number."""
    ranges = [kind for kind in (hint, *get_args(hint)) if get_origin(kind) is tuple and ... not in get_args(kind)]
    one = ranges and isinstance(value, int | float) and not isinstance(value, bool)
    return _RECIPES.typed([value, value] if one else value, hint, where)


def building_of(tier: str, settings: dict[str, Any], split: str, where: str) -> HomeConfig:
    """Return the building of one of `TIERS` with settings of `HomeConfig`; the split decides the CAD models."""
    if tier not in TIERS:
        raise GenerationError(f"{where}: tier is {tier!r}, expected one of {', '.join(TIERS)}")
    fields = home_fields()
    _refuse_unknown(settings, fields, where)
    values = {key: _value(value, fields[key], f"{where}: {key}") for key, value in settings.items()}
    try:
        return home_config(tier, values, MODELS[split])
    except ConfigError as error:
        raise GenerationError(f"{where}: {error}") from error


def check_conversion(settings: dict[str, Any], where: str) -> None:
    """Refuse settings of a conversion that do not exist, or are no whole numbers."""
    _refuse_unknown(settings, _CONVERSION, where)
    for key, value in settings.items():
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            raise GenerationError(f"{where}: {key} is {value!r}, expected a whole number of 0 or more")


def parse_recipes(data: Any, where: str) -> Recipes:
    """Build recipes from decoded YAML of the form of `_File`; errors name the file `where`."""
    file = _RECIPES.record(data, _File, where)
    conversion = file.conversion or {}
    check_conversion(conversion, f"{where}: conversion")
    scenes = []
    for name, recipe in file.scenes.items():
        here = f"{where}: scenes: {check_name(str(name), f'{where}: scenes: a name', GenerationError)}: building"
        building = building_of(recipe.tier, recipe.building or {}, recipe.split, here)
        scenes.append(SceneRecipe(str(name), recipe.split, recipe.seed, building))
    return Recipes(tuple(scenes), dict(conversion))


def load_recipes(path: Path) -> Recipes:
    """Read a recipe file; raise `GenerationError` if it cannot be used."""
    remedy = "write it with --tier TIER, name another with --recipes, or run python -m converters scenes make NAME"
    with readable(path, GenerationError, remedy):
        text = read_bytes(path)
    return parse_recipes(_RECIPES.decoded(text, "YAML", str(path)), str(path))


def missed(building: HomeConfig, result: Converted) -> str:
    """Return the failed gates, or the share missed because conversion closed passages; an empty string if neither."""
    if failed := [gate.name for gate in result.gates if not gate.passed]:
        return f"gates that fail once converted: {', '.join(failed)}"
    for robot, (low, high) in building.must_push.items():
        share = result.manifest.measures["must_push_share"][robot]
        if not low - SHARE_TOLERANCE <= share <= high + SHARE_TOLERANCE:
            return f"must_push_{robot} is {share} once converted: expected {low} to {high}"
    return ""


def with_seeds(seed: int, attempt: Callable[[int], T]) -> tuple[T, str]:
    """Return the result of the first attempt that succeeds, and its seed in words.

    An attempt raises a `GenerationError` that names its seed to request the next seed.
    """
    words, refused = f"seed {seed}", None
    for one in range(seed, seed + MOST_SEEDS * NEXT_SEED, NEXT_SEED):
        try:
            return attempt(one), words
        except GenerationError as error:
            refused, reason = error, str(error).removeprefix(f"seed {one}: ")
            if reason == str(error):
                raise
            words = f"seed {one + NEXT_SEED} in place of {seed} ({reason})"
    raise GenerationError(f"none of {MOST_SEEDS} seeds: {refused}") from refused


def _generated(recipe: SceneRecipe, config: ConvertConfig, work: Path, report: Report) -> tuple[Converted, str]:
    """Generate and convert the recipe's building; return it, and its seed in words."""
    raw, scene = work / "raw", work / recipe.name

    def attempt(seed: int) -> Converted:
        for folder in (raw, scene):
            shutil.rmtree(folder, ignore_errors=True)
        generate_building(raw, seed, lambda s, share: report(s, GENERATE * share), recipe.building)
        result = convert(raw, scene, config, lambda s, share: report(s, GENERATE + CONVERT * share))
        if why := missed(recipe.building, result):
            raise GenerationError(f"seed {seed}: {why}")
        return result

    try:
        return with_seeds(recipe.seed, attempt)
    except GenerationError as error:
        raise GenerationError(f"{recipe.name}: {error}") from error


def make_scene(
    recipe: SceneRecipe, conversion: dict[str, Any], folder: Path, jobs: int, report: Report
) -> tuple[list[str], str, str]:
    """Generate, convert and draw one scene; return the failed gates, its seed in words, and why it has no preview.

    `folder` is replaced atomically. `conversion` are settings of `ConvertConfig`, `jobs` parallel decompositions.
    """
    with part_folder(folder, overwrite=True) as work:
        config = ConvertConfig(format="gibson", split=recipe.split, jobs=jobs, keep=False, **conversion)
        (result, seed), scene = _generated(recipe, config, work, report), work / recipe.name
        report("drawing", GENERATE + CONVERT)
        undrawn, again = "", f"python -m converters preview {typed(folder, '-o', folder / 'preview.png')}"
        try:
            preview(scene, scene / "preview.png")
        except (ValueError, ArithmeticError, LookupError, RuntimeError, UserError) as error:  # the scene itself is fine
            undrawn = f"; no preview: {type(error).__name__}: {' '.join(str(error).split())}; try again with: {again}"
        publish({scene: folder})
    report("done", 1.0)
    return [g.name for g in result.gates if not g.passed], seed, undrawn


def chosen(
    recipes: Recipes, out: Path, names: tuple[str, ...] = (), overwrite: bool = False,
    log: Callable[[str], None] = lambda line: None,
) -> tuple[SceneRecipe, ...]:  # fmt: skip
    """Return the recipes in `names` (empty: all) without a scene, or all with `overwrite`; log the ones kept."""
    every = [r.name for r in recipes.scenes]
    for name in (name for name in names if name not in every):
        raise GenerationError(f"no recipe named '{name}'{nearest(name, every)}; known: {', '.join(every)}")
    wanted = tuple(r for r in recipes.scenes if not names or r.name in names)
    todo = tuple(r for r in wanted if overwrite or not (out / r.name).exists())
    for recipe in wanted:
        if recipe not in todo:
            log(f"{recipe.name}: {KEPT}")
    return todo


def make_scenes(
    todo: Sequence[SceneRecipe], conversion: dict[str, Any], out: Path, overwrite: bool = False, jobs: int = 2,
    report: Report = lambda stage, share: None, log: Callable[[str], None] = lambda line: None,
) -> dict[str, list[str]]:  # fmt: skip
    """Generate scenes one after the other; return name -> failed gates of the scenes generated now.

    `log` receives one line for each scene, also if it fails; the error of a single scene is raised instead.
    """
    weight = [sum(r.building.floor_area_m2) for r in todo]
    failed: dict[str, list[str]] = {}
    for k, recipe in enumerate(todo):

        def inner(stage: str, share: float, k: int = k, recipe: SceneRecipe = recipe) -> None:
            done = (sum(weight[:k]) + weight[k] * share) / sum(weight)
            report(f"{k + 1}/{len(todo)} {recipe.name}: {stage}", done)

        if not overwrite and (out / recipe.name).exists():  # another generator's, finished since
            log(f"{recipe.name}: {KEPT}")
            continue
        try:
            failed[recipe.name], seed, undrawn = make_scene(recipe, conversion, out / recipe.name, jobs, inner)
        except (GenerationError, StageFailed) as error:
            if len(todo) == 1:
                raise
            failed[recipe.name] = ["none"]
            log(f"{recipe.name}: {str(error).removeprefix(f'{recipe.name}: ')}")
            continue
        verdict = f"gates that fail: {', '.join(failed[recipe.name])}" if failed[recipe.name] else "every gate passes"
        log(f"{recipe.name}: {recipe.split}, {seed}, {verdict}{undrawn}")
    return failed
