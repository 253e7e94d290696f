"""What can go wrong for a user of `topological_nav`: each error is one clear line (what, got, expected, remedy)."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from interactive_nav_common.errors import UserError


class SpaceError(UserError):
    """A scene without the free space that was asked for."""


class DatasetError(UserError):
    """A dataset that is missing, incomplete, or made with other settings."""


class RunError(UserError):
    """A run folder that is missing, damaged, or trained with other settings."""


class MapError(UserError):
    """A topological map that is damaged, of another version, or of another scene."""


class Stopped(Exception):
    """A signal asked to stop; carries its number. What was done is kept, and the same command goes on."""


Asked = Callable[[], int]
"""Asked at places where work can stop: the number of the signal that wants it to; 0: go on."""


def go_on() -> int:
    """An `Asked` that never stops."""
    return 0


@contextlib.contextmanager
def readable(path: Path, kind: type[UserError], remedy: str) -> Iterator[None]:
    """Whatever goes wrong in the block that reads a file is told as one line.

    Zip, npy, msgpack, WebP and JSON readers raise many kinds for a damaged file.

    Args:
        path: of the file.
        kind: of the error.
        remedy: what to do about it.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001
        told = " ".join(repr(error).split())[:200]
        raise kind(f"{path}: not readable ({told}); {remedy}") from None
