"""Run jobs on a Ray cluster: one actor per job, on any node that has room; all nodes see the same folder."""

import logging
import os
from typing import Any

from interactive_nav_common.errors import ConfigError, missing, optional
from interactive_nav_common.jobs.processes import LOST, Begun, Child, Job, Launcher


class Worker(Child):
    """In the actor: the job's process, with the GPU that Ray gave it; `stop` and `kill` come while `wait` waits."""

    def __init__(self, job: Job, cwd: str, fraction: float):
        os.chdir(cwd)
        gpu = os.environ.get("CUDA_VISIBLE_DEVICES") if fraction else None
        super().__init__(job, job.env_on(gpu or None, fraction or 1.0))


class Actor:
    """A worker as its launcher sees it."""

    def __init__(self, ray: Any, worker: Any):
        self._ray, self._worker, self._code = ray, worker, worker.wait.remote()

    def poll(self) -> int | None:
        """Return the exit code, or None while it runs."""
        ready, _ = self._ray.wait([self._code], timeout=0)
        if not ready:
            return None
        try:
            code = self._ray.get(self._code)
        except self._ray.exceptions.RayError:
            code = LOST
        self._ray.kill(self._worker)
        return code

    def stop(self) -> None:
        """Ask the job to save and end."""
        self._worker.stop.remote()

    def kill(self) -> None:
        """End the job."""
        self._worker.kill.remote()


class RayLauncher(Launcher):
    """Actors on a Ray cluster, each with the CPU cores and the part of a GPU that it asks for.

    Args:
        address: of the cluster, as `ray.init` takes it.
    """

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
        self._given = 0.0
        """GPUs."""

    def _begin(self, job: Job) -> Begun | None:
        total = self._ray.cluster_resources()
        cpus = total.get("CPU", 0.0) - sum(other.cpus for other, *_ in self._running)
        fraction = job.gpus if total.get("GPU") else 0.0
        if cpus < job.cpus or total.get("GPU", 0.0) - self._given < fraction - 1e-9:
            return None
        room = self._worker.options(num_cpus=job.cpus, num_gpus=fraction)
        self._given += fraction

        def give_back() -> None:
            self._given -= fraction

        return Actor(self._ray, room.remote(job, os.getcwd(), fraction)), "ray", give_back

    def close(self) -> None:
        """Leave the cluster."""
        if self._mine:
            self._ray.shutdown()
