"""Small holes: the loops by hand, the least surface against its formula, and what stays open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.cracks import open_border
from converters.fill.join import border_edges
from converters.fill.loops import HOLE_M2, border_loops, close_loops, least_surface, without_dust, without_flaps
from converters.geometry.faces import face_areas


def sheet(step: float = 0.1, wide: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """A level square of squares cut in two, its corner at the origin."""
    n = round(wide / step)
    x = np.linspace(0, wide, n + 1)
    vertices = np.array([(a, b, 0.0) for b in x for a in x])
    index = np.arange(len(vertices)).reshape(n + 1, n + 1)
    a, b, c, d = (v.ravel() for v in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return vertices, np.vstack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def inside(vertices, faces, low, high) -> np.ndarray:
    middle = vertices[faces].mean(axis=1)[:, :2]
    return ((middle > low) & (middle < high)).all(axis=1)


def holed(low, high, patch_low=(0.0, 0.0), patch_high=(2.0, 2.0), step=0.1):
    """A sheet with a hole; faces inside the patch's bounds belong to plane 0, the rest to the scan."""
    vertices, faces = sheet(step)
    faces = faces[~inside(vertices, faces, low, high)]
    return vertices, faces, np.where(inside(vertices, faces, patch_low, patch_high), 0, -1)


def rim_length(vertices, faces) -> float:
    ends = vertices[border_edges(faces)[0]]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum())


def test_loops_of_two_triangles_that_touch_in_a_vertex():
    loops = border_loops(np.array([(0, 1, 2), (2, 3, 4)]))
    assert sorted(sorted(v.tolist()) for v in loops) == [[0, 1, 2], [2, 3, 4]]


def test_loops_pass_edges_of_three_faces():
    # Three faces at the edge 0-1: odd, like the six outer edges. Every vertex then has an even number of odd edges.
    loops = border_loops(np.array([(0, 1, 2), (0, 1, 3), (0, 1, 4)]))
    found = sorted(tuple(sorted(e)) for v in loops for e in zip(v.tolist(), np.roll(v, -1).tolist(), strict=True))
    assert found == [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (1, 3), (1, 4)]


@given(st.integers(3, 14), st.floats(0.2, 3.0), st.integers(0, 2**31))
def test_the_least_surface_of_a_flat_star_is_its_area(count, turn, seed):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, count))
    # Wide gaps between the angles would put the middle outside; then the polygon is another, its area still the same.
    flat = rng.uniform(0.5, 1.0, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x, y = flat.T
    signed = 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    tilted = np.stack([x, y * np.cos(turn), y * np.sin(turn)], axis=1)
    triangles, area = least_surface(tilted, np.zeros((count, count), bool))
    assert len(triangles) == count - 2
    if np.diff(np.r_[angle, angle[0] + 2 * np.pi]).max() < np.pi:
        assert area == pytest.approx(signed, rel=1e-3)
    else:
        assert area >= abs(signed) - 1e-9


def test_the_least_surface_of_a_bent_square_goes_over_the_shorter_fold():
    # Two corners raised: over the diagonal between the low ones lie two faces of sqrt(2)/2 * sqrt(1/2 + h^2) each.
    height = 0.5
    points = np.array([(0, 0, 0), (1, 0, height), (1, 1, 0), (0, 1, height)], float)
    area = least_surface(points, np.zeros((4, 4), bool))[1]
    assert area == pytest.approx(np.sqrt(2) * np.sqrt(0.5 + height**2), rel=1e-6)


def test_holes_that_patches_surround_are_closed_up_to_their_limit():
    vertices, faces, plane = holed((0.5, 0.5), (1.0, 1.0))
    plane[0] = -1  # the sheet is joined to the scan
    closed, source, planes = close_loops(vertices, faces, plane)
    assert rim_length(vertices, closed) == pytest.approx(8.0)
    assert face_areas(vertices, closed[source < 0]).sum() == pytest.approx(0.25) and set(planes[source < 0]) == {0}
    a, b, c = (vertices[closed[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()  # they look to the side that the others look to
    np.testing.assert_array_equal(closed[source >= 0], faces[source[source >= 0]])
    wide = holed((0.5, 0.5), (1.1, 1.1))
    assert HOLE_M2 < 0.36
    np.testing.assert_array_equal(close_loops(*wide)[0], wide[1])


def test_holes_of_the_scan_beside_a_patch_stay_unless_they_are_narrow():
    # A quarter of the hole's border is the patch's: a window. The same share of a slit 0.1 m wide is closed.
    window = holed((0.5, 0.5), (1.0, 1.0), (0.0, 0.0), (0.5, 2.0))
    np.testing.assert_array_equal(close_loops(*window)[0], window[1])
    vertices, faces, plane = holed((0.5, 0.5), (1.2, 0.6), (0.0, 0.0), (0.5, 2.0))
    assert rim_length(vertices, faces) == pytest.approx(9.6)
    assert rim_length(vertices, close_loops(vertices, faces, plane)[0]) == pytest.approx(8.0)
    # What no patch borders is the scan's own.
    none = np.full(len(faces), -1)
    np.testing.assert_array_equal(close_loops(vertices, faces, none)[0], faces)


def test_a_slit_that_runs_into_the_rim_is_closed_to_the_rim():
    vertices, faces, plane = holed((0.5, 1.5), (0.55, 2.0), (0.0, 0.0), (2.0, 1.8), 0.05)
    assert rim_length(vertices, faces) == pytest.approx(9.0)
    # At the height y above its end the sides are 0.05 m apart and 2 y + 0.05 along the border: from 0.03 m on (with the
    # spots' spacing) that is more than double. The patch holds 0.3 m of either side.
    assert open_border(vertices, faces, plane)[0].crack_m == pytest.approx(2 * 0.27, abs=0.021)
    closed, _, planes = close_loops(vertices, faces, plane)
    assert rim_length(vertices, closed) == pytest.approx(8.0)
    assert open_border(vertices, closed, planes)[0].crack_m == 0.0


def test_a_patch_edge_over_a_vertex_of_the_scan_is_split_there():
    # Scan below y = 0 with a vertex in the middle of its edge, patch above without: a hole without area.
    vertices = np.array([(0, 0, 0), (0.2, 0, 0), (0.4, 0, 0), (0.2, -0.3, 0), (0.2, 0.3, 0)], float)
    faces = np.array([(3, 1, 0), (3, 2, 1), (0, 2, 4)])
    closed, source, plane = close_loops(vertices, faces, np.array([-1, -1, 0]))
    # The patch hangs on the scan by two vertices only; a loop of three edges between them is closed all the same.
    assert face_areas(vertices, closed).min() > 0.01 and len(closed) == 4
    assert sorted(plane.tolist()) == [-1, -1, 0, 0] and sorted(source.tolist()) == [0, 1, 2, 2]
    ends = vertices[border_edges(closed)[0]]
    assert not (np.abs(ends[..., 1]) < 1e-9).all(axis=1).any()


def test_flaps_go_and_what_holds_stays():
    vertices, faces = sheet(0.5)
    # A third face at an inner edge whose other two edges are open; a face at the rim is as it should be.
    flap = np.array([[1, 6, len(vertices)]])
    both = np.vstack([faces, flap])
    assert without_flaps(both, np.ones(len(both), bool)).tolist() == [True] * len(faces) + [False]
    assert without_flaps(both, np.zeros(len(both), bool)).all()
    assert without_flaps(faces, np.ones(len(faces), bool)).all()


@pytest.mark.parametrize(("width", "stays"), [(0.08, False), (0.5, True)])
def test_patches_that_join_nothing_stay_where_they_are_large(width, stays):
    vertices, faces = sheet()
    island = np.array([(3, 0, 0), (4, 0, 0), (4, width, 0), (3, width, 0)], float)
    every = np.vstack([vertices, island])
    both = np.vstack([faces, np.array([(0, 1, 2), (0, 2, 3)]) + len(vertices)])
    plane = np.repeat([-1, 0], [len(faces), 2])
    assert without_dust(every, both, plane).tolist() == [True] * len(faces) + [stays] * 2
    # Its outline is no hole.
    np.testing.assert_array_equal(close_loops(every, both, plane)[0], both)


def test_the_rim_that_goes_on_beside_a_patch_is_no_crack():
    vertices, faces = sheet()
    plane = np.where(inside(vertices, faces, (0.5, 1.5), (0.8, 2.0)), 0, -1)
    found = open_border(vertices, faces, plane)[0]
    # Its open edge is 0.3 m of the sheet's rim, within reach of the scan's rim at both ends.
    assert found.open_m == pytest.approx(0.3) and found.crack_m == 0.0


def test_a_hole_smaller_than_the_reach_is_a_crack_whatever_its_shape():
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(24)], axis=1)
    for radius, crack in ((0.03, True), (0.2, False)):
        vertices = np.vstack([ring * radius, ring])
        k, n = np.arange(24), (np.arange(24) + 1) % 24
        faces = np.vstack([np.stack([k, k + 24, n + 24], 1), np.stack([k, n + 24, n], 1)])
        found = open_border(vertices, faces, np.repeat([-1, 0], [24, 24]), 0.1)[0]
        assert found.open_m == pytest.approx(48 * radius * np.sin(np.pi / 24))
        assert (found.crack_m == pytest.approx(found.open_m)) == crack and (found.crack_m == 0) != crack


def test_the_two_sides_of_a_narrow_patch_are_no_crack():
    """A strip of 0.08 m beside a slit of the same width: the slit counts, on the strip's side, not the strip."""
    vertices, faces = sheet(0.08, 1.6)
    middle = vertices[faces].mean(axis=1)
    keep = (middle[:, 1] < 0.4) | (middle[:, 1] > 0.48) & (middle[:, 1] < 0.56)
    faces, middle = faces[keep], middle[keep]
    plane = np.where(middle[:, 1] > 0.48, 0, -1)
    found = open_border(vertices, faces, plane)[0]
    assert found.open_m == pytest.approx(2 * (1.6 + 0.08))
    # Its far side is 0.16 m from the scan; of its ends what is nearer than the reach.
    assert found.crack_m == pytest.approx(1.6 + 2 * 0.02, abs=0.011)
    assert open_border(vertices, faces[plane == 0], plane[plane == 0])[0].crack_m == 0.0
