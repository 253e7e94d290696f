"""Record SIGINT, SIGTERM and SIGHUP for loops that look between two pieces of work, or raise them at once."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""SIGHUP comes when the terminal closes; under nohup it is ignored, and stays so."""
_came: list[BaseException] = []
"""What the handlers of `interrupts_heard` have recorded, whether they raised it or not."""


def number_of(stop: BaseException) -> int:
    """Return the signal that raised a KeyboardInterrupt or a `Stopped`."""
    return stop.args[0] if stop.args else signal.SIGINT


def raise_stop() -> None:
    """Raise the first signal within `interrupts_heard` that is still without effect; call it between pieces of work.

    It was only recorded, or Python lost what its handler raised: some modules catch all that happens while they import
    others, and nothing leaves a destructor or a callback of the garbage collector or of a weak reference.
    """
    if _came:
        raise _came.pop(0)


@contextlib.contextmanager
def interrupts_heard(*also: int, at_once: bool = True) -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGINT and `also`, and SystemExit at other stops, which would end the process at once.

    So nothing unfinished stays behind. Signals that others handle, or that are ignored, are left alone. Without
    `at_once`, the first is left to `raise_stop`: JAX turns what leaves a callback into another error, and a compilation
    that is left runs on and crashes the interpreter at its end.
    """

    def handler(number: int, _: FrameType | None) -> None:
        _came.append(KeyboardInterrupt(number) if number in (signal.SIGINT, *also) else SystemExit(128 + number))
        if at_once or len(_came) > 1:
            raise _came[-1]

    usual = {n: signal.getsignal(n) for n in STOPS}
    ours, others = (signal.default_int_handler, signal.SIG_DFL), (signal.SIG_IGN, None)
    chosen = [n for n, h in usual.items() if h in ours or n in also and h not in others]
    try:
        with _handled(dict.fromkeys(chosen, handler)):
            yield
    finally:
        _came.clear()


@contextlib.contextmanager
def _handled(handlers: dict[int, Any]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        handlers = {}  # Python sets handlers, and runs them, in the main thread only
    usual = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def stop_signals(second_ends: bool = True) -> Iterator[list[int]]:
    """Collect `STOPS` into the list that it yields; what they did before is put back at the end.

    A second one acts as it always would, or without `second_ends` is collected too.
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
    """Delay `STOPS`; one that came is raised at the end.

    By handlers and not by a mask, which would hold for this thread only: libraries run others.
    """
    with stop_signals(second_ends=False) as came:
        yield
    for number in came[:1]:
        signal.raise_signal(number)
