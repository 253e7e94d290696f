"""The floor's plane: exact on clean floors, unmoved by labels that are wrong, refused where there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from converters.records.errors import SceneRejected
from converters.structure.clean import LIFT_M, FloorFit, fit_floor, level_floor
from tests.converters import tiny_raw


def patches(centres: np.ndarray, slope: np.ndarray, side_m: float = 0.05):
    """One small upright-facing square at each centre, tilted by the slope; vertices (4n, 3), faces (2n, 3)."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * side_m / 2
    corners = centres[:, None] + np.column_stack([square, square @ slope])
    index = 4 * np.arange(len(centres))[:, None]
    return corners.reshape(-1, 3), np.vstack([index + [0, 1, 2], index + [0, 2, 3]])


def tilt_deg(fit: FloorFit) -> float:
    """Return the angle of a fitted floor to the level."""
    return math.degrees(math.atan(float(np.hypot(*fit.slope))))


def test_clutter_labelled_floor_does_not_move_the_plane():
    """Six in ten labels are wrong: clutter above, a reflection below. The median is 2.5 cm off, the fit 2 mm"""
    rng = np.random.default_rng(0)
    slope = np.array([math.tan(math.radians(1.0)), 0.0])
    xy = rng.uniform(0, 4, (1000, 2))
    z = 0.2 + xy @ slope + rng.normal(0, 0.005, 1000)
    z[:450] += rng.uniform(0.05, 0.5, 450)
    z[450:600] -= 0.3
    vertices, faces = patches(np.column_stack([xy, z]), slope)
    labels = np.full(len(vertices), 2)
    truth = 0.2 + slope @ [2.0, 2.0]
    assert abs(np.median(vertices[:, 2]) - truth) > 0.02
    fit = fit_floor(vertices, faces, labels)
    assert fit.height_at(np.array([[2.0, 2.0]]))[0] == pytest.approx(truth, abs=0.002)
    assert tilt_deg(fit) == pytest.approx(1.0, abs=0.1)
    level = level_floor(vertices - [0, 0, truth], faces, labels)
    true = np.repeat(np.arange(1000) >= 600, 4)
    np.testing.assert_array_equal(level[true, 2], LIFT_M)  # its tilt would leave +-3.5 cm
    reflection = np.repeat((np.arange(1000) >= 450) & (np.arange(1000) < 600), 4)
    np.testing.assert_array_equal(level[reflection], (vertices - [0, 0, truth])[reflection])


def test_the_height_that_the_source_states_chooses_the_floor():
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2) * 0.1
    low, high = np.column_stack([grid, np.zeros(400)]), np.column_stack([grid[:150], np.full(150, 2.6)])
    vertices, faces = patches(np.vstack([low, high]), np.zeros(2))
    labels = np.full(len(vertices), 2)
    assert fit_floor(vertices, faces, labels).height_m == pytest.approx(0.0, abs=1e-9)
    assert fit_floor(vertices, faces, labels, near_m=2.5).height_m == pytest.approx(2.6, abs=1e-9)


def test_stray_labels_on_a_wall_are_ignored():
    vertices, faces, labels = tiny_raw.scan()
    labels = labels.copy()
    labels[np.flatnonzero(labels == 1)[:400]] = 2
    fit = fit_floor(vertices, faces, labels)
    assert fit.height_m == pytest.approx(tiny_raw.FLOOR_M, abs=2e-3) and tilt_deg(fit) < 0.2


def test_a_scan_without_a_floor_is_refused():
    vertices, faces, labels = tiny_raw.scan()
    with pytest.raises(SceneRejected, match="0 vertices carry the floor label"):
        fit_floor(vertices, faces, np.ones_like(labels))
    with pytest.raises(SceneRejected, match="in no plane within 5 degrees of the level"):
        fit_floor(vertices[:, [2, 0, 1]], faces[(labels[faces] == 2).all(axis=1)], labels)
    np.testing.assert_array_equal(level_floor(vertices, faces, np.ones_like(labels)), vertices)
