"""Records of arrays that have a row for each of many things: taken in part, counted, joined."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Self

import numpy as np


class Rows:
    """A dataclass all of whose fields are arrays of as many rows."""

    def __len__(self) -> int:
        return len(getattr(self, dataclasses.fields(self)[0].name))  # type: ignore[arg-type]

    def take(self, which: Any) -> Self:
        """Some of the rows, by index or mask."""
        return type(self)(*(getattr(self, f.name)[which] for f in dataclasses.fields(self)))  # type: ignore[arg-type]

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, one part after the other."""
        names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
