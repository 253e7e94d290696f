"""What a user can cause or mend: each error is one clear line (what, got, expected, remedy)."""

import contextlib
import functools
import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec

from interactive_nav_common.signals import interrupts_heard

Arguments = ParamSpec("Arguments")


def printable(text: str) -> str:
    """Return the text with control characters escaped: names in files must not steer the reader's terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class UserError(Exception):
    """Base of the errors that programs print as one line and exit with 2."""

    def __str__(self) -> str:
        """Return the message, safe to print."""
        return printable(super().__str__())


class ConfigError(UserError):
    """A setting that does not exist, a value that it cannot have, or a combination that cannot be run."""


class FileError(UserError):
    """A file or folder that cannot be read, written or locked."""


@contextlib.contextmanager
def readable(path: str | Path, kind: type[UserError], remedy: str, what: str = "") -> Iterator[None]:
    """Whatever goes wrong in the block that reads a file is told as one line.

    Zip, npy, Parquet, msgpack, picture and mesh readers raise many kinds for a damaged file.

    Args:
        path: of the file.
        kind: of the error.
        remedy: what to do about it.
        what: it should be, such as ` as Parquet`.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001
        told = " ".join(f"{type(error).__name__}: {error}".replace(str(path), Path(path).name).split())[:300]
        told = "it is empty" if Path(path).is_file() and not Path(path).stat().st_size else told
        raise kind(f"{path}: not readable{what} ({told}); {remedy}") from error


def reports_errors(program: str) -> Callable[[Callable[Arguments, int]], Callable[Arguments, int]]:
    """Of a program's `main`: a user's error is printed as one line, and its exit code is 2."""

    def of(main: Callable[Arguments, int]) -> Callable[Arguments, int]:
        @functools.wraps(main)
        def reported(*arguments: Arguments.args, **keywords: Arguments.kwargs) -> int:
            try:
                with interrupts_heard():
                    return main(*arguments, **keywords)
            except UserError as error:
                print(f"{program}: {error}", file=sys.stderr)
                return 2

        return reported

    return of


class MissingPackage(ConfigError, ImportError):
    """A package that only an extra of this project brings cannot be imported."""


def missing(user: str, package: str, extra: str, otherwise: str = "") -> str:
    """The line: what needs the package, the extra that brings it, and another remedy. It holds beside a wheel, too."""
    return f"{user} needs {package}, which is not installed; pip install 'interactive-nav[{extra}]'{otherwise}"


def optional(module: str, line: str, kind: type[UserError] = MissingPackage) -> Any:
    """A module of an optional package.

    Raises:
        UserError: of this kind, with the line and what the import said; it cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise kind(f"{line} ({' '.join(str(error).split())})") from error
