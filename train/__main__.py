"""Run `python -m train`: train as the command line says, write a run folder and return an exit code."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.words import Parser
from train import config_io
from train.config import TrainConfig
from train.runs.run_folder import RunFolder


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    command = Parser(
        prog="python -m train",
        description="Trains a policy. The same command continues a run that was stopped or killed.",
        epilog=f"settings (key=default):\n{config_io.help_text()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    presets = ", ".join(config_io.preset_names())
    source = command.add_mutually_exclusive_group(required=True)
    source.add_argument("--config", metavar="NAME|PATH", help=f"a preset ({presets}) or a YAML file")
    source.add_argument("--resume", metavar="RUN_DIR", help="continue this run folder with its config")
    command.add_argument("--robot", metavar="NAME|FILE", help="as env.robot=...: a name, a file, or path.py:function")
    command.add_argument(
        "--checkpoint", default="last", metavar="best|last|STEPS", help="continue from it (default: last)"
    )
    command.add_argument("overrides", nargs="*", metavar="key=value", help="settings to change, see below")
    return command


def read_config(arguments: argparse.Namespace) -> TrainConfig:
    """Return the config that the command line describes."""
    if arguments.config:
        return config_io.load_config(arguments.config, arguments.overrides)
    path = Path(arguments.resume)
    config = RunFolder(path).read_config()
    run = dataclasses.replace(config.run, out_dir=str(path.parent), name=path.resolve().name)
    return config_io.apply_overrides(dataclasses.replace(config, run=run), arguments.overrides)


@reports_errors("train")
def main(argv: Sequence[str] | None = None) -> int:
    """Train; return 0 when done, 2 on a user's error, 128 + signal when stopped by one (after saving)."""
    arguments = parser().parse_intermixed_args(argv)
    arguments.overrides = config_io.with_robot(arguments.overrides, arguments.robot)
    config = read_config(arguments)
    # Heavy: after the config has been checked.
    from train.runs.run import train_run

    _, _, stopped_by = train_run(config, SafeConsole(), resume_from=arguments.checkpoint)
    return 128 + stopped_by if stopped_by else 0


if __name__ == "__main__":
    sys.exit(main())
