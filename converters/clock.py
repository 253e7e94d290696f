"""Measure the time of each stage of a conversion, the share that is done, and the memory that it takes."""

import contextlib
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from interactive_nav_common.signals import raise_stop

STAGES = dict(read=1.0, align=0.5, decompose=25.0, cut=3.0, map=1.0, settle=4.0, texture=10.0, write=1.0, gates=3.0)
"""Stage -> seconds it took on the sample room on two cores: weights of the progress bar."""

Report = Callable[[str, float], None]
"""Called with the stage's name and the share of the whole work that is done, 0 to 1."""


def peak_memory_mib(pid: int | str = "self") -> float:
    """Return a process's peak memory, MiB, or 0 if unknown; `ru_maxrss` would include the parent's peak."""
    with contextlib.suppress(OSError):
        if match := re.search(r"VmHWM:\s+(\d+) kB", Path("/proc", str(pid), "status").read_text()):
            return int(match[1]) / 1024
    return 0.0


class Clock:
    """Time the stages and turn their shares into one progress number."""

    def __init__(self, report: Report) -> None:
        self.report = report
        self.seconds: dict[str, float] = {}
        self.floors = 1
        self._before = 0.0

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Callable[[float], None]]:
        per_floor = sum(STAGES.values()) - STAGES["read"]
        total = STAGES["read"] + self.floors * per_floor
        start = time.monotonic()

        def inner(share: float) -> None:
            raise_stop()
            self.report(name, min((self._before + STAGES[name] * min(share, 1.0)) / total, 1.0))

        inner(0.0)
        yield inner
        inner(1.0)
        self._before += STAGES[name]
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start
