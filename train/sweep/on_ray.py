"""Jobs on a Ray cluster: an actor a job, on whatever node has room; all nodes see the same folder."""

from __future__ import annotations

import contextlib
import logging
import os
from typing import Any

from interactive_nav_common.errors import ConfigError
from train.sweep.devices import Gpu, Share, share_env
from train.sweep.jobs import LOST, Child, Job


def _work(job: Job, cwd: str, fraction: float) -> Any:
    """In the actor: the job's process, with the GPU that Ray gave it."""
    os.chdir(cwd)
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    share = Share(Gpu(visible, 0.0) if visible and fraction else None, fraction or 1.0)
    return Child(job, share_env(share, job.launch))


class RayLauncher:
    """Actors on a Ray cluster, each with the CPU cores and the part of a GPU that its run asks for.

    Args:
        address: of the cluster, as `ray.init` takes it.

    Raises:
        ConfigError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, address: str):
        try:
            import ray
        except ImportError:
            raise ConfigError(
                "--launcher ray: Ray is not installed; pip install 'interactive-nav[ray]', or use --launcher local"
            ) from None
        self._ray = ray
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

        class Worker:
            """Holds one job's process; `stop` and `kill` come while `wait` waits."""

            def __init__(self, job: Job, cwd: str, fraction: float):
                self._child = _work(job, cwd, fraction)

            def wait(self) -> int:
                return self._child.wait()

            def stop(self) -> None:
                self._child.stop()

            def kill(self) -> None:
                self._child.kill()

        remote: Any = ray.remote
        self._worker = remote(max_concurrency=2, max_restarts=0)(Worker)
        self._running: list[tuple[Job, Any, Any, float]] = []

    def start(self, job: Job) -> str | None:
        """See `train.sweep.local.Launcher`."""
        total = self._ray.cluster_resources()
        gpus, cpus = total.get("GPU", 0.0), total.get("CPU", 0.0)
        fraction = min(1.0, job.factor / job.launch.runs_per_gpu) if gpus else 0.0
        cpus -= sum(other.launch.cpus_per_run for other, *_ in self._running)
        gpus -= sum(taken for *_, taken in self._running)
        if cpus < job.launch.cpus_per_run or gpus < fraction - 1e-9:
            return None
        actor = self._worker.options(num_cpus=job.launch.cpus_per_run, num_gpus=fraction).remote(
            job, os.getcwd(), fraction
        )
        self._running.append((job, actor, actor.wait.remote(), fraction))
        return "ray"

    def ended(self) -> list[tuple[Job, int]]:
        """See `train.sweep.local.Launcher`."""
        over, still = [], []
        for job, actor, result, fraction in self._running:
            ready, _ = self._ray.wait([result], timeout=0)
            if not ready:
                still.append((job, actor, result, fraction))
                continue
            try:
                over.append((job, self._ray.get(result)))
            except self._ray.exceptions.RayError:
                over.append((job, LOST))
            self._ray.kill(actor)
        self._running = still
        return over

    def stop(self) -> None:
        """See `train.sweep.local.Launcher`."""
        for _, actor, _, _ in self._running:
            actor.stop.remote()

    def kill(self) -> None:
        """See `train.sweep.local.Launcher`."""
        done = [actor.kill.remote() for _, actor, _, _ in self._running]
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.get(done, timeout=10)

    def close(self) -> None:
        """See `train.sweep.local.Launcher`."""
        if self._mine:
            self._ray.shutdown()
