"""SIGINT and SIGTERM as data: programs that save before they end ask a list whether they should."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType
from typing import Any


@contextlib.contextmanager
def stop_signals(second_ends: bool = True) -> Iterator[list[int]]:
    """Collects SIGINT and SIGTERM into the list that it yields; what they did before is put back at the end.

    Args:
        second_ends: a second one acts as it always would; False: it is collected too (a sweep waits for its runs,
            which save).
    """
    seen: list[int] = []
    usual: dict[int, Any] = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}

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
