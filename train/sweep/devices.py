"""Find what a machine has, and choose which part of it a run gets."""

import dataclasses
import os
import subprocess
from collections.abc import Mapping

from interactive_nav_common.jobs.processes import Begun, Child, Job, Launcher
from train.sweep.spec import LaunchConfig

USABLE = 0.95
"""Part of a GPU's memory that runs may fill: the driver takes some."""


@dataclasses.dataclass(frozen=True)
class Gpu:
    """One GPU."""

    name: str
    """As CUDA_VISIBLE_DEVICES takes it: an index or a UUID."""
    memory_gb: float


Share = tuple[str | None, float]
"""Part of a machine for one run: a GPU's name, if it has any, and a fraction of its memory or of the cores."""


def find_gpus() -> list[Gpu]:
    """Return the NVIDIA GPUs that this process may use."""
    return parse_gpus(gpu_listing("index,uuid,memory.total"), os.environ.get("CUDA_VISIBLE_DEVICES"))


def gpu_listing(fields: str) -> str:
    """Return nvidia-smi's line for each NVIDIA GPU; nothing where there are none."""
    query = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader,nounits"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout if done.returncode == 0 else ""


def parse_gpus(listing: str, visible: str | None) -> list[Gpu]:
    """Return the GPUs of nvidia-smi's `index, uuid, MiB` lines that CUDA_VISIBLE_DEVICES (None: unset) leaves."""
    gpus: dict[str, Gpu] = {}
    for line in listing.splitlines():
        fields = [field.strip() for field in line.split(",")]
        if len(fields) == 3 and fields[2].isdecimal():
            memory_gb = int(fields[2]) * 2**20 / 1e9
            gpus[fields[0]] = Gpu(fields[0], memory_gb)
            gpus[fields[1]] = Gpu(fields[1], memory_gb)
    names = [n for n in gpus if n.isdecimal()] if visible is None else [n.strip() for n in visible.split(",")]
    return [gpus[name] for name in names if name in gpus]


class Machine(Launcher):
    """Processes on this machine, each with its share of a GPU or of the cores."""

    def __init__(self, gpus: list[Gpu], slots: int):
        super().__init__()
        self._gpus, self._slots = gpus, slots
        self._shares: list[Share] = []

    def take(self, launch: LaunchConfig, factor: float = 1.0) -> Share | None:
        """Take a share for a run; None where there is no room."""
        share, room = (None, 1.0 / self._slots), self._slots > len(self._shares)
        if self._gpus:
            free = {gpu: 1.0 - sum(part for name, part in self._shares if name == gpu.name) for gpu in self._gpus}
            gpu, runs = max(free, key=lambda g: free[g]), launch.runs_per_gpu
            if launch.gpu_memory_gb:
                runs = max(1, min(runs, int(USABLE * gpu.memory_gb / launch.gpu_memory_gb)))
            share = gpu.name, min(1.0, factor * (1.0 / runs))
            room = share[1] <= free[gpu] + 1e-9
        if not room:
            return None
        self._shares.append(share)
        return share

    def give_back(self, share: Share) -> None:
        """Free the share of a run that is over."""
        self._shares.remove(share)

    def _begin(self, job: Job) -> Begun | None:
        assert isinstance(job, RunJob)
        share = self.take(job.launch, job.factor)
        if share is None:
            return None
        where = "cpu" if share[0] is None else f"gpu {share[0]}"
        return Child(job, job.env_on(*share)), where, lambda: self.give_back(share)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunJob(Job):
    """One program to run for one or several runs."""

    kind: str
    """train or evaluate."""
    runs: tuple[str, ...]
    launch: LaunchConfig
    factor: float = 1.0
    """Times the usual share of a GPU."""

    def env_on(self, gpu: str | None, part: float) -> Mapping[str, str]:
        """Return environment variables that keep it within its part of a GPU or of the cores."""
        if gpu is None:
            cores = max(1, int((os.cpu_count() or 1) * part))
            return {"OMP_NUM_THREADS": str(cores)} if part < 1.0 else {}
        return {
            "CUDA_DEVICE_ORDER": "PCI_BUS_ID",  # nvidia-smi's order
            "CUDA_VISIBLE_DEVICES": gpu,
            "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{USABLE * part * self.launch.jax_memory_share:.3f}",
        }
