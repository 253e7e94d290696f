"""Run commands as processes that end with whoever started them, and on request; return their exit codes."""

import contextlib
import dataclasses
import itertools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from interactive_nav_common.files import take_lock

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
LATE = -1002
"""In place of an exit code: it ran past its time limit and was killed."""
POLL_S = 0.05
Share = tuple[str | None, float]
"""Part of a machine for one job: a GPU's name, if it has any, and a fraction of its memory or of the cores."""


def our_env() -> dict[str, str]:
    """Return the environment of a child that runs our programs: the same code as here, from whatever folder."""
    ours = str(Path(__file__).resolve().parents[2])
    paths = [ours, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {"PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)), "PYTHONUNBUFFERED": "1"}


@dataclasses.dataclass(frozen=True)
class Job:
    """One program to run."""

    name: str
    """For people."""
    command: tuple[str, ...]
    log: Path
    """What it prints is added there."""
    locks: tuple[Path, ...] = ()
    env: Mapping[str, str] = dataclasses.field(default_factory=our_env)
    timeout_s: float = math.inf
    cpus: float = 1.0
    """Cores, of a cluster's."""
    gpus: float = 0.0
    """GPUs, of a cluster's that has any."""

    def env_on(self, gpu: str | None, part: float) -> Mapping[str, str]:
        """Return more environment, to keep to a share of a machine."""
        return {}


class Child:
    """A job's process; holds its locks as long as it lives."""

    def __init__(self, job: Job, env: Mapping[str, str], logged: bool = True):
        """Start the process; unless `logged`, it shares our input and output."""
        self._process: subprocess.Popen[bytes] | None = None
        self._until = time.monotonic() + job.timeout_s
        held: list[int] = []
        with contextlib.ExitStack() as here:
            for path in job.locks:
                descriptor = take_lock(path)
                if descriptor is None:
                    return
                here.callback(os.close, descriptor)
                held.append(descriptor)
            log = here.enter_context(open(job.log, "ab", buffering=0)) if logged else None
            if log:
                log.write(f"== {time.strftime('%Y-%m-%d %H:%M:%S')} {job.name}\n".encode())
            self._process = subprocess.Popen(
                [sys.executable, "-c", GUARD, *job.command],
                stdin=subprocess.DEVNULL if log else None,
                stdout=log,
                stderr=subprocess.STDOUT if log else None,
                env={**os.environ, **job.env, **env},
                pass_fds=held,
                start_new_session=True,  # Ctrl-C is for us: the child gets it once, as SIGTERM
            )

    def poll(self) -> int | None:
        """Return the exit code, `LOCKED`, `LATE`, or None while it runs."""
        if self._process is None:
            return LOCKED
        code = self._process.poll()
        if code is None and time.monotonic() > self._until:
            self.send(signal.SIGKILL)
            self._process.wait()
            return LATE
        return code

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end, at most `timeout_s`; return what `poll` does."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return LOCKED if self._process is None else self._process.wait(timeout_s)

    def send(self, number: signal.Signals) -> None:
        """Ask it to save and end with SIGTERM; end it and its children with SIGKILL."""
        if self._process is not None and self._process.poll() is None:
            if number == signal.SIGKILL:
                os.killpg(self._process.pid, number)
            else:
                self._process.send_signal(number)


class Launcher:
    """Run jobs as processes on this machine, `side_by_side` of them at a time."""

    def __init__(self, side_by_side: int = 1) -> None:
        self._side_by_side = side_by_side
        self.running: list[tuple[Any, Any, Share]] = []
        """Job, its process (a `Child`, or what has its `poll` and `send`), and its share."""

    def take(self, job: Any) -> Share | None:
        """Return a share for a job, beside those that run; None where there is no room now."""
        return (None, 1.0 / self._side_by_side) if len(self.running) < self._side_by_side else None

    def begin(self, job: Job, share: Share) -> Any:
        """Start the process of a job in its share."""
        return Child(job, job.env_on(*share))

    def start(self, job: Job) -> str | None:
        """Start a job; return where in a few words, or None where there is no room now."""
        share = self.take(job)
        if share is None:
            return None
        self.running.append((job, self.begin(job, share), share))
        return self.where(share)

    def where(self, share: Share) -> str:
        """Return where a job with a share runs, in a few words."""
        return "cpu" if share[0] is None else f"gpu {share[0]}"

    def ended(self) -> list[tuple[Any, int]]:
        """Return the jobs that have ended since the last call, with their exit codes (`LOCKED`: not started)."""
        polled = [(one, one[1].poll()) for one in self.running]
        self.running = [one for one, code in polled if code is None]
        return [(job, code) for (job, *_), code in polled if code is not None]

    def send(self, number: signal.Signals) -> None:
        """Send SIGTERM, so that they save and end, or SIGKILL to all jobs."""
        for _, process, _ in self.running:
            process.send(number)

    def end(self, grace_s: float) -> None:
        """Stop what still runs, kill it after `grace_s`, and close."""
        self.send(signal.SIGTERM)
        deadline = time.monotonic() + grace_s
        while self.running and time.monotonic() < deadline:
            self.ended()
            time.sleep(POLL_S)
        self.send(signal.SIGKILL)
        self.close()

    def close(self) -> None:
        """Release what it holds, after the last job."""


def run_jobs(
    launcher: Launcher, jobs: Iterable[Any] | Callable[[], Iterable[Any] | None], grace_s: float, poll_s: float = POLL_S
) -> Generator[tuple[Any, int], None, None]:
    """Run jobs where there is room; yield each, with its exit code, as it ends: one that fails stops no other.

    Closed early, by a signal or an error, it ends what runs: `grace_s` lie between asking it to save and end, and
    killing it. Jobs run in turn, each drawn once the one before has room; or a function, called before each look for
    room, returns those that may start now, the most urgent first, or None if no more will come.
    """
    ready = jobs if callable(jobs) else _in_turn(jobs)
    try:
        while (todo := ready()) is not None or launcher.running:
            for job in todo or ():
                if not launcher.start(job):
                    break
            time.sleep(poll_s)
            yield from launcher.ended()
    finally:
        launcher.end(grace_s)


def _in_turn(jobs: Iterable[Any]) -> Callable[[], Iterator[Any] | None]:
    """Return a function that returns the jobs that are left; one is left until the next one is drawn."""
    left = iter(jobs)
    head = list(itertools.islice(left, 1))

    def drawn() -> Iterator[Any]:
        while head:
            yield head[0]
            head[:] = itertools.islice(left, 1)

    return lambda: drawn() if head else None
