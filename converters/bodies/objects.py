"""Place annotated objects upright as `PlacedObject`, with mass and friction; compare poses with re-solved ones."""

import collections
import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import shapely
import trimesh

from converters.bodies import alignment
from converters.bodies.alignment import Alignment
from converters.geometry.boxes import MAX_PIECES, Hull, OrientedBox, convex_hull, fit_box
from converters.records.raw import UP, Annotation, CadModel, RawScene, ScannedHinge, TexturedMesh
from interactive_nav_common.rotations import matrix_from_quat, transformed, wrap_angle, yaw_matrix
from scenes_mjcf.categories import TABLE

FOOT_M = 0.02
ROUND_FILL = 0.9
"""Outlines that fill less of their smallest box are round: that box then stands along the walls."""
MATERIALS = {category.name: category.material for category in TABLE if category.material is not None}


@dataclasses.dataclass(frozen=True)
class PlacedObject:
    """Describe one movable object. Body frame: origin at the middle of the base, z up."""

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
    hinge: ScannedHinge | None = None
    """Body frame."""
    surface_b: TexturedMesh | None = None
    """What the model looks like, where it has more than the colours of its faces."""


def to_world(placed: PlacedObject, points_b: np.ndarray) -> np.ndarray:
    """Move (n, 3) points from the body frame to the world."""
    return points_b @ matrix_from_quat(placed.quaternion_w).T + placed.position_w


def flatten_feet(hull: Hull) -> Hull:
    """Make a hull level at z = 0 (body frame): cut off what is below, and extend it down if it ends within `FOOT_M`."""
    points = np.maximum(hull.vertices, [-np.inf, -np.inf, 0.0])
    feet = points[points[:, 2] < FOOT_M] * [1.0, 1.0, 0.0]
    return convex_hull(np.vstack([points, feet]))


def with_feet(hulls: tuple[Hull, ...], vertices: np.ndarray) -> tuple[Hull, ...]:
    """Add a low hull for each foot that no hull has: voxels lose legs of open surfaces, and the object would tip."""
    stands = [h.vertices[h.vertices[:, 2] < FOOT_M, :2] for h in hulls]
    covered = shapely.union_all([shapely.MultiPoint(p).convex_hull for p in stands if len(p)])
    base = vertices[vertices[:, 2] < FOOT_M, :2]
    lost = base[shapely.distance(shapely.points(base), covered) > FOOT_M] if not covered.is_empty else base[:0]
    feet = []
    for column in shapely.get_parts(shapely.union_all(shapely.buffer(shapely.points(lost), 2 * FOOT_M))):
        inside = vertices[shapely.contains_xy(column, *vertices[:, :2].T) & (vertices[:, 2] < 5 * FOOT_M)]
        level = inside * [1.0, 1.0, 0.0]
        feet.append(convex_hull(np.vstack([inside, level, level + [0.0, 0.0, FOOT_M]])))
    return (*hulls, *feet) if len(hulls) + len(feet) <= MAX_PIECES else hulls


def _body_hinge(
    annotation: Annotation, scale: np.ndarray, base_cad: np.ndarray, extent: np.ndarray
) -> ScannedHinge | None:
    """Return the body's hinge or slide in its frame; assume one at the edge of a door's leaf that has none."""
    hinge = annotation.hinge
    if hinge is None and annotation.category != "door":
        return None
    if hinge is None:
        along = int(np.argmax(extent[:2]))
        origin = np.zeros(3)
        origin[along] = -extent[along] / 2
        return ScannedHinge(origin, UP, (-math.pi / 2, math.pi / 2), True)
    origin = scale * hinge.origin - base_cad
    if annotation.category != "door":
        return dataclasses.replace(hinge, origin=origin)
    low, high = sorted(float(np.sign(hinge.axis[2])) * v for v in hinge.range_rad)
    origin[2] = 0.0
    return ScannedHinge(origin, UP, (low, high), hinge.assumed)


def place_object(
    name: str,
    annotation: Annotation,
    cad: CadModel,
    hulls_cad: tuple[Hull, ...],
    pose: Alignment,
    floor_height_m: float,
    walls_yaw: float,
) -> PlacedObject:
    """Scale a CAD model and its hulls, move the origin to the middle of the base and compute the world pose.

    The world's z is the scan's minus `floor_height_m`; `walls_yaw` is the building's main direction, rad.
    """
    vertices, look = cad.vertices * pose.scale, cad.surface
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    hulls = tuple(flatten_feet(convex_hull(h.vertices * pose.scale - base)) for h in hulls_cad)
    if cad.pieces is None and annotation.hinge is None and annotation.category != "door":
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
        hinge=_body_hinge(annotation, pose.scale, base, high - low),
        surface_b=None if look is None else dataclasses.replace(look, vertices=look.vertices * pose.scale - base),
    )


def name_objects(annotations: tuple[Annotation, ...]) -> tuple[str, ...]:
    """Return body names `<category>_<k>`, k counting from 0 inside its category in the annotation's order."""
    count = collections.defaultdict(itertools.count)
    return tuple(f"{a.category}_{next(count[a.category])}" for a in annotations)


@dataclasses.dataclass(frozen=True)
class Physical:
    """Hold rigid-body properties in the body frame."""

    mass_kg: float
    com_b: np.ndarray
    """(3,) m."""
    inertia_b: np.ndarray
    """(3, 3) kg m2 about the centre of mass, along the body's axes."""
    friction: float
    volume_m3: float


def physical_properties(
    category: str, hulls: tuple[Hull, ...], mass_kg: float | None = None, friction: float | None = None
) -> Physical:
    """Return mass (density x hull volume within the category's range, unless given), moments (m, kg) and friction."""
    material = MATERIALS[category]
    # The moments of closed surfaces add up; at unit density.
    whole = trimesh.triangles.mass_properties(np.concatenate([hull.vertices[hull.faces] for hull in hulls]))
    volume, com, inertia = float(whole.volume), np.asarray(whole.center_mass), np.asarray(whole.inertia)
    usual = float(np.clip(material.density_kg_m3 * volume, *material.mass_range_kg))
    mass = usual if mass_kg is None else mass_kg
    friction = material.friction if friction is None else friction
    return Physical(mass, com, inertia * usual / volume * (mass / usual), friction, volume)


LYING_DEG = 15.0
"""Annotated tilt from which a scene's report says that the object was stood upright."""


def upright(pose: np.ndarray, pivot_cad: np.ndarray) -> tuple[alignment.Alignment, float]:
    """Remove roll and pitch from a pose (4, 4) about a CAD point (3,); return the pose and the removed tilt, rad."""
    scale = np.linalg.norm(pose[:3, :3], axis=0)
    turn = pose[:3, :3] / scale
    yaw = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    place = pose[:3, :3] @ pivot_cad + pose[:3, 3]
    translation = place - yaw_matrix(yaw) @ (scale * pivot_cad)
    tilt = math.acos(float(np.clip(turn[2, 2], -1.0, 1.0)))
    return alignment.Alignment(scale, translation, yaw, math.nan), tilt


def compare(
    annotation: Annotation, placed: alignment.Alignment, tilt_rad: float, pivot_cad: np.ndarray, name: str
) -> dict[str, Any]:
    """Return a row of the alignment report: residual of the annotated pose, and the re-solved one, at a pivot (3,)."""
    row: dict[str, Any] = {
        "name": name,
        "cad_id": annotation.cad_id,
        "n_keypoints": len(annotation.keypoints_cad),
        "symmetry": annotation.symmetry,
        "tilt_removed_deg": round(math.degrees(tilt_rad), 3),
    }
    if annotation.confidence is not None:
        row["retrieved_confidence"] = annotation.confidence
    if tilt_rad > math.radians(LYING_DEG):
        degrees = math.degrees(tilt_rad)
        row["note"] = f"annotated {degrees:.0f} degrees off the vertical; placed upright, yaw is the only rotation"
    if len(annotation.keypoints_cad):
        at = transformed(annotation.keypoints_cad, annotation.pose)
        distance2 = ((at - annotation.keypoints_scan) ** 2).sum(axis=1)
        row["annotated_rms_m"] = round(float(np.sqrt(distance2.mean())), 5)
    try:
        solved = alignment.solve_alignment(annotation.keypoints_cad, annotation.keypoints_scan, annotation.symmetry)
    except alignment.AlignmentError as error:
        return row | {"solved": False, "reason": str(error)}
    translation_m, yaw_rad, scale_ratio = pose_difference(solved, placed, pivot_cad, annotation.symmetry)
    return row | {
        "solved": True,
        "n_outliers": int(solved.outliers.sum()),
        "rms_m": round(solved.rms_m, 5),
        "translation_difference_m": round(translation_m, 5),
        "yaw_difference_deg": round(math.degrees(yaw_rad), 3),
        "scale_ratio": [round(float(v), 4) for v in scale_ratio],
    }


def pose_difference(
    one: alignment.Alignment, other: alignment.Alignment, pivot_cad: np.ndarray, symmetry: str
) -> tuple[float, float, np.ndarray]:
    """Compare poses of a model at a pivot (3,), CAD frame, but for turns that the symmetry, Scan2CAD's word, allows.

    Return the translation, m, the yaw in [0, pi], and (3,) the ratio of scales, one / other, along the other's axes.
    """
    period = alignment.SYMMETRY_PERIOD_RAD.get(symmetry, 2 * math.pi)
    at = [alignment.apply_alignment(a, pivot_cad[None])[0] for a in (one, other)]
    turn = wrap_angle(one.yaw - other.yaw)
    yaw = wrap_angle(turn, period) if period else 0.0
    swapped = period and round((turn - yaw) / (math.pi / 2)) % 2
    scale = one.scale[[1, 0, 2]] if swapped else one.scale
    return float(np.linalg.norm(at[0] - at[1])), abs(yaw), scale / other.scale


def align_objects(raw: RawScene) -> tuple[list[alignment.Alignment], list[dict[str, Any]]]:
    """Return upright placements from the annotations, and the report that compares them with re-solved ones."""
    placements, rows = [], []
    for name, annotation in zip(name_objects(raw.annotations), raw.annotations, strict=True):
        vertices = raw.cads[annotation.cad_id].vertices
        pivot = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        placed, tilt = upright(annotation.pose, pivot)
        placements.append(placed)
        rows.append(compare(annotation, placed, tilt, pivot, name))
    return placements, rows
