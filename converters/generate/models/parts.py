"""Build convex pieces of furniture: boxes, cushions, bars, plates, shells and leaves, in metres, y up."""

import dataclasses
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from converters.geometry.faces import face_vectors, stacked
from converters.records.raw import VisualMesh
from interactive_nav_common.records import read_packaged

MATERIALS: dict[str, tuple[float, float, float]] = read_packaged(
    Path(__file__).with_suffix(".yaml"), dict[str, tuple[float, float, float]]
)
"""Material name -> diffuse RGB in 0..1."""


@dataclasses.dataclass(frozen=True)
class Part:
    """Describe one convex piece."""

    vertices: np.ndarray
    """(n, 3) float64."""
    faces: np.ndarray
    """(m, 3) int64, counter-clockwise from outside."""
    material: str
    """Key of `MATERIALS`."""


def _leaned(part: Part, center, tilt_rad: float) -> Part:
    """Return a part turned about x (positive: the top leans back, towards -z), then moved to `center`."""
    turn = Rotation.from_euler("x", -tilt_rad).as_matrix()
    return dataclasses.replace(part, vertices=part.vertices @ turn.T + np.asarray(center, float))


def box(center, size, material, tilt_rad=0.0) -> Part:
    """Build a box that leans back by `tilt_rad`."""
    mesh = trimesh.creation.box(extents=size)
    return _leaned(Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), material), center, tilt_rad)


def block(base, size, material) -> Part:
    """Build a box whose underside has its middle at `base`."""
    x, y, z = base
    return box((x, y + size[1] / 2, z), size, material)


SPINES = ("navy", "rust", "cream", "moss", "leather", "slate", "red", "mustard", "denim", "linen", "teal")


def books(base, width, height, depth, first=0) -> list[Part]:
    """Build a row of books of several sizes to the right of `base`; rows of another `first` differ."""
    (x, y, z), parts, k = base, [], first
    while x < base[0] + width - 0.05:
        thick, tall = 0.025 + 0.007 * (5 * k % 4), height * (0.75 + 0.08 * (7 * k % 4))
        parts.append(block((x + thick / 2, y, z), (thick - 0.002, tall, depth), SPINES[k % len(SPINES)]))
        x, k = x + thick, k + 1
    return parts


def hull(points, material) -> Part:
    """Build the convex hull of points."""
    mesh = trimesh.convex.convex_hull(np.asarray(points, float))
    return Part(np.asarray(mesh.vertices), np.asarray(mesh.faces), material)


def cushion(center, size, material, chamfer=0.03, tilt_rad=0.0) -> Part:
    """Build a box with cut edges."""
    half = np.asarray(size, float) / 2
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    cut = min(chamfer, 0.45 * half.min())
    points = np.concatenate([signs * (half - cut * (1 - np.eye(3)[i])) for i in range(3)])
    return _leaned(hull(points, material), center, tilt_rad)


def bar(start, end, radius, material, sides=8) -> Part:
    """Build a prism of `sides` sides from `start` to `end`; `radius` is a number, or a pair (at start, at end)."""
    p0, p1 = np.asarray(start, float), np.asarray(end, float)
    r0, r1 = (radius, radius) if isinstance(radius, int | float) else radius
    axis = (p1 - p0) / np.linalg.norm(p1 - p0)
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 0, 1.0])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v
    vertices = np.concatenate([p0 + r0 * ring, p1 + r1 * ring])
    i = np.arange(sides)
    j = (i + 1) % sides
    around = np.concatenate([np.stack([i, j, j + sides], 1), np.stack([i, j + sides, i + sides], 1)])
    k = np.arange(1, sides - 1)
    low = np.stack([np.zeros_like(k), k + 1, k], 1)
    high = np.stack([np.zeros_like(k), k, k + 1], 1) + sides
    return Part(vertices, np.concatenate([around, low, high]), material)


def rail(reach, y, z, radius, material, sides=8) -> Part:
    """Build a level bar from left to right."""
    return bar((-reach, y, z), (reach, y, z), radius, material, sides)


def beam(x, y, reach, radius, material, sides=8) -> Part:
    """Build a level bar from the back to the front."""
    return bar((x, y, -reach), (x, y, reach), radius, material, sides)


def pillar(base, height, radius, material, sides=12) -> Part:
    """Build an upright bar that stands at `base`."""
    x, y, z = base
    return bar((x, y, z), (x, y + height, z), radius, material, sides)


def turned(base, profile, material, sides=12) -> list[Part]:
    """Build what a lathe turns: pieces between the (radius, height) pairs of a profile, from below."""
    x, y, z = base
    return [
        bar((x, y + y0, z), (x, y + y1, z), (r0, r1), material, sides)
        for (r0, y0), (r1, y1) in zip(profile, profile[1:], strict=False)
    ]


def oval(x, z, rx, rz, sides=16) -> np.ndarray:
    """Return the (sides, 2) outline of an ellipse in the plane of the floor."""
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return np.stack([x + rx * np.cos(angles), z + rz * np.sin(angles)], axis=1)


def rectangle(x, z, width, depth, cut=0.0) -> np.ndarray:
    """Return the (4 or 8, 2) outline of a rectangle on the floor, its corners cut by `cut`, anticlockwise."""
    w, d = width / 2, depth / 2
    if not cut:
        return np.array([(w, -d), (w, d), (-w, d), (-w, -d)]) + [x, z]
    corners = [(w, -d + cut), (w, d - cut), (w - cut, d), (-w + cut, d)]
    corners += [(-w, d - cut), (-w, -d + cut), (-w + cut, -d), (w - cut, -d)]
    return np.array(corners) + [x, z]


def _at(outline, y) -> np.ndarray:
    return np.column_stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]])


def plate(outline, y0, y1, material, top=None) -> Part:
    """Build a convex outline drawn up from y0 to y1, where it has the outline `top` if that is given."""
    return hull(np.concatenate([_at(outline, y0), _at(outline if top is None else top, y1)]), material)


def shell(outline, y0, y1, thick, material, top=None) -> list[Part]:
    """Build the wall along an outline, one piece a side; its underside is open, its inside `thick` further in."""
    above = outline if top is None else top
    pieces = []
    for k in range(len(outline)):
        sides = [ring[[k, (k + 1) % len(ring)]] for ring in (outline, above)]
        inner = [
            side - thick * (side - ring.mean(axis=0)) / np.linalg.norm(side - ring.mean(axis=0), axis=1, keepdims=True)
            for side, ring in zip(sides, (outline, above), strict=True)
        ]
        points = [_at(side, y) for pair in (sides, inner) for side, y in zip(pair, (y0, y1), strict=True)]
        pieces.append(hull(np.concatenate(points), material))
    return pieces


def ball(center, radii, material, sides=8) -> Part:
    """Build an ellipsoid."""
    rings = [(np.cos(a), np.sin(a)) for a in np.pi * np.array([-0.5, -0.3, -0.1, 0.1, 0.3, 0.5])]
    points = [_at(oval(0, 0, max(r, 0.02), max(r, 0.02), sides), y) for r, y in rings]
    return hull(np.concatenate(points) * np.asarray(radii, float) + np.asarray(center, float), material)


def leaf(base, tip, width, material, thick=0.008) -> Part:
    """Build a pointed leaf from base to tip, broadest past its middle, lying as flat as its direction allows."""
    p0, p1 = np.asarray(base, float), np.asarray(tip, float)
    along = p1 - p0
    across = np.cross(along, [0.0, 1.0, 0.0])
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else np.array([1.0, 0.0, 0.0])
    up = np.cross(across, along) / np.linalg.norm(along)
    middle = p0 + 0.55 * along
    rim = [p0, p1, middle + across * width / 2, middle - across * width / 2]
    return hull([p + s * thick / 2 * up for p in rim for s in (-1, 1)], material)


def four_legs(width, depth, height, thick, material, square=True) -> list[Part]:
    """Build legs under the corners of a `width` x `depth` top whose underside is at `height`."""
    legs = []
    for sx in (-1, 1):
        for sz in (-1, 1):
            x, z = sx * (width / 2 - thick), sz * (depth / 2 - thick)
            sides, radius = (4, thick * 0.7) if square else (10, (thick * 0.4, thick * 0.6))
            legs.append(bar((x, 0.0, z), (x, height, z), radius, material, sides))
    return legs


def on_floor(parts) -> list[Part]:
    """Return the same parts, with what leaning bars reach below the floor cut off."""
    low = [part.vertices[:, 1].min() for part in parts]
    return [
        hull(np.maximum(part.vertices, [-np.inf, 0.0, -np.inf]), part.material) if y < 0 else part
        for part, y in zip(parts, low, strict=True)
    ]


def fronts(low, high, z, columns, rows, material, handle="bar", metal="steel") -> list[Part]:
    """Build doors or drawers with handles before a carcass, their backs at z: a grid from `low` to `high` (x, y)."""
    parts = []
    width, height = (high[0] - low[0]) / columns, (high[1] - low[1]) / rows
    for k in range(columns * rows):
        column, row = k % columns, k // columns
        x, y = low[0] + width * (column + 0.5), low[1] + height * (row + 0.5)
        parts.append(box((x, y, z + 0.008), (width - 0.012, height - 0.012, 0.02), material))
        if handle == "bar":
            parts.append(box((x, y + 0.2 * height, z + 0.028), (0.35 * width, 0.018, 0.024), metal))
        elif handle == "knob":
            parts.append(cushion((x, y, z + 0.03), (0.034, 0.034, 0.03), metal, 0.01))
        elif handle == "pull":
            side = 1 if column % 2 == 0 and columns > 1 else -1
            place = (x + side * (width / 2 - 0.05), y, z + 0.028)
            parts.append(box(place, (0.018, min(0.3, 0.4 * height), 0.024), metal))
    return parts


SWATCH = 8
"""Rows of an image that show plain colours."""


def holding(surface: VisualMesh, things: list[Part], unit_m: float, move: np.ndarray) -> VisualMesh:
    """Return a surface with parts, m, in their materials' colours, which the lowest rows of its image then show."""
    names, (high, wide) = sorted({part.material for part in things}), surface.image.shape[:2]
    kept = np.asarray(Image.fromarray(surface.image).resize((wide, high - SWATCH), Image.Resampling.NEAREST))
    colours = np.rint(255 * np.array([MATERIALS[n] for n in names])).astype(np.uint8)
    swatches = np.broadcast_to(colours[np.arange(wide) * len(names) // wide], (SWATCH, wide, 3))
    uv = surface.uv * [1, 1 - SWATCH / high] + [0, SWATCH / high]
    places = np.array([((k + 0.5) / len(names), SWATCH / 2 / high) for k in range(len(names))])
    vertices, faces = stacked((part.vertices / unit_m + move, part.faces) for part in things)
    of = np.repeat([len(uv) + names.index(part.material) for part in things], [len(part.faces) for part in things])
    normals = face_vectors(vertices, faces)
    # Neither back nor underside.
    shown = (normals[:, 1:] > -0.99 * np.linalg.norm(normals, axis=1, keepdims=True)).all(axis=1)
    faces, of = faces[shown], of[shown]
    vertices, faces = stacked(((surface.vertices, surface.faces), (vertices, faces)))
    uv_faces = np.vstack([surface.uv_faces, np.tile(of[:, None], 3)])
    return VisualMesh(vertices, faces, np.vstack([uv, places]), uv_faces, np.vstack([kept, swatches]), surface.exact)
