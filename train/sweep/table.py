"""Show states of runs on the console, as a live table or plain lines."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from train.sweep.folder import RunState

STYLES = {"running": "cyan", "done": "green", "trained": "green", "failed": "red", "stopped": "yellow", "waiting": ""}
ORDER = ("running", "failed", "stopped", "trained", "waiting", "done")
REFRESH_S = 2.0
LINE_EVERY_S = 60.0


def totals(states: Sequence[RunState]) -> str:
    """Return how far the sweep is, in a line."""
    counts = Counter(state.state for state in states)
    words = ", ".join(f"{counts[name]} {name}" for name in ORDER if counts[name])
    left = sum(state.total_steps - state.env_steps for state in states if not state.over)
    speed = sum(state.metrics.get("env_steps_per_s", 0.0) for state in states if state.state == "running")
    ahead = f"; {left:,} env steps left" if left else ""
    if left and speed:
        ahead += f" at {speed:,.0f} a second: about {_hours(left / speed)}"
    return f"{len(states)} runs: {words}{ahead}"


def status_table(states: Sequence[RunState], where: dict[str, str] | None = None) -> Table:
    """Return a table with one line for each run."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("run")
    table.add_column("state")
    for label in ("env steps", "", "steps/s", "success", "INS"):
        table.add_column(label, justify="right")
    table.add_column("", overflow="fold")
    for s in states:
        share = f"{100 * s.env_steps / max(s.total_steps, 1):.0f} %"
        speed = s.metrics.get("env_steps_per_s")
        table.add_row(
            s.name,
            Text(s.state, STYLES[s.state]),
            f"{s.env_steps:,}",
            share,
            f"{speed:,.0f}" if speed else "-",
            _score(s, "episode/success"),
            _score(s, "episode/ins_0.5"),
            (where or {}).get(s.name, s.reason),
        )
    return table


class SweepDisplay:
    """A live table under the events on a terminal; elsewhere the events, and a line now and then."""

    def __init__(self, console: Console):
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._shown_at = float("-inf")

    def __enter__(self) -> SweepDisplay:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def event(self, text: str, style: str = "") -> None:
        """Print a line."""
        self._console.print(Text(f"{time.strftime('%H:%M:%S')} {text}", style), soft_wrap=True)

    def update(self, states: Sequence[RunState], where: dict[str, str]) -> None:
        """Show how far the runs are, every few seconds."""
        now = time.monotonic()
        if now - self._shown_at < (REFRESH_S if self._live else LINE_EVERY_S):
            return
        self._shown_at = now
        if self._live:
            ordered = sorted(states, key=lambda state: ORDER.index(state.state))
            self._live.update(Group(status_table(ordered, where), Text(totals(states))), refresh=True)
        else:
            self._console.print(Text(f"{time.strftime('%H:%M:%S')} {totals(states)}"), soft_wrap=True)


def _score(state: RunState, name: str) -> str:
    value = state.metrics.get(name)
    return "-" if value is None else f"{value:.2f}"


def _hours(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
