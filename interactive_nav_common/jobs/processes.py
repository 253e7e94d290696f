"""Run commands as processes that end with whoever started them, and on request; return their exit codes."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from interactive_nav_common.locks import take_lock

# The child gets SIGTERM (it saves and ends) when its parent dies, however that happens: a run that nobody watches
# would be in the way of the same command given again. Linux only; elsewhere the lock alone guards.
GUARD = (
    "import ctypes, os, sys\n"
    "try: ctypes.CDLL(None).prctl(1, 15)\n"
    "except (OSError, AttributeError): pass\n"
    "os.execv(sys.argv[1], sys.argv[1:])"
)
LOCKED = -1000
"""In place of an exit code: somebody else holds one of the locks."""
LOST = -1001
"""In place of an exit code: the node that it ran on, or its worker there, is gone."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One program to run."""

    name: str
    """For people."""
    command: tuple[str, ...]
    log: Path
    """What it prints is added there."""
    locks: tuple[Path, ...] = ()
    env: Mapping[str, str] = dataclasses.field(default_factory=dict)
    cpus: float = 1.0
    """Cores, of a cluster's."""
    gpus: float = 0.0
    """GPUs, of a cluster's that has any."""

    def env_on(self, gpu: str | None, part: float) -> Mapping[str, str]:
        """Return more environment for a node of a cluster, with this part of its GPU of this name."""
        return {}


class Child:
    """A job's process; holds its locks as long as it lives."""

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
                    start_new_session=True,  # Ctrl-C is for us: the child gets it once, as SIGTERM
                )
        finally:
            for descriptor in held:
                os.close(descriptor)

    def poll(self) -> int | None:
        """Return the exit code, `LOCKED`, or None while it runs."""
        return LOCKED if self._process is None else self._process.poll()

    def wait(self) -> int:
        """Wait until it has ended; return what `poll` does."""
        return LOCKED if self._process is None else self._process.wait()

    def stop(self) -> None:
        """Ask it to save and end."""
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it and its children."""
        self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None and self._process.poll() is None:
            if number == signal.SIGKILL:
                os.killpg(self._process.pid, number)
            else:
                self._process.send_signal(number)


Begun = tuple[Any, str, Callable[[], None]]
"""A job's process, where it runs in a few words, and what to do when it has ended."""


class Launcher:
    """Where jobs run."""

    def __init__(self) -> None:
        self._running: list[tuple[Job, Any, Callable[[], None]]] = []
        """Job, its process (a `Child`, or what has its `poll`, `stop` and `kill`), and what to do when it has ended."""

    def _begin(self, job: Job) -> Begun | None:
        """Start a job; return None where there is no room now."""
        raise NotImplementedError

    def start(self, job: Job) -> str | None:
        """Start a job; return where in a few words, or None where there is no room now."""
        begun = self._begin(job)
        if begun is None:
            return None
        process, where, give_back = begun
        self._running.append((job, process, give_back))
        return where

    def ended(self) -> list[tuple[Any, int]]:
        """Return the jobs that have ended since the last call, with their exit codes (`LOCKED`: not started)."""
        over, still = [], []
        for running in self._running:
            job, process, give_back = running
            code = process.poll()
            if code is None:
                still.append(running)
            else:
                give_back()
                over.append((job, code))
        self._running = still
        return over

    def stop(self) -> None:
        """Ask every job to save and end."""
        for _, process, _ in self._running:
            process.stop()

    def kill(self) -> None:
        """End every job."""
        for _, process, _ in self._running:
            process.kill()

    def end(self, grace_s: float) -> None:
        """Stop what still runs, kills it after `grace_s`, and closes."""
        self.stop()
        deadline = time.monotonic() + grace_s
        while self._running and time.monotonic() < deadline:
            self.ended()
            time.sleep(0.05)
        self.kill()
        self.close()

    def close(self) -> None:
        """Release what it holds, after the last job."""


class LocalLauncher(Launcher):
    """Processes on this machine, so many side by side."""

    def __init__(self, side_by_side: int):
        super().__init__()
        self._side_by_side = side_by_side

    def _begin(self, job: Job) -> Begun | None:
        return (Child(job, {}), "here", lambda: None) if len(self._running) < self._side_by_side else None
