"""What is written of equal objects: files once, compiled as each of them was."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import KDTree

from converters.bodies.objects import PlacedObject, physical_properties
from converters.check.pictures import geom_surface
from converters.geometry.boxes import convex_hull, fit_box
from converters.records.raw import VisualMesh
from converters.write.emit import SceneParts, paired, write_obj, write_scene
from scenes_mjcf.look import geom_mesh

WIDE = np.array([1.1, 0.95, 1.0])
IMAGE = np.random.default_rng(0).integers(0, 255, (16, 8, 3), np.uint8)


def box(name: str, scale: np.ndarray, x_m: float) -> tuple[PlacedObject, VisualMesh]:
    mesh = trimesh.creation.icosphere(1, 0.2)
    vertices, faces = (np.asarray(mesh.vertices) + [0.0, 0.0, 0.2]) * scale, np.asarray(mesh.faces)
    hull = convex_hull(vertices)
    placed = PlacedObject(
        name, "box", "ball", vertices, faces, np.zeros((len(faces), 3), np.uint8), (hull,), (fit_box(hull, 0.0, 0.0),),
        np.array([x_m, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), None,
    )  # fmt: skip
    uv = np.random.default_rng(1).random((len(vertices), 2))
    return placed, VisualMesh(vertices, faces, uv, faces, IMAGE, exact=True)


def test_equal_objects_share_their_files_and_keep_their_vertices(tmp_path):
    """Two equal bodies, a wider one, and one of the same shape in another colour."""
    one, wide = np.ones(3), WIDE
    made = [box(f"box_{k}", scale, 2.0 * k) for k, scale in enumerate((one, one, wide, one))]
    made[3] = made[3][0], dataclasses.replace(made[3][1], image=255 - IMAGE)
    objects, visuals = (tuple(v) for v in zip(*made, strict=True))
    physical = tuple(physical_properties("box", o.hulls_b) for o in objects)
    write_scene(SceneParts("four", objects, physical, (), None, visuals), tmp_path)

    names = sorted(p.name for p in (tmp_path / "assets").iterdir())
    assert names == ["box_0.png", "box_0_hull_0.obj", "box_0_visual.obj", "box_2_hull_0.obj", "box_3.png"]
    with Image.open(tmp_path / "assets" / "box_0.png") as image:
        assert (np.asarray(image.convert("RGB")) == IMAGE).all()
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    for placed, visual in made:
        drawn = geom_surface(model, model.geom(f"{placed.name}_visual").id)
        assert drawn.corner_uv is not None and drawn.texture is not None
        corners = np.concatenate([visual.vertices[visual.faces], visual.uv[visual.uv_faces]], axis=2)
        turned = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)]).reshape(-1, 15)
        found = np.concatenate([drawn.vertices[drawn.faces], drawn.corner_uv], axis=2).reshape(-1, 15)
        far, index = KDTree(turned).query(found)
        assert far.max() < 2e-3 and np.sort(np.asarray(index) % len(corners)).tolist() == list(range(len(corners)))
        assert (drawn.texture == visual.image).all()
        hull = geom_mesh(model, model.geom(f"{placed.name}_hull_0").id)[0]
        assert np.abs(np.sort(hull, axis=0) - np.sort(placed.hulls_b[0].vertices, axis=0)).max() < 2e-5


def test_two_triangles_are_a_quad_where_every_reader_finds_the_same_two(tmp_path):
    """A square, two slopes that meet in a short ridge, two in a long one, which is not the shorter diagonal."""
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [5, 4, 7], [8, 9, 10], [9, 8, 11]])
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    short, long = ([[x, 3, 0], [x + ridge, 3, 0], [x, 4, 1], [x, 2, 1]] for x, ridge in ((0, 0.5), (2, 4)))
    vertices = np.array([*square, *short, *long], float)
    uv = vertices[:, :2] / 10
    assert paired(faces, 1e4 * np.hstack([vertices, uv])) == [[0, 1, 2, 3], [5, 6, 4, 7], [8, 9, 10], [9, 8, 11]]
    write_obj(tmp_path / "mesh.obj", vertices, faces, uv, faces)
    written = (tmp_path / "mesh.obj").read_text().splitlines()
    assert "v .5 3 0" in written and "vt .1 .1" in written
    polygons = [line.split()[1:] for line in written if line[0] == "f"]
    assert [len(polygon) for polygon in polygons] == [4, 4, 3, 3]
    own = trimesh.load(tmp_path / "mesh.obj", process=False)
    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh", file=str(tmp_path / "mesh.obj"), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    for read, cut in ((own.vertices, own.faces), geom_mesh(spec.compile(), 0)):
        found = np.round(np.asarray(read, float)[cut], 4) + 0.0
        for ridge in (faces[2:4], faces[4:]):
            for face in ridge:
                wanted = sorted(vertices[face].tolist())
                assert any(sorted(t) == wanted for t in found.tolist())
        flat = found[(found[:, :, 2] == 0).all(axis=1) & (found[:, :, 1] <= 1).all(axis=1)]
        normals = np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
        assert len(flat) == 2 and normals.tolist() == [[0.0, 0.0, 1.0]] * 2
