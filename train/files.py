"""Files written whole or not at all, and read back."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from train.errors import RunFolderError


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`, which replaces it once the block has written it.

    Raises:
        RunFolderError: it cannot be written; what stood at `path` is untouched.
    """
    partial = path.with_name(f".partial-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        reason = error.strerror or error
        raise RunFolderError(f"{path}: cannot be written ({reason}); make room or choose another place") from None


def write_text(path: Path, text: str) -> None:
    """Writes a text file whole or not at all."""
    with whole_file(path) as partial:
        partial.write_text(text)
