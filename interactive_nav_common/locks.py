"""Take advisory locks on files and folders, which the system frees however their holder ends."""

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import lock_descriptor

from interactive_nav_common.errors import FileError, regular

PATIENCE_S = 0.5
"""How long a lock is tried for: whoever only looks (`is_locked`) holds it for an instant."""


def take_lock(path: Path) -> int | None:
    """Hold a lock as long as the file descriptor that it returns is open, here or in a child.

    A lock and not a process id in a file: ids are used again, and mean nothing in another container. And a descriptor
    and not a `filelock.FileLock`, which opens no folders, and whose release frees what a child has inherited.

    Args:
        path: of a folder that is there, or of a file, which is created and names its holder.

    Returns:
        The descriptor, or None where another holds the lock.
    """
    is_folder = path.is_dir()
    descriptor = _open(path, os.O_RDONLY if is_folder else os.O_CREAT | os.O_RDWR)
    until = time.monotonic() + PATIENCE_S
    with contextlib.ExitStack() as unless_held:
        unless_held.callback(os.close, descriptor)
        with _needs_locks(path):
            while not lock_descriptor(descriptor, blocking=False):
                if is_locked(path) or time.monotonic() > until:
                    return None
                time.sleep(0.02)
        unless_held.pop_all()
    if not is_folder:
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"{os.getpid()} {socket.gethostname()}\n".encode())
    return descriptor


def release(descriptor: int | None) -> None:
    """Free a lock; None is none."""
    if descriptor is not None:
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Return whether another process holds the lock; the check does not take it."""
    try:
        descriptor = _open(path, os.O_RDONLY)
    except FileError as error:
        if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):  # by now another may have created it
            return False
        raise
    try:  # filelock has no shared lock on a descriptor, and two that looked with exclusive ones would see each other
        with _needs_locks(path):
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)


def holder(path: Path) -> str:
    """Return who holds a lock file, as the file says: `process 123 on host`."""
    with contextlib.suppress(OSError, ValueError):
        pid, host = path.read_text().split()
        return f"process {pid} on {host}"
    return "another process"


@contextlib.contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold a lock file for the block.

    Args:
        path: of the lock file.
        busy: what to say where it is held, with `{holder}` in it.
    """
    descriptor = take_lock(path)
    if descriptor is None:
        raise FileError(busy.replace("{holder}", holder(path)))  # a path in it may have braces
    try:
        yield
    finally:
        release(descriptor)


def _open(path: Path, flags: int) -> int:
    try:  # a link would let the lock's text replace what it leads to, a FIFO would block
        if path.exists():
            regular(path)
        return os.open(path, flags if path.is_dir() else flags | os.O_NOFOLLOW, 0o644)
    except OSError as error:
        raise FileError(f"{path}: cannot be opened ({error.strerror}); expected a writable folder") from error


@contextlib.contextmanager
def _needs_locks(path: Path) -> Iterator[None]:
    try:
        yield
    except BlockingIOError:
        raise
    except OSError as error:
        raise FileError(
            f"{path}: its file system has no locks ({error.strerror}); choose a folder on one that does"
        ) from None


LOCK = ".lock"


@contextlib.contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Create a folder and keep other processes out of it for the block."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{out}: cannot create a folder there ({error.strerror}); choose another one (-o)") from None
    with locked(out / LOCK, f"{out}: {{holder}} works there; wait for it or choose another folder (-o)"):
        yield
