"""`python -m interactive_nav.episodes make`: an environment and a seed in, a file of fixed evaluation episodes out.

`python -m interactive_nav.episodes make --robot turtlebot --scenes DIR ... --episodes N --seed S -o FILE`

What such a file is, and how it becomes starts again: `interactive_nav.task.episode_files`, whose names are here too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import interactive_nav
from interactive_nav.task.episode_files import EpisodeFile, EpisodeFileError, draw, load, load_all, save, starts_of
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.words import add_words, read_commands

__all__ = ["EpisodeFile", "EpisodeFileError", "draw", "load", "load_all", "main", "save", "starts_of"]


@reports_errors("interactive_nav.episodes")
def main(argv: Sequence[str] | None = None) -> int:
    """Makes a file; 0 when done, 2 on a user's error."""
    parser = argparse.ArgumentParser(prog="python -m interactive_nav.episodes", description="Fixed episodes.")
    commands = parser.add_subparsers(dest="command", required=True)
    row = read_commands(Path(__file__).with_name("words.yaml"))["episodes"]
    make_parser = commands.add_parser("make", help=row.help)
    add_words(make_parser, row.words)
    arguments = parser.parse_args(argv)
    env = interactive_nav.make(
        arguments.robot,
        arguments.scenes,
        backend="native",
        num_objects=arguments.num_objects,
        objects=arguments.objects,
    )
    file = draw(env, arguments.episodes, arguments.seed)
    save(file, arguments.out)
    shortest = [row["shortest_path_m"] for row in file.episodes]
    print(
        f"{arguments.out}: {len(shortest)} episodes in {len(file.scenes)} scenes, shortest paths "
        f"{min(shortest):.2f} to {max(shortest):.2f} m"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
