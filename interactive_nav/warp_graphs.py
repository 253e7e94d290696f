"""CUDA graphs that MJX-Warp captures: enough of them are kept, and Python's garbage collector stays out.

A capture runs Python for a second. Whatever the collector finds dead meanwhile, a program that JAX has compiled for
one, is destroyed on the device at once, which no capture survives (CUDA errors 900 and 901: NVIDIA/warp#401 and #992,
mujocolab/mjlab#821). Captures are made again whenever a buffer has moved, so this may come at any step.
"""

from __future__ import annotations

import functools
import gc
from typing import Any

GRAPHS = 128
"""Kept of each function. A control step makes one for each of its substeps, and all of them anew where XLA has moved a
buffer; of Warp's own 32 a loop that draws images between its steps finds few again."""


def keep_graphs() -> None:
    """Makes Warp keep `GRAPHS` of every function that JAX calls from now on; once is enough."""
    import warp as wp

    if "graph_cache_max" not in getattr(wp.jax_callable, "keywords", {}):
        wp.jax_callable = functools.partial(wp.jax_callable, graph_cache_max=GRAPHS)


def keep_collector_out() -> None:
    """Makes Warp's captures, `wp.ScopedCapture`, suspend the collector; once is enough."""
    import warp as wp

    if not getattr(wp.ScopedCapture, "suspends_collector", False):
        wp.ScopedCapture = suspending(wp.ScopedCapture)  # type: ignore[misc]


def suspending(capture: Any) -> Any:
    """A class of context managers whose body the collector, where it is on, does not interrupt."""

    class Suspending(capture):
        suspends_collector = True

        def __enter__(self) -> Any:
            self._collects = gc.isenabled()
            gc.disable()
            try:
                return super().__enter__()
            except BaseException:
                self._resume()
                raise

        def __exit__(self, *raised: Any) -> Any:
            try:
                return super().__exit__(*raised)
            finally:
                self._resume()

        def _resume(self) -> None:
            if self._collects:
                gc.enable()

    return Suspending
