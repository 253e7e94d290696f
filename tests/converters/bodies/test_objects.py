"""Hulls and boxes: thickness, footing, orientation, each by hand on simple shapes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from converters.bodies.objects import flatten_feet, with_feet
from converters.geometry.boxes import Hull, convex_hull, fit_box, upright_box


def box_points(size, centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    return trimesh.creation.box(size).vertices + np.asarray(centre)


def disc(radius: float, z: tuple[float, float], n: int = 48) -> np.ndarray:
    angle = np.arange(n) * 2 * math.pi / n
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    return np.vstack([np.column_stack([ring, np.full(n, v)]) for v in z])


@pytest.mark.parametrize("flat_axis", [0, 1, 2])
def test_a_flat_sheet_becomes_one_centimetre_thick(flat_axis):
    size = np.array([0.4, 0.4, 0.4])
    size[flat_axis] = 0.0
    hull = convex_hull(box_points((1, 1, 1)) * size)
    thickness = np.ptp(hull.vertices, axis=0)
    assert thickness[flat_axis] == pytest.approx(0.01)
    np.testing.assert_allclose(np.delete(thickness, flat_axis), 0.4)
    mesh = trimesh.Trimesh(hull.vertices, hull.faces)
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.4 * 0.4 * 0.01)


def test_feet_reach_the_floor_and_nothing_goes_below():
    hull = flatten_feet(Hull(box_points((0.1, 0.1, 0.5), (0, 0, 0.26)), np.zeros((0, 3), np.int64)))  # foot at 1 cm
    assert hull.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    sunk = flatten_feet(Hull(box_points((0.1, 0.1, 0.5), (0, 0, 0.24)), np.zeros((0, 3), np.int64)))  # at -1 cm
    assert sunk.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-12) and sunk.vertices[:, 2].max() == pytest.approx(
        0.49
    )
    shelf = convex_hull(box_points((0.1, 0.1, 0.1), (0, 0, 0.5)))
    np.testing.assert_allclose(flatten_feet(shelf).vertices[:, 2].min(), 0.45)


def test_a_leg_that_decomposition_lost_gets_a_foot():
    legs = [box_points((0.04, 0.04, 0.5), (x, y, 0.25)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    top = box_points((0.5, 0.5, 0.05), (0, 0, 0.525))
    whole = tuple(convex_hull(p) for p in (top, *legs))
    assert with_feet(whole, np.vstack([top, *legs])) == whole
    *kept, foot = with_feet(whole[:-1], np.vstack([top, *legs]))
    assert tuple(kept) == whole[:-1]
    np.testing.assert_allclose(foot.vertices.min(axis=0), (0.18, 0.18, 0.0), atol=1e-9)
    assert foot.vertices[:, 2].max() < 0.05


def test_upright_box_of_a_turned_rectangle_is_exact():
    c, s = math.cos(0.4), math.sin(0.4)
    points = box_points((1.0, 0.4, 0.2), (0, 0, 0.3)) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    box = upright_box(points)
    np.testing.assert_allclose(sorted(box.half), sorted([0.5, 0.2, 0.1]))
    np.testing.assert_allclose(box.centre, (0, 0, 0.3), atol=1e-12)
    np.testing.assert_allclose(box.rotation @ box.rotation.T, np.eye(3), atol=1e-12)


def test_a_round_top_stands_square_to_the_walls_and_is_drawn_in_to_its_area():
    yaw = 0.3
    box = fit_box(convex_hull(disc(0.5, (0.70, 0.75))), 0.0, prefer_yaw=yaw)
    direction = math.atan2(box.rotation[1, 0], box.rotation[0, 0])
    assert direction % (math.pi / 2) == pytest.approx(yaw)
    # A square of the circle's area: side = r sqrt(pi), half 0.886 r.
    assert 4 * box.half[0] * box.half[1] == pytest.approx(math.pi * 0.25, rel=0.01)
    assert box.half[2] == pytest.approx(0.025)


def test_a_long_things_box_keeps_its_own_yaw_and_a_round_ones_the_walls():
    angle = math.radians(1.0)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
    long = np.array([(x, y, z) for x in (-0.8, 0.8) for y in (-0.2, 0.2) for z in (0, 0.4)]) @ turn.T
    sides = np.arange(16) * math.tau / 16 + 0.1
    disc = np.array([(math.cos(a), math.sin(a), z) for a in sides for z in (0, 1)])
    np.testing.assert_allclose(upright_box(long, 0.0, 0.9).half, (0.8, 0.2, 0.2), atol=1e-9)
    assert upright_box(long, 0.0).half[1] > 0.213  # along the walls it stands out
    np.testing.assert_allclose(upright_box(disc, 0.3, 0.9).rotation, upright_box(disc, 0.3).rotation)
    assert abs(upright_box(disc, 0.3, 0.9).rotation[0, 0]) == pytest.approx(math.cos(0.3))


def test_a_box_fits_a_box_exactly():
    box = fit_box(convex_hull(box_points((0.6, 0.4, 0.2), (0.1, 0.2, 0.5))), 0.0)
    np.testing.assert_allclose(np.sort(box.half), [0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(box.centre, (0.1, 0.2, 0.5), atol=1e-6)


def test_a_slanted_brace_is_tight_in_the_air_and_upright_on_the_floor():
    turn = trimesh.transformations.rotation_matrix(math.radians(30), (0, 1, 0))[:3, :3]
    brace = box_points((0.04, 0.04, 0.6)) @ turn.T
    high = fit_box(convex_hull(brace + [0, 0, 1.0]), 0.0)
    np.testing.assert_allclose(np.sort(high.half), [0.02, 0.02, 0.3], atol=1e-3)
    low = fit_box(convex_hull(brace - [0, 0, brace[:, 2].min()]), 0.0)
    foot = low.centre[2] - np.abs(low.rotation[2]) @ low.half
    assert foot == pytest.approx(0.0, abs=1e-9)  # never below the object's own foot
