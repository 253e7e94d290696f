"""Join flat patches into one textured mesh: each patch has a rectangle of texels on one sheet.

Frame: scan x, y, height above the floor; metres. Faces are one-sided, counter-clockwise from their visible side.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from converters.generate.surface.finishes import Colouring
from converters.generate.surface.scan import Scan
from converters.generate.surface.texture import Atlas, charts_of, face_axes, pack_rows
from converters.geometry.faces import compacted, face_vectors, stacked

SHEETS = (1024, 1536, 2048)
"""Sides that a sheet may have, texels; on the largest the resolution is lowered until all fits."""
MARGIN = 3
"""Texels around each patch that repeat its border, so that smaller versions of the sheet do not mix patches."""
LIGHT_M = 0.06
"""Between the points of a patch at which light is worked out."""
LEVELS = 63
"""Steps of each channel, few enough for a small PNG."""

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
    """(3,) normal that light falls on instead of the patch's: of thin things at a wall, whose edges are not dark."""

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


def piece_charts(vertices: np.ndarray, faces: np.ndarray, label: int, paint: Colouring) -> list[Chart]:
    """Cut a mesh into patches of faces that look mostly along one axis."""
    n, chart = charts_of(faces, face_axes(vertices, faces))
    return [Chart(*compacted(vertices, faces[chart == k]), label, paint, 50.0) for k in range(n)]


@dataclasses.dataclass(frozen=True)
class _Laid:
    chart: Chart
    corner: np.ndarray
    axes: np.ndarray
    normal: np.ndarray
    size_m: np.ndarray

    def grid(self, n: np.ndarray, step_m: np.ndarray, first: float) -> np.ndarray:
        """Return (n[0] * n[1], 3) places, rows along the second edge, clamped to the patch."""
        s, t = (np.clip((np.arange(n[k]) + first) * step_m[k], 0, self.size_m[k]) for k in range(2))
        st = np.stack(np.meshgrid(s, t), axis=-1).reshape(-1, 2)
        return self.corner + st[:, :1] * self.axes[0] + st[:, 1:] * self.axes[1]


def _lit(laid: list[_Laid], light: Light) -> list[np.ndarray]:
    """Compute for each patch (rows, columns, 3) brightness on a coarse grid from corner to corner, all at once."""
    counts = [np.maximum(np.ceil(q.size_m / LIGHT_M).astype(int), 1) + 1 for q in laid]
    places = [q.grid(n, q.size_m / (n - 1), 0.0) for q, n in zip(laid, counts, strict=True)]
    normals = [q.normal if q.chart.lit_as is None else q.chart.lit_as for q in laid]
    normals = np.repeat(normals, [len(p) for p in places], axis=0)
    values = light(np.concatenate(places), normals)
    ends = np.cumsum([len(p) for p in places])[:-1]
    return [v.reshape(n[1], n[0], 3) for v, n in zip(np.split(values, ends), counts, strict=True)]


def _between(grid: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Interpolate a grid bilinearly; rows and columns in 0..1 from its first to its last."""
    for axis, at in ((0, rows), (1, columns)):
        place = np.clip(at, 0, 1) * (grid.shape[axis] - 1)
        low = np.minimum(place.astype(int), grid.shape[axis] - 2)
        share = (place - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        grid = np.take(grid, low, axis) * (1 - share) + np.take(grid, low + 1, axis) * share
    return grid


def _texels(laid: _Laid, n: np.ndarray, density: np.ndarray, grid: np.ndarray | None) -> np.ndarray:
    """Return (rows, columns, 3) colours of one patch with its margin, first row lowest."""
    chart = laid.chart
    if isinstance(chart.paint, np.ndarray):
        return np.pad(chart.paint[::-1], ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), mode="edge")
    wide = n + 2 * MARGIN
    colour = chart.paint(laid.grid(wide, 1 / density, 0.5 - MARGIN)).reshape(wide[1], wide[0], 3)
    if grid is None:
        return colour
    s, t = ((np.arange(wide[k]) + 0.5 - MARGIN) / density[k] / max(laid.size_m[k], 1e-9) for k in range(2))
    return colour * _between(grid, t, s)


def _packed(laid: list[_Laid]) -> tuple[int, float, list[np.ndarray], np.ndarray]:
    """Return side of the sheet, factor on the resolution, texels (columns, rows) and corner of each patch."""
    finer, paints = 1.0, [q.chart.paint for q in laid]
    images = [np.array(paint.shape[1::-1]) if isinstance(paint, np.ndarray) else None for paint in paints]
    while True:
        sizes = [np.ceil(np.round(q.size_m * q.chart.texels_per_m * finer, 6)).astype(int) for q in laid]
        sizes = [np.maximum(n, 1) if image is None else image for n, image in zip(sizes, images, strict=True)]
        wide = np.array(sizes) + 2 * MARGIN
        for side in SHEETS:
            if wide.max() > side:
                continue
            corner, used = pack_rows(wide, side)
            if used <= side:
                return side, finer, sizes, corner
        finer *= 0.95


def assemble(charts: list[Chart], light: Light) -> tuple[Scan, Atlas]:
    """Join patches into one mesh, no vertex in two of them, and paint its sheet."""
    laid = [_Laid(c, *c.frame()) for c in charts]
    first: dict[int, int] = {}
    sheet_of = [first.setdefault(id(c.paint) if c.uv is not None else -1 - k, k) for k, c in enumerate(charts)]
    drawn = sorted(set(sheet_of))
    side, finer, sizes, corners = _packed([laid[k] for k in drawn])
    shaded = [k for k in drawn if not charts[k].glows and charts[k].uv is None]
    grids = dict(zip(shaded, _lit([laid[k] for k in shaded], light), strict=True))
    sheet = np.full((side, side, 3), 0.8)
    place = {}
    for k, n, corner in zip(drawn, sizes, corners, strict=True):
        density = np.full(2, charts[k].texels_per_m * finer)
        place[k] = corner + MARGIN, density, n
        x, y = corner
        sheet[y : y + n[1] + 2 * MARGIN, x : x + n[0] + 2 * MARGIN] = _texels(laid[k], n, density, grids.get(k))
    uv = []
    for q, k in zip(laid, sheet_of, strict=True):
        corner, density, n = place[k]
        if q.chart.uv is not None:
            uv.append(corner + q.chart.uv * n)
        else:
            uv.append(corner + (q.chart.vertices - q.corner) @ q.axes.T * density)
    vertices, faces = stacked((c.vertices, c.faces) for c in charts)
    uv, uv_faces = stacked(zip(uv, (c.faces if c.uv_faces is None else c.uv_faces for c in charts), strict=True))
    labels = np.repeat([c.label for c in charts], [len(c.vertices) for c in charts]).astype(np.uint8)
    colour = np.round(np.round(np.clip(sheet, 0, 1), 6) * LEVELS) * (255 / LEVELS)
    image = np.round(colour).astype(np.uint8)[::-1]
    return Scan(vertices, faces, labels), Atlas(uv / side, uv_faces, image)
