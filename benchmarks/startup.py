"""Measure how long programs take to print their help, and packages to be imported: rows of the best of `--repeats`."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.steps_per_second import RESULTS, append_row, origin
from interactive_nav_common.commands import Command, parse
from interactive_nav_common.config import AtLeastOne
from interactive_nav_common.errors import reports_errors

PROGRAMS = ("interactive_nav", "train", "train.evaluate", "train.sweep", "converters", "topological_nav")
PACKAGES = ("interactive_nav", "converters", "train.config_io", "topological_nav.config")


class Startup(Command):
    """Measure how long programs take to print their help, and how long packages take to import."""

    repeats: AtLeastOne = 5
    """Number of measurements of each, of which the fastest counts."""
    out: Path = RESULTS / "startup.jsonl"
    """File to append rows to."""


@reports_errors("benchmarks.startup")
def main(argv: Sequence[str] | None = None) -> int:
    """Measure and append a row each."""
    arguments = parse(Startup, "python -m benchmarks.startup", argv)
    calls = {f"{name} --help": ["-m", name, "--help"] for name in PROGRAMS}
    calls |= {f"import {name}": ["-c", f"import {name}"] for name in PACKAGES}
    for what, words in calls.items():
        seconds = []
        for _ in range(arguments.repeats):
            began = time.perf_counter()
            subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
            seconds.append(time.perf_counter() - began)
        append_row(arguments.out, {"what": what, "seconds": round(min(seconds), 3), **origin(packages=())}, ("device",))
    return 0


if __name__ == "__main__":
    sys.exit(main())
