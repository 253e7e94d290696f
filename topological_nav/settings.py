"""`key=value` words and plain mappings -> a frozen dataclass of settings; every mistake named in one line."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

import yaml

from topological_nav.errors import SettingsError
from train.config_io import field_docs

AUTO = "auto"
"""How None ("chosen for you") is written in files and on the command line."""
Config = TypeVar("Config")


def overridden(config: Config, words: Sequence[str]) -> Config:
    """The config with `name=value` words laid over it; values are read as YAML.

    Raises:
        SettingsError: a word without `=`, an unknown name, or a value that the setting cannot have.
    """
    plain: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or not name:
            raise SettingsError(f"{word!r}: expected key=value, for example seed=1")
        try:
            plain[name] = yaml.safe_load(text)
        except yaml.YAMLError:
            plain[name] = text
    return overlaid(config, plain, "setting")


def overlaid(config: Config, plain: Mapping[str, Any], where: str) -> Config:
    """The config with a mapping laid over it.

    Args:
        config: a dataclass.
        plain: its field names -> values as YAML holds them.
        where: named in errors.

    Raises:
        SettingsError: an unknown name, or a value that the setting cannot have.
    """
    hints = typing.get_type_hints(type(config))
    changes = {}
    for name, value in plain.items():
        if name not in hints:
            near = difflib.get_close_matches(str(name), hints, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(hints)}"
            raise SettingsError(f"{where}: unknown key '{name}'; {hint}")
        changes[name] = _converted(value, hints[name], f"{where}: {name}")
    try:
        return dataclasses.replace(config, **changes)  # type: ignore[type-var]
    except SettingsError:
        raise
    except ValueError as error:
        raise SettingsError(f"{where}: {error}") from None


def plain_settings(config: Any) -> dict[str, Any]:
    """The settings as YAML holds them: lists for tuples, `auto` for None."""
    values = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return {k: AUTO if v is None else list(v) if isinstance(v, tuple) else v for k, v in values.items()}


def settings_help(config: Any) -> str:
    """One line a setting: name, default, meaning."""
    docs, hints = field_docs(type(config)), typing.get_type_hints(type(config))
    lines = []
    for name, value in plain_settings(config).items():
        shown = ",".join(map(str, value)) if isinstance(value, list) else value
        choice = typing.get_args(hints[name]) if typing.get_origin(hints[name]) is Literal else ()
        lines.append((f"{name}={shown}", docs[name] + (f" [{' | '.join(choice)}]" if choice else "")))
    width = max(len(left) for left, _ in lines) + 2
    return "\n".join(f"  {left:<{width}}{right}" for left, right in lines)


def require(config: Any, names: str, low: float, high: float) -> None:
    """Refuses values outside [low, high]; None is still to be chosen."""
    for name in names.split():
        value = getattr(config, name)
        if value is not None and not low <= value <= high:
            raise SettingsError(f"{name} is {value!r}, expected between {low:g} and {high:g}")


def _converted(value: Any, kind: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:
        return None if value is None or value == AUTO else _converted(value, arguments[0], where)
    if origin is Literal:
        if value not in arguments:
            raise SettingsError(f"{where} is {value!r}, expected one of {', '.join(arguments)}")
        return value
    if origin is tuple:
        items = [part for part in value.split(",") if part] if isinstance(value, str) else value
        items = items if isinstance(items, list | tuple) else [items]
        return tuple(_converted(item, arguments[0], where) for item in items)
    if kind is bool and isinstance(value, bool):
        return value
    if kind is str and isinstance(value, str | int | float) and not isinstance(value, bool):
        return str(value)
    if kind in (int, float) and not isinstance(value, bool):
        try:
            number = float(value)  # YAML takes 1e-4 for text
        except (TypeError, ValueError):
            number = None
        if number is not None and (kind is float or number.is_integer()):
            return kind(number)
    expected = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}[kind]
    raise SettingsError(f"{where} is {value!r}, expected {expected}")
