"""Define what readers fill and stages take: scan, CAD library, annotations and drawn surfaces.

Frames: *scan frame* = the scan's, z up, floor anywhere; *CAD frame* = the library's model turned to z up, not scaled;
*world frame* (`_w`) = scan frame with the floor at z = 0; *body frame* (`_b`) = a placed object's.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from converters.records.errors import SceneRejected
from interactive_nav_common.jobs.cache import NOT_HASHED
from interactive_nav_common.rotations import transform, transformed
from scenes_mjcf.categories import TABLE

ATTRIBUTION = "ATTRIBUTION.md"
"""Credits of the models in a source, and in its scene."""
SYNSETS = {category.synset: category.name for category in TABLE if category.synset}
"""ShapeNet synset -> category."""


def category_of_id(synset: str, where: str, classes: Mapping[str, str] = SYNSETS) -> str:
    """Return the category of a synset; `where` begins the error about an unknown one."""
    if synset not in classes:
        known = ", ".join(f"{k} ({v})" for k, v in sorted(classes.items()))
        raise SceneRejected(f"{where} {synset}, expected one of {known}")
    return classes[synset]


# NYU40 ids used by the stages (Gupta et al. 2013, the 40-class mapping that ScanNet labels with).
UNLABELLED, WALL, FLOOR, CEILING, WINDOW, DOOR = 0, 1, 2, 22, 9, 8
OTHER_PROP = 40
"""NYU40 id of small objects; where a structure without furniture has them, they stand on it, in no robot's way."""
STRUCTURE_LABELS = (WALL, FLOOR, DOOR, WINDOW, 11, 13, 16, 19, CEILING, 28, 30, 38)
"""Wall, floor, door, window, picture, blinds, curtain, mirror, ceiling, shower curtain, whiteboard, otherstructure."""
SMALL_LABELS = (UNLABELLED, 18, 20, 21, 23, 26, 27, 29, 35, 37, 40)
"""Unlabelled, pillow, mat, clothes, books, paper, towel, box, lamp, bag, otherprop: may lie on furniture."""
CATEGORY_LABELS = {category.name: category.labels for category in TABLE if category.labels}
"""Category -> NYU40 ids."""


class ColourCloud(NamedTuple):
    """Coloured points of a surface."""

    points: np.ndarray
    """(n, 3) m."""
    normals: np.ndarray
    """(n, 3) unit, or zero where unknown."""
    colours: np.ndarray
    """(n, 3) float64, 0 to 255."""


@dataclasses.dataclass(frozen=True)
class TexturedMesh:
    """A mesh with at most one image."""

    vertices: np.ndarray
    """(n, 3) float64, m."""
    faces: np.ndarray
    """(m, 3) int64."""
    corner_uv: np.ndarray | None = None
    """(m, 3, 2) float64, origin at the lower left, or None without an image."""
    texture: np.ndarray | None = None
    """(h, w, 3) uint8, or None."""


@dataclasses.dataclass(frozen=True)
class VisualMesh:
    """A mesh with separately indexed texture coordinates."""

    vertices: np.ndarray
    """(n, 3) m."""
    faces: np.ndarray
    """(m, 3) into `vertices`."""
    uv: np.ndarray
    """(k, 2) in [0, 1], origin at the lower left."""
    uv_faces: np.ndarray
    """(m, 3) into `uv`."""
    image: np.ndarray
    """(h, w, 3) uint8, first row at the top."""
    exact: bool = False
    """The image is the source's, and is written as it is."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScanMesh(TexturedMesh):
    """A mesh with semantic labels, and colours of its vertices where it has no texture."""

    labels: np.ndarray
    """(n,) int64, NYU40 id of each vertex; 0 is unlabelled."""
    vertex_colours: np.ndarray | None = None
    """(n, 3) uint8, or None where the scan has a texture."""
    furnished: bool = True
    """False: it shows the structure alone, so that no face of it is an annotated object's."""


@dataclasses.dataclass(frozen=True)
class CadModel:
    """One model of the CAD library, in the CAD frame."""

    category: str
    cad_id: str
    vertices: np.ndarray
    """(n, 3) float64, z up, unscaled."""
    faces: np.ndarray
    """(m, 3) int64."""
    face_colours: np.ndarray
    """(m, 3) uint8: diffuse colour of the material, or of the texture at the face."""
    pieces: tuple[tuple[np.ndarray, np.ndarray], ...] | None = None
    """Convex pieces (vertices (n, 3), faces (m, 3)) that came with the model; None: they are to be computed."""
    mass_kg: float | None = None
    """The source's mass; None: density times volume."""
    friction: float | None = None
    """The source's sliding coefficient; None: the category's."""
    surface: TexturedMesh | None = None
    """What it looks like, CAD frame; None: nothing but the colours of the faces."""


UP = np.array([0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True)
class ScannedHinge:
    """A hinge, or a slide, in the frame of what hangs on it; 0 is the pose as scanned."""

    origin: np.ndarray
    """(3,) a point on the axis."""
    axis: np.ndarray
    """(3,) unit, about which it turns or along which it slides."""
    range_rad: tuple[float, float]
    """Or m, of a slide."""
    assumed: bool = False
    """True when the source had no articulation and a hinge at one edge was taken."""
    slides: bool = False

    def moved(self, matrix: np.ndarray) -> "ScannedHinge":
        """Return it in another frame, which a (4, 4) matrix leads to; a mirror turns hinges the other way round."""
        axis = matrix[:3, :3] @ self.axis
        length = float(np.linalg.norm(axis))
        grows, side = (length, 1.0) if self.slides else (1.0, np.sign(np.linalg.det(matrix[:3, :3])))
        span, origin = (self.range_rad[0] * grows, self.range_rad[1] * grows), transformed(self.origin[None], matrix)[0]
        return dataclasses.replace(self, origin=origin, axis=side * axis / length, range_rad=span)

    def motion(self, value: float) -> np.ndarray:
        """Return the (4, 4) of what hangs on it from 0 to a value."""
        turn = np.eye(3) if self.slides else Rotation.from_rotvec(value * self.axis).as_matrix()
        return transform(turn, value * self.axis if self.slides else self.origin - turn @ self.origin)

    def value(self, motion: np.ndarray) -> float:
        """Return how far a (4, 4) opens it."""
        return float(self.axis @ (motion[:3, 3] if self.slides else Rotation.from_matrix(motion[:3, :3]).as_rotvec()))


@dataclasses.dataclass(frozen=True)
class Annotation:
    """One annotated object: which model, where, and the keypoint pairs that it was fitted to."""

    category: str
    cad_id: str
    pose: np.ndarray
    """(4, 4) CAD frame -> scan frame, with scale."""
    symmetry: str = "__SYM_NONE"
    """Scan2CAD's `sym` word."""
    keypoints_cad: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """(k, 3) CAD frame."""
    keypoints_scan: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """(k, 3) scan frame, m."""
    hinge: ScannedHinge | None = None
    confidence: float | None = None
    """Of a model that was retrieved and fitted; None: somebody put it there."""


@dataclasses.dataclass(frozen=True)
class GivenMap:
    """A traversable map that came with the scan, in the scan frame."""

    traversable: np.ndarray
    """[rows along y, columns along x] bool."""
    resolution_m: float
    origin: tuple[float, float]
    """x, y of the outer corner of cell [0, 0]."""


@dataclasses.dataclass(frozen=True)
class Storey:
    """One floor of a building with several."""

    height_m: float
    """Of its floor, scan frame."""
    given_map: GivenMap | None


@dataclasses.dataclass(frozen=True)
class Lamp:
    """A lamp that shines to all sides."""

    at: np.ndarray
    """(3,) scan frame, m."""
    colour: np.ndarray
    """(3,) in [0, 1], times its power."""


WINDOWS = "windows.txt"
"""Of a folder in Gibson's layout: the boxes that windows fill."""


@dataclasses.dataclass(frozen=True)
class Window:
    """A box that a window's opening fills."""

    middle: np.ndarray
    """(3,) scan frame, m."""
    half: np.ndarray
    """(3,) along the wall, across it and up, m."""
    yaw: float
    """Of the wall, rad."""


@dataclasses.dataclass(frozen=True)
class RawScene:
    """Everything that a reader hands to the pipeline."""

    name: str = dataclasses.field(metadata=NOT_HASHED)
    source_format: str = dataclasses.field(metadata=NOT_HASHED)
    scan: ScanMesh
    licence: str = dataclasses.field(metadata=NOT_HASHED)
    sources: dict[str, str] = dataclasses.field(metadata=NOT_HASHED)
    """Path relative to the source folder -> sha256."""
    cads: dict[str, CadModel] = dataclasses.field(default_factory=dict)
    """By `cad_id`."""
    annotations: tuple[Annotation, ...] = ()
    floor_height_m: float | None = None
    """Of the scan frame, the lowest of several; None: the pipeline finds it from the floor labels."""
    given_map: GivenMap | None = None
    storeys: tuple[Storey, ...] = dataclasses.field(default=(), metadata=NOT_HASHED)
    """From the lowest up, where there are several; `converters.read.surfaces.split_storeys` takes them apart."""
    picture: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    """Vertices (n, 3) and faces (m, 3) of the parts that a modelled structure is drawn with, in place of the scan."""
    lamps: tuple[Lamp, ...] = ()
    windows: tuple[Window, ...] = ()
    """Where the source says so."""
    warnings: tuple[str, ...] = dataclasses.field(default=(), metadata=NOT_HASHED)
    """What the reader repaired or missed, for scene.json."""
    attribution: str = dataclasses.field(default="", metadata=NOT_HASHED)
    """Whose the models are, for a file beside it; empty: there is none."""


FAR_M = 100.0
"""Coordinates beyond this lose accuracy in files and in single precision."""


def at_origin(raw: RawScene) -> RawScene:
    """Return the scene with its middle at x = y = 0, whole metres moved, if it reaches beyond `FAR_M`; heights stay."""
    vertices = raw.scan.vertices[np.unique(raw.scan.faces)][:, :2]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if max(-low.min(), high.max()) <= FAR_M:
        return raw
    x, y = np.round((low + high) / 2)
    by = np.array([x, y, 0.0])

    def moved_map(given: GivenMap | None) -> GivenMap | None:
        return given and dataclasses.replace(given, origin=(given.origin[0] - float(x), given.origin[1] - float(y)))

    shift = transform(np.eye(3), -by)
    return dataclasses.replace(
        raw,
        scan=dataclasses.replace(raw.scan, vertices=raw.scan.vertices - by),
        annotations=tuple(
            dataclasses.replace(a, pose=shift @ a.pose, keypoints_scan=a.keypoints_scan - by) for a in raw.annotations
        ),
        given_map=moved_map(raw.given_map),
        storeys=tuple(dataclasses.replace(s, given_map=moved_map(s.given_map)) for s in raw.storeys),
        picture=tuple((points - by, faces) for points, faces in raw.picture),
        lamps=tuple(dataclasses.replace(lamp, at=lamp.at - by) for lamp in raw.lamps),
        windows=tuple(dataclasses.replace(window, middle=window.middle - by) for window in raw.windows),
        warnings=(
            *raw.warnings,
            f"moved by ({-x:.0f}, {-y:.0f}) m to the origin; add ({x:.0f}, {y:.0f}) m to return to the source's frame",
        ),
    )
