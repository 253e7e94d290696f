"""What can go wrong for a user of `topological_nav`: each error is one clear line (what, got, expected, remedy)."""

import dataclasses
import sys
from collections.abc import Callable

from interactive_nav_common.errors import UserError


class SpaceError(UserError):
    """A scene without the free space that is needed."""


class DatasetError(UserError):
    """A dataset that is missing, incomplete, or of other settings."""


class RunError(UserError):
    """A run folder that is missing, damaged, or trained with other settings."""


class MapError(UserError):
    """A topological map that is damaged, of another version, or of another scene."""


class Stopped(Exception):
    """A signal to stop; carries its number. What was done is kept, and the same command goes on."""


Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and of how much; may raise to stop."""


@dataclasses.dataclass(frozen=True)
class Host:
    """Whoever started long work: shows its lines, and stops it between two steps."""

    show: Callable[[str], None] = lambda _: None
    signal: Callable[[], int] = lambda: 0
    """Return the number of the signal that wants the work to stop; 0: go on."""


ALONE = Host()
"""Shows nothing and never stops."""


def say(line: str) -> None:
    """Print a line to stderr, at once."""
    print(line, file=sys.stderr, flush=True)
