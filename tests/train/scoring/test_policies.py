"""The follower's steering by hand, and that it gets there."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.robots import get_robot
from interactive_nav.robots.spec import TwistMap
from interactive_nav.task.rollout import episode_keys
from interactive_nav_common.errors import UserError
from tests.train.toy_env import ToyConfig, ToyEnv
from train.scoring.evaluation import BatchPlayer
from train.scoring.policies import make_follower, make_random, steer

# Wheel radius 0.05 m, track 0.2 m, action -1 .. 1 is -10 .. 30 rad/s: action = (w - 10) / 20.
ROBOT = dataclasses.replace(
    get_robot("turtlebot"),
    action_low=(-10.0, -10.0),
    action_high=(30.0, 30.0),
    twist=TwistMap(((20.0, -2.0), (20.0, 2.0)), 1.5, 5.0),
)


@pytest.mark.parametrize(
    ("target_b", "wheels_rad_s"),
    [
        # Straight ahead: 0.5 m/s on both wheels, 0.5 / 0.05 = 10 rad/s.
        ((1.0, 0.0), (10.0, 10.0)),
        # 45 degrees left: turn min(4 * 0.785, 2) = 2 rad/s, so +-0.2 m/s; speed 0.5 cos 45 = 0.3536 m/s.
        ((1.0, 1.0), ((0.353553 - 0.2) / 0.05, (0.353553 + 0.2) / 0.05)),
        # 90 degrees right: on the spot, 2 rad/s clockwise, left wheel forward: +-0.2 / 0.05 = 4 rad/s.
        ((0.0, -1.0), (4.0, -4.0)),
        # Bearing 0.1 rad left: turn 0.4 rad/s, +-0.04 m/s; speed 0.5 cos 0.1 = 0.497502 m/s.
        ((np.cos(0.1), np.sin(0.1)), ((0.497502 - 0.04) / 0.05, (0.497502 + 0.04) / 0.05)),
    ],
)
def test_steering_by_hand(target_b, wheels_rad_s):
    expected = (np.array(wheels_rad_s) - 10.0) / 20.0
    np.testing.assert_allclose(steer(ROBOT, jnp.asarray(target_b)), expected, atol=1e-5)


def test_a_slow_robot_is_not_asked_for_more_than_it_can():
    slow = dataclasses.replace(ROBOT, twist=TwistMap(((20.0, -2.0), (20.0, 2.0)), 0.25, 1.0))
    # Straight ahead at 0.25 m/s: 5 rad/s; on the spot at 1 rad/s: -+0.1 / 0.05 = -+2 rad/s.
    np.testing.assert_allclose(steer(slow, jnp.array([1.0, 0.0])), [-0.25, -0.25], atol=1e-6)
    np.testing.assert_allclose(steer(slow, jnp.array([0.0, 1.0])), [-0.6, -0.4], atol=1e-6)


def test_follower_of_a_robot_without_a_base_velocity_is_refused():
    env = ToyEnv()
    env.robot = dataclasses.replace(env.robot, twist=None)
    with pytest.raises(UserError, match="takes no base velocity"):
        make_follower(env)


def test_follower_looks_at_the_waypoint_0_4_m_ahead():
    follower = make_follower(ToyEnv())
    observation = jnp.zeros(29).at[2:4].set(jnp.array([0.0, 0.4]))  # second waypoint: 0.4 m to the left
    left, right = follower(observation, jax.random.PRNGKey(0))
    assert left < right
    observation = jnp.zeros(29).at[0:2].set(jnp.array([0.0, 0.4])).at[2:4].set(jnp.array([0.4, 0.0]))
    left, right = follower(observation, jax.random.PRNGKey(0))
    assert left == right


def test_follower_without_waypoints_is_refused():
    with pytest.raises(UserError, match="expected waypoints among them"):
        make_follower(ToyEnv(ToyConfig(observations=("goal", "velocity"))))


def test_random_policy_covers_the_actions():
    policy = make_random(ToyEnv())
    actions = jax.vmap(policy)(jnp.zeros((4000, 29)), jax.random.split(jax.random.PRNGKey(1), 4000))
    assert actions.shape == (4000, 2) and float(jnp.abs(actions).max()) <= 1.0
    # Uniform on [-1, 1]: mean 0 (its deviation is 0.58 / sqrt(4000) = 0.009), variance 1/3.
    np.testing.assert_allclose(actions.mean(0), 0.0, atol=0.04)
    np.testing.assert_allclose(actions.var(0), 1 / 3, atol=0.02)


def test_follower_reaches_every_toy_goal():
    env = ToyEnv(ToyConfig(episode_steps=120))
    played = BatchPlayer(env).play(make_follower(env), episode_keys(seed=5, episodes=64))
    assert played.metrics["success"].mean() == 1.0
    assert played.metrics["path_efficiency"].mean() > 0.95
