"""Show the share of work that is done as a bar on the console."""

import contextlib
import functools
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import rich.progress
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from interactive_nav_common.errors import printable
from interactive_nav_common.signals import raise_stop, stop_signals


class SafeConsole(Console):
    """Print names as they are written: they may hold neither markup nor control characters that have an effect.

    Lines are neither wrapped nor highlighted; tables are as wide as the console.
    """

    def print(self, *objects: Any, **how: Any) -> None:
        lines = all(isinstance(each, str | Text) for each in objects)
        super().print(*objects, **{"soft_wrap": lines, "highlight": not lines, **how})

    def render_str(self, text: str, **how: Any) -> Text:
        """Render text that is printed, or that stands in a table."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **{**how, "markup": False})


@contextlib.contextmanager
def progress_bar(
    console: Console, what: str, total: float | None = None, transient: bool = False
) -> Iterator[Callable[..., None]]:
    """Show a bar on a terminal, nothing elsewhere; yield its update, with `Progress.update`'s words and a `status`.

    The update raises a signal that was left to `raise_stop`.
    """
    plain = functools.partial(TextColumn, markup=False)
    columns = (
        *(plain("{task.description:<14}"), BarColumn(bar_width=24), TaskProgressColumn(), TimeElapsedColumn()),
        *(plain("left", style="dim"), TimeRemainingColumn(), plain("{task.fields[status]}")),
    )
    with rich.progress.Progress(*columns, console=console, transient=transient, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total, status="")

        def update(**fields: Any) -> None:
            raise_stop()
            bar.update(task, **fields)

        yield update


@contextlib.contextmanager
def stage_progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    """Show one `progress_bar` over the whole work, with the stage's name."""
    with progress_bar(console, "starting", 1.0) as update:
        yield lambda stage, share: update(description=stage, completed=share)


def warn_once(console: Console) -> Callable[[str], None]:
    """Return a function that prints a warning once: most come while reading, and all again with the result."""
    printed: set[str] = set()

    def warn(warning: str) -> None:
        if warning not in printed:
            printed.add(warning)
            console.print(f"warning: {warning}")

    return warn


class Stopped(Exception):
    """Stop at a signal, whose number it carries. What was done is kept, and the same command goes on."""


Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and of how much; may raise to stop."""


def say(line: str) -> None:
    """Print a line to stderr, at once."""
    print(line, file=sys.stderr, flush=True)


@contextlib.contextmanager
def bar(signals: list[int] | None = None) -> Iterator[Progress]:
    """Show a bar with the time left on a terminal, a line every tenth elsewhere; raise `Stopped` before the end.

    `signals` are those of a `stop_signals` around it; None: it collects them itself.
    """
    console = SafeConsole(stderr=True)
    collected = stop_signals() if signals is None else contextlib.nullcontext(signals)
    with collected as stops, progress_bar(console, "starting") as update:
        tenths = 0
        # Neither compiling before the first step nor what an earlier run has done says how fast it goes.
        first: tuple[float, int] | None = None

        def report(what: str, done: int, total: int) -> None:
            nonlocal tenths, first
            first = first or (time.perf_counter(), done)
            update(description=what, completed=done, total=total)
            if not console.is_terminal and done * 10 // max(total, 1) > tenths:
                tenths, (began, before), left = done * 10 // total, first, ""
                if done > before:
                    left = f", {(time.perf_counter() - began) / (done - before) * (total - done):.0f} s left"
                console.print(f"{what}: {done:,} of {total:,}{left}")
            if stops and done < total:
                raise Stopped(stops[0])

        yield report
