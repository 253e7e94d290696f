"""Train one policy in several processes, joined by JAX: process 0 keeps the run folder, all stop together."""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from interactive_nav.task.wrappers import start_distributed
from interactive_nav_common.errors import ConfigError
from train.learners.learner import Callbacks, Snapshot, Update
from train.runs.checkpoint import megabytes


def join_processes() -> None:
    """Join the processes that the environment names, before anything else uses JAX; do nothing where it names none."""
    names = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
    address, *numbers = (os.environ.get(name, "") for name in names)
    if not address:
        return
    if not all(number.isdigit() for number in numbers):
        raise ConfigError(f"{names[0]} is set, expected whole numbers in {names[1]} and {names[2]} too")
    jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM, at which a run saves
    start_distributed(address, int(numbers[0]), int(numbers[1]))


class Together:
    """Callbacks of each process; those of the run folder are called in process 0 alone, with whole arrays."""

    def __init__(self, folder: Callbacks | None, stops: list[int], env_state_limit_mb: float):
        """Take the folder's callbacks (None: of another process) and the list that signals are collected in."""
        self.folder, self.stops, self.limit_mb = folder, stops, env_state_limit_mb

    def restore(self, template: Snapshot) -> Snapshot | None:
        """Return what process 0 restores, as all processes do."""
        mine = self.folder.restore(template) if self.folder else None
        steps, whole = -1 if mine is None else mine.env_steps, mine is not None and mine.env_state is not None
        steps, whole = multihost_utils.broadcast_one_to_all((np.int64(steps), np.int64(whole)))
        if steps < 0:
            return None
        parts = (template.learner, template.env_state if whole else None)
        # Values of other processes count for nothing: process 0 sends its own.
        parts = (
            jax.tree.map(lambda x: np.zeros(np.shape(x), jnp.asarray(x).dtype), parts)
            if mine is None
            else mine_of(mine)
        )
        learner, env_state = jax.tree.map(jnp.asarray, multihost_utils.broadcast_one_to_all(parts))
        return Snapshot(int(steps), learner, env_state)

    def should_stop(self) -> bool:
        """Return whether a signal has come to any process, after the same update in each."""
        came = multihost_utils.process_allgather(np.int32(self.stops[0] if self.stops else 0))
        if came.any() and not self.stops:
            self.stops.append(int(came.max()))
        return bool(self.stops) and bool(came.any())

    def on_start(self, snapshot: Snapshot, total_steps: int) -> None:
        """Prepare the folder."""
        if self.folder:
            self.folder.on_start(snapshot, total_steps)

    def on_update(self, env_steps: int) -> None:
        """Show progress."""
        if self.folder:
            self.folder.on_update(env_steps)

    def on_log(self, env_steps: int, metrics: dict[str, float]) -> None:
        """Log."""
        if self.folder:
            self.folder.on_log(env_steps, metrics)

    def on_checkpoint(self, snapshot: Snapshot) -> None:
        """Gather the environments of all processes, and save."""
        kept = megabytes(snapshot.env_state) <= self.limit_mb
        env_state = gathered(snapshot.env_state) if kept else None
        if self.folder:
            self.folder.on_checkpoint(Snapshot(snapshot.env_steps, snapshot.learner, env_state))

    def on_diverged(self, before: Snapshot, update: Update) -> str:
        """Gather the batch, and save."""
        update = Update(update.losses, update.episode_sums, update.finite, gathered(update.batch))
        return self.folder.on_diverged(before, update) if self.folder else "the folder of process 0"


def mine_of(snapshot: Snapshot) -> Any:
    """Return learner and environments as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(jnp.asarray(x)), (snapshot.learner, snapshot.env_state))


def gathered(tree: Any) -> Any:
    """Return arrays spread over processes as whole ones in each."""
    return multihost_utils.process_allgather(tree, tiled=True)
