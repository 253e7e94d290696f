"""The words of the command line of `topological_nav`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from interactive_nav_common.config import settings_help
from topological_nav.adapt.config import AdaptConfig
from topological_nav.commands import adapt
from topological_nav.commands.learning import TASKS
from topological_nav.config import (
    DATASET,
    DRIVES,
    RUNS,
    DataConfig,
    DriveConfig,
    EvaluationConfig,
    ExportConfig,
    MapConfig,
    PolicyConfig,
    room_config,
)

Command = Callable[..., argparse.ArgumentParser]
"""Name, what it does, its settings, and settings of what else it does, to the command's own parser."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="python -m topological_nav",
        description="Navigation by images and a graph. Words key=value change settings: COMMAND --help lists them.",
    )
    commands = made.add_subparsers(dest="command", required=True)

    def command(name: str, text: str, config: Any, **more: Any) -> argparse.ArgumentParser:
        listed = "".join(f"\n\nsettings of {what}:\n{settings_help(c)}" for what, c in more.items())
        return commands.add_parser(
            name,
            help=text,
            description=text,
            epilog=f"settings (key=default):\n{settings_help(config)}{listed}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    for add in (_data, _train, _map, _episodes, _adapt, _export):
        add(command)
    return made


def _networks(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--localiser", type=Path, metavar="RUN", help=f"embeds images (default {RUNS}, or the package's)")
    sub.add_argument("--detector", type=Path, metavar="RUN", help="judges passages (default: as the localiser)")


def _data(command: Command) -> None:
    data = command(
        "data",
        "Renders room and passage images of scenes, or drives of the expert.",
        DataConfig(),
        drives=DriveConfig(),
    )
    data.add_argument("scenes", nargs="+", metavar="SCENE", help="scene folders or sets of them")
    data.add_argument("--drives", action="store_true", help="drive through the scenes, and render what the robot sees")
    data.add_argument("-o", "--out", type=Path, metavar="DIR", help=f"dataset (default {DATASET}; drives: {DRIVES})")


def _train(command: Command) -> None:
    train = command(
        "train",
        "Trains the room classifier, the passage detector or the local policy.",
        room_config(),
        policy=PolicyConfig(),
    )
    train.add_argument("task", choices=[*TASKS, "policy"], help="passages differ in: batch=32 epochs=20")
    train.add_argument("--data", type=Path, metavar="DIR", help=f"dataset (default {DATASET}; policy: {DRIVES})")
    train.add_argument(
        "--localiser", type=Path, metavar="RUN", help=f"policy: embeds images (default {RUNS / 'rooms'})"
    )
    train.add_argument(
        "--detector", type=Path, metavar="RUN", help=f"policy: embeds them too (default {RUNS / 'passages'})"
    )
    train.add_argument("--grid", action="store_true", help="policy: train with every alpha and lambda of the report")
    train.add_argument("-o", "--out", type=Path, metavar="DIR", help=f"run folder (default {RUNS}/TASK)")


def _map(command: Command) -> None:
    plan = command("map", "Builds a scene's topological map and draws it.", MapConfig())
    plan.add_argument("scene", metavar="SCENE", help="scene folder")
    plan.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"map (default {RUNS}/maps/SCENE.npz)")
    plan.add_argument("--route", nargs=2, type=int, metavar=("FROM", "TO"), help="draw the way between two nodes")
    _networks(plan)


def _episodes(command: Command) -> None:
    one = command("navigate", "Drives one episode of a scene and draws it.", EvaluationConfig())
    one.add_argument("scene", metavar="SCENE", help="scene folder")
    one.add_argument("--episode", type=int, default=0, metavar="N", help="of the scene's (default 0)")
    one.add_argument("--sparse", action="store_true", help="on the map thinned out")
    one.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"picture (default {RUNS}/navigate/SCENE-N.png)")
    one.add_argument("--video", type=Path, metavar="PATH", help="film it as well (.mp4), ten times as fast")
    several = command("evaluate", "Plays fixed episodes of scenes and scores them.", EvaluationConfig())
    several.add_argument("scenes", nargs="+", metavar="SCENE", help="scene folders or sets of them")
    several.add_argument(
        "--contenders",
        metavar="NAMES",
        help="comma-separated choice from dense, sparse (the navigator on its map, and on the map thinned out), "
        "expert, ppo (default: all that can be played)",
    )
    several.add_argument("--ppo", type=Path, metavar="RUN", help="run folder of `python -m train`: told the goal")
    several.add_argument("-o", "--out", type=Path, default=RUNS / "evaluation", metavar="DIR", help="rows and figures")
    for sub in (one, several):
        sub.add_argument(
            "--maps",
            type=Path,
            metavar="DIR",
            help=f"of SCENE.npz (default {RUNS}/maps, made where missing)",
        )
        sub.add_argument(
            "--policy",
            metavar="RUN",
            help="local policy (default: with the networks, where none is named); passage: straight on while the "
            "detector agrees, else turn",
        )
        sub.add_argument(
            "--domain",
            default="clean",
            metavar="NAME",
            help="camera that the navigator sees by, goals included: clean (default), lens, light, noise, blur or "
            "camera; maps of its images: `adapt map`",
        )
        sub.add_argument(
            "--truth", action="store_true", help="maps from the plan, and the truth instead of both networks"
        )
        _networks(sub)


def _export(command: Command) -> None:
    carry = command("export", "Writes finished runs as a small folder of weights in half precision.", ExportConfig())
    carry.add_argument("--localiser", type=Path, default=RUNS / "rooms", metavar="RUN", help="embeds images")
    carry.add_argument("--detector", type=Path, default=RUNS / "passages", metavar="RUN", help="judges passages")
    carry.add_argument("--policy", type=Path, metavar="RUN", help="local policy (default: none)")
    carry.add_argument("--maps", type=Path, metavar="DIR", help="of SCENE.npz, all of them (default: none)")
    carry.add_argument(
        "--images",
        type=Path,
        default=DATASET,
        metavar="PATH",
        help=f"to compare by: dataset, scene (default {DATASET})",
    )
    carry.add_argument("-o", "--out", type=Path, default=RUNS / "export", metavar="DIR", help=f"default {RUNS}/export")
    carry.add_argument("--picture", type=Path, metavar="PATH", help="default DIR.png")


def _adapt(command: Command) -> None:
    sub = command("adapt", "Takes networks and maps to another domain.", AdaptConfig())
    sub.add_argument(
        "what",
        choices=list(adapt.WHAT),
        help="features: the embedding, adversarially; passages: the detector in configurations A to D; map: of images "
        "collected in the target domain",
    )
    sub.add_argument("scene", nargs="?", metavar="SCENE", help="map: scene folder")
    sub.add_argument("--data", type=Path, metavar="DIR", help=f"source (default {DATASET})")
    sub.add_argument("--target", type=Path, metavar="DIR", help="dataset of the target (default: the source's)")
    sub.add_argument("-o", "--out", type=Path, metavar="PATH", help=f"default {adapt.ADAPTED}/WHAT, a map SCENE.npz")
    _networks(sub)
