"""Run `python -m topological_nav data|train|map|navigate|evaluate|adapt|export`: words in, files and pictures out.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when stopped: the same command goes on.
"""

import argparse
import importlib
import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from interactive_nav_common.config import settings_help
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.words import Parser, add_words, read_commands
from topological_nav import config as configs
from topological_nav.config import ADAPTED, DATASET, DRIVES, RUNS
from topological_nav.data.domains import AdaptConfig

SETTINGS: dict[str, dict[str, Any]] = {
    "data": {"": configs.DataConfig(), " of drives": configs.DriveConfig()},
    "train": {"": configs.TASKS["rooms"], " of policy": configs.PolicyConfig()},
    "map": {"": configs.MapConfig()},
    "navigate": {"": configs.EvaluationConfig()},
    "evaluate": {"": configs.EvaluationConfig()},
    "adapt": {"": AdaptConfig()},
    "export": {"": configs.ExportConfig()},
}
"""Command -> its settings, and of what else it does."""


def parser() -> argparse.ArgumentParser:
    """Build the command line's parser; its words are in words.yaml."""
    root = Parser(
        prog="python -m topological_nav",
        description="Navigation by images and a graph. Words key=value change settings: COMMAND --help lists them.",
    )
    commands = root.add_subparsers(dest="command", required=True)
    for name, row in read_commands(Path(__file__).with_name("words.yaml")).items():
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
    return root


@reports_errors("topological_nav")
def main(argv: Sequence[str] | None = None) -> int:
    """Run a command."""
    words = list(sys.argv[1:] if argv is None else argv)
    settings = [word for word in words if re.match(r"\w+=", word)]
    arguments = parser().parse_args([word for word in words if word not in settings])
    arguments.settings = settings
    try:
        # Imported once the command is clear: it is heavy.
        getattr(importlib.import_module("topological_nav.commands"), f"run_{arguments.command}")(arguments)
    except (Stopped, KeyboardInterrupt) as stopped:  # the latter: before the work began, or at a second Ctrl-C
        print("topological_nav: stopped; the same command goes on", file=sys.stderr)
        return 128 + (stopped.args[0] if isinstance(stopped, Stopped) else signal.SIGINT)
    return 0


if __name__ == "__main__":
    sys.exit(main())
