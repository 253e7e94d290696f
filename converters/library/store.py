"""Read the packaged furniture, `models.zip`: an index with credits, and each model's surface, texture and convex hulls.

Frame of a model: metres, y up, front along +z, the middle of its base at the origin.
"""

import dataclasses
import functools
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from converters.geometry.boxes import Hull
from converters.records.raw import VisualMesh
from converters.write.texture import quantise
from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.records import Reader

PACKED = Path(__file__).with_name("models.zip")
ATTRIBUTION = Path(__file__).with_name("ATTRIBUTION.md")
STEPS = 65535
"""Coordinates are kept in so many steps of the model's bounding box: 0.05 mm of 3 m."""
COLOURS = 96
"""Of a model's image, as it is given out: so that scenes keep it in a palette."""
REINSTALL = "install the package again"


@dataclasses.dataclass(frozen=True)
class Credit:
    """Creator, title and licence of a model."""

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
    """Surface and hulls of a model."""

    visual: VisualMesh
    hulls: tuple[Hull, ...]


def _table(planes: np.ndarray) -> np.ndarray:
    steps = planes[0].astype(np.uint16) | planes[1].astype(np.uint16) << 8
    return np.cumsum(steps, axis=1, dtype=np.uint16).T


def _faces(behind: np.ndarray) -> np.ndarray:
    flat = behind.ravel().astype(np.int64)
    new = flat == 0
    return ((np.cumsum(new) - new) - flat).reshape(-1, 3)


def attribution(models: Sequence[Model]) -> str:
    """Return the file that credits the creators and says what was changed, as the licences require."""
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


_archive = functools.cache(zipfile.ZipFile)
"""Opens an archive for good: its table of members takes as long to read as a model."""


def _member(path: Path, name: str) -> bytes:
    with readable(path, FileError, REINSTALL):
        return _archive(path).read(name)


@functools.cache
def read_index(path: Path = PACKED) -> dict[str, Model]:
    """Return name -> model, in the archive's order."""
    reader = Reader(FileError, REINSTALL)
    rows = reader.decoded(_member(path, "index.json"), "JSON", str(path))
    return {model.name: model for model in reader.typed(rows, tuple[Model, ...], str(path))}


@functools.cache
def read_image(name: str, path: Path = PACKED) -> Image.Image:
    """Read a model's texture, in all its colours."""
    with (
        readable(path, FileError, REINSTALL, f": {name}"),
        Image.open(io.BytesIO(_member(path, f"{name}.webp"))) as picture,
    ):
        return picture.convert("RGB")


def read_shape(name: str, path: Path = PACKED) -> Shape:
    """Read a model's surface and hulls."""
    visual, hulls = read_meshes(name, path)
    image = np.asarray(quantise(np.asarray(read_image(name, path)), COLOURS).convert("RGB"))
    return Shape(dataclasses.replace(visual, image=image), hulls)


@functools.cache
def read_meshes(name: str, path: Path = PACKED) -> tuple[VisualMesh, tuple[Hull, ...]]:
    """Read what `read_shape` does, with a surface of one grey pixel: decoding images takes longest."""
    buffer = io.BytesIO(_member(path, f"{name}.arrays"))
    with readable(path, FileError, REINSTALL, f": {name}"):
        bounds, *planes = (np.lib.format.read_array(buffer, allow_pickle=False) for _ in range(8))
        vertices, behind, uv, uv_behind, hull_vertices, hull_faces, counts = map(_table, planes)

    def metres(values: np.ndarray) -> np.ndarray:
        return bounds[0] + values / STEPS * bounds[1]

    at = np.cumsum(counts.astype(int), axis=0)
    solid = np.split(metres(hull_vertices), at[:-1, 0]), np.split(hull_faces.astype(np.int64), at[:-1, 1])
    grey = np.full((1, 1, 3), 128, np.uint8)
    visual = VisualMesh(metres(vertices), _faces(behind), uv / STEPS, _faces(uv_behind), grey)
    return visual, tuple(Hull(v, f) for v, f in zip(*solid, strict=True))
