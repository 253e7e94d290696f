"""The words of the command line of `topological_nav`; they stand in words.yaml."""

import argparse
from pathlib import Path
from typing import Any

from interactive_nav_common.config import settings_help
from interactive_nav_common.words import Parser, add_words, read_commands
from topological_nav.adapt.config import AdaptConfig
from topological_nav.config import (
    ADAPTED,
    DATASET,
    DRIVES,
    RUNS,
    TASKS,
    DataConfig,
    DriveConfig,
    EvaluationConfig,
    ExportConfig,
    MapConfig,
    PolicyConfig,
)

SETTINGS: dict[str, dict[str, Any]] = {
    "data": {"": DataConfig(), " of drives": DriveConfig()},
    "train": {"": TASKS["rooms"], " of policy": PolicyConfig()},
    "map": {"": MapConfig()},
    "navigate": {"": EvaluationConfig()},
    "evaluate": {"": EvaluationConfig()},
    "adapt": {"": AdaptConfig()},
    "export": {"": ExportConfig()},
}
"""Command -> its settings, and of what else it does."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Parser(
        prog="python -m topological_nav",
        description="Navigation by images and a graph. Words key=value change settings: COMMAND --help lists them.",
    )
    commands = made.add_subparsers(dest="command", required=True)
    for name, row in read_commands(Path(__file__).parents[1] / "words.yaml").items():
        listed = [
            f"settings{of or ' (key=default)'}:\n{settings_help(config)}" for of, config in SETTINGS[name].items()
        ]
        command = commands.add_parser(
            name,
            help=row.help,
            description=row.help,
            epilog="\n\n".join(listed),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add_words(command, row.words, runs=RUNS, dataset=DATASET, drives=DRIVES, adapted=ADAPTED)
    return made
