"""Paint scans and modelled structures procedurally, by the place of each texel in the building.

Patterns thus continue across the charts of a scan's atlas and across the patches of a structure, which are packed into
rows. Faces are one-sided, counter-clockwise from their visible side.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from converters.generate.homes.building import Rect
from converters.generate.models.cad import CadModel
from converters.generate.models.parts import MATERIALS
from converters.generate.surface.finishes import Colouring, finishes
from converters.generate.surface.scan import Scan, smooth_noise
from converters.geometry.faces import compacted, face_areas, face_vectors, stacked, unit_normals
from converters.records.raw import TexturedMesh, VisualMesh
from converters.write.texture import LEVELS, fill_image, texel_surface, textured_cloud, unwrap

FILLED = 0.6
"""Share of a scan's image that its charts fill, about."""
MODEL_SPACING_M = 0.01
"""Between coloured points of a library model."""


def pack_rows(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Pack rectangles (n, 2) of width and height, texels, into rows; return lower corners (n, 2) and the height."""
    corner = np.zeros_like(sizes)
    x = y = row = 0
    for k in np.lexsort((np.arange(len(sizes)), -sizes[:, 0], -sizes[:, 1])):
        w, h = sizes[k]
        if x + w > width:
            x, y, row = 0, y + row, 0
        corner[k] = x, y
        x, row = x + w, max(row, h)
    return corner, y + row


def _light(points: np.ndarray, normals: np.ndarray, lamp: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (n,) brightness: a lamp per room that falls off, shade by direction, darker in corners near the floor."""
    away = lamp - points
    far = np.linalg.norm(away, axis=1)
    lambert = np.clip(np.einsum("ij,ij->i", normals, away) / far, 0, 1)
    light = 0.72 + 0.34 * lambert / (0.6 + 0.25 * far)
    light *= 1 - 0.12 * np.exp(-np.maximum(points[:, 2], 0) / 0.15) * (np.abs(normals[:, 2]) < 0.5)
    return light * (1 + 0.03 * smooth_noise(points, 0.8, rng))


def _coloured(model: CadModel) -> tuple[cKDTree, np.ndarray]:
    """Return points of a library model's surface, CAD frame, and the colour (n, 3) of each in 0..1."""
    surface = model.surface
    assert surface is not None
    mesh = TexturedMesh(surface.vertices, surface.faces, surface.uv[surface.uv_faces], surface.image)
    cloud = textured_cloud(mesh, MODEL_SPACING_M / model.unit_m)
    return cKDTree(cloud.points), cloud.colours / 255


def paint(
    scan: Scan,
    rooms: Sequence[Rect],
    uses: Sequence[str],
    points: np.ndarray,
    ids: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return colours (n, 3) in 0..1 of points (n, 3) on faces `ids` (n,), by the nearest solid's material and room."""
    corner = scan.solid[scan.faces[ids]]
    # Two of three corners decide, so that a border follows edges rather than zigzags.
    solid = np.where(corner[:, 1] == corner[:, 2], corner[:, 1], corner[:, 0])
    names = sorted({s.material for s in scan.solids})
    material = np.array([names.index(s.material) for s in scan.solids])[solid]
    colour = np.zeros((len(points), 3))
    centres = np.array([r.centre for r in rooms])
    half = np.array([r.size for r in rooms]) / 2
    outside = np.stack([(np.abs(points[:, :2] - c) - h).max(axis=1) for c, h in zip(centres, half, strict=True)], 1)
    room = outside.argmin(axis=1)
    finish = finishes(rooms, uses, rng)
    cabinet = np.array(MATERIALS["white"] if rng.random() < 0.6 else MATERIALS["oak"])
    for m, name in enumerate(names):
        here = np.flatnonzero(material == m)
        p = points[here]
        if name in ("floor", "paint"):
            value = np.zeros((len(p), 3))
            for k, of in enumerate(finish):
                inside = room[here] == k
                value[inside] = of.floor_colour(p[inside]) if name == "floor" else of.wall_colour(p[inside])
        elif name == "cabinet":
            seam = (np.mod(p[:, 0] + 0.003, 0.45) < 0.012) | (np.mod(p[:, 1] + 0.003, 0.45) < 0.012)
            value = cabinet * np.where(seam, 0.7, 1.0)[:, None]
            value[(p[:, 2] > 0.87) & (p[:, 2] < 0.95)] = [0.35, 0.34, 0.33]
        else:
            weave = 1 + 0.05 * np.sin(90 * p[:, 0]) * np.sin(90 * p[:, 1] + 40 * p[:, 2])
            value = np.array(MATERIALS[name]) * weave[:, None]
        colour[here] = value
    # Points of a library model take the colour of the model's nearest point.
    items = {id(s.item): s.item for s in scan.solids if s.item is not None and s.item.model.surface is not None}
    of = np.array([id(s.item) for s in scan.solids])[solid]
    order, coloured = np.argsort(of, kind="stable"), {}
    for key, item in items.items():
        here = order[np.searchsorted(of[order], key) : np.searchsorted(of[order], key, "right")]
        if id(item.model) not in coloured:
            coloured[id(item.model)] = _coloured(item.model)
        tree, colours = coloured[id(item.model)]
        in_cad = (points[here] - item.matrix[:3, 3]) @ np.linalg.inv(item.matrix[:3, :3]).T
        colour[here] = colours[tree.query(in_cad)[1]]
    lamp = np.column_stack([centres, np.full(len(rooms), 2.2)])[room]
    light = _light(points, unit_normals(scan.vertices, scan.faces)[ids], lamp, rng)
    return np.clip(colour * light[:, None], 0, 1)


def make_atlas(
    scan: Scan, rooms: Sequence[Rect], uses: Sequence[str], texels_per_m: float, rng: np.random.Generator
) -> VisualMesh:
    """Unwrap and paint a scan; the rooms' `uses` are as `finishes` takes them."""
    area_m2 = float(face_areas(scan.vertices, scan.faces).sum())
    side = math.ceil(texels_per_m * math.sqrt(area_m2 / FILLED))
    uv, uv_faces = unwrap(scan.vertices, scan.faces, side)
    texel, points, ids = texel_surface(scan.vertices, scan.faces, uv, uv_faces, side)
    # Six bits a channel and no noise per texel: the PNG stays small.
    colours = np.round(paint(scan, rooms, uses, points, ids, rng) * LEVELS) * (255 / LEVELS)
    return VisualMesh(scan.vertices, scan.faces, uv, uv_faces, fill_image(texel, colours, side))


SHEETS = (1024, 1536, 2048)
"""Sides that a sheet may have, texels; on the largest the resolution is lowered until all fits."""
MARGIN = 3
"""Texels around each patch that repeat its border, so that smaller versions of the sheet do not mix patches."""
LIGHT_M = 0.08
"""Between the points of a patch at which light is worked out."""

Light = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(n, 3) places and (n, 3) normals -> (n, 3) brightness of each channel."""


@dataclasses.dataclass(frozen=True)
class Chart:
    """Describe a patch that is flat, or nearly so."""

    vertices: np.ndarray
    """(k, 3)."""
    faces: np.ndarray
    """(m, 3) int64."""
    label: int
    """NYU40."""
    paint: Colouring | np.ndarray
    """Colour by place; an array (h, w, 3) in 0..1, top row first, is an image that `uv` looks up."""
    texels_per_m: float = 80.0
    glows: bool = False
    """Its colour is what one sees: no light falls on it."""
    uv: np.ndarray | None = None
    """(k, 2) in 0..1, of an image."""
    uv_faces: np.ndarray | None = None
    """(m, 3) into `uv`; None: as `faces`."""
    lit_as: np.ndarray | None = None
    """(3,) normal that light falls on instead of the patch's: of thin objects at a wall, whose edges are not dark."""

    @functools.cached_property
    def frame(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return its rectangle: corner (3,), unit edges (2, 3) and normal (3,), size (2,) in metres."""
        normal = face_vectors(self.vertices, self.faces).sum(axis=0)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
        edge = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.7 else np.array([0.0, 1.0, 0.0])
        u = np.cross(edge, normal)
        u = u / np.linalg.norm(u)
        axes = np.stack([u, np.cross(normal, u)])
        middle = self.vertices.mean(axis=0)
        flat = (self.vertices - middle) @ axes.T
        low = flat.min(axis=0)
        return middle + low @ axes, axes, normal, flat.max(axis=0) - low

    @property
    def size_m(self) -> np.ndarray:
        """Return the (2,) size of its rectangle."""
        return self.frame[3]

    def grid(self, n: np.ndarray, step_m: np.ndarray, first: float) -> np.ndarray:
        """Return (n[0] * n[1], 3) places, rows along the second edge, clamped to the patch."""
        corner, axes, _, size_m = self.frame
        s, t = (np.clip((np.arange(n[k]) + first) * step_m[k], 0, size_m[k]) for k in range(2))
        st = np.stack(np.meshgrid(s, t), axis=-1).reshape(-1, 2)
        return corner + st[:, :1] * axes[0] + st[:, 1:] * axes[1]


def plain(colour: Sequence[float] | np.ndarray) -> Colouring:
    """Paint one colour all over."""
    value = np.asarray(colour, float)
    return lambda p: np.broadcast_to(value, (len(p), 3))


def polygon(points: Iterable[Iterable[float]], towards: Iterable[float], *about: Any, **more: Any) -> Chart:
    """Return a flat convex polygon that is visible from where `towards` (3,) points; `about` it: `Chart`'s others."""
    corners = np.array([tuple(p) for p in points])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    if normal @ np.array(tuple(towards)) < 0:
        corners = corners[::-1]
    fan = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
    return Chart(corners, np.array(fan), *about, **more)


def piece_charts(vertices: np.ndarray, faces: np.ndarray, label: int, material: str) -> list[Chart]:
    """Cut a convex mesh of one material into patches that look mostly along one axis; glass keeps its colour."""
    normals = face_vectors(vertices, faces)
    axis = np.abs(normals).argmax(axis=1)
    way = np.where(np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] < 0, -1 - axis, axis)
    about = label, plain(MATERIALS[material]), 50.0, material == "glass"
    return [Chart(*compacted(vertices, faces[way == k]), *about) for k in dict.fromkeys(way.tolist())]


def _lit(charts: list[Chart], light: Light) -> list[np.ndarray]:
    """Compute for each patch (rows, columns, 3) brightness on a coarse grid from corner to corner, all at once."""
    counts = [np.maximum(np.ceil(c.size_m / LIGHT_M).astype(int), 1) + 1 for c in charts]
    places = [c.grid(n, c.size_m / (n - 1), 0.0) for c, n in zip(charts, counts, strict=True)]
    normals = [c.frame[2] if c.lit_as is None else c.lit_as for c in charts]
    normals = np.repeat(normals, [len(p) for p in places], axis=0)
    values = light(np.concatenate(places), normals)
    ends = np.cumsum([len(p) for p in places])[:-1]
    return [v.reshape(n[1], n[0], 3) for v, n in zip(np.split(values, ends), counts, strict=True)]


def _texels(chart: Chart, n: np.ndarray, density: np.ndarray, grid: np.ndarray | None) -> np.ndarray:
    """Return (rows, columns, 3) colours of one patch with its margin, first row lowest."""
    if isinstance(chart.paint, np.ndarray):
        return np.pad(chart.paint[::-1], ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), mode="edge")
    wide = n + 2 * MARGIN
    colour = chart.paint(chart.grid(wide, 1 / density, 0.5 - MARGIN)).reshape(wide[1], wide[0], 3)
    if grid is None:
        return colour
    s, t = ((np.arange(wide[k]) + 0.5 - MARGIN) / density[k] / max(chart.size_m[k], 1e-9) for k in range(2))
    lattice = [np.linspace(0.0, 1.0, n) for n in grid.shape[:2]]
    places = np.meshgrid(np.clip(t, 0, 1), np.clip(s, 0, 1), indexing="ij")
    return colour * RegularGridInterpolator(lattice, grid)(tuple(places))


def _packed(charts: list[Chart]) -> tuple[int, float, list[np.ndarray], np.ndarray]:
    """Return side of the sheet, factor on the resolution, texels (columns, rows) and corner of each patch."""
    finer = 1.0
    images = [np.array(c.paint.shape[1::-1]) if isinstance(c.paint, np.ndarray) else None for c in charts]
    while True:
        sizes = [np.ceil(np.round(c.size_m * c.texels_per_m * finer, 6)).astype(int) for c in charts]
        sizes = [np.maximum(n, 1) if image is None else image for n, image in zip(sizes, images, strict=True)]
        wide = np.array(sizes) + 2 * MARGIN
        for side in SHEETS:
            if wide.max() > side:
                continue
            corner, used = pack_rows(wide, side)
            if used <= side:
                return side, finer, sizes, corner
        finer *= 0.95


def assemble(charts: list[Chart], light: Light) -> tuple[Scan, VisualMesh]:
    """Join patches into one mesh, no vertex in two of them, and paint its sheet, whose side is one of `SHEETS`."""
    first: dict[int, int] = {}
    sheet_of = [first.setdefault(id(c.paint) if c.uv is not None else -1 - k, k) for k, c in enumerate(charts)]
    drawn = sorted(set(sheet_of))
    side, finer, sizes, corners = _packed([charts[k] for k in drawn])
    shaded = [k for k in drawn if not charts[k].glows and charts[k].uv is None]
    grids = dict(zip(shaded, _lit([charts[k] for k in shaded], light), strict=True))
    sheet = np.full((side, side, 3), 0.8)
    place = {}
    for k, n, corner in zip(drawn, sizes, corners, strict=True):
        density = np.full(2, charts[k].texels_per_m * finer)
        place[k] = corner + MARGIN, density, n
        x, y = corner
        sheet[y : y + n[1] + 2 * MARGIN, x : x + n[0] + 2 * MARGIN] = _texels(charts[k], n, density, grids.get(k))
    uv = []
    for chart, k in zip(charts, sheet_of, strict=True):
        corner, density, n = place[k]
        if chart.uv is not None:
            uv.append(corner + chart.uv * n)
        else:
            uv.append(corner + (chart.vertices - chart.frame[0]) @ chart.frame[1].T * density)
    vertices, faces = stacked((c.vertices, c.faces) for c in charts)
    uv, uv_faces = stacked(zip(uv, (c.faces if c.uv_faces is None else c.uv_faces for c in charts), strict=True))
    labels = np.repeat([c.label for c in charts], [len(c.vertices) for c in charts]).astype(np.uint8)
    colour = np.round(np.round(np.clip(sheet, 0, 1), 6) * LEVELS) * (255 / LEVELS)
    image = np.round(colour).astype(np.uint8)[::-1]
    return Scan(vertices, faces, labels), VisualMesh(vertices, faces, uv / side, uv_faces, image)
