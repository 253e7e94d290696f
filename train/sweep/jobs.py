"""A command in, its exit code out; it ends with whoever started it, and when it is asked to."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from interactive_nav_common.locks import take_lock
from train.sweep.spec import LaunchConfig

# The child gets SIGTERM (it saves and ends) when its parent dies, however that happens: a run that nobody watches
# would be in the way of the same command given again. Linux only; elsewhere the lock alone guards.
GUARD = (
    "import ctypes, os, sys\n"
    "try: ctypes.CDLL(None).prctl(1, 15)\n"
    "except (OSError, AttributeError): pass\n"
    "os.execv(sys.argv[1], sys.argv[1:])"
)
LOCKED = -1000
"""In place of an exit code: somebody else works on one of the runs."""
LOST = -1001
"""In place of an exit code: the node that it ran on, or its worker there, is gone."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One program to run for one or several runs."""

    kind: str
    """train or evaluate."""
    runs: tuple[str, ...]
    command: tuple[str, ...]
    log: Path
    locks: tuple[Path, ...]
    env: Mapping[str, str]
    launch: LaunchConfig
    factor: float = 1.0
    """Times the usual share of a GPU."""

    @property
    def name(self) -> str:
        """For people."""
        first, *others = self.runs
        return f"{self.kind} {first}" + (f" and {len(others)} more" if others else "")


class Child:
    """A job's process; holds the locks of its runs as long as it lives."""

    def __init__(self, job: Job, env: Mapping[str, str]):
        self._process: subprocess.Popen[bytes] | None = None
        held = []
        for path in job.locks:
            descriptor = take_lock(path)
            if descriptor is None:
                break
            held.append(descriptor)
        try:
            if len(held) < len(job.locks):
                return
            with open(job.log, "ab") as log:
                log.write(f"== {time.strftime('%Y-%m-%d %H:%M:%S')} {job.name}\n".encode())
                log.flush()
                self._process = subprocess.Popen(
                    [sys.executable, "-c", GUARD, *job.command],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, **job.env, **env},
                    pass_fds=held,
                    start_new_session=True,  # Ctrl-C is for us: the child is told once, by SIGTERM
                )
        finally:
            for descriptor in held:
                os.close(descriptor)

    def poll(self) -> int | None:
        """The exit code, `LOCKED`, or None while it runs."""
        return LOCKED if self._process is None else self._process.poll()

    def wait(self) -> int:
        """As `poll`, once it has ended."""
        return LOCKED if self._process is None else self._process.wait()

    def stop(self) -> None:
        """Asks it to save and end."""
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """Ends it and its children."""
        self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None and self._process.poll() is None:
            if number == signal.SIGKILL:
                os.killpg(self._process.pid, number)
            else:
                self._process.send_signal(number)
