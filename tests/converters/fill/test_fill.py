"""Patches: they join the hole's border vertex by vertex, floor and wall patch each other, nothing else changes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import trimesh

from converters.fill.patches import Plane, border_edges, fill_planes, floor_plane, wall_planes
from converters.geometry.faces import face_areas
from converters.structure.cut import face_pieces
from interactive_nav_common.rotations import yaw_matrix

LEVEL = 0.004
WALL = Plane(np.array([0.0, 2.0, 0.0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))
FLOOR_BOX, WALL_BOX = shapely.box(0, 0, 2, 2), shapely.box(0, LEVEL, 2, 1.5)


def corner(step: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """A floor of 2 x 2 m and a wall of 2 x 1.5 m on its far side, one mesh of squares cut in two."""
    n, m = round(2 / step), round(1.5 / step)
    x = np.linspace(0, 2, n + 1)
    rows = [(y, LEVEL) for y in np.linspace(0, 2, n + 1)] + [(2.0, z) for z in np.linspace(LEVEL, 1.5, m + 1)[1:]]
    vertices = np.array([(a, y, z) for y, z in rows for a in x])
    index = np.arange(len(vertices)).reshape(len(rows), n + 1)
    a, b, c, d = (v.ravel() for v in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return vertices, np.vstack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def without(vertices, faces, gone) -> np.ndarray:
    return faces[~gone(vertices[faces].mean(axis=1))]


def rim(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(k, 2, 3) border edges that are not on the outer rim of the corner."""
    ends = vertices[border_edges(faces)[0]]
    on = np.zeros(len(ends), bool)
    for axis, value in ((0, 0.0), (0, 2.0), (1, 0.0), (2, 1.5)):
        on |= (np.abs(ends[:, :, axis] - value) < 1e-9).all(axis=1)
    return ends[~on]


def behind_a_sofa(c: np.ndarray) -> np.ndarray:
    """A hole over the edge between floor and wall, and one in the floor alone."""
    sofa = (c[:, 0] > 0.55) & (c[:, 0] < 1.25) & (c[:, 1] > 1.35) & (c[:, 2] < 0.75)
    return sofa | (np.hypot(c[:, 0] - 0.6, c[:, 1] - 0.6) < 0.2)


@pytest.mark.parametrize("relief_m", [0.0, 0.015])
def test_floor_and_wall_patches_make_the_corner_watertight_again(relief_m):
    vertices, faces = corner()
    faces = without(vertices, faces, behind_a_sofa)
    # Reconstructed walls wave: their border vertices do not lie on the plane.
    waves = (vertices[:, 2] > LEVEL + 1e-6) & (vertices[:, 2] < 1.5)
    vertices[waves, 1] += relief_m * np.sin(9 * vertices[waves, 0]) * np.sin(7 * vertices[waves, 2])
    assert len(rim(vertices, faces)) > 20
    filled = fill_planes(vertices, faces, [(floor_plane(LEVEL), FLOOR_BOX, 0.05), (WALL, WALL_BOX, 0.04)])
    assert len(rim(filled.vertices, filled.faces)) == 0
    # One mesh: every edge has at most two faces, and each patch's border vertices are the hole's own.
    edges = np.sort(np.vstack([filled.faces[:, [0, 1]], filled.faces[:, [1, 2]], filled.faces[:, [2, 0]]]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    np.testing.assert_array_equal(filled.vertices[: len(vertices)], vertices)
    hole = np.unique(border_edges(faces)[0])
    patch = filled.faces[filled.source_face < 0]
    assert set(np.unique(patch)) - set(range(len(vertices))) <= set(range(len(vertices), len(filled.vertices)))
    inner = [v for v in hole if len(rim(vertices, faces)) and not _on_rim(vertices[v])]
    assert set(inner) <= set(np.unique(patch).tolist())
    if relief_m == 0.0:
        assert face_areas(filled.vertices, filled.faces).sum() == pytest.approx(2 * 2 + 2 * (1.5 - LEVEL))
    assert len(set(face_pieces(filled.faces, len(filled.vertices)).tolist())) == 1


def _on_rim(point: np.ndarray) -> bool:
    return point[0] in (0.0, 2.0) or point[1] == 0.0 or point[2] == 1.5


def test_a_patch_that_stops_inside_splits_the_scan_faces_it_meets():
    vertices, faces = corner()
    faces = without(vertices, faces, lambda c: c[:, 2] > 0.1)  # the wall stops at 0.1 m
    region = shapely.box(0.53, LEVEL, 1.27, 0.9)  # its sides meet the scan's border between two vertices
    filled = fill_planes(vertices, faces, [(WALL, region, 0.04)])
    edges, _ = border_edges(filled.faces)
    ends = filled.vertices[edges]
    top = ends[(np.abs(ends[:, :, 2] - filled.vertices[faces].reshape(-1, 3)[:, 2].max()) < 1e-9).all(axis=1)]
    covered = top[(top[:, :, 0].min(axis=1) > 0.53 - 1e-9) & (top[:, :, 0].max(axis=1) < 1.27 + 1e-9)]
    assert len(covered) == 0  # nothing of the wall's edge is open between 0.53 and 1.27
    # Scan faces were split, not moved: each is covered by its parts.
    scan = filled.source_face >= 0
    assert len(faces) < scan.sum() < len(faces) + 20
    parts = np.bincount(filled.source_face[scan], face_areas(filled.vertices, filled.faces[scan]), len(faces))
    np.testing.assert_allclose(parts, face_areas(vertices, faces), atol=1e-12)


def test_nothing_missing_changes_nothing():
    vertices, faces = corner()
    filled = fill_planes(vertices, faces, [(floor_plane(LEVEL), FLOOR_BOX, 0.05)])
    np.testing.assert_array_equal(filled.faces, faces)
    assert (filled.source_face == np.arange(len(faces))).all() and (filled.patch_plane == -1).all()


def test_patches_look_along_the_normals():
    vertices, faces = corner()
    faces = without(vertices, faces, behind_a_sofa)
    filled = fill_planes(vertices, faces, [(floor_plane(LEVEL), FLOOR_BOX, 0.05), (WALL, WALL_BOX, 0.04)])
    a, b, c = (filled.vertices[filled.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (normal[filled.patch_plane == 0, 2] > 0).all()
    assert (normal[filled.patch_plane == 1] @ WALL.normal > 0).all()


def test_ransac_finds_two_noisy_walls_among_clutter():
    rng = np.random.default_rng(0)
    parts = []
    for yaw, offset in ((0.3, 2.0), (0.3 + math.pi / 2, 1.0)):
        wall = trimesh.creation.box((4, 0.001, 2)).subdivide().subdivide().subdivide()
        points = np.asarray(wall.vertices) + [0, offset, 1.0]
        points[:, 1] += rng.normal(0, 0.008, len(points))
        parts.append(trimesh.Trimesh(points @ yaw_matrix(yaw).T, wall.faces, process=False))
    clutter = trimesh.creation.icosphere(2, 0.4).apply_translation((0, 0, 1))
    mesh = trimesh.util.concatenate([*parts, clutter])
    assert isinstance(mesh, trimesh.Trimesh)
    planes = wall_planes(np.asarray(mesh.vertices), np.asarray(mesh.faces), np.ones(len(mesh.vertices), int))
    assert len(planes) >= 2
    for yaw, offset in ((0.3, 2.0), (0.3 + math.pi / 2, 1.0)):
        normal = yaw_matrix(yaw) @ [0, 1, 0]
        best = max(planes, key=lambda p: abs(p.normal @ normal))
        assert abs(best.normal @ normal) > math.cos(math.radians(1))
        assert abs(best.origin @ normal) == pytest.approx(offset, abs=0.01)
