"""Alignment: closed-form fit against known parameters, its refusals, and the upright placement."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from converters.bodies.alignment import Alignment, AlignmentError, solve_alignment
from converters.bodies.objects import compare, pose_difference, upright
from converters.records.raw import Annotation
from interactive_nav_common.rotations import wrap_angle, yaw_matrix

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.3, 0.3) for z in (0.0, 0.8)])
FLAT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.3, 0.6, 0], [0.7, 0.1, 0.0]])


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
        (CORNERS[:5], "5 keypoint pairs, expected at least 6"),
        (FLAT, "no extent along the model's z axis: they are coplanar and the z scale is unobservable"),
        (FLAT[:, [2, 0, 1]], "no extent along the model's x axis"),
        (FLAT[:, [0, 2, 1]] + FLAT[:, [2, 0, 2]], "lie in one upright plane"),
        (np.outer(np.arange(7), [1.0, 2.0, 3.0]), "collinear"),
        (np.zeros((6, 3)), "coincide"),
        (np.full((6, 3), np.nan), "not a finite number"),
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


def made_pairs(seed: int, count: int, noise: float):
    """Random pairs under a known pose: CAD points, scan points, scale, yaw, translation."""
    rng = np.random.default_rng(seed)
    cad = rng.uniform(-0.5, 0.5, (count, 3))
    scale, yaw, shift = rng.uniform(0.5, 1.5, 3), rng.uniform(-math.pi, math.pi), rng.uniform(-3, 3, 3)
    scan = cad * scale @ yaw_matrix(yaw).T + shift + rng.normal(0, noise, cad.shape)
    return cad, scan, scale, yaw, shift


@pytest.mark.parametrize("count", [6, 8, 12, 16])
def test_one_gross_outlier_in_eight_is_left_out(count):
    for seed in range(10):
        cad, scan, *_ = made_pairs(seed, count, 0.01)
        rng = np.random.default_rng(100 + seed)
        wrong = rng.choice(count, max(count // 8, 1), replace=False)
        expected = solve_alignment(np.delete(cad, wrong, 0), np.delete(scan, wrong, 0)) if count > 6 else None
        scan[wrong] += rng.choice([-1.0, 1.0], (len(wrong), 3)) * 0.4
        np.testing.assert_array_equal(np.flatnonzero(solve_alignment(cad, scan).outliers), np.sort(wrong))
        found = solve_alignment(cad, scan)
        if expected is not None:
            np.testing.assert_allclose(found.scale, expected.scale, atol=1e-9)
            assert found.rms_m == pytest.approx(expected.rms_m)
        assert found.rms_m < 0.03


def test_one_swapped_pair_does_not_move_an_exact_fit():
    # A click on the opposite corner: exact answer known, seven of eight pairs exact.
    scan = CORNERS * [1.2, 0.9, 1.1] @ yaw_matrix(0.7).T + [1.0, 2.0, 0.5]
    scan[0] = scan[7]
    found = solve_alignment(CORNERS, scan)
    np.testing.assert_allclose(found.scale, [1.2, 0.9, 1.1], atol=1e-9)
    np.testing.assert_allclose(found.translation, [1.0, 2.0, 0.5], atol=1e-9)
    assert found.yaw == pytest.approx(0.7) and found.rms_m == pytest.approx(0.0, abs=1e-9)


def test_sound_noisy_pairs_are_all_kept():
    # OUTLIER_P is a chance of 1 in 1,000 a set: none in 60 sets.
    for seed in range(60):
        cad, scan, *_ = made_pairs(seed, 6 + seed % 6, 0.03)
        assert not solve_alignment(cad, scan).outliers.any()


def test_eight_outliers_among_sixty_four():
    cad, scan, scale, yaw, _ = made_pairs(3, 64, 0.01)
    scan[5:13] += np.random.default_rng(9).normal(0, 1.0, (8, 3))
    np.testing.assert_array_equal(np.flatnonzero(solve_alignment(cad, scan).outliers), np.arange(5, 13))
    found = solve_alignment(cad, scan)
    np.testing.assert_allclose(found.scale, scale, rtol=0.03)
    assert abs(wrap_angle(found.yaw - yaw)) < 0.03


@pytest.mark.parametrize(("symmetry", "folds"), [("__SYM_ROTATE_UP_2", 2), ("__SYM_ROTATE_UP_4", 4)])
def test_pairs_clicked_on_equivalent_points_of_a_symmetric_model(symmetry, folds):
    cad = np.vstack([CORNERS, [[0.5, 0.0, 0.4], [0.0, 0.3, 0.4]]])
    scale = np.array([1.2, 1.2 if folds == 4 else 0.8, 1.1])
    scan = cad * scale @ yaw_matrix(0.3).T + [1.0, 2.0, 0.0]
    clicked = cad.copy()
    clicked[[1, 6]] = clicked[[1, 6]] @ yaw_matrix(2 * math.pi / folds).T  # two pairs name an equivalent point
    found = solve_alignment(clicked, scan, symmetry)
    np.testing.assert_allclose(found.scale, scale, atol=1e-9)
    assert found.yaw == pytest.approx(0.3) and found.rms_m == pytest.approx(0.0, abs=1e-9)
    # Clicked consistently one symmetric turn off: the same pose comes back, with the smallest yaw.
    turned = solve_alignment(cad @ yaw_matrix(2 * math.pi / folds).T, scan, symmetry)
    assert turned.yaw == pytest.approx(0.3) and turned.rms_m == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(turned.scale, scale, atol=1e-9)


def test_a_round_model_stays_round():
    cad, scan, *_ = made_pairs(4, 8, 0.03)
    found = solve_alignment(cad, scan, "__SYM_ROTATE_UP_INF")
    assert found.scale[0] == found.scale[1]
    exact = cad * [1.3, 1.3, 0.7] @ yaw_matrix(2.0).T + [1, 0, 0]
    found = solve_alignment(cad, exact, "__SYM_ROTATE_UP_INF")
    np.testing.assert_allclose(found.scale, [1.3, 1.3, 0.7])
    np.testing.assert_allclose(found.translation, [1, 0, 0], atol=1e-9)


def test_a_quarter_turn_of_a_four_fold_model_swaps_the_scales_compared():
    one = Alignment(np.array([1.0, 2.0, 3.0]), np.zeros(3), math.pi / 2 + 0.1, 0.0)
    other = Alignment(np.array([2.0, 1.0, 3.0]), np.zeros(3), 0.0, 0.0)
    _, yaw_rad, scale_ratio = pose_difference(one, other, np.zeros(3), "__SYM_ROTATE_UP_4")
    assert yaw_rad == pytest.approx(0.1)
    np.testing.assert_allclose(scale_ratio, 1.0)


def test_unknown_symmetry_is_refused():
    with pytest.raises(AlignmentError, match="symmetry is 'round', expected one of __SYM_NONE"):
        solve_alignment(CORNERS, CORNERS, "round")


@pytest.mark.parametrize(("tilt", "noted"), [(0.1, False), (math.pi / 2 - 0.01, True)])
def test_an_object_annotated_lying_is_reported_as_stood_upright(tilt, noted):
    annotation = Annotation("chair", "c", pose((1, 1, 1), 0.0, (0, 0, 0), tilt), "__SYM_NONE", CORNERS, CORNERS)
    row = compare(annotation, *upright(annotation.pose, np.zeros(3)), np.zeros(3), "chair_0")
    assert ("placed upright" in row.get("note", "")) is noted
