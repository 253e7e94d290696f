"""Build the small objects of each episode from parametric boxes with real-world masses (kg) and sizes (m).

The four kinds are the paper's (section IV): baskets, shoes, pots, toys. The original's meshes are not public with
textures; ours are unions of boxes with visual primitives. Models of a kind have equal numbers of boxes, so that a batch
may mix them. `NavConfig.objects` names folders of `python -m converters object` to use instead.
"""

import dataclasses
import hashlib
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from interactive_nav.scenes.scene import Movable, body_task_parts, hull_sources, read_movable
from interactive_nav_common.config import Positive
from interactive_nav_common.errors import readable
from interactive_nav_common.files import check_name
from interactive_nav_common.records import Reader
from interactive_nav_common.untrusted.reading import check_named
from scenes_mjcf.categories import MaskClasses, class_id
from scenes_mjcf.schema import CATEGORIES, SceneError

Rgba = tuple[float, float, float, float]
Size = tuple[float, float, float]
KINDS = ("basket", "shoe", "pot", "toy", "shoe", "basket", "toy", "pot")
"""Kinds in the order in which `pick` deals them: ten are 3 baskets, 3 shoes, 2 pots, 2 toys."""
VISUAL_GROUP = 2
LEVEL = (1.0, 0.0, 0.0, 0.0)
"""Quaternion w x y z of what is not turned."""
_GREY, _GLASS = (0.6, 0.6, 0.6, 1.0), (0.75, 0.85, 0.92, 1.0)


@dataclasses.dataclass(frozen=True)
class Box:
    """A box of an object, in the object's frame (origin on the floor, z up)."""

    centre_m: tuple[float, float, float]
    half_m: tuple[float, float, float]
    quat: tuple[float, float, float, float] = LEVEL

    @property
    def corners_m(self) -> list[tuple[float, float, float]]:
        """Return its eight corners, in the object's frame."""
        corner, corners = np.zeros(3), []
        for signs in itertools.product((-1, 1), repeat=3):
            corner_m = [s * h for s, h in zip(signs, self.half_m, strict=True)]
            mujoco.mju_rotVecQuat(corner, np.array(corner_m), np.array(self.quat))
            x, y, z = (c + float(v) for c, v in zip(self.centre_m, corner, strict=True))
            corners.append((x, y, z))
        return corners


@dataclasses.dataclass(frozen=True)
class Shape:
    """A primitive to look at, in the object's frame; it never collides and weighs nothing."""

    kind: str
    """box, cylinder, capsule or ellipsoid."""
    centre_m: tuple[float, float, float]
    size_m: tuple[float, ...]
    """As MuJoCo's geom size: half sizes; (radius, half length) of cylinders and capsules."""
    rgba: Rgba
    axis: str = "z"
    """Axis of a cylinder or capsule: x, y or z."""


Parts = tuple[tuple[Box, ...], list[Shape]]
"""What of an object collides, and what it looks like."""


@dataclasses.dataclass(frozen=True)
class SmallObject:
    """A movable small object."""

    name: str
    category: str
    segmentation_id: int
    """Class in the segmentation image (reference benchmark, section 1.4)."""
    mass_kg: float
    friction: float
    boxes: tuple[Box, ...]
    rgba: Rgba
    """Its main colour."""
    shapes: tuple[Shape, ...]

    def mask_id(self, classes: MaskClasses) -> int:
        """Return its class where the setting `segmentation_classes` is this: its model's, or its category's."""
        return class_id(self.category, classes) if classes == "all" else self.segmentation_id

    @property
    def task_parts(self) -> tuple:
        """Return what of it decides a task, to be hashed: its looks are not in it."""
        boxes = [dataclasses.astuple(box) for box in self.boxes]
        return self.category, self.segmentation_id, self.mass_kg, self.friction, boxes

    @property
    def radius_m(self) -> float:
        """Return the radius of the disc about the origin that holds the object's footprint."""
        return max(math.hypot(x, y) for b in self.boxes for x, y, _ in b.corners_m)

    @property
    def height_m(self) -> float:
        """Return the top of the boxes above the floor."""
        return max(z for b in self.boxes for _, _, z in b.corners_m)

    @property
    def rows(self) -> np.ndarray:
        """Return [n, 10] of its boxes: centre (3), quaternion (4), half sizes (3)."""
        return np.asarray([[*b.centre_m, *b.quat, *b.half_m] for b in self.boxes], float)


def _darker(colour: Rgba, factor: float = 0.65) -> Rgba:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor, 1.0


def _basket(colour: Rgba, width: float, depth: float, height: float, bands: int = 0) -> Parts:
    wall = 0.012
    w, d, h = width / 2, depth / 2, height / 2
    boxes = (
        Box((0, 0, wall / 2), (w, d, wall / 2)),
        Box((w - wall / 2, 0, h), (wall / 2, d, h)),
        Box((-w + wall / 2, 0, h), (wall / 2, d, h)),
        Box((0, d - wall / 2, h), (w, wall / 2, h)),
        Box((0, -d + wall / 2, h), (w, wall / 2, h)),
    )
    dark = _darker(colour)
    shapes = [Shape("box", b.centre_m, b.half_m, colour) for b in boxes]
    # A rim and, on woven ones, bands round the walls; the grips stand above the short sides.
    for z, radius in [(height - 0.008, 0.011)] + [(height * (i + 1) / (bands + 1), 0.006) for i in range(bands)]:
        for side in (-1, 1):
            shapes.append(Shape("capsule", (side * (w - 0.005), 0, z), (radius, d - 0.01), dark, "y"))
            shapes.append(Shape("capsule", (0, side * (d - 0.005), z), (radius, w - 0.01), dark, "x"))
    for side in (-1, 1):
        shapes.append(Shape("capsule", (side * (w - 0.008), 0, height + 0.02), (0.008, 0.35 * d), dark, "y"))
    return boxes, shapes


def _shoe(colour: Rgba, length: float, width: float, upper: float = 0.05, sole: Rgba = (0.9, 0.9, 0.88, 1.0)) -> Parts:
    boxes = (
        Box((0, 0, 0.025), (length / 2, width / 2, 0.025)),
        Box((-0.22 * length, 0, round(0.05 + upper / 2, 4)), (0.28 * length, 0.42 * width, upper / 2)),
    )
    top, inside = 0.05 + upper, _darker(colour, 0.3)
    return boxes, [
        Shape("box", (0, 0, 0.010), (0.40 * length, 0.46 * width, 0.010), sole),
        Shape("cylinder", (0.36 * length, 0, 0.010), (0.46 * width, 0.010), sole),
        Shape("cylinder", (-0.38 * length, 0, 0.010), (0.42 * width, 0.010), sole),
        Shape("ellipsoid", (0.20 * length, 0, 0.034), (0.29 * length, 0.46 * width, 0.032), colour),
        Shape("ellipsoid", (-0.22 * length, 0, 0.5 * top), (0.27 * length, 0.43 * width, 0.5 * top), colour),
        Shape("ellipsoid", (-0.25 * length, 0, top - 0.012), (0.17 * length, 0.27 * width, 0.014), inside),
        Shape("capsule", (0.06 * length, 0, 0.058), (0.004, 0.22 * width), sole, "y"),
        Shape("capsule", (0.12 * length, 0, 0.054), (0.004, 0.24 * width), sole, "y"),
    ]


def _pot(colour: Rgba, width: float, height: float, planted: bool = False) -> Parts:
    # An octagonal prism from two boxes turned against each other would need a quaternion; a plus of two
    # boxes keeps the frame and is 8 % smaller in area than the disc.
    r = width / 2
    boxes = (
        Box((0, 0, height / 2), (r * 0.92, r * 0.55, height / 2)),
        Box((0, 0, height / 2), (r * 0.55, r * 0.92, height / 2)),
    )
    dark, green = _darker(colour), (0.25, 0.50, 0.20, 1.0)
    body = Shape("cylinder", (0, 0, height / 2), (0.92 * r, height / 2), colour)
    if planted:
        return boxes, [
            body,
            Shape("cylinder", (0, 0, height - 0.012), (0.97 * r, 0.012), dark),
            Shape("ellipsoid", (0, 0, height + 0.05), (0.75 * r, 0.75 * r, 0.07), green),
            Shape("ellipsoid", (0.3 * r, 0.2 * r, height + 0.10), (0.4 * r, 0.4 * r, 0.06), _darker(green, 1.2)),
        ]
    return boxes, [
        body,
        Shape("cylinder", (0, 0, height + 0.004), (0.95 * r, 0.006), dark),
        Shape("ellipsoid", (0, 0, height + 0.022), (0.016, 0.016, 0.014), dark),
        Shape("capsule", (0.96 * r, 0, 0.8 * height), (0.009, 0.25 * r), dark, "y"),
        Shape("capsule", (-0.96 * r, 0, 0.8 * height), (0.009, 0.25 * r), dark, "y"),
    ]


def _toy(colour: Rgba, length: float, width: float, cab: Size = (0.05, 0.20, 0.035), accent: Rgba = _GLASS) -> Parts:
    """Build a vehicle; `cab` is the cab's centre and half length as shares of the length, and its half height in m."""
    boxes = (
        Box((0, 0, 0.04), (length / 2, width / 2, 0.04)),
        Box((cab[0] * length, 0, round(0.08 + cab[2], 4)), (cab[1] * length, 0.4 * width, cab[2])),
    )
    roof_m = cab[0] * length, 0, 0.08 + 2 * cab[2] - 0.006
    shapes = [
        Shape("box", (0, 0, 0.052), (length / 2, 0.42 * width, 0.028), colour),
        Shape("box", boxes[1].centre_m, boxes[1].half_m, accent),
        Shape("box", roof_m, (cab[1] * length + 0.004, 0.41 * width, 0.007), colour),
    ]
    for x, side in itertools.product((-0.30, 0.30), (-1, 1)):
        wheel_m, tyre = (x * length, side * 0.43 * width, 0.030), (0.10, 0.10, 0.11, 1.0)
        shapes.append(Shape("cylinder", wheel_m, (0.030, 0.07 * width), tyre, "y"))
    return boxes, shapes


_BUILT = {"basket": (_basket, 0, 0.5), "shoe": (_shoe, 10, 0.7), "pot": (_pot, 7, 0.45), "toy": (_toy, 9, 0.4)}
"""Kind -> builder, segmentation id, friction."""


def _model(kind: str, name: str, mass: float, segmentation_id: int | None = None, **about: Any) -> SmallObject:
    build, number, friction = _BUILT[kind]
    about |= {key: (*about[key], 1.0) for key in ("colour", "sole", "accent") if key in about}
    boxes, shapes = build(**about)
    number = segmentation_id or number
    return SmallObject(name, kind, number, mass, friction, boxes, about["colour"], tuple(shapes))


_ROWS = yaml.safe_load((Path(__file__).parent / "small_objects.yaml").read_text())
MODELS: dict[str, dict[str, tuple[SmallObject, ...]]] = {
    split: {kind: tuple(_model(kind, **row) for row in rows) for kind, rows in kinds.items()}
    for split, kinds in _ROWS.items()
}
"""Split -> kind -> models; no model is in both splits."""


def pick(num_objects: int, split: str = "train") -> tuple[SmallObject, ...]:
    """Return a set of small objects: two models of each kind, repeated in turn.

    Slot i holds the same kind and number of boxes for every split. Ten objects are 3 baskets, 3 shoes, 2 pots, 2 toys.
    """
    places = (i % len(KINDS) for i in range(num_objects))
    return tuple(MODELS[split][KINDS[i]][KINDS[:i].count(KINDS[i])] for i in places)


_HALF = math.sqrt(0.5)
_TURN = {"z": (1.0, 0.0, 0.0, 0.0), "x": (_HALF, 0.0, _HALF, 0.0), "y": (_HALF, -_HALF, 0.0, 0.0)}


def body_names(objects: Sequence[SmallObject]) -> tuple[str, ...]:
    """Return the names of the bodies of small objects, wherever these stand in a model."""
    return tuple(f"{o.category}_small_{i}" for i, o in enumerate(objects))


def solid(friction: float, group: int = 3, density: float | None = None) -> dict[str, Any]:
    """Return what geoms that collide are alike in; without a density, kg/m3, they weigh nothing."""
    weight = {"mass": 0.0} if density is None else {"density": density}
    return {"friction": [friction, 0.005, 0.0001], "group": group, **weight}


def add_box(body: mujoco.MjsBody, row: np.ndarray, name: str, friction: float, density: float | None = None) -> None:
    """Add a box that collides to a body: its centre (3), quaternion (4) and half sizes (3)."""
    box = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name=name, type=box, pos=row[:3], quat=row[3:7], size=row[7:10], **solid(friction, density=density))


def add_boxes(body: mujoco.MjsBody, obj: SmallObject, name: str) -> None:
    """Add an object's boxes to its body, origin on the floor: they collide, and share its mass by volume."""
    volume = sum(8 * b.half_m[0] * b.half_m[1] * b.half_m[2] for b in obj.boxes)
    for i, row in enumerate(obj.rows):
        add_box(body, row, f"{name}_box_{i}", obj.friction, density=obj.mass_kg / volume)


def add_shapes(body: mujoco.MjsBody, obj: SmallObject, name: str) -> None:
    """Add an object's shapes to its body, origin on the floor: visuals, massless and without collision."""
    for i, shape in enumerate(obj.shapes):
        body.add_geom(
            name=f"{name}_visual_{i}",
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}"),
            pos=shape.centre_m,
            quat=_TURN[shape.axis],
            size=(*shape.size_m, 0.0, 0.0)[:3],
            rgba=shape.rgba,
            contype=0,
            conaffinity=0,
            mass=0.0,
            group=VISUAL_GROUP,
        )


@dataclasses.dataclass(frozen=True)
class _About:
    """What is required of object.json."""

    name: str
    category: str
    friction: Positive


_OBJECTS = Reader(SceneError, "expected a folder made by 'python -m converters object'")


@dataclasses.dataclass(frozen=True)
class ConvertedObject(SmallObject):
    """A small object from a folder; its boxes are those of `object.xml` as it stands at rest, lowest point at 0."""

    sha256: str
    """Of object.xml and the hulls."""
    movable: Movable = dataclasses.field(repr=False, compare=False)
    """Its body in the same frame: mass properties and hulls as converted."""
    hull_sources: list = dataclasses.field(repr=False, compare=False)
    """What its hulls come from."""

    @property
    def task_parts(self) -> tuple:
        return *super().task_parts, body_task_parts(self.movable, self.hull_sources)


def small_objects(num_objects: int, split: str, folders: Sequence[str]) -> tuple[SmallObject, ...]:
    """Return the small objects of an environment: the folders in turn where there are some, else the builtin ones."""
    if not folders:
        return pick(num_objects, split)
    models = [load_object(folder) for folder in folders]
    return tuple(models[i % len(models)] for i in range(num_objects))


def load_object(folder: str | Path) -> ConvertedObject:
    """Read and check a folder with `object.xml`, `object.json` and `assets/`."""
    folder = Path(folder)
    xml, described = folder / "object.xml", folder / "object.json"
    about = _OBJECTS.record(_OBJECTS.json(described), _About, str(described), others=True)
    category, friction = about.category, about.friction
    name = check_name(about.name, f"{described}: name", SceneError)
    check_named(xml, SceneError, _OBJECTS.remedy)
    with readable(xml, SceneError, _OBJECTS.remedy, " as MJCF"):
        hulls = sorted((folder / "assets").glob("*_hull_*.obj"))
        sha256 = hashlib.sha256(b"".join(p.read_bytes() for p in (xml, *hulls))).hexdigest()
        model = mujoco.MjModel.from_xml_path(str(xml))
    if category not in CATEGORIES:
        raise SceneError(f"{folder}: category is '{category}', expected one of {', '.join(CATEGORIES)}")
    movable = _standing(read_movable(model, xml, name, category, friction))
    rows = movable.boxes.tolist()
    boxes = tuple(Box(tuple(row[:3]), tuple(row[7:]), tuple(row[3:7])) for row in rows)  # type: ignore[arg-type]
    about_physics = movable, hull_sources(xml).get(name, [])
    return ConvertedObject(
        name, category, class_id(category), movable.mass_kg, friction, boxes, _GREY, (), sha256, *about_physics
    )


def _standing(movable: Movable) -> Movable:
    """Return the body as it stands at rest over the origin: its frame level, its boxes' lowest corner at z = 0."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, movable.quat_w)
    turn = turn.reshape(3, 3)

    def turned(quat: np.ndarray) -> np.ndarray:
        out = np.zeros(4)
        mujoco.mju_mulQuat(out, movable.quat_w, quat)
        return out

    boxes = np.asarray([[*(turn @ r[:3]), *turned(r[3:7]), *r[7:]] for r in movable.boxes])
    drop = np.array([0.0, 0.0, min(z for r in boxes for _, _, z in Box(r[:3], r[7:], r[3:7]).corners_m)])
    boxes[:, :3] -= drop
    return dataclasses.replace(
        movable,
        pos_w=np.zeros(3),
        quat_w=np.array([1.0, 0.0, 0.0, 0.0]),
        com_m=turn @ movable.com_m - drop,
        inertia_quat=turned(movable.inertia_quat),
        boxes=boxes,
        hulls=tuple(h @ turn.T - drop for h in movable.hulls),
    )
