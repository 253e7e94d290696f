"""Parse command lines into dataclasses: the docstrings of the fields are the help, `key=value` words are settings."""

import dataclasses
import functools
import importlib.metadata
import inspect
import operator
import os
import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeAlias, dataclass_transform, get_args, get_type_hints

import tyro
from tyro import _errors as events  # the only way to tyro's mistakes as data; the lock file pins its version
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from interactive_nav_common.config import check, field_docs, nearest, refuse_unused
from interactive_nav_common.errors import ConfigError

PROJECT = "interactive-nav"
TYPED: dict[str, str] = {}
"""`python -m MODULE` -> what was typed instead of it; filled by programs that run others."""
Flag = Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")]
"""False unless its option is given."""
Repeated: TypeAlias = UseAppendAction[tuple[str, ...]]
"""One value each time that its option is given."""


def option(*aliases: str, name: str | None = None, metavar: str | None = None) -> Any:
    """Return the annotation of a field with other names (`-o`) or a placeholder; the help omits empty defaults."""
    return arg(
        name=name,
        aliases=aliases or None,
        metavar=metavar,
        help_behavior_hint=lambda default: "" if default in ("None", "") else f"(default: {default})",
    )


def word(metavar: str) -> tuple[Any, Any]:
    """Return the annotations of a positional field."""
    return Positional, option(metavar=metavar)


Words = Annotated[tuple[str, ...], tyro.conf.Suppress]
"""`key=value` words, which may stand anywhere among the others."""


@dataclass_transform(kw_only_default=True)
class Command:
    """Base of commands, which become dataclasses; a field `settings` of type `Words` collects `key=value` words."""

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(kw_only=True)(cls)

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self), include_extras=True)
        names = {f.name: _option(f.name, hints[f.name]) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        check({name: getattr(self, key) for key, name in names.items()}, {names[key]: hints[key] for key in names})

    @classmethod
    def epilog(cls) -> str:
        """Return text for the end of the help."""
        return ""


class OnCluster(Command):
    """Base of the commands that can run on a cluster."""

    launcher: Literal["local", "ray"] = "local"
    """Where to run: `local` is this machine, `ray` is a Ray cluster."""
    ray_address: Annotated[str | None, option(metavar="HOST:PORT")] = None
    """Address of the Ray cluster's head node, with --launcher ray (default: auto)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.launcher != "ray":
            refuse_unused(self, "--ray-address", "without --launcher ray")


@functools.cache
def version() -> str:
    """Return the name and version of the installed package, or of the checkout."""
    try:
        return f"{PROJECT} {importlib.metadata.version(PROJECT)}"
    except importlib.metadata.PackageNotFoundError:
        text = Path(__file__).parents[1].joinpath("pyproject.toml").read_text(encoding="utf-8")
        return f"{PROJECT} {tomllib.loads(text)['project']['version']}"


def parse(command: Any, prog: str, argv: Sequence[str] | None = None) -> Any:
    """Return the command line as an instance of `command`, or of the one that it names where `command` maps names.

    A word that cannot be used raises `ConfigError` with one line; help and version raise `SystemExit`.
    """
    words, prog = list(sys.argv[1:] if argv is None else argv), TYPED.get(prog, prog)
    if words[:1] == ["--version"]:
        print(version())
        raise SystemExit(0)
    while isinstance(command, Mapping) and words and not words[0].startswith("-"):
        if words[0] not in command:
            near = nearest(words[0], list(command))
            raise ConfigError(f"no command {words[0]!r}{near}; expected one of {', '.join(command)}")
        command, prog, words = command[words[0]], f"{prog} {words[0]}", words[1:]
    if isinstance(command, Mapping) and words[:1] != ["--tyro-print-completion"]:
        if words[:1] not in (["-h"], ["--help"]):
            raise ConfigError(f"expected a command: {', '.join(command)} (--help describes them)")
        print(listing(prog, {name: _summary(kind) for name, kind in command.items()}))
        raise SystemExit(0)
    kind: Any = _union(command) if isinstance(command, Mapping) else command
    hints = {} if kind is not command else get_type_hints(kind, include_extras=True)
    settings, others = _split(hints, words) if "settings" in hints else ([], words)
    about = f"\n\nKEY=VALUE  {field_docs(kind)['settings']}" if "settings" in hints else ""
    try:
        with events.on_parse_error(functools.partial(_refuse, hints)):
            parsed, rest = tyro.cli(
                kind, prog=prog, args=others, description=f"{inspect.getdoc(kind)}{about}",
                config=(tyro.conf.DisallowNone,), return_unknown_args=True,
            )  # fmt: skip
    except SystemExit:
        if {"-h", "--help"} & {*words} and (more := kind.epilog()):
            print(more)
        raise
    changes: dict[str, Any] = {"settings": tuple(settings)} if settings else {}
    if rest:  # words of a list of places that stand behind options
        name = next((name for name, hint in hints.items() if Positional in getattr(hint, "__metadata__", ())), None)
        items: Any = get_args(get_args(hints[name])[0]) if name else ()
        if name is None or items[1:] != (...,) or any(word.startswith("-") for word in rest):
            _refuse(hints, events.UnrecognizedArgs(prog, rest))
        changes[name] = (*getattr(parsed, name), *map(items[0], rest))
    parsed = dataclasses.replace(parsed, **changes) if changes else parsed
    for field in dataclasses.fields(parsed):
        if field.default is dataclasses.MISSING and getattr(parsed, field.name) == ():
            raise ConfigError(f"missing {_option(field.name, hints[field.name])} (--help lists all)")
    return parsed


def listing(prog: str, commands: Mapping[str, str]) -> str:
    """Return the help of a program that has commands; `commands` maps a name to what it does."""
    rows = "\n".join(f"  {name:<16}{about}" for name, about in commands.items())
    return f"usage: {prog} COMMAND ...   (COMMAND --help describes one; --version)\n\n{rows}"


def _summary(command: Any) -> str:
    words = f"Commands: {', '.join(command)}." if isinstance(command, Mapping) else str(inspect.getdoc(command))
    return " ".join(words.split())


def _union(commands: Any) -> Any:
    """Return the type that tyro shows, and completes, as subcommands."""
    kinds = [
        Annotated[_union(kind), tyro.conf.subcommand(name, description=", ".join(kind))]
        if isinstance(kind, Mapping)
        else Annotated[kind, tyro.conf.subcommand(name)]
        for name, kind in commands.items()
    ]
    return functools.reduce(operator.or_, kinds)


def _split(hints: Mapping[str, Any], words: list[str]) -> tuple[list[str], list[str]]:
    """Return `key=value` words and all others; values of options are no settings."""
    flags = {
        f"--{no}{name.replace('_', '-')}"
        for name, hint in hints.items()
        if hint == Flag or hint is bool
        for no in ("", "no-")
    }
    settings, others, before = [], [], ""
    for word in words:
        is_value = re.match("--?[a-z]", before) and "=" not in before and before not in flags
        is_setting = not is_value and re.match(r"[A-Za-z_][\w.]*=", word) and not os.path.exists(word)
        (settings if is_setting else others).append(word)
        before = word
    return settings, others


def _refuse(hints: Mapping[str, Any], event: events.ParseErrorEvent) -> NoReturn:
    """Raise what tyro would print in a box as one line."""
    if isinstance(event, events.UnrecognizedArgs):
        options = [_option(*item) for item in hints.items()]
        near = nearest(event.tokens[0].partition("=")[0], options) if event.tokens[0].startswith("--") else ""
        problem = f"unrecognized {' '.join(event.tokens)}{near}"
    elif isinstance(event, events.MissingArgs):
        problem = f"missing {', '.join(_name(each.arg) for each in event.missing_arguments)}"
    elif isinstance(event, events.InvalidChoice):
        declared = str(event.argument.field.type_stripped)  # tyro keeps those of `Literal[...] | None` in a set
        choices = ", ".join(sorted({*event.choices} - {"None"}, key=lambda choice: declared.find(f"'{choice}'")))
        near = nearest(event.value, event.choices)
        problem = f"{_name(event.argument)} is {event.value!r}, expected one of {choices}{near}"
    elif isinstance(event, events.InstantiationFailure) and event.argument:
        got = (re.findall(r"'([^']*)'", event.message) or ["?"])[-1]
        kind, named = str(event.argument.field.type_stripped), {"int": "whole number", "float": "number"}
        expected = next((text for name, text in named.items() if name in kind), "other value")
        expected = f"{expected}s" if "tuple" in kind else f"a {expected}"
        problem = f"{_name(event.argument)} is {got!r}, expected {expected}"
    elif isinstance(event, events.BadValue):
        problem = f"{_name(event.argument)} lacks a value, expected {event.argument.lowered.metavar}"
    else:
        problem = " ".join(" ".join(map(str, events._render(event)[1])).split())
    raise ConfigError(f"{problem} (--help lists all)")


def _option(name: str, hint: Any) -> str:
    """Return the option of a field, or the placeholder of a positional one."""
    about = [each for each in getattr(hint, "__metadata__", ()) if hasattr(each, "metavar")]
    if Positional in getattr(hint, "__metadata__", ()):
        return about[0].metavar
    return f"--{(about and about[0].name or name).replace('_', '-')}"


def _name(argument: Any) -> str:
    """Return an option's longest name, or the placeholder of a positional word."""
    return argument.lowered.metavar if argument.is_positional() else max(argument.lowered.name_or_flags, key=len)
