"""The cut takes furniture and leaves floor and walls; masses and moments by hand."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from converters.bodies.objects import MATERIALS, physical_properties, place_object, upright
from converters.geometry.boxes import Hull, convex_hull
from converters.geometry.faces import face_labels, loose_parts
from converters.read.annotations import read_scan2cad
from converters.records.raw import WALL
from converters.structure.clean import cut_furniture, depth_in_hulls
from tests.converters import tiny_raw


def cube(side: float, centre=(0.0, 0.0, 0.0)) -> Hull:
    return convex_hull(trimesh.creation.box((side,) * 3).vertices + np.asarray(centre))


def placed_objects(raw):
    """The tiny room's objects with the CAD's convex hull as only hull (no decomposition needed here)."""
    objects = []
    for k, annotation in enumerate(raw.annotations):
        cad = raw.cads[annotation.cad_id]
        pose, _ = upright(annotation.pose, np.zeros(3))
        hulls = (convex_hull(cad.vertices),)
        objects.append(place_object(f"{annotation.category}_{k}", annotation, cad, hulls, pose, 0.3, 0.0))
    return tuple(objects)


def test_place_object_states_base_and_yaw(scan2cad_raw):
    table, basket = placed_objects(read_scan2cad(scan2cad_raw))
    np.testing.assert_allclose(table.position_w, (0.9, 1.6, 0.0), atol=1e-6)
    np.testing.assert_allclose(np.abs(table.quaternion_w), (np.sqrt(0.5), 0, 0, np.sqrt(0.5)), atol=1e-6)
    np.testing.assert_allclose(np.ptp(table.vertices_b, axis=0), (1.0, 0.6, 0.7), atol=1e-6)
    np.testing.assert_allclose(basket.position_w, (2.4, 0.6, 0.0), atol=1e-6)


def test_the_cut_takes_exactly_the_furniture(scan2cad_raw):
    raw = read_scan2cad(scan2cad_raw)
    result = cut_furniture(raw.scan.vertices - [0, 0, 0.3], raw.scan.faces, raw.scan.labels, placed_objects(raw))
    label = face_labels(raw.scan.labels, raw.scan.faces)
    np.testing.assert_array_equal(result.keep, np.isin(label, (1, 2)))
    np.testing.assert_array_equal(result.owner[label == 7], 0)
    np.testing.assert_array_equal(result.owner[label == 39], 1)


def test_nothing_is_cut_out_of_a_scan_that_shows_no_furniture(scan2cad_raw):
    raw = read_scan2cad(scan2cad_raw)
    level = raw.scan.vertices - [0, 0, 0.3]
    result = cut_furniture(level, raw.scan.faces, raw.scan.labels, placed_objects(raw), furnished=False)
    assert result.keep.all() and len(result.keep) == len(raw.scan.faces) and (result.owner == -1).all()


def test_unlabelled_things_on_a_table_go_with_it_and_a_shelf_beside_stays(scan2cad_raw):
    raw = read_scan2cad(scan2cad_raw)
    book = trimesh.creation.box((0.2, 0.2, 0.05)).subdivide().subdivide().apply_translation((0.9, 1.6, 0.75))
    shelf = trimesh.creation.box((0.3, 0.8, 1.0)).subdivide().subdivide().apply_translation((2.0, 1.8, 0.5))
    vertices, faces = raw.scan.vertices - [0, 0, 0.3], raw.scan.faces
    labels = np.concatenate([raw.scan.labels, np.zeros(len(book.vertices), int), np.full(len(shelf.vertices), 3)])
    first, second = len(vertices), len(vertices) + len(book.vertices)
    vertices = np.vstack([vertices, book.vertices, shelf.vertices])
    faces = np.vstack([faces, book.faces + first, shelf.faces + second])
    result = cut_furniture(vertices, faces, labels, placed_objects(raw))
    in_book = (faces[:, 0] >= first) & (faces[:, 0] < second)
    assert not result.keep[in_book].any() and (result.owner[in_book] == 0).all()
    assert result.keep[faces[:, 0] >= second].all()


def test_face_labels_take_the_majority():
    labels = np.array([1, 1, 2, 2, 3])
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 0, 3], [0, 2, 4]])
    np.testing.assert_array_equal(face_labels(labels, faces), [1, 2, 2, 1])


def test_loose_parts_join_over_shared_vertices():
    points = np.random.default_rng(0).random((8, 3))
    pieces = loose_parts(points, np.array([[0, 1, 2], [2, 3, 4], [5, 6, 7]]))
    assert pieces[0] == pieces[1] != pieces[2]


def test_loose_parts_join_over_equal_positions():
    """Two triangles of a square that share no vertex, and one that is a micrometre away on a scale of a metre."""
    square = np.array(
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 0, 0), (1, 1, 0), (0, 1, 0), (1.1, 1, 0), (1.2, 1, 0), (1.1, 2, 0)]
    )
    pieces = loose_parts(square.astype(float), np.arange(9).reshape(3, 3))
    assert pieces[0] == pieces[1] != pieces[2]


def test_only_what_a_cut_leaves_hanging_is_debris(scan2cad_raw):
    """Two specks of 50 cm2 in the air: one was never part of anything that is cut, one hung on the basket."""
    raw = read_scan2cad(scan2cad_raw)
    objects = placed_objects(raw)
    vertices = raw.scan.vertices - [0, 0, tiny_raw.FLOOR_M]
    plain = cut_furniture(vertices, raw.scan.faces, raw.scan.labels, objects)
    speck = np.array([(1.5, 1.0, 1.2), (1.6, 1.0, 1.2), (1.5, 1.1, 1.2)])
    count = len(vertices)
    cut = cut_furniture(
        np.vstack([vertices, speck]), np.vstack([raw.scan.faces, [[count, count + 1, count + 2]]]),
        np.concatenate([raw.scan.labels, [WALL] * 3]), objects,
    )  # fmt: skip
    np.testing.assert_array_equal(cut.keep[:-1], plain.keep)
    assert cut.keep[-1] and not plain.keep.all()


def test_depth_in_a_cube_by_hand():
    points = np.array([[0, 0, 0], [0.4, 0, 0], [0.7, 0, 0]])
    np.testing.assert_allclose(depth_in_hulls(points, (cube(1.0),)), [-0.5, -0.1, 0.2], atol=1e-12)


def test_mass_and_moments_of_two_cubes_by_hand():
    # Two cubes of 0.3 m, centres 0.6 m apart along x: volume 2 * 0.027 = 0.054 m3.
    result = physical_properties("chair", (cube(0.3, (0, 0, 0.15)), cube(0.3, (0.6, 0, 0.15))))
    mass = MATERIALS["chair"].density_kg_m3 * 0.054  # 6.21 kg, inside 4 to 8
    assert result.mass_kg == pytest.approx(mass)
    assert result.volume_m3 == pytest.approx(0.054)
    np.testing.assert_allclose(result.com_b, (0.3, 0, 0.15), atol=1e-9)
    # Each half: m/2 * s^2 / 6 about its own centre, plus m/2 * 0.3^2 about y and z.
    own, moved = mass * 0.3**2 / 6, mass * 0.3**2
    np.testing.assert_allclose(result.inertia_b, np.diag([own, own + moved, own + moved]), atol=1e-9)


@pytest.mark.parametrize(("side", "mass"), [(0.05, 0.5), (1.0, 2.0)])
def test_mass_is_clipped_to_what_the_real_thing_weighs(side, mass):
    result = physical_properties("basket", (cube(side),))
    assert result.mass_kg == mass
    np.testing.assert_allclose(np.diag(result.inertia_b), mass * side**2 / 6)
