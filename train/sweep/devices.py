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


@dataclasses.dataclass(frozen=True)
class Share:
    """Part of a machine for one run."""

    gpu: Gpu | None
    fraction: float
    """Of the GPU's memory, or of the machine's cores."""


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
        self._given: list[Share] = []

    def take(self, launch: LaunchConfig, factor: float = 1.0) -> Share | None:
        """Take a share for a run; None where there is no room."""
        if not self._gpus:
            if len(self._given) >= self._slots:
                return None
            share = Share(None, 1.0 / self._slots)
        else:
            free = {gpu: 1.0 - sum(s.fraction for s in self._given if s.gpu == gpu) for gpu in self._gpus}
            gpu, runs = max(free, key=lambda g: free[g]), launch.runs_per_gpu
            if launch.gpu_memory_gb:
                runs = max(1, min(runs, int(USABLE * gpu.memory_gb / launch.gpu_memory_gb)))
            share = Share(gpu, min(1.0, factor * (1.0 / runs)))
            if share.fraction > free[gpu] + 1e-9:
                return None
        self._given.append(share)
        return share

    def give_back(self, share: Share) -> None:
        """Free the share of a run that is over."""
        self._given.remove(share)

    def _begin(self, job: Job) -> Begun | None:
        assert isinstance(job, RunJob)
        share = self.take(job.launch, job.factor)
        if share is None:
            return None
        where = "cpu" if share.gpu is None else f"gpu {share.gpu.name}"
        return Child(job, share_env(share, job.launch)), where, lambda: self.give_back(share)


def share_env(share: Share, launch: LaunchConfig) -> dict[str, str]:
    """Return environment variables that keep a run within its share."""
    if share.gpu is None:
        cores = max(1, int((os.cpu_count() or 1) * share.fraction))
        return {"OMP_NUM_THREADS": str(cores)} if share.fraction < 1.0 else {}
    memory = USABLE * share.fraction * launch.jax_memory_share
    return {
        "CUDA_DEVICE_ORDER": "PCI_BUS_ID",  # nvidia-smi's order
        "CUDA_VISIBLE_DEVICES": share.gpu.name,
        "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{memory:.3f}",
    }


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
        """Return variables that keep it within its part."""
        return share_env(Share(Gpu(gpu, 0.0) if gpu else None, part), self.launch)
