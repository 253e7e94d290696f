"""Scores against arithmetic by hand, and the properties that the paper states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav import metrics

positive = st.floats(0.01, 50.0)


def test_path_efficiency_by_hand():
    # 4 m shortest, 5 m driven: 0.8; failure: 0; shorter than L* thanks to the goal region: clipped to 1.
    got = metrics.path_efficiency(np.array([1, 0, 1]), np.array([4.0, 4.0, 4.0]), np.array([5.0, 5.0, 3.5]))
    np.testing.assert_allclose(got, [0.8, 0.0, 1.0])


def test_effort_efficiency_by_hand():
    # Robot 2 kg over 3 m, object 4 kg over 0.5 m, one untouched: kinematic 6 / (6 + 2) = 0.75.
    # Force 10 + 30 N over T = 4 steps, G = 2 * 10: dynamic 80 / (80 + 40) = 2/3. Mean: 17/24.
    got = metrics.effort_efficiency(
        np.array([2.0, 4.0, 100.0]),
        np.array([3.0, 0.5, 0.0]),
        np.array([0.0, 10.0, 30.0, 0.0]),
        4,
        gravity=10.0,
    )
    assert got == pytest.approx(17 / 24)


def test_a_robot_that_did_nothing_scores_one_not_nan():
    assert metrics.effort_efficiency(np.array([2.0, 1.0]), np.zeros(2), np.zeros(5), 5) == 1.0
    assert metrics.kinematic_effort(np.array([2.0, 1.0]), np.zeros(2)) == 1.0
    assert metrics.dynamic_effort(2.0, 0.0, 0) == 1.0
    assert metrics.path_efficiency(1, 1.0, 0.0) == 1.0


def test_ins_by_hand_and_its_limits():
    assert metrics.interactive_navigation_score(0.8, 0.4, 0.25) == pytest.approx(0.5)
    assert metrics.interactive_navigation_score(0.8, 0.4, 1.0) == pytest.approx(0.8)  # SPL
    assert metrics.interactive_navigation_score(0.8, 0.4, 0.0) == pytest.approx(0.4)
    with pytest.raises(ValueError, match=r"alpha is 1.5, expected a weight in \[0, 1\]"):
        metrics.interactive_navigation_score(0.8, 0.4, 1.5)


@settings(max_examples=50, deadline=None)
@given(
    masses=st.lists(positive, min_size=3, max_size=3),
    paths=st.lists(st.floats(0.0, 20.0), min_size=3, max_size=3),
    forces=st.lists(st.floats(0.0, 500.0), min_size=4, max_size=4),
    more=positive,
)
def test_effort_is_bounded_monotone_and_blind_to_object_order(masses, paths, forces, more):
    masses, paths, forces = np.array(masses), np.array(paths), np.array(forces)
    e = metrics.effort_efficiency(masses, paths, forces, 4)
    assert 0.0 <= e <= 1.0
    swapped = metrics.effort_efficiency(masses[[0, 2, 1]], paths[[0, 2, 1]], forces, 4)
    assert swapped == pytest.approx(e)
    assert metrics.effort_efficiency(masses, paths + np.array([0, more, 0]), forces, 4) <= e + 1e-12
    assert metrics.effort_efficiency(masses, paths, forces + np.array([0, 0, more, 0]), 4) <= e + 1e-12


episodes = st.fixed_dictionaries(
    {
        "success": st.booleans(),
        "shortest": st.floats(0.5, 30.0),
        "masses": st.lists(positive, min_size=4, max_size=4),
        "paths": st.lists(st.just(0.0) | st.floats(1e-4, 20.0), min_size=4, max_size=4),
        "forces": st.lists(st.floats(0.0, 500.0), min_size=5, max_size=5),
    }
)


def score(episode, alpha, masses=None, paths=None, forces=None):
    masses, paths = masses or episode["masses"], paths or episode["paths"]
    p_eff = metrics.path_efficiency(episode["success"], episode["shortest"], paths[0])
    e_eff = metrics.effort_efficiency(np.array(masses), np.array(paths), np.array(forces or episode["forces"]), 5)
    return float(metrics.interactive_navigation_score(p_eff, e_eff, alpha))


@settings(max_examples=100, deadline=None)
@given(episode=episodes, alpha=st.floats(0.0, 1.0), order=st.permutations([1, 2, 3]), by=positive, k=st.integers(1, 3))
def test_ins_is_bounded_monotone_and_blind_to_object_order(episode, alpha, order, by, k):
    ins = score(episode, alpha)
    assert 0.0 <= ins <= 1.0
    turned = [0, *order]
    masses, paths = ([episode[name][j] for j in turned] for name in ("masses", "paths"))
    assert score(episode, alpha, masses, paths) == pytest.approx(ins)
    farther, harder = list(episode["paths"]), list(episode["forces"])
    farther[k] += by
    harder[k] += by
    assert score(episode, alpha, paths=farther) <= ins + 1e-12
    assert score(episode, alpha, forces=harder) <= ins + 1e-12
    # A body in two halves that go the same way is the same body; one that stays where it is does not count.
    masses, paths = list(episode["masses"]), list(episode["paths"])
    masses[k] /= 2
    assert score(episode, alpha, [*masses, masses[k]], [*paths, paths[k]]) == pytest.approx(ins)
    assert score(episode, alpha, [*episode["masses"], by], [*paths, 0.0]) == pytest.approx(ins)


@settings(max_examples=100, deadline=None)
@given(episode=episodes)
def test_alpha_1_is_spl_and_alpha_0_is_effort(episode):
    """SPL: Anderson et al. 2018, S L / max(L, l)."""
    spl = episode["success"] * episode["shortest"] / max(episode["shortest"], episode["paths"][0])
    assert score(episode, 1.0) == pytest.approx(spl)
    masses, paths, forces = (np.array(episode[name]) for name in ("masses", "paths", "forces"))
    e_eff = metrics.effort_efficiency(masses, paths, forces, 5)
    assert score(episode, 0.0) == pytest.approx(float(e_eff))


@settings(max_examples=50, deadline=None)
@given(episode=episodes, scale=positive)
def test_effort_has_no_unit(episode, scale):
    masses, paths = np.array(episode["masses"]), np.array(episode["paths"])
    kinematic = metrics.kinematic_effort(masses, paths)
    assert metrics.kinematic_effort(scale * masses, paths) == pytest.approx(kinematic)
    assert metrics.kinematic_effort(masses, scale * paths) == pytest.approx(kinematic)
    dynamic = metrics.dynamic_effort(2.0, 30.0, 5)
    assert metrics.dynamic_effort(2.0 * scale, 30.0 * scale, 5) == pytest.approx(dynamic)
    assert metrics.dynamic_effort(2.0, 30.0 * scale, 5, 9.81 * scale) == pytest.approx(dynamic)


def test_effort_in_its_limits():
    # Without contact 1, whatever the robot drove; pushing something far heavier, or without end, towards 0.
    assert metrics.effort_efficiency(np.array([2.0, 5.0]), np.array([7.0, 0.0]), np.zeros(9), 9) == 1.0
    assert metrics.kinematic_effort(np.array([2.0, 1e9]), np.array([1.0, 1.0])) == pytest.approx(2e-9)
    assert metrics.dynamic_effort(2.0, 1e9, 10) == pytest.approx(2.0 * 9.81 * 10 / 1e9, rel=1e-5)
    # A robot that is pushed aside by nothing but its own standing still: all of what moved was not its own.
    assert metrics.kinematic_effort(np.array([2.0, 1.0]), np.array([0.0, 0.5])) == 0.0


def test_jax_and_numpy_agree_under_jit_and_batching():
    rng = np.random.default_rng(0)
    masses, paths = rng.uniform(0.1, 9, (5, 2, 4)), rng.uniform(0, 9, (5, 2, 4))
    forces, steps = rng.uniform(0, 99, (5, 2, 7)), rng.integers(1, 8, (5, 2))
    want = metrics.effort_efficiency(masses, paths, forces, steps)
    got = jax.jit(metrics.effort_efficiency)(*(jnp.asarray(v) for v in (masses, paths, forces, steps)))
    assert isinstance(got, jax.Array) and want.shape == (5, 2)
    np.testing.assert_allclose(got, want, rtol=1e-5)
