"""Read `key=value` words and plain mappings into a frozen dataclass of settings; each mistake is reported in one line.

A setting's type says what it may be: `Literal` for choices, `Annotated` with `Bounds` for ranges. A
dataclass may be composed of others: in files and on the command line they are sections (`ppo.learning_rate`).
"""

import dataclasses
import difflib
import functools
import json
import math
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeVar

import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config
from pydantic_core import PydanticCustomError, core_schema
from typing_extensions import TypedDict

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.untrusted.reading import Loader

Config = TypeVar("Config")


AUTO = "auto"  # how None ("chosen for you") is written in files and on the command line


class Bounds(NamedTuple):
    """Numbers that a setting or a value in a file may be."""

    low: float
    high: float = math.inf
    open: bool = False
    """Both ends are excluded."""

    def hold(self, value: Any) -> bool:
        """Return whether a number is within the bounds, or an ascending pair of numbers."""
        first, last = value if isinstance(value, tuple) else (value, value)
        return self.low < first <= last < self.high if self.open else self.low <= first <= last <= self.high

    def __str__(self) -> str:
        low, high = (f"{end:g}" if isinstance(end, float) else str(end) for end in self[:2])
        if self.high < math.inf:
            return f"between {low} and {high}{', both excluded' if self.open else ''}"
        return "a positive number" if self.open else f"at least {low}" if self.low else "0 or more"

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Check what pydantic has accepted by its type; None is still to be chosen."""

        def checked(value: Any) -> Any:
            if value is not None and not self.hold(value):
                raise PydanticCustomError(
                    "bounds", "{expected}", {"expected": f"{self}{', ascending' if isinstance(value, tuple) else ''}"}
                )
            return value

        return core_schema.no_info_after_validator_function(checked, handler(source))


STRICT = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)
EXPECTED = {
    **{"int_type": "a whole number", "float_type": "a number", "string_type": "a string", "bool_type": "true or false"},
    **dict.fromkeys(("tuple_type", "list_type", "is_instance_of"), "a list"),
    **dict.fromkeys(("dict_type", "dataclass_type", "dataclass_exact_type", "mapping_type"), "a mapping"),
}
"""A mistake, as pydantic names it -> what should stand there."""
Seed = Annotated[int, Bounds(0, 2**32 - 1)]
Count = Annotated[int, Bounds(1, 10**6)]
AtLeastOne = Annotated[int, Bounds(1)]
Natural = Annotated[int, Bounds(0)]
NotNegative = Annotated[float, Bounds(0)]
Positive = Annotated[float, Bounds(0, open=True)]
Share = Annotated[float, Bounds(0.0, 1.0)]


class Settings:
    """Base of a frozen dataclass of settings, each with a default, that refuses what their types do not allow.

    Lists become tuples, and NumPy's numbers Python's. A class that inherits from several has the settings of all.
    """

    IDLE: ClassVar[Sequence[tuple[str, str, Callable[[Any], bool]]]] = ()
    """Settings that have an effect only under a condition: their names, the condition, and its test. Where it does not
    hold, they are refused unless they are 0 or their default."""

    def __post_init__(self) -> None:
        for name in _hints(type(self)):
            if isinstance(value := getattr(self, name), list):
                object.__setattr__(self, name, tuple(value))
            elif type(value).__module__ == "numpy" and not getattr(value, "shape", ()):  # a number of `np.linspace`
                object.__setattr__(self, name, value.item())
        check({name: getattr(self, name) for name in _hints(type(self))}, _hints(type(self)))
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


def check(values: Mapping[str, Any], hints: Mapping[str, Any]) -> None:
    """Raise `ConfigError` unless each value is what the type of its name allows."""
    try:
        _adapter(tuple(hints.items())).validate_python(dict(values))
    except ValidationError as error:
        raise ConfigError(mistake_of(error, values, hints)) from None


@functools.cache
def _adapter(hints: tuple[tuple[str, Any], ...]) -> Any:
    return TypeAdapter(with_config(STRICT)(TypedDict("Values", dict(hints))))  # type: ignore[misc]


def mistake_of(error: ValidationError, value: Any, hint: Any, root: str = "", show: Callable[[Any], str] = repr) -> str:
    """Return the first mistake in a value of the type `hint`: `ROOT: key[2] is 5, expected a number`.

    Of several types that were possible, it is the mistake of the last one.
    """
    details = error.errors(include_url=False)
    keys = {"unexpected_keyword_argument", "missing"}
    walked = [_resolve(each["loc"][:-1] if each["type"] in keys else each["loc"], value, hint) for each in details]
    (path, got, at), last = [pair for pair in zip(walked, details, strict=True) if pair[0][0] == walked[0][0]][-1]
    kind, arguments, place = last["type"], typing.get_args(at), (root + path).removeprefix(": ")
    if kind in keys and dataclasses.is_dataclass(at):
        key, names = str(last["loc"][-1]), sorted(_hints(typing.cast(type, at)))
        if kind == "missing":
            return f"{place}: missing key '{key}'"
        return f"{place}: unknown key '{key:.60}'{nearest(key, names)}; known keys: {', '.join(names)}"
    expected = EXPECTED.get(kind, last["msg"])
    if kind == "literal_error":
        choices = list(map(str, arguments))
        expected = f"one of {', '.join(choices)}{nearest(str(got), choices)}"
    elif kind == "bounds":
        expected = f"{'a whole number, ' if at is int and root else ''}{last.get('ctx', {})['expected']}"
    elif kind in ("missing", "too_long"):
        expected = f"a list of {len(arguments)}"
    text = repr(got) if kind == "literal_error" and isinstance(got, str) and len(got) < 60 else show(got)
    return (
        f"{place}: got {text}, expected {expected}"
        if kind.startswith("dataclass") or not path
        else f"{place} is {text}, expected {expected}"
    )


def _resolve(loc: Sequence[str | int], value: Any, hint: Any) -> tuple[str, Any, Any]:
    """Return a place in words, what stands there, and its type; pydantic's names of alternatives are passed over."""
    path = ""
    for key in (*loc, None):
        while typing.get_origin(hint) in (Annotated, types.UnionType, typing.Union):  # without bounds and None
            kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
            hint = kinds[0 if typing.get_origin(hint) is Annotated else -1]
        arguments: Any = typing.get_args(hint) or (Any,)
        if isinstance(value, Mapping) and key in value:
            path += f": {key!s:.60}"
            named = hint if isinstance(hint, Mapping) else _hints(hint) if dataclasses.is_dataclass(hint) else {}
            hint = named.get(str(key), arguments[-1])
        elif isinstance(value, (list, tuple)) and isinstance(key, int) and key < len(value):
            path += f"[{key}]"
            hint = arguments[key if key < len(arguments) and arguments[-1] is not ... else 0]
        else:
            continue
        value = value[typing.cast(Any, key)]
    return path, value, hint


def shown(value: Any, most: int = 60) -> str:
    """Return a value as a file writes it, cut to `most` characters."""
    try:
        text = json.dumps(value, default=repr)
    except (ValueError, TypeError, RecursionError):  # a number of thousands of digits, a key of another kind, a circle
        text = type(value).__name__
    return text if len(text) <= most else f"{text[: most - 3]}..."


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
    from tyro._docstrings import get_field_docstring  # parses each class once; the lock file pins tyro's version

    docs = {name: get_field_docstring(config_type, name, ()) for name in _hints(config_type)}
    return {name: " ".join(doc.split()) for name, doc in docs.items() if doc}


def overlay(base: Config, plain: Any, where: str, prefix: str = "", elsewhere: Sequence[str] = ()) -> Config:
    """Return a dataclass of settings with nested plain values, as of a YAML file, laid over it.

    `where` names the file or word that they come from, and `prefix` the place of `base` inside the whole, with its dot;
    `elsewhere` are dotted names outside of `base` that a wrong key may have meant.
    """
    plain = {} if plain is None else plain
    if not isinstance(plain, Mapping):
        section = prefix.rstrip(".") or "the file"
        raise ConfigError(f"{where}: {section}: got {shown(plain)}, expected a mapping of settings")
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
            changes[key] = _plain(value, hint)
    try:
        return replace(base, **changes)
    except ConfigError as error:  # the dataclass's check: "<field> is <value>, expected ..."
        raise ConfigError(f"{where}: {prefix}{error}") from None


def overridden(config: Config, words: Sequence[str]) -> Config:
    """Return the config with `name=value` words laid over it; values are read as YAML."""
    return overlay(config, read_words(words, "seed=1"), "setting")


def refuse_unused(arguments: Any, names: str, why: str) -> None:
    """Refuse options and settings, `names` of a `Command`, that were given but change nothing, and say `why`."""
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


def _plain(value: Any, hint: Any) -> Any:
    """Return a value of YAML or of a word as its type has it, where that is clear; what is not is refused later.

    `auto` is None, `1e-4`, which YAML takes for text, a number, and `a,b` a tuple.
    """
    while typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    if type(None) in typing.get_args(hint) and (value is None or value == AUTO):
        return None
    _, _, kind = _resolve((), value, hint)
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is tuple:
        items = [item for item in value.split(",") if item] if isinstance(value, str) else value
        return tuple(_plain(item, arguments[0]) for item in (items if isinstance(items, (list, tuple)) else [items]))
    if typing.get_origin(kind) in (Mapping, Sequence):
        return ({} if typing.get_origin(kind) is Mapping else []) if value is None else value
    if kind is str and not isinstance(value, (bool, Mapping, list)):
        return "" if value is None else str(value)
    if kind in (int, float) and isinstance(value, (str, int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except (ValueError, OverflowError):
            return value
        if kind is int:
            return int(value if isinstance(value, int) else number) if number.is_integer() else value
        return number if abs(number) < 2.0**64 or math.isinf(number) else value
    return value


def nearest(word: str, candidates: Sequence[str]) -> str:
    """Return `, did you mean 'X'?` for the candidate that a wrong name looks like, or an empty string."""
    tails = {name.rpartition(".")[2]: name for name in reversed(candidates)}  # of equal names the first section's
    tail = word.rpartition(".")[2]
    if tail in tails:  # the right name in the wrong section, or without its section
        return f", did you mean {tails[tail]!r}?"
    near = difflib.get_close_matches(word, candidates, n=1, cutoff=0.6)
    near = near or [tails[match] for match in difflib.get_close_matches(tail, list(tails), n=1, cutoff=0.6)]
    return f", did you mean {near[0]!r}?" if near else ""
