"""Train the network on buildings that are generated beside the training, which continues where it stopped.

OUT/crops/SEED.npz   labelled voxels of a generated building, held_out/SEED.npz of those with other furniture
    checkpoint.msgpack, weights.safetensors, metrics.jsonl   as of the last save
"""

import contextlib
import dataclasses
import functools
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np
import optax

from converters.segment.labelling import VoxelNet, dense, save_network
from converters.segment.samples import Crop, generate_crops, read_crops
from converters.segment.voxels import FEATURES, NAMES, UNKNOWN, intersection_over_union
from interactive_nav_common.config import AtLeastOne, Count, Positive, Seed, Settings
from interactive_nav_common.records import METRICS, cut_metrics
from interactive_nav_common.runs.folder import CHECKPOINT, append_metrics
from interactive_nav_common.runs.weights import read_state, write_state
from interactive_nav_common.signals import signals_wait

HELD_OUT_SEED = 900_000
State = tuple[Any, Any]
"""Parameters, optimiser's state."""


@dataclasses.dataclass(frozen=True)
class SegmentConfig(Settings):
    """What the network learns from, and for how long."""

    buildings: Count = 400
    """Generated, each another home or sparse building."""
    held_out: Count = 24
    """Buildings with other furniture that it is scored by."""
    crops: AtLeastOne = 48
    """Of a building, each worn in another way."""
    side: AtLeastOne = 96
    """Voxels of a crop's side, a multiple of 8."""
    widths: tuple[int, ...] = (40, 64, 96)
    """Channels of the levels."""
    batch: Count = 16
    """Crops of a step."""
    most_voxels: Count = 40000
    """Of a crop; the rest is left out at random."""
    steps: Count = 20000
    """At most."""
    minutes: Positive = 480.0
    """At most, of training; the learning rate falls to nothing at whichever comes first."""
    learning_rate: Positive = 2e-3
    """At the beginning."""
    workers: Count = os.cpu_count() or 1
    """Processes that generate."""
    save_s: Positive = 60.0
    """Seconds between saves."""
    half: bool = False
    """Computes in bfloat16, for GPUs."""
    seed: Seed = 0
    """Of the first building, and of the weights."""


def turned(crop: Crop, side: int, quarter: int, mirror: bool) -> Crop:
    """Return the crop turned by quarters, counter-clockwise, and then mirrored in x, within its square."""
    index, features = crop.index.astype(np.int64), crop.features.copy()
    for _ in range(quarter % 4):
        index = np.stack([side - 1 - index[:, 1], index[:, 0], index[:, 2]], axis=1)
        features[:, 0], features[:, 1] = -features[:, 1], features[:, 0].copy()
    if mirror:
        index[:, 0], features[:, 0] = side - 1 - index[:, 0], -features[:, 0]
    return Crop(index, features, crop.classes)


def batch_of(crops: Sequence[Crop], config: SegmentConfig, rng: np.random.Generator | None) -> tuple[np.ndarray, ...]:
    """Return index [N, K, 3] i32, features [N, K, FEATURES] i8 and classes [N, K] u8; turned if `rng`."""
    n, k = len(crops), config.most_voxels
    index, classes = np.full((n, k, 3), -1, np.int32), np.full((n, k), UNKNOWN, np.uint8)
    features = np.zeros((n, k, FEATURES), np.int8)
    for row, crop in enumerate(crops):
        pick = np.arange(len(crop.index))
        if rng is not None:
            crop, pick = turned(crop, config.side, int(rng.integers(4)), bool(rng.integers(2))), rng.permutation(pick)
        for column, given in ((index, crop.index), (features, crop.features), (classes, crop.classes)):
            column[row, : len(pick[:k])] = given[pick[:k]]
    return index, features, classes


@signals_wait()  # a compilation that is left crashes the interpreter at its end
@functools.partial(jax.jit, static_argnums=(0, 4))
def _scores_at(net: VoxelNet, params: Any, index: jax.Array, features: jax.Array, side: int) -> jax.Array:
    out = net.apply({"params": params}, dense(index, features, (side, side)))
    assert isinstance(out, jax.Array)
    at = jnp.maximum(index, 0)
    return out[jnp.arange(len(index))[:, None], at[..., 0], at[..., 1], at[..., 2]]


def make_step(net: VoxelNet, config: SegmentConfig) -> tuple[Callable[[Any], State], Callable[..., tuple[Any, ...]]]:
    """Return parameters -> state, and (state, learning rate, batch) -> state, loss; rare classes weigh more."""
    rule = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(), optax.add_decayed_weights(1e-3))

    def loss_of(params: Any, index: jax.Array, features: jax.Array, classes: jax.Array) -> jax.Array:
        scores = _scores_at(net, params, index, features, config.side)
        labelled = classes != UNKNOWN
        classes = jnp.where(labelled, classes, 0)
        count = jnp.zeros(len(NAMES)).at[classes].add(labelled)
        weight = jnp.where(labelled, ((count.sum() / (count + 1.0)) ** 0.5)[classes], 0.0)
        loss = optax.softmax_cross_entropy_with_integer_labels(scores, classes)
        return (weight * loss).sum() / jnp.maximum(weight.sum(), 1.0)

    @signals_wait()
    @functools.partial(jax.jit, donate_argnums=0)
    def step(state: State, rate: jax.Array, *batch: jax.Array) -> tuple[State, jax.Array]:
        loss, gradient = jax.value_and_grad(loss_of)(state[0], *batch)
        change, inner = rule.update(gradient, state[1], state[0])
        return (optax.apply_updates(state[0], jax.tree.map(lambda c: -rate * c, change)), inner), loss

    return lambda params: (params, rule.init(params)), step


def score_crops(net: VoxelNet, params: Any, crops: Sequence[Crop], config: SegmentConfig) -> dict[str, float]:
    """Return class -> IoU over all voxels of the crops."""
    truth, predicted = [], []
    for first in range(0, len(crops), config.batch):
        index, features, classes = batch_of(crops[first : first + config.batch], config, None)
        predicted.append(np.asarray(_scores_at(net, params, index, features, config.side).argmax(axis=-1)).ravel())
        truth.append(classes.ravel())
    return intersection_over_union(np.concatenate(truth), np.concatenate(predicted)) if crops else {}


def train(out: Path, config: SegmentConfig, report: Callable[[str, float], None], log: Callable[[str], None]) -> dict:
    """Train or resume, and save at the end or on interruption; return held-out IoU by class and `mean`."""
    tasks = []
    for folder, split, seed, count, crops in (
        ("held_out", "test", HELD_OUT_SEED, config.held_out, 8),
        ("crops", "train", config.seed, config.buildings, config.crops),
    ):
        (out / folder).mkdir(parents=True, exist_ok=True)
        tasks += [(out / folder / f"{k}.npz", k, split, crops, config.side) for k in range(seed, seed + count)]
    with multiprocessing.get_context("spawn").Pool(
        config.workers, signal.signal, (signal.SIGINT, signal.SIG_IGN)
    ) as pool:
        learner = _Learner(out, config, log, pool.imap_unordered(generate_crops, tasks))
        try:
            least = min(len(tasks), config.held_out + min(config.buildings, 2 * config.workers))
            for k in range(least):
                learner.take(None)
                report("generating", (k + 1) / least)
            learner.run(report)
        finally:
            learner.save()
    return learner.score(len(learner.crops["held_out"]))


class _Learner:
    """Hold the network, its optimiser, the crops and how far the training is."""

    def __init__(self, out: Path, config: SegmentConfig, log: Callable[[str], None], paths: Any) -> None:
        self.out, self.config, self.log, self.paths = out, config, log, paths
        self.crops: dict[str, list[Crop]] = {"crops": [], "held_out": []}
        self.net = VoxelNet(config.widths, jnp.bfloat16 if config.half else jnp.float32)
        start, self.step = make_step(self.net, config)
        nothing = jnp.zeros((1, 8, 8, 8, FEATURES + 2))
        params = jax.jit(self.net.init)(jax.random.key(config.seed), nothing)["params"]
        self.at: dict[str, Any] = {"state": start(params), "steps": 0, "seconds": 0.0}
        self.loss: Any = float("nan")
        if saved := read_state(out / CHECKPOINT):
            self.at = flax.serialization.from_state_dict(self.at, saved)
        cut_metrics(out / METRICS, lambda row: row["step"] <= self.at["steps"])

    def take(self, wait_s: float | None) -> None:
        """Read the next building that is finished."""
        path = self.paths.next(wait_s)
        self.crops[path.parent.name] += read_crops(path)

    def run(self, report: Callable[[str, float], None]) -> None:
        """Run the steps that are left."""
        at, config, crops = self.at, self.config, self.crops["crops"]
        rng = np.random.default_rng((config.seed, at["steps"]))
        saved = last = time.monotonic()
        while (share := max(at["steps"] / config.steps, at["seconds"] / 60 / config.minutes)) < 1:
            rate = config.learning_rate * (0.5 + 0.5 * np.cos(np.pi * share)) * min(1.0, (at["steps"] + 1) / 100)
            batch = batch_of([crops[k] for k in rng.integers(len(crops), size=config.batch)], config, rng)
            at["state"], self.loss = self.step(at["state"], rate, *batch)
            at["steps"] += 1
            if at["steps"] % 10 == 0:
                report("training", share)
                with contextlib.suppress(multiprocessing.TimeoutError, StopIteration):
                    while True:
                        self.take(0)
            now = time.monotonic()
            at["seconds"], last = at["seconds"] + now - last, now
            if now - saved > config.save_s:
                self.save()
                self.score(4 * config.batch)
                saved = last = time.monotonic()

    def save(self) -> None:
        """Write checkpoint and weights."""
        if self.at["steps"]:
            write_state(self.out / CHECKPOINT, self.at)
            save_network(self.out / "weights.safetensors", self.net, {"params": self.at["state"][0]})

    def score(self, most: int) -> dict[str, float]:
        """Return IoU by class of so many held-out crops, and `mean`; add a line to metrics.jsonl and the console."""
        scores = score_crops(self.net, self.at["state"][0], self.crops["held_out"][:most], self.config)
        scores["mean"] = float(np.mean(list(scores.values()))) if scores else 0.0
        steps, seconds, loss = self.at["steps"], self.at["seconds"], float(self.loss)
        row = {"step": steps, "seconds": round(seconds, 1), "loss": None if np.isnan(loss) else loss, "iou": scores}
        append_metrics(self.out, row)
        scored = f"loss {loss:.3f}, held-out mIoU {scores['mean']:.3f}"
        self.log(f"step {steps}, {seconds:.0f} s, {len(self.crops['crops'])} crops: {scored}")
        return scores
