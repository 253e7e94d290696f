"""DDPG's losses, noise and targets by hand, and on toys it must learn."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import types
from brax.training.agents.sac.networks import SACNetworks
from brax.training.networks import FeedForwardNetwork

from tests.train.learners.test_ppo import Recorder
from tests.train.learners.test_sac import KEY, LEARNING, SIZES, transitions
from tests.train.toy_env import ToyEnv, batched
from tests.train.toy_pixels import SMALL, ToyPixels
from train.config import DDPGConfig, EnvConfig, NetworkConfig, RunConfig, TrainConfig
from train.learners.actor_critic import DDPG, ddpg_losses
from train.learners.algorithms import ALGORITHMS


def make(env: ToyEnv, network: NetworkConfig = SMALL, **settings: Any) -> DDPG:
    section = DDPGConfig(**{**SIZES, **settings})
    config = TrainConfig(env=EnvConfig(scenes=("toy",)), algorithm="ddpg", network=network, ddpg=section)
    return DDPG.of(batched(env), config)


# One number each: policy p * o before tanh, critics (q * o + a, q * o - a).
_networks: Any = SACNetworks
BY_HAND = _networks(
    policy_network=FeedForwardNetwork(init=lambda key: key, apply=lambda _, p, o: p * o),
    q_network=FeedForwardNetwork(
        init=lambda key: key, apply=lambda _, q, o, a: jnp.concatenate([q * o + a, q * o - a], -1)
    ),
    parametric_action_distribution=None,
)


def by_hand(truncation: float = 0.0, discount: float = 1.0) -> types.Transition:
    """Two transitions: from 1 to 2 with reward 1, action 0.5; and one from 0 to 0 with reward 0.25, action 0."""
    return types.Transition(  # type: ignore[call-arg]
        observation=jnp.array([[1.0], [0.0]]),
        action=jnp.array([[0.5], [0.0]]),
        reward=jnp.array([1.0, 0.25]),
        discount=jnp.array([discount, 0.0]),
        next_observation=jnp.array([[2.0], [0.0]]),
        extras={"policy_extras": {}, "state_extras": {"truncation": jnp.array([truncation, 0.0])}},  # type: ignore[arg-type]
    )


def test_critic_loss_by_hand():
    """Target policy 0.25: next action tanh(0.5) = a. Target critics 3: 6 + a and 6 - a, the least is 6 - a.

    First transition: target 2 * 1 + 0.5 (6 - a); critics of 1 say 1.5 and 0.5, so both errors exceed 1 and count
    |e| - 0.5. Second, ended: target 2 * 0.25 = 0.5; critics say 0, errors 0.5 count 0.125 each.
    """
    critic_loss, _ = ddpg_losses(BY_HAND, reward_scaling=2.0, discounting=0.5)
    target = 2.0 + 0.5 * (6.0 - np.tanh(0.5))
    expected = ((target - 1.5 - 0.5) + (target - 0.5 - 0.5) + 2 * 0.125) / 4
    np.testing.assert_allclose(critic_loss(1.0, 0.25, None, 3.0, by_hand()), expected, rtol=1e-6)
    # Cut by the clock: the first transition counts nothing, though the mean is over both.
    np.testing.assert_allclose(critic_loss(1.0, 0.25, None, 3.0, by_hand(1.0, 0.0)), 2 * 0.125 / 4, rtol=1e-6)
    # Ended by itself: its target is the reward alone, 2; errors 0.5 and 1.5.
    np.testing.assert_allclose(
        critic_loss(1.0, 0.25, None, 3.0, by_hand(0.0, 0.0)), (0.125 + 1.0 + 2 * 0.125) / 4, rtol=1e-6
    )
    # Of the first transition's critics alone: Huber's slope is -1 twice, times the observation 1, over four errors.
    np.testing.assert_allclose(jax.grad(critic_loss)(1.0, 0.25, None, 3.0, by_hand()), -0.5, rtol=1e-6)


def test_actor_loss_by_hand():
    """-mean of the first critic: observations 1 and 0 give 2 + tanh(0.5) and 0; its slope is -(1 - a^2) / 2."""
    _, actor_loss = ddpg_losses(BY_HAND, 1.0, 0.5)
    a = np.tanh(0.5)
    np.testing.assert_allclose(actor_loss(0.5, None, 2.0, by_hand()), -(2 + a) / 2, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(actor_loss)(0.5, None, 2.0, by_hand()), -(1 - a**2) / 2, rtol=1e-5)


def explore(noise: str, noise_sd: tuple[float, ...], steps: int = 4000, envs: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Actions and noise [steps, envs, A] of a policy that is always 0."""
    agent = make(ToyEnv(), noise=noise, noise_sd=noise_sd, num_envs=envs)
    learner = agent.init(KEY, KEY)
    learner = learner.replace(policy_params=jax.tree.map(jnp.zeros_like, learner.policy_params))  # type: ignore[attr-defined]

    def step(state: jax.Array, key: jax.Array) -> tuple[jax.Array, Any]:
        action, state = agent.explore(learner, jnp.ones((envs, 29)), state, key)
        return state, (action, state)

    _, (action, state) = jax.jit(lambda: jax.lax.scan(step, agent.init_noise(), jax.random.split(KEY, steps)))()
    return np.asarray(action), np.asarray(state)


def test_noise_is_an_ornstein_uhlenbeck_process():
    """x <- 0.85 x + 0.2 N: deviation 0.2 / sqrt(1 - 0.85^2) = 0.380, correlation 0.85 a step and 0.85^5 five steps."""
    action, noise = explore("ou", (0.2,))
    assert noise[500:].std() == pytest.approx(0.2 / np.sqrt(1 - 0.85**2), rel=0.02)
    for lag, expected in ((1, 0.85), (5, 0.85**5)):
        assert np.corrcoef(noise[:-lag].ravel(), noise[lag:].ravel())[0, 1] == pytest.approx(expected, abs=0.03)
    np.testing.assert_allclose(action, np.clip(noise, -1, 1))
    assert (np.abs(noise) > 1).any() and (np.abs(action) <= 1).all()


def test_gaussian_noise_spread_over_environments():
    """From 0.1 to 0.8 over eight environments: 0.1, 0.2, ...; no step remembers the one before."""
    _, noise = explore("gaussian", (0.1, 0.8))
    np.testing.assert_allclose(noise.std((0, 2)), 0.1 * np.arange(1, 9), rtol=0.05)
    assert abs(np.corrcoef(noise[:-1, 3].ravel(), noise[1:, 3].ravel())[0, 1]) < 0.03


def test_targets_follow_every_period():
    """tau 0.25 every second gradient step, from what policy and critic then are."""
    agent = make(ToyEnv(), tau=0.25, target_update_period=2, actor_learning_rate=1e-2, critic_learning_rate=1e-2)
    step, data = jax.jit(agent.gradient_step), transitions(29)
    start = agent.init(KEY, KEY)
    one, _ = step(start, data, KEY)
    two, _ = step(one, data, KEY)
    for online, target in (("policy_params", "target_policy_params"), ("q_params", "target_q_params")):
        jax.tree.map(np.testing.assert_array_equal, getattr(one, target), getattr(start, target))
        expected = jax.tree.map(lambda a, b: 0.75 * a + 0.25 * b, getattr(start, online), getattr(two, online))
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7), getattr(two, target), expected
        )
        same = jax.tree.map(np.array_equal, getattr(one, online), getattr(start, online))
        assert not any(jax.tree.leaves(same))


def test_number_of_critics_and_the_same_policy_either_way():
    for critics in (1, 3):
        agent = make(ToyEnv(), num_critics=critics)
        learner, data = agent.init(KEY, KEY), transitions(29)
        q = agent.networks.q_network.apply(learner.normalizer_params, learner.q_params, data.observation, data.action)
        assert q.shape == (12, critics)
    config = TrainConfig(env=EnvConfig(scenes=("toy",)), algorithm="ddpg", ddpg=DDPGConfig(**SIZES))
    template = ALGORITHMS["ddpg"].template(batched(), config)
    drawn = [ALGORITHMS["ddpg"].policy(batched(), config, template, d)(data.observation, KEY)[0] for d in (True, False)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert drawn[0].shape == (12, 2) and (np.abs(drawn[0]) < 1).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "share"),
    [(ToyEnv(), False), pytest.param(ToyPixels(), True, marks=pytest.mark.heavy)],
    ids=["vector", "picture, shared encoder"],
)
def test_learns_the_toy(env, share):
    """From random (0.03 success) to at least 0.9 in 14,336 steps; in the pictures only the image shows the goal."""
    config = TrainConfig(
        env=EnvConfig(scenes=("toy",)),
        algorithm="ddpg",
        network=dataclasses.replace(SMALL, share_encoder=share),
        ddpg=DDPGConfig(**LEARNING),
        run=RunConfig(num_timesteps=14_336, log_every_steps=2_048, checkpoint_every_steps=14_336),
    )
    seen = Recorder()
    result = ALGORITHMS["ddpg"].train(batched(env), config, seen)
    assert seen.logs[0][1]["episode/success"] < 0.3
    assert result.metrics["episode/success"] >= 0.9
