"""SIGINT and SIGTERM: collected by programs that save before they end, or held back for an instant."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

STOPS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_signals(second_ends: bool = True) -> Iterator[list[int]]:
    """Collects SIGINT and SIGTERM into the list that it yields; what they did before is put back at the end.

    Args:
        second_ends: a second one acts as it always would; False: it is collected too (a sweep waits for its runs,
            which save).
    """
    seen: list[int] = []
    usual: dict[int, Any] = {n: signal.getsignal(n) for n in STOPS}

    def remember(number: int, _: FrameType | None) -> None:
        seen.append(number)
        if second_ends:
            signal.signal(number, usual[number])

    for number in usual:
        signal.signal(number, remember)
    try:
        yield seen
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def signals_wait() -> Iterator[None]:
    """Holds back SIGINT and SIGTERM; one that came is raised at the end.

    By handlers and not by a mask, which would hold for this thread only: libraries run others.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # Python runs handlers in the main thread only
        return
    with stop_signals(second_ends=False) as came:
        yield
    for number in came[:1]:
        signal.raise_signal(number)
