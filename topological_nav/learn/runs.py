"""A run folder's files: settings that a run is bound to, epochs with metrics, checkpoints to go on from."""

from __future__ import annotations

import contextlib
import hashlib
import json
import lzma
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np
import yaml

from interactive_nav_common.files import whole_file, write_text
from interactive_nav_common.locks import alone_in
from interactive_nav_common.metrics_file import read_metrics
from topological_nav.errors import RunError, readable
from topological_nav.learn.learning import Learner

CONFIG, METRICS, CHECKPOINT = "config.yaml", "metrics.jsonl", "checkpoint.msgpack"
WEIGHTS, DESCRIPTION, RESULTS = "weights.msgpack", "network.json", "results.json"
PACKED_WEIGHTS = f"{WEIGHTS}.xz"
"""Of an exported run."""
SAVE_EVERY_S = 60.0
"""Between two checkpoints; one is written at the end of a phase and on a stop as well."""


@contextlib.contextmanager
def claimed(out: Path, settings: dict[str, Any]) -> Iterator[None]:
    """A run folder for the block: of these settings (see `claim`), and of this process alone."""
    with alone_in(out):
        claim(out, settings)
        yield


def claim(out: Path, settings: dict[str, Any]) -> None:
    """Writes config.yaml of a new run, or checks that the run there has the same settings.

    Raises:
        RunError: it has others.
    """
    path = out / CONFIG
    if path.is_file():
        with readable(path, RunError, "choose another folder (-o) or delete it"):
            there = dict(yaml.safe_load(path.read_text()))
        for name, value in settings.items():
            if there.get(name) != value:
                shown = (there.get(name), value) if not isinstance(value, dict) else ("another", "this one")
                raise RunError(
                    f"{out}: the run there has {name} = {shown[0]!r}, this one {shown[1]!r}; "
                    "choose another folder (-o) or delete it"
                )
        return
    out.mkdir(parents=True, exist_ok=True)
    write_text(path, yaml.safe_dump(settings, sort_keys=False))


def run_epochs(
    phase: str,
    learner: Learner,
    epoch: Callable[[Learner, int], tuple[Learner, dict[str, jax.Array]]],
    epochs: range,
    out: Path,
    tell: Callable[[str], None],
    should_stop: Callable[[], bool],
) -> tuple[Learner, bool]:
    """Epochs of one phase; False where a stop was asked for before the last.

    Args:
        phase: its name in the metrics.
        learner: what it starts with.
        epoch: the learner and the epoch's number from 0 to the learner and means over the epoch, `loss` among them.
        epochs: numbers of those to run.
        out: the run folder.
        tell: told one line an epoch.
        should_stop: asked after every epoch.

    Raises:
        RunError: the loss is not finite.
    """
    began = saved_at = time.perf_counter()
    for number in epochs:
        started = time.perf_counter()
        learner, means = epoch(learner, number)
        line = {"phase": phase, "epoch": number + 1, **{k: float(v) for k, v in means.items()}}
        now = time.perf_counter()
        if not np.isfinite(line["loss"]):
            raise RunError(f"{out}: the loss of epoch {number + 1} is {line['loss']}; try a smaller learning_rate")
        with open(out / METRICS, "a") as file:
            file.write(json.dumps({**line, "seconds": round(now - started, 3)}) + "\n")
        left = (now - began) / (number + 1 - epochs.start) * (epochs.stop - number - 1)
        scores = "  ".join(f"{k} {line[k]:.3f}" for k in means)
        tell(f"{phase}: epoch {number + 1} of {epochs.stop}  {scores}  {now - started:.1f} s  {left:.0f} s left")
        last, stop = number + 1 == epochs.stop, should_stop()
        if last or stop or now - saved_at > SAVE_EVERY_S:
            state = {"phase": phase, "epoch": number + 1, "learner": flax.serialization.to_state_dict(learner)}
            with whole_file(out / CHECKPOINT) as partial:
                partial.write_bytes(flax.serialization.msgpack_serialize(jax.device_get(state)))
            saved_at = now
        if stop:
            return learner, False
    return learner, True


def packed(content: bytes) -> bytes:
    """A file of fp16 weights by LZMA, a seventh smaller: the two bytes a number are modelled apart."""
    return lzma.compress(content, filters=[{"id": lzma.FILTER_LZMA2, "preset": 9, "lc": 0, "lp": 1, "pb": 1}])


def weights_content(run: Path) -> bytes:
    """The msgpack of a run's weights, whether it was exported or not.

    Raises:
        OSError: there are none.
        lzma.LZMAError: they are damaged.
    """
    path = run / PACKED_WEIGHTS
    return lzma.decompress(path.read_bytes()) if path.is_file() else (run / WEIGHTS).read_bytes()


def read_description(run: Path, kind: str, task: str) -> dict[str, Any]:
    """The network.json of a finished run.

    Args:
        run: its folder.
        kind: what it should hold, network or policy, for messages.
        task: of the command that trains one.

    Raises:
        RunError: the run is not finished, or the file is damaged.
    """
    path = run / DESCRIPTION
    if not path.is_file():
        raise RunError(f"{run}: holds no trained {kind}; finish it: python -m topological_nav train {task} -o {run}")
    with readable(path, RunError, "train again"):
        about = json.loads(path.read_text())
        return {**about, "task": about["task"], "digest": about["digest"]}


def read_weights(run: Path, template: Any, about: dict[str, Any]) -> Any:
    """Variables of a finished run, in the template's precision.

    Args:
        run: its folder.
        template: tree of arrays or shapes.
        about: content of network.json.

    Raises:
        RunError: weights.msgpack is damaged, another network's, or not what an export wrote.
    """
    path = run / (PACKED_WEIGHTS if (run / PACKED_WEIGHTS).is_file() else WEIGHTS)
    with readable(path, RunError, "train again"):
        content = weights_content(run)
        zeros = jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), template)
        found = flax.serialization.from_bytes(zeros, content)
    own = about.get("export", {}).get("weights_digest")
    if own and hashlib.sha256(content).hexdigest() != own:
        raise RunError(f"{path}: is not the file that was exported with its {DESCRIPTION}; export the run again")
    return jax.tree.map(lambda s, x: jnp.asarray(x, s.dtype), template, found)


def read_checkpoint(path: Path) -> dict[str, Any] | None:
    """A checkpoint as plain mappings; None: there is none.

    Raises:
        RunError: it is damaged.
    """
    if not path.is_file():
        return None
    with readable(path, RunError, "delete it to begin again"):
        return flax.serialization.msgpack_restore(path.read_bytes())  # type: ignore[return-value]


def restored(template: Learner, state: Any, path: Path) -> Learner:
    """A learner as the checkpoint at a path holds it.

    Raises:
        RunError: it is another network's.
    """
    try:
        learner = flax.serialization.from_state_dict(template, state)
    except (ValueError, KeyError) as error:
        raise RunError(f"{path}: does not fit the network ({error}); delete it to begin again") from None
    return jax.tree.map(lambda t, x: jnp.asarray(x, jnp.asarray(t).dtype), template, learner)


def cut_metrics(out: Path, phases: Sequence[str], saved: dict[str, Any] | None) -> None:
    """Drops the lines after the checkpoint that a run goes on from: their epochs are run again."""
    path = out / METRICS
    if path.is_file():
        until = (phases.index(saved["phase"]), saved["epoch"]) if saved else (-1, 0)
        kept = [line for line in read_metrics(path) if (phases.index(line["phase"]), line["epoch"]) <= until]
        write_text(path, "".join(json.dumps(line) + "\n" for line in kept))
