"""Pause Python's garbage collector in calls from JAX to Warp, and keep Warp's lines off the console.

Such a call may capture a CUDA graph. If the collector destroys a JAX program meanwhile, the capture fails (CUDA error
901; NVIDIA/warp#401 and #992, mujocolab/mjlab#821). When an old `wp.Stream` is destroyed, it unregisters the stream
that it shares with XLA (error 900, "unknown stream"). This also happens without the collector, when somebody drops the
frame of an old call within a new one, as samplers of `sys._current_frames` do: profile from outside of the process.
"""

import functools
import gc
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import mlir

_held = Primitive("held")
_held.def_impl(lambda x, *, owner: x)
_held.def_abstract_eval(lambda x, *, owner: x)


def _lower_held(ctx: Any, x: Any, *, owner: Any) -> list[Any]:
    ctx.module_context.add_keepalive(owner)
    return [x]


mlir.register_lowering(_held, _lower_held)


def held(x: jax.Array, owner: object) -> jax.Array:
    """Return the array; its program keeps `owner` alive, whose memory Warp reads, as long as the program lives."""
    return _held.bind(x, owner=owner)


class _Suspended:
    """Suspend the collector while any thread is inside, and restore its state afterwards."""

    def __init__(self) -> None:
        self._lock, self._inside, self._collects = threading.Lock(), 0, False

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._collects = gc.isenabled()
                gc.disable()
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside and self._collects:
                gc.enable()


_SUSPENDED = _Suspended()


def quieten() -> None:
    """Replace Warp's lines, one per kernel, by a single line if none is compiled yet; once is enough."""
    import warp

    if warp.config.log_level != warp.LOG_INFO:  # somebody chose, or it was done
        return
    warp.config.log_level = warp.LOG_WARNING
    warp.init()
    kept = warp.config.kernel_cache_dir
    if kept and not any(Path(kept).glob("wp_*mujoco_warp*")):
        print(f"Warp compiles its kernels: about two minutes the first time (kept in {kept})", file=sys.stderr)


def keep_collector_out() -> None:
    """Suspend the collector in every callback of Warp's that is created from now on; once is enough."""
    from warp._src.jax.ffi import FfiCallable

    quieten()

    # Warp has no public place for this: `jax_callable` registers the bound method.
    if not hasattr(FfiCallable.ffi_callback, "__wrapped__"):
        FfiCallable.ffi_callback = without_collector(FfiCallable.ffi_callback)


def without_collector(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with the collector suspended in its calls."""

    @functools.wraps(function)
    def quiet(*args: Any, **kwargs: Any) -> Any:
        with _SUSPENDED:
            return function(*args, **kwargs)

    return quiet
