"""Run `interactive-nav demo`: watch a packaged policy push its way through a packaged flat, without training."""

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from interactive_nav_common.commands import Command, option, parse
from interactive_nav_common.errors import reports_errors
from scenes_mjcf.sets import installed
from train.record import Record

POLICY = Path(__file__).parent / "policies" / "turtlebot"
SCENE, OBJECTS, EPISODE = "scenes_mjcf/drawn/flat", 10, 23
"""A flat that the policy was not trained in, and an episode in which it shoves a basket and a door."""


class Demo(Command):
    """Watch a TurtleBot push its way through a flat: play one episode with a packaged policy and film it."""

    out: Annotated[Path, option("-o", metavar="DIR")] = Path("interactive-nav-demo")
    """Folder for the film and the replay."""
    episode: int = EPISODE
    """Number of the fixed episode, starting at 0."""


@reports_errors("interactive-nav demo")
def main(argv: Sequence[str] | None = None) -> int:
    """Play and film; return 0 when done, 2 on a user's error, 130 when interrupted."""
    arguments = parse(Demo, "interactive-nav demo", argv)
    run, film = arguments.out / "turtlebot", arguments.out / "demo.mp4"
    # A copy, because replays are written into the run's folder.
    shutil.copytree(POLICY, run, dirs_exist_ok=True)
    settings = f"env.scenes=[{installed(SCENE)}]", f"env.num_objects={OBJECTS}", "env.backend=native"
    played: Any = {"run": run, "settings": settings, "checkpoint": "last", "episode": arguments.episode}
    status = Record(**played, views=("follow",), out=film).film("interactive-nav demo")
    if not status:
        print(f"The film is {film.resolve()}. Train a policy of your own with `interactive-nav train --config demo`.")
    return status


if __name__ == "__main__":
    sys.exit(main())
