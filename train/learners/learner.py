"""Run updates until the run's settings are met: the interface and the loop that all learners share."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import Env

from interactive_nav.physics import compiler_options
from interactive_nav.scenes.many import check_device_memory
from interactive_nav_common.errors import UserError
from train.config import RunConfig

PyTree = Any


class DivergedError(UserError):
    """The learner's loss, parameters or statistics stopped being finite numbers."""


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """All that a learner needs to go on exactly where it was."""

    env_steps: int
    """Environment steps taken since the start of the run."""
    learner: PyTree
    """Networks, optimiser, normaliser, random key."""
    env_state: PyTree | None
    """The batched environments; None where the checkpoint left them out, so that new episodes begin."""


@dataclasses.dataclass(frozen=True)
class Update:
    """What one update leaves behind for the loop to look at (a pytree)."""

    losses: dict[str, jax.Array]
    """name -> scalar."""
    episode_sums: dict[str, jax.Array]
    """name -> sum over the episodes that ended; `episodes` -> how many did."""
    finite: jax.Array
    """() bool: losses and everything learned are finite numbers."""
    batch: PyTree
    """The data learned from, saved if the numbers blow up."""


jax.tree_util.register_dataclass(Update, ["losses", "episode_sums", "finite", "batch"], [])

UpdateFn = Callable[[PyTree, PyTree], tuple[PyTree, PyTree, Update]]
"""(learner, env_state) -> (learner, env_state, update); pure, compiled by the loop."""


class Callbacks(Protocol):
    """Where a learner meets the world: everything that reads clocks of others, files or signals."""

    def restore(self, template: Snapshot) -> Snapshot | None:
        """Return the snapshot to continue from, shaped like `template`; None to begin."""

    def should_stop(self) -> bool:
        """Return whether to stop, between updates: True saves a checkpoint and ends the loop."""
        ...

    def on_start(self, snapshot: Snapshot, total_steps: int) -> None:
        """Receive the state to begin from and the steps to reach, before anything is compiled."""

    def on_update(self, env_steps: int) -> None:
        """Receive the steps after each update; must be cheap."""

    def on_log(self, env_steps: int, metrics: dict[str, float]) -> None:
        """Receive the means of a log interval."""

    def on_checkpoint(self, snapshot: Snapshot) -> None:
        """Receive a snapshot to keep; its arrays may be overwritten once this returns."""

    def on_diverged(self, before: Snapshot, update: Update) -> str:
        """Save the state before the update that blew up, and that update; return where they were saved."""
        ...


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """What training ends with."""

    snapshot: Snapshot
    metrics: dict[str, float]
    """The last log interval's."""
    completed: bool
    """False when it was stopped before its last step."""


def whole_updates(steps: int, steps_per_update: int) -> int:
    """Return the number of updates that cover `steps`: at least one."""
    return max(1, math.ceil(steps / steps_per_update))


def reset_envs(agent: Any, env: Env, key: jax.Array) -> PyTree:
    """Start a new episode in every environment, with the memory of a policy that has one in `info["policy"]`."""
    number = agent.config.num_envs or 1
    first_memory = getattr(agent, "first_memory", tuple)()

    def reset(key: jax.Array) -> PyTree:
        state = env.reset(jax.random.split(key, number))
        return state.replace(info=state.info | {"policy": first_memory}) if first_memory else state

    # A program of several processes takes an array of none of their devices.
    begin = np.asarray(key) if jax.process_count() > 1 else key
    start = jax.jit(reset)
    check_device_memory("environments", number, jax.eval_shape(start, begin), getattr(env, "num_devices", 1))
    return start(begin)


def run_loop(
    update_fn: UpdateFn, start: Snapshot, steps_per_update: int, run: RunConfig, callbacks: Callbacks
) -> TrainResult:
    """Update until `run.num_timesteps`, with logs and checkpoints at fixed update counts, so that resuming is exact."""
    total = whole_updates(run.num_timesteps, steps_per_update)
    log_every = whole_updates(run.log_every_steps, steps_per_update)
    save_every = log_every * whole_updates(run.checkpoint_every_steps, log_every * steps_per_update)

    def update_typed(learner: PyTree, env_state: PyTree) -> tuple[PyTree, PyTree, Update]:
        learner, env_state, update = update_fn(learner, env_state)
        return strong_types(learner), strong_types(env_state), update

    learner, env_state = strong_types((start.learner, start.env_state))
    done = start.env_steps // steps_per_update
    callbacks.on_start(start, total * steps_per_update)
    metrics: dict[str, float] = {}
    stop = done >= total or callbacks.should_stop()
    if stop:
        return TrainResult(start, metrics, completed=done >= total)

    clock = time.perf_counter()
    # Each update leaves arrays on the devices where the next one expects them.
    places = jax.tree.map(lambda x: x.sharding, (learner, env_state))
    lowered = jax.jit(update_typed, donate_argnums=1, out_shardings=(*places, None)).lower(learner, env_state)
    compiled = lowered.compile(compiler_options())
    compile_s = time.perf_counter() - clock

    interval: list[Update] = []
    clock = time.perf_counter()
    while not stop:
        before = learner
        learner, env_state, update = compiled(learner, env_state)
        if not bool(update.finite):
            bad = [name for name, loss in sorted(update.losses.items()) if not np.isfinite(loss)]
            saved = callbacks.on_diverged(Snapshot(done * steps_per_update, before, None), update)
            raise DivergedError(
                f"diverged after env step {done * steps_per_update}: {', '.join(bad or ['parameters'])} not finite; "
                f"batch and learner before it are in {saved}; lower the learning rate or mend the batch"
            )
        done += 1
        interval.append(dataclasses.replace(update, batch=None))
        callbacks.on_update(done * steps_per_update)
        stop = done >= total or callbacks.should_stop()
        if done % log_every == 0 or stop:
            seconds = time.perf_counter() - clock
            metrics = interval_metrics(interval)
            metrics["env_steps_per_s"] = len(interval) * steps_per_update / seconds
            metrics["compile_s"] = compile_s
            interval, clock = [], time.perf_counter()
            callbacks.on_log(done * steps_per_update, metrics)
        if done % save_every == 0 or stop:
            callbacks.on_checkpoint(Snapshot(done * steps_per_update, learner, env_state))
            clock = time.perf_counter()
    return TrainResult(Snapshot(done * steps_per_update, learner, env_state), metrics, completed=done >= total)


def interval_metrics(updates: list[Update]) -> dict[str, float]:
    """Return means over updates (losses) and over the episodes that ended in them, if any did."""
    losses = {name: np.mean([float(u.losses[name]) for u in updates]) for name in updates[0].losses}
    sums = {name: np.sum([float(u.episode_sums[name]) for u in updates]) for name in updates[0].episode_sums}
    episodes = sums.pop("episodes")
    means = {name: total / episodes for name, total in sums.items()} if episodes else {}
    named = {"episode": means, "loss": losses}
    metrics = {f"{kind}/{name}": float(mean) for kind, each in named.items() for name, mean in each.items()}
    return {"episodes": float(episodes), **metrics}


def episode_sums(info: dict[str, Any]) -> dict[str, jax.Array]:
    """Return scalar sums over the episodes that ended, and their number `episodes`, from an environment's `info`.

    Only values of `episode_metrics` {name: [...]} where `episode_done` [...] is set count; others may be NaN.
    """
    ended = info["episode_done"] > 0
    sums = {name: jnp.sum(jnp.where(ended, value, 0.0)) for name, value in info["episode_metrics"].items()}
    return {**sums, "episodes": jnp.sum(ended.astype(jnp.float32))}


def all_finite(tree: PyTree) -> jax.Array:
    """Return () bool: every floating number of the tree is finite."""
    floats = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in floats]))


def strong_types(tree: PyTree) -> PyTree:
    """Return the tree with weakly typed leaves cast to strong types, so that every update has the same signature."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(jnp.asarray(x), jnp.asarray(x).dtype), tree)
