"""Jobs on this machine: processes, each with its share of a GPU or of the cores."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from train.sweep.devices import Machine, share_env
from train.sweep.jobs import Child, Job


class Launcher:
    """Where jobs run."""

    def __init__(self) -> None:
        self._running: list[tuple[Job, Any, Callable[[], None]]] = []
        """Job, its process (a `Child`, or what has its `poll`, `stop` and `kill`), and what to do when it has ended."""

    def _begin(self, job: Job) -> tuple[Any, str, Callable[[], None]] | None:
        """A job's process, where it runs in a few words, and what to do when it has ended; None: no room now."""
        raise NotImplementedError

    def start(self, job: Job) -> str | None:
        """Starts a job; where, in a few words, or None where there is no room now."""
        begun = self._begin(job)
        if begun is None:
            return None
        process, where, give_back = begun
        self._running.append((job, process, give_back))
        return where

    def ended(self) -> list[tuple[Job, int]]:
        """The jobs that have ended since it was last asked, with their exit codes (`LOCKED`: not begun)."""
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
        """Asks every job to save and end."""
        for _, process, _ in self._running:
            process.stop()

    def kill(self) -> None:
        """Ends every job."""
        for _, process, _ in self._running:
            process.kill()

    def close(self) -> None:
        """After the last job."""


class LocalLauncher(Launcher):
    """Processes on this machine."""

    def __init__(self, machine: Machine):
        super().__init__()
        self._machine = machine

    def _begin(self, job: Job) -> tuple[Any, str, Callable[[], None]] | None:
        share = self._machine.take(job.launch, job.factor)
        if share is None:
            return None
        return Child(job, share_env(share, job.launch)), share.label, lambda: self._machine.give_back(share)
