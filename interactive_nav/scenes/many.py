"""Do the same for each of many homes, on all cores and once, and check that they fit into memory."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import cache_folder
from interactive_nav_common.jobs.cache import StageCache

T = TypeVar("T")

FEW = 8
"""Fewer homes are built by threads of this process, and not kept: that is as fast, and leaves no files."""
LIMIT_BYTES = 8 * 2**30
"""Of what is kept, 3 MB for a cluttered home."""


def for_each_home(function: Callable[..., T], calls: Sequence[tuple], what: str) -> list[T]:
    """Return a pure function's results for each tuple of arguments, one a home; keep those of many homes."""
    if len(calls) < FEW:
        with ThreadPoolExecutor() as pool:  # MuJoCo, and NumPy with large arrays, do not hold Python's lock
            return list(pool.map(lambda arguments: function(*arguments), calls))
    return StageCache(cache_folder() / "homes", LIMIT_BYTES).call_many(function, calls, what)


def free_bytes() -> int:
    """Return the memory that the first device has left for arrays; for a CPU, all that the machine has."""
    memory = jax.local_devices()[0].memory_stats()
    if memory and "bytes_limit" in memory:
        return memory["bytes_limit"] - memory["bytes_in_use"]
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def check_device_memory(what: str, count: int, arrays: Any, devices: int = 1) -> None:
    """Raise `ConfigError` where these arrays, or shapes, of `count` homes or environments exceed `free_bytes`.

    Each device holds an equal share. What a step needs besides is not counted: what passes may still not fit.
    """
    needed = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(arrays)) // devices
    free = free_bytes()
    if needed > free:
        raise ConfigError(
            f"{count:,} {what} take {needed / 1e9:.3g} GB of each device, expected at most the {free / 1e9:.3g} GB "
            f"that are free; take {free * count // needed:,} {what} or fewer"
        )
