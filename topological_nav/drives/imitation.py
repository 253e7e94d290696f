"""Train a local policy on drives as two networks see them, into a run folder; or one per alpha and lambda.

RUN/config.yaml      settings; the same settings resume the run
    versions.json, metrics.jsonl, checkpoint.msgpack, results.json, curves.png   as in `training`
    weights.safetensors  the policy and the scale of its input, without the forward model
    network.json     how to build it, and the runs that embed its images
"""

import dataclasses
import functools
import math
import os
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from interactive_nav_common.config import to_dict
from interactive_nav_common.errors import FileError
from interactive_nav_common.files import write_json, write_text
from interactive_nav_common.rows import Rows, markdown
from interactive_nav_common.runs.folder import claimed, run_epochs
from topological_nav.config import PolicyConfig
from topological_nav.drives.dataset import Drives
from topological_nav.drives.driving import Forward, Frames, Policy, fresh_params, policy_loss, standardised, unrolled
from topological_nav.drives.expert import CONTROL_S
from topological_nav.learn.learning import RESULTS, Epoch, Learner, descent_epoch, shuffled, write_network
from topological_nav.learn.training import class_scores
from topological_nav.scenes.rendering import batched

GRIDS = {
    "nine": [(alpha, lam) for alpha in (0.1, 10.0, 50.0) for lam in (0.1, 0.5, 1.0)],
    "report": [(0.1, 0.5), (10.0, 0.1), (50.0, 1.0)],
}
"""Pairs of alpha and lambda: those of the report's table II, and all combinations of its values."""
LEAST_SPREAD = 0.3
"""Features are scaled by their standard deviation, at least this share of the mean one."""


@dataclasses.dataclass(frozen=True)
class Sequences(Rows):
    """Hold W windows of T control steps."""

    rows: np.ndarray
    """[W, T + 1] i32 indices of the steps' frames; after a drive's end, its last one."""
    valid: np.ndarray
    """[W, T] bool: the step belongs to the drive."""
    followed: np.ndarray
    """[W, T] bool: the next frame belongs to the drive too."""
    linear: np.ndarray
    """[W, T] i32 class of the commanded velocity."""
    angular: np.ndarray
    """[W, T] i32."""


def class_values(config: PolicyConfig, linear_m_s: float, angular_rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the classes' velocities, ascending: linear [L] m/s and angular [A] rad/s."""
    return (
        np.linspace(0.0, linear_m_s, config.linear_classes),
        np.linspace(-angular_rad_s, angular_rad_s, config.angular_classes),
    )


def classes(values: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Return the index (i32) of the nearest of ascending values [C]; of two equally near, the lower."""
    return np.searchsorted((of[1:] + of[:-1]) / 2, values - 1e-6).astype(np.int32)


def window_starts(steps: int, window: int, overlap: int) -> np.ndarray:
    """Return the starts of a drive's windows, which share at most `overlap` steps; a drive's remainder is dropped."""
    stride = max(window - overlap, 1)
    return np.arange(0, max(steps - window, 0) + 1, stride)


def make_sequences(
    drives: Drives, which: np.ndarray, config: PolicyConfig, values: tuple[np.ndarray, np.ndarray], overlap_s: float
) -> Sequences:
    """Return all windows of the drives with indices [k]."""
    window, overlap = config.steps, int(np.floor(overlap_s / CONTROL_S + 1e-9))
    rows, ends = [], []
    for k in which:
        begin, steps = int(drives.first[k]), int(drives.steps[k])
        for start in window_starts(steps, window, min(overlap, window - 1)):
            rows.append(begin + start + np.arange(window + 1))
            ends.append(begin + steps)
    at, end = np.array(rows, int).reshape(-1, window + 1), np.array(ends, int)[:, None]
    capped = np.minimum(at, end - 1).astype(np.int32)
    command = drives.command[capped[:, :-1]]
    commanded = (classes(command[..., k], of) for k, of in enumerate(values))
    return Sequences(capped, at[:, :-1] < end, at[:, 1:] < end, *commanded)


def turning_share(sequences: Sequences, config: PolicyConfig) -> np.ndarray:
    """Return each window's share [W] of steps whose angular class is not straight ahead."""
    turns = (sequences.angular != config.angular_classes // 2) & sequences.valid
    return turns.sum(1) / np.maximum(sequences.valid.sum(1), 1)


def thinned(sequences: Sequences, config: PolicyConfig) -> Sequences:
    """Return the windows, keeping nearly straight ones with probability `straight_kept`."""
    straight = turning_share(sequences, config) < config.straight_share
    rng = np.random.default_rng([config.seed, 7])
    return sequences.take(np.flatnonzero(~straight | (rng.random(len(sequences)) < config.straight_kept)))


def mirrored(sequences: Sequences, frames: int, config: PolicyConfig) -> Sequences:
    """Return the windows mirrored: frames are offset by `frames`, and left and right are exchanged."""
    return dataclasses.replace(
        sequences, rows=sequences.rows + frames, angular=config.angular_classes - 1 - sequences.angular
    )


def train_policy(frames: Frames, out: Path, config: PolicyConfig) -> dict[str, Any]:
    """Train a policy, or continue the run at `out`; return the content of results.json."""
    if config.mirror and not frames.mirrored:
        raise FileError("mirror is set, but mirrored images were not embedded; embed them too or set mirror=false")
    values = class_values(config, frames.config.linear_m_s, frames.config.angular_rad_s)
    every, learned, held_out = _split(frames.drives, config, values)
    digests = [network.about["digest"] for network in frames.networks]
    with claimed(out, {"task": "policy", "dataset": frames.header, "networks": digests, **to_dict(config)}):
        policy = Policy(config.hidden, config.projection, config.linear_classes, config.angular_classes)
        forward = Forward(config.forward_hidden, config.predicts == "change")
        params = fresh_params(policy, forward, frames.features.shape[1], config.seed)
        # Features that hardly vary here must not become large where they do.
        used = frames.features[np.unique(learned.rows)].astype(np.float32)
        deviation = np.maximum(used.std(0), LEAST_SPREAD * used.std(0).mean() + 1e-6)
        scale = {"mean": jnp.asarray(used.mean(0)), "deviation": jnp.asarray(deviation)}
        learner = Learner(params, scale, optax.adam(config.learning_rate).init(params))
        alone = math.ceil(config.alone * config.epochs - 1e-9)
        weights = {"alpha": jnp.float32(config.alpha), "lam": jnp.float32(config.lam)}
        shown, truth = jnp.asarray(frames.features), jax.tree.map(jnp.asarray, dataclasses.asdict(learned))
        epoch = policy_epoch(policy, forward, config.learning_rate, config.batch, len(learned))  # type: ignore[arg-type]

        def one(learner: Learner, number: int, key: jax.Array):
            phase = {"jointly": jnp.float32(number >= alone), "consistent": jnp.float32(config.lam_alone)}
            return epoch(learner, shown, {**truth, **weights, **phase}, key)

        key = jax.random.PRNGKey(config.seed)
        learner = run_epochs(out, "policy", learner, one, config.epochs, key)
        about = {
            "task": "policy",
            "hidden": config.hidden,
            "projection": config.projection,
            "width": int(frames.features.shape[1]),
            "linear_m_s": values[0].tolist(),
            "angular_rad_s": values[1].tolist(),
            "networks": [
                {"run": os.path.relpath(network.run.resolve(), out.resolve()), "digest": network.about["digest"]}
                for network in frames.networks
            ],
            "parameters": int(sum(np.size(x) for x in jax.tree.leaves(learner.params["policy"]))),
        }
        write_network(out, {"params": learner.params["policy"], "scale": learner.batch_stats}, about)
        results: dict[str, Any] = {
            "task": "policy",
            "alpha": config.alpha,
            "lambda": config.lam,
            "parameters": about["parameters"],
            "sequences": len(learned),
            "nearly_straight": float((turning_share(every, config) < config.straight_share).mean()),
            "classes": {"linear": about["linear_m_s"], "angular": about["angular_rad_s"]},
        }
        if len(held_out):
            results["test"] = _scores(frames.features, learner, policy, forward, held_out, config)
        return write_json(out / RESULTS, results)


def _split(drives: Drives, config: PolicyConfig, values: tuple[np.ndarray, np.ndarray]):
    """Return training sequences, thinned and mirrored if set, and held-out ones."""
    every = make_sequences(drives, np.flatnonzero(drives.kept & ~drives.test), config, values, config.overlap_s)
    held_out = make_sequences(drives, np.flatnonzero(drives.kept & drives.test), config, values, 0.0)
    learned = thinned(every, config)
    if not len(learned):
        raise FileError(f"no sequence to learn from in {len(drives)} drives; drive more or set straight_kept=1")
    if config.mirror:
        learned = Sequences.joined([learned, mirrored(learned, len(drives.command), config)])
    return every, learned, held_out


def _applied(policy: Policy, forward: Forward, params: Any, scale: Any, u: jax.Array):
    """Return logits of embeddings [B, T + 1, D], and a function from actions [B, T, classes] to next embeddings."""
    x = standardised(u, scale)

    def next_after(action: list[jax.Array]) -> Any:
        given = (u[:, :-1], x[:, :-1], jnp.concatenate(action, -1), scale["deviation"])
        return forward.apply({"params": params["forward"]}, *given)

    return unrolled(policy, params["policy"], x[:, :-1]), next_after


def _one_hot(policy: Policy, linear: jax.Array, angular: jax.Array) -> list[jax.Array]:
    return [jax.nn.one_hot(linear, policy.linear_classes), jax.nn.one_hot(angular, policy.angular_classes)]


@functools.cache
def policy_epoch(policy: Policy, forward: Forward, learning_rate: float, batch: int, count: int) -> Epoch:
    """Build an epoch over `count` sequences without the last, partial batch; see `learning.compiled_epoch`.

    Labels are the fields of `Sequences` and the numbers `alpha`, `lam`, `jointly` and `consistent` of `policy_loss`, so
    that one program serves a whole grid. The policy is frozen while `jointly` is 0.
    """

    def loss_of(params, scale, features, labels, step):
        (which,) = step
        batch = {name: labels[name][which] for name in ("rows", "valid", "followed", "linear", "angular")}
        weights = {name: labels[name] for name in ("alpha", "lam", "jointly", "consistent")}
        u = features[batch["rows"]].astype(jnp.float32)
        truth = (batch["linear"], batch["angular"])
        logits, next_after = _applied(policy, forward, params, scale, u)
        chosen = [nn.softmax(value) for value in logits]
        chosen = [jnp.where(weights["jointly"] > 0, p, jax.lax.stop_gradient(p)) for p in chosen]
        guesses = next_after(_one_hot(policy, *truth)), next_after(chosen)
        loss, parts = policy_loss(logits, batch, guesses, u[:, 1:], **weights)
        right = {
            f"{name}_accuracy": ((one.argmax(-1) == t) & batch["valid"]).sum() / batch["valid"].sum()
            for name, one, t in zip(("linear", "angular"), logits, truth, strict=True)
        }
        return loss, (scale, {**parts, **right})

    def steps(_, key):
        return (shuffled(key, count, batch),)

    return descent_epoch(steps, loss_of, optax.adam(learning_rate))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _judged(policy: Policy, forward: Forward, params: Any, scale: Any, u: jax.Array, linear: Any, angular: Any):
    """Return the policy's classes, and squared errors of the forward model and of predicting no change."""
    logits, next_after = _applied(policy, forward, params, scale, u)
    guesses = next_after(_one_hot(policy, linear, angular)), u[:, :-1]
    errors = [jnp.square(u[:, 1:] - guess).sum(-1) for guess in guesses]
    return *(value.argmax(-1) for value in logits), *errors


def _scores(
    features: np.ndarray, learner: Learner, policy: Policy, forward: Forward, held_out: Sequences, config: PolicyConfig
) -> dict[str, Any]:
    """Compare the policy with the expert on held-out drives, and the forward model with predicting no change."""

    def judged(rows: np.ndarray, *commands: np.ndarray) -> Any:
        u = jnp.asarray(features[rows], jnp.float32)
        return _judged(policy, forward, learner.params, learner.batch_stats, u, *commands)

    parts = held_out.rows, held_out.linear, held_out.angular
    linear, angular, predicted, still = batched(judged, parts, (config.batch,))
    out: dict[str, Any] = {"steps": int(held_out.valid.sum())}
    for name, chosen, truth, count in (
        ("linear", linear, held_out.linear, config.linear_classes),
        ("angular", angular, held_out.angular, config.angular_classes),
    ):
        chosen, truth = chosen[held_out.valid], truth[held_out.valid]
        out[name] = {
            **class_scores(truth, chosen, count),
            "commonest": float(np.bincount(truth, minlength=count).max() / len(truth)),
        }
    followed = held_out.followed
    out["forward"] = float(predicted[followed].mean()) if followed.any() else 0.0
    out["no_change"] = float(still[followed].mean()) if followed.any() else 0.0
    return out


def train_grid(frames: Frames, out: Path, config: PolicyConfig) -> list[dict[str, Any]]:
    """Train a policy in a folder under `out` for each pair of alpha and lambda; write and return the results."""
    rows = []
    grid = GRIDS[config.pairs]
    for alpha, lam in grid:
        one = dataclasses.replace(config, alpha=alpha, lam=lam)
        print(f"alpha {alpha:g}, lambda {lam:g}: {len(rows) + 1} of {len(grid)}", flush=True)
        rows.append(train_policy(frames, out / f"alpha-{alpha:g}-lambda-{lam:g}", one))
    write_json(out / "grid.json", rows)
    write_text(out / "grid.md", grid_table(rows))
    return rows


def grid_table(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table of scores on held-out drives, if any, with a row per alpha and lambda."""
    names = [(kind, key) for kind in ("linear", "angular") for key in ("accuracy", "macro_f1")]
    lines = [
        [f"{row[name]:g}" for name in ("alpha", "lambda")]
        + [f"{test[kind][key]:.3f}" for kind, key in names]
        + [f"{test[name]:.4f}" for name in ("forward", "no_change")]
        for row in rows
        if (test := row.get("test"))
    ]
    scores = ("linear accuracy", "macro F1", "angular accuracy", "macro F1", "forward error", "of no change")
    return markdown(("alpha", "lambda", *scores), lines)
