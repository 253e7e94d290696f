"""Collect SIGINT, SIGTERM and SIGHUP for programs that save before they end, hold them back, or never lose them."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""SIGHUP comes when the terminal closes; under nohup it is ignored, and stays so."""
Handler = Callable[[int, FrameType | None], Any]
_AGAIN_S = 0.05
_LOST_IN = ("<frozen importlib._bootstrap>", "jax/_src/compiler.py", "jax/_src/callback.py")


def heard(handler: Handler) -> Handler:
    """Wrap a handler that raises, so that what it raises is not lost.

    Some modules catch all that happens while they import others, and nothing leaves a destructor or a callback of the
    garbage collector or of a weak reference. JAX turns what leaves a callback into another error, and a compilation
    that is left runs on and crashes the interpreter at its end. There the signal comes again a moment later.
    """

    def raising(number: int, frame: FrameType | None) -> None:
        within = frame
        while within:
            if within.f_code.co_filename.endswith(_LOST_IN):
                return _come_again(number)
            within = within.f_back
        try:
            handler(number, frame)
        except BaseException as raised:
            raised.signal_number = number  # type: ignore[attr-defined]
            raise

    if not hasattr(sys.unraisablehook, "before"):
        sys.unraisablehook = _lost_again(sys.unraisablehook)
    return raising


def number_of(stop: KeyboardInterrupt) -> int:
    """Return the signal that raised it."""
    return getattr(stop, "signal_number", signal.SIGINT)


def _lost_again(before: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def hook(unraisable: Any) -> None:
        """Handle what Python cannot raise: a signal comes again, all else is for the hook before."""
        number = getattr(unraisable.exc_value, "signal_number", None)
        _come_again(number) if number else before(unraisable)

    hook.before = before  # type: ignore[attr-defined]
    return hook


def _come_again(number: int) -> None:
    timer = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
    timer.daemon = True
    timer.start()


@contextlib.contextmanager
def interrupts_heard(*also: int) -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGINT as always, but where it is not lost, and SystemExit at other stops.

    The latter, where they would end the process at once: so nothing unfinished stays behind. Signals that others
    handle, or that are ignored, are left alone.

    Args:
        *also: signals that raise KeyboardInterrupt, too, unless they are ignored. `number_of` tells which.
    """
    mine = threading.current_thread() is threading.main_thread()
    usual = {n: signal.getsignal(n) for n in STOPS if mine}
    keyboard, ends = (heard(h) for h in (signal.default_int_handler, lambda number, _: sys.exit(128 + number)))
    others = (signal.SIG_IGN, None)
    chosen: dict[int, Any] = {
        n: keyboard if n in also or h is signal.default_int_handler else ends
        for n, h in usual.items()
        if h in (signal.default_int_handler, signal.SIG_DFL) or n in also and h not in others
    }
    with _handled(chosen):
        yield


@contextlib.contextmanager
def _handled(handlers: dict[int, Any]) -> Iterator[None]:
    usual = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def stop_signals(second_ends: bool = True) -> Iterator[list[int]]:
    """Collect `STOPS` into the list that it yields; what they did before is put back at the end.

    Args:
        second_ends: a second one acts as it always would; False: it is collected too (a sweep waits for its runs,
            which save).
    """
    collected: list[int] = []
    usual: dict[int, Any] = {n: signal.getsignal(n) for n in STOPS}
    if usual[signal.SIGHUP] is signal.SIG_IGN:
        del usual[signal.SIGHUP]

    def remember(number: int, _: FrameType | None) -> None:
        collected.append(number)
        if second_ends:
            signal.signal(number, usual[number])

    with _handled(dict.fromkeys(usual, remember)):
        yield collected


@contextlib.contextmanager
def signals_wait() -> Iterator[None]:
    """Hold back `STOPS`; one that came is raised at the end.

    By handlers and not by a mask, which would hold for this thread only: libraries run others.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # Python runs handlers in the main thread only
        return
    with stop_signals(second_ends=False) as came:
        yield
    for number in came[:1]:
        signal.raise_signal(number)
