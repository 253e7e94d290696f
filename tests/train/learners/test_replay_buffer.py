"""The ring against a plain Python list: what comes out is what went in, each as likely as any other."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from train.learners import offpolicy

SLOTS, ENVS, DISCOUNT = 5, 3, 0.5
VECTORS = jnp.zeros((ENVS, 2))
insert = jax.jit(offpolicy.insert)
sample = jax.jit(offpolicy.sample, static_argnums=(2, 3, 4))
Step = list[tuple[int, int]]
"""For each environment (done, truncated) of one time step."""

ends = st.sampled_from([(0, 0), (0, 0), (1, 0), (1, 1)])
histories = st.lists(st.lists(ends, min_size=ENVS, max_size=ENVS), min_size=4, max_size=13)


def reward(time: int, env: int) -> float:
    """A number that no other step has."""
    return 1.0 + time + 0.125 * env


def fill(history: list[Step]) -> offpolicy.ReplayBuffer:
    """The ring after a history; observations and actions say which step they are of."""
    replay = offpolicy.empty_replay(SLOTS, VECTORS, 1)
    for time, step in enumerate(history):
        ids = np.array([[time, env] for env in range(ENVS)], np.float32)
        rewards = np.array([reward(time, env) for env in range(ENVS)], np.float32)
        done, truncated = np.array(step, np.float32).T
        replay = insert(replay, ids, ids[:, :1] + 100, rewards, done, truncated)
    return replay


def expected(history: list[Step], time: int, env: int, n_steps: int) -> tuple[float, float, float, int]:
    """Reward, discount, truncation and time of the next observation of a transition, step by step."""
    total, factor = 0.0, 1.0
    for k in range(n_steps):
        done, truncated = history[time + k][env]
        if truncated and k:  # ends before the cut step: bootstraps from the observation there
            return total, factor / DISCOUNT, 0.0, time + k
        total += factor * reward(time + k, env)
        factor *= DISCOUNT
        if done:
            return total, 0.0, float(truncated), time + k + 1
    return total, factor / DISCOUNT, 0.0, time + n_steps


@settings(deadline=None, max_examples=60)
@given(history=histories, n_steps=st.sampled_from([1, 3]), seed=st.integers(0, 2**31 - 1))
def test_what_comes_out_is_what_went_in(history: list[Step], n_steps: int, seed: int):
    """Also past the seam: histories are up to 13 steps long, the ring has 5 slots."""
    drawn = jax.device_get(sample(fill(history), jax.random.PRNGKey(seed), 64, n_steps, DISCOUNT))
    oldest = max(0, len(history) - SLOTS)
    for i in range(64):
        time, env = (int(x) for x in drawn.observation[i])
        assert oldest <= time < len(history) - n_steps
        total, discount, truncation, next_time = expected(history, time, env, n_steps)
        assert float(drawn.action[i, 0]) == 100 + time
        assert float(drawn.reward[i]) == pytest.approx(total)
        assert float(drawn.discount[i]) == pytest.approx(discount)
        assert float(drawn.extras["state_extras"]["truncation"][i]) == truncation
        assert drawn.next_observation[i].tolist() == [next_time, env]


@pytest.mark.parametrize(("steps", "n_steps"), [(4, 1), (13, 1), (13, 3)])
def test_every_transition_is_as_likely_as_any_other(steps: int, n_steps: int):
    """Chi-square over (time, environment) of 6,000 draws; what cannot be drawn is not among them."""
    replay = fill([[(0, 0)] * ENVS] * steps)
    ids = np.asarray(sample(replay, jax.random.PRNGKey(1), 6000, n_steps, DISCOUNT).observation)
    _, counts = np.unique(ids, axis=0, return_counts=True)
    assert len(counts) == (min(steps, SLOTS) - n_steps) * ENVS
    assert chisquare(counts).pvalue > 1e-3
    assert chisquare(counts + np.arange(len(counts)) * 100).pvalue < 1e-6  # and a slant would be seen


IMAGES = {
    "state": jnp.ones((ENVS, 6)),
    "pixels/depth": jnp.full((ENVS, 4, 4, 1), 7, jnp.uint8),
    "pixels/segmentation": jnp.full((ENVS, 4, 4, 1), 9, jnp.uint8),
}


def test_memory_is_what_is_told_beforehand():
    """By hand, each step: 32 pixels, 6 numbers, 2 actions and a reward of 4 bytes, two flags of 1; two counters."""
    make = functools.partial(offpolicy.empty_replay, SLOTS, IMAGES, 2)
    each = 32 + 6 * 4 + 2 * 4 + 4 + 2
    actual = sum(leaf.nbytes for leaf in jax.tree.leaves(make()))
    assert actual == offpolicy.nbytes(jax.eval_shape(make)) == SLOTS * ENVS * each + 8
    told = offpolicy.describe(jax.eval_shape(lambda: offpolicy.empty_replay(1000, jnp.zeros((2000, 29)), 2)))
    assert told == (
        "replay of 2,000,000 transitions (1,000 steps of 2,000 environments) of 130 bytes each takes "
        "0.26 GB on the device"
    )


def test_images_stay_bytes_and_vectors_keep_their_numbers():
    replay = offpolicy.empty_replay(SLOTS, IMAGES, 2)
    zeros = jnp.zeros(ENVS)
    observation = {**IMAGES, "state": jnp.full((ENVS, 6), 1 / 3)}
    for _ in range(2):
        replay = insert(replay, observation, jnp.zeros((ENVS, 2)), zeros, zeros, zeros)
    drawn = sample(replay, jax.random.PRNGKey(0), 4, 1, DISCOUNT).observation
    assert drawn["pixels/depth"].dtype == jnp.uint8 and (drawn["pixels/depth"] == 7).all()
    assert (drawn["pixels/segmentation"] == 9).all()
    assert drawn["state"].dtype == jnp.float32 and (drawn["state"] == np.float32(1 / 3)).all()


def test_an_insertion_into_a_donated_ring_copies_nothing():
    replay = offpolicy.empty_replay(4096, IMAGES, 2)
    one = jnp.zeros(ENVS)
    compiled = (
        jax.jit(offpolicy.insert, donate_argnums=0).lower(replay, IMAGES, jnp.zeros((ENVS, 2)), one, one, one).compile()
    )
    memory: Any = compiled.memory_analysis()
    size = offpolicy.nbytes(replay)
    assert memory.alias_size_in_bytes >= size
    assert memory.temp_size_in_bytes < size / 100


def test_windows_of_one_step_are_plain_transitions():
    """The commonest case spelled out: steps 0 and 1 of one environment, the second a failure."""
    replay = offpolicy.empty_replay(4, jnp.zeros((1, 1)), 1)
    one, zero = jnp.ones(1), jnp.zeros(1)
    for time, done in enumerate([zero, one, zero]):
        replay = insert(replay, jnp.full((1, 1), float(time)), one[:, None], 10.0 + time * one, done, zero)
    seen = set()
    for seed in range(16):
        t = sample(replay, jax.random.PRNGKey(seed), 1, 1, 0.9)
        seen.add(
            (float(t.observation[0, 0]), float(t.reward[0]), float(t.discount[0]), float(t.next_observation[0, 0]))
        )
    assert seen == {(0.0, 10.0, 1.0, 1.0), (1.0, 11.0, 0.0, 2.0)}
