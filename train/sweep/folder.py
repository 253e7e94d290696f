"""Locate the files of a sweep's folder, read from them alone how far each run is, and show it.

<out_dir>/<name>/configs/<run>.yaml     complete config of a run, as `python -m train --config` takes it
                 runs/<run>/            its run folder
                 rows/<run>-*.parquet   its scores; in rows/_paths/ where its robot went in some episodes
                 logs/<run>.log         the output of its programs
                 failed/<run>.json      why it was given up
                 locks/<run>            held by whoever works on it
"""

import contextlib
import dataclasses
import functools
import json
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from interactive_nav_common.errors import FileError, regular
from interactive_nav_common.files import is_locked, remove_partial, write_text
from interactive_nav_common.records import RUNS
from interactive_nav_common.rows import console_table, read_notes
from train.config_io import to_yaml
from train.runs.run_folder import PATHS, EvaluationRequest, RunFolder, files_of_run, paths_beside
from train.sweep.spec import EvaluateConfig, RunSpec, Sweep

TAIL_BYTES = 1 << 16
STYLES = {"running": "cyan", "done": "green", "trained": "green", "failed": "red", "stopped": "yellow", "waiting": ""}
ORDER = ("running", "failed", "stopped", "trained", "waiting", "done")
REFRESH_S = 2.0
LINE_EVERY_S = 60.0


@dataclasses.dataclass(frozen=True)
class RunState:
    """How far a run is."""

    name: str
    state: str
    """waiting, running, stopped, trained, done or failed."""
    env_steps: int
    total_steps: int
    metrics: dict[str, Any]
    """Its last line of metrics."""
    reason: str = ""
    """Why it failed, one line."""
    over: bool = False
    """Nothing is left to train, whoever works on it now."""


class SweepFolder:
    """Paths of a sweep, and the small files in it."""

    def __init__(self, sweep: Sweep):
        self.sweep, self.root = sweep, sweep.root
        self.rows, self.runs = self.root / "rows", self.root / "runs"

    def prepare(self) -> None:
        """Create the folder, write the config of each run, and remove what killed evaluations left."""
        for run in self.sweep.runs:
            write_text(self.config(run.name), to_yaml(run.config))
        for name in ("runs", "rows", "logs", "locks", "failed"):
            (self.root / name).mkdir(exist_ok=True)
        for folder in (self.rows, self.rows / PATHS):
            remove_partial(folder)
        for run in self.sweep.runs:
            for paths in files_of_run(self.rows / PATHS, run.name, ".npz"):
                rows = self.rows / f"{paths.stem}.parquet"
                if not rows.is_file() and not is_locked(self.lock(run.name)):  # else they are yet to come
                    paths.unlink(missing_ok=True)

    def config(self, run: str) -> Path:
        return self.root / "configs" / f"{run}.yaml"

    def log(self, run: str) -> Path:
        return self.root / "logs" / f"{run}.log"

    def lock(self, run: str) -> Path:
        return self.root / "locks" / run

    def state(self, run: RunSpec) -> RunState:
        """Return how far a run is; of finished ones `done` where its rows are up to date."""
        folder = RunFolder(self.runs / run.name)
        metrics = last_line(folder.metrics)
        origin = folder.origin()
        steps, total = int(metrics.get("env_steps", 0)), run.config.run.num_timesteps
        failed = self._failure(run.name)
        over = bool(origin["completed"]) and (origin["env_steps"] or 0) >= total
        if is_locked(self.lock(run.name)):
            state = "running"
        elif over:
            state = "done" if self.evaluated(run) else "trained"
            steps = origin["env_steps"]
        elif failed:
            state = "failed"
        else:
            state = "stopped" if steps else "waiting"
        return RunState(run.name, state, steps, max(total, steps), metrics, "" if state == "done" else failed, over)

    def _failure(self, run: str) -> str:
        """Return why a run was given up, or nothing. Read once: another sweep may try the run again meanwhile."""
        path = self.root / "failed" / f"{run}.json"
        try:
            return str(RUNS.typed(RUNS.json(path, {}), dict[str, str | int], str(path)).get("reason", ""))
        except FileError as error:
            return str(error)

    def request(self, run: RunSpec) -> EvaluationRequest:
        """Return the evaluation that the sweep wants of a run."""
        wanted: EvaluateConfig = self.sweep.config.evaluate
        files = self.episode_files(run)
        fixed, digest = _read(files) if files else (None, "")
        return EvaluationRequest(
            scenes=tuple(Path(scene).name for scene in wanted.scenes or run.config.env.scenes),
            policies=("learned",),
            episodes=len(fixed.episodes) if fixed else wanted.episodes,
            seed=fixed.seed if fixed else wanted.seed,
            balanced=wanted.balanced and fixed is None,
            checkpoint=wanted.checkpoint,
            deterministic=not wanted.stochastic,
            episode_file=digest,
        )

    def episode_files(self, run: RunSpec) -> tuple[str, ...]:
        """Return the files of the fixed episodes that a run is to play."""
        from interactive_nav.robots import robot_name  # heavy, and the table of a sweep does without

        files = self.sweep.config.evaluate.episode_files
        return tuple(file.replace("{robot}", robot_name(run.config.env.robot)) for file in files)

    def evaluated(self, run: RunSpec) -> bool:
        """Return whether there are rows, as requested, of the run as far as it is trained."""
        path = self.rows / self.request(run).file_name(run.name)
        if not path.is_file():
            return False
        steps = read_notes(path).get("trained_steps")
        return steps == json.dumps(RunFolder(self.runs / run.name).origin()["env_steps"])

    def drop_old_rows(self, run: RunSpec) -> None:
        """Remove rows of an evaluation that is no longer wanted, once those that are wanted are there."""
        wanted = self.rows / self.request(run).file_name(run.name)
        for path in files_of_run(self.rows, run.name) if wanted.is_file() else []:
            if path != wanted:
                path.unlink(missing_ok=True)  # another sweep of the same name may do the same
                paths_beside(path).unlink(missing_ok=True)

    def give_up(self, run: str, reason: str, attempts: int) -> None:
        write_text(self.root / "failed" / f"{run}.json", json.dumps({"reason": reason, "attempts": attempts}) + "\n")

    def try_again(self, run: str) -> None:
        (self.root / "failed" / f"{run}.json").unlink(missing_ok=True)


@functools.cache
def _read(files: tuple[str, ...]) -> tuple[Any, str]:
    from interactive_nav.episodes import load_episode_files  # imports Brax and MJX, for seconds

    return load_episode_files(files)


def _tail(path: Path) -> list[str]:
    """Return the last lines of a file; none where there is none."""
    try:
        with open(regular(path), "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
            return file.read().decode(errors="replace").splitlines()
    except OSError:
        return []


def last_line(path: Path) -> dict[str, Any]:
    """Return the last whole line of a file of JSON lines; empty where there is none."""
    for line in reversed(_tail(path)):
        with contextlib.suppress(ValueError, RecursionError):
            parsed = json.loads(line)
            if isinstance(parsed, dict) and isinstance(parsed.get("env_steps", 0), int):
                return parsed
    return {}


def log_tail(path: Path, count: int = 6) -> list[str]:
    """Return the last lines of a log that are not blank, of its last try: a line of `== time name` begins each."""
    lines = [line.rstrip() for line in _tail(path) if line.strip()]
    start = max((i for i, line in enumerate(lines) if re.match(r"== \d{4}-\d\d-\d\d ", line)), default=-1)
    return lines[start + 1 :][-count:]


def words_of_evaluation(folder: SweepFolder, runs: list[str], program: tuple[str, ...]) -> list[str]:
    """Return the command that evaluates runs of one environment."""
    wanted = folder.sweep.config.evaluate
    words = [sys.executable, *program, *(str(folder.runs / run) for run in runs), "--dataset", str(folder.rows)]
    words += ["--policies", "learned", "--checkpoint", wanted.checkpoint, "--record", str(wanted.record)]
    words += ["--stochastic" if wanted.stochastic else "--no-stochastic"]
    words += ["--batch", str(wanted.batch)] if wanted.batch else []
    if files := folder.episode_files(next(run for run in folder.sweep.runs if run.name == runs[0])):
        words += [word for file in files for word in ("--episode-file", file)]
    else:  # of files all episodes are played
        words += ["--episodes", str(wanted.episodes), "--seed", str(wanted.seed)]
        words += ["--balanced"] if wanted.balanced else []
    return words + (["--scenes", *wanted.scenes] if wanted.scenes else [])


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
    header, lines = ("run", "state", "env steps", "", "steps/s", "success", "INS", ""), []
    for s in states:
        share, speed = s.env_steps / max(s.total_steps, 1), s.metrics.get("env_steps_per_s")
        numbers = f"{s.env_steps:,}", f"{100 * share:.0f} %", f"{speed:,.0f}" if speed else "-"
        scores = (s.metrics.get(name) for name in ("episode/success", "episode/ins_0.5"))
        shown = ("-" if score is None else f"{score:.2f}" for score in scores)
        lines.append((s.name, Text(s.state, STYLES[s.state]), *numbers, *shown, (where or {}).get(s.name, s.reason)))
    table = console_table(header, lines, left=2, box=None, pad_edge=False, header_style="bold")
    table.columns[-1].justify, table.columns[-1].overflow = "left", "fold"
    return table


class SweepDisplay(contextlib.ExitStack):
    """A live table under the events on a terminal; elsewhere the events, and a line now and then."""

    def __init__(self, console: Console):
        super().__init__()
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._shown_at = float("-inf")

    def __enter__(self) -> Self:
        if self._live:
            self.enter_context(self._live)
        return self

    def event(self, text: str, style: str = "") -> None:
        self._console.print(Text(f"{time.strftime('%H:%M:%S')} {text}", style))

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
            self._console.print(Text(f"{time.strftime('%H:%M:%S')} {totals(states)}"))


def _hours(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
