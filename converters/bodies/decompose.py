"""Decompose CAD meshes into convex hulls with coacd, and cache the results by content.

Each model has a process, because coacd may crash and cannot be interrupted from Python. If coacd fails or runs out of
time, the model's convex hull is the result, and a reason comes with it.
"""

import contextlib
import dataclasses
import errno
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from converters.geometry.boxes import Hull, convex_hull
from converters.records.errors import CANNOT_WRITE, StageFailed
from interactive_nav_common import files
from interactive_nav_common.jobs.cache import MISSING, NOT_HASHED, StageCache
from interactive_nav_common.jobs.processes import LATE, Job, Launcher, our_env, run_jobs

WORKER = "converters.bodies.coacd_worker"


@dataclasses.dataclass(frozen=True)
class DecomposeConfig:
    """coacd's parameters; the values were chosen by measurement (quick settings, hull mode)."""

    threshold: float = 0.1
    max_convex_hull: int = 12
    preprocess_resolution: int = 30
    resolution: int = 800
    mcts_nodes: int = 10
    mcts_iterations: int = 40
    mcts_max_depth: int = 2
    max_ch_vertex: int = 32
    """Vertices of a hull: keeps collision cheap and the assets small."""
    seed: int = 0
    timeout_s: float = dataclasses.field(default=240.0, metadata=NOT_HASHED)


DOOR_OVERRIDES = {"threshold": 0.02, "max_convex_hull": 4, "preprocess_resolution": 60}
"""Parameters of doors. With coacd's quick settings, in half heights, a voxel of 7 cm would thicken a 4 cm leaf to 9."""


def cache_folder() -> Path:
    """Return `converters` in the package's cache folder."""
    return files.cache_folder() / "converters"


@dataclasses.dataclass(frozen=True)
class Decomposition:
    """Hulls of every model, and which of them are not coacd's."""

    hulls: dict[str, tuple[Hull, ...]]
    """Name -> hulls, in the mesh's frame."""
    fallbacks: dict[str, str]
    """Name -> why its one convex hull stands for it."""
    worker_mib: float = 0.0
    """Most memory that one of its processes held."""


def decompose_all(
    meshes: dict[str, tuple[np.ndarray, np.ndarray]],
    config: DecomposeConfig,
    jobs: int,
    cache: Path,
    report: Callable[[float], None] = lambda share: None,
    overrides: Mapping[str, Mapping[str, float]] | None = None,
    strict: bool = False,
) -> Decomposition:
    """Decompose meshes, name -> (vertices (n, 3), faces (m, 3)), in `jobs` processes; `overrides` is by name."""
    changes = overrides or {}
    configs = {name: dataclasses.replace(config, **changes.get(name, {})) for name in meshes}  # pyright: ignore
    stored = StageCache(cache)
    keys = {
        name: stored.key(
            "hulls", WORKER, np.ascontiguousarray(v, float), np.ascontiguousarray(f, np.int64), configs[name]
        )
        for name, (v, f) in meshes.items()
    }
    done = {key: hulls for key in set(keys.values()) if (hulls := stored.load(key)) is not MISSING}
    worker_mib = 0.0
    failed: dict[str, str] = {}
    waiting = {key: name for name, key in reversed(keys.items()) if key not in done}
    # The largest first: the tail of the stage is then short.
    waiting = dict(sorted(waiting.items(), key=lambda item: -len(meshes[item[1]][1])))
    total = len(set(keys.values()))
    report(len(done) / max(total, 1))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hulls-")))
        todo = (_job(key, *meshes[name], configs[name], folder) for key, name in waiting.items())
        running = run_jobs(Launcher(max(jobs, 1)), todo, grace_s=0.0)
        for job, code in stack.enter_context(contextlib.closing(running)):
            key, name = job.name, waiting[job.name]
            hulls, reason, peak_mib = _result(job, code, name)
            worker_mib = max(worker_mib, peak_mib)
            if hulls is None:
                if strict:
                    raise StageFailed(f"decompose: {reason}")
                hulls, failed[key] = (convex_hull(meshes[name][0]),), reason
            else:
                stored.store(key, hulls)
            done[key] = hulls
            report(len(done) / max(total, 1))
    return Decomposition(
        {name: done[key] for name, key in keys.items()},
        {name: failed[key] for name, key in keys.items() if key in failed},
        worker_mib,
    )


def _job(key: str, vertices: np.ndarray, faces: np.ndarray, config: DecomposeConfig, scratch: Path) -> Job:
    """Write a mesh, and return the job that decomposes it."""
    source = scratch / f"{key}.in.npz"
    parameters = {k: v for k, v in dataclasses.asdict(config).items() if k != "timeout_s"}
    np.savez(source, vertices=vertices, faces=faces, **parameters)  # pyright: ignore[reportArgumentType]
    command = sys.executable, "-m", WORKER, str(source), str(scratch / f"{key}.npz")
    # One thread each: results then do not depend on the machine's load, and `jobs` is what it says.
    env = our_env() | {"OMP_NUM_THREADS": "1"}
    return Job(key, command, scratch / f"{key}.log", env=env, timeout_s=config.timeout_s)


def _result(job: Job, code: int, name: str) -> tuple[tuple[Hull, ...] | None, str, float]:
    """Return a job's hulls, or None and the reason, and the memory that it took, MiB."""
    if code == LATE:
        return None, f"coacd ran past {job.timeout_s:g} s on {name}", 0.0
    if code == CANNOT_WRITE:
        raise OSError(errno.ENOSPC, "the decomposition's result cannot be written", str(job.log.parent))
    if code:
        _, *printed = job.log.read_text(errors="replace").strip().splitlines()
        return None, f"coacd failed on {name} (exit code {code}: {(printed or ['no message'])[-1]})", 0.0
    with np.load(job.log.with_suffix(".npz"), allow_pickle=False) as arrays:
        hulls = tuple(Hull(arrays[f"v{i}"], arrays[f"f{i}"]) for i in range(int(arrays["count"])))
        return hulls, "", float(arrays["peak_mib"])
