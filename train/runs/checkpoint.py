"""Write snapshots as checkpoint folders, and read them: each is whole, and its files are those that were written."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.robots import robot_name
from interactive_nav_common.config import Natural
from interactive_nav_common.errors import UserError, regular
from interactive_nav_common.files import check_name, remove_stale, whole_folder, write_text, writing
from interactive_nav_common.records import Reader
from interactive_nav_common.runs import weights
from interactive_nav_common.runs.folder import GOES_ON
from interactive_nav_common.runs.weights import write_state
from interactive_nav_common.untrusted.reading import read_npz
from train.config import EnvConfig
from train.runs import STEP
from train.runs.run_folder import RunFolder

LEARNER, ENV_STATE, META = "learner.msgpack", "env_state.npz", "meta.json"
POLICY = "policy.safetensors"
"""Holds the policy alone: it acts nearly as the original (see docs/results-sparse.md) and cannot be trained."""
SHOWN = ("algorithm", "robot", "observations", "observation_size", "action_size", "env_steps")
"""Fields of `CheckpointMeta` that a policy's file repeats."""


class CheckpointError(UserError):
    """A checkpoint that is missing, damaged or belongs to something else."""


@dataclasses.dataclass(frozen=True)
class CheckpointMeta:
    """The content of `meta.json`: which run, robot, observations and step a checkpoint belongs to."""

    env_steps: Natural
    wall_s: float
    """Training time up to here, over all sittings."""
    score: float | None
    """Mean of run.best_metric over the checkpoint interval, at least a time limit; None if no episode ended in it, or
    if it reaches back to before every environment has had the time for a whole episode."""
    algorithm: str
    robot: str
    observations: tuple[str, ...]
    observation_size: int | dict[str, list[int]]
    """Length of the vector, or with images the shape under each key."""
    action_size: int
    began_together: int = 0
    """Env steps at which all environments last began new episodes."""
    curriculum_m: float | None = None
    """The limit that new episodes were drawn under (`run.curriculum`)."""
    sha256: dict[str, str] = dataclasses.field(default_factory=dict)
    """File name -> SHA-256 of its content; empty in checkpoints of earlier releases."""
    scenes: dict[str, str] = dataclasses.field(default_factory=dict)
    """Scene name -> digest of the task in it (`Scene.task_digest`)."""


def save_snapshot(root: Path, snapshot: Any, meta: CheckpointMeta, keep: int, env_state_limit_mb: float) -> Path:
    """Write `root/<env steps>/` and remove all but the newest `keep` snapshots and the best.

    Only the newest holds the environments, and only if they take no more than the limit.
    """
    final = root / f"{meta.env_steps:012d}"
    with writing(final, GOES_ON, "cannot write the checkpoint"), whole_folder(final, overwrite=True) as part:
        write_state(part / LEARNER, snapshot.learner)
        if snapshot.env_state is not None and megabytes(snapshot.env_state) <= env_state_limit_mb:
            np.savez(part / ENV_STATE, *(np.asarray(_raw(leaf)) for leaf in jax.tree.leaves(snapshot.env_state)))
        meta = dataclasses.replace(meta, sha256={p.name: _sha256(p) for p in sorted(part.iterdir())})
        (part / META).write_text(json.dumps(dataclasses.asdict(meta), indent=1))
        for path in part.iterdir():  # on disk before the checkpoint that it replaces is gone
            with open(path, "rb") as file:
                os.fsync(file.fileno())
    kept = list_checkpoints(root)
    best = best_checkpoint(kept)
    for old in kept[:-keep]:
        if old != best:  # at once: a reader sees all of it or nothing
            folder = root / f"{old.env_steps:012d}"
            shutil.rmtree(folder.rename(folder.with_name(f".{folder.name}.part-{os.getpid()}")))
    for old in kept[:-1]:
        (root / f"{old.env_steps:012d}" / ENV_STATE).unlink(missing_ok=True)
    return final


def list_checkpoints(root: Path) -> list[CheckpointMeta]:
    """Return all checkpoints with a readable `meta.json`, oldest first."""
    every = []
    for path in sorted(root.glob("[0-9]*")):
        with contextlib.suppress(CheckpointError):
            every.append(read_meta(path))
    return every


def verify(folder: Path) -> CheckpointMeta:
    """Return what a checkpoint is of; raise where a file is missing or differs from the digest in `meta.json`."""
    meta = read_meta(folder)
    for name, digest in meta.sha256.items():
        path = folder / check_name(name, f"{folder / META}: a file", CheckpointError)
        if name == ENV_STATE and not path.exists():
            continue  # kept for the newest checkpoint only
        if not path.is_file() or _sha256(path) != digest:
            raise CheckpointError(f"{path}: damaged: its SHA-256 is not that in {META}; remove this checkpoint")
    return meta


def best_checkpoint(checkpoints: list[CheckpointMeta]) -> CheckpointMeta | None:
    """Return the checkpoint with the highest score; of equals the newest, and None before any has a score."""
    scored = [c for c in checkpoints if c.score is not None]
    return max(scored, key=lambda c: (c.score, c.env_steps), default=None)


def find(root: Path, which: str) -> tuple[Path, CheckpointMeta]:
    """Return a checkpoint's folder by `best`, `last` or its env steps; without scores, `best` is the last.

    `best` and `last` skip damaged checkpoints with a warning; one named by its steps must be intact.
    """
    paths = [path for path in sorted(root.glob("[0-9]*")) if path.name.isdigit() and (path / META).exists()]
    if not paths:
        raise CheckpointError(f"{root}: holds no checkpoint; train the run first, until its first checkpoint")
    if which not in ("best", "last"):
        named = [path for path in paths if path.name.lstrip("0") == which.lstrip("0")]
        if not named:
            steps = ", ".join(path.name.lstrip("0") or "0" for path in paths)
            raise CheckpointError(f"{root}: no checkpoint {which!r}; expected best, last or one of {steps}")
        return named[0], verify(named[0])
    intact, faults = {}, []
    for path in reversed(paths):
        try:
            meta = verify(path)
            intact[meta.env_steps] = path, meta
        except CheckpointError as error:
            if (path / META).exists() or not intact:  # else the run that trains removed it meanwhile
                faults.append(error)
    if not intact:
        raise faults[0]
    metas = [meta for _, meta in reversed(intact.values())]
    chosen = (best_checkpoint(metas) if which == "best" else None) or metas[-1]
    for error in faults:
        warnings.warn(f"{error}; the checkpoint at {chosen.env_steps} steps is used", stacklevel=2)
    return intact[chosen.env_steps]


def set_aside(root: Path, after: int) -> list[Path]:
    """Rename the checkpoints beyond so many env steps to `aside-*`, where no command takes them for the run's."""
    later = [path for path in sorted(root.glob("[0-9]*")) if path.name.isdigit() and int(path.name) > after]
    with writing(root, GOES_ON):
        for path in later:
            target = root / f"aside-{path.name}"
            shutil.rmtree(target, ignore_errors=True)
            path.rename(target)
    return later


def read_meta(folder: Path) -> CheckpointMeta:
    reader = Reader(CheckpointError, "remove this checkpoint", finite=False)
    return reader.record(reader.json(folder / META), CheckpointMeta, str(folder / META))


def is_whole(folder: Path) -> bool:
    """Return whether a checkpoint holds all of the learner; one that was exported holds the policy alone."""
    return (folder / LEARNER).is_file() or not (folder / POLICY).is_file()


def policy_leaves(path: Path, learner: Mapping[str, Any], algorithm: str) -> dict[str, Any]:
    """Return the leaves of a learner that its policy reads, by names such as "params/policy/..."."""
    from train.learners.algorithms import ALGORITHMS  # takes seconds, and `--help` needs none

    try:
        return weights.flat(ALGORITHMS[algorithm].policy_part(learner))
    except (AttributeError, KeyError, TypeError):
        names = ", ".join(ALGORITHMS)
        raise CheckpointError(f"{path}: holds no policy of {algorithm!r}, expected one of {names}") from None


def keep_policy(folder: Path, target: Path, step: float = STEP) -> None:
    """Write what evaluating a checkpoint needs to another folder: `policy.safetensors` and `meta.json`."""
    meta = read_meta(folder)
    target.mkdir(parents=True)
    if is_whole(folder):
        learner = flax.serialization.msgpack_restore(regular(folder / LEARNER).read_bytes())
        leaves = policy_leaves(folder / LEARNER, learner, meta.algorithm)  # type: ignore[arg-type]
        about = {name: getattr(meta, name) for name in SHOWN}
        about["commit"] = RunFolder(folder.parents[1]).origin()["commit"]
        weights.write_weights(target / POLICY, weights.rounded(leaves, step), about)
    else:
        shutil.copy2(folder / POLICY, target)
    kept = dataclasses.replace(meta, sha256={POLICY: _sha256(target / POLICY)})
    write_text(target / META, json.dumps(dataclasses.asdict(kept), indent=1))


def weights_digest(folder: Path) -> str:
    """Return the SHA-256 of a checkpoint's weights."""
    return _sha256(folder / (LEARNER if is_whole(folder) else POLICY))


def load_learner(folder: Path, template: Any) -> Any:
    """Return a checkpoint's learner as arrays in the template's structure; of an exported one the policy counts."""
    path = folder / LEARNER
    if not is_whole(folder):
        path, again = folder / POLICY, "export the run again"
        tensors, _ = weights.read_weights(path, CheckpointError, again)
        state, algorithm = flax.serialization.to_state_dict(template), read_meta(folder).algorithm
        needed = functools.partial(policy_leaves, path, state, algorithm)
        learner = weights.fill(template, tensors, path, needed, CheckpointError, again)
    else:
        try:
            learner = flax.serialization.from_bytes(template, regular(path).read_bytes())
        except Exception as error:  # msgpack and flax raise many kinds for a damaged or foreign file
            raise CheckpointError(
                f"{path}: not a checkpoint of this learner ({' '.join(str(error).split())[:200]}); "
                "use the run's config, or another checkpoint"
            ) from None
    return weights.fitting(template, learner, path, CheckpointError)


def load_env_state(folder: Path, template: Any) -> Any | None:
    """Return the environments of a checkpoint in the template's structure; None if it has none that fit it."""
    path = folder / ENV_STATE
    if not path.is_file():
        return None
    leaves, structure = jax.tree.flatten(template)
    remedy = "remove it: the run goes on with new episodes"
    with read_npz(path, CheckpointError, remedy) as stored:
        arrays = [stored[f"arr_{i}"] for i in range(len(stored.files))]
    like = [_raw(leaf) for leaf in leaves]
    if [(a.shape, a.dtype) for a in arrays] != [(x.shape, x.dtype) for x in like]:
        return None
    restored = [
        jax.random.wrap_key_data(jnp.asarray(array)) if _is_key(leaf) else jnp.asarray(array)
        for array, leaf in zip(arrays, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, restored)


def check_fits(meta: CheckpointMeta, path: Path, config: EnvConfig, env: Any) -> None:
    """Raise `CheckpointError` where a checkpoint was trained on another robot or other observations."""
    facts = (
        ("robot", meta.robot, robot_name(config.robot)),
        ("observations", meta.observations, config.observations),
        ("observation size", meta.observation_size, plain_size(env.observation_size)),
        ("action size", meta.action_size, int(env.action_size)),
    )
    for name, got, expected in facts:
        if got != expected:
            raise CheckpointError(
                f"{path}: {name} of the checkpoint: {got!r}, of the environment: {expected!r}; "
                "choose a checkpoint of this robot and these observations, or the run's env settings"
            )


def plain_size(size: int | Mapping[str, tuple[int, ...]]) -> int | dict[str, list[int]]:
    """Return an observation's size as JSON holds it."""
    return {name: list(shape) for name, shape in size.items()} if isinstance(size, Mapping) else int(size)


def megabytes(tree: Any) -> float:
    return sum(_raw(x).nbytes for x in jax.tree.leaves(tree)) / 1e6


def remove_partial(root: Path) -> None:
    """Remove what a killed run left half written."""
    for left_over in root.glob(".[0-9]*"):
        remove_stale(root / left_over.name.split(".")[1])


def _sha256(path: Path) -> str:
    return hashlib.sha256(regular(path).read_bytes()).hexdigest()


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(jnp.asarray(leaf).dtype, jax.dtypes.prng_key)


def _raw(leaf: Any) -> jax.Array:
    return jax.random.key_data(leaf) if _is_key(leaf) else jnp.asarray(leaf)
