"""Cracks: their length by hand, and that they are closed without moving anything; open outlines stay open."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.cracks import open_border
from converters.fill.join import REACH_M, border_edges, close_cracks, cut_teeth
from converters.geometry.faces import face_areas


def strip(low: float, high: float, step_m: float, length_m: float = 1.0, z: float = 0.0):
    """A rectangle from y = low to y = high along x, in squares cut in two."""
    n = round(length_m / step_m)
    x = np.linspace(0, length_m, n + 1)
    vertices = np.array([(a, y, z) for y in (low, high) for a in x])
    k = np.arange(n)
    faces = np.vstack([np.stack([k, k + 1, k + n + 2], 1), np.stack([k, k + n + 2, k + n + 1], 1)])
    return vertices, faces


def two_strips(gap_m: float, z: float = 0.0, scan_step_m: float = 0.02, patch_step_m: float = 1.0):
    """Scan from y = -0.5 to 0, patch from the gap on; (vertices, faces, patch_plane)."""
    scan, scan_faces = strip(-0.5, 0.0, scan_step_m)
    patch, patch_faces = strip(gap_m, gap_m + 0.5, patch_step_m, z=z)
    faces = np.vstack([scan_faces, patch_faces + len(scan)])
    return np.vstack([scan, patch]), faces, np.repeat([-1, 0], [len(scan_faces), len(patch_faces)])


def closed(vertices, faces, plane):
    vertices, faces, source = cut_teeth(vertices, faces, plane)
    more, more_plane = close_cracks(vertices, faces, plane[source])
    return vertices, np.vstack([faces, more]), np.concatenate([plane[source], more_plane]), len(more)


@pytest.mark.parametrize(("gap_m", "crack_m"), [(0.03, 1.0), (0.2, 0.0)])
def test_the_measure_by_hand(gap_m, crack_m):
    found = open_border(*two_strips(gap_m))[0]
    assert found.border_m == pytest.approx(3.0) and found.open_m == pytest.approx(3.0)
    # The side that faces the scan, and of the two others what is nearer than the reach.
    sides = 2 * np.sqrt(REACH_M**2 - 0.0) - 2 * gap_m if crack_m else 0.0
    assert found.crack_m == pytest.approx(crack_m + sides, abs=0.02)


@pytest.mark.parametrize("z", [0.0, 0.03, -0.03])
@pytest.mark.parametrize("patch_step_m", [1.0, 0.05])
def test_a_crack_is_zipped_and_the_rest_stays_open(z, patch_step_m):
    vertices, faces, plane = two_strips(0.04, z, patch_step_m=patch_step_m)
    v, f, p, added = closed(vertices, faces, plane)
    assert added > 30
    np.testing.assert_array_equal(v[: len(vertices)], vertices)
    # One rectangle now: its outline and nothing else is open, and no edge has three faces.
    edges = np.sort(np.vstack([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    ends = v[border_edges(f)[0]]
    outline = ((np.abs(ends[..., 0]) < 1e-9) | (np.abs(ends[..., 0] - 1) < 1e-9)).all(1)
    outline |= (np.abs(ends[..., 1] + 0.5) < 1e-9).all(1) | (np.abs(ends[..., 1] - 0.54) < 1e-9).all(1)
    assert outline.all()
    # The seam; and where it stands slanted, a fillet at its end.
    assert 0 <= face_areas(v, f).sum() - 1.0 - np.hypot(0.04, z) < (0.003 if z else 1e-9)
    assert set(p[-added:]) == {0}
    # The new faces look to the side that their neighbours look to.
    a, b, c = (v[f[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > -1e-12).all()


def test_a_patch_that_overlaps_the_scan_is_joined_too():
    v, f, p, added = closed(*two_strips(-0.03, 0.02))
    assert added > 30
    assert open_border(v, f, p, 0.025)[0].crack_m < 0.11  # the two ends of the seam alone


def test_wide_gaps_and_outlines_are_left_alone():
    for gap_m in (0.12, 0.3):
        vertices, faces, plane = two_strips(gap_m)
        assert closed(vertices, faces, plane)[3] == 0
    vertices, faces, _ = two_strips(0.04)
    for plane in (-1, 3):  # scan alone, patches of one plane alone
        assert len(close_cracks(vertices, faces, np.full(len(faces), plane))[0]) == 0


def test_patches_of_two_planes_are_joined_at_their_corner():
    floor, floor_faces = strip(-0.5, 0.0, 0.5)
    wall, wall_faces = strip(0.03, 0.53, 0.25)
    wall = wall[:, [0, 2, 1]]  # upright, its foot 3 cm above the floor's edge
    faces = np.vstack([floor_faces, wall_faces[:, ::-1] + len(floor)])
    plane = np.repeat([0, 1], [len(floor_faces), len(wall_faces)])
    v, f, p, _ = closed(np.vstack([floor, wall]), faces, plane)
    assert 0 <= face_areas(v, f).sum() - 0.5 - 0.5 - 0.03 < 0.005
    assert all(o.crack_m < 0.25 for o in open_border(v, f, p).values())
