"""How far a command is, on the terminal; and how a signal stops it."""

import sys
import time
from contextlib import contextmanager

from interactive_nav_common.jobs.progress import SafeConsole, progress_bar
from topological_nav.errors import Asked, Progress, Stopped


def stopping(tell: Progress, stops: list[int]) -> Progress:
    """The same, which raises `Stopped` before the end once `stops` has a signal (see `signals.stop_signals`)."""

    def told(what: str, done: int, total: int) -> None:
        tell(what, done, total)
        if stops and done < total:
            raise Stopped(stops[0])

    return told


def asked_by(stops: list[int]) -> Asked:
    """Asks a list of signals that came (see `signals.stop_signals`)."""
    return lambda: stops[0] if stops else 0


def say(line: str) -> None:
    """A line to stderr, at once."""
    print(line, file=sys.stderr, flush=True)


def tell_line(line: str) -> None:
    """A line to stdout, at once."""
    print(line, flush=True)


@contextmanager
def bar():
    """A bar with the time left on a terminal, a line every tenth elsewhere."""
    console = SafeConsole(stderr=True)
    with progress_bar(console, "starting") as update:
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

        yield tell
