"""Pictures of quads whose pixels one can work out, and of a scene whose objects must be seen."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from trimesh.intersections import slice_faces_plane

from converters.check.pictures import (
    Picture,
    _taken,
    at_eye_height,
    camera_axes,
    from_the_south,
    mesh_picture,
    world_surfaces,
)
from converters.generate.models.cad import cad_model
from converters.records.raw import TexturedMesh
from scenes_mjcf.look import GLASS, CameraPose, Lens, look_along, over
from scenes_mjcf.schema import load_maps

RED, BLUE, MAGENTA = (200, 0, 0), (0, 0, 200), (255, 0, 255)
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Looks along +y, x to the right."""


def ahead(shape: tuple[int, int], focal: float) -> tuple[CameraPose, Lens]:
    """A camera at the origin that looks along +y, of so many pixels focal length."""
    lens = Lens(shape[1], shape[0], math.degrees(2 * math.atan(shape[0] / 2 / focal)))
    return look_along(np.zeros(3), np.array([0.0, 1.0, 0.0])), lens


def wall(y_m: float, half_m: float, texture: np.ndarray) -> TexturedMesh:
    """A square about (0, y, 0) that looks along -y; the texture's left is at -x."""
    vertices = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * half_m + [0, y_m, 0]
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return TexturedMesh(vertices, faces, uv[faces], texture)


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.tile(np.array(colour, np.uint8), (4, 4, 1))


def hue(picture: np.ndarray) -> np.ndarray:
    """(rows, columns) 'r', 'b' or '.' where it is white."""
    return np.where(picture.min(axis=2) == 255, ".", np.where(picture[..., 0] > picture[..., 2], "r", "b"))


def test_the_nearer_wall_hides_the_farther_as_perspective_has_it():
    """Focal length 20: a half metre two metres off is 5 pixels from the middle, two metres four metres off are 10."""
    picture = Picture(*ahead((40, 40), 20.0))
    picture.draw(wall(2.0, 0.5, plain(RED)))
    picture.draw(wall(4.0, 2.0, plain(BLUE)))
    seen = hue(picture.image)
    assert (seen[15:25, 15:25] == "r").all() and (seen == "r").sum() == 100
    assert (seen[10:30, 10:30] != ".").all() and (seen == "b").sum() == 300


def test_glass_is_mixed_with_what_is_behind_it_in_whichever_order_it_comes():
    """Both walls are upright and as bright, so 0.3 of the pane's colour shows with 0.7 of the red one's."""
    red, pane = wall(4.0, 3.0, plain(RED)), wall(2.0, 0.5, plain(GLASS))
    shown = []
    for order in ({"far": red, "pane": pane}, {"pane": pane, "far": red}, {"far": red}, {"pane": pane}):
        shown.append(_taken(*ahead((40, 40), 20.0), order).astype(float)[20, 20])
    bright = shown[2][0] / RED[0]
    assert 0.7 < bright <= 1.0
    assert np.abs(shown[0] - bright * (0.3 * np.array(GLASS) + 0.7 * np.array(RED))).max() < 1.5
    assert (shown[1] == shown[0]).all()
    assert np.abs(shown[3] - (0.3 * bright * np.array(GLASS) + 0.7 * 255)).max() < 1.5  # white where nothing is


@pytest.mark.parametrize("parallel", [False, True])
def test_texels_stand_where_their_coordinates_say(parallel):
    texture = np.array([[RED, BLUE], [BLUE, BLUE]], np.uint8)  # red at the upper left
    picture = Picture(
        *(over(UPRIGHT, np.full(2, -1.25), np.full(2, 1.25), 0.125) if parallel else ahead((20, 20), 8.0))
    )
    picture.draw(wall(1.0, 1.0, texture))
    seen = hue(picture.image)
    assert (seen[2:8, 2:8] == "r").all() and (seen[12:18, 2:18] == "b").all() and (seen[2:8, 12:18] == "b").all()


def test_a_face_seen_from_behind_is_left_out_where_sides_matter_and_none_above_the_cut():
    away = wall(2.0, 1.0, plain(RED))
    away = dataclasses.replace(away, faces=away.faces[:, ::-1])
    for one_sided, below_m, count in ((True, np.inf, 0), (False, np.inf, 400), (False, 0.0, 200)):
        picture = Picture(*ahead((40, 40), 20.0))
        picture.draw(away, one_sided, below_m)
        assert (hue(picture.image) == "r").sum() == count


@pytest.mark.parametrize("width_m", [0.0, 1e-9, 1e-7])
def test_the_cut_leaves_out_slivers_which_have_no_texture_coordinates(width_m):
    """The walls are 200 pixels below the cut, with a sliver along the diagonal or without one."""
    whole = wall(2.0, 1.0, plain(RED))
    vertices = np.vstack([whole.vertices, whole.vertices[2] + [width_m, 0, 0]])
    faces = np.vstack([whole.faces, [0, 2, 4]])
    assert whole.corner_uv is not None
    uv = np.concatenate([whole.corner_uv, np.zeros((1, 3, 2))])
    picture = Picture(*ahead((40, 40), 20.0))
    picture.draw(TexturedMesh(vertices, faces, uv, whole.texture), below_m=0.0)
    assert (hue(picture.image) == "r").sum() == 200


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_trimesh_still_cuts_slivers_into_nan():
    """When this fails (trimesh's issue 1889), `nondegenerate` in `Picture.draw` can go."""
    corners = np.array([[-1.0, 0, -1], [1, 0, 1], [1 + 1e-9, 0, 1]])
    _, _, uv = slice_faces_plane(corners, np.array([[0, 1, 2]]), np.array([0, 0, -1.0]), np.zeros(3), np.zeros((3, 2)))
    assert np.isnan(np.asarray(uv)).any()


def test_a_floor_that_passes_under_the_eye_fills_the_lower_half():
    corners = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    floor = dataclasses.replace(wall(0.0, 1.0, plain(RED)), vertices=corners)
    picture = Picture(look_along(np.array([0.0, 0, 1.5]), np.array([1.0, 0, 0])), Lens(40, 30, 60.0))
    picture.draw(floor, one_sided=True)
    seen = hue(picture.image)
    assert (seen[17:] == "r").all() and (seen[:15] == ".").all()


def test_both_views_of_a_scene_show_an_object(tiny_scene):
    folder = tiny_scene[0]
    model, maps = mujoco.MjModel.from_xml_path(str(folder / "scene.xml")), load_maps(folder)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    surfaces = world_surfaces(model, data)
    marked = {k: v if k == "structure" else dataclasses.replace(v, texture=plain(MAGENTA)) for k, v in surfaces.items()}
    low, high = (getattr(surfaces["structure"].vertices, f)(axis=0)[:2] for f in ("min", "max"))
    for picture in (
        from_the_south(marked, maps, low, high, 120),
        at_eye_height(model, data, marked, maps, (90, 120)),
    ):
        shown = (picture[..., 0] > 150) & (picture[..., 2] > 150) & (picture[..., 1] < 60)
        assert picture.shape[1] == 120 and 0.01 < shown.mean() < 0.6


def test_the_reader_of_a_models_picture_stands_before_right_of_and_above_it():
    axes = camera_axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert (axes[2] > 0).all() and axes[2, 2] > axes[2, 0] and axes[1, 1] > 0.9 and axes[0, 1] == 0


def test_a_model_is_drawn_in_its_colours_and_fills_the_picture():
    surface = cad_model("Scopia/chair").surface
    assert surface is not None
    mesh = TexturedMesh(surface.vertices, surface.faces, surface.uv[surface.uv_faces], surface.image)
    picture = mesh_picture(mesh, camera_axes(), 120)
    used = np.argwhere((picture < 255).any(axis=2))
    assert (used.min(axis=0).min(), used.max(axis=0).max()) == (4, 115)  # it fills 94 % of the longer side
    shade = picture[tuple(used.T)].max(axis=0)
    assert (shade <= surface.image.reshape(-1, 3).max(axis=0)).all() and len(used) > 2000
