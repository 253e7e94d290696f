"""Report what a user can cause or fix: each error is one clear line (what, got, expected, remedy)."""

import contextlib
import errno
import functools
import importlib
import io
import os
import select
import shlex
import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec

from interactive_nav_common.signals import interrupts_heard

Arguments = ParamSpec("Arguments")


def printable(text: str) -> str:
    """Return the text with control characters escaped: names in files must not steer the reader's terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def typed(*words: object) -> str:
    """Return words, such as paths with spaces, as they are typed into a shell."""
    return shlex.join(map(str, words))


MOST_LETTERS = 1_900
"""Of a message: the middle of a longer one, which shows a value of a file, is cut out."""


class UserError(Exception):
    """Base of the errors that programs print as one line and exit with 2."""

    def __str__(self) -> str:
        """Return the message, safe to print."""
        text = super().__str__()
        if len(text) > MOST_LETTERS:
            text = f"{text[: MOST_LETTERS * 2 // 3]} [...] {text[-MOST_LETTERS // 3 :]}"
        return printable(text)


class ConfigError(UserError):
    """A setting that does not exist, a value that it cannot have, or a combination that cannot be run."""


class FileError(UserError):
    """A file or folder that cannot be read, written or locked."""


def regular(path: str | Path) -> Path:
    """Return the path of a file or folder; a FIFO, socket or device, which may block or never end, raises OSError."""
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "no regular file but a FIFO, socket or device", str(path))
    return Path(path)


@contextlib.contextmanager
def readable(path: str | Path, kind: type[UserError], remedy: str, what: str = "") -> Iterator[None]:
    """Report whatever goes wrong in the block that reads a file as one line of a `kind` of error, with a remedy.

    Zip, npy, Parquet, msgpack, picture and mesh readers raise many kinds for a damaged file. `what` it should be is
    such as ` as Parquet`.
    """
    try:
        if os.path.exists(path):  # who reads tells whether it may be missing
            regular(path)
        yield
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001
        cause = " ".join(f"{type(error).__name__}: {error}".replace(str(path), Path(path).name).split())[:300]
        cause = "it is empty" if Path(path).is_file() and not Path(path).stat().st_size else cause
        gone = isinstance(error, OSError) and not os.path.lexists(path)
        why = "no such file" if gone else f"not readable{what} ({cause})"
        raise kind(f"{path}: {why}; {remedy}") from error


_REFUSED = {errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EACCES, errno.ENAMETOOLONG}
"""Of an OSError: the system's refusals, which are no fault of ours."""


def reports_errors(program: str) -> Callable[[Callable[Arguments, int]], Callable[Arguments, int]]:
    """Decorate a program's `main`: a user's error is printed as one line, and its exit code is 2."""

    def of(main: Callable[Arguments, int]) -> Callable[Arguments, int]:
        @functools.wraps(main)
        def reported(*arguments: Arguments.args, **keywords: Arguments.kwargs) -> int:
            for stream in (sys.stdout, sys.stderr):
                if isinstance(stream, io.TextIOWrapper):  # a locale without our letters must not end a program
                    stream.reconfigure(errors="backslashreplace")
            code = 0
            try:
                with interrupts_heard():
                    code = main(*arguments, **keywords)
                    sys.stdout.flush()
            except UserError as error:
                print(f"{program}: {error}", file=sys.stderr)
                code = 2
            except SystemExit as stop:
                if not isinstance(stop.__context__, BrokenPipeError):  # of rich
                    raise
                code = 141
            except OSError as error:
                if error.errno not in _REFUSED or isinstance(error, BrokenPipeError) and not _reader_gone():
                    raise
                code = 141 if isinstance(error, BrokenPipeError) else 2  # 141: as of SIGPIPE
                with contextlib.suppress(OSError), open(os.devnull, "w") as nowhere:  # takes what Python flushes
                    os.dup2(nowhere.fileno(), sys.stdout.fileno())
                if code == 2:
                    print(f"{program}: {printable(str(error.filename or 'output'))}: {error.strerror}", file=sys.stderr)
            return code

        return reported

    return of


def _reader_gone() -> bool:
    """Return whether nobody reads stdout any more."""
    pipe = select.poll()
    pipe.register(sys.stdout.fileno(), 0)
    return bool(pipe.poll(0))


class MissingPackage(ConfigError, ImportError):
    """A package that only an extra of this project brings cannot be imported."""


def missing(user: str, package: str, extra: str, otherwise: str = "") -> str:
    """Return the line: what needs the package, the extra that installs it, another remedy. It also suits a wheel."""
    return f"{user} needs {package}, which is not installed; pip install 'interactive-nav[{extra}]'{otherwise}"


def optional(module: str, line: str, kind: type[UserError] = MissingPackage) -> Any:
    """Import a module of an optional package."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise kind(f"{line} ({' '.join(str(error).split())})") from error
