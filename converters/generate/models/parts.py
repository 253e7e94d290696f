"""Sizes in, convex pieces of furniture out: boxes, cushions, bars and legs, in metres, y up."""

from __future__ import annotations

import dataclasses

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

MATERIALS: dict[str, tuple[float, float, float]] = {
    "oak": (0.72, 0.53, 0.34), "walnut": (0.38, 0.25, 0.17), "white": (0.90, 0.89, 0.86),
    "black": (0.13, 0.13, 0.14), "steel": (0.60, 0.61, 0.63), "navy": (0.18, 0.24, 0.40),
    "moss": (0.34, 0.42, 0.27), "rust": (0.62, 0.31, 0.19), "linen": (0.78, 0.73, 0.64),
    "slate": (0.36, 0.40, 0.44),
}  # fmt: skip
"""Material name -> diffuse RGB in 0..1."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One convex piece."""

    vertices: np.ndarray
    """(n, 3) float64."""
    faces: np.ndarray
    """(m, 3) int64, counter-clockwise from outside."""
    material: str
    """Key of `MATERIALS`."""
    open: bool = False
    """Written without its underside."""


def box(center, size, material, tilt_rad=0.0, open=False) -> Part:
    """A box; `tilt_rad` turns it about x (positive: the top leans back, towards -z)."""
    mesh = trimesh.creation.box(extents=size)
    turn = Rotation.from_euler("x", -tilt_rad).as_matrix()
    vertices = np.asarray(mesh.vertices) @ turn.T + np.asarray(center, float)
    return Part(vertices, np.asarray(mesh.faces), material, open)


def cushion(center, size, material, chamfer=0.03, tilt_rad=0.0) -> Part:
    """A box with cut edges."""
    half = np.asarray(size, float) / 2
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    cut = min(chamfer, 0.45 * half.min())
    points = np.concatenate([signs * (half - cut * (1 - np.eye(3)[i])) for i in range(3)])
    mesh = trimesh.convex.convex_hull(points)
    turn = Rotation.from_euler("x", -tilt_rad).as_matrix()
    vertices = np.asarray(mesh.vertices) @ turn.T + np.asarray(center, float)
    return Part(vertices, np.asarray(mesh.faces), material)


def bar(start, end, radius, material, sides=8) -> Part:
    """A prism of `sides` sides from `start` to `end`; `radius` is a number, or a pair (at start, at end)."""
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


def four_legs(width, depth, height, thick, material, splay=0.0, square=True) -> list[Part]:
    """Legs under the corners of a `width` x `depth` top whose underside is at `height`."""
    legs = []
    for sx in (-1, 1):
        for sz in (-1, 1):
            x, z = sx * (width / 2 - thick), sz * (depth / 2 - thick)
            foot = (x + sx * splay, 0.0, z + sz * splay)
            sides, radius = (4, thick * 0.7) if square else (10, (thick * 0.4, thick * 0.6))
            legs.append(bar(foot, (x, height, z), radius, material, sides))
    return legs
