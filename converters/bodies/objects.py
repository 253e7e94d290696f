"""Build `PlacedObject` records of CAD models, hulls and upright poses, and their masses and friction."""

import collections
import dataclasses
import itertools
import math

import numpy as np
import shapely
import trimesh

from converters.bodies.alignment import Alignment
from converters.geometry.boxes import MAX_PIECES, Hull, OrientedBox, convex_hull, fit_box
from converters.records.raw import Annotation, CadModel, TexturedMesh
from interactive_nav_common.rotations import matrix_from_quat, yaw_matrix
from scenes_mjcf.categories import TABLE

FOOT_M = 0.02
ROUND_FILL = 0.9
"""Outlines that fill less of their smallest box are round: that box then stands along the walls."""
MATERIALS = {category.name: category.material for category in TABLE if category.material is not None}


@dataclasses.dataclass(frozen=True)
class BodyHinge:
    """A vertical hinge in the body frame."""

    origin_b: np.ndarray
    """(3,) m."""
    range_rad: tuple[float, float]
    """Counter-clockwise from above; 0 is the pose as scanned."""
    assumed: bool


@dataclasses.dataclass(frozen=True)
class PlacedObject:
    """One movable object. Body frame: origin at the middle of the base, z up."""

    name: str
    category: str
    cad_id: str
    vertices_b: np.ndarray
    """(n, 3) CAD surface, scaled, m."""
    faces: np.ndarray
    face_colours: np.ndarray
    hulls_b: tuple[Hull, ...]
    boxes_b: tuple[OrientedBox, ...] = ()
    """The oriented box of each hull, same order."""
    position_w: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    """(3,) m."""
    quaternion_w: np.ndarray = dataclasses.field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    """(4,) w x y z."""
    hinge: BodyHinge | None = None
    surface_b: TexturedMesh | None = None
    """What the model looks like, where it has more than the colours of its faces."""


def to_world(placed: PlacedObject, points_b: np.ndarray) -> np.ndarray:
    """Move (n, 3) points from the body frame to the world."""
    return points_b @ matrix_from_quat(placed.quaternion_w).T + placed.position_w


def flatten_feet(hull: Hull) -> Hull:
    """Cut a hull at the body frame's z = 0 and bring what ends within `FOOT_M` above it down to it.

    Decomposition works on voxels: hulls stand out of the model by some millimetres and feet come out of
    unequal length; the object would rest tilted on its hulls and upright on its boxes.
    """
    points = hull.vertices * [1.0, 1.0, 1.0]
    points[:, 2] = np.maximum(points[:, 2], 0.0)
    feet = points[points[:, 2] < FOOT_M] * [1.0, 1.0, 0.0]
    return convex_hull(np.vstack([points, feet]))


def with_feet(hulls: tuple[Hull, ...], vertices: np.ndarray) -> tuple[Hull, ...]:
    """Add a low hull for each foot that no hull has: voxels lose legs of open surfaces, and the object would tip."""
    stands = [h.vertices[h.vertices[:, 2] < FOOT_M, :2] for h in hulls]
    covered = shapely.union_all([shapely.MultiPoint(p).convex_hull for p in stands if len(p)])
    base = vertices[vertices[:, 2] < FOOT_M, :2]
    lost = base[shapely.distance(shapely.points(base), covered) > FOOT_M] if not covered.is_empty else base[:0]
    columns = (
        shapely.get_parts(shapely.union_all(shapely.buffer(shapely.points(lost), 2 * FOOT_M))) if len(lost) else []
    )
    feet = []
    for column in columns:
        inside = vertices[shapely.contains_xy(column, *vertices[:, :2].T) & (vertices[:, 2] < 5 * FOOT_M)]
        level = inside * [1.0, 1.0, 0.0]
        feet.append(convex_hull(np.vstack([inside, level, level + [0.0, 0.0, FOOT_M]])))
    return (*hulls, *feet) if len(hulls) + len(feet) <= MAX_PIECES else hulls


def _door_hinge(annotation: Annotation, scale: np.ndarray, base_cad: np.ndarray, extent: np.ndarray) -> BodyHinge:
    """Return the door's hinge in the body frame; without an articulation, assume one at the leaf's edge."""
    hinge = annotation.hinge
    if hinge is None:
        along = int(np.argmax(extent[:2]))
        origin = np.zeros(3)
        origin[along] = -extent[along] / 2
        return BodyHinge(origin, (-math.pi / 2, math.pi / 2), True)
    low, high = sorted(hinge.sign * v for v in hinge.range_rad)
    origin = scale * hinge.origin - base_cad
    origin[2] = 0.0
    return BodyHinge(origin, (low, high), hinge.assumed)


def place_object(
    name: str,
    annotation: Annotation,
    cad: CadModel,
    hulls_cad: tuple[Hull, ...],
    pose: Alignment,
    floor_height_m: float,
    walls_yaw: float,
) -> PlacedObject:
    """Scale a CAD model and its hulls, move the origin to the middle of the base and state the world pose.

    The world's z is the scan's less `floor_height_m`; `walls_yaw` is the main direction of the building, rad.
    """
    vertices, look = cad.vertices * pose.scale, cad.surface
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    hulls = tuple(convex_hull(h.vertices * pose.scale - base) for h in hulls_cad)
    hulls = tuple(flatten_feet(h) for h in hulls)
    if cad.pieces is None and annotation.category != "door":
        hulls = with_feet(hulls, vertices - base)
    # Exact pieces have exact boxes; coacd's hulls are rough, and stored scenes have theirs along the walls.
    round_fill = 1.0 if cad.pieces is None else ROUND_FILL
    position = yaw_matrix(pose.yaw) @ base + pose.translation
    position[2] -= floor_height_m
    return PlacedObject(
        name=name,
        category=annotation.category,
        cad_id=annotation.cad_id,
        vertices_b=vertices - base,
        faces=cad.faces,
        face_colours=cad.face_colours,
        hulls_b=hulls,
        boxes_b=tuple(fit_box(h, 0.0, walls_yaw - pose.yaw, round_fill) for h in hulls),
        position_w=position,
        quaternion_w=np.array([math.cos(pose.yaw / 2), 0.0, 0.0, math.sin(pose.yaw / 2)]),
        hinge=_door_hinge(annotation, pose.scale, base, high - low) if annotation.category == "door" else None,
        surface_b=None if look is None else dataclasses.replace(look, vertices=look.vertices * pose.scale - base),
    )


def name_objects(annotations: tuple[Annotation, ...]) -> tuple[str, ...]:
    """Return body names `<category>_<k>`, k counting from 0 inside its category in the annotation's order."""
    count = collections.defaultdict(itertools.count)
    return tuple(f"{a.category}_{next(count[a.category])}" for a in annotations)


@dataclasses.dataclass(frozen=True)
class Physical:
    """Rigid-body properties in the body frame."""

    mass_kg: float
    com_b: np.ndarray
    """(3,) m."""
    inertia_b: np.ndarray
    """(3, 3) kg m2 about the centre of mass, along the body's axes."""
    friction: float
    volume_m3: float


def mass_moments(hulls: tuple[Hull, ...]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return summed volume, m3, centre of mass (3,), m, and inertia (3, 3) about it at unit density, of hulls."""
    volumes, centres, inertias = [], [], []
    for hull in hulls:
        properties = trimesh.triangles.mass_properties(hull.vertices[hull.faces])
        volumes.append(abs(float(properties.volume)))
        centres.append(np.asarray(properties.center_mass, float))
        inertias.append(np.asarray(properties.inertia, float))  # about the hull's centre, unit density
    com = np.average(centres, axis=0, weights=volumes)
    inertia = np.zeros((3, 3))
    for v, centre, about_centre in zip(volumes, centres, inertias, strict=True):
        r = centre - com
        inertia += about_centre + v * (r @ r * np.eye(3) - np.outer(r, r))  # parallel axes
    return float(sum(volumes)), com, inertia


def physical_properties(
    category: str, hulls: tuple[Hull, ...], mass_kg: float | None = None, friction: float | None = None
) -> Physical:
    """Return mass, moments (body frame, m, kg) and friction; moments scale with the mass.

    The mass is density x summed hull volume, clipped to the category's range, unless the source gives one.
    """
    material = MATERIALS[category]
    volume, com, inertia = mass_moments(hulls)
    usual = float(np.clip(material.density_kg_m3 * volume, *material.mass_range_kg))
    mass = usual if mass_kg is None else mass_kg
    friction = material.friction if friction is None else friction
    return Physical(mass, com, inertia * usual / volume * (mass / usual), friction, volume)
