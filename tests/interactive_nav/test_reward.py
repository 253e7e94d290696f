"""Reward terms by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.reward import interactive_navigation_reward


def test_terms_and_their_sum_by_hand():
    # 3.0 -> 2.9 m: +0.1; touching at k_int 0.5: -0.5; success: +10.
    total, terms = interactive_navigation_reward(np.array([0, 1]), 3.0, 2.9, np.array([1, 0]), 0.5)
    np.testing.assert_allclose(total, [0.1 - 0.5, 10.1])
    np.testing.assert_allclose(terms["success"], [0, 10])
    np.testing.assert_allclose(terms["potential"], 0.1)
    np.testing.assert_allclose(terms["interaction"], [-0.5, 0])


def test_jax_arrays_stay_jax_arrays():
    total, _ = interactive_navigation_reward(jnp.array(1.0), jnp.array(1.0), jnp.array(2.0), jnp.array(0.0), 0.1)
    assert float(total) == pytest.approx(9.0)


def test_a_negative_penalty_is_refused():
    with pytest.raises(ValueError, match="k_int is -0.1, expected a penalty >= 0"):
        interactive_navigation_reward(0, 1.0, 1.0, 0, -0.1)
