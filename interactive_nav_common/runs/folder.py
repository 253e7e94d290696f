"""Keep a run's folder: its settings, versions and metrics, and epochs that go on from a checkpoint."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import yaml

from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.files import alone_in, append_text, write_json, write_text, writing
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.records import METRICS, cut_metrics
from interactive_nav_common.signals import stop_signals
from interactive_nav_common.untrusted.reading import Loader
from interactive_nav_common.versions import versions

if TYPE_CHECKING:  # programs that only look at run folders start without JAX
    import jax

CONFIG, CHECKPOINT, VERSIONS = "config.yaml", "checkpoint.msgpack", "versions.json"
GOES_ON = "make room and start again: the run continues from its last checkpoint"
SAVE_EVERY_S = 60.0
"""Between two checkpoints of epochs; one is written at the end of a phase and on a stop as well."""
State = TypeVar("State")
"""What training changes: a tree of arrays."""


def refuse_changes(
    out: Path, there: Mapping[str, Any], settings: Mapping[str, Any], remedy: str, what: str = "run"
) -> None:
    """Refuse settings other than those of the run, or what it is, that a folder holds."""
    for name, value in settings.items():
        if there.get(name) != value:
            shown = ("another", "this one") if isinstance(value, dict) else (there.get(name), value)
            raise FileError(f"{out}: the {what} there has {name} = {shown[0]!r}, this one {shown[1]!r}; {remedy}")


@contextlib.contextmanager
def claimed(out: Path, settings: dict[str, Any]) -> Iterator[None]:
    """Reserve a run folder for the block, for these settings, written to config.yaml, and for this process alone."""
    path, remedy = out / CONFIG, "choose another folder (-o) or delete it"
    with alone_in(out):
        if path.is_file():
            with readable(path, FileError, remedy):
                there = dict(yaml.load(path.read_text(), Loader))
            refuse_changes(out, there, settings, remedy)
        else:
            write_text(path, yaml.safe_dump(settings, sort_keys=False))
        write_json(out / VERSIONS, versions())
        yield


def append_metrics(out: Path, line: Mapping[str, Any]) -> None:
    """Add one line to a run's metrics.jsonl."""
    with writing(out / METRICS, GOES_ON):
        append_text(out / METRICS, json.dumps(line) + "\n")


def run_epochs(
    out: Path,
    phase: str,
    state: State,
    epoch: "Callable[[State, int, jax.Array], tuple[State, dict[str, jax.Array]]]",
    epochs: int,
    key: "jax.Array",
    checkpoint: str = CHECKPOINT,
) -> State:
    """Run and print the epochs of one phase of a run that the checkpoint does not hold, and return the state.

    `epoch` takes the state, the epoch's number from 0 and its key to the state and means over the epoch, `loss` among
    them. At a signal, the epoch ends and is saved before `Stopped` is raised.
    """
    import jax

    from interactive_nav_common.runs.weights import read_state, restored, write_state

    saved, first = read_state(out / checkpoint), 0
    if saved and saved.get("phase", phase) == phase:
        first, state = saved["epoch"], restored(state, saved["learner"], out / checkpoint)
    # Epochs after the last one that the checkpoint holds are run again.
    cut_metrics(out / METRICS, lambda line: line["phase"] != phase or line["epoch"] <= first)
    began = saved_at = time.perf_counter()
    with stop_signals() as stops:
        for number in range(first, epochs):
            started = time.perf_counter()
            state, means = epoch(state, number, jax.random.fold_in(key, number))
            line = {"phase": phase, "epoch": number + 1, **{k: float(v) for k, v in means.items()}}
            now = time.perf_counter()
            if not np.isfinite(line["loss"]):
                raise FileError(f"{out}: the loss of epoch {number + 1} is {line['loss']}; try a smaller learning_rate")
            append_metrics(out, {**line, "seconds": round(now - started, 3)})
            left = (now - began) / (number + 1 - first) * (epochs - number - 1)
            scores = "  ".join(f"{k} {line[k]:.3f}" for k in means)
            spent = f"{now - started:.1f} s  {left:.0f} s left"
            print(f"{phase}: epoch {number + 1} of {epochs}  {scores}  {spent}", flush=True)
            stop = bool(stops)
            if number + 1 == epochs or stop or now - saved_at > SAVE_EVERY_S:
                write_state(out / checkpoint, {"phase": phase, "epoch": number + 1, "learner": state})
                saved_at = now
            if stop:
                raise Stopped(stops[0])
    return state
