"""Textures: texels land on the surface, seen ones take the scan's colour, unseen ones their neighbours'."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from converters.geometry.faces import simplify
from converters.records.raw import ColourCloud, ScanMesh, VisualMesh
from converters.write.texture import (
    bake_object,
    bake_structure,
    colour_cloud,
    fill_image,
    quantise,
    share_plain,
    texel_surface,
)

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def cloud_over(mesh: trimesh.Trimesh, colour, keep=lambda p: np.ones(len(p), bool)) -> ColourCloud:
    points, face = trimesh.sample.sample_surface(mesh, 4000, seed=0)[:2]
    chosen = keep(points)
    normals = mesh.face_normals[face][chosen]
    return ColourCloud(np.asarray(points)[chosen], normals, np.tile(np.array(colour, float), (chosen.sum(), 1)))


def test_texels_of_a_square_that_fills_the_image():
    uv = SQUARE[:, :2]
    texel, point, face = texel_surface(SQUARE, TRIANGLES, uv, TRIANGLES, 4)
    np.testing.assert_array_equal(texel, np.arange(16))
    row, column = np.divmod(texel, 4)
    # Image rows run downwards: a texel's middle is at u = (column + 0.5) / 4, v = 1 - (row + 0.5) / 4.
    np.testing.assert_allclose(point[:, 0], (column + 0.5) / 4)
    np.testing.assert_allclose(point[:, 1], 1 - (row + 0.5) / 4)
    assert set(face) == {0, 1}


def test_fill_spreads_the_nearest_colour():
    image = fill_image(np.array([0, 15]), np.array([[10.0, 0, 0], [0, 20.0, 0]]), 4)
    np.testing.assert_array_equal(image[0, 1], [10, 0, 0])
    np.testing.assert_array_equal(image[3, 2], [0, 20, 0])


def test_texture_of_a_scan_is_sampled_where_it_lies():
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 0] = (255, 0, 0)  # upper left
    texture[1, 1] = (0, 0, 255)  # lower right
    uv = SQUARE[:, :2][TRIANGLES]
    scan = ScanMesh(SQUARE, TRIANGLES, uv, texture, labels=np.zeros(4, int))
    cloud = colour_cloud(scan, SQUARE, np.arange(2), 0.1)
    upper_left = (cloud.points[:, 0] < 0.5) & (cloud.points[:, 1] > 0.5)
    lower_right = (cloud.points[:, 0] > 0.5) & (cloud.points[:, 1] < 0.5)
    assert (cloud.colours[upper_left] == (255, 0, 0)).all() and upper_left.sum() > 20
    assert (cloud.colours[lower_right] == (0, 0, 255)).all() and lower_right.sum() > 20
    np.testing.assert_allclose(cloud.normals, np.tile([0, 0, 1.0], (len(cloud.points), 1)))


def test_vertex_colours_come_with_the_chosen_faces_only():
    colours = np.array([[1, 1, 1], [2, 2, 2], [3, 3, 3], [4, 4, 4]], np.uint8)
    scan = ScanMesh(SQUARE, TRIANGLES, labels=np.zeros(4, int), vertex_colours=colours)
    cloud = colour_cloud(scan, SQUARE, np.array([1]))
    np.testing.assert_array_equal(cloud.colours[:, 0], [1, 3, 4])


def as_is(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_object_takes_scan_colours_and_in_paints_the_rest():
    mesh = trimesh.creation.box((1, 1, 1)).subdivide().subdivide()
    grey = np.full((len(mesh.faces), 3), 128, np.uint8)
    upper = cloud_over(mesh, (200, 40, 40), lambda p: p[:, 2] > 0)
    visual, seen = bake_object(*as_is(mesh), grey, upper, as_is(mesh), 64)
    assert 0.4 < seen < 0.65  # the upper half of the cube, and 8 cm more
    assert np.abs(visual.image.astype(int) - (200, 40, 40)).max() <= 1  # in-painted from seen neighbours
    assert visual.uv.min() >= 0 and visual.uv.max() <= 1


def test_each_material_is_in_painted_from_itself():
    mesh = trimesh.creation.box((1, 1, 1)).subdivide().subdivide()
    left = mesh.triangles_center[:, 0] < 0
    colours = np.where(left[:, None], [10, 10, 10], [250, 250, 250]).astype(np.uint8)
    red = cloud_over(mesh, (200, 0, 0), lambda p: (p[:, 2] > 0.2) & (p[:, 0] < -0.1))
    blue = cloud_over(mesh, (0, 0, 200), lambda p: (p[:, 2] > 0.2) & (p[:, 0] > 0.1))
    both = ColourCloud(*(np.vstack([getattr(red, f), getattr(blue, f)]) for f in ("points", "normals", "colours")))
    visual, _ = bake_object(*as_is(mesh), colours, both, as_is(mesh), 64)
    texel, point, _ = texel_surface(visual.vertices, visual.faces, visual.uv, visual.uv_faces, 64)
    shown = visual.image.reshape(-1, 3)[texel].astype(int)
    low = point[:, 2] < -0.1  # unseen by the scan
    assert (shown[low & (point[:, 0] < -0.1), 0] > 150).mean() > 0.97
    assert (shown[low & (point[:, 0] > 0.1), 2] > 150).mean() > 0.97


def test_an_object_that_the_scan_does_not_show_keeps_its_cad_colour():
    mesh = trimesh.creation.box((1, 1, 1))
    empty = ColourCloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    colours = np.full((12, 3), 77, np.uint8)
    visual, seen = bake_object(*as_is(mesh), colours, empty, as_is(mesh), 32)
    assert seen == 0.0 and (visual.image == 77).all()


def test_simplify_keeps_the_shape_and_the_limit():
    sphere = trimesh.creation.icosphere(4)
    vertices, faces = simplify(np.asarray(sphere.vertices), np.asarray(sphere.faces), 500)
    assert len(faces) <= 500 and faces.max() == len(vertices) - 1
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(sphere.volume, rel=0.03)


def test_structure_takes_the_clouds_colours():
    sphere = trimesh.creation.icosphere(2)
    visual = bake_structure(np.asarray(sphere.vertices), np.asarray(sphere.faces), cloud_over(sphere, (90, 90, 90)), 64)
    assert len(visual.faces) == len(sphere.faces) and visual.uv_faces.shape == visual.faces.shape
    assert (visual.image == 90).all()


def test_both_sides_of_a_thin_wall_keep_their_colours():
    """The cloud's points lie nearer to the other side here and there."""
    square = trimesh.Trimesh(SQUARE, TRIANGLES, process=False)
    front, back = cloud_over(square, (200, 0, 0)), cloud_over(square, (0, 0, 200))
    both = ColourCloud(
        np.vstack([front.points, back.points]),
        np.vstack([front.normals, -back.normals]),
        np.vstack([front.colours, back.colours]),
    )
    vertices = np.vstack([SQUARE, SQUARE])
    faces = np.vstack([TRIANGLES, TRIANGLES[:, ::-1] + 4])
    shares = []
    for turned_m in (0.0, 0.1):
        visual = bake_structure(vertices, faces, both, 64, turned_m)
        texel, _, face = texel_surface(vertices, faces, visual.uv, visual.uv_faces, 64)
        shown = visual.image.reshape(-1, 3)[texel]
        shares.append(
            float((np.abs(shown - np.where((face < 2)[:, None], (200, 0, 0), (0, 0, 200))) < 2).all(1).mean())
        )
    assert shares[0] < 0.9 and shares[1] == 1.0


def test_quantised_colours_stay_close():
    ramp = np.tile(np.arange(256, dtype=np.uint8)[:, None, None], (1, 8, 3)) // np.array([1, 2, 4], np.uint8)
    back = np.asarray(quantise(ramp, 64).convert("RGB")).astype(int)
    assert np.abs(back - ramp).max() <= 8


def test_faces_of_one_colour_look_up_one_place_and_the_rest_is_blank():
    """Two red triangles, a blue one and a striped one, in the quarters of an image with noise between them."""
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    for (row, column), colour in {(2, 2): [255, 0, 0], (2, 34): [255, 0, 0], (34, 2): [0, 0, 255]}.items():
        image[row : row + 26, column : column + 26] = colour
    image[34:60, 34:60] = np.where(np.arange(26)[:, None, None] % 4 < 2, 0, 255)
    corner = np.array([[3, 3], [25, 3], [3, 25]])
    uv = np.concatenate([corner + [x, y] for y, x in ((2, 2), (2, 34), (34, 2), (34, 34))]) / 64
    uv[:, 1] = 1 - uv[:, 1]
    vertices, faces = np.hstack([uv, np.zeros((12, 1))]), np.arange(12).reshape(4, 3)
    visual = VisualMesh(vertices, faces, uv, faces, image)
    made = share_plain(visual)
    assert len(made.uv) == 5 and (np.ptp(made.uv[made.uv_faces[:3]], axis=1) == 0).all()
    assert (made.uv[made.uv_faces[3]] == uv[9:]).all() and (made.faces == faces).all()
    for weights in ([0.8, 0.1, 0.1], [0.2, 0.5, 0.3]):
        before, after = (
            [
                v.image[int((1 - y) * 64), int(x * 64)].tolist()
                for x, y in np.tensordot(weights, v.uv[v.uv_faces], (0, 1))
            ]
            for v in (visual, made)
        )
        assert before == after
    assert len(np.unique(made.image[:28, 34:].reshape(-1, 3), axis=0)) == 1
    assert share_plain(made).uv.tolist() == made.uv.tolist()
    noise = dataclasses.replace(visual, image=np.random.default_rng(1).integers(0, 255, (64, 64, 3), np.uint8))
    assert share_plain(noise) is noise
