"""Lines of metrics in, a metrics.jsonl out, packed or not, and back."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from interactive_nav_common.errors import FileError
from interactive_nav_common.files import whole_file, write_text

METRICS, PACKED_METRICS = "metrics.jsonl", "metrics.jsonl.gz"
"""Of a run, and of one that was exported."""


def write_metrics(path: Path, lines: Sequence[dict[str, Any]]) -> None:
    """Writes a metrics.jsonl, or, where the name ends in .gz, a packed one."""
    text = "".join(json.dumps(line) + "\n" for line in lines)
    if path.suffix == ".gz":
        with whole_file(path) as partial:
            partial.write_bytes(gzip.compress(text.encode(), mtime=0))
    else:
        write_text(path, text)


def mean_over_episodes(lines: Sequence[dict[str, Any]], name: str) -> float | None:
    """Mean of a score over the episodes of some lines of metrics; None where none ended."""
    scored = [(line[name], line["episodes"]) for line in lines if name in line]
    episodes = sum(count for _, count in scored)
    return sum(score * count for score, count in scored) / episodes if episodes else None


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a metrics.jsonl, packed or not; an unfinished last line (a killed run) is left out.

    Raises:
        FileError: it cannot be read.
    """
    try:
        everything = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    except (OSError, EOFError, zlib.error) as error:
        raise FileError(f"{path}: not readable ({error}); expected the metrics of a run") from None
    lines = []
    for text in everything.decode(errors="replace").splitlines():
        try:
            line = json.loads(text)
        except ValueError:
            break
        if not isinstance(line, dict):
            break
        lines.append(line)
    return lines
