"""Run the commands of `python -m converters` that generate scenes and prepare furniture; words.yaml has their words."""

import argparse
import dataclasses
import functools
import shlex

from rich.console import Console

from interactive_nav_common.config import read_words, refuse_unused
from interactive_nav_common.errors import FileError
from interactive_nav_common.jobs.progress import stage_progress
from scenes_mjcf.sets import HERE, PACKAGED, in_cache, is_listed, packaged_set


def _generate(arguments: argparse.Namespace, console: Console) -> None:
    from converters.generate import generate_building
    from converters.recipes import building_of

    settings = read_words(arguments.settings, "floor_area_m2=80")
    config = building_of(arguments.tier, settings, arguments.split, "settings")
    with stage_progress(console) as report:
        generate_building(arguments.out, arguments.seed, report, config)
    console.print(
        f"{arguments.out}: building of seed {arguments.seed}; convert it with "
        f"'python -m converters convert {shlex.quote(str(arguments.out))} SCENE_DIR'",
        soft_wrap=True,
    )


def _generate_scenes(arguments: argparse.Namespace, console: Console) -> int:
    from converters.sets import SEEDS, Wanted, generate_scenes

    if arguments.tier:
        refuse_unused(arguments, "--recipes", "with --tier, which writes them")
        arguments.count, arguments.seed = arguments.count or 10, SEEDS if arguments.seed is None else arguments.seed
    else:
        refuse_unused(arguments, "--count --seed", "without --tier")
    wanted = Wanted(**{f.name: getattr(arguments, f.name) for f in dataclasses.fields(Wanted)})
    with stage_progress(console) as report:
        failed = generate_scenes(wanted, report, lambda line: console.print(line, soft_wrap=True, highlight=False))
    return 1 if failed else 0


def _make_scenes(arguments: argparse.Namespace, console: Console) -> int:
    from converters.sets import make_packaged

    with stage_progress(console) as report:
        log = functools.partial(console.print, soft_wrap=True, highlight=False)
        failed = make_packaged(arguments.names, arguments.jobs, report, log)
    return 1 if failed else 0


def _list_scenes(arguments: argparse.Namespace, console: Console) -> None:
    listed = {f / scene: (name, m) for name, f in PACKAGED.items() for scene, m in packaged_set(name).scenes.items()}
    for scene, (name, member) in listed.items():
        place = next((p for p in (scene, in_cache(scene)) if p.exists()), None)
        other = place and place == in_cache(scene) and not is_listed(place, member)
        what = "in the cache is another scene of this name: make it again" if other else place or "not made"
        print(f"{name:<10} {member.split:<6} {scene.name:<15} {what}")
    for scene in sorted({path.parent for path in HERE.rglob("scene.json")} - set(listed)):
        print(f"{'-':<10} {'-':<6} {scene.relative_to(HERE).as_posix():<15} {scene}")


def _models(arguments: argparse.Namespace, console: Console) -> None:
    from converters.check.pictures import model_sheet

    count = model_sheet(arguments.output, arguments.names)
    console.print(f"{arguments.output}: picture of {count} models", soft_wrap=True)


def _get(arguments: argparse.Namespace, console: Console) -> None:
    from converters.library.build import fetch, library_folder

    target = arguments.out or library_folder()
    files = fetch(arguments.given, target, arguments.overwrite)
    console.print(f"{target}: {len(files)} furniture libraries, checked by digest", soft_wrap=True)


def _build(arguments: argparse.Namespace, console: Console) -> None:
    from converters.library.build import FILES, build, library_folder

    given = arguments.given or library_folder()
    files = [given / f"{name}.sh3f" for name in FILES]
    if not all(path.is_file() for path in files):
        raise FileError(f"{given}: lacks furniture libraries; run 'python -m converters library get sweethome3d' first")
    with stage_progress(console) as report:
        count = build(files, arguments.out, arguments.jobs, report)
    console.print(f"{arguments.out}: {count} models with their hulls, and ATTRIBUTION.md", soft_wrap=True)


def _list(arguments: argparse.Namespace, console: Console) -> None:
    from converters.library.store import read_index

    for model in read_index().values():
        width, height, depth = model.size_m
        print(
            f"{model.name:<40} {model.category:<15} {model.split:<6} {width:.2f} x {depth:.2f} x {height:.2f} m "
            f"{model.faces:>5} faces {model.hulls:>3} hulls  "
            + "; ".join(f"{c.creator}, {c.licence}" for c in model.credits)
        )


GENERATING = {
    **{"generate": _generate, "generate-scenes": _generate_scenes, "models": _models},
    "scenes": {"list": _list_scenes, "make": _make_scenes},
    "library": {"get": _get, "build": _build, "list": _list},
}
"""Command -> what runs it, or its actions' table."""
