"""Define the errors of users of `topological_nav`, each one clear line, and who is informed of long work."""

import dataclasses
import sys
from collections.abc import Callable

from interactive_nav_common.errors import UserError


class SpaceError(UserError):
    """Report a scene without the free space that is needed."""


class DatasetError(UserError):
    """Report a dataset that is missing, incomplete, or of other settings."""


class RunError(UserError):
    """Report a run folder that is missing, damaged, or trained with other settings."""


class MapError(UserError):
    """Report a topological map that is damaged, of another version, or of another scene."""


class Stopped(Exception):
    """Stop at a signal, whose number it carries. What was done is kept, and the same command goes on."""


Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and of how much; may raise to stop."""


@dataclasses.dataclass(frozen=True)
class Host:
    """Show the lines of long work, and stop it between two steps."""

    show: Callable[[str], None] = lambda _: None
    signal: Callable[[], int] = lambda: 0
    """Return the number of the signal that wants the work to stop; 0: go on."""


ALONE = Host()
"""Shows nothing and never stops."""


def say(line: str) -> None:
    """Print a line to stderr, at once."""
    print(line, file=sys.stderr, flush=True)
