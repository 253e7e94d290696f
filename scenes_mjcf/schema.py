"""Define the scene folder's contract: read and write `scene.json` and `maps.npz` as typed, checked records.

A scene folder holds `scene.xml` (MJCF), `scene.json` (this module's `SceneManifest`), `maps.npz`
(`SceneMaps`) and `assets/`. World frame: z up, metres, floor at z = 0. See `scenes_mjcf/README.md`.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np

from interactive_nav_common.config import Positive
from interactive_nav_common.errors import UserError
from interactive_nav_common.files import check_name
from interactive_nav_common.records import Reader
from interactive_nav_common.untrusted.reading import check_named, read_npz
from scenes_mjcf.categories import OBJECT_CATEGORIES

SCHEMA_VERSION = 1
CATEGORIES = OBJECT_CATEGORIES
SPLITS = ("train", "test")


class SceneError(UserError):
    """A scene folder that cannot be used; the message says what, where, what was expected and what to do."""


SCENES = Reader(SceneError, "convert the scene again")


@dataclasses.dataclass(frozen=True)
class SceneObject:
    """One movable object of a scene."""

    name: str
    """Body name in scene.xml, `<category>_<k>`."""
    category: str
    """One of `CATEGORIES`."""
    mass_kg: Positive
    """Density times decomposed volume, or the source's own mass."""
    friction: Positive
    """Sliding friction coefficient of its geoms."""
    n_hulls: int
    """Convex hulls (and as many boxes) it collides with."""
    cad_id: str
    """Identifier of the CAD model in its library."""


@dataclasses.dataclass(frozen=True)
class SceneManifest:
    """Content of `scene.json`: what a scene is, where it came from, and which gates it passed."""

    name: str
    split: Literal["train", "test"]
    source: dict[str, Any]
    """`format`, path names relative to the source folder, and their `sha256`."""
    licence: str
    floor_area_m2: float
    objects: tuple[SceneObject, ...]
    collision: dict[str, Any]
    """Decomposition parameters."""
    gates: dict[str, Any]
    """Gate name -> {passed, value, limit, unit}."""
    versions: dict[str, str]
    """Package versions that wrote the folder."""
    alignment: tuple[dict[str, Any], ...] = ()
    """Per object: residual of the keypoint fit and difference to the annotated pose."""
    warnings: tuple[str, ...] = ()
    """What the converter repaired, left out or found missing in the source."""
    measures: dict[str, Any] = dataclasses.field(default_factory=dict)
    """How full the scene is and how hard to get through (`converters/write/manifest.py`); empty: not measured."""
    floor_unseen_m2: float = 0.0
    """Of the floor, what the source does not show: under and behind furniture, and gaps that were bridged."""
    scan_kept: float | None = None
    """Share of the scan, without its furniture, that is drawn; None: not measured."""
    floor_open: float | None = None
    """Share of the free floor that lies beyond all walls; None: not measured."""
    schema_version: int = SCHEMA_VERSION


@dataclasses.dataclass(frozen=True)
class SceneMaps:
    """Content of `maps.npz`."""

    traversable: np.ndarray
    """[rows along y, columns along x] bool; static structure only, not eroded."""
    resolution_m: float
    """Cell side."""
    origin_w: tuple[float, float]
    """World x, y of the outer corner of cell [0, 0]."""
    floor_height_m: float
    """Height of the floor in the scan's own frame (0 in the scene's)."""

    @property
    def extent_w(self) -> tuple[float, float, float, float]:
        """Least and largest x, then y, m: what Matplotlib calls an image's extent."""
        (x, y), (rows, columns) = self.origin_w, self.traversable.shape
        return x, x + columns * self.resolution_m, y, y + rows * self.resolution_m


def manifest_from_dict(data: Any, where: str = "scene.json") -> SceneManifest:
    """Build a manifest from decoded JSON; a `SceneError` that names `where` says what breaks the schema."""
    manifest = SCENES.record(data, SceneManifest, where)
    check_name(manifest.name, f"{where}: name", SceneError)
    if manifest.schema_version != SCHEMA_VERSION:
        raise SceneError(
            f"{where}: schema_version is {manifest.schema_version}, expected {SCHEMA_VERSION}; convert the scene again"
        )
    for i, obj in enumerate(manifest.objects):
        if obj.category not in CATEGORIES:
            raise SceneError(
                f"{where}: objects[{i}]: category is '{obj.category}', expected one of {', '.join(CATEGORIES)}"
            )
    names = [o.name for o in manifest.objects]
    if len(set(names)) != len(names):
        raise SceneError(f"{where}: two objects share a name; names must be unique")
    return manifest


def load_manifest(folder: str | Path) -> SceneManifest:
    """Read and check `folder/scene.json`; raise `SceneError` where it is missing or breaks the schema."""
    path = Path(folder) / "scene.json"
    if not path.is_file():
        raise SceneError(
            f"{path}: no such file; expected a scene folder (scene.xml, scene.json, maps.npz, assets/), "
            "as 'python -m converters scenes list' shows; make one with 'python -m converters convert SRC OUT'"
        )
    if (xml := path.with_suffix(".xml")).is_file():
        check_named(xml, SceneError, "convert the scene again")
    return manifest_from_dict(SCENES.json(path), str(path))


def save_manifest(manifest: SceneManifest, folder: str | Path) -> None:
    """Writes `folder/scene.json` with sorted keys, so that equal manifests give equal bytes."""
    text = json.dumps(dataclasses.asdict(manifest), indent=1, sort_keys=True, allow_nan=False)
    (Path(folder) / "scene.json").write_text(text + "\n", encoding="utf-8")


def load_maps(folder: str | Path) -> SceneMaps:
    """Read and check `folder/maps.npz`; raise `SceneError` if it is missing or unusable, or coarser than 0.05 m."""
    path = Path(folder) / "maps.npz"
    with read_npz(path, SceneError, "convert the scene again") as arrays:
        traversable = arrays["traversable"]
        resolution, floor_height = float(arrays["resolution"]), float(arrays["floor_height"])
        origin = np.asarray(arrays["origin"], float).reshape(-1)
    if traversable.ndim != 2 or traversable.dtype != np.bool_:
        raise SceneError(f"{path}: traversable is {traversable.dtype}{traversable.shape}, expected a 2-D bool array")
    if not 0 < resolution <= 0.05 + 1e-9:
        raise SceneError(f"{path}: resolution is {resolution} m, expected at most 0.05 m")
    if origin.shape != (2,) or not np.isfinite([*origin, floor_height]).all():
        raise SceneError(f"{path}: origin is {origin}, floor_height {floor_height}, expected x, y and a height, finite")
    if not traversable.any():
        raise SceneError(f"{path}: the traversable map is empty; the scan needs visible floor")
    return SceneMaps(traversable, resolution, (float(origin[0]), float(origin[1])), floor_height)


def save_maps(maps: SceneMaps, folder: str | Path) -> None:
    """Writes `folder/maps.npz`."""
    np.savez_compressed(
        Path(folder) / "maps.npz",
        traversable=np.asarray(maps.traversable, bool),
        resolution=np.float64(maps.resolution_m),
        origin=np.asarray(maps.origin_w, np.float64),
        floor_height=np.float64(maps.floor_height_m),
    )
