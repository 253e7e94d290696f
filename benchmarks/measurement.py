"""What the benchmarks share: their command lines, rows that say where they come from, random driving, timing."""

import argparse
import datetime
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from interactive_nav_common.versions import commit, package_versions
from interactive_nav_common.words import Parser, add_words, read_commands

RESULTS = Path("benchmarks/results")
SCENE = "scenes_mjcf/apartment_0"
TABLE = read_commands(Path(__file__).with_name("words.yaml"))
"""Words of the command lines."""
PACKAGES = ("mujoco", "mujoco-mjx", "warp-lang", "jax", "brax")


def command_line(description: str | None, rows: str = "", settings: bool = False) -> argparse.ArgumentParser:
    """The words that benchmarks share: of one that writes `rows`, a file in `RESULTS`, if not empty.

    With `settings` it makes an environment, by `--set key=value`.
    """
    made = Parser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if settings:
        add_words(made, TABLE["settings"].words)
        made.add_argument(
            "--set",
            dest="settings",
            type=lambda word: (word.partition("=")[0], json.loads(word.partition("=")[2])),
            nargs="*",
            default=[],
            metavar="key=value",
            help="environment settings",
        )
    if rows:
        add_words(made, TABLE["rows"].words, rows=RESULTS / f"{rows}.jsonl")
    return made


def origin(commit_told: str | None = None, packages: Sequence[str] = PACKAGES) -> dict[str, Any]:
    """The columns of a row that say where it comes from: device, versions, commit and date."""
    device, found = jax.devices()[0], commit() or "unknown"
    return {
        "device": device.device_kind if device.platform != "cpu" else f"cpu, {os.cpu_count()} cores",
        "versions": package_versions(packages),
        "commit": commit_told or (found[:7] + ("+dirty" if found.endswith("+dirty") else "")),
        "date": datetime.date.today().isoformat(),
    }


def append_row(path: Path, row: dict[str, Any], hidden: Sequence[str] | None = ()) -> None:
    """Adds a row to a file of JSON lines, and prints it without the hidden columns (None: all)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a", encoding="utf-8") as out:
        out.write(json.dumps(row) + "\n")
    if hidden is not None:
        print(json.dumps({name: value for name, value in row.items() if name not in hidden}), flush=True)


def timed(call: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """What a call gives, once it is there, and the seconds until then."""
    began = time.perf_counter()
    out = jax.block_until_ready(call(*arguments))
    return out, time.perf_counter() - began


def random_driving(
    step: Callable[[Any, jax.Array], tuple[Any, Any]],
    shape: tuple[int, int],
    steps: int,
    low: float = -1.0,
    high: float = 1.0,
) -> Callable[[Any, jax.Array], tuple[Any, Any]]:
    """State and key to the state after `steps` steps of uniform actions, and what each step counted, stacked.

    `shape` is environments and numbers in an action, which lie between `low` and `high`.
    """

    def one(state: Any, key: jax.Array) -> tuple[Any, Any]:
        return step(state, jax.random.uniform(key, shape, minval=low, maxval=high))

    return lambda state, key: jax.lax.scan(one, state, jax.random.split(key, steps))
