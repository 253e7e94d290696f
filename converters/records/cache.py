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
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import joblib

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import PARTIAL, whole_file

T = TypeVar("T")

COMPUTING = ("numpy", "scipy", "trimesh", "fast-simplification", "xatlas", "shapely", "mujoco", "coacd")
LIMIT_BYTES = 2 * 2**30
"""The least recently used entries beyond this size are deleted."""
KEEP_S = 3600.0
"""Entries read or written within this time may belong to a running conversion, and stay."""
ROOT = Path(__file__).parents[2]
PACKAGES = ("converters", "scenes_mjcf", "interactive_nav_common")
"""The converter and what it is built on: categories and their labels, rotations."""
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
    parts = ([(name, version(name)) for name in COMPUTING], sorted(contents.items()))
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
        with contextlib.suppress(FileError), whole_file(self.folder / key) as partial:
            joblib.dump(value, partial)
        prune(self.folder, self._limit_bytes, time.time())


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
