"""Drives and two trained networks in, a run folder with a local policy out; or one for every alpha and lambda.

RUN/config.yaml      settings; a run that is started again with the same ones goes on
    versions.json, metrics.jsonl, checkpoint.msgpack, results.json, curves.png   as in `training`
    weights.msgpack  the policy and the scale of its input; the forward model is not kept
    network.json     how to build it, and which runs embed its images
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import flax.linen as nn
import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np
import optax
from sklearn.metrics import confusion_matrix, f1_score

from interactive_nav_common.config import to_dict
from interactive_nav_common.files import whole_file, write_text
from interactive_nav_common.versions import versions
from topological_nav.config import DriveConfig, PolicyConfig
from topological_nav.drives.dataset import Drives, drive_images, load_drives, read_drives_header
from topological_nav.drives.policy import Forward, Policy, policy_loss, unrolled
from topological_nav.drives.sequences import (
    Sequences,
    class_values,
    joined,
    make_sequences,
    mirrored,
    thinned,
    turning_share,
)
from topological_nav.errors import RunError
from topological_nav.learn.learning import Epoch, Learner, compiled_epoch, in_batches, initial
from topological_nav.learn.runs import (
    CHECKPOINT,
    DESCRIPTION,
    RESULTS,
    WEIGHTS,
    claimed,
    cut_metrics,
    read_checkpoint,
    restored,
    run_epochs,
)
from topological_nav.learn.training import Trained, load_trained

GRID = [(alpha, lam) for alpha in (0.1, 10.0, 50.0) for lam in (0.1, 0.5, 1.0)]
"""alpha and lambda of the report's table."""
SAME = ("robot", "engine", "width", "height", "fov_deg")
"""What drives and networks must have in common to look through one camera."""
LEAST_SPREAD = 0.3
"""Features are scaled by their standard deviation, at least this share of the mean one."""
_TOLD_EVERY = 10
"""Files of images between two lines about embedding."""


@dataclasses.dataclass(frozen=True)
class Frames:
    """Drives of a folder and the embeddings of their images."""

    drives: Drives
    config: DriveConfig
    header: dict[str, Any]
    features: np.ndarray
    """[F or 2 F, D] f16 of all control steps, 0 where nothing was drawn; then the same of mirrored images."""
    networks: tuple[Trained, Trained]
    """Of rooms and of passages."""
    runs: tuple[Path, Path]

    @property
    def mirrored(self) -> bool:
        """Whether there are mirrored ones."""
        return len(self.features) > len(self.drives.command)


def load_networks(localiser_run: Path, detector_run: Path) -> tuple[Trained, Trained]:
    """The networks that embed the policy's images.

    Raises:
        RunError: one is not finished, or they learned from different cameras.
    """
    networks = load_trained(localiser_run), load_trained(detector_run)
    for run, network, task in zip((localiser_run, detector_run), networks, ("rooms", "passages"), strict=True):
        if network.about["task"] != task:
            raise RunError(f"{run}: was trained for '{network.about['task']}', expected a run of 'train {task}'")
    seen = [{**n.about["data"], "fov_deg": n.about["fov_deg"]} for n in networks]
    for name in SAME:
        if seen[0][name] != seen[1][name]:
            raise RunError(
                f"the localiser learned from images with {name} = {seen[0][name]!r}, the detector {seen[1][name]!r}; "
                "train both on one dataset"
            )
    return networks


def embed_drives(
    folder: Path,
    localiser_run: Path,
    detector_run: Path,
    mirror: bool,
    tell: Callable[[str], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Frames | None:
    """Embeds the images of all kept drives.

    Args:
        folder: of the drives.
        localiser_run: run folder of a room classifier.
        detector_run: of a passage detector.
        mirror: embed mirrored images too.
        tell: told now and then how far it is.
        should_stop: asked after every file of images.

    Returns:
        None where it was stopped.

    Raises:
        DatasetError, RunError: drives or networks cannot be used, or do not fit each other.
    """
    header, config = read_drives_header(folder)
    drives, networks = load_drives(folder), load_networks(localiser_run, detector_run)
    mine, theirs = {**header["settings"], "fov_deg": header["fov_deg"]}, networks[0].about
    for name in SAME:
        expected = theirs["fov_deg"] if name == "fov_deg" else theirs["data"][name]
        if mine[name] != expected:
            raise RunError(
                f"{folder}: images have {name} = {mine[name]!r}, the networks learned from {expected!r}; drive again "
                f"with {name}={expected}"
            )
    count, total, done = len(drives.command), int(drives.steps[drives.kept].sum()), 0
    features: np.ndarray | None = None
    embed = _embedder(networks, mirror)
    for i, (rows, images) in enumerate(drive_images(folder)):
        at, part = drives.rows(rows), in_batches(embed, images)
        if features is None:
            features = np.zeros((part.shape[1] * count, part.shape[2]), np.float16)
        for side in range(part.shape[1]):
            features[at + side * count] = part[:, side]
        done += len(images)
        if i % _TOLD_EVERY == 0 or done == total:
            tell(f"embedded {done:,} of {total:,} images")
        if should_stop():
            return None
    if features is None:
        raise RunError(f"{folder}: none of {len(drives)} drives was kept; drive more, or in other scenes")
    return Frames(drives, config, header, features, networks, (Path(localiser_run), Path(detector_run)))


def _embedder(networks: Sequence[Trained], mirror: bool) -> Callable[[jax.Array], jax.Array]:
    """Compiled: images [N, H, W, 3] to [N, 1 or 2, D] f16, all networks' embeddings, then those of the mirrored."""
    modules, weights = [network.network for network in networks], [network.variables for network in networks]

    @jax.jit
    def embedded(weights: Any, images: jax.Array) -> jax.Array:
        sides = []
        for shown in (images, images[:, :, ::-1]) if mirror else (images,):
            parts = [m.apply(w, shown, method="embed") for m, w in zip(modules, weights, strict=True)]
            sides.append(jnp.concatenate(parts, -1))  # type: ignore[arg-type]
        return jnp.stack(sides, 1).astype(jnp.float16)

    return functools.partial(embedded, weights)


def train_policy(
    frames: Frames,
    out: Path,
    config: PolicyConfig,
    tell: Callable[[str], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """Trains a policy, or goes on with it.

    Args:
        frames: of `embed_drives`.
        out: the run folder.
        config: settings.
        tell: told one line an epoch.
        should_stop: asked after every epoch.

    Returns:
        The content of results.json; None where it was stopped before the end.

    Raises:
        RunError: `out` holds another run, or there is no sequence to learn from.
    """
    if config.mirror and not frames.mirrored:
        raise RunError("mirror is set, but mirrored images were not embedded; embed them too or set mirror=false")
    drives, values = frames.drives, class_values(config, frames.config.linear_m_s, frames.config.angular_rad_s)
    every = make_sequences(drives, np.flatnonzero(drives.kept & ~drives.test), config, values, config.overlap_s)
    held_out = make_sequences(drives, np.flatnonzero(drives.kept & drives.test), config, values, 0.0)
    learned = thinned(every, config)
    if not len(learned):
        raise RunError(f"no sequence to learn from in {len(drives)} drives; drive more or set straight_kept=1")
    if config.mirror:
        learned = joined([learned, mirrored(learned, len(drives.command), config)])
    digests = [network.about["digest"] for network in frames.networks]
    with claimed(out, {"task": "policy", "dataset": frames.header, "networks": digests, **to_dict(config)}):
        write_text(out / "versions.json", json.dumps(versions(), indent=1) + "\n")

        policy = Policy(config.hidden, config.projection, config.linear_classes, config.angular_classes)
        forward = Forward(config.forward_hidden)
        tx, width = optax.adam(config.learning_rate), frames.features.shape[1]
        params = fresh_params(policy, forward, width, config.seed)
        used = frames.features[np.unique(learned.rows)].astype(np.float32)
        spread = used.std(0)
        # Features that hardly vary here must not become large where they do.
        scale = {
            "mean": jnp.asarray(used.mean(0)),
            "deviation": jnp.asarray(np.maximum(spread, LEAST_SPREAD * spread.mean() + 1e-6)),
        }
        learner = Learner(params, scale, tx.init(params))
        saved = read_checkpoint(out / CHECKPOINT)
        cut_metrics(out, ("policy",), saved)
        first = 0
        if saved:
            first, learner = saved["epoch"], restored(learner, saved["learner"], out / CHECKPOINT)
        alone = math.ceil(config.alone * config.epochs - 1e-9)
        shown, truth = jnp.asarray(frames.features), jax.tree.map(jnp.asarray, dataclasses.asdict(learned))
        epoch = policy_epoch(policy, forward, config.learning_rate, config.batch, len(learned))  # type: ignore[arg-type]
        keys, weights = (
            jax.random.PRNGKey(config.seed),
            {"alpha": jnp.float32(config.alpha), "lam": jnp.float32(config.lam)},
        )

        def one(learner, number):
            labels = {**truth, **weights, "jointly": jnp.float32(number >= alone)}
            return epoch(learner, shown, labels, jax.random.fold_in(keys, number))

        learner, done = run_epochs("policy", learner, one, range(first, config.epochs), out, tell, should_stop)
        if not done:
            return None
        return _finish(frames, out, config, values, learner, policy, forward, every, learned, held_out)


def fresh_params(policy: Policy, forward: Forward, width: int, seed: int) -> dict[str, Any]:
    """First weights of policy and forward model for embeddings of `width` numbers; the latter predicts no change."""
    key, u = jax.random.PRNGKey(0), jax.ShapeDtypeStruct((1, width), jnp.float32)
    action = jax.ShapeDtypeStruct((1, policy.linear_classes + policy.angular_classes), jnp.float32)
    shapes = {
        "policy": jax.eval_shape(lambda k, x: policy.init(k, policy.fresh(1), x), key, u)["params"],
        "forward": jax.eval_shape(lambda k, x, a: forward.init(k, x, x, a, x[0]), key, u, action)["params"],
    }
    params = initial(shapes, seed)
    last = params["forward"]["Dense_2"]
    params["forward"]["Dense_2"] = {**last, "kernel": jnp.zeros_like(last["kernel"])}
    return params


@functools.cache
def policy_epoch(policy: Policy, forward: Forward, learning_rate: float, batch: int, count: int) -> Epoch:
    """An epoch over `count` sequences; the last, incomplete batch is left out. See `learning.compiled_epoch`.

    Labels: the fields of `Sequences`, and numbers `alpha`, `lam` and `jointly` as `policy_loss` has them: one program
    serves a whole grid.
    """
    tx, most = optax.adam(learning_rate), batch

    def loss_of(params, scale, u, batch, weights):
        x = (u - scale["mean"]) / scale["deviation"]
        logits = unrolled(policy, params["policy"], x[:, :-1])
        truth = (batch["linear"], batch["angular"])
        sizes = (policy.linear_classes, policy.angular_classes)
        expert = jnp.concatenate([jax.nn.one_hot(t, n) for t, n in zip(truth, sizes, strict=True)], -1)
        own = jnp.concatenate([nn.softmax(value) for value in logits], -1)

        def next_after(action) -> Any:
            given = (u[:, :-1], x[:, :-1], action, scale["deviation"])
            return forward.apply({"params": params["forward"]}, *given)

        loss, parts = policy_loss(
            logits, *truth, batch["valid"], next_after(expert), next_after(own), u[:, 1:], batch["followed"], **weights
        )
        right = {
            f"{name}_accuracy": ((one.argmax(-1) == t) & batch["valid"]).sum() / batch["valid"].sum()
            for name, one, t in zip(("linear", "angular"), logits, truth, strict=True)
        }
        return loss, {"loss": loss, **parts, **right}

    def steps(features, key):
        del features
        size = min(most, count)
        return (jax.random.permutation(key, count)[: count // size * size].reshape(-1, size),)

    def update(learner, features, labels, step):
        (which,) = step
        batch = {name: labels[name][which] for name in ("rows", "valid", "followed", "linear", "angular")}
        u = features[batch["rows"]].astype(jnp.float32)
        grad = jax.value_and_grad(loss_of, has_aux=True)
        weights = {name: labels[name] for name in ("alpha", "lam", "jointly")}
        (_, told), slope = grad(learner.params, learner.batch_stats, u, batch, weights)
        change, opt_state = tx.update(slope, learner.opt_state, learner.params)
        return Learner(optax.apply_updates(learner.params, change), learner.batch_stats, opt_state), told

    return compiled_epoch(steps, update)


def _finish(
    frames: Frames,
    out: Path,
    config: PolicyConfig,
    values: tuple[np.ndarray, np.ndarray],
    learner: Learner,
    policy: Policy,
    forward: Forward,
    every: Sequences,
    learned: Sequences,
    held_out: Sequences,
) -> dict[str, Any]:
    """Writes weights, description and scores."""
    kept = {"params": learner.params["policy"], "scale": learner.batch_stats}
    weights = flax.serialization.to_bytes(jax.device_get(kept))
    with whole_file(out / WEIGHTS) as partial:
        partial.write_bytes(weights)
    about = {
        "task": "policy",
        "hidden": config.hidden,
        "projection": config.projection,
        "width": int(frames.features.shape[1]),
        "linear_m_s": values[0].tolist(),
        "angular_rad_s": values[1].tolist(),
        "networks": [
            {"run": os.path.relpath(run.resolve(), out.resolve()), "digest": network.about["digest"]}
            for run, network in zip(frames.runs, frames.networks, strict=True)
        ],
        "parameters": int(sum(np.size(x) for x in jax.tree.leaves(learner.params["policy"]))),
        "digest": hashlib.sha256(weights).hexdigest(),
    }
    write_text(out / DESCRIPTION, json.dumps(about, indent=1) + "\n")
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
    write_text(out / RESULTS, json.dumps(results, indent=1) + "\n")
    return results


@functools.cache
def _judge(policy: Policy, forward: Forward) -> Callable[..., tuple[jax.Array, ...]]:
    """Compiled: the policy's classes, and squared errors of the forward model and of no change."""

    @jax.jit
    def judged(params, scale, u, linear, angular):
        x = (u - scale["mean"]) / scale["deviation"]
        logits = unrolled(policy, params["policy"], x[:, :-1])
        action = jnp.concatenate(
            [jax.nn.one_hot(linear, policy.linear_classes), jax.nn.one_hot(angular, policy.angular_classes)], -1
        )
        predicted = forward.apply({"params": params["forward"]}, u[:, :-1], x[:, :-1], action, scale["deviation"])
        errors = [jnp.square(u[:, 1:] - guess).sum(-1) for guess in (predicted, u[:, :-1])]
        return *(value.argmax(-1) for value in logits), *errors

    return judged


def _scores(
    features: np.ndarray,
    learner: Learner,
    policy: Policy,
    forward: Forward,
    held_out: Sequences,
    config: PolicyConfig,
) -> dict[str, Any]:
    """How the policy's commands on held-out drives compare with the expert's, and the forward model with no change."""
    judged = _judge(policy, forward)  # type: ignore[arg-type]  (flax modules are hashable)
    columns = []
    for first in range(0, len(held_out), config.batch):
        rows = np.minimum(np.arange(first, first + config.batch), len(held_out) - 1)
        part = held_out.take(rows)
        told = judged(
            learner.params,
            learner.batch_stats,
            jnp.asarray(features[part.rows], jnp.float32),
            part.linear,
            part.angular,
        )
        columns.append([np.asarray(c)[: len(held_out) - first] for c in told])
    linear, angular, predicted, still = (np.concatenate(c) for c in zip(*columns, strict=True))
    out: dict[str, Any] = {"steps": int(held_out.valid.sum())}
    for name, found, truth, count in (
        ("linear", linear, held_out.linear, config.linear_classes),
        ("angular", angular, held_out.angular, config.angular_classes),
    ):
        found, truth = found[held_out.valid], truth[held_out.valid]
        out[name] = {
            "accuracy": float((found == truth).mean()),
            "macro_f1": float(f1_score(truth, found, average="macro")),
            "commonest": float(np.bincount(truth, minlength=count).max() / len(truth)),
            "confusion": confusion_matrix(truth, found, labels=range(count)).tolist(),
        }
    followed = held_out.followed
    out["forward"] = float(predicted[followed].mean()) if followed.any() else 0.0
    out["no_change"] = float(still[followed].mean()) if followed.any() else 0.0
    return out


def train_grid(
    frames: Frames,
    out: Path,
    config: PolicyConfig,
    tell: Callable[[str], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> list[dict[str, Any]] | None:
    """A policy for every alpha and lambda of the report, each in a folder of its own under `out`.

    Returns:
        The results, also written to grid.json and, as a table, to grid.md; None where it was stopped.
    """
    rows = []
    for alpha, lam in GRID:
        one = dataclasses.replace(config, alpha=alpha, lam=lam)
        tell(f"alpha {alpha:g}, lambda {lam:g}: {len(rows) + 1} of {len(GRID)}")
        results = train_policy(frames, out / f"alpha-{alpha:g}-lambda-{lam:g}", one, tell, should_stop)
        if results is None:
            return None
        rows.append(results)
    write_text(out / "grid.json", json.dumps(rows, indent=1) + "\n")
    write_text(out / "grid.md", grid_table(rows))
    return rows


def grid_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a row for every alpha and lambda."""
    lines = [
        "| alpha | lambda | linear accuracy | macro F1 | angular accuracy | macro F1 | forward error | of no change |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [f"{row['alpha']:g}", f"{row['lambda']:g}"]
        if "test" in row:
            test = row["test"]
            cells += [f"{test[name][key]:.3f}" for name in ("linear", "angular") for key in ("accuracy", "macro_f1")]
            cells += [f"{test['forward']:.4f}", f"{test['no_change']:.4f}"]
        else:
            cells += ["none held out"] + [""] * 5
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
