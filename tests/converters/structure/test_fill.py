"""Patches: nothing is seen through where something was hidden, nothing that was seen is covered."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import trimesh

from converters.geometry.faces import face_areas, sample_faces
from converters.structure.fill import BEHIND_M, FREE, OVERLAP, Plane, Shown, faces_in_plane, wall_planes
from interactive_nav_common.rotations import yaw_matrix

LEVEL = 0.004
WALL = Plane(np.array([0.0, 2.0, 0.0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))
GROUND = Plane(np.array([0.0, 0.0, LEVEL]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
CELL_M, PAD = 0.025, 8
FLOOR_BOX, WALL_BOX = (0, 0, 2, 2), (0, LEVEL, 2, 1.5)


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


def patches(vertices, faces, plane: Plane, box) -> tuple[np.ndarray, np.ndarray]:
    """Of what is not seen whole of a box (left, bottom, right, top) in a plane."""
    points, _ = sample_faces(vertices, faces[faces_in_plane(vertices, faces, plane)], CELL_M / 2)
    low, size = np.array(box[:2]) - PAD * CELL_M, np.round((np.array(box[2:]) - box[:2]) / CELL_M).astype(int)
    shown = Shown.of(plane, points, low, (size[1] + 2 * PAD, size[0] + 2 * PAD), CELL_M)
    wanted = np.zeros(shown.visible.shape, bool)
    wanted[PAD:-PAD, PAD:-PAD] = True
    return shown.patches(wanted & ~shown.visible)


def hits(vertices: np.ndarray, faces: np.ndarray, eye: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(k,) distance in which MuJoCo's rays from an eye towards targets meet the mesh; -1 where nothing is met."""
    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="m", uservert=vertices.ravel(), userface=faces.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rays = targets - eye
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ids, distance = np.zeros(len(rays), np.int32), np.zeros(len(rays))
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), None, 1, -1, ids, distance, None, len(rays), 100.0)
    return distance


def behind_a_sofa(c: np.ndarray) -> np.ndarray:
    """A hole over the edge between floor and wall, and one in the floor alone."""
    sofa = (c[:, 0] > 0.55) & (c[:, 0] < 1.25) & (c[:, 1] > 1.35) & (c[:, 2] < 0.75)
    return sofa | (np.hypot(c[:, 0] - 0.6, c[:, 1] - 0.6) < 0.2)


@pytest.mark.parametrize("relief_m", [0.0, 0.015, 0.04])
def test_no_ray_from_within_the_room_passes_floor_or_wall(relief_m):
    vertices, whole = corner()
    faces = without(vertices, whole, behind_a_sofa)
    # Reconstructed walls wave: their border vertices do not lie on the plane.
    waves = (vertices[:, 2] > LEVEL + 1e-6) & (vertices[:, 2] < 1.5)
    vertices[waves, 1] += relief_m * np.sin(9 * vertices[waves, 0]) * np.sin(7 * vertices[waves, 2])
    rng = np.random.default_rng(0)
    floor = np.column_stack([*rng.uniform(0.05, 1.95, (2, 4000)), np.full(4000, LEVEL)])
    wall = np.column_stack([rng.uniform(0.05, 1.95, 4000), np.full(4000, 2.0), rng.uniform(LEVEL, 1.45, 4000)])
    targets = np.vstack([floor, wall])
    filled = vertices, faces
    for patch in (patches(vertices, faces, GROUND, FLOOR_BOX), patches(vertices, faces, WALL, WALL_BOX)):
        filled = np.vstack([filled[0], patch[0]]), np.vstack([filled[1], patch[1] + len(filled[0])])
    for eye in (np.array([1.0, 0.3, 1.2]), np.array([0.2, 1.6, 1.4]), np.array([1.9, 1.0, 0.3])):
        intact, holed = hits(vertices, whole, eye, targets), hits(vertices, faces, eye, targets)
        closed = hits(*filled, eye, targets)
        hidden, seen = (holed < 0) & (intact > 0), holed > 0
        assert hidden.sum() > 500
        assert (closed[hidden] > 0).mean() >= (1.0 if relief_m < 0.02 else 0.996)
        # Hardly anything that was seen is covered, and then by millimetres; what was hidden is near where it was.
        assert (seen & (closed < holed - 1e-6)).sum() < 0.015 * seen.sum()
        assert (holed - closed)[seen].max() < 1.5 * relief_m + 1e-6
        assert np.median(np.abs(closed - intact)[hidden]) < 0.06


def test_patches_lie_behind_the_scan_and_reach_under_it():
    vertices, faces = corner()
    faces = without(vertices, faces, behind_a_sofa)
    points, triangles = patches(vertices, faces, GROUND, FLOOR_BOX)
    assert set(np.round(points[:, 2], 9)) == {LEVEL - BEHIND_M}
    # The round hole covers squares of 0.1 m; the sofa's is 0.7 x 0.6 m at the wall. Around both lies the overlap.
    area = face_areas(points, triangles).sum()
    hole = 4.0 - face_areas(vertices, faces[(vertices[faces][:, :, 2] == LEVEL).all(axis=1)]).sum()
    assert hole + 0.1 * 2.5 < area < hole + 0.125 * 4.0 + 0.2


def test_a_patch_is_behind_the_rearmost_scan_around_it():
    vertices, faces = corner()
    faces = without(vertices, faces, behind_a_sofa)
    vertices[(np.abs(vertices[:, 0] - 0.5) < 0.01) & (vertices[:, 2] > LEVEL + 0.01), 1] += 0.03
    points, _ = patches(vertices, faces, WALL, WALL_BOX)
    near = (points[:, 0] < 0.5) & (points[:, 2] > 0.15) & (points[:, 2] < 0.6)
    assert near.any() and (points[near, 1] > 2.02).all() and points[:, 1].max() < 2.035


def test_a_door_way_stays_open():
    """A region that ends at an opening is not built on beyond it, but for what hides behind the wall."""
    vertices, faces = corner()
    faces = without(vertices, faces, lambda c: (c[:, 2] > LEVEL) & (c[:, 0] > 0.5) & (c[:, 0] < 1.5))
    points, _ = patches(vertices, faces, WALL, (0.5, LEVEL, 0.8, 1.0))
    assert points[:, 0].max() == pytest.approx(0.8 + FREE * CELL_M)
    assert points[:, 0].min() == pytest.approx(0.5 - OVERLAP * CELL_M)


def test_nothing_missing_adds_nothing():
    vertices, faces = corner()
    assert len(patches(vertices, faces, GROUND, FLOOR_BOX)[1]) == 0


def test_patches_look_along_the_normals():
    vertices, faces = corner()
    faces = without(vertices, faces, behind_a_sofa)
    for plane, box in ((GROUND, FLOOR_BOX), (WALL, WALL_BOX)):
        points, triangles = patches(vertices, faces, plane, box)
        a, b, c = (points[triangles[:, k]] for k in range(3))
        assert len(triangles) and (np.cross(b - a, c - a) @ plane.normal > 0).all()


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
