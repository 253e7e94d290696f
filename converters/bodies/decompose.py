"""CAD meshes in, convex hulls out: coacd in one process a model, results cached by content.

A model on which coacd fails or runs past the time limit gets its convex hull instead, which the result names.

coacd runs outside this process because it prints its log to the terminal, may crash on bad meshes, and
cannot be interrupted from Python. A model is decomposed once, unscaled: scaling keeps a hull convex.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from pathlib import Path

import numpy as np

from converters.clock import peak_memory_mib
from converters.geometry.boxes import Hull, convex_hull
from converters.records.cache import LIMIT_BYTES, store, touch
from converters.records.errors import CANNOT_WRITE, StageFailed


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
    timeout_s: float = 240.0


DOOR_OVERRIDES = {"threshold": 0.02, "max_convex_hull": 4, "preprocess_resolution": 60}
"""Parameters of doors. coacd measures in half heights: with the quick settings handles 5 cm off the leaf are
within the threshold, and a voxel is 7 cm, so that a leaf of 4 cm would become a slab of 9."""


def cache_folder() -> Path:
    """`$INTERACTIVE_NAV_CACHE/converters`, else `$XDG_CACHE_HOME/interactive_nav/converters`, else `~/.cache/...`."""
    own = os.environ.get("INTERACTIVE_NAV_CACHE")
    if own:
        return Path(own) / "converters"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "interactive_nav" / "converters"


def content_key(vertices: np.ndarray, faces: np.ndarray, config: DecomposeConfig) -> str:
    """sha256 over the mesh, the parameters and coacd's version."""
    from importlib.metadata import version

    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(vertices, np.float64).tobytes())
    digest.update(np.ascontiguousarray(faces, np.int64).tobytes())
    parameters = {k: v for k, v in dataclasses.asdict(config).items() if k != "timeout_s"}
    digest.update(repr((sorted(parameters.items()), version("coacd"))).encode())
    return digest.hexdigest()


def _load(path: Path) -> tuple[Hull, ...] | None:
    """Hulls from a cache file; None where it is missing or damaged (then it is made again)."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            count = int(arrays["count"])
            return tuple(Hull(arrays[f"v{i}"], arrays[f"f{i}"]) for i in range(count)) or None
    except Exception:  # a damaged archive fails in zipfile, zlib, struct or NumPy, each in its own way
        return None


def _store(path: Path, hulls: tuple[Hull, ...], limit_bytes: int = LIMIT_BYTES) -> None:
    arrays = {f"v{i}": h.vertices for i, h in enumerate(hulls)} | {f"f{i}": h.faces for i, h in enumerate(hulls)}
    count = len(hulls)
    store(
        path,
        lambda partial: np.savez_compressed(partial, count=count, **arrays),  # pyright: ignore[reportArgumentType]
        limit_bytes,
    )


@dataclasses.dataclass(frozen=True)
class Decomposition:
    """Hulls of every model, and which of them are not coacd's."""

    hulls: dict[str, tuple[Hull, ...]]
    """Name -> hulls, in the mesh's own frame."""
    fallbacks: dict[str, str]
    """Name -> why its one convex hull stands for it."""
    worker_mib: float = 0.0
    """Most memory that one of its processes held."""


@dataclasses.dataclass
class _Job:
    key: str
    name: str
    process: subprocess.Popen
    started: float
    output: Path
    peak_mib: float = 0.0


def decompose_all(
    meshes: dict[str, tuple[np.ndarray, np.ndarray]],
    config: DecomposeConfig,
    jobs: int,
    cache: Path,
    progress: Callable[[float], None] | None = None,
    overrides: Mapping[str, Mapping[str, float]] | None = None,
    strict: bool = False,
) -> Decomposition:
    """Decomposes every mesh, `jobs` processes at a time.

    Args:
        meshes: name -> (vertices (n, 3), faces (m, 3)).
        config: coacd's parameters.
        jobs: processes side by side.
        cache: folder of hulls by content; convex hulls that stand in for a failed decomposition are not stored.
        progress: called with the share that is done, 0 to 1.
        overrides: name -> parameters that differ from the config's.
        strict: a model that coacd cannot decompose is an error.

    Raises:
        StageFailed: coacd failed or ran past the time limit, with `strict`; the message names the model.
        OSError: the folder for temporary files is full or cannot be written.
    """
    changes = overrides or {}
    configs = {name: dataclasses.replace(config, **changes.get(name, {})) for name in meshes}  # pyright: ignore
    keys = {name: content_key(v, f, configs[name]) for name, (v, f) in meshes.items()}
    done: dict[str, tuple[Hull, ...]] = {}
    worker_mib = 0.0
    failed: dict[str, str] = {}
    waiting: list[tuple[str, str]] = []
    for name, key in keys.items():
        found = _load(cache / f"{key}.npz")
        if found is not None:
            touch(cache / f"{key}.npz")
            done[key] = found
        elif key not in {k for k, _ in waiting}:
            waiting.append((key, name))
    # The largest first: the tail of the stage is then short.
    waiting.sort(key=lambda item: -len(meshes[item[1]][1]))
    total = len(set(keys.values()))
    tell = progress or (lambda share: None)
    tell(len(done) / max(total, 1))
    with contextlib.closing(_results(waiting, meshes, configs, max(jobs, 1), config.timeout_s)) as results:
        for job, hulls, reason in results:
            key, name, worker_mib = job.key, job.name, max(worker_mib, job.peak_mib)
            if hulls is None:
                if strict:
                    raise StageFailed(f"decompose: {reason}")
                hulls, failed[key] = (convex_hull(meshes[name][0]),), reason
            else:
                _store(cache / f"{key}.npz", hulls)
            done[key] = hulls
            tell(len(done) / max(total, 1))
    return Decomposition(
        {name: done[key] for name, key in keys.items()},
        {name: failed[key] for name, key in keys.items() if key in failed},
        worker_mib,
    )


def _results(
    waiting: list[tuple[str, str]],
    meshes: dict[str, tuple[np.ndarray, np.ndarray]],
    configs: Mapping[str, DecomposeConfig],
    jobs: int,
    timeout_s: float,
) -> Generator[tuple[_Job, tuple[Hull, ...] | None, str], None, None]:
    """Job, hulls and what `_finish` says of each that waits, as they end; closed early, it ends what runs."""
    running: list[_Job] = []
    with tempfile.TemporaryDirectory(prefix="hulls-") as scratch:
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    key, name = waiting.pop(0)
                    running.append(_start(key, name, *meshes[name], configs[name], Path(scratch)))
                for job in list(running):
                    job.peak_mib = max(job.peak_mib, peak_memory_mib(job.process.pid))
                    late = time.monotonic() - job.started > timeout_s
                    if job.process.poll() is not None or late:
                        hulls, reason = _finish(job, timeout_s)
                        running.remove(job)
                        yield job, hulls, reason
                if running:
                    time.sleep(0.05)
        finally:
            for job in running:
                job.process.kill()
                job.process.wait()


def _finish(job: _Job, timeout_s: float) -> tuple[tuple[Hull, ...] | None, str]:
    """Hulls of a job that ended or is out of time; None and the reason where there are none."""
    if job.process.poll() is None:
        job.process.kill()
        job.process.wait()
        return None, f"coacd ran past {timeout_s:g} s on {job.name}"
    code = job.process.returncode
    if code == CANNOT_WRITE:
        raise OSError(errno.ENOSPC, "the decomposition's result cannot be written", str(job.output.parent))
    hulls = _load(job.output) if code == 0 else None
    if hulls is not None:
        return hulls, ""
    log = job.output.with_suffix(".log").read_text(errors="replace").strip().splitlines()
    return None, f"coacd failed on {job.name} (exit code {code}: {log[-1] if log else 'no message'})"


def _start(
    key: str, name: str, vertices: np.ndarray, faces: np.ndarray, config: DecomposeConfig, scratch: Path
) -> _Job:
    mesh_path, output = scratch / f"{key}.in.npz", scratch / f"{key}.npz"
    parameters = {k: v for k, v in dataclasses.asdict(config).items() if k != "timeout_s"}
    np.savez(mesh_path, vertices=vertices, faces=faces, **parameters)  # pyright: ignore[reportArgumentType]
    # One thread each: results then do not depend on the machine's load, and `jobs` is what it says.
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with output.with_suffix(".log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "converters.bodies.coacd_worker", str(mesh_path), str(output)],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            stdin=subprocess.DEVNULL,
            cwd=Path(__file__).resolve().parents[2],
        )
    return _Job(key, name, process, time.monotonic(), output)
