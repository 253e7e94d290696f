"""Hulls and boxes do not depend on the last digits of their points, nor on how a box's axes are named."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from converters.geometry.boxes import TURNS, convex_hull, fit_box, hull_of, least_turned, upright_box
from interactive_nav_common.rotations import yaw_matrix

CUBE = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T


def noisy(points: np.ndarray, seed: int) -> np.ndarray:
    """What another processor makes of the same points."""
    return points + np.random.default_rng(seed).uniform(-1e-14, 1e-14, points.shape)


@given(st.integers(0, 50), st.floats(-3.0, 3.0), st.floats(0.1, 1.0), st.floats(0.1, 1.0))
def test_noise_changes_no_hull_and_no_box(seed, yaw, a, b):
    """A wedge and a brick, turned about a slanted axis: coplanar facets, and several boxes as small."""
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    for points in (CUBE * [a, b, 0.3], CUBE[CUBE.sum(1) < 1.5] * [a, a, b]):
        turned = np.round(points @ tilt @ yaw_matrix(yaw).T, 7) + 3e-8  # far from where rounding tips over
        one, two = convex_hull(turned), convex_hull(noisy(turned, seed)[::-1])
        np.testing.assert_array_equal(one.vertices, two.vertices)
        np.testing.assert_array_equal(one.faces, two.faces)
        for lowest in (-9.0, turned[:, 2].min()):
            first, second = fit_box(one, lowest), fit_box(two, lowest)
            np.testing.assert_array_equal(first.rotation, second.rotation)
            inside = np.abs((turned - first.centre) @ first.rotation) <= first.half / 0.85 + 1e-6
            assert inside.all() and np.linalg.det(first.rotation) == pytest.approx(1.0)


def test_of_boxes_as_small_the_one_that_turns_least_is_taken():
    """A figure that equals its mirror image at 45 degrees has two smallest boxes, and rounding decides between them."""
    half = np.array([[1.0, 0.0], [0.98, 0.2], [0.3, 0.9]])
    outline = np.vstack([half, half[:, ::-1], [[0.0, 0.0]]])
    points = np.concatenate([np.c_[outline, np.zeros(len(outline))], np.c_[outline, np.ones(len(outline))]])
    found = {round(math.atan2(*upright_box(noisy(points, s), 9.0, 0.0).rotation[1::-1, 0]), 6) for s in range(20)}
    assert len(found) == 1


def test_a_tilted_box_is_named_so_that_it_turns_least():
    """A thin slanted leg: of the 24 ways to name its axes, the one nearest to the body's own."""
    angle = math.radians(20.0)
    tilt = np.array([[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]])
    box = fit_box(convex_hull(CUBE * [0.02, 0.02, 0.4] @ tilt.T), -9.0)
    np.testing.assert_allclose(box.half, [0.02, 0.02, 0.4], atol=1e-6)
    np.testing.assert_allclose(box.rotation, tilt, atol=1e-6)
    assert len({tuple(turn.ravel()) for turn in TURNS}) == 24 and {round(np.linalg.det(turn)) for turn in TURNS} == {1}
    left_handed = tilt[:, [2, 0, 1]] * [1, -1, 1]
    rotation, sides = least_turned(left_handed, np.array([3.0, 1.0, 2.0]))
    np.testing.assert_allclose(rotation, tilt, atol=1e-9)
    np.testing.assert_allclose(sides, [1.0, 2.0, 3.0], atol=1e-9)


def test_hulls_are_those_of_trimesh():
    rng = np.random.default_rng(0)
    box = np.array([[x, y, z] for x in (0, 0.4) for y in (0, 0.3) for z in (0, 0.9)])
    clouds = [rng.normal(size=(n, 3)) for n in (4, 9, 40, 300)] + [box, np.vstack([box, box.mean(axis=0)])]
    for points in clouds:
        ours, theirs = hull_of(points), trimesh.convex.convex_hull(points)
        np.testing.assert_array_equal(ours.vertices, theirs.vertices)
        np.testing.assert_array_equal(ours.faces, theirs.faces)
        assert trimesh.Trimesh(ours.vertices, ours.faces, process=False).volume == pytest.approx(theirs.volume)
