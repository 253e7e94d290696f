"""Shares of work in, a bar on the console out."""

import contextlib
import functools
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


@contextlib.contextmanager
def progress_bar(
    console: Console, what: str, total: float | None = None, transient: bool = False
) -> Iterator[Callable[..., None]]:
    """A bar on a terminal, nothing elsewhere; what updates it takes `Progress.update`'s words, and a `status`."""
    columns = (
        *(TextColumn("{task.description:<14}"), BarColumn(bar_width=24), TaskProgressColumn(), TimeElapsedColumn()),
        *(TextColumn("[dim]left[/]"), TimeRemainingColumn(), TextColumn("{task.fields[status]}")),
    )
    with Progress(*columns, console=console, transient=transient, disable=not console.is_terminal) as bar:
        yield functools.partial(bar.update, bar.add_task(what, total=total, status=""))


@contextlib.contextmanager
def stage_progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    """One `progress_bar` over the whole work, with the stage's name."""
    with progress_bar(console, "starting", 1.0) as update:
        yield lambda stage, share: update(description=stage, completed=share)


def warn_once(console: Console) -> Callable[[str], None]:
    """Prints a warning unless it has been printed before: most come while reading, and all again with the result."""
    printed: set[str] = set()

    def warn(warning: str) -> None:
        if warning not in printed:
            printed.add(warning)
            console.print(f"warning: {warning}", soft_wrap=True, markup=False, highlight=False)

    return warn
