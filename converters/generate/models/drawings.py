"""The rows of `drawings.yaml` in, furniture of convex parts out: metres, base at y = 0, front along +z."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from converters.generate.models import parts as shapes
from converters.generate.models.parts import Part
from interactive_nav_common.records import read_packaged


@dataclasses.dataclass(frozen=True)
class Drawing:
    """How a model is drawn."""

    category: str
    parts: tuple[list[Any], ...] = ()
    """Functions of `parts`, each with its arguments in order and, last, those by name; none of a library model."""
    sym: str = "__SYM_NONE"
    """Scan2CAD's symmetry class."""
    front: int = 1
    """+1: the model faces +z; -1: it faces -z, as some ShapeNet models do."""
    held_out: bool = False
    """Only homes to test in have it."""

    def draw(self) -> list[Part]:
        """Its parts."""
        drawn = [_shape(row) for row in self.parts]
        return [part for made in drawn for part in (made if isinstance(made, list) else [made])]


def _shape(row: list[Any]) -> Any:
    """What a row makes; an argument that is a row is made first, one of points becomes an array."""
    name, *values = row
    named = values.pop() if isinstance(values[-1], dict) else {}
    points = [np.array(v) if isinstance(v, list) and isinstance(v[0], list) else v for v in values]
    made = [_shape(v) if isinstance(v, list) and isinstance(v[0], str) else v for v in points]
    return getattr(shapes, name)(*made, **named)


_TABLES = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, dict[str, Drawing]])
SPARSE: dict[str, Drawing] = _TABLES["sparse"]
"""Model name -> how it is drawn, of what sparse homes have."""
DRAWN: dict[str, Drawing] = SPARSE | _TABLES["furnished"]
"""The same of all homes."""
