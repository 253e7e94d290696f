"""Run `python -m train.record RUN_DIR --episode K -o out.mp4`: replay an episode of a run and draw a video of it."""

import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from interactive_nav.pictures.replay import replay_path
from interactive_nav.record import Picture
from interactive_nav_common.commands import parse
from interactive_nav_common.errors import reports_errors
from train.replay import OfRun


class Record(Picture, OfRun):
    """Play an episode of a run and make a video of it."""

    def source(self, console: Console) -> Path:
        """Play the episode; return its replay."""
        self.play([self.episode], self.policy, console)
        return replay_path(self.run, self.policy, self.episode)


@reports_errors("train.record")
def main(argv: Sequence[str] | None = None) -> int:
    """Play and draw; return 0 when done, 2 on a user's error, 130 when interrupted."""
    return parse(Record, "python -m train.record", argv).film("train.record")


if __name__ == "__main__":
    sys.exit(main())
