"""Read `key=value` words and plain mappings into a frozen dataclass of settings; each mistake is reported in one line.

A setting's type says what it may be: `Literal` for choices, `Annotated` with `Bounds` (or a plain pair) for ranges. A
dataclass may be composed of others: in files and on the command line they are sections (`ppo.learning_rate`).
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import functools
import inspect
import math
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeVar

import yaml

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.untrusted.reading import Loader

Config = TypeVar("Config")


AUTO = "auto"  # how None ("chosen for you") is written in files and on the command line


class Bounds(NamedTuple):
    """Numbers that a setting may be; a plain pair `(low, high)` means the same."""

    low: float
    high: float = math.inf
    open: bool = False
    """Both ends are excluded."""

    def hold(self, value: float) -> bool:
        """Return whether a number is within the bounds."""
        return self.low < value < self.high if self.open else self.low <= value <= self.high

    def __str__(self) -> str:
        low, high = (f"{end:g}" if isinstance(end, float) else str(end) for end in self[:2])
        if self.high < math.inf:
            return f"between {low} and {high}{', both excluded' if self.open else ''}"
        return "a positive number" if self.open else f"at least {low}" if self.low else "0 or more"


Seed = Annotated[int, (0, 2**32 - 1)]
Count = Annotated[int, (1, 10**6)]
AtLeastOne = Annotated[int, Bounds(1)]
Natural = Annotated[int, Bounds(0)]
NotNegative = Annotated[float, Bounds(0)]
Positive = Annotated[float, Bounds(0, open=True)]
Share = Annotated[float, (0.0, 1.0)]


class Settings:
    """Base of a frozen dataclass of settings, each with a default, that refuses what their types do not allow.

    Lists become tuples. A class may inherit from several: it then has the settings of all of them.
    """

    IDLE: ClassVar[Sequence[tuple[str, str, Callable[[Any], bool]]]] = ()
    """Settings that have an effect only under a condition: their names, the condition, and its test. Where it does not
    hold, they are refused unless they are 0 or their default."""

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            if isinstance(value := getattr(self, name), list):
                object.__setattr__(self, name, tuple(value))
            check(name, getattr(self, name), hint)
        for names, needs, used in (row for cls in type(self).__mro__ for row in cls.__dict__.get("IDLE", ())):
            for name in () if used(self) else names.split():
                if (value := getattr(self, name)) not in (0, getattr(type(self), name, 0)):
                    problem = f"{name} is {value!r}, which changes nothing here"
                    raise ConfigError(f"{problem}: expected {needs}; or leave it out")

    @classmethod
    def of(cls, **settings: Any) -> Self:
        """Return the defaults with these settings replaced."""
        return replace(cls(), **settings)


@functools.cache
def _hints(config_type: type) -> dict[str, Any]:
    """Return the type of each setting by its name."""
    hints = typing.get_type_hints(config_type, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(config_type)}


def check(name: str, value: Any, hint: Any) -> None:
    """Raise `ConfigError` for a value that its type does not allow; None is still to be chosen."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if value is None or origin is None:
        return
    if origin is Literal:
        if value not in arguments:
            choices = [str(choice) for choice in arguments]
            near = nearest(str(value), choices)
            raise ConfigError(f"{name} is {value!r}, expected one of {', '.join(choices)}{near}")
    elif origin is tuple:
        for item in value:
            check(name, item, arguments[0])
    else:  # `X | None`, Annotated[X, bounds]
        check(name, value, arguments[0])
        for bounds in arguments[1:] if origin is Annotated else ():
            if isinstance(bounds, tuple) and not Bounds(*bounds).hold(value):
                raise ConfigError(f"{name} is {value!r}, expected {Bounds(*bounds)}")


def replace(config: Config, **changes: Any) -> Config:
    """Do as `dataclasses.replace` does, and name an unknown setting with the nearest known one."""
    names = list(_hints(type(config)))
    for name in changes:
        if name not in names:
            near = nearest(name, names).removeprefix(", ")
            available = f"known settings: {', '.join(sorted(names))}"
            raise ConfigError(f"unknown setting {name!r}; {f'{near} ' if near else ''}{available}")
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]


def _walk(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield each setting in order of definition: its dotted name, the dataclass whose field it is, its plain name."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _walk(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", config, field.name


def flatten(config: Any) -> dict[str, Any]:
    """Return the value of every setting by its dotted name, in order of definition."""
    return {dotted: getattr(part, name) for dotted, part, name in _walk(config)}


def to_dict(config: Any) -> dict[str, Any]:
    """Return nested plain values as YAML holds them: lists for tuples, `auto` for None."""

    def plain(value: Any) -> Any:
        return AUTO if value is None else list(value) if isinstance(value, tuple) else value

    return nested((name, plain(value)) for name, value in flatten(config).items())


def nested(settings: Iterable[tuple[str, Any]], where: str = "settings") -> dict[str, Any]:
    """Split dotted names into nested mappings; mappings among the values are merged."""
    whole: dict[str, Any] = {}
    for name, value in settings:
        *sections, last = str(name).split(".")
        mapping = isinstance(value, Mapping)
        place = whole
        for section in [*sections, last] if mapping else sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigError(f"{where}: {name}: {section} has a value already")
        if mapping:
            place.update(nested(value.items(), where))
        else:
            place[last] = value
    return whole


def read_words(words: Sequence[str], example: str = "ppo.learning_rate=1e-4") -> dict[str, Any]:
    """Return `dotted.name=value` words as a nested mapping; values are read as YAML.

    All words at once, so that two values that only fit together may both change.
    """
    settings = []
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or not name:
            raise ConfigError(f"override {word!r}: expected key=value, for example {example}")
        try:
            value = yaml.load(text, Loader)
        except (yaml.YAMLError, ValueError, RecursionError):
            value = text
        settings.append((name, value))
    return nested(settings, "override")


@functools.cache
def field_docs(config_type: type) -> dict[str, str]:
    """Return the docstring under each field by its name, for the class and the classes that it extends."""
    docs: dict[str, str] = {}
    for cls in reversed(config_type.__mro__[:-1]):
        (class_node,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        assert isinstance(class_node, ast.ClassDef)
        for field, after in zip(class_node.body, class_node.body[1:], strict=False):
            doc = after.value if isinstance(after, ast.Expr) else None
            if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Constant):
                docs[ast.unparse(field.target)] = " ".join(str(doc.value).split())
    return docs


def overlay(base: Config, plain: Any, where: str, prefix: str = "", elsewhere: Sequence[str] = ()) -> Config:
    """Return a dataclass of settings with nested plain values laid over it; other programs use it, too.

    Args:
        base: what `plain` does not name.
        plain: nested mapping as read from YAML; None, as of an empty file or section: nothing.
        where: file or word the values come from, for messages.
        prefix: dotted name of `base` inside the whole, with its dot.
        elsewhere: dotted names outside of `base` that a wrong key may have meant.
    """
    plain = {} if plain is None else plain
    if not isinstance(plain, Mapping):
        section = prefix.rstrip(".") or "the file"
        raise ConfigError(f"{where}: {section}: got {_shown(plain)}, expected a mapping of settings")
    hints = _hints(type(base))
    changes: dict[str, Any] = {}
    for key, value in plain.items():
        name = f"{prefix}{key}"
        if key not in hints:
            names = [*(f"{prefix}{field}" for field in hints), *elsewhere]
            raise ConfigError(f"{where}: unknown key {name!r}{nearest(name, names)} (--help lists them)")
        hint = hints[key]
        if dataclasses.is_dataclass(hint):
            changes[key] = overlay(getattr(base, key), value, where, f"{name}.", elsewhere)
        else:
            changes[key] = _convert(value, hint, f"{where}: {name}")
    try:
        return replace(base, **changes)
    except ConfigError as error:  # the dataclass's check: "<field> is <value>, expected ..."
        raise ConfigError(f"{where}: {prefix}{error}") from None


def overridden(config: Config, words: Sequence[str]) -> Config:
    """Return the config with `name=value` words laid over it; values are read as YAML."""
    return overlay(config, read_words(words, "seed=1"), "setting")


def refuse_unused(arguments: Any, names: str, why: str) -> None:
    """Refuse options and settings that were given but would change nothing.

    Args:
        arguments: a `Command`; what is None, False or empty was not given.
        names: `--options` and settings.
        why: with what they change nothing.
    """
    words = {word.partition("=")[0] for word in getattr(arguments, "settings", ())}
    for name in names.split():
        option = name.startswith("--")
        value = getattr(arguments, name[2:].replace("-", "_")) if option else name in words
        if value or (value == 0 and value is not False):
            raise ConfigError(f"{name} has no effect {why}; leave it out")


def settings_help(config: Any, notes: Mapping[str, str] | None = None, equals: str = "=") -> str:
    """Return one line per setting: dotted name, default, meaning, choices, and the note of its name."""
    lines = []
    for dotted, part, name in _walk(config):
        value, doc, hint = getattr(part, name), field_docs(type(part))[name], _hints(type(part))[name]
        shown = AUTO if value is None else ",".join(map(str, value)) if isinstance(value, (tuple, Mapping)) else value
        note = " | ".join(map(str, typing.get_args(hint))) if typing.get_origin(hint) is Literal else ""
        note = note or (notes or {}).get(dotted, "")
        lines.append((f"{dotted}{equals}{shown}", doc + (f" [{note}]" if note else "")))
    width = max(len(left) for left, _ in lines) + 2
    return "\n".join(f"  {left:<{width}}{right}" for left, right in lines)


def _convert(value: Any, kind: Any, where: str) -> Any:
    """Return a value as the type of its field, or raise a `ConfigError` that says what was expected."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):  # `X | None`
        if value is None or value == AUTO:
            return None
        return _convert(value, arguments[0], where)
    if origin is Annotated:
        return _convert(value, arguments[0], where)
    if origin in (Mapping, Sequence):  # whose items are checked by who reads them
        expected, empty = ("a mapping of settings", {}) if origin is Mapping else ("a list", [])
        if not isinstance(empty if value is None else value, type(empty)):
            raise ConfigError(f"{where}: got {_shown(value)}, expected {expected}")
        return value or empty
    if origin is Literal:  # which choices there are is checked with the bounds
        return value
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
    """Return `value` as `kind`, or None where it is not one. YAML takes 1e-4 for text; text is read as a number."""
    if kind is bool or isinstance(value, bool):
        return value if kind is bool and isinstance(value, bool) else None
    if kind is str:
        return "" if value is None else str(value) if isinstance(value, (str, int, float)) else None
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            return None
    if not isinstance(value, (int, float)) or not (abs(value) < 2.0**64 or abs(value) == math.inf):
        return None
    if kind is int:
        return int(value) if float(value).is_integer() else None
    return float(value)


def nearest(word: str, candidates: Sequence[str]) -> str:
    """Return `, did you mean 'X'?` for the candidate that a wrong name looks like, or an empty string."""
    tails = {name.rpartition(".")[2]: name for name in reversed(candidates)}  # of equal names the first section's
    tail = word.rpartition(".")[2]
    if tail in tails:  # the right name in the wrong section, or without its section
        return f", did you mean {tails[tail]!r}?"
    near = difflib.get_close_matches(word, candidates, n=1, cutoff=0.6)
    near = near or [tails[match] for match in difflib.get_close_matches(tail, list(tails), n=1, cutoff=0.6)]
    return f", did you mean {near[0]!r}?" if near else ""


def _shown(value: Any) -> str:
    text = repr(value)
    return f"{text if len(text) < 80 else text[:76] + '...'} ({type(value).__name__})"
