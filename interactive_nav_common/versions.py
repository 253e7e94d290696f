"""Collect what a result depends on: packages, device, cores, commit, command."""

import contextlib
import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

PACKAGES = (
    *("interactive-nav", "brax", "flax", "jax", "jaxlib", "jax-cuda13-plugin", "mujoco", "mujoco-mjx"),
    *("numpy", "optax", "warp-lang"),
)


def versions() -> dict[str, Any]:
    """Return the packages, Python, platform, device and commit that a result depends on."""
    import jax  # what only asks for a commit starts without it

    device = jax.devices()[0]
    return {
        "packages": package_versions(PACKAGES),
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
        "cpu_count": os.cpu_count(),
        "matmul_precision": str(getattr(jax.config, "jax_default_matmul_precision", None) or "default"),
        "commit": commit(),
        "argv": command(),
    }


def package_versions(names: Iterable[str]) -> dict[str, str]:
    """Return the versions of those packages that are installed."""
    installed = {}
    for name in names:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            installed[name] = importlib.metadata.version(name)
    return installed


def command() -> list[str]:
    """Return what was run, without the folder that it lies in on this machine."""
    program = Path(sys.argv[0])
    module = program.parent.name if program.name == "__main__.py" else program.name
    return [module, *sys.argv[1:]]


def commit() -> str | None:
    """Return the project's git commit, with `+dirty` if files differ from it; None outside a git checkout.

    The environment variable GIT_COMMIT says it for a copy of the files whose git knows another.
    """
    if os.environ.get("GIT_COMMIT"):
        return os.environ["GIT_COMMIT"]
    root = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, timeout=20)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if git("rev-parse", "--show-toplevel") != str(root):  # installed as a package inside some other checkout
        return None
    head = git("rev-parse", "HEAD")
    return head and head + ("+dirty" if git("status", "--porcelain") else "")


def usable_cores() -> int:
    """Return the number of the machine's cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
