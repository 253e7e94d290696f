"""List the NVIDIA GPUs of this machine, without the libraries that would take hold of one."""

import os
import subprocess
from typing import NamedTuple


class Gpu(NamedTuple):
    """One GPU."""

    name: str
    """As CUDA_VISIBLE_DEVICES takes it: an index or a UUID."""
    memory_gb: float


def find_gpus() -> list[Gpu]:
    """Return the NVIDIA GPUs that this process may use; none where nvidia-smi is missing or fails."""
    query = ["nvidia-smi", "--query-gpu=index,uuid,memory.total", "--format=csv,noheader,nounits"]
    try:
        listing = subprocess.run(query, capture_output=True, text=True, timeout=60, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return parse_gpus(listing, os.environ.get("CUDA_VISIBLE_DEVICES"))


def parse_gpus(listing: str, visible: str | None) -> list[Gpu]:
    """Return the GPUs of nvidia-smi's `index, uuid, MiB` lines that CUDA_VISIBLE_DEVICES (None: unset) leaves."""
    gpus: dict[str, Gpu] = {}
    for line in listing.splitlines():
        fields = [field.strip() for field in line.split(",")]
        if len(fields) == 3 and fields[2].isdecimal():
            gpus |= {name: Gpu(name, int(fields[2]) * 2**20 / 1e9) for name in fields[:2]}
    names = [n for n in gpus if n.isdecimal()] if visible is None else [n.strip() for n in visible.split(",")]
    return [gpus[name] for name in names if name in gpus]
