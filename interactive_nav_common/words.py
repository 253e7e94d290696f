"""Build argparse parsers from YAML command tables.

A command has its `help` and its `words`: `name` or `-o, --out` -> what `add_argument` takes, `type` by its name in
`KINDS`. `{name}` stands for a value that only code knows.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import itertools
import os
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn, TypeAlias

from interactive_nav_common.config import nearest
from interactive_nav_common.errors import UserError
from interactive_nav_common.records import read_packaged

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"

PROJECT = "interactive-nav"


def positive(text: str) -> int:
    """Return a whole number above 0."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not a positive number")
    return value


def positive_number(text: str) -> float:
    """Return a number above 0."""
    value = float(text)
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


KINDS: dict[str, Callable[[str], Any]] = {
    **{"path": Path, "int": int, "float": float},
    **{"positive": positive, "positive_number": positive_number},
}
"""Name of a `type` -> what makes a value of a word's text."""
ACTIONS = {"yes_or_no": argparse.BooleanOptionalAction}
"""Name of an `action` -> it, where argparse has no name for it."""


@dataclasses.dataclass(frozen=True)
class Command:
    """A row of a table."""

    help: str = ""
    """What it does."""
    words: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    usage: str | None = None
    writes: tuple[str, ...] = ()
    """Patterns of the files that it may write; {} is where it writes."""
    actions: dict[str, Command] = dataclasses.field(default_factory=dict)
    """Its subcommands."""


def read_commands(path: Path) -> dict[str, Command]:
    """Return the table of a file that comes with the package."""
    return read_packaged(path, dict[str, Command])


def add_words(to: argparse._ActionsContainer, words: Mapping[str, Mapping[str, Any]], **values: Any) -> None:
    """Add words to a parser or to a group of one.

    Args:
        to: takes them.
        words: of a `Command`.
        **values: what `{name}` stands for; a value that is nothing but `{name}` becomes it, of whatever type.
    """

    def filled(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        return values[value[1:-1]] if value[1:-1] in values and value[0] == "{" else value.format(**values)

    for names, row in words.items():
        about = {key: filled(value) for key, value in row.items()}
        about |= {"metavar": tuple(row["metavar"])} if isinstance(row.get("metavar"), list) else {}
        about |= {"type": KINDS[about["type"]]} if "type" in about else {}
        about |= {"action": ACTIONS.get(about["action"], about["action"])} if "action" in about else {}
        to.add_argument(*names.split(", "), **about)


TYPED: dict[str, str] = {}
"""`python -m MODULE` -> what was typed instead of it; filled by programs that run others."""


@functools.cache
def version() -> str:
    """Return the name and version of the installed package, or of the checkout."""
    try:
        return f"{PROJECT} {importlib.metadata.version(PROJECT)}"
    except importlib.metadata.PackageNotFoundError:
        text = Path(__file__).parents[1].joinpath("pyproject.toml").read_text(encoding="utf-8")
        return f"{PROJECT} {tomllib.loads(text)['project']['version']}"


class Parser(argparse.ArgumentParser):
    """Show what was typed, and the version; say which option (also of its commands) a wrong one looks like."""

    def __init__(self, *arguments: Any, **about: Any) -> None:
        super().__init__(*arguments, **about)
        self.prog = TYPED.get(self.prog, self.prog)
        self.add_argument("--version", action="version", version=version(), help="print the version and exit")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does; a setting behind `--scenes A` (env.x=1) is a setting, not one more scene."""
        words = list(sys.argv[1:] if args is None else args)
        if "--scenes" in words and any(a.dest in ("words", "overrides") for a in self._actions):
            at = words.index("--scenes")
            scenes = list(itertools.takewhile(lambda word: not word.startswith("-"), words[at + 1 :]))
            settings = [word for word in scenes if "=" in word and not Path(word).exists()]
            rest = [word for word in scenes if word not in settings]
            words = [*words[:at], *settings, "--scenes", *rest, *words[at + 1 + len(scenes) :]]
        return super().parse_known_args(words, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the usage and the message; exit with code 2."""
        wrong = [word for word in message.split() if word.startswith("--")]
        about = nearest(wrong[0].split("=")[0], list(_options(self))) if wrong and "unrecognized" in message else ""
        super().error(message + about)


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        yield from action.option_strings
        for command in action.choices.values() if isinstance(action, argparse._SubParsersAction) else ():
            yield from _options(command)


def program(table: Path, name: str, epilog: str | None = None, **values: Any) -> argparse.ArgumentParser:
    """Return the parser of `python -m PACKAGE.name`, where PACKAGE is the table's folder.

    Args:
        table: file of `read_commands`; its row `name` is taken.
        name: of the program.
        epilog: printed as it is.
        **values: as of `add_words`.
    """
    row, how = read_commands(table)[name], argparse.RawDescriptionHelpFormatter
    prog = f"python -m {table.parent.name}.{name}"
    parser = Parser(prog=prog, description=row.help, epilog=epilog, formatter_class=how)
    add_words(parser, row.words, **values)
    return parser


def first_line(error: BaseException) -> str:
    """Return an exception's type and the first line of its message."""
    return f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"


def import_function(place: str, word: str, expected: str, kind: type[UserError]) -> Callable[..., Any]:
    """Return the function at `module:name` or `path/to/file.py:name`; modules of the current folder count."""
    module, _, name = place.rpartition(":")
    is_file = module.endswith(".py")
    folder = str(Path(module).resolve().parent) if is_file else os.getcwd()
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        loaded = _import_file(Path(module)) if is_file else importlib.import_module(module)
    except (Exception, SystemExit) as error:
        raise kind(f"{word}: cannot import {module} ({first_line(error)}); {expected}") from error
    function = getattr(loaded, name, None)
    if not callable(function):
        names = [n for n, v in vars(loaded).items() if callable(v) and getattr(v, "__module__", "") == loaded.__name__]
        has = hasattr(loaded, name)
        got = f"{name!r} of type {type(function).__name__}" if has else f"no {name!r}{nearest(name, names)}"
        raise kind(f"{word}: {module} has {got}; expected one of its functions: {', '.join(names) or 'it has none'}")
    return function


def _import_file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"file_{path.stem}", path)
    assert spec and spec.loader
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
