"""Enclose points by convex hulls and boxes, and join convex pieces of a mesh into few."""

import dataclasses
import functools
import itertools
import math

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from converters.geometry.faces import face_areas
from interactive_nav_common.rotations import yaw_matrix

MIN_THICKNESS_M = 0.01
"""Hulls and boxes thinner than this make contacts that a simulation step can tunnel through."""
PREFER_SLACK = 1.15

NOISE_DIGITS = 9
"""Decimals beyond which numbers differ by how a processor rounds."""
TIE_DIGITS = 6
"""Decimals to which two boxes that are as good are equal."""

TILT_GAIN = 0.9
"""A tilted box is taken where its volume is below this share of the upright one's."""
MIN_DRAW_IN = 0.85
"""Least horizontal factor on an upright box; a circle's is sqrt(pi / 4) = 0.886."""
MAX_PIECES = 16
"""Convex pieces of one object; the gates' limit (`hulls_per_object`)."""
SLIVER_SHARE = 0.1
"""Of a mesh's area that flat pieces may have."""
CONVEX_SHARE = 0.9
"""A piece that fills this share of its convex hull counts as convex."""
TURNS = np.round(Rotation.create_group("O").as_matrix())
"""(24, 3, 3) all choices of names and directions for the three axes of a right-handed frame."""


@dataclasses.dataclass(frozen=True)
class Hull:
    """A convex polyhedron."""

    vertices: np.ndarray
    """(n, 3) float64, m."""
    faces: np.ndarray
    """(m, 3) int64, counter-clockwise from outside."""


@dataclasses.dataclass(frozen=True)
class OrientedBox:
    """An oriented box."""

    centre: np.ndarray
    """(3,) m."""
    rotation: np.ndarray
    """(3, 3) columns are the box's axes."""
    half: np.ndarray
    """(3,) half sizes, m."""


def hull_of(points: np.ndarray) -> Hull:
    """Return the convex hull of (n, 3) points."""
    mesh = trimesh.convex.convex_hull(points)
    return Hull(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))


def convex_hull(points: np.ndarray) -> Hull:
    """Return the convex hull of points, rounded to 1 nm for reproducibility; flat ones get `MIN_THICKNESS_M`."""
    points = np.asarray(points, float)
    centre = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - centre, full_matrices=True)
    along = (points - centre) @ axes.T
    thin = np.ptp(along, axis=0) < MIN_THICKNESS_M
    for k in np.flatnonzero(thin):
        # Two copies pushed apart along the thin direction: the hull of both has exactly the minimum
        # thickness.
        along = np.vstack([along, along])
        middle = (along[:, k].min() + along[:, k].max()) / 2
        half = len(along) // 2
        along[:half, k], along[half:, k] = middle - MIN_THICKNESS_M / 2, middle + MIN_THICKNESS_M / 2
    # Which facets are coplanar is a matter of the last digits and of the points' order: both go first.
    points = np.unique(np.round(along @ axes + centre if thin.any() else points, NOISE_DIGITS), axis=0)
    return hull_of(points)


def upright_box(points: np.ndarray, prefer_yaw: float = 0.0, round_fill: float = 1.0) -> OrientedBox:
    """Return the smallest box with a vertical axis around (n, 3) points.

    The box along `prefer_yaw` is preferred if it is at most `PREFER_SLACK` larger in area, so that a round table's box
    is parallel to the walls. With `round_fill`, this applies only if the outline fills at most that share of its
    smallest box (a circle: 0.79), because the box of a long object turned by a degree would be noticeably too wide.
    """
    shadow = ConvexHull(points[:, :2])
    outline = points[shadow.vertices, :2]
    edges = np.roll(outline, -1, axis=0) - outline
    # The smallest rectangle around a convex polygon lies along one of its edges.
    angles = np.append(np.arctan2(edges[:, 1], edges[:, 0]), prefer_yaw) % (math.pi / 2)
    angles[angles > math.pi / 2 - 10.0**-NOISE_DIGITS] = 0.0
    area = np.array([np.ptp(outline @ yaw_matrix(t)[:2, :2], axis=0).prod() for t in angles])
    prefer = area[-1] <= PREFER_SLACK * area.min() and shadow.volume <= round_fill * area.min() * (1 + 1e-9)
    # Of several as small, the one that turns least: which of them is a rounding smaller depends on the processor.
    tied = area <= area.min() * (1 + 10.0**-TIE_DIGITS)
    best = len(angles) - 1 if prefer else int(np.lexsort((np.round(angles, TIE_DIGITS), ~tied))[0])
    rotation = yaw_matrix(float(angles[best]))
    turned = points @ rotation
    low, high = turned.min(axis=0), turned.max(axis=0)
    return OrientedBox(rotation @ ((low + high) / 2), rotation, (high - low) / 2)


def least_turned(rotation: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes (3, 3 columns), permuted and flipped to the least rotation, and `along` (3,) permuted."""
    turns = np.sign(np.linalg.det(rotation)) * rotation @ TURNS  # left-handed axes are flipped first
    order = np.lexsort(np.round([*turns.reshape(-1, 9).T, -np.trace(turns, axis1=1, axis2=2)], TIE_DIGITS))
    best = turns[order[0]]
    return best, np.abs(best.T @ rotation) @ along


def fit_box(hull: Hull, lowest_m: float, prefer_yaw: float = 0.0, round_fill: float = 1.0) -> OrientedBox:
    """Return the collision box of a hull (body frame, m), at least `MIN_THICKNESS_M` thick.

    The axis is vertical if the smallest box would reach below `lowest_m` (the object's lowest point) or gains little.
    Such a box shrinks horizontally to the hull's cross-section (at most to `MIN_DRAW_IN`), as corners around a round
    table top would stick out. `prefer_yaw`: direction of the walls in the body frame, rad.
    """
    box = upright_box(hull.vertices, prefer_yaw, round_fill)
    shadow = float(ConvexHull(hull.vertices[:, :2]).volume)  # scipy: `volume` of a planar hull is its area
    fill = shadow / max(float(4 * box.half[0] * box.half[1]), 1e-12)
    draw_in = max(math.sqrt(min(fill, 1.0)), MIN_DRAW_IN)
    upright = dataclasses.replace(box, half=box.half * [draw_in, draw_in, 1.0])
    least_m3 = TILT_GAIN * float(upright.half.prod())
    if hull_volume(hull.vertices) >= 8 * least_m3:  # no box around it is smaller
        return dataclasses.replace(upright, half=np.maximum(upright.half, MIN_THICKNESS_M / 2))
    to_origin, size = trimesh.bounds.oriented_bounds(hull.vertices, angle_digits=2)
    centre = -to_origin[:3, :3].T @ to_origin[:3, 3]
    tilted = OrientedBox(centre, *least_turned(to_origin[:3, :3].T, np.asarray(size) / 2))
    foot = tilted.centre[2] - np.abs(tilted.rotation[2]) @ tilted.half
    better = np.prod(tilted.half) < least_m3 and foot >= lowest_m + 0.002
    chosen = tilted if better else upright
    return dataclasses.replace(chosen, half=np.maximum(chosen.half, MIN_THICKNESS_M / 2))


def convex_pieces(
    vertices: np.ndarray, faces: np.ndarray, most: int = MAX_PIECES, slack: float | None = None
) -> tuple[tuple[np.ndarray, np.ndarray], ...] | None:
    """Return vertices and faces of the hull of each connected piece of a mesh, or None if one is not convex.

    Pieces share vertex indices, as V-HACD writes them; `merge_pieces` joins close ones if that adds at most the share
    `slack` of the mesh's bounding box.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    groups = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(faces)), min_len=1)
    points: list[np.ndarray] = []
    flat_m2 = 0.0
    for group in groups:
        corners = vertices[np.unique(faces[group])]
        full = hull_volume(corners)
        if full <= 0:
            flat_m2 += float(face_areas(vertices, faces[group]).sum())
            continue  # flat slivers
        if abs(trimesh.triangles.mass_properties(vertices[faces[group]]).volume) < CONVEX_SHARE * full:
            return None
        points.append(corners)
    # Faces that share no vertices are flat pieces too, of a solid that only its source knows.
    if not points or flat_m2 > SLIVER_SHARE * float(face_areas(vertices, faces).sum()):
        return None
    points = merge_pieces(points, most, None if slack is None else slack * float(np.ptp(vertices, axis=0).prod()))
    return tuple((hull.vertices, hull.faces) for hull in map(hull_of, points))


def hull_volume(points: np.ndarray) -> float:
    """Return the volume of the convex hull; 0 for points in a plane."""
    try:
        return float(ConvexHull(points).volume) if len(points) > 3 else 0.0
    except QhullError:
        return 0.0


def merge_pieces(points: list[np.ndarray], most: int, slack: float | None = None) -> list[np.ndarray]:
    """Join pairs of convex pieces, each time the pair whose common hull encloses least that neither does."""

    @functools.cache
    def size(of: frozenset[int]) -> float:
        corners = np.vstack([points[k] for k in sorted(of)])
        return hull_volume(corners) if slack is None else float(np.ptp(corners, axis=0).prod())

    @functools.cache
    def cost(one: frozenset[int], other: frozenset[int]) -> float:
        return size(one | other) - size(one) - size(other)

    groups = [frozenset([k]) for k in range(len(points))]
    while len(groups) > (most if slack is None else 1):
        pair = min(itertools.combinations(groups, 2), key=lambda pair: cost(*pair))
        if len(groups) <= most and slack is not None and cost(*pair) > slack:
            break
        groups = [group for group in groups if group not in pair] + [pair[0] | pair[1]]
    joined = [np.vstack([points[k] for k in sorted(group)]) for group in groups]
    return [p if len(group) == 1 else p[ConvexHull(p).vertices] for p, group in zip(joined, groups, strict=True)]
