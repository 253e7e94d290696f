"""Write tables of rows as Parquet files, read and show them; take parts of records of arrays and join them."""

import dataclasses
import functools
import hashlib
import inspect
import io
import json
import operator
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from rich.table import Table

from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.files import whole_file

IDENTITY = ("run", "robot", "policy", "evaluation_seed", "scene", "episode")
"""Columns that name an episode that was played."""
LAYOUT: dict[str, Any] = {"write_statistics": False, "store_schema": False, "data_page_size": 2**26}
"""Nothing twice (types are the same without a schema), and one page a column; PyArrow 23 ends them at 20,000 rows."""
if "max_rows_per_page" in inspect.signature(pq.ParquetWriter).parameters:
    LAYOUT["max_rows_per_page"] = 2**30


def markdown(header: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """Return a table for people."""
    rows = [list(header), ["---"] * len(header), *([str(cell) for cell in line] for line in lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def console_table(header: Sequence[str], lines: Iterable[Sequence[str]], left: int = 1, **look: Any) -> Table:
    """Return a table for a terminal, its first columns to the left and the others to the right."""
    table = Table(**look)
    for place, heading in enumerate(header):
        table.add_column(heading, justify="left" if place < left else "right")
    for line in lines:
        table.add_row(*line)
    return table


def where(rows: pa.Table, **wanted: Any) -> pa.Table:
    """Return the rows whose columns have these values; None: any."""
    tests = [pc.field(name) == value for name, value in wanted.items() if value is not None]
    return rows.filter(functools.reduce(operator.and_, tests)) if tests else rows


def digest_of(request: Any, digits: int = 8) -> str:
    """Return hexadecimal digits that tell requests apart which differ as JSON; they name files of rows."""
    return hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:digits]


def write_parquet(table: pa.Table, path: Path, notes: dict[str, str] | None = None, small: bool = False) -> None:
    """Write rows, each column in its smallest encoding, and notes beside them in the file, whole or not at all.

    A small one is a tenth smaller and takes thirty times as long to write: for files that are kept.
    """
    table = table.replace_schema_metadata(None)
    packing: dict[str, Any] = {"compression": "brotli" if small else "zstd", "compression_level": 11 if small else 15}

    def columns(**encoding: Any) -> list[Any]:
        pq.write_table(table, buffer := io.BytesIO(), **packing, **LAYOUT, **encoding)
        group = pq.read_metadata(buffer).row_group(0)
        return [group.column(k) for k in range(group.num_columns)]

    plain = columns(use_dictionary=False)
    numbers = [c.path_in_schema for c in plain if c.physical_type in ("INT32", "INT64", "FLOAT", "DOUBLE")]
    tried = plain, columns(), columns(use_dictionary=False, use_byte_stream_split=numbers)
    best = [min(same, key=lambda c: c.total_compressed_size) for same in zip(*tried, strict=True)]
    packing["use_dictionary"], packing["use_byte_stream_split"] = (
        [c.path_in_schema for c, chosen in zip(some, best, strict=True) if c is chosen] for some in tried[1:]
    )
    with whole_file(path) as partial, pq.ParquetWriter(partial, table.schema, **packing, **LAYOUT) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata(notes or {})


def read_notes(path: Path) -> dict[str, str]:
    """Return what `write_parquet` kept beside the rows; nothing where the file is damaged."""
    try:
        metadata = pq.read_schema(path).metadata or {}
    except (OSError, pa.ArrowInvalid):
        return {}
    return {key.decode(): value.decode() for key, value in metadata.items()}


@dataclasses.dataclass(frozen=True)
class Columns:
    """Columns that files of rows must have, by the kind of their values."""

    text: tuple[str, ...]
    whole: tuple[str, ...]
    numbers: tuple[str, ...]
    may_be_empty: tuple[str, ...] = ()
    may_be_missing: tuple[str, ...] = ()

    def check(self, rows: pa.Table, path: Path) -> None:
        """Refuse rows that lack one, have values of another kind in it, or none."""
        again = "evaluate the run again"
        for kind, names in (("text", self.text), ("whole numbers", self.whole), ("numbers", self.numbers)):
            for name in names:
                if name not in rows.column_names and name in self.may_be_missing:
                    continue
                if name not in rows.column_names:
                    raise FileError(f"{path}: has no column '{name}', expected {kind} there; {again}")
                is_whole, column = pa.types.is_integer(rows[name].type), rows[name]
                is_number = kind == "numbers" and pa.types.is_floating(column.type)
                right = pa.types.is_string(column.type) if kind == "text" else is_whole or is_number
                if not right and not (column.null_count == len(rows) and name in self.may_be_empty):
                    raise FileError(f"{path}: column '{name}' holds {column.type}, expected {kind}; {again}")
                if column.null_count and name not in self.may_be_empty:
                    raise FileError(f"{path}: column '{name}' is empty in {column.null_count:,} rows; {again}")


def read_rows(paths: Sequence[Path], check: Callable[[pa.Table, Path], None] | None = None) -> pa.Table:
    """Return the rows of several files as one table, each checked; a column that a file lacks is empty there.

    An episode that stands in several files (`IDENTITY`) is taken once, from the last of them by name. Raise
    `FileError` for a file that cannot be read or does not fit the others.
    """
    tables = []
    for path in sorted(paths):
        with readable(path, FileError, "evaluate the run again", " as Parquet"):
            tables.append(pq.read_table(path).replace_schema_metadata(None))
        if check:
            check(tables[-1], path)
    try:
        rows = pa.concat_tables(tables, promote_options="permissive")
        if not set(IDENTITY) <= set(rows.column_names):
            return rows
        order = rows.select(list(IDENTITY)).append_column("at", pa.array(np.arange(len(rows))))
        last = order.group_by(list(IDENTITY)).aggregate([("at", "max")])["at_max"].to_numpy()
    except pa.ArrowException as error:
        raise FileError(f"rows do not fit each other ({error}); draw their folders one by one") from None
    return rows.take(np.sort(last))


def column(first: Any, kind: type = float) -> Any:
    """Declare a field of a dataclass: an array with a row for each of many, and the value that `fresh` gives it."""
    return dataclasses.field(metadata={"first": first, "kind": kind})


def fresh(record: type, count: int) -> dict[str, np.ndarray]:
    """Return the first values of a dataclass's columns, of `count` rows."""
    fields = [field for field in dataclasses.fields(record) if "first" in field.metadata]
    return {field.name: np.full(count, field.metadata["first"], field.metadata["kind"]) for field in fields}


class Rows:
    """A dataclass all of whose fields are arrays of as many rows."""

    def __len__(self) -> int:
        return len(getattr(self, dataclasses.fields(self)[0].name))  # type: ignore[arg-type]

    def take(self, which: Any) -> Self:
        """Return some of the rows, by index or mask."""
        return type(self)(*(getattr(self, f.name)[which] for f in dataclasses.fields(self)))  # type: ignore[arg-type]

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of all parts, one part after the other."""
        names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
