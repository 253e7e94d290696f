"""Alignment: closed-form fit against known parameters, its refusals, and the upright placement."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from converters.alignment import AlignmentError, compare, solve_alignment, upright, wrap_angle, yaw_matrix
from converters.raw import Annotation

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.3, 0.3) for z in (0.0, 0.8)])


def pose(scale, yaw: float, translation, tilt: float = 0.0) -> np.ndarray:
    """(4, 4) with a roll of `tilt` applied before the yaw."""
    c, s = math.cos(tilt), math.sin(tilt)
    matrix = np.eye(4)
    matrix[:3, :3] = yaw_matrix(yaw) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) * np.asarray(scale)
    matrix[:3, 3] = translation
    return matrix


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(0.2, 3.0)] * 3),
    st.floats(-math.pi, math.pi),
    st.tuples(*[st.floats(-5.0, 5.0)] * 3),
)
def test_exact_points_give_back_the_seven_parameters(scale, yaw, translation):
    scan = CORNERS * scale @ yaw_matrix(yaw).T + translation
    found = solve_alignment(CORNERS, scan)
    assert found.rms_m == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-7)
    np.testing.assert_allclose(found.translation, translation, atol=1e-7)
    assert abs(wrap_angle(found.yaw - yaw)) < 1e-7


def test_residual_by_hand():
    # Moving four of eight corners by +d and the other four by -d along z, so that no translation or z scale
    # can follow (signs alternate over x), leaves every point d off: rms = d.
    scan = CORNERS.copy()
    scan[:, 2] += 0.02 * np.sign(CORNERS[:, 0]) * np.sign(CORNERS[:, 1])
    assert solve_alignment(CORNERS, scan).rms_m == pytest.approx(0.02)


def test_no_perturbation_of_the_fit_is_better():
    rng = np.random.default_rng(0)
    scan = CORNERS * [1.2, 0.9, 1.1] @ yaw_matrix(0.7).T + rng.normal(0, 0.03, CORNERS.shape)
    best = solve_alignment(CORNERS, scan)

    def cost(scale, yaw, shift):
        return ((CORNERS * scale @ yaw_matrix(yaw).T + shift - scan) ** 2).sum()

    least = cost(best.scale, best.yaw, best.translation)
    for _ in range(200):
        step = rng.normal(0, 1e-3, 7)
        assert cost(best.scale + step[:3], best.yaw + step[3], best.translation + step[4:]) >= least - 1e-12


@pytest.mark.parametrize("mirror", [(1, 1, -1), (1, -1, 1), (-1, 1, 1)])
def test_mirrored_keypoints_are_refused(mirror):
    with pytest.raises(AlignmentError, match="mirrors"):
        solve_alignment(CORNERS, CORNERS * mirror)


def test_a_thin_axis_that_noise_mirrors_still_gets_positive_scales():
    # A leaf 4 cm thick; noise of a few centimetres on the clicks can turn its front and back around.
    rng = np.random.default_rng(5)
    leaf = CORNERS * [1.0, 0.07, 1.0]
    fits = 0
    for _ in range(40):
        try:
            found = solve_alignment(leaf, leaf + rng.normal(0, 0.03, leaf.shape))
        except AlignmentError:
            continue
        fits += 1
        assert (found.scale > 0).all()
    assert fits >= 30


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (CORNERS[:3], "3 keypoint pairs, expected at least 4"),
        (CORNERS[CORNERS[:, 2] == 0], "no extent along the model's z axis"),
        (CORNERS[CORNERS[:, 0] > 0], "no extent along the model's x axis"),
    ],
)
def test_undetermined_keypoints_are_refused(points, reason):
    with pytest.raises(AlignmentError, match=reason):
        solve_alignment(points, points)


def test_upright_removes_tilt_about_the_pivot():
    pivot = np.array([0.1, -0.2, 0.4])
    tilted = pose((1.1, 0.9, 1.3), 0.8, (2.0, 1.0, 0.1), tilt=0.05)
    placed, tilt = upright(tilted, pivot)
    assert tilt == pytest.approx(0.05)
    assert placed.yaw == pytest.approx(0.8, abs=0.002)  # exact but for a term of second order in the tilt
    np.testing.assert_allclose(placed.scale, (1.1, 0.9, 1.3))
    at = yaw_matrix(placed.yaw) @ (placed.scale * pivot) + placed.translation
    np.testing.assert_allclose(at, tilted[:3, :3] @ pivot + tilted[:3, 3])


@pytest.mark.parametrize(("symmetry", "difference"), [("__SYM_NONE", 180.0), ("__SYM_ROTATE_UP_2", 0.0)])
def test_yaw_difference_is_taken_modulo_the_symmetry(symmetry, difference):
    annotated = pose((1, 1, 1), math.pi, (0, 0, 0))
    row = compare(
        Annotation("table", "t", annotated, symmetry, CORNERS, CORNERS), *upright(annotated, np.zeros(3)),
        np.zeros(3), "table_0",
    )  # fmt: skip
    assert row["yaw_difference_deg"] == pytest.approx(difference)
    assert row["rms_m"] == 0.0


def test_too_few_keypoints_are_reported_not_fatal():
    annotation = Annotation("chair", "c", np.eye(4), "__SYM_NONE", CORNERS[:2], CORNERS[:2] + [0, 0, 0.1])
    row = compare(annotation, *upright(annotation.pose, np.zeros(3)), np.zeros(3), "chair_0")
    assert row["solved"] is False and "2 keypoint pairs" in row["reason"]
    assert row["annotated_rms_m"] == pytest.approx(0.1)
