"""Write and read a run folder's files: settings, epochs with metrics, checkpoints to go on from."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import flax.serialization
import jax
import numpy as np
import yaml

from interactive_nav_common.errors import readable
from interactive_nav_common.files import append_text, whole_file, write_text
from interactive_nav_common.locks import alone_in
from interactive_nav_common.records import METRICS, Reader, cut_metrics
from interactive_nav_common.runs import weights
from interactive_nav_common.untrusted.reading import Loader
from interactive_nav_common.versions import versions
from topological_nav.errors import Host, RunError, Stopped

CONFIG, CHECKPOINT = "config.yaml", "checkpoint.msgpack"
WEIGHTS, DESCRIPTION, RESULTS, VERSIONS = "weights.safetensors", "network.json", "results.json", "versions.json"
PACKED_WEIGHTS = f"{WEIGHTS}.xz"
"""Of an exported run."""
State = TypeVar("State")
"""What an epoch changes: a tree of arrays, such as `learning.Learner`."""
SAVE_EVERY_S = 60.0
"""Between two checkpoints; one is written at the end of a phase and on a stop as well."""


@contextlib.contextmanager
def claimed(out: Path, settings: dict[str, Any]) -> Iterator[None]:
    """Reserve a run folder for the block, for these settings, written to config.yaml, and for this process alone."""
    path, remedy = out / CONFIG, "choose another folder (-o) or delete it"
    with alone_in(out):
        there = settings
        if path.is_file():
            with readable(path, RunError, remedy):
                there = dict(yaml.load(path.read_text(), Loader))
        for name, value in settings.items():
            if there.get(name) != value:
                shown = ("another", "this one") if isinstance(value, dict) else (there.get(name), value)
                raise RunError(f"{out}: the run there has {name} = {shown[0]!r}, this one {shown[1]!r}; {remedy}")
        if there is settings:
            write_text(path, yaml.safe_dump(settings, sort_keys=False))
        write_text(out / VERSIONS, json.dumps(versions(), indent=1) + "\n")
        yield


def run_epochs(
    out: Path,
    phase: str,
    learner: State,
    epoch: Callable[[State, int, jax.Array], tuple[State, dict[str, jax.Array]]],
    epochs: int,
    key: jax.Array,
    host: Host,
    checkpoint: str = CHECKPOINT,
) -> State:
    """Run the epochs of one phase of a run, without those that the checkpoint holds, and return the learner.

    `epoch` takes the learner, the epoch's number from 0 and its key to the learner and means over the epoch, `loss`
    among them.
    """
    saved, first = read_checkpoint(out / checkpoint), 0
    if saved and saved.get("phase", phase) == phase:
        first, learner = saved["epoch"], _restored(learner, saved["learner"], out / checkpoint)
    # Epochs after the last one that the checkpoint holds are run again.
    cut_metrics(out / METRICS, lambda line: line["phase"] != phase or line["epoch"] <= first)
    began = saved_at = time.perf_counter()
    for number in range(first, epochs):
        started = time.perf_counter()
        learner, means = epoch(learner, number, jax.random.fold_in(key, number))
        line = {"phase": phase, "epoch": number + 1, **{k: float(v) for k, v in means.items()}}
        now = time.perf_counter()
        if not np.isfinite(line["loss"]):
            raise RunError(f"{out}: the loss of epoch {number + 1} is {line['loss']}; try a smaller learning_rate")
        append_text(out / METRICS, json.dumps({**line, "seconds": round(now - started, 3)}) + "\n")
        left = (now - began) / (number + 1 - first) * (epochs - number - 1)
        scores = "  ".join(f"{k} {line[k]:.3f}" for k in means)
        host.show(f"{phase}: epoch {number + 1} of {epochs}  {scores}  {now - started:.1f} s  {left:.0f} s left")
        stop = host.signal()
        if number + 1 == epochs or stop or now - saved_at > SAVE_EVERY_S:
            state = {"phase": phase, "epoch": number + 1, "learner": flax.serialization.to_state_dict(learner)}
            with whole_file(out / checkpoint) as partial:
                partial.write_bytes(flax.serialization.msgpack_serialize(jax.device_get(state)))
            saved_at = now
        if stop:
            raise Stopped(stop)
    return learner


def write_network(out: Path, tensors: Any, about: dict[str, Any], precision: str = "") -> None:
    """Write weights and their description, which gains their digest; with a precision those of an export, packed."""
    header = {name: about[name] for name in ("task", "parameters", "commit") if name in about}
    path = out / (PACKED_WEIGHTS if precision else WEIGHTS)
    digest = weights.write_weights(path, weights.flat(jax.device_get(tensors)), header)["digest"]
    about |= {"export": {"precision": precision, "weights_digest": digest}} if precision else {"digest": digest}
    write_text(out / DESCRIPTION, json.dumps({k: v for k, v in about.items() if k != "commit"}, indent=1) + "\n")


def write_results(out: Path, results: dict[str, Any]) -> dict[str, Any]:
    """Write results.json; return its content."""
    write_text(out / RESULTS, json.dumps(results, indent=1) + "\n")
    return results


def weights_file(run: Path) -> Path:
    """Return where the weights of a run are, whether it was exported or not."""
    packed = run / PACKED_WEIGHTS
    return packed if packed.is_file() else run / WEIGHTS


@dataclasses.dataclass(frozen=True)
class _Description:
    """Hold the fields that every network.json needs."""

    task: str
    digest: str
    export: dict[str, str] = dataclasses.field(default_factory=dict)


def read_description(run: Path, kind: str, task: str) -> dict[str, Any]:
    """Return the network.json of a finished run."""
    path = run / DESCRIPTION
    if not path.is_file():
        raise RunError(f"{run}: holds no trained {kind}; finish it: python -m topological_nav train {task} -o {run}")
    reader = Reader(RunError, "train again", finite=False)
    about = reader.json(path)
    reader.record(about, _Description, str(path), others=True)
    return about


def read_weights(run: Path, template: Any, about: dict[str, Any]) -> Any:
    """Return the variables of a finished run, in the template's precision."""
    path, again = weights_file(run), "train again"
    tensors, header = weights.read_weights(path, RunError, again)
    if about.get("export", {}).get("weights_digest", header["digest"]) != header["digest"]:
        raise RunError(f"{path}: is not the file that was exported with its {DESCRIPTION}; export the run again")
    variables = weights.fill(template, tensors, path, lambda: weights.flat(template), RunError, again)
    return weights.fitting(template, variables, path, RunError)


def read_checkpoint(path: Path) -> dict[str, Any] | None:
    """Return a checkpoint as plain mappings, or None where there is none."""
    if not path.is_file():
        return None
    with readable(path, RunError, "delete it to start again"):
        return flax.serialization.msgpack_restore(path.read_bytes())  # type: ignore[return-value]


def _restored(template: State, state: Any, path: Path) -> State:
    """Return a learner as the checkpoint at a path holds it."""
    try:
        learner = flax.serialization.from_state_dict(template, state)
    except (ValueError, KeyError) as error:
        raise RunError(f"{path}: does not fit the network ({error}); delete it to start again") from None
    return weights.fitting(template, learner, path, RunError)
