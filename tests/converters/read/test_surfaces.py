"""Labels by shape and the check of the axes, on the tiny room whose true labels are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from converters.geometry.faces import face_areas, face_labels
from converters.read.annotations import gap_to_scan
from converters.read.gibson import read_gibson
from converters.read.obj import TexturedMesh
from converters.read.surfaces import check_upright, floor_level, structure_labels, with_split_corners
from converters.records.errors import SceneRejected
from converters.records.raw import CEILING, FLOOR, WALL, Annotation
from tests.converters import tiny_raw


@pytest.fixture(scope="module")
def room():
    vertices, faces, labels = tiny_raw.scan()
    tall = vertices.copy()  # walls of 2.4 m instead of 1.5
    tall[labels == WALL, 2] = tiny_raw.FLOOR_M + (vertices[labels == WALL, 2] - tiny_raw.FLOOR_M) * 1.6
    up = np.cross(tall[faces[:, 1]] - tall[faces[:, 0]], tall[faces[:, 2]] - tall[faces[:, 0]])[:, 2]
    down = (labels[faces] == FLOOR).all(axis=1) & (up < 0)
    faces = faces.copy()
    faces[down] = faces[down][:, ::-1]
    return tall, faces, labels


def test_floor_and_walls_are_told_by_shape(room):
    vertices, faces, labels = room
    found = structure_labels(vertices, faces, tiny_raw.FLOOR_M)
    for kind in (FLOOR, WALL):
        assert (found[labels == kind] == kind).mean() > 0.95
    furniture = ~np.isin(labels, (FLOOR, WALL))
    # The basket's bottom plate lies on the floor and faces down; nothing of the furniture is floor or wall.
    assert np.isin(found[furniture], (FLOOR, WALL)).mean() < 0.02


def test_a_right_mesh_passes_with_and_without_labels(room):
    vertices, faces, labels = room
    check_upright("scan", vertices, faces, labels, 0.0)
    check_upright("scan", vertices, faces, None, tiny_raw.FLOOR_M)


@pytest.mark.parametrize("labelled", [True, False])
def test_y_up_is_told_by_the_floor(room, labelled):
    vertices, faces, labels = room
    y_up = vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T  # (x, y, z) -> (x, z, -y)
    with pytest.raises(
        SceneRejected, match=r"the mesh is y up, expected z up; turn it: \(x, y, z\) becomes \(x, -z, y\)"
    ):
        check_upright("scan", y_up, faces, labels if labelled else None, tiny_raw.FLOOR_M)
    turned = y_up @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T  # the remedy, as the message has it
    np.testing.assert_allclose(turned, vertices, atol=1e-12)


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("mirror", [[-1, 1, 1], [1, -1, 1]])
def test_a_left_handed_mesh_is_told_by_the_floor(room, labelled, mirror):
    vertices, faces, labels = room
    with pytest.raises(SceneRejected, match="the floor faces down .* left-handed"):
        check_upright("scan", vertices * mirror, faces, labels if labelled else None, tiny_raw.FLOOR_M)


def test_a_floor_at_another_height_or_unit(room):
    vertices, faces, _ = room
    with pytest.raises(SceneRejected, match="0.00 m2 lie level at the floor's height of 1.2 m"):
        check_upright("scan", vertices, faces, None, 1.2)
    with pytest.raises(SceneRejected, match="check floors.txt, the mesh's axes"):
        check_upright("scan", vertices * 10, faces, None, tiny_raw.FLOOR_M)


def large_room(size=(6.0, 5.0, 2.6)) -> TexturedMesh:
    """Six walls of two triangles each, front inwards, textured by where they lie."""
    box = trimesh.creation.box(size).apply_translation((0, 0, size[2] / 2))
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)[:, ::-1]
    uv = vertices[faces][..., :2] / 10 + 0.5
    return TexturedMesh(vertices, faces, uv, np.zeros((8, 8, 3), np.uint8))


def test_large_faces_are_floor_or_wall_as_a_whole():
    mesh = large_room()
    own = with_split_corners(mesh)
    assert len(own.vertices) == 8 + 36 and own.corner_uv is mesh.corner_uv
    np.testing.assert_array_equal(own.vertices[own.faces], mesh.vertices[mesh.faces])
    found = face_labels(structure_labels(own.vertices, own.faces, 0.0), own.faces)
    area = face_areas(own.vertices, own.faces)
    assert area[found == FLOOR].sum() == area[found == CEILING].sum() == pytest.approx(30.0)
    assert area[found == WALL].sum() == pytest.approx(2 * (6 + 5) * 2.6)
    assert floor_level(own.vertices, own.faces, "scan") == 0.0
    low = trimesh.creation.box((2.0, 1.0, 1.0)).apply_translation((0, 0, 0.5))  # no wall
    table = with_split_corners(TexturedMesh(np.asarray(low.vertices), np.asarray(low.faces), None, None))
    assert WALL not in structure_labels(table.vertices, table.faces, 0.0)


def test_the_gap_to_a_scan_is_to_its_surface():
    none = np.zeros((0, 3))
    box = Annotation("table", "t", np.eye(4), "", none, none)
    cad = np.asarray(trimesh.creation.box((1.0, 1.0, 1.0)).vertices)
    far = 20.0 * np.array([(-1, -1, 0), (1, -1, 0), (0, 2, 0)], float)
    for height, gap in ((0.3, 0.0), (1.5, 1.0), (-4.5, 4.0)):
        assert gap_to_scan(box, cad, far + [0, 0, height], np.array([[0, 1, 2]])) == pytest.approx(gap)
    wall = np.array([(2, 1.5, -5), (2, 30, -5), (2, 1.5, 40)], float)  # its edge stands askew of the box
    assert gap_to_scan(box, cad, wall, np.array([[0, 1, 2]])) == pytest.approx(np.hypot(1.5, 1.0))


def test_objects_in_the_middle_of_large_faces_stand_in_the_scan(tmp_path):
    """Distances are to the surface: all vertices of this room are metres away from its furniture."""
    root = tiny_raw.write_gibson(tmp_path / "room")
    low = [-3.0, -3.0, tiny_raw.FLOOR_M]
    box = trimesh.creation.box((8.0, 8.0, 2.6)).apply_translation(np.array(low) + [4.0, 4.0, 1.3])
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"f {c + 1} {b + 1} {a + 1}" for a, b, c in box.faces]
    (root / "mesh_z_up.obj").write_text("\n".join(lines) + "\n")
    for name in ("floor_trav_0.png", "floor_0.png", "labels.npz"):
        (root / name).unlink(missing_ok=True)
    for extra in root.glob("*.npz"):
        extra.unlink()
    assert len(read_gibson(root).annotations) == len(tiny_raw.ITEMS)
