"""Decompose CAD meshes into convex hulls: coacd in one process per model, results cached by content.

A model on which coacd fails or runs past the time limit gets its convex hull instead, and the result names it.

coacd runs outside this process because it prints its log to the terminal, may crash on bad meshes, and
cannot be interrupted from Python. A model is decomposed once, unscaled: scaling keeps a hull convex.
"""

import concurrent.futures
import contextlib
import dataclasses
import errno
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Mapping
from pathlib import Path

import numpy as np

from converters.clock import peak_memory_mib
from converters.geometry.boxes import Hull, convex_hull
from converters.records.cache import MISSING, NOT_HASHED, StageCache
from converters.records.errors import CANNOT_WRITE, StageFailed
from interactive_nav_common import files

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
"""Parameters of doors. coacd measures in half heights: with the quick settings handles 5 cm off the leaf are
within the threshold, and a voxel is 7 cm, so that a leaf of 4 cm would become a slab of 9."""


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
    progress: Callable[[float], None] | None = None,
    overrides: Mapping[str, Mapping[str, float]] | None = None,
    strict: bool = False,
) -> Decomposition:
    """Decompose every mesh, name -> (vertices (n, 3), faces (m, 3)), `jobs` processes at a time.

    `overrides`: name -> parameters that differ from the config's.
    """
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
    waiting = list({key: (key, name) for name, key in reversed(keys.items()) if key not in done}.values())
    worker_mib = 0.0
    failed: dict[str, str] = {}
    # The largest first: the tail of the stage is then short.
    waiting.sort(key=lambda item: -len(meshes[item[1]][1]))
    total = len(set(keys.values()))
    report = progress or (lambda share: None)
    report(len(done) / max(total, 1))
    with contextlib.closing(_results(waiting, meshes, configs, max(jobs, 1))) as results:
        for (key, name), (hulls, reason, peak_mib) in results:
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


def _results(
    waiting: list[tuple[str, str]],
    meshes: dict[str, tuple[np.ndarray, np.ndarray]],
    configs: Mapping[str, DecomposeConfig],
    jobs: int,
) -> Generator[tuple[tuple[str, str], tuple[tuple[Hull, ...] | None, str, float]], None, None]:
    """Yield key and name, and what `_run` returns, of each that waits, as they end; closed early, end what runs."""
    stop = threading.Event()
    with tempfile.TemporaryDirectory(prefix="hulls-") as folder, concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        try:
            begun = {
                pool.submit(_run, *one, *meshes[one[1]], configs[one[1]], Path(folder), stop): one for one in waiting
            }
            yield from ((begun[done], done.result()) for done in concurrent.futures.as_completed(begun))
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _run(
    key: str, name: str, vertices: np.ndarray, faces: np.ndarray, config: DecomposeConfig, scratch: Path,
    stop: threading.Event,
) -> tuple[tuple[Hull, ...] | None, str, float]:  # fmt: skip
    """Return hulls, or None and the reason, and its memory, MiB; kill what is out of time or to stop."""
    mesh_path, output = scratch / f"{key}.in.npz", scratch / f"{key}.npz"
    parameters = {k: v for k, v in dataclasses.asdict(config).items() if k != "timeout_s"}
    np.savez(mesh_path, vertices=vertices, faces=faces, **parameters)  # pyright: ignore[reportArgumentType]
    with output.with_suffix(".log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", WORKER, str(mesh_path), str(output)],
            stdout=log,
            stderr=subprocess.STDOUT,
            # One thread each: results then do not depend on the machine's load, and `jobs` is what it says.
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            cwd=Path(__file__).resolve().parents[2],
        )
    peak_mib, until = 0.0, time.monotonic() + config.timeout_s
    while process.poll() is None and time.monotonic() < until and not stop.wait(0.05):
        peak_mib = max(peak_mib, peak_memory_mib(process.pid))
    if process.poll() is None:
        process.kill()
        process.wait()
        return None, f"coacd ran past {config.timeout_s:g} s on {name}", peak_mib
    code = process.returncode
    if code == CANNOT_WRITE:
        raise OSError(errno.ENOSPC, "the decomposition's result cannot be written", str(scratch))
    if code == 0:
        with np.load(output, allow_pickle=False) as arrays:
            hulls = tuple(Hull(arrays[f"v{i}"], arrays[f"f{i}"]) for i in range(int(arrays["count"])))
        return hulls, "", peak_mib
    log = output.with_suffix(".log").read_text(errors="replace").strip().splitlines()
    return None, f"coacd failed on {name} (exit code {code}: {log[-1] if log else 'no message'})", peak_mib
