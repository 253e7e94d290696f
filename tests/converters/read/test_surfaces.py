"""Labels by shape and the check of the axes, on the tiny room whose true labels are known."""

from __future__ import annotations

import numpy as np
import pytest

from converters.read.surfaces import check_upright, structure_labels
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR, WALL
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
    check_upright("scan", vertices, faces, labels, None)
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
        check_upright("scan", vertices * 100, faces, None, tiny_raw.FLOOR_M)
