"""Run `python -m train.record RUN_DIR --episode K -o out.mp4`: replay an episode of a run and draw a video of it.

This is `python -m train.replay`, then `python -m interactive_nav.record` of the replay.
"""

import dataclasses
import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

from interactive_nav.pictures.replay import replay_path
from interactive_nav.record import Picture
from interactive_nav_common.commands import Words, option, parse, word
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from train import replay
from train.config import EnvConfig
from train.runs.run import build_env


@dataclasses.dataclass(kw_only=True)
class Record(Picture):
    """Make a video of an episode of a run."""

    run: Annotated[Path, *word("RUN_DIR")]
    """Folder that `python -m train` wrote."""
    settings: Words = ()
    """Environment settings to change: env.NAME=VALUE."""
    checkpoint: Annotated[str, option(metavar="best|last|STEPS")] = "best"
    """Which checkpoint plays."""
    episode_file: Annotated[str | None, option(metavar="FILE")] = None
    """Play those of this one (python -m interactive_nav.episodes make)."""


@reports_errors("train.record")
def main(argv: Sequence[str] | None = None, build_env: Callable[[EnvConfig], Any] = build_env) -> int:
    """Play and draw; return 0 when done, 2 on a user's error, 130 when interrupted."""
    arguments = parse(Record, "python -m train.record", argv)
    played = ["--episodes", str(arguments.episode), "--policies", arguments.policy]
    played += ["--episode-file", arguments.episode_file] if arguments.episode_file else []
    try:
        words = [str(arguments.run), *played, "--checkpoint", arguments.checkpoint, *arguments.settings]
        refused = inspect.unwrap(replay.main)(words, build_env)  # errors are this program's
        if refused:
            return refused
        arguments.record(replay_path(arguments.run, arguments.policy, arguments.episode), SafeConsole())
    except KeyboardInterrupt:
        print("train.record: stopped; no video was written", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
