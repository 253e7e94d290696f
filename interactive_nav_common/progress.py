"""Shares of work in, a bar on the console out."""

from __future__ import annotations

import contextlib
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
def stage_progress(console: Console) -> Iterator[Callable[[str, float], None]]:
    """One bar over the whole work, with the stage's name and the time left."""
    with Progress(
        TextColumn("{task.description:<16}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=False,
    ) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda stage, share: bar.update(task, description=stage, completed=share)


def warn_once(console: Console) -> Callable[[str], None]:
    """Prints a warning unless it has been printed before: most come while reading, and all again with the result."""
    printed: set[str] = set()

    def warn(warning: str) -> None:
        if warning not in printed:
            printed.add(warning)
            console.print(f"warning: {warning}", soft_wrap=True, markup=False, highlight=False)

    return warn
