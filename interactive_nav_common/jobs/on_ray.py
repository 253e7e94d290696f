"""Run jobs on a Ray cluster: one actor per job, on any node that has room; all nodes see the same folder."""

import logging
import os
import signal
from typing import Any

from interactive_nav_common.errors import ConfigError, missing, optional
from interactive_nav_common.jobs.processes import LOST, Child, Job, Launcher, Share


class Worker(Child):
    """In the actor: the job's process, with the GPU that Ray gave it; `send` comes while `wait` waits."""

    def __init__(self, job: Job, cwd: str, fraction: float):
        os.chdir(cwd)
        gpu = os.environ.get("CUDA_VISIBLE_DEVICES") if fraction else None
        super().__init__(job, job.env_on(gpu or None, fraction or 1.0))


class Actor:
    """A worker as its launcher sees it."""

    def __init__(self, ray: Any, worker: Any):
        self._ray, self._worker, self._code = ray, worker, worker.wait.remote().future()

    def poll(self) -> int | None:
        if not self._code.done():
            return None
        self._ray.kill(self._worker)
        return LOST if self._code.exception() else self._code.result()

    def send(self, number: signal.Signals) -> None:
        self._worker.send.remote(number)


class RayLauncher(Launcher):
    """Actors on a Ray cluster at an `address`, each with the CPU cores and the part of a GPU that it asks for."""

    def __init__(self, address: str):
        super().__init__()
        ray = self._ray = optional("ray", missing("--launcher ray", "ray", "ray", ", or use --launcher local"))
        self._mine = not ray.is_initialized()
        if self._mine:
            try:
                ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
            except (ConnectionError, ValueError, RuntimeError) as error:
                first = next(iter(str(error).splitlines()), "")
                raise ConfigError(
                    f"--launcher ray: no cluster at {address!r} ({first}); start one with `ray start --head`, "
                    "join other machines with `ray start --address=HEAD:6379`, or give --ray-address"
                ) from None
        remote: Any = ray.remote
        self._worker = remote(max_concurrency=2, max_restarts=0)(Worker)

    def take(self, job: Job) -> Share | None:
        """Return the part of a GPU that a job gets, of the cluster's if it has any."""
        total = self._ray.cluster_resources()
        cpus = total.get("CPU", 0.0) - sum(other.cpus for other, *_ in self.running)
        gpus = total.get("GPU", 0.0) - sum(fraction for *_, (_, fraction) in self.running)
        fraction = job.gpus if total.get("GPU") else 0.0
        return None if cpus < job.cpus or gpus < fraction - 1e-9 else (None, fraction)

    def begin(self, job: Job, share: Share) -> Actor:
        room = self._worker.options(num_cpus=job.cpus, num_gpus=share[1])
        return Actor(self._ray, room.remote(job, os.getcwd(), share[1]))

    def where(self, share: Share) -> str:
        """Return the cluster's name: which node runs a job, it decides."""
        return "ray"

    def close(self) -> None:
        if self._mine:
            self._ray.shutdown()
