"""Draw textured meshes as a camera shows them; in NumPy: neither display nor GPU is needed."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from PIL import Image

from converters.geometry.faces import face_vectors
from converters.records.visual import TexturedMesh

NEAR_M, FAR_M = 0.05, 100.0
"""Nothing nearer is drawn; rays that are parallel begin so far off."""
LAMP_W = np.array([0.35, -0.45, 0.82])
"""Where the little light comes from that is not even."""
EVEN = 0.72
"""Of the light that is."""
SQUARE = 0.35
"""Texels a pixel; colours are mixed where there are fewer."""
FRAGMENTS = 2_000_000
"""Pixels that are looked at together, of boxes about triangles."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """Where a picture is taken from."""

    eye_w: np.ndarray
    """(3,) m; of parallel rays any point that nothing visible lies behind."""
    axes_w: np.ndarray
    """(3, 3) rows: what runs to the right, what runs up, what looks at the reader."""
    shape: tuple[int, int]
    """Rows and columns."""
    focal: float
    """Pixels; of parallel rays, pixels a metre."""
    parallel: bool = False

    def project(self, points_w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return homogeneous pixels (..., 3), columns first, rows downwards, and metres in front of the eye (...)."""
        turned = (points_w - self.eye_w) @ self.axes_w.T
        depth = -turned[..., 2]
        weight = np.ones_like(depth) if self.parallel else depth
        rows, columns = self.shape
        x, y = self.focal * turned[..., 0] + columns / 2 * weight, rows / 2 * weight - self.focal * turned[..., 1]
        return np.stack([x, y, weight], axis=-1), depth


def looking_at(eye_w: np.ndarray, at_w: np.ndarray, shape: tuple[int, int], view_rad: float) -> Camera:
    """Return a camera with an upright picture that is `view_rad` wide; it does not look straight up or down."""
    toward = (eye_w - at_w) / np.linalg.norm(eye_w - at_w)
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    return Camera(eye_w, np.stack([right, np.cross(toward, right), toward]), shape, shape[1] / 2 / np.tan(view_rad / 2))


def over(axes_w: np.ndarray, low: np.ndarray, high: np.ndarray, pixel_m: float) -> Camera:
    """Return a camera of parallel rays over a rectangle.

    Args:
        axes_w: (3, 3) as a `Camera` has them.
        low: (2 or 3,) m along these axes, lower left corner of the picture.
        pixel_m: width of a pixel; the picture is some whole pixels large, from the lower left corner on.
    """
    columns, rows = np.ceil((high - low)[:2] / pixel_m).astype(int).tolist()
    middle = low[:2] + np.array([columns, rows]) * pixel_m / 2
    return Camera(np.array([*middle, FAR_M]) @ axes_w, axes_w, (rows, columns), 1 / pixel_m, True)


class Picture:
    """A picture that meshes are drawn into, near before far; white where nothing is."""

    def __init__(self, camera: Camera) -> None:
        """Start an empty picture."""
        self._camera = camera
        self._depth = np.full(camera.shape[0] * camera.shape[1], np.inf)
        self._colours = np.full((len(self._depth), 3), 255, np.uint8)

    @property
    def image(self) -> np.ndarray:
        """Return (rows, columns, 3) uint8."""
        return self._colours.reshape(*self._camera.shape, 3)

    def draw(self, mesh: TexturedMesh, one_sided: bool = False, below_m: float = np.inf) -> None:
        """Draw a mesh."""
        assert mesh.corner_uv is not None and mesh.texture is not None
        corners = mesh.vertices[mesh.faces]
        normal = face_vectors(mesh.vertices, mesh.faces)
        pixels, depth = self._camera.project(corners)
        with np.errstate(all="ignore"):
            inverse = np.linalg.det(pixels)
        good = (np.abs(inverse) > 1e-9) & (depth > NEAR_M).any(axis=1)
        if one_sided:
            rays = self._camera.axes_w[2] if self._camera.parallel else self._camera.eye_w - corners[:, 0]
            good &= (normal * rays).sum(axis=1) > 0
        good &= corners[..., 2].min(axis=1) < below_m
        keep = np.flatnonzero(good)
        if not len(keep):
            return
        light = EVEN + (1 - EVEN) * np.abs(normal @ LAMP_W) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
        low, high = _boxes(pixels[keep], depth[keep], self._camera.shape)
        texture, between = _fitted(mesh.texture, mesh.corner_uv[keep], pixels[keep])
        inverse = np.linalg.inv(pixels[keep])
        for part, face, at in _fragments(low, high):
            share = np.einsum("nk,nkc->nc", np.column_stack([at + 0.5, np.ones(len(at))]), inverse[part][face])
            inside = np.flatnonzero((share >= 0).all(axis=1))
            face, share = keep[part][face[inside]], share[inside] / share[inside].sum(axis=1, keepdims=True)
            far = (share * depth[face]).sum(axis=1)
            where = at[inside, 1] * self._camera.shape[1] + at[inside, 0]
            shown = (far > NEAR_M) & (far < self._depth[where])
            if np.isfinite(below_m):
                shown &= (share * corners[face, :, 2]).sum(axis=1) < below_m
            order = np.flatnonzero(shown)
            order = order[np.argsort(-far[order], kind="stable")]  # the nearest is written last
            face, share, where = face[order], share[order], where[order]
            uv = np.einsum("nc,ncd->nd", share, mesh.corner_uv[face])
            self._depth[where] = far[order]
            self._colours[where] = _looked_up(texture, uv, between) * light[face, None]


def _looked_up(texture: np.ndarray, uv: np.ndarray, between: bool) -> np.ndarray:
    """Return (n, 3) colours at texture coordinates (n, 2): the nearest texel's, or `between` four."""
    size = np.array(texture.shape[1::-1])
    at = np.stack([uv[:, 0] % 1.0, 1.0 - uv[:, 1] % 1.0], axis=1) * size - 0.5 * between
    first = np.floor(at).astype(int)
    (x, y), (right, down) = first.T, (at - first).T[..., None]
    column, row = (np.clip(np.stack([v, v + 1]), 0, n - 1) for v, n in zip((x, y), size, strict=True))
    if not between:
        return texture[row[0], column[0]]
    top, bottom = (texture[r, column[0]] * (1 - right) + texture[r, column[1]] * right for r in row)
    return top * (1 - down) + bottom * down


def _boxes(pixels: np.ndarray, depth: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return (m, 2) first pixel and the one after the last of boxes about triangles, of what lies before the eye."""
    after, after_depth = np.roll(pixels, -1, axis=1), np.roll(depth, -1, axis=1)
    with np.errstate(all="ignore"):
        share = ((NEAR_M - depth) / (after_depth - depth))[..., None]
        points = np.concatenate([pixels, pixels + share * (after - pixels)], axis=1)
        crossed = (depth > NEAR_M) != (after_depth > NEAR_M)
        valid = np.concatenate([depth > NEAR_M, crossed], axis=1)[..., None]
        points = points[..., :2] / points[..., 2:]
        low, high = np.where(valid, points, np.inf).min(axis=1), np.where(valid, points, -np.inf).max(axis=1)
    size = np.array(shape[::-1])
    low, high = np.clip(np.ceil(low - 0.5), 0, size), np.clip(np.floor(high - 0.5) + 1, 0, size)
    return low.astype(int), np.maximum(high, low).astype(int)


def _fragments(low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield blocks of boxes: which boxes (p,), and of every pixel in them which of these (n,) and where (n, 2)."""
    count = (high - low).prod(axis=1)
    some = np.flatnonzero(count)
    for part in np.split(some, np.flatnonzero(np.diff(np.cumsum(count[some]) // FRAGMENTS)) + 1):
        box = np.repeat(np.arange(len(part)), count[part])
        step = np.arange(len(box)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
        wide = (high - low)[part, 0][box]
        yield part, box, low[part][box] + np.stack([step % wide, step // wide], axis=1)


def _fitted(texture: np.ndarray, uv: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the texture with no more texels than it has pixels in the picture, and whether one shows as a square."""

    def area(corners: np.ndarray) -> float:
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())

    front = (pixels[..., 2] > NEAR_M).all(axis=1)
    shown = area(pixels[front, :, :2] / pixels[front, :, 2:])
    per_pixel = np.sqrt(area(uv[front]) * texture.shape[0] * texture.shape[1] / max(shown, 1.0))
    factor = min(int(per_pixel), *texture.shape[:2])
    small = texture if factor < 2 else np.asarray(Image.fromarray(texture).reduce(factor))
    return small, bool(per_pixel < SQUARE)
