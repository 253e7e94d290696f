"""Up is found whatever frame and unit a scan comes in, or asked for; oracle: the frame it was turned from."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from converters.read.files import read_mesh
from converters.read.surfaces import AXES, find_unit, find_up, turn_upright
from converters.records.errors import SceneRejected
from tests.converters import tiny_raw


@functools.cache
def tiny() -> tuple[np.ndarray, np.ndarray]:
    vertices, faces, _ = tiny_raw.scan()
    return vertices, faces


def box_room(size: tuple[float, float, float], ceiling: bool) -> tuple[np.ndarray, np.ndarray]:
    """A room of twelve triangles (ten without its ceiling) that look inwards."""
    box = trimesh.creation.box(size)
    faces = np.asarray(box.faces)[:, ::-1]
    down = np.asarray(box.face_normals)[:, 2] > 0.9  # the ceiling's front looks down
    return np.asarray(box.vertices), faces if ceiling else faces[~down]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1.0, 100.0, 1000.0]))
def test_a_furnished_room_is_found_upright_from_any_turn(seed, scale):
    vertices, faces = tiny()
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    up = find_up(scale * vertices @ turn.T, faces, "scan")
    assert np.degrees(np.arccos(np.clip(up @ turn[:, 2], -1, 1))) < 0.5
    back = scale * vertices @ turn.T @ turn_upright(up).T
    assert find_unit(back, faces, "scan") == {1.0: "m", 100.0: "cm", 1000.0: "mm"}[scale]


@pytest.mark.data
@pytest.mark.parametrize("part", ["whole", "half the floor gone", "upper half gone"])
def test_the_real_room_is_found_upright(sample_data, part):
    mesh = read_mesh(sample_data / "scan2cad_scene0470_00" / "scan" / "scene0470_00_vh_clean_2.ply")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    middle = vertices[faces].mean(axis=1)
    floor = middle[:, 2] < vertices[:, 2].min() + 0.1
    gone = {
        "whole": np.zeros(len(faces), bool),
        "half the floor gone": floor & (middle[:, 0] > np.median(middle[:, 0])),
        "upper half gone": middle[:, 2] > 0.9,
    }[part]
    for seed in range(3):
        turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
        up = find_up(vertices @ turn.T, faces[~gone], "scan")
        assert np.degrees(np.arccos(np.clip(up @ turn[:, 2], -1, 1))) < 1.0


def test_an_empty_room_without_a_ceiling_is_told_by_its_floor():
    vertices, faces = box_room((4.0, 3.0, 2.5), ceiling=False)
    np.testing.assert_allclose(find_up(vertices, faces, "scan"), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(find_up(vertices * [1, 1, -1], faces[:, ::-1], "scan"), [0, 0, -1], atol=1e-9)


@pytest.mark.parametrize(
    ("room", "message"),
    [
        (box_room((4.0, 3.0, 2.5), True), "floor and its ceiling look alike"),
        (box_room((2.6, 2.6, 2.5), True), "do not tell which is its height"),
        ((np.eye(3), np.array([[0, 1, 2]])), "shows one direction of surface only"),
        ((np.zeros((3, 3)), np.array([[0, 1, 2]])), "enclose no area"),
    ],
)
def test_what_does_not_tell_is_asked_for(room, message):
    with pytest.raises(SceneRejected, match=message):
        find_up(room[0], room[1], "scan")


@pytest.mark.parametrize("height", [0.5, 8.2, 50.0, 1e5])
def test_a_height_of_no_storey_is_asked_for(height):
    vertices, faces = box_room((2 * height, 2 * height, height), True)
    with pytest.raises(SceneRejected, match="say its unit with --unit"):
        find_unit(vertices, faces, "scan")


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31))
def test_turns_are_turns(seed):
    up = np.random.default_rng(seed).normal(size=3)
    up /= np.linalg.norm(up)
    for axis in (up, *AXES.values()):
        turn = turn_upright(axis)
        np.testing.assert_allclose(turn @ axis, [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(turn) == pytest.approx(1.0)


def test_a_mesh_without_area_has_no_height():
    points = np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0)], float)
    with pytest.raises(SceneRejected, match="is 0 units high"):
        find_unit(points, np.array([[0, 1, 2]]), "line")
