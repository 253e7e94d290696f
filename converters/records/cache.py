"""A function of arrays and its arguments in, its result out, computed once for the same content.

The key is a sha256 over the arguments, the converter's own source files and the versions of the libraries that
compute; a stale entry can therefore not be met, and the folder may be deleted at any time. Results are kept as
NPZ with a JSON tree inside (no pickles: an entry can be damaged, but cannot run).
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.resources
import json
import os
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import PARTIAL, whole_file

T = TypeVar("T")

COMPUTING = ("numpy", "scipy", "trimesh", "fast-simplification", "xatlas", "shapely", "mujoco")
LIMIT_BYTES = 2 * 2**30
"""The oldest entries go beyond this size."""
KEEP_S = 3600.0
"""What was read or written within this time may be a running conversion's, and stays."""
_NAMES = ("converters", "scenes_mjcf", "interactive_nav_common")
PACKAGES = tuple(Path(str(importlib.resources.files(name))) for name in _NAMES)
"""The converter, and what it is built on: categories and their labels, rotations."""
NOT_HASHED = {"hashed": False}
"""Metadata of dataclass fields that no stage's result depends on (names, reports)."""


@functools.cache
def fingerprint(packages: tuple[Path, ...] = PACKAGES) -> bytes:
    """Digest of the converter's modules, of the tables that have their names, and of the libraries' versions."""
    digest = hashlib.sha256(repr([(name, version(name)) for name in COMPUTING]).encode())
    for package in packages:
        # Unlike rglob, walk passes over folders that vanish: scenes may be in the making inside of a package.
        files = (Path(folder, name) for folder, _, names in os.walk(package) for name in names)
        modules = sorted(path for path in files if path.suffix == ".py")
        for path in (*modules, *(table for p in modules if (table := p.with_suffix(".yaml")).is_file())):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(package.parent).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.digest()


class StageCache:
    """Results of stages by content, in one folder; without a folder everything is computed."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self._digests: dict[int, tuple[np.ndarray, str]] = {}

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """`function(*arguments)`, from the folder where it is there.

        Args:
            function: pure and named; of arrays, numbers, strings, None, tuples, lists, dicts and the converter's
                dataclasses, and returns such.
        """
        if self.folder is None:
            return function(*arguments)
        digest = hashlib.sha256(fingerprint() + f"{function.__module__}.{function.__qualname__}".encode())
        digest.update(json.dumps(_encode(arguments, self._array_digest, key=True)).encode())
        path = self.folder / f"{function.__name__.strip('_')}-{digest.hexdigest()}.npz"
        found, value = _load(path)
        if not found:
            value = function(*arguments)
            _store(path, value)
        return value

    def _array_digest(self, array: np.ndarray) -> str:
        if id(array) not in self._digests:
            own = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
            own.update(np.ascontiguousarray(array).tobytes())
            self._digests[id(array)] = (array, own.hexdigest())  # the reference keeps the id taken
        return self._digests[id(array)][1]


def _encode(value: Any, of_array: Callable[[np.ndarray], int | str], key: bool = False) -> Any:
    """JSON tree of a value, `of_array` in place of its arrays; for a `key` without what is not hashed, with types."""
    if isinstance(value, np.ndarray):
        return {"array": of_array(value)}
    if dataclasses.is_dataclass(value):
        kind, fields = type(value), [f for f in dataclasses.fields(value) if not key or f.metadata.get("hashed", True)]
        tree = {f.name: _encode(getattr(value, f.name), of_array, key) for f in fields}
        return {"class": f"{kind.__module__}:{kind.__qualname__}", "fields": tree}
    if isinstance(value, (tuple, list)):
        name = "tuple" if isinstance(value, tuple) and not key else "list"
        return {name: [_encode(v, of_array, key) for v in value]}
    if key and isinstance(value, dict):
        return {"map": [[repr(k), _encode(value[k], of_array, key)] for k in sorted(value)]}
    if key and (value is None or isinstance(value, (bool, int, float, str, Path, np.generic))):
        return {type(value).__name__: repr(value)}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return {"value": value}
    raise TypeError(f"a {type(value).__name__} cannot be {'hashed by content' if key else 'kept in the cache'}")


def _decode(tree: Any, arrays: dict[str, np.ndarray]) -> Any:
    if "array" in tree:
        return arrays[f"a{tree['array']}"]
    if "class" in tree:
        module, _, name = tree["class"].partition(":")
        if not module.startswith("converters."):
            raise ValueError(f"{module} is no module of the converter")
        kind = getattr(importlib.import_module(module), name)
        if not dataclasses.is_dataclass(kind):
            raise ValueError(f"{name} is no record")
        return kind(**{k: _decode(v, arrays) for k, v in tree["fields"].items()})  # pyright: ignore
    if "tuple" in tree:
        return tuple(_decode(v, arrays) for v in tree["tuple"])
    if "list" in tree:
        return [_decode(v, arrays) for v in tree["list"]]
    return tree["value"]


def _load(path: Path) -> tuple[bool, Any]:
    """Whether the entry is there and whole, and its value."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        value = _decode(json.loads(bytes(arrays.pop("tree")).decode()), arrays)
    except Exception:  # a damaged archive fails in zipfile, zlib, struct or NumPy, each in its own way
        return False, None
    touch(path)
    return True, value


def _store(path: Path, value: Any) -> None:
    arrays: list[np.ndarray] = []

    def number(array: np.ndarray) -> int:
        arrays.append(array)
        return len(arrays) - 1

    tree = np.frombuffer(json.dumps(_encode(value, number)).encode(), np.uint8)
    named = {f"a{i}": a for i, a in enumerate(arrays)}
    store(path, lambda partial: np.savez(partial, tree=tree, **named))  # pyright: ignore[reportArgumentType]


def touch(path: Path) -> None:
    """Marks an entry as used: the oldest unused go first."""
    with contextlib.suppress(OSError):
        os.utime(path)


def store(path: Path, write: Callable[[Path], None], limit_bytes: int = LIMIT_BYTES) -> None:
    """Keeps an entry, whole or not at all, and its folder within the limit.

    A cache that cannot be written (full disk, read-only home) costs the next run time and this run nothing.
    """
    with contextlib.suppress(FileError), whole_file(path) as partial:
        write(partial)
    prune(path.parent, limit_bytes, time.time())


def prune(folder: Path, limit_bytes: int, now_s: float) -> None:
    """Deletes the entries that were not used for longest until the folder is within the limit.

    Those of the last `KEEP_S` stay. What a killed writer left unfinished goes in any case.
    """
    entries = []
    for path in folder.glob("*.npz"):
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
