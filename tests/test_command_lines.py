"""The help of every program, and the line that each mistake is answered with, are those of the snapshots.

`python -m tests.test_command_lines` writes the snapshots anew; look at what git says has changed.
"""

import contextlib
import importlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from docs.program_help import help_of

HELP, ERRORS = (Path(__file__).parent / "snapshots" / name for name in ("help.txt", "errors.txt"))
PROGRAMS = (
    "interactive_nav",
    *(f"interactive_nav.{name}" for name in ("view", "record", "episodes", "robots", "ros")),
    *("train", "train.sweep", "train.evaluate", "train.export", "train.figures", "train.figures.report"),
    *("train.record", "train.replay"),
    *("converters", "topological_nav", "topological_nav.ros", "benchmarks.steps_per_second"),
)
SCENE = "scenes_mjcf/apartment_0"


def shown(program: str) -> str:
    """Return the help of a program and of its commands, without the lists of settings and the number of cores."""
    kept = {
        words: re.split(r"^(settings|keys of the file)\b", text, flags=re.M)[0]
        for words, text in help_of(program).items()
    }
    text = "\n".join(f"$ {words} --help\n{text}" for words, text in kept.items())
    text = "".join(f"{line.rstrip()}\n" for line in text.splitlines() if line.strip(" -"))  # without frames
    return re.sub(r"(in parallel|of sources)\.([^()]*)\(default: \d+\)", r"\1.\2(default: cores)", text)


def answer(command: str) -> str:
    """Return the exit code and the last line that a command prints on stderr."""
    module, *words = shlex.split(command)
    package = not importlib.util.find_spec(module).loader.is_package(module)  # type: ignore[union-attr]
    main = importlib.import_module(module if package else f"{module}.__main__").main
    err = io.StringIO()
    with contextlib.redirect_stderr(err), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    return f"{code} {(err.getvalue().strip().splitlines() or [''])[-1]}"


def recorded(path: Path) -> dict[str, str]:
    """Return what a snapshot holds: command -> text."""
    parts = re.split(r"^\$ ", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return dict(part.split("\n", 1) for part in parts)


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_is_that_of_the_snapshot(program):
    text = shown(program)
    kept = recorded(HELP)
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        words, body = part.split("\n", 1)
        assert kept[words].rstrip() == body.rstrip(), words


@pytest.mark.parametrize(
    "program", ("train", "train.evaluate", "train.sweep", "train.figures", "train.figures.report", "converters")
)
def test_help_comes_without_what_takes_seconds_to_import(program):
    script = (
        f"import importlib.util, runpy, sys; sys.argv = [{program!r}, '--help']\n"
        f"try: runpy.run_module({program!r}, run_name='__main__', alter_sys=True)\n"
        "except SystemExit as end: assert not end.code\n"
        "print('slow:', sorted({'jax', 'mujoco', 'brax', 'flax', 'matplotlib', 'scipy'} & set(sys.modules)))"
    )
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert printed.startswith("usage: ") and printed.endswith("slow: []\n")


@pytest.mark.parametrize("command", recorded(ERRORS) if ERRORS.is_file() else [])
def test_each_mistake_is_answered_as_in_the_snapshot(command):
    assert answer(command).rstrip() == recorded(ERRORS)[command].rstrip()


if __name__ == "__main__":
    HELP.write_text("\n".join(shown(program) for program in PROGRAMS), encoding="utf-8")
    commands = recorded(ERRORS)
    ERRORS.write_text("".join(f"$ {command}\n{answer(command)}\n" for command in commands), encoding="utf-8")
