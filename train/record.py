"""Run `python -m train.record RUN_DIR --episode K -o out.mp4`: replay an episode of a run and draw a video of it.

This is `python -m train.replay`, then `python -m interactive_nav.record` of the replay.
"""

import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from interactive_nav.pictures.replay import replay_path
from interactive_nav.record import add_picture_words, check_picture_words, record
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.words import program
from train import replay
from train.config import EnvConfig
from train.runs.run import build_env


@reports_errors("train.record")
def main(argv: Sequence[str] | None = None, build_env: Callable[[EnvConfig], Any] = build_env) -> int:
    """Play and draw; return 0 when done, 2 on a user's error, 130 when interrupted."""
    command = program(Path(__file__).with_name("words.yaml"), "record")
    add_picture_words(command)
    arguments = command.parse_intermixed_args(argv)
    played = ["--episodes", str(arguments.episode), "--policies", arguments.policy]
    played += ["--episode-file", arguments.episode_file] if arguments.episode_file else []
    try:
        check_picture_words(arguments)
        words = [arguments.run, *played, "--checkpoint", arguments.checkpoint, *arguments.overrides]
        refused = inspect.unwrap(replay.main)(words, build_env)  # errors are this program's
        if refused:
            return refused
        path = replay_path(Path(arguments.run), arguments.policy, arguments.episode)
        record(path, arguments, SafeConsole())
    except KeyboardInterrupt:
        print("train.record: stopped; no video was written", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
