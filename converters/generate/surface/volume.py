"""Convex solids in, a triangle surface out: signed distances on a voxel grid, and dual contouring of them.

Surface nets (one vertex per cell that the surface crosses, at the mean of its edge crossings) give the evenly
sized triangles and rounded edges that fused depth images give.
"""

import dataclasses

import numpy as np

from converters.generate.design.instance import Instance


@dataclasses.dataclass(frozen=True)
class Solid:
    """A convex solid, as half-spaces `normals @ x <= offsets`."""

    normals: np.ndarray
    """(k, 3) unit outward normals."""
    offsets: np.ndarray
    """(k,)"""
    low: np.ndarray
    """(3,) corner of its bounding box."""
    high: np.ndarray
    """(3,)"""
    label: int
    """NYU40 id."""
    material: str
    """Key of the palette."""
    owner: int
    """Index of the movable it belongs to; -1: static structure."""
    item: Instance | None = None
    """What stands there, of which it is a part; None: floor or wall."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) -> (n,) signed distance, exact inside and beside faces, a lower bound off edges."""
        out = points @ self.normals[0] - self.offsets[0]
        for normal, offset in zip(self.normals[1:], self.offsets[1:], strict=True):
            np.maximum(out, points @ normal - offset, out=out)
        return out


def solid_from_mesh(vertices: np.ndarray, faces: np.ndarray, label: int, material: str, owner: int) -> Solid:
    """A convex mesh as half-spaces, equal planes merged."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    keep = area > 1e-10
    normals = normals[keep] / area[keep, None]
    offsets = np.einsum("ij,ij->i", normals, a[keep])
    _, first = np.unique(np.round(np.column_stack([normals, offsets]), 4), axis=0, return_index=True)
    return Solid(normals[first], offsets[first], vertices.min(axis=0), vertices.max(axis=0), label, material, owner)


def solid_from_box(low, high, label: int, material: str) -> Solid:
    """An axis-aligned box of the static structure."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    return Solid(np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]), low, high, label, material, -1)


@dataclasses.dataclass(frozen=True)
class Volume:
    """Truncated signed distances."""

    sdf: np.ndarray
    """(nx, ny, nz) float32, metres, negative inside; at `origin + voxel_m * index`."""
    origin: np.ndarray
    """(3,)"""
    voxel_m: float

    def sample(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) -> (n,) value at the nearest voxel; outside the grid: that of its border."""
        index = (points - self.origin) / self.voxel_m + 0.5
        i, j, k = (np.clip(index[:, d].astype(np.int32), 0, size - 1) for d, size in enumerate(self.sdf.shape))
        return self.sdf.ravel().take((i * self.sdf.shape[1] + j) * self.sdf.shape[2] + k)


def fuse(solids: list[Solid], low: np.ndarray, high: np.ndarray, voxel_m: float) -> Volume:
    """Writes the union of the solids into a grid that spans `low`..`high`, truncated at three voxels."""
    shape = np.ceil((high - low) / voxel_m).astype(int) + 1
    trunc = 3 * voxel_m
    sdf = np.full(tuple(shape), trunc, np.float32)
    for s in solids:
        i0 = np.clip(np.floor((s.low - trunc - low) / voxel_m).astype(int), 0, shape)
        i1 = np.clip(np.ceil((s.high + trunc - low) / voxel_m).astype(int) + 1, 0, shape)
        if (i1 <= i0).any():
            continue
        axes = [(low[k] + voxel_m * np.arange(i0[k], i1[k])).astype(np.float32) for k in range(3)]
        value = np.full(tuple(i1 - i0), -np.inf, np.float32)
        for normal, offset in zip(s.normals.astype(np.float32), s.offsets, strict=True):
            plane = (normal[0] * axes[0] - np.float32(offset))[:, None, None]
            plane = plane + (normal[1] * axes[1])[None, :, None] + (normal[2] * axes[2])[None, None, :]
            np.maximum(value, plane, out=value)
        part = sdf[tuple(slice(a, b) for a, b in zip(i0, i1, strict=True))]
        np.minimum(part, value, out=part)
    np.maximum(sdf, -trunc, out=sdf)
    return Volume(sdf, np.asarray(low, float), voxel_m)


def surface_nets(volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """Extracts the zero surface.

    Returns:
        vertices (n, 3) float64 in the volume's frame; faces (m, 3) int64, counter-clockwise from outside.
    """
    sdf = volume.sdf
    shape = np.array(sdf.shape)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    points, cells, flips = [], [], []
    for axis in range(3):
        first, second = [slice(None)] * 3, [slice(None)] * 3
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        # Only edges with all four neighbouring cells inside the grid make a quad.
        for other in {0, 1, 2} - {axis}:
            first[other] = second[other] = slice(1, -1)
        a, b = sdf[tuple(first)], sdf[tuple(second)]
        index = np.argwhere((a < 0) != (b < 0))
        index_a = index + [0 if k == axis else 1 for k in range(3)]
        va, vb = a[tuple(index.T)], b[tuple(index.T)]
        at = index_a.astype(float)
        at[:, axis] += va / (va - vb)
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corner = np.zeros((4, 3), int)
        corner[1, u], corner[2, [u, v]], corner[3, v] = -1, -1, -1
        points.append(at)
        cells.append(((index_a[:, None] + corner) * strides).sum(axis=2))
        flips.append(va >= 0)
    at, cell, flip = np.concatenate(points), np.concatenate(cells), np.concatenate(flips)
    ids, vertex = np.unique(cell, return_inverse=True)
    vertex = vertex.reshape(cell.shape)
    weight = np.bincount(vertex.ravel(), minlength=len(ids))
    flat = np.repeat(at, 4, axis=0)
    mean = np.stack([np.bincount(vertex.ravel(), flat[:, k], len(ids)) / weight for k in range(3)], axis=1)
    quads = np.where(flip[:, None], vertex[:, ::-1], vertex)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return volume.origin + volume.voxel_m * mean, faces
