"""Unwrap a scan into a texture atlas: charts by dominant direction, packed into rows, painted procedurally.

Each chart is a connected patch of faces that look mostly along the same axis, projected along that axis; so a
texel knows its place in the building, and a floor board runs on across chart borders.
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw
from scipy import sparse
from scipy.spatial import cKDTree

from converters.generate.design.plan import Rect
from converters.generate.models.cad import cad_model
from converters.generate.models.parts import MATERIALS
from converters.generate.surface.finishes import finishes
from converters.generate.surface.scan import Scan, smooth_noise
from converters.geometry.faces import face_vectors, unit_normals
from converters.records.raw import TexturedMesh
from converters.write.texture import textured_cloud
from interactive_nav_common.grids import nearest_cell

PAD = 2
"""Texels between charts."""
MODEL_SPACING_M = 0.01
"""Between coloured points of a library model."""


@dataclasses.dataclass(frozen=True)
class Atlas:
    """Hold UVs and the image they look up."""

    uv: np.ndarray
    """(k, 2) float64 in 0..1, origin at the lower left (OBJ's convention)."""
    face_uv: np.ndarray
    """(m, 3) int64 into `uv`."""
    image: np.ndarray
    """(size, size, 3) uint8, top row first."""


def face_axes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m,) 0..5: +x, -x, +y, -y, +z, -z, the axis that each face's normal is closest to."""
    normals = face_vectors(vertices, faces)
    axis = np.abs(normals).argmax(axis=1)
    return 2 * axis + (normals[np.arange(len(faces)), axis] < 0)


def charts_of(faces: np.ndarray, axes: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of connected patches of faces with the same axis, and (m,) the patch of each face."""
    m = len(faces)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(m), 3)
    order = np.lexsort(edges.T[::-1])
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(axis=1) & (axes[owner[1:]] == axes[owner[:-1]])
    pairs = owner[:-1][same], owner[1:][same]
    graph = sparse.coo_matrix((np.ones(same.sum(), bool), pairs), shape=(m, m))
    n, chart = sparse.csgraph.connected_components(graph, directed=False)
    return int(n), chart


def pack_rows(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Pack rectangles of (n, 2) width and height, texels, into rows, tallest first.

    Return the (n, 2) lower corner of each, and the height used.
    """
    corner = np.zeros_like(sizes)
    x = y = row = 0
    for k in np.lexsort((np.arange(len(sizes)), -sizes[:, 0], -sizes[:, 1])):
        w, h = sizes[k]
        if x + w > width:
            x, y, row = 0, y + row, 0
        corner[k] = x, y
        x, row = x + w, max(row, h)
    return corner, y + row


def unwrap(vertices: np.ndarray, faces: np.ndarray, texels_per_m: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Lay the faces out on a square sheet.

    Return uv (k, 2) in texels, face_uv (m, 3), and the sheet's side (a power of two, so resolution may come out lower).
    """
    axes = face_axes(vertices, faces)
    n, chart = charts_of(faces, axes)
    # One UV per (vertex, chart).
    keys = faces.astype(np.int64) * n + chart[:, None]
    ids, face_uv = np.unique(keys, return_inverse=True)
    face_uv = face_uv.reshape(-1, 3)
    vertex, of_chart = ids // n, ids % n
    plane = np.array([(1, 2), (0, 2), (0, 1)])
    chart_axis = np.zeros(n, int)
    chart_axis[chart] = axes // 2
    flat = np.take_along_axis(vertices[vertex], plane[chart_axis[of_chart]], axis=1)
    low = np.full((n, 2), np.inf)
    high = np.full((n, 2), -np.inf)
    np.minimum.at(low, of_chart, flat)
    np.maximum.at(high, of_chart, flat)
    for _ in range(20):
        sizes = np.ceil((high - low) * texels_per_m).astype(int) + 1 + 2 * PAD
        side = 2 ** int(np.ceil(np.log2(np.sqrt(sizes.prod(axis=1).sum()) * 0.94)))
        corner, used = pack_rows(sizes, side)
        if used <= side and sizes[:, 0].max() <= side:
            break
        texels_per_m *= 0.95
    else:
        raise AssertionError("charts do not fit")
    uv = corner[of_chart] + PAD + 0.5 + (flat - low[of_chart]) * texels_per_m
    return uv, face_uv, side


def texel_positions(uv: np.ndarray, face_uv: np.ndarray, scan: Scan, ids: np.ndarray, texels: np.ndarray) -> np.ndarray:
    """Return the (n, 3) place in the building of each texel, by barycentric coordinates clamped to the face."""
    a, b, c = (uv[face_uv[ids, i]] for i in range(3))
    d = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    d = np.where(np.abs(d) < 1e-9, 1e-9, d)
    p = texels - a
    wb = (p[:, 0] * (c[:, 1] - a[:, 1]) - p[:, 1] * (c[:, 0] - a[:, 0])) / d
    wc = ((b[:, 0] - a[:, 0]) * p[:, 1] - (b[:, 1] - a[:, 1]) * p[:, 0]) / d
    w = np.clip(np.stack([1 - wb - wc, wb, wc], axis=1), 0, 1)
    w /= np.maximum(w.sum(axis=1, keepdims=True), 1e-9)
    return np.einsum("nk,nkd->nd", w, scan.vertices[scan.faces[ids]])


def _light(points: np.ndarray, normals: np.ndarray, lamp: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (n,) brightness: a lamp per room that falls off, shade by direction, darker in corners near the floor."""
    away = lamp - points
    far = np.linalg.norm(away, axis=1)
    lambert = np.clip(np.einsum("ij,ij->i", normals, away) / far, 0, 1)
    light = 0.72 + 0.34 * lambert / (0.6 + 0.25 * far)
    light *= 1 - 0.12 * np.exp(-np.maximum(points[:, 2], 0) / 0.15) * (np.abs(normals[:, 2]) < 0.5)
    return light * (1 + 0.03 * smooth_noise(points, 0.8, rng))


@functools.cache
def _coloured(name: str) -> tuple[cKDTree, np.ndarray]:
    """Return points of a library model's surface, CAD frame, and the colour (n, 3) of each in 0..1."""
    model = cad_model(name)
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
    """Return colours (n, 3) in 0..1 of points (n, 3) on faces `ids` (n,) of the scan, by the nearest solid's material.

    Walls and floors differ by room.
    """
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
    # What is of a library model has the colour of the model's nearest point.
    items = {id(s.item): s.item for s in scan.solids if s.item is not None and s.item.model.surface is not None}
    of = np.array([id(s.item) for s in scan.solids])[solid]
    order = np.argsort(of, kind="stable")
    for key, item in items.items():
        here = order[np.searchsorted(of[order], key) : np.searchsorted(of[order], key, "right")]
        tree, colours = _coloured(item.model.name)
        in_cad = (points[here] - item.matrix[:3, 3]) @ np.linalg.inv(item.matrix[:3, :3]).T
        colour[here] = colours[tree.query(in_cad)[1]]
    lamp = np.column_stack([centres, np.full(len(rooms), 2.2)])[room]
    light = _light(points, unit_normals(scan.vertices, scan.faces)[ids], lamp, rng)
    return np.clip(colour * light[:, None], 0, 1)


def make_atlas(
    scan: Scan, rooms: Sequence[Rect], uses: Sequence[str], texels_per_m: float, rng: np.random.Generator
) -> Atlas:
    """Unwrap and paint a scan; the rooms' `uses` are as `finishes` takes them."""
    uv, face_uv, side = unwrap(scan.vertices, scan.faces, texels_per_m)
    sheet = Image.new("I", (side, side), 0)
    draw = ImageDraw.Draw(sheet)
    for k, polygon in enumerate((uv[face_uv] - 0.5).reshape(-1, 6).tolist(), 1):
        draw.polygon(polygon, fill=k)
    ids = np.array(sheet)  # of the face that each texel shows, row 0 at v = 0; the nearest face where none does
    faces_at = (ids[tuple(nearest_cell(ids != 0))] - 1).ravel()
    rows, columns = np.divmod(np.arange(side * side), side)
    points = texel_positions(uv, face_uv, scan, faces_at, np.stack([columns + 0.5, rows + 0.5], axis=1))
    shade = paint(scan, rooms, uses, points, faces_at, rng)
    # Six bits a channel and no noise per texel: the PNG stays small.
    colour = np.round(np.round(shade * 63) * (255 / 63)).astype(np.uint8)
    return Atlas(uv / side, face_uv, colour.reshape(side, side, 3)[::-1])
