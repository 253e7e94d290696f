"""Read JSON and YAML files into plain values and typed records; every mistake is one line that names file and key.

A record is a dataclass: its types say what its keys may hold, `Annotated` with `Bounds` how large numbers may be.
Lines of metrics too, packed or not, and back.
"""

import dataclasses
import functools
import json
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError

from interactive_nav_common.config import STRICT, mistake_of, shown
from interactive_nav_common.errors import FileError, UserError, readable
from interactive_nav_common.files import write_text
from interactive_nav_common.untrusted.reading import Loader, read_bytes, unpack

Record = TypeVar("Record")
LARGEST = 2.0**64
"""Of numbers: seeds and sizes in bytes are below, and no float of 32 bits overflows."""


@functools.cache
def _adapter(hint: Any) -> Any:
    """Return what checks a value of a type; in a tuple, so that records in it are as strict."""
    return TypeAdapter(tuple.__class_getitem__((hint,)), config=STRICT)  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True)
class Reader:
    """How files of one kind are read."""

    error: type[UserError]
    """Raised for what cannot be used."""
    remedy: str
    """Ends its message."""
    finite: bool = True
    """All numbers must be finite and below 2**64; measured scores may be none."""

    def json(self, path: Path, absent: Any = None) -> Any:
        """Return the decoded file; `absent`, unless None, where there is none."""
        try:
            return self.decoded(read_bytes(path), "JSON", str(path))
        except OSError as error:
            if isinstance(error, FileNotFoundError) and absent is not None:
                return absent
            raise self.error(f"{path}: cannot be read ({error.strerror or error}); {self.remedy}") from None

    def decoded(self, text: str | bytes, kind: Literal["JSON", "YAML"], where: str, loader: Any = Loader) -> Any:
        """Return what `json` does, from a file's text."""
        try:
            value = json.loads(text) if kind == "JSON" else yaml.load(text, loader)
        except (ValueError, RecursionError, yaml.YAMLError) as error:  # no UTF-8, a number too long, brackets too deep
            reason = " ".join(str(error).split())[:200]
            raise self.error(f"{where}: not readable as {kind} ({reason}); {self.remedy}") from None
        if self.finite:
            self._check_numbers(value, where)
        return value

    def record(self, data: Any, cls: type[Record], where: str, others: bool = False) -> Record:
        """Return a decoded mapping as a record: lists become tuples, mappings records where the types say so.

        `where` is named in errors; with `others`, keys that the record lacks are passed over.
        """
        if others and isinstance(data, dict):
            names = {field.name for field in dataclasses.fields(typing.cast(Any, cls))}
            data = {key: value for key, value in data.items() if key in names}
        return self.typed(data, cls, where)

    def typed(self, value: Any, hint: Any, where: str) -> Any:
        """Return a decoded value as its type requires it."""
        try:
            return _adapter(hint).validate_json(json.dumps([value], default=str))[0]
        except ValidationError as error:
            raise self.error(
                f"{mistake_of(error, [value], tuple[hint], where, shown)}; {self.remedy}".replace("[0]", "", 1)
            ) from None

    def _check_numbers(self, value: Any, where: str) -> None:
        left = [(where, value)]
        while left:
            place, item = left.pop()
            if isinstance(item, int | float) and not abs(item) < LARGEST:  # NaN too
                raise self.error(f"{place} is {shown(item)}, expected a finite number below 2**64; {self.remedy}")
            if isinstance(item, dict | list):
                pairs = item.items() if isinstance(item, dict) else enumerate(item)
                left += [(f"{place}[{k}]" if isinstance(item, list) else f"{place}: {k!s:.60}", v) for k, v in pairs]


RUNS = Reader(FileError, "make it again or remove it", finite=False)
"""Small files of runs."""
PACKAGED = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # six times as fast, but too deep a file could end the process
METRICS, PACKED_METRICS = "metrics.jsonl", "metrics.jsonl.gz"
"""Of a run, and of one that was exported."""


def read_packaged(path: Path, hint: Any) -> Any:
    """Return a YAML table that comes with the package, as the type `hint`."""
    reader = Reader(FileError, "install the package again", finite=False)
    return reader.typed(reader.decoded(path.read_bytes(), "YAML", str(path), PACKAGED), hint, str(path))


def write_metrics(path: Path, lines: Sequence[dict[str, Any]]) -> None:
    """Write a metrics.jsonl, or, where the name ends in .gz, a packed one."""
    write_text(path, "".join(json.dumps(line) + "\n" for line in lines))


def cut_metrics(path: Path, keep: Callable[[dict[str, Any]], bool]) -> None:
    """Keep only those lines of a metrics.jsonl, if there is one, for which `keep` returns True."""
    if path.is_file():
        write_metrics(path, [line for line in read_metrics(path) if keep(line)])


def mean_over_episodes(lines: Sequence[dict[str, Any]], name: str) -> float | None:
    """Return the mean of a score over the episodes of some lines of metrics; None where none ended."""
    scored = [(line[name], line["episodes"]) for line in lines if name in line]
    episodes = sum(count for _, count in scored)
    return sum(score * count for score, count in scored) / episodes if episodes else None


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a metrics.jsonl, packed or not, without an unfinished last line (a killed run)."""
    with readable(path, FileError, "expected the metrics of a run"):
        everything = read_bytes(path)
        everything = unpack(everything, "gzip") if path.suffix == ".gz" else everything
    lines = []
    for text in everything.decode(errors="replace").splitlines():
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            break
        if not isinstance(line, dict):
            break
        lines.append(line)
    return lines
