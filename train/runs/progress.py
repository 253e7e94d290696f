"""Show metrics on the console, as lines or a live bar."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from interactive_nav_common.jobs.progress import progress_bar


class TrainingDisplay:
    """A live bar on a terminal; one line a log interval elsewhere."""

    def __init__(self, console: Console):
        self.console = console
        self._shown = progress_bar(console, "training")
        self._total = 0

    def __enter__(self) -> TrainingDisplay:
        self._bar = self._shown.__enter__()
        self._bar(status="compiling")
        return self

    def __exit__(self, *error: Any) -> None:
        self._shown.__exit__(*error)

    def begin(self, env_steps: int, total_steps: int) -> None:
        """Set the range of steps to show."""
        self._total = total_steps
        self._bar(completed=env_steps, total=total_steps)

    def update(self, env_steps: int) -> None:
        """Move the bar."""
        self._bar(completed=env_steps)

    def log(self, env_steps: int, metrics: dict[str, float]) -> None:
        """Show a log interval's scores."""
        status = describe(metrics)
        self._bar(completed=env_steps, status=status)
        if not self.console.is_terminal:
            left = (self._total - env_steps) / max(metrics["env_steps_per_s"], 1e-9)
            share = 100.0 * env_steps / max(self._total, 1)
            reached = f"training {share:3.0f} %  {env_steps:,} of {self._total:,} steps  {left:.0f} s left"
            self.console.print(f"{reached}  {status}", highlight=False, soft_wrap=True)


def describe(metrics: dict[str, float]) -> str:
    """Return the speed and scores of a log interval in a few words."""
    words = [f"{metrics['env_steps_per_s']:,.0f} steps/s"]
    for label, name in (("success", "success"), ("INS", "ins_0.5"), ("reward", "sum_reward")):
        value = metrics.get(f"episode/{name}")
        words.append(f"{label} {'-' if value is None else format(value, '.2f')}")
    return "  ".join(words)
