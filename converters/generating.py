"""Commands of `python -m converters` that generate: their words, and what they print."""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path
from typing import TypeAlias

from rich.console import Console

from interactive_nav_common.config import refuse_unused
from interactive_nav_common.progress import stage_progress

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def positive(text: str) -> int:
    """A whole number above 0."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not a positive number")
    return value


def add_launcher(command: argparse.ArgumentParser) -> None:
    """Words that say where."""
    command.add_argument("--launcher", choices=("local", "ray"), default="local", help="where (default: local)")
    command.add_argument("--ray-address", metavar="HOST:PORT", help="of the cluster's head (default: auto)")


def _generate(arguments: argparse.Namespace, console: Console) -> int:
    from converters.generate import generate_building
    from converters.recipes import building_of, parse_settings

    settings = parse_settings(arguments.settings)
    config = building_of(arguments.tier, settings, arguments.split, "settings")
    with stage_progress(console) as report:
        generate_building(arguments.out, arguments.seed, report, config)
    console.print(
        f"{arguments.out}: building of seed {arguments.seed}; convert it with "
        f"'python -m converters convert {arguments.out} SCENE_DIR'",
        soft_wrap=True,
    )
    return 0


def _generate_scenes(arguments: argparse.Namespace, console: Console) -> int:
    from converters.sets import SEEDS, Wanted, generate_scenes

    if arguments.tier:
        refuse_unused(arguments, "--recipes", "with --tier, which writes its own")
        arguments.count, arguments.seed = arguments.count or 10, SEEDS if arguments.seed is None else arguments.seed
    else:
        refuse_unused(arguments, "--count --seed", "without --tier")
    wanted = Wanted(**{f.name: getattr(arguments, f.name) for f in dataclasses.fields(Wanted)})
    with stage_progress(console) as report:
        failed = generate_scenes(wanted, report, lambda line: console.print(line, soft_wrap=True, highlight=False))
    return 1 if failed else 0


def _models(arguments: argparse.Namespace, console: Console) -> int:
    from converters.check.model_sheet import model_sheet

    count = model_sheet(arguments.output, arguments.names)
    console.print(f"{arguments.output}: picture of {count} models", soft_wrap=True)
    return 0


def add_generate(commands: Commands) -> None:
    """Words of `generate`."""
    command = commands.add_parser("generate", help="write a synthetic building in the raw Gibson layout")
    command.add_argument("out", type=Path, metavar="OUT", help="folder to make")
    command.add_argument("--seed", type=int, required=True, metavar="N", help="same seed, same building")
    command.add_argument("--tier", default="sparse", help="sparse (default), furnished or cluttered")
    command.add_argument("--split", choices=("train", "test"), default="train", help="whose CAD models (default train)")
    command.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="of the tier's buildings, such as floor_area_m2=80"
    )
    command.set_defaults(run=_generate, writes=("{}",))


def add_generate_scenes(commands: Commands) -> None:
    """Words of `generate-scenes`."""
    command = commands.add_parser(
        "generate-scenes",
        help="make the scenes of a recipe file, or so many homes of a tier: generate, convert, draw; goes on where it "
        "stopped",
    )
    command.add_argument("out", type=Path, metavar="OUT", help="folder of scene folders; those that are there are kept")
    command.add_argument("--recipes", type=Path, metavar="YAML", help="default: OUT/recipes.yaml")
    command.add_argument("--tier", metavar="TIER", help="write OUT/recipes.yaml: sparse, furnished or cluttered homes")
    command.add_argument("--count", type=positive, metavar="N", help="how many of a tier (default 10)")
    command.add_argument("--seed", type=int, metavar="N", help="of a tier's first home (default 100000)")
    command.add_argument("--only", nargs="+", default=(), metavar="NAME", help="scenes to make (default: all)")
    command.add_argument("--overwrite", action="store_true", help="make those again that are there")
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="scenes side by side; default: cores"
    )
    add_launcher(command)
    command.set_defaults(run=_generate_scenes, writes=("{}/*",))


def add_models(commands: Commands) -> None:
    """Words of `models`."""
    command = commands.add_parser("models", help="draw the CAD models that generated buildings are furnished with")
    command.add_argument("names", nargs="*", metavar="NAME", help="models or categories (default: all models)")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    command.set_defaults(run=_models, writes=("{}",))
