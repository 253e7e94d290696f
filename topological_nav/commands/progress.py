"""How far a command is, on the terminal; and how a signal stops it."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from interactive_nav_common.jobs.progress import SafeConsole, progress_bar
from interactive_nav_common.signals import stop_signals
from topological_nav.errors import Host, Progress, Stopped


@contextmanager
def terminal() -> Iterator[Host]:
    """Show lines on stdout, at once, and stop at a signal."""
    with stop_signals() as stops:
        yield Host(lambda line: print(line, flush=True), lambda: stops[0] if stops else 0)


def say(line: str) -> None:
    """Print a line to stderr, at once."""
    print(line, file=sys.stderr, flush=True)


@contextmanager
def bar(signals: list[int] | None = None) -> Iterator[Progress]:
    """Show a bar with the time left on a terminal, a line every tenth elsewhere; raise `Stopped` before the end.

    `signals` are those of a `stop_signals` around it; None: it collects its own.
    """
    console = SafeConsole(stderr=True)
    collected = stop_signals() if signals is None else nullcontext(signals)
    with collected as stops, progress_bar(console, "starting") as update:
        tenths = 0
        # Neither compiling before the first step nor what an earlier run has done says how fast it goes.
        first: tuple[float, int] | None = None

        def tell(what: str, done: int, total: int) -> None:
            nonlocal tenths, first
            first = first or (time.perf_counter(), done)
            update(description=what, completed=done, total=total)
            if not console.is_terminal and done * 10 // max(total, 1) > tenths:
                tenths, (began, before), left = done * 10 // total, first, ""
                if done > before:
                    left = f", {(time.perf_counter() - began) / (done - before) * (total - done):.0f} s left"
                console.print(f"{what}: {done:,} of {total:,}{left}", highlight=False, soft_wrap=True)
            if stops and done < total:
                raise Stopped(stops[0])

        yield tell
