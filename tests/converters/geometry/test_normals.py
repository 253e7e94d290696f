"""Normals at the corners of faces, by hand, and as MuJoCo reads them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import trimesh

from converters.geometry.faces import corner_normals, unit_normals
from converters.write.emit import write_obj
from scenes_mjcf.look import mesh_normals


def cylinder(sides: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.cylinder(0.2, 0.5, sections=sides)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def wanted(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Radial at the side's corners, along the axis at the lids'."""
    radial = vertices[faces] * [1, 1, 0]
    flat = unit_normals(vertices, faces)
    lid = np.abs(flat[:, 2]) > 0.5
    return np.where(lid[:, None, None], flat[:, None], radial / 0.2)


def test_a_cylinder_is_smooth_around_and_sharp_at_its_lids_however_its_sides_are_cut():
    vertices, faces = cylinder(16)
    assert corner_normals(vertices, faces) == pytest.approx(wanted(vertices, faces), abs=1e-9)
    # Faces that share no vertices, in another order, are the same surface.
    order = np.random.default_rng(0).permutation(len(faces))
    apart = vertices[faces[order]].reshape(-1, 3)
    again = corner_normals(apart, np.arange(len(apart)).reshape(-1, 3))
    assert again == pytest.approx(wanted(vertices, faces)[order], abs=1e-9)
    eight = cylinder(8)  # 45 degrees from side to side: creases
    flat = unit_normals(*eight)[:, None]
    assert corner_normals(*eight) == pytest.approx(np.broadcast_to(flat, (len(flat), 3, 3)), abs=1e-9)


def test_a_face_without_an_area_takes_no_part():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 0, 0]], float)
    normals = corner_normals(vertices, np.array([[0, 1, 2], [0, 3, 1]]))
    assert normals[0].tolist() == [[0, 0, 1]] * 3 and np.isfinite(normals).all()


def test_files_of_what_is_curved_have_normals_which_mujoco_reads(tmp_path):
    uv = np.zeros((1, 2))
    box = trimesh.creation.box((1, 1, 1))
    for name, (vertices, faces), smooth, told in (
        ("smooth", cylinder(16), True, True),
        ("plain", cylinder(16), False, False),
        ("box", (np.asarray(box.vertices), np.asarray(box.faces)), True, False),
    ):
        path = tmp_path / f"{name}.obj"
        write_obj(path, vertices, faces, uv, np.zeros_like(faces), smooth=smooth)
        assert ("\nvn " in path.read_text()) == told
        spec = mujoco.MjSpec()
        spec.add_mesh(name="mesh", file=str(path), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
        model = spec.compile()
        normals = mesh_normals(model, 0)
        assert (normals is not None) == told
        if normals is not None:
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
            turn = turn.reshape(3, 3)
            points = model.mesh_vert @ turn.T + model.mesh_pos[0]
            assert normals @ turn.T == pytest.approx(wanted(points, model.mesh_face.astype(int)), abs=0.05)


def test_what_is_equal_is_written_once_the_commonest_first(tmp_path):
    """Two triangles of one colour that share an edge, with corners of their own, and one whose corners coincide."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 0, 0], [3, 0, 0], [1, 1, 1e-6], [1, 1, 2e-6]], float)
    faces, uv = np.array([[0, 1, 2], [3, 4, 5], [2, 5, 6]]), np.array([[0.2, 0.5], [0.5, 0.5], [0.5, 0.50001]])
    write_obj(tmp_path / "mesh.obj", vertices, faces, uv, np.array([[1, 1, 1], [2, 2, 2], [0, 0, 0]]))
    lines = (tmp_path / "mesh.obj").read_text().splitlines()
    assert lines == ["v 1 0 0", "v 1 1 0", "v 0 0 0", "v 3 0 0", "vt .5 .5", "f 2/1 3/1 1/1 4/1"]
