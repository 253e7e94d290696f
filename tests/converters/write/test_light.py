"""Light in drawn homes: where lamps and windows shine, and what hides them; textures that do not bleed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from converters.read.obj import join_textures
from converters.records.raw import Lamp, Window
from converters.write.light import AMBIENT, GAIN, daylight, light_on
from converters.write.texture import APART, texel_surface, unwrap

UP = np.array([0.0, 0.0, 1.0])
ALL_AROUND = np.array([0.88, 0.88, 0.889])
"""1.4 times 0.65 and 0.66, of which a tenth is beyond 0.8: 0.8 + 0.3 (1 - exp(-0.11 / 0.3))."""


def plane(low: tuple[float, float], high: tuple[float, float], z: float = 0.0) -> np.ndarray:
    """Points of a level rectangle, 3 cm apart."""
    x, y = (np.arange(a, b + 0.01, 0.03) for a, b in zip(low, high, strict=True))
    return np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z)], -1).reshape(-1, 3)


def test_a_lamp_tints_what_is_below_it_but_not_what_a_table_hides():
    floor, table = plane((-3, -3), (3, 3)), plane((0.4, -0.4), (1.2, 0.4), 0.7)
    red = Lamp(np.array([0.0, 0.0, 2.0]), np.array([0.5, 0.0, 0.0]))
    light = daylight(np.vstack([floor, table]), [red], [])
    places = np.array([[-1.2, 0.0, 0.0], [1.2, 0.0, 0.0], [-2.8, -2.8, 0.0]])
    bare, shaded, far = light(places, np.tile(UP, (3, 1)))
    assert bare[0] > far[0] > 0.8 and bare[0] - bare[2] > 0.05 + far[0] - far[2]
    assert bare[1:] == pytest.approx(ALL_AROUND[1:], abs=0.04)  # a red lamp adds no green
    assert shaded[0] < bare[0] - 0.05


def test_daylight_comes_through_a_window_and_not_through_the_wall_beside_it():
    floor, wall = plane((-3, 0), (3, 4)), plane((-3, 0), (3, 2.4))[:, [0, 2, 1]]
    window = Window(np.array([-1.5, 0.0, 1.5]), np.array([0.5, 0.1, 0.6]), 0.0)
    light = daylight(np.vstack([floor, wall]), [], [window])
    before, beside = light(np.array([[-1.5, 1.0, 0.0], [2.5, 1.0, 0.0]]), np.tile(UP, (2, 1)))
    assert (before > beside + 0.1).all() and beside == pytest.approx(ALL_AROUND, rel=0.1)


def test_a_corner_is_darker():
    floor, wall = plane((0, 0), (2, 2)), plane((0, 0), (2, 2))[:, [0, 2, 1]]
    points = np.vstack([floor, wall])
    normals = np.repeat(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), [len(floor), len(wall)], axis=0)
    bright = light_on(points, normals, daylight(points, [], []))
    middle, corner = (np.linalg.norm(floor[:, :2] - at, axis=1).argmin() for at in ([1.2, 1.2], [1.2, 0.03]))
    assert (bright[corner] < 0.9 * bright[middle]).all()
    assert bright.max() <= (GAIN * AMBIENT).max() + 1e-6


def test_light_shows_no_pattern_of_the_places_where_it_is_computed():
    points = plane((0, 0), (2, 2))
    bright = light_on(points, np.tile(UP, (len(points), 1)), lambda at, _: np.repeat(at[:, :1] ** 2, 3, axis=1))
    across = bright[:, 0].reshape(67, 67)[10:-10]  # rows along x: light depends on x alone
    assert np.ptp(across, axis=0).max() < 0.02
    assert across.mean(axis=0)[10:-10] == pytest.approx((0.03 * np.arange(67))[10:-10] ** 2, abs=0.05)


def test_joined_images_show_no_neighbour_within_two_texels():
    images = [np.full((8, 8, 3), value, np.uint8) for value in (40, 200)]
    corners = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]] * 2)
    uv, joint = join_textures(corners, np.arange(2), images)
    height, width = joint.shape[:2]
    for k, value in enumerate((40, 200)):
        ends = np.rint([uv[k, :, 0] * width, (1 - uv[k, :, 1]) * height]).astype(int)
        (left, top), (right, bottom) = ends.min(axis=1) - 2, ends.max(axis=1) + 2
        assert (bottom - top, right - left) == (12, 12) and (joint[top:bottom, left:right] == value).all()


def test_charts_of_an_atlas_keep_apart():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    parts = [square + [0, 0, 1.7 * k] for k in range(5)]
    faces = np.vstack([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(5)])
    uv, uv_faces = unwrap(np.vstack(parts), faces, 256)
    texel, _, face = texel_surface(np.vstack(parts), faces, uv, uv_faces, 256)
    owner = np.full(256 * 256, -1)
    owner[texel] = face // 2
    owner = owner.reshape(256, 256)
    for k in range(5):
        away = np.asarray(distance_transform_edt(owner != k))
        assert away[(owner >= 0) & (owner != k)].min() >= APART
