"""Observation and key in, action out: the learned policy and two yardsticks that never learned.

Every policy is a pure function (observation (O,), key) -> action (A,) in [-1, 1] of one environment; batch it
with `jax.vmap` and a key for each, so that an episode does not depend on which others run beside it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from interactive_nav.robots import RobotSpec
from interactive_nav.robots.turtlebot import HALF_TRACK_M, WHEEL_RADIUS_M
from train.errors import TrainError

PolicyFn = Callable[[jax.Array, jax.Array], jax.Array]

LOOK_AHEAD_M = 0.4
CRUISE_M_S = 0.5
TURN_GAIN_PER_S = 4.0
MAX_TURN_RAD_S = 2.0
ALIGNED_RAD = jnp.pi / 3
"""Beyond this bearing the follower turns on the spot."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """A differential drive: what turns speeds of the body into speeds of the wheels."""

    wheel_radius_m: float
    track_m: float
    wheel_low_rad_s: float
    """Wheel speed at action -1."""
    wheel_high_rad_s: float
    """Wheel speed at action +1."""


def drive_of(robot: RobotSpec) -> Drive:
    """The robot's drive.

    Raises:
        TrainError: not a robot on two wheels that is known here.
    """
    wheels = {"turtlebot": (WHEEL_RADIUS_M, 2 * HALF_TRACK_M)}
    if robot.name not in wheels:
        raise TrainError(
            f"policy follower: robot is {robot.name!r}, expected one of {', '.join(wheels)}; leave it out of --policies"
        )
    return Drive(*wheels[robot.name], robot.action_low[0], robot.action_high[0])


def random_policy(action_size: int, observation: jax.Array, key: jax.Array) -> jax.Array:
    """Uniform over all actions."""
    del observation
    return jax.random.uniform(key, (action_size,), minval=-1.0, maxval=1.0)


def steer(drive: Drive, target_b: jax.Array) -> jax.Array:
    """Wheel actions that lead to a point: turn towards it, and drive the faster the better aligned.

    Args:
        drive: geometry and limits.
        target_b: (2,) x forward, y left, m, robot frame.

    Returns:
        (2,) left and right wheel in [-1, 1].
    """
    bearing = jnp.arctan2(target_b[1], target_b[0])
    turn_rad_s = jnp.clip(TURN_GAIN_PER_S * bearing, -MAX_TURN_RAD_S, MAX_TURN_RAD_S)
    speed_m_s = jnp.where(jnp.abs(bearing) < ALIGNED_RAD, CRUISE_M_S * jnp.cos(bearing), 0.0)
    half_track_m = drive.track_m / 2
    wheels_m_s = speed_m_s + turn_rad_s * jnp.array([-half_track_m, half_track_m])
    span_rad_s = drive.wheel_high_rad_s - drive.wheel_low_rad_s
    share = (wheels_m_s / drive.wheel_radius_m - drive.wheel_low_rad_s) / span_rad_s
    return jnp.clip(2.0 * share - 1.0, -1.0, 1.0)


def waypoint_follower(drive: Drive, waypoint: int, observation: jax.Array, key: jax.Array) -> jax.Array:
    """Steers to one of the waypoints that lead the observation (numbers 2i and 2i + 1); sees no object."""
    del key
    return steer(drive, observation[2 * waypoint : 2 * waypoint + 2])


def make_random(env: Any) -> PolicyFn:
    """The random yardstick."""
    return functools.partial(random_policy, env.action_size)


def make_follower(env: Any) -> PolicyFn:
    """The yardstick that follows the shortest path.

    Raises:
        TrainError: the observation has no waypoints, or the robot is not known here.
    """
    config = env.config
    if "waypoints" not in config.observations:
        raise TrainError(
            f"policy follower: observations are {', '.join(config.observations)}, "
            "expected waypoints among them; leave it out of --policies"
        )
    waypoint = min(max(round(LOOK_AHEAD_M / config.waypoint_spacing_m), 1), config.num_waypoints) - 1
    return functools.partial(waypoint_follower, drive_of(env.robot), waypoint)


def make_learned(act: Any) -> PolicyFn:
    """A Brax policy (observation, key) -> (action, extras) without its extras."""
    return lambda observation, key: act(observation, key)[0]


YARDSTICKS: dict[str, Callable[[Any], PolicyFn]] = {"random": make_random, "follower": make_follower}
