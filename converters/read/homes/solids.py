"""Build meshes of polygons in plan and of height fields."""

from typing import Any

import numpy as np
import shapely

from converters.records.visual import TexturedMesh


def flat(region: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (n, 3) at z = 0 and the faces (m, 3), which look up, of polygons in plan."""
    polygons = [p for p in shapely.get_parts(region) if shapely.get_type_id(p) == 3 and shapely.area(p) > 1e-6]
    triangles = [t for p in polygons for t in shapely.get_parts(shapely.constrained_delaunay_triangles(p))]
    corners = [shapely.get_coordinates(shapely.orient_polygons(t))[:3] for t in triangles if shapely.area(t) > 1e-9]
    plan = np.array(corners).reshape(-1, 2)
    return np.column_stack([plan, np.zeros(len(plan))]), np.arange(len(plan)).reshape(-1, 3)


def height_field(height_m: np.ndarray, half_m: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a surface over the plane around the origin.

    `height_m`: [rows along y, columns along x].
    """
    rows, columns = height_m.shape
    x, y = np.meshgrid(np.linspace(-half_m[0], half_m[0], columns), np.linspace(-half_m[1], half_m[1], rows))
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return np.column_stack([x.ravel(), y.ravel(), height_m.ravel()]), faces


def rectangle(x_m: float, y_m: float) -> TexturedMesh:
    """Return an uncoloured rectangle around the origin that looks up, from its half sides."""
    corners = np.array([(-x_m, -y_m, 0), (x_m, -y_m, 0), (x_m, y_m, 0), (-x_m, y_m, 0)], float)
    return TexturedMesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), None, None)
