"""Lock files and folders, and write them whole or not at all."""

import contextlib
import errno
import fcntl
import gzip
import json
import os
import re
import secrets
import shutil
import socket
import stat
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from filelock import lock_descriptor

from interactive_nav_common.errors import FileError, UserError, regular
from interactive_nav_common.signals import signals_wait

STALE_S = 1.0
"""Something unfinished younger than this may be what its maker has not locked yet."""
PARTIAL = ".partial-"
"""Begins the names of unfinished files."""
LONGEST_NAME = 100
"""Bytes of a name: file systems take 255, and names of our files add to it."""


def cache_folder() -> Path:
    """Return `$INTERACTIVE_NAV_CACHE`, else the platform's cache folder: `~/.cache/interactive_nav` on Linux."""
    return Path(os.environ.get("INTERACTIVE_NAV_CACHE") or platformdirs.user_cache_path("interactive_nav"))


def check_name(name: str, what: str, error: type[UserError] = FileError) -> str:
    """Check a name that comes from a file or a user and becomes one part of a path; return it."""
    good = name.isprintable() and name[:1] not in ("", ".") and not set("/\\") & set(name)
    if not good or len(name.encode()) > LONGEST_NAME:
        shown = repr(name if len(name) <= 40 else f"{name[:37]}...")
        raise error(
            f"{what} is {shown}, expected one folder name: at most {LONGEST_NAME} printable letters, no '/' or "
            "'\\', not beginning with '.'"
        )
    return name


@contextlib.contextmanager
def writing(place: object, remedy: str, what: str = "cannot be written") -> Iterator[None]:
    """Report in one line what could not be written in the block, why, and what helps."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{place}: {what} ({error.strerror or error}); {remedy}") from None


PATIENCE_S = 0.5
"""How long a lock is tried for: whoever only looks (`is_locked`) holds it for an instant."""
LOCK = ".lock"
NO_LOCKS = "choose a folder on one that does", "its file system has no locks"


def take_lock(path: Path) -> int | None:
    """Hold a lock as long as the returned file descriptor is open, here or in a child; None if another holds it.

    The path is of a folder that is there, or of a file, which is created and names its holder. The system frees the
    lock however its holder ends. A `filelock.FileLock` would open no folders, and its release free what a child has.
    """
    is_folder = path.is_dir()
    with contextlib.ExitStack() as unless_held:
        with writing(path, "expected a writable folder", "cannot be opened"):
            descriptor = _open(path, os.O_RDONLY if is_folder else os.O_CREAT | os.O_RDWR)
        unless_held.callback(os.close, descriptor)
        until = time.monotonic() + PATIENCE_S
        with writing(path, *NO_LOCKS):
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
    with writing(path, "expected a writable folder", "cannot be opened"):
        try:
            descriptor = _open(path, os.O_RDONLY)
        except (FileNotFoundError, NotADirectoryError):  # by now another may have created it
            return False
    try:  # filelock has no shared lock on a descriptor, and two that looked with exclusive ones would see each other
        with writing(path, *NO_LOCKS), contextlib.suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
        return True
    finally:
        os.close(descriptor)


def _open(path: Path, flags: int) -> int:
    if path.exists():  # a link would let the lock's text replace what it leads to, a FIFO would block
        regular(path)
    return os.open(path, flags if path.is_dir() else flags | os.O_NOFOLLOW, 0o644)


def holder(path: Path) -> str:
    """Return who holds a lock file, as the file says: `process 123 on host`."""
    with contextlib.suppress(OSError, ValueError):
        pid, host = path.read_text().split()
        return f"process {pid} on {host}"
    return "another process"


@contextlib.contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold a lock file for the block; where another holds it, say that it is `busy`, with `{holder}` in it."""
    descriptor = take_lock(path)
    if descriptor is None:
        raise FileError(busy.replace("{holder}", holder(path)))  # a path in it may have braces
    try:
        yield
    finally:
        release(descriptor)


@contextlib.contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Create a folder and keep other processes out of it for the block."""
    with writing(out, "choose another one (-o)", "cannot create a folder there"):
        out.mkdir(parents=True, exist_ok=True)
    with locked(out / LOCK, f"{out}: {{holder}} works there; wait for it or choose another folder (-o)"):
        yield


@contextlib.contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` of the same ending, which replaces it once the block has written it.

    Each writer has a temporary file, locked while it writes: the last of two at the same time stands.
    """
    path = Path(path)
    partial, lock = path.with_name(f"{PARTIAL}{secrets.token_hex(4)}-{path.name[-40:]}"), None
    try:
        with writing(path, "make room or choose another place"):
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                regular(path)
            lock = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
            with contextlib.suppress(OSError):  # a file system without locks: what a killed writer leaves stays there
                lock_descriptor(lock)
            yield partial
            with contextlib.suppress(OSError):  # none stands there, or it is another user's
                os.chmod(partial, stat.S_IMODE(path.stat().st_mode))
            os.replace(partial, path)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
        release(lock)


def _is_young(path: Path) -> bool:
    """Return whether it was changed just now; what the clock, set back since, puts into the future is not."""
    return abs(time.time() - path.stat().st_mtime) < STALE_S


def remove_partial(folder: Path) -> None:
    """Remove unfinished files of a folder whose writers were killed; those of writers that run are locked and stay."""
    for path in folder.glob(f"{PARTIAL}*"):
        with contextlib.suppress(OSError, FileError):
            lock = None if _is_young(path) else take_lock(path)
            if lock is not None:
                path.unlink()
                release(lock)


def append_text(path: Path, text: str) -> None:
    """Add to a text file, which must be no link to another file."""
    with open(path, "a", encoding="utf-8", opener=lambda p, flags: os.open(p, flags | os.O_NOFOLLOW, 0o666)) as file:
        file.write(text)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8), packed where its name ends in .gz, whole or not at all."""
    data = text.encode()
    with whole_file(path) as partial:
        partial.write_bytes(gzip.compress(data, mtime=0) if Path(path).suffix == ".gz" else data)


def write_json(path: str | Path, content: Any) -> Any:
    """Write a JSON file whole or not at all; return its content."""
    write_text(path, json.dumps(content, indent=1) + "\n")
    return content


def write_arrays(path: str | Path, **arrays: Any) -> None:
    """Write arrays as a packed npz file, whole or not at all."""
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, **arrays)


@contextlib.contextmanager
def whole_folder(target: Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield an empty folder beside `target`, which becomes it once the block has filled it."""
    with part_folder(target, overwrite) as part:
        yield part
        publish({part: target}, overwrite)


@contextlib.contextmanager
def part_folder(target: Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield an empty, locked folder beside `target`, to be filled and published; else it is removed at the end."""
    if target.parent.is_dir():
        remove_stale(target)
        pattern = re.compile(rf"\.{re.escape(target.name)}\.part-(\d+)-[0-9a-f]+")
        others = [m[1] for p in target.parent.iterdir() if (m := pattern.fullmatch(p.name)) and is_locked(p)]
        if others and not overwrite:
            raise FileError(f"{target}: process {others[0]} is making it; wait for it or give another place")
    if target.exists() and not overwrite:
        raise FileError(f"{target}: exists already; give another place or add --overwrite")
    if target.exists() and not target.is_dir():
        raise FileError(f"{target}: is a file, expected a folder to write; give another place")
    part = target.parent / f".{target.name}.part-{os.getpid()}-{secrets.token_hex(4)}"
    lock = None
    try:
        with writing(target, "give another place"):
            target.parent.mkdir(parents=True, exist_ok=True)
            part.mkdir()
            lock = take_lock(part)
        yield part
    finally:
        shutil.rmtree(part, ignore_errors=True)
        release(lock)


def publish(folders: Mapping[Path, Path], overwrite: bool = True) -> None:
    """Rename finished folders to their targets on the same file system, all or none.

    Signals wait until it is done: a few renames take no time, and half of them would be worse. Of two that replace one
    target at the same time, the last one stands. Without `overwrite`, only empty targets are replaced.
    """
    placed: list[Path] = []
    moved: list[tuple[Path, Path]] = []
    with signals_wait(), writing(", ".join(map(str, folders.values())), "make room or give another place"):
        try:
            for finished, target in folders.items():
                while not _take_place(finished, target):
                    if not overwrite:
                        raise FileError(f"{target}: exists already; give another place or add --overwrite")
                    old = target.parent / f".{target.name}.old-{os.getpid()}-{secrets.token_hex(4)}"
                    with contextlib.suppress(FileNotFoundError):  # another one has moved it
                        target.rename(old)
                        moved.append((old, target))
                placed.append(target)
        except BaseException:
            for target in placed:
                shutil.rmtree(target, ignore_errors=True)
            for old, target in reversed(moved):
                with contextlib.suppress(OSError):  # then it stays, and the next writer puts it back
                    if not _take_place(old, target):
                        shutil.rmtree(old, ignore_errors=True)
            raise
        for old, _ in moved:
            shutil.rmtree(old, ignore_errors=True)


def _take_place(folder: Path, target: Path) -> bool:
    """Rename a folder; return False where a filled one stands at `target`."""
    try:
        folder.rename(target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise
    return True


def remove_stale(target: Path) -> None:
    """Remove what a writer of `target` left that was killed (SIGKILL, power): its unfinished folder.

    Was it killed while it replaced an older `target`, that one is put back. Folders of writers that run are locked and
    stay.
    """
    running = False
    for kind in ("part", "old"):
        name = re.compile(re.escape(f".{target.name}.{kind}-") + r"\d+(-[0-9a-f]{8})?")
        for folder in sorted(p for p in target.parent.iterdir() if name.fullmatch(p.name)):
            with contextlib.suppress(OSError, FileError):
                lock = None if kind == "part" and _is_young(folder) else take_lock(folder)
                if lock is None:
                    running = True
                    continue
                if kind == "part":
                    shutil.rmtree(folder, ignore_errors=True)
                elif not running:  # else it may be in use: a running one replaces the target
                    if target.exists():
                        shutil.rmtree(folder, ignore_errors=True)
                    else:
                        folder.rename(target)
                release(lock)
