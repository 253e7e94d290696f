"""Commands of `python -m converters` that generate, and what they print; their words are in words.yaml."""

from __future__ import annotations

import argparse
import dataclasses

from rich.console import Console

from interactive_nav_common.config import read_words, refuse_unused
from interactive_nav_common.progress import stage_progress


def _generate(arguments: argparse.Namespace, console: Console) -> int:
    from converters.generate import generate_building
    from converters.recipes import building_of

    settings = read_words(arguments.settings, "floor_area_m2=80")
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


GENERATING = {"generate": _generate, "generate-scenes": _generate_scenes, "models": _models}
"""Command -> what runs it."""
