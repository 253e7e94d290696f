"""Jobs on this machine: processes, each with its share of a GPU or of the cores."""

from __future__ import annotations

from typing import Protocol

from train.sweep.devices import Machine, share_env
from train.sweep.jobs import Child, Job


class Launcher(Protocol):
    """Where jobs run."""

    def start(self, job: Job) -> str | None:
        """Starts a job; where, in a few words, or None where there is no room now."""
        ...

    def ended(self) -> list[tuple[Job, int]]:
        """The jobs that have ended since it was last asked, with their exit codes (`LOCKED`: not begun)."""
        ...

    def stop(self) -> None:
        """Asks every job to save and end."""
        ...

    def kill(self) -> None:
        """Ends every job."""
        ...

    def close(self) -> None:
        """After the last job."""
        ...


class LocalLauncher:
    """Processes on this machine."""

    def __init__(self, machine: Machine):
        self._machine = machine
        self._running: list[tuple[Job, Child, object]] = []

    def start(self, job: Job) -> str | None:
        """See `Launcher`."""
        share = self._machine.take(job.launch, job.factor)
        if share is None:
            return None
        self._running.append((job, Child(job, share_env(share, job.launch)), share))
        return share.label

    def ended(self) -> list[tuple[Job, int]]:
        """See `Launcher`."""
        over, still = [], []
        for job, child, share in self._running:
            code = child.poll()
            if code is None:
                still.append((job, child, share))
            else:
                self._machine.give_back(share)  # type: ignore[arg-type]
                over.append((job, code))
        self._running = still
        return over

    def stop(self) -> None:
        """See `Launcher`."""
        for _, child, _ in self._running:
            child.stop()

    def kill(self) -> None:
        """See `Launcher`."""
        for _, child, _ in self._running:
            child.kill()

    def close(self) -> None:
        """See `Launcher`."""
