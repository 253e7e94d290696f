"""Draw textured meshes as a camera shows them; in NumPy: neither display nor GPU is needed."""

from collections.abc import Iterator

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates
from trimesh.intersections import slice_faces_plane

from converters.geometry.faces import unit_normals
from converters.records.visual import TexturedMesh
from scenes_mjcf.look import CameraPose, Lens

NEAR_M = 0.05
"""Nothing nearer is drawn."""
LAMP_W = np.array([0.35, -0.45, 0.82])
"""Where the little light comes from that is not even."""
EVEN = 0.72
"""Of the light that is."""
SQUARE = 0.35
"""Texels a pixel; colours are mixed where there are fewer."""
FRAGMENTS = 2_000_000
"""Pixels that are looked at together, of boxes about triangles."""


class Picture:
    """A picture that meshes are drawn into, near before far; white where nothing is."""

    def __init__(self, pose: CameraPose, lens: Lens) -> None:
        """Start an empty picture."""
        self._pose, self._lens = pose, lens
        self._depth = np.full(lens.height * lens.width, np.inf)
        self._colours = np.full((len(self._depth), 3), 255, np.uint8)

    @property
    def image(self) -> np.ndarray:
        """Return (rows, columns, 3) uint8."""
        return self._colours.reshape(self._lens.height, self._lens.width, 3)

    def draw(self, mesh: TexturedMesh, one_sided: bool = False, below_m: float = np.inf) -> None:
        """Draw a mesh."""
        assert mesh.corner_uv is not None and mesh.texture is not None
        lens, eye, axes_w = self._lens, self._pose.pos_w, self._pose.axes_w
        points, uv = mesh.vertices[mesh.faces].reshape(-1, 3), mesh.corner_uv.reshape(-1, 2)
        faces = np.arange(len(points)).reshape(-1, 3)
        if one_sided:
            faces = faces[(unit_normals(points, faces) * (eye - points[::3])).sum(axis=1) > 0]
        points, faces, uv = slice_faces_plane(points, faces, axes_w[:, 0], eye + NEAR_M * axes_w[:, 0], uv)
        if np.isfinite(below_m):
            points, faces, uv = slice_faces_plane(points, faces, np.array([0, 0, -1]), np.array([0, 0, below_m]), uv)
        depth, x, y = np.moveaxis((points[faces] - eye) @ axes_w, -1, 0)
        size, uv = np.array([lens.width, lens.height]), np.asarray(uv)[faces]
        pixels = np.stack([x, -y], axis=-1) / lens.pixel / depth[..., None] + size / 2
        keep = np.flatnonzero(_areas(pixels) > 1e-9)
        light = (EVEN + (1 - EVEN) * np.abs(unit_normals(points, faces) @ LAMP_W))[keep]
        depth, pixels, uv = depth[keep], pixels[keep], uv[keep]
        texture, between = _fitted(mesh.texture, _areas(uv), _areas(pixels), depth.min(axis=1, initial=np.inf))
        low, high = np.ceil(pixels.min(axis=1) - 0.5), np.floor(pixels.max(axis=1) - 0.5) + 1
        low, high = (np.clip(v, 0, size).astype(int) for v in (low, high))
        inverse = np.linalg.inv(np.dstack([pixels, np.ones_like(depth)]) * depth[..., None])
        for part, face, at in _fragments(low, np.maximum(high, low)):
            share = np.einsum("nk,nkc->nc", np.column_stack([at + 0.5, np.ones(len(at))]), inverse[part][face])
            outside = share < -1e-6 * np.abs(share).sum(axis=1, keepdims=True)  # no gaps between neighbours
            inside = np.flatnonzero(~outside.any(axis=1))
            face, share = part[face[inside]], share[inside] / share[inside].sum(axis=1, keepdims=True)
            far = (share * depth[face]).sum(axis=1)
            where = at[inside, 1] * lens.width + at[inside, 0]
            order = np.flatnonzero(far < self._depth[where])
            order = order[np.argsort(-far[order], kind="stable")]  # the nearest is written last
            face, share, where = face[order], share[order], where[order]
            self._depth[where] = far[order]
            colours = _looked_up(texture, np.einsum("nc,ncd->nd", share, uv[face]), between)
            self._colours[where] = colours * light[face, None]


def _areas(corners: np.ndarray) -> np.ndarray:
    """Return twice the areas (m,) of triangles (m, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _looked_up(texture: np.ndarray, uv: np.ndarray, between: bool) -> np.ndarray:
    """Return (n, 3) colours at texture coordinates (n, 2): the nearest texel's, or `between` four."""
    at = (np.stack([1 - uv[:, 1] % 1, uv[:, 0] % 1], axis=1) * texture.shape[:2]).T - 0.5
    return np.stack([map_coordinates(texture[..., k], at, order=int(between), mode="nearest") for k in range(3)], -1)


def _fragments(low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield blocks of boxes: which boxes (p,), and of every pixel in them which of these (n,) and where (n, 2)."""
    count = (high - low).prod(axis=1)
    some = np.flatnonzero(count)
    for part in np.split(some, np.flatnonzero(np.diff(np.cumsum(count[some]) // FRAGMENTS)) + 1):
        box = np.repeat(np.arange(len(part)), count[part])
        step = np.arange(len(box)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
        wide = (high - low)[part, 0][box]
        yield part, box, low[part][box] + np.stack([step % wide, step // wide], axis=1)


def _fitted(
    texture: np.ndarray, uv_areas: np.ndarray, pixels: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Return the texture with no more texels than it has pixels in the picture, and whether one shows as a square.

    Areas are of faces (m,), in texture coordinates and pixels; what was cut at the near plane does not count.
    """
    rows, columns = texture.shape[:2]
    front = depth > 2 * NEAR_M
    per_pixel = np.sqrt(uv_areas[front].sum() * rows * columns / max(pixels[front].sum(), 1.0))
    factor = min(int(per_pixel), rows, columns)
    small = texture if factor < 2 else np.asarray(Image.fromarray(texture).reduce(factor))
    return small, bool(per_pixel < SQUARE)
