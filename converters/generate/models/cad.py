"""Build CAD furniture by name, from the packaged library or drawn, and place it on a floor.

Frame of a CAD model: y up, front along +z, normalised so that the bounding box's diagonal is 1, as in ShapeNet. Models
are unions of overlapping convex parts. `Scopia/puff~moss` is a pouf in the colour of the material moss.
"""

import dataclasses
import functools
import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterable, Set
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from converters.generate.models import parts as shapes
from converters.generate.models.parts import MATERIALS, Part, holding, on_floor
from converters.geometry.boxes import convex_pieces
from converters.geometry.faces import face_vectors, stacked
from converters.library.store import read_image, read_index, read_meshes, read_shape
from converters.read.annotations import MOST_PIECES, SLACK
from converters.read.obj import texels
from converters.records.raw import ScannedHinge, VisualMesh
from interactive_nav_common.records import read_packaged
from interactive_nav_common.rotations import Y_UP_TO_Z_UP, transform, transformed, yaw_matrix
from scenes_mjcf.categories import CATEGORIES


@dataclasses.dataclass(frozen=True)
class Drawing:
    """Describe how a model is drawn."""

    category: str
    parts: tuple[list[Any], ...] = ()
    """Functions of `parts`, each with its arguments in order and, last, those by name; none of a library model."""
    sym: str = "__SYM_NONE"
    """Scan2CAD's symmetry class."""
    held_out: bool = False
    """Only homes to test in have it."""
    role: str = ""
    """Key of `roles` in `looks.yaml`, such as `office`: homes use the model only in groups that request the role."""


def drawn_parts(rows: Iterable[list[Any]]) -> list[Part]:
    """Return the parts of rows as `Drawing.parts` has them."""
    return [part for shape in map(_shape, rows) for part in (shape if isinstance(shape, list) else [shape])]


def _shape(row: list[Any]) -> Any:
    """Build what a row describes; an argument that is a row is built first, one of points becomes an array."""
    name, *values = row
    named = values.pop() if isinstance(values[-1], dict) else {}
    for k, value in enumerate(values):
        if isinstance(value, list) and isinstance(value[0], (list, str)):
            values[k] = _shape(value) if isinstance(value[0], str) else np.array(value)
    return getattr(shapes, name)(*values, **named)


DRAWN = read_packaged(Path(__file__).with_name("drawings.yaml"), dict[str, Drawing])
"""Model name -> how it is drawn, of those that are no library models."""
FITTED = {
    "counter": "kitchen",
    "sink": "kitchen",
    "door": "doors",
    "toilet": "bath",
    "washbasin": "bath",
    "tub": "bath",
}
"""Category -> what of a home is in one tint."""


@dataclasses.dataclass(frozen=True)
class Looks:
    """Hold the tables of `looks.yaml`."""

    roles: dict[str, tuple[str, ...]]
    """Role -> models that have it."""
    tints: dict[str, tuple[str, ...]]
    """Category -> materials in whose colour its models come too."""
    palettes: tuple[tuple[str, ...], ...]
    """Of each the materials that a home's cloth is in: in place of each tint of sofas, then of none."""
    holds: dict[str, tuple[list[Any], ...]]
    """Model of the library -> what is drawn in it and nothing else, as `Drawing.parts`, in the library's frame."""
    worktops: tuple[tuple[list[Any], ...], ...]
    """Groups of what stands on counters, as `Drawing.parts`; y = 0 is the counter's top."""


LOOKS: Looks = read_packaged(Path(__file__).with_name("looks.yaml"), Looks)
CLOTH = ("armchair", "bed", "sofa")  # whose looks a home's palette decides


@dataclasses.dataclass(frozen=True)
class CadModel:
    """Describe a normalised model."""

    name: str
    category: str
    catid: str
    id_cad: str
    sym: str
    parts: tuple[Part, ...]
    """In the normalised CAD frame."""
    unit_m: float
    """Metres per CAD unit at the model's designed size."""
    look: Callable[[], VisualMesh] | None = None
    """Returns `surface`, which takes longer than the rest and is not needed to furnish a home."""
    solids: tuple[Part, ...] = ()
    """What of it collides; none: its parts."""

    @functools.cached_property
    def surface(self) -> VisualMesh | None:
        """Return what is drawn of a library model, CAD frame; its parts are its hulls."""
        return None if self.look is None else self.look()

    @functools.cached_property
    def bounds(self) -> np.ndarray:
        """Return the (2, 3) lowest and highest corner, CAD frame."""
        points = np.concatenate([p.vertices for p in self.parts])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def center(self) -> np.ndarray:
        """Return the (3,) centre of the bounding box, CAD frame."""
        return self.bounds.mean(axis=0)

    @property
    def built_in(self) -> bool:
        """Return whether it is part of the building."""
        return not CATEGORIES[self.category].is_object

    @property
    def half_extents(self) -> np.ndarray:
        """Return the (3,) half extents of the bounding box, CAD frame."""
        return np.diff(self.bounds, axis=0)[0] / 2


def _library_parts(name: str) -> list[Part]:
    """Return the hulls of a library model, as the converter joins them, in the colour nearest to the model's."""
    hulls = read_meshes(name)[1]
    colour = np.asarray(read_image(name)).reshape(-1, 3).mean(axis=0) / 255
    material = min(MATERIALS, key=lambda m: float(np.abs(np.array(MATERIALS[m]) - colour).sum()))
    pieces = convex_pieces(*stacked((h.vertices, h.faces) for h in hulls), MOST_PIECES, SLACK)
    assert pieces is not None, f"{name}: a hull is not convex"
    return [Part(v, f, material) for v, f in pieces]


_ROLE = {name: role for role, names in LOOKS.roles.items() for name in names}
_PACKAGED = {name: Drawing(model.category, held_out=model.split == "test") for name, model in read_index().items()}
LIBRARY: dict[str, Drawing] = {
    name: dataclasses.replace(drawing, role=_ROLE.get(name, "")) for name, drawing in (DRAWN | _PACKAGED).items()
}
"""Model name -> how it is drawn."""

HOME_TRAIN_MODELS, HOME_TEST_MODELS = (
    tuple(name for name, drawing in (_PACKAGED | DRAWN).items() if drawing.held_out == test) for test in (False, True)
)
"""Models of homes to train in, and those held out for homes to test in."""
MODELS = {"train": HOME_TRAIN_MODELS, "test": HOME_TEST_MODELS}
"""Split -> models of its homes."""


@functools.cache
def cad_model(name: str) -> CadModel:
    """Draw a model, y up, with a bounding box diagonal of 1; like ShapeNet's, its origin is a little off-centre."""
    plain, _, tint = name.partition("~")
    model = _tinted(_empty(plain), tint) if tint else _empty(plain)
    if plain not in LOOKS.holds or model.look is None:
        return model
    return dataclasses.replace(model, look=functools.partial(_filled, model, plain))


@functools.cache
def _empty(name: str) -> CadModel:
    """Return a model that holds nothing, without a tint."""
    drawing = LIBRARY[name]
    parts = _library_parts(name) if name in _PACKAGED else on_floor(drawn_parts(drawing.parts))
    points = np.concatenate([p.vertices for p in parts])
    low, high = points.min(axis=0), points.max(axis=0)
    unit_m = float(np.linalg.norm(high - low))
    digest = _digest(name)
    shift = (np.frombuffer(bytes.fromhex(digest)[:3], np.uint8) / 255 - 0.5) * 0.06
    move = -(low + high) / 2 / unit_m + np.round(shift, 4)
    scaled = tuple(dataclasses.replace(p, vertices=np.round(p.vertices / unit_m + move, 6)) for p in parts)
    look, category = functools.partial(_surface, name, unit_m, move) if name in _PACKAGED else None, drawing.category
    return CadModel(name, category, CATEGORIES[category].synset, digest[:32], drawing.sym, scaled, unit_m, look)


def as_drawn(surface: VisualMesh) -> VisualMesh:
    """Return the surface: `CadModel.look` of one that is at hand."""
    return surface


def _surface(name: str, unit_m: float, move: np.ndarray) -> VisualMesh:
    visual = read_shape(name).visual
    return dataclasses.replace(visual, vertices=visual.vertices / unit_m + move)


ALIKE = 0.25
"""Colours whose channels, brightness aside, lie this near to a surface's main colour belong to what is tinted."""


def _digest(name: str) -> str:
    return hashlib.sha256(f"interactive-nav generated CAD {name} 1".encode()).hexdigest()


def _tinted(model: CadModel, tint: str) -> CadModel:
    """Return a model whose main material, or main colour of its texture, is another material; it is another model."""
    name = f"{model.name}~{tint}"
    if model.look is None:
        area = dict.fromkeys((part.material for part in model.parts), 0.0)
        for part in model.parts:
            area[part.material] += float(np.linalg.norm(face_vectors(part.vertices, part.faces), axis=1).sum())
        main = max(area, key=lambda material: area[material])
        parts = tuple(dataclasses.replace(p, material=tint if p.material == main else p.material) for p in model.parts)
        return dataclasses.replace(model, name=name, id_cad=_digest(name)[:32], parts=parts)
    look = functools.partial(_repainted, model, np.array(MATERIALS[tint]))
    return dataclasses.replace(model, name=name, id_cad=_digest(name)[:32], look=look)


def _filled(model: CadModel, name: str) -> VisualMesh:
    """Return the surface of a model that is empty, with what the packaged model `name` holds."""
    surface = model.surface
    assert surface is not None
    move = surface.vertices.min(axis=0) - read_meshes(name)[0].vertices.min(axis=0) / model.unit_m
    return holding(surface, drawn_parts(LOOKS.holds[name]), model.unit_m, move)


def _repainted(model: CadModel, colour: np.ndarray) -> VisualMesh:
    surface = model.surface
    assert surface is not None
    return dataclasses.replace(surface, image=_painted(surface, colour, model.category in CLOTH))


def _painted(surface: VisualMesh, colour: np.ndarray, vivid: bool = False) -> np.ndarray:
    """Return a surface's image with its main colour, or a `vivid` one, turned in all shades into another (3,)."""
    area = np.linalg.norm(face_vectors(surface.vertices, surface.faces), axis=1)
    shown, of = np.unique(texels(surface.image, surface.uv[surface.uv_faces].mean(axis=1)), axis=0, return_inverse=True)
    shown, weight = shown / 255, np.bincount(of.ravel(), area)
    near = np.linalg.norm(shown[:, None] - shown, axis=2) < ALIKE
    near = near[np.argmax(near @ (weight * (0.25 + np.ptp(shown, axis=1) if vivid else 1.0)))]
    main = np.average(shown[near], axis=0, weights=weight[near])
    pixels = surface.image / 255
    bright, usual = pixels.mean(axis=2, keepdims=True), main.mean()
    shade = (bright - usual) / max(usual, 1 - usual)
    painted = np.where(shade < 0, colour * (1 + shade), colour + (1 - colour) * shade)
    off = np.linalg.norm(pixels - bright - (main - usual), axis=2, keepdims=True) + 0.4 * np.abs(bright - usual)
    share = np.clip(2 - 2 * off / ALIKE, 0, 1)
    return np.rint(255 * (share * painted + (1 - share) * pixels)).astype(np.uint8)


def tints(name: str) -> tuple[str, ...]:
    """Return a model of `LIBRARY` as it is and in all its tints."""
    return (name, *(f"{name}~{tint}" for tint in LOOKS.tints.get(LIBRARY[name].category, ())))


class Models:
    """Draw CAD models that a home may use, the least drawn first. Mutable, private to one home."""

    def __init__(self, names: tuple[str, ...], jitter: float):
        """Take keys of `LIBRARY`, which come in all tints, each scaled per axis by up to a fraction."""
        self._jitter, self._drawn = jitter, Counter[str]()
        self._fitted: dict[str, str] = {}
        self.spent: Set[str] = frozenset()
        """Models that are not drawn any more."""
        self._models: dict[tuple[str, str], list[str]] = {}
        for name in names:
            self._models.setdefault((LIBRARY[name].category, LIBRARY[name].role), []).extend(tints(name))

    def _left(self, category: str, role: str) -> list[str]:
        return [name for name in self._models.get((category, role), ()) if name not in self.spent]

    def has(self, category: str, role: str = "") -> bool:
        """Return whether there is a model of it."""
        return bool(self._left(category, role))

    def draw(self, category: str, rng: np.random.Generator, role: str = "") -> tuple[CadModel, np.ndarray]:
        """Draw a model of a category and its scale (CAD units -> metres)."""
        names = self._left(category, role)
        fitted = self._fitted.get(FITTED.get(category, ""))
        names = [name for name in names if name.partition("~")[2] == fitted] or names
        worn = {name: (self._drawn[name.partition("~")[0] + "~"], self._drawn[name]) for name in names}
        names = [name for name in names if worn[name] == min(worn.values())]
        model = cad_model(names[rng.integers(len(names))])
        plain, _, tint = model.name.partition("~")
        self._drawn.update((plain + "~", model.name))
        if category in FITTED:
            self._fitted[FITTED[category]] = tint
        return model, model.unit_m * (1 + rng.uniform(-self._jitter, self._jitter, 3))


@dataclasses.dataclass(frozen=True)
class Instance:
    """Place one piece of furniture: scan x, y; heights above the floor; metres."""

    model: CadModel
    scale: np.ndarray
    """(3,) CAD units -> metres along the CAD's x, y, z."""
    yaw_rad: float
    """About the vertical; at 0 the CAD's +z shows along -y of the scan frame."""
    position: np.ndarray
    """(3,) of the CAD origin; z above the floor."""
    hinge: ScannedHinge | None = None
    """What a door leaf or front opens on, CAD frame; a slide's range is in m nevertheless."""

    @functools.cached_property
    def matrix(self) -> np.ndarray:
        """Return (4, 4) CAD frame (y up) -> scan x, y and height above the floor (z up)."""
        return transform(yaw_matrix(self.yaw_rad) @ Y_UP_TO_Z_UP @ np.diag(self.scale), self.position)

    def to_floor(self, points_cad: np.ndarray) -> np.ndarray:
        """Move (n, 3) points of the CAD frame into scan x, y and height above the floor."""
        return transformed(points_cad, self.matrix)

    @functools.cached_property
    def footprint(self) -> shapely.Polygon:
        """Return the rectangle that it stands on."""
        (x0, _, z0), (x1, _, z1) = self.model.bounds
        return shapely.Polygon(self.to_floor(np.array([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]]))[:, :2])

    @functools.cached_property
    def slabs(self) -> list[tuple[shapely.Geometry, float, float]]:
        """Return the outline from above, the lowest and the highest point of each of its convex parts."""
        placed = [self.to_floor(part.vertices) for part in self.model.parts]
        return [(shapely.MultiPoint(p[:, :2]).convex_hull, p[:, 2].min(), p[:, 2].max()) for p in placed]

    def outlines(self, band_m: tuple[float, float] = (-math.inf, math.inf)) -> list[shapely.Geometry]:
        """Return the outlines of the parts that reach into a band of heights."""
        return [outline for outline, low, high in self.slabs if low < band_m[1] and high > band_m[0]]


def stand_at(
    model: CadModel, scale: np.ndarray, yaw_rad: float, point_cad: np.ndarray, xy: np.ndarray, lift_m: float
) -> Instance:
    """Stand a model so that a point of its CAD frame is above `xy`, and its lowest point `lift_m` above the floor."""
    yaw = math.atan2(math.sin(yaw_rad), math.cos(yaw_rad))
    x, y, _ = Instance(model, scale, yaw, np.zeros(3)).to_floor(point_cad[None])[0]
    return Instance(model, scale, yaw, np.array([xy[0] - x, xy[1] - y, lift_m - scale[1] * model.bounds[0, 1]]))


def place(model: CadModel, scale: np.ndarray, xy: np.ndarray, facing_rad: float, lift_m: float = 0.0) -> Instance:
    """Stand a model on the floor: centre of the footprint at `xy`, front towards `facing_rad` (from +x)."""
    return stand_at(model, scale, facing_rad + math.pi / 2, model.center, xy, lift_m)
