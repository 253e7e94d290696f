"""Train one policy in several processes, joined by JAX: process 0 keeps the run folder, all stop together."""

import contextlib
import dataclasses
import os
import socket
import subprocess
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from interactive_nav.task.wrappers import start_distributed
from interactive_nav_common.errors import ConfigError, UserError
from interactive_nav_common.jobs.gpus import find_gpus
from train.learners.learner import Callbacks, Snapshot, Update
from train.runs.checkpoint import megabytes

ADDRESS, COUNT, INDEX = "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
FAILED, ANEW = -2, -1
"""What process 0 sends in place of the steps of a checkpoint."""


def join_processes() -> None:
    """Join the processes that the environment names, before anything else uses JAX; do nothing where it names none."""
    address, *numbers = (os.environ.get(name, "") for name in (ADDRESS, COUNT, INDEX))
    if not address:
        return
    if not all(number.isdigit() for number in numbers):
        raise ConfigError(f"{ADDRESS} is set, expected whole numbers in {COUNT} and {INDEX} too")
    jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM, at which a run saves
    start_distributed(address, int(numbers[0]), int(numbers[1]))


@contextlib.contextmanager
def one_for_each_gpu(devices: int, command: Sequence[str]) -> Iterator[None]:
    """Join the processes named in the environment; if there are none, start one for each of several GPUs.

    One process would wait for itself: MJX-Warp's calls hold Python's lock. The others run `command` and end with the
    block.
    """
    gpus = [] if devices == 1 or os.environ.get(ADDRESS) else find_gpus()[:devices]
    if len(gpus) < devices or devices == 1:
        join_processes()
        yield
        return
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        names = {ADDRESS: f"127.0.0.1:{probe.getsockname()[1]}", COUNT: str(devices)}
    each = [{**names, INDEX: str(i), "CUDA_VISIBLE_DEVICES": gpu.name} for i, gpu in enumerate(gpus)]
    others = [subprocess.Popen(command, env={**os.environ, **variables}) for variables in each[1:]]
    os.environ.update(each[0])
    try:
        join_processes()
        yield
    except KeyboardInterrupt:
        # The others are interrupted too, and JAX would wait for them at the end.
        for other in others:
            other.kill()
        os._exit(130)
    finally:
        jax.distributed.shutdown()  # at which all wait for each other
        codes = [other.wait() for other in others]
    if any(code == 1 or code < 0 for code in codes):
        raise ConfigError("another process ended with an error, which it prints above")


@contextlib.contextmanager
def beginning() -> Iterator[Callable[[], None]]:
    """Yield what each process calls once when it is ready to train; where one fails before, all end."""
    called = False

    def ready(fine: bool = True) -> None:
        nonlocal called
        called = True
        if jax.process_count() > 1 and not multihost_utils.process_allgather(np.int32(fine)).all() and fine:
            raise another_failed()

    try:
        yield ready
    except UserError:
        if not called:
            ready(False)
        raise


def another_failed() -> BaseException:
    """Return what ends a process where another could not go on, which has said why."""
    return SystemExit(2) if jax.process_index() else ConfigError("another process could not begin; it says why above")


class Together:
    """Callbacks of each process; those of the run folder are called in process 0 alone, with whole arrays."""

    def __init__(self, folder: Callbacks | None, stops: list[int], env_state_limit_mb: float):
        """Take the folder's callbacks (None: of another process) and the list that signals are collected in."""
        self.folder, self.stops, self.limit_mb = folder, stops, env_state_limit_mb
        for name in ("on_start", "on_update", "on_log"):  # which other processes leave to process 0
            setattr(self, name, getattr(folder, name, lambda *_: None))

    def restore(self, template: Snapshot) -> Snapshot | None:
        """Return what process 0 restores, as all processes do."""
        failure, mine = None, None
        try:
            mine = self.folder.restore(template) if self.folder else None
        except UserError as error:
            failure = error
        steps = FAILED if failure else ANEW if mine is None else mine.env_steps
        whole = mine is not None and mine.env_state is not None
        steps, whole = multihost_utils.broadcast_one_to_all((np.int64(steps), np.int64(whole)))
        if steps == FAILED:
            raise failure or another_failed()
        if steps == ANEW:
            return None
        parts = (template.learner, template.env_state if whole else None)
        # Values of other processes count for nothing: process 0 sends its own.
        parts = (
            jax.tree.map(lambda x: np.zeros(np.shape(x), jnp.asarray(x).dtype), parts)
            if mine is None
            else jax.tree.map(lambda x: np.asarray(jnp.asarray(x)), (mine.learner, mine.env_state))
        )
        learner, env_state = jax.tree.map(jnp.asarray, multihost_utils.broadcast_one_to_all(parts))
        return Snapshot(int(steps), learner, env_state)

    def should_stop(self) -> bool:
        """Return whether a signal has come to any process, after the same update in each."""
        came = multihost_utils.process_allgather(np.int32(self.stops[0] if self.stops else 0))
        if came.any() and not self.stops:
            self.stops.append(int(came.max()))
        return bool(self.stops) and bool(came.any())

    def on_checkpoint(self, snapshot: Snapshot) -> None:
        """Gather the environments of all processes, and save."""
        kept = megabytes(snapshot.env_state) <= self.limit_mb
        env_state = multihost_utils.process_allgather(snapshot.env_state, tiled=True) if kept else None
        if self.folder:
            self.folder.on_checkpoint(Snapshot(snapshot.env_steps, snapshot.learner, env_state))

    def on_diverged(self, before: Snapshot, update: Update) -> str:
        """Gather the batch, and save."""
        update = dataclasses.replace(update, batch=multihost_utils.process_allgather(update.batch, tiled=True))
        return self.folder.on_diverged(before, update) if self.folder else "the folder of process 0"
