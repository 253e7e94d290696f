"""The packaged furniture: an index of models with their credits, and each one's surface, texture and convex hulls.

One archive, `models.zip`: `index.json`, and for each model its arrays and its texture. Frame of a model: metres, y up,
front along +z, the middle of its base at the origin.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from converters.geometry.boxes import Hull
from converters.records.visual import VisualMesh
from converters.write.texture import quantise
from interactive_nav_common.errors import FileError

PACKED = Path(__file__).with_name("models.zip")
ATTRIBUTION = Path(__file__).with_name("ATTRIBUTION.md")
STEPS = 65535
"""Coordinates are kept in so many steps of the model's bounding box: 0.05 mm of 3 m."""
COLOURS = 96
_DAY = (1980, 1, 1, 0, 0, 0)


@dataclasses.dataclass(frozen=True)
class Credit:
    """Whose a model is, and what it is called there."""

    title: str
    creator: str
    licence: str
    source: str
    """Library and model, such as `Scopia/armchair1`."""


@dataclasses.dataclass(frozen=True)
class Model:
    """A packaged model without its arrays."""

    name: str
    """Of the library and the model there: `Scopia/armchair1`."""
    category: str
    split: str
    """train or test: no creator is in both."""
    size_m: tuple[float, ...]
    """Along x, y (up) and z."""
    faces: int
    """Of its surface."""
    hulls: int
    credits: tuple[Credit, ...]
    """One each for the model and what stands on it."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """What a model looks like and collides with."""

    visual: VisualMesh
    hulls: tuple[Hull, ...]


def _packed(values: np.ndarray, low: np.ndarray, span: np.ndarray) -> np.ndarray:
    return np.rint((values - low) / span * STEPS).astype(np.uint16)


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    quantise(image, COLOURS).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _arrays(shape: Shape) -> bytes:
    visual = shape.visual
    points = np.vstack([visual.vertices, *(hull.vertices for hull in shape.hulls)])
    low, span = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-6)
    arrays = {
        "bounds": np.stack([low, span]),
        "vertices": _packed(visual.vertices, low, span),
        "faces": visual.faces.astype(np.uint16),
        "uv": np.rint(np.clip(visual.uv, 0, 1) * STEPS).astype(np.uint16),
        "uv_faces": visual.uv_faces.astype(np.uint16),
        "hull_vertices": _packed(np.vstack([h.vertices for h in shape.hulls]), low, span),
        "hull_faces": np.vstack([h.faces for h in shape.hulls]).astype(np.uint16),
        "hull_counts": np.array([(len(h.vertices), len(h.faces)) for h in shape.hulls], np.uint16),
    }
    buffer = io.BytesIO()
    for array in arrays.values():
        np.lib.format.write_array(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def write_library(path: Path, models: Sequence[tuple[Model, Shape]]) -> None:
    """Writes the archive: the same models, the same bytes."""
    with zipfile.ZipFile(path, "w") as archive:

        def put(name: str, data: bytes) -> None:
            archive.writestr(zipfile.ZipInfo(name, _DAY), data, zipfile.ZIP_LZMA)

        index = [dataclasses.asdict(model) for model, _ in models]
        put("index.json", json.dumps(index, indent=1, sort_keys=True).encode())
        for model, shape in models:
            put(f"{model.name}.arrays", _arrays(shape))
            put(f"{model.name}.png", _png(shape.visual.image))


def attribution(models: Sequence[Model]) -> str:
    """The file that names who made what, and what was changed, as the licences ask."""
    lines = [
        "# Furniture: whose models these are",
        "",
        "From the libraries of 3D models contributed to [Sweet Home 3D](https://www.sweethome3d.com/importModels.jsp)"
        ", as Debian's package sweethome3d-furniture 1.8 carries them. Changed in each: scaled to the size that its",
        "catalogue gives, simplified to at most 1 cm from the original, its materials baked into one texture of 256",
        "pixels; convex hulls were computed for collision.",
        "",
        "| Model | Title | Creator | Licence |",
        "|---|---|---|---|",
    ]
    rows = dict.fromkeys((c.source, c.title, c.creator or "not named", c.licence) for m in models for c in m.credits)
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)]) + "\n"


def _member(path: Path, name: str) -> bytes:
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.read(name)
    except (OSError, KeyError, zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else " ".join(str(error).split())
        raise FileError(f"{path}: {name} is not readable ({reason}); install the package again") from None


@functools.cache
def read_index(path: Path = PACKED) -> dict[str, Model]:
    """Name -> model, in the archive's order.

    Raises:
        FileError: a missing or damaged archive.
    """
    found = {}
    for row in json.loads(_member(path, "index.json")):
        credits = tuple(Credit(**one) for one in row["credits"])
        values: dict[str, Any] = {**row, "size_m": tuple(row["size_m"]), "credits": credits}
        found[row["name"]] = Model(**values)
    return found


@functools.cache
def read_shape(name: str, path: Path = PACKED) -> Shape:
    """A model's surface and hulls.

    Args:
        name: key of `read_index`.
        path: of the archive.

    Raises:
        FileError: no such model, or a damaged archive.
    """
    buffer = io.BytesIO(_member(path, f"{name}.arrays"))
    try:
        bounds, vertices, faces, uv, uv_faces, hull_vertices, hull_faces, counts = (
            np.lib.format.read_array(buffer, allow_pickle=False) for _ in range(8)
        )
        with Image.open(io.BytesIO(_member(path, f"{name}.png"))) as picture:
            image = np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, EOFError) as error:
        raise FileError(f"{path}: {name} is damaged ({' '.join(str(error).split())}); install it again") from None

    def metres(values: np.ndarray) -> np.ndarray:
        return bounds[0] + values / STEPS * bounds[1]

    at = np.cumsum(counts.astype(int), axis=0)
    solid = np.split(metres(hull_vertices), at[:-1, 0]), np.split(hull_faces.astype(np.int64), at[:-1, 1])
    visual = VisualMesh(metres(vertices), faces.astype(np.int64), uv / STEPS, uv_faces.astype(np.int64), image)
    return Shape(visual, tuple(Hull(v, f) for v, f in zip(*solid, strict=True)))
