"""`key=value` words and plain mappings -> a frozen dataclass of settings; every mistake named in one line."""

from __future__ import annotations

import argparse
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

from interactive_nav_common.errors import ConfigError
from train import config_io

Config = TypeVar("Config")


def overridden(config: Config, words: Sequence[str]) -> Config:
    """The config with `name=value` words laid over it; values are read as YAML.

    Raises:
        ConfigError: a word without `=`, an unknown name, or a value that the setting cannot have.
    """
    return _told(lambda: config_io.overlay(config, config_io.read_words(words, "seed=1"), "setting"))


def overlaid(config: Config, plain: Mapping[str, Any], where: str) -> Config:
    """The config with a mapping laid over it.

    Args:
        config: a dataclass.
        plain: its field names -> values as YAML holds them.
        where: named in errors.

    Raises:
        ConfigError: an unknown name, or a value that the setting cannot have.
    """
    return _told(lambda: config_io.overlay(config, plain, where))


def _told(make: Callable[[], Config]) -> Config:
    try:
        return make()
    except ConfigError as error:
        raise ConfigError(str(error)) from None


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
    docs, hints = config_io.field_docs(type(config)), typing.get_type_hints(type(config))
    lines = []
    for name, value in config_io.to_dict(config).items():
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
            raise ConfigError(f"{name} is {value!r}, expected between {low:g} and {high:g}")
