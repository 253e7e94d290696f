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


def test_jax_and_numpy_agree_under_jit_and_batching():
    rng = np.random.default_rng(0)
    masses, paths = rng.uniform(0.1, 9, (5, 2, 4)), rng.uniform(0, 9, (5, 2, 4))
    forces, steps = rng.uniform(0, 99, (5, 2, 7)), rng.integers(1, 8, (5, 2))
    want = metrics.effort_efficiency(masses, paths, forces, steps)
    got = jax.jit(metrics.effort_efficiency)(*(jnp.asarray(v) for v in (masses, paths, forces, steps)))
    assert isinstance(got, jax.Array) and want.shape == (5, 2)
    np.testing.assert_allclose(got, want, rtol=1e-5)
