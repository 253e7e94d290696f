"""Cache results of pure functions in a folder, which may be deleted at any time, by content.

A key covers the arguments, the sources of the function's module and its imports from the project, and the versions of
libraries, so entries are never stale. Entries are pickles by joblib: nobody else may have write access to the folder.
"""

import ast
import contextlib
import dataclasses
import functools
import hashlib
import os
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import joblib

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import PARTIAL, whole_file
from interactive_nav_common.jobs.progress import bar
from interactive_nav_common.versions import package_versions, usable_cores

T = TypeVar("T")

COMPUTING = ("numpy", "scipy", "trimesh", "fast-simplification", "xatlas", "shapely", "mujoco", "coacd")
LIMIT_BYTES = 2 * 2**30
"""The least recently used entries beyond this size are deleted."""
KEEP_S = 3600.0
"""Entries read or written within this time may belong to a running conversion, and stay."""
ROOT = Path(__file__).parents[2]
PACKAGES = ("converters", "interactive_nav", "scenes_mjcf", "interactive_nav_common")
LEAST_EACH = 4
"""Calls for each process: one takes seconds to start."""
IDLE_S = 10
"""Idle processes end after this time, and free their memory."""
NOT_HASHED = {"hashed": False}
"""Metadata of dataclass fields that no result depends on (names, reports)."""
MISSING = object()


@functools.cache
def fingerprint(module: str) -> str:
    """Return a digest of the libraries' versions, a module, its imports from the project and their YAML tables."""
    contents: dict[str, bytes] = {}
    left = [module]
    while left:
        name = left.pop()
        place = ROOT / name.replace(".", "/")
        path = next((p for p in (place.with_suffix(".py"), place / "__init__.py") if p.is_file()), None)
        if path is None or name in contents or name.partition(".")[0] not in PACKAGES:
            continue
        table = path.with_suffix(".yaml")
        contents[name] = path.read_bytes() + (table.read_bytes() if table.is_file() else b"")
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ImportFrom) and node.module:
                left += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                left += [alias.name for alias in node.names]
    parts = (sorted(package_versions(COMPUTING).items()), sorted(contents.items()))
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def hashed(value: Any) -> Any:
    """Return a value without the fields of its dataclasses that are marked as `NOT_HASHED`."""
    if dataclasses.is_dataclass(value):
        fields = [f.name for f in dataclasses.fields(value) if f.metadata.get("hashed", True)]
        return type(value).__qualname__, {name: hashed(getattr(value, name)) for name in fields}
    if isinstance(value, (tuple, list)):
        return type(value)(map(hashed, value))
    return {key: hashed(item) for key, item in value.items()} if isinstance(value, dict) else value


class StageCache:
    """Results by content in one folder."""

    def __init__(self, folder: Path, limit_bytes: int = LIMIT_BYTES, keep: bool = True) -> None:
        self.folder, self._limit_bytes, self._keep = folder, limit_bytes, keep

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """Return `function(*arguments)`, read from the folder if it is there; the function must be pure."""
        if not self._keep:
            return function(*arguments)
        key = self.key(function.__name__.strip("_"), function.__module__, *arguments)
        value = self.load(key)
        if value is MISSING:
            value = function(*arguments)
            self.store(key, value)
        return value

    def call_many(self, function: Callable[..., T], calls: Sequence[tuple], what: str) -> list[T]:
        """Return `call` of each tuple of arguments; compute on all cores what is missing, with a bar that shows `what`.

        Each result is stored once it is there: after a stop, the same call goes on.
        """
        keys = [self.key(function.__name__.strip("_"), function.__module__, *arguments) for arguments in calls]
        values = {key: self.load(key) for key in dict.fromkeys(keys)}
        todo = {key: arguments for key, arguments in zip(keys, calls, strict=True) if values[key] is MISSING}
        if todo:
            # joblib's processes, unlike those of multiprocessing, neither fork JAX's threads nor run the main module.
            jobs = min(usable_cores(), -(-len(todo) // LEAST_EACH))
            pool = joblib.Parallel(jobs, return_as="generator_unordered", max_nbytes=None, idle_worker_timeout=IDLE_S)
            results: Any = pool(joblib.delayed(_labelled)(key, function, arguments) for key, arguments in todo.items())
            with bar([]) as report, warnings.catch_warnings():
                # It replaces a process whose memory has grown, such as one that has read many textures.
                warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)
                for done, (key, value) in enumerate(results, 1):
                    values[key] = value
                    self._write(key, value)
                    report(what, done, len(todo))
            prune(self.folder, self._limit_bytes, time.time())
        return [values[key] for key in keys]

    def key(self, name: str, module: str, *arguments: Any) -> str:
        """Return the name of the entry of a module's function of these arguments."""
        return f"{name}-{joblib.hash((fingerprint(module), hashed(arguments)), 'sha1')}.pkl"

    def load(self, key: str) -> Any:
        """Return an entry, and mark it as used; `MISSING` if there is none, or a damaged one."""
        try:
            value = joblib.load(self.folder / key)
        except Exception:  # a damaged pickle fails in many ways
            return MISSING
        with contextlib.suppress(OSError):
            os.utime(self.folder / key)
        return value

    def store(self, key: str, value: Any) -> None:
        """Write an entry atomically and prune the folder; if it cannot be written, continue without the entry."""
        self._write(key, value)
        prune(self.folder, self._limit_bytes, time.time())

    def _write(self, key: str, value: Any) -> None:
        with contextlib.suppress(FileError), whole_file(self.folder / key) as partial:
            joblib.dump(value, partial)


def _labelled(key: str, function: Callable, arguments: tuple) -> tuple[str, Any]:
    return key, function(*arguments)


def prune(folder: Path, limit_bytes: int, now_s: float) -> None:
    """Delete the least recently used entries over the limit, older than `KEEP_S`, and leftovers of killed writers."""
    entries = []
    for path in folder.glob("*.pkl"):
        with contextlib.suppress(OSError):
            status = path.stat()
            entries.append((status.st_mtime, status.st_size, path))
    excess = sum(size for _, size, _ in entries) - limit_bytes
    for used_s, size, path in sorted(entries):
        if used_s > now_s - KEEP_S:
            return
        if excess > 0 or path.name.startswith(PARTIAL):
            with contextlib.suppress(OSError):
                path.unlink()
            excess -= size
