"""Shared fixtures: toy scene folders, built once per test process, and the licensed sample where it lies."""

from __future__ import annotations

import atexit
import collections
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# Before JAX: tests compile more than they compute, and often the same as another test, worker or subprocess (see also
# `quick_compilation`). The fusion emitters of jaxlib 0.10 take half of the time that all else of a compilation takes.
os.environ["XLA_FLAGS"] = (
    f"{os.environ.get('XLA_FLAGS', '')} --xla_llvm_disable_expensive_passes=true "
    "--xla_backend_optimization_level=1 --xla_cpu_parallel_codegen_split_count=1 --xla_cpu_use_fusion_emitters=false"
).strip()
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    compiled = tempfile.mkdtemp(prefix="interactive-nav-compiled-")
    atexit.register(shutil.rmtree, compiled, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = compiled
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
# An array that silently gains an axis is an error, here and in the programs that tests start.
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"

# Without the Python calls that each operation of a program comes from, tests that compile take a tenth less.
os.environ["JAX_INCLUDE_FULL_TRACEBACKS_IN_LOCATIONS"] = os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
# Programs that tests start find the project's modules compiled.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A core for each worker: two processes that take turns on two cores lose a seventh of their time to each other.
if "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity"):
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) <= int(os.environ["PYTEST_XDIST_WORKER_COUNT"]):
        os.sched_setaffinity(0, {cores[int(os.environ["PYTEST_XDIST_WORKER"][2:]) % len(cores)]})

import pytest
from filelock import FileLock
from hypothesis import settings

import interactive_nav  # noqa: F401  (before JAX: it sets how constants are compiled)
from interactive_nav_common.runs import folder
from tests.changed import changed_files, chosen
from tests.toys import write_room

# A shell starts what runs in its background with SIGINT ignored, and what that starts ignores it too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tracing makes objects by the million, and next to none of them is garbage: looking for it took a tenth of the time.
gc.set_threshold(100_000, 5, 5)

sys.dont_write_bytecode = False  # as for the programs that tests start

# The same examples in every run, so that a red run shows what was changed; `HYPOTHESIS_PROFILE=explore` draws new ones.
settings.register_profile("same", derandomize=True)
settings.register_profile("explore", derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


def pytest_collection_finish() -> None:
    """Leaves a million objects of modules and tests out of later collections; JAX's check for leaks begins many."""
    gc.freeze()


CHANGED = "INTERACTIVE_NAV_CHANGED_FILES"


def pytest_configure(config: pytest.Config) -> None:
    """Asks Git once, before workers start: all of them must collect the same tests."""
    if "changed" in config.option.markexpr and CHANGED not in os.environ:
        os.environ[CHANGED] = "\n".join(sorted(changed_files(Path(__file__).parents[1])))


@pytest.hookimpl(tryfirst=True)  # before pytest looks at marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files with slow tests first, then those with many: what comes last is small, and both workers end together.

    With `-m "not heavy or changed"`, marks the heavy tests of what changed."""
    if "changed" in config.option.markexpr:
        heavy = [i for i in items if i.get_closest_marker("heavy") and not i.get_closest_marker("gpu")]
        names = set(chosen((i.nodeid for i in heavy), set(os.environ[CHANGED].splitlines())))
        for item in heavy:
            if item.nodeid in names:
                item.add_marker("changed")
    slow = {item.path for item in items if item.get_closest_marker("slow") or item.get_closest_marker("changed")}
    count = collections.Counter(item.path for item in items)
    items.sort(key=lambda item: (item.path not in slow, -count[item.path]))


@pytest.fixture(scope="module", autouse=True)
def quick_compilation(request: pytest.FixtureRequest) -> Iterator[None]:
    """Level 0 compiles in half the time of level 1, but where networks learn on pictures costs more than it saves."""
    import jax

    quick = "topological_nav" not in request.path.parts or "ros" in request.path.parts
    jax.config.update("jax_disable_most_optimizations", quick)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(quick))  # for programs that a test starts
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    del os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"]


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Callable[[str, Callable[[Path], None]], Path]:
    """A name and what fills a folder -> the folder, filled by whichever test process asks first, for all of them."""
    own = tmp_path_factory.getbasetemp()
    base = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def folder(name: str, fill: Callable[[Path], None]) -> Path:
        path, done = base / name, base / f"{name}.done"
        with FileLock(base / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(path, ignore_errors=True)  # of a process that failed half-way
                path.mkdir()
                fill(path)
                done.touch()
        return path

    return folder


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """A 4 x 3 m room with one 5 kg cube."""
    return write_room(tmp_path_factory.mktemp("scenes") / "room")


@pytest.fixture(scope="session")
def two_rooms(tmp_path_factory) -> Path:
    """A 5 x 4 m room cut by a partition, with two cubes and a door leaf."""
    blocks = (("chair", 1.2, 0.0, 5.0, 0.5), ("table", -1.2, 1.0, 10.0, 0.4))
    return write_room(
        tmp_path_factory.mktemp("scenes") / "two_rooms",
        (5.0, 4.0),
        blocks,
        door=True,
        partition=True,
        split="test",
    )


@pytest.fixture(scope="session")
def sample_data() -> Path:
    """The licensed sample data's folder; tests that ask for it skip where it is absent."""
    places = [os.environ.get("INTERACTIVE_NAV_DATA"), Path(__file__).parents[2] / "shared" / "data"]
    for place in places:
        if place and (Path(place) / "scan2cad_scene0470_00" / "full_annotations.json").is_file():
            return Path(place)
    pytest.skip("the licensed ScanNet sample is not on this machine (set INTERACTIVE_NAV_DATA to its folder)")


@pytest.fixture
def stop_after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Return a function that lets a signal stop `run_epochs` in the N-th epoch from the start of the test."""
    append, epochs = folder.append_metrics, []

    def after(count: int) -> None:
        def counted(*line: Any) -> None:
            append(*line)
            epochs.append(line)
            if len(epochs) == count:
                signal.raise_signal(signal.SIGTERM)

        monkeypatch.setattr(folder, "append_metrics", counted)

    return after
