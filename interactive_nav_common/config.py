"""`key=value` words and plain mappings -> a frozen dataclass of settings; every mistake named in one line."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import difflib
import functools
import inspect
import math
import textwrap
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

import yaml

from interactive_nav_common.errors import ConfigError

Config = TypeVar("Config")


AUTO = "auto"  # how None ("chosen for you") is written in files and on the command line


Seed = Annotated[int, (0, 2**32 - 1)]
Count = Annotated[int, (1, 10**6)]
Share = Annotated[float, (0.0, 1.0)]


class Settings:
    """Base of a frozen dataclass that refuses numbers out of their bounds, as in `p: Annotated[float, (0.0, 1.0)]`."""

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            value = getattr(self, name)
            for low, high in getattr(hint, "__metadata__", ()) if value is not None else ():  # None: still to be chosen
                if not low <= value <= high:
                    raise ConfigError(f"{name} is {value!r}, expected between {low:g} and {high:g}")


@functools.cache
def _hints(config_type: type) -> dict[str, Any]:
    return typing.get_type_hints(config_type, include_extras=True)


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain values as YAML holds them: lists for tuples, `auto` for None."""
    plain: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            value = to_dict(value)
        elif isinstance(value, tuple):
            value = list(value)
        plain[field.name] = AUTO if value is None else value
    return plain


def read_words(words: Sequence[str], example: str = "ppo.learning_rate=1e-4") -> dict[str, Any]:
    """`dotted.name=value` words as a nested mapping; values are read as YAML.

    All words at once, so that two values that only fit together may both change.

    Raises:
        ConfigError: a word without `=`, or a section that was given a value.
    """
    nested: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or not name:
            raise ConfigError(f"override {word!r}: expected key=value, for example {example}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = text
        *sections, last = name.split(".")
        place = nested
        for section in sections:
            inner = place.setdefault(section, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"override {word!r}: {section} was given a value by an earlier override")
            place = inner
        place[last] = value
    return nested


@functools.cache
def field_docs(config_type: type) -> dict[str, str]:
    """Field name -> the docstring written under it, of the class and the classes it extends."""
    docs: dict[str, str] = {}
    for cls in reversed(config_type.__mro__[:-1]):
        (class_node,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        assert isinstance(class_node, ast.ClassDef)
        for field, after in zip(class_node.body, class_node.body[1:], strict=False):
            doc = after.value if isinstance(after, ast.Expr) else None
            if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Constant):
                docs[ast.unparse(field.target)] = " ".join(str(doc.value).split())
    return docs


def overlay(base: Config, plain: Any, where: str, prefix: str = "", known: Sequence[str] = ()) -> Config:
    """A dataclass of settings with nested plain values laid over it, here and in other programs.

    Args:
        base: what `plain` does not name.
        plain: nested mapping as read from YAML.
        where: file or word the values come from, for messages.
        prefix: dotted name of `base` inside the whole, with its dot.
        known: dotted names elsewhere that a wrong key may have meant.

    Raises:
        ConfigError: an unknown key, a wrong type or a value out of range.
    """
    if not isinstance(plain, Mapping):
        section = prefix.rstrip(".") or "the file"
        raise ConfigError(f"{where}: {section}: got {_shown(plain)}, expected a mapping of settings")
    hints = typing.get_type_hints(type(base))
    changes: dict[str, Any] = {}
    for key, value in plain.items():
        name = f"{prefix}{key}"
        if key not in hints:
            names = [*(f"{prefix}{field}" for field in hints), *known]
            raise ConfigError(f"{where}: unknown key {name!r}{nearest(name, names)} (--help lists them)")
        if dataclasses.is_dataclass(hints[key]):
            changes[key] = overlay(getattr(base, key), value, where, f"{name}.", known)
        else:
            changes[key] = _convert(value, hints[key], f"{where}: {name}")
    try:
        return dataclasses.replace(base, **changes)  # type: ignore[type-var]
    except ConfigError:
        raise
    except ValueError as error:  # the dataclass's own check: "<field> is <value>, expected ..."
        raise ConfigError(f"{where}: {prefix}{error}") from None


def overridden(config: Config, words: Sequence[str]) -> Config:
    """The config with `name=value` words laid over it; values are read as YAML.

    Raises:
        ConfigError: a word without `=`, an unknown name, or a value that the setting cannot have.
    """
    return overlay(config, read_words(words, "seed=1"), "setting")


def refuse_unused(arguments: argparse.Namespace, names: str, why: str) -> None:
    """Refuses options and settings that were given but would change nothing.

    Args:
        arguments: of a command line, its `key=value` words in `settings`; what is None, False or empty was not given.
        names: `--options` and settings.
        why: with what they change nothing.

    Raises:
        ConfigError: one of them was given.
    """
    words = {word.partition("=")[0] for word in arguments.settings}
    for name in names.split():
        option = name.startswith("--")
        if getattr(arguments, name[2:].replace("-", "_")) if option else name in words:
            raise ConfigError(f"{name} has no effect {why}; leave it out")


def settings_help(config: Any) -> str:
    """One line a setting: name, default, meaning."""
    docs, hints = field_docs(type(config)), typing.get_type_hints(type(config))
    lines = []
    for name, value in to_dict(config).items():
        shown = ",".join(map(str, value)) if isinstance(value, list) else value
        choice = typing.get_args(hints[name]) if typing.get_origin(hints[name]) is Literal else ()
        lines.append((f"{name}={shown}", docs[name] + (f" [{' | '.join(map(str, choice))}]" if choice else "")))
    width = max(len(left) for left, _ in lines) + 2
    return "\n".join(f"  {left:<{width}}{right}" for left, right in lines)


def _convert(value: Any, kind: Any, where: str) -> Any:
    """One value as the type of its field, or a `ConfigError` that says what was expected."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:  # `X | None`
        if value is None or value == AUTO:
            return None
        return _convert(value, arguments[0], where)
    if origin is Literal:
        names = [str(argument) for argument in arguments]
        if str(value) not in names:
            near = nearest(str(value), names)
            raise ConfigError(f"{where}: got {_shown(value)}, expected one of {', '.join(names)}{near}")
        return arguments[names.index(str(value))]
    if origin is tuple:
        items = [item for item in value.split(",") if item] if isinstance(value, str) else value
        items = items if isinstance(items, (list, tuple)) else [items]
        return tuple(_convert(item, arguments[0], where) for item in items)
    converted = _scalar(value, kind)
    if converted is None:
        names = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
        raise ConfigError(f"{where}: got {_shown(value)}, expected {names[kind]}")
    return converted


def _scalar(value: Any, kind: type) -> Any:
    """`value` as `kind`, or None where it is not one. YAML takes 1e-4 for text: text is read as a number."""
    if kind is bool or isinstance(value, bool):
        return value if kind is bool and isinstance(value, bool) else None
    if kind is str:
        return "" if value is None else str(value) if isinstance(value, (str, int, float)) else None
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            return None
    if not isinstance(value, (int, float)) or math.isnan(value):
        return None
    if kind is int:
        return int(value) if float(value).is_integer() else None
    return float(value)


def nearest(word: str, known: Sequence[str]) -> str:
    """`, did you mean 'X'?` for the known name that a wrong one looks like, or nothing."""
    tails = {name.rpartition(".")[2]: name for name in reversed(known)}  # of equal names the first section's
    tail = word.rpartition(".")[2]
    if tail in tails:  # the right name in the wrong section, or without its section
        return f", did you mean {tails[tail]!r}?"
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    near = near or [tails[match] for match in difflib.get_close_matches(tail, list(tails), n=1, cutoff=0.6)]
    return f", did you mean {near[0]!r}?" if near else ""


def _shown(value: Any) -> str:
    return f"{value!r} ({type(value).__name__})"
