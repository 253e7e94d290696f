"""Reward terms by hand, and their properties over episodes of any kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav.reward import interactive_navigation_reward
from interactive_nav_common.errors import UserError


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
    with pytest.raises(UserError, match="k_int is -0.1, expected a penalty >= 0"):
        interactive_navigation_reward(0, 1.0, 1.0, 0, -0.1)


@settings(max_examples=100, deadline=None)
@given(
    distances=st.lists(st.floats(0.0, 40.0), min_size=2, max_size=30),
    touches=st.lists(st.booleans(), min_size=29, max_size=29),
    reached=st.booleans(),
    k_int=st.sampled_from([0.0, 0.1, 1.0]),
)
def test_the_return_of_an_episode_is_progress_and_success_less_touches(distances, touches, reached, k_int):
    """R_pot telescopes: the way there does not matter to it, and a robot that goes in circles earns nothing."""
    distances = np.array(distances)
    steps = len(distances) - 1
    success, touching = np.zeros(steps), np.array(touches[:steps], float)
    success[-1] = reached
    total, terms = interactive_navigation_reward(success, distances[:-1], distances[1:], touching, k_int)
    assert total.shape == (steps,) and set(terms) == {"success", "potential", "interaction"}
    np.testing.assert_allclose(sum(terms.values()), total)
    assert total.sum() == pytest.approx(
        10.0 * reached + distances[0] - distances[-1] - k_int * touching.sum(), abs=1e-9
    )
    assert set(terms["interaction"].tolist()) <= {0.0, -k_int} and set(terms["success"].tolist()) <= {0.0, 10.0}
    # One more touch never pays; getting nearer always does.
    more = interactive_navigation_reward(success, distances[:-1], distances[1:], np.ones(steps), k_int)[0]
    nearer = interactive_navigation_reward(success, distances[:-1], distances[1:] - 0.1, touching, k_int)[0]
    assert (more <= total).all() and (nearer > total).all()


def test_any_batch_axes_numpy_and_jax_alike():
    rng = np.random.default_rng(0)
    success, touching = rng.integers(0, 2, (2, 5, 4, 3)).astype(float)
    before, after = rng.uniform(0, 9, (2, 5, 4, 3))
    want, terms = interactive_navigation_reward(success, before, after, touching, 0.1, 7.0)
    one = interactive_navigation_reward(success[2, 1, 0], before[2, 1, 0], after[2, 1, 0], touching[2, 1, 0], 0.1, 7.0)[
        0
    ]
    assert want.shape == (5, 4, 3) and want[2, 1, 0] == pytest.approx(one)
    call = jax.jit(jax.vmap(lambda s, b, a, t: interactive_navigation_reward(s, b, a, t, 0.1, 7.0)))
    got, got_terms = call(*(jnp.asarray(x) for x in (success, before, after, touching)))
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)
    for name, term in terms.items():
        np.testing.assert_allclose(got_terms[name], term, rtol=1e-5, atol=1e-5)
