"""Choose actions from observation and key: the learned policy and two baselines that never learned.

Every policy is a pure function (observation, key) -> action (A,) in [-1, 1] of one environment, its observation
a vector (O,) or a dict with images; batch it with `jax.vmap` and a key for each, so that an episode does not
depend on which others run beside it.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from interactive_nav.robots import RobotSpec
from interactive_nav.task.rollout import PolicyFn
from interactive_nav_common.errors import UserError
from train.scoring.planners import Planner, need_twist, velocity_towards

Observation = jax.Array | Mapping[str, jax.Array]

LOOK_AHEAD_M = 0.4
CRUISE_M_S = 0.5
ALIGNED_RAD = jnp.pi / 3
"""Beyond this bearing the follower turns on the spot."""


def random_policy(action_size: int, observation: Observation, key: jax.Array) -> jax.Array:
    """Draw an action uniformly."""
    del observation
    return jax.random.uniform(key, (action_size,), minval=-1.0, maxval=1.0)


def steer(robot: RobotSpec, target_b: jax.Array) -> jax.Array:
    """Return actions that lead to a point: turn towards it, and drive the faster the better aligned.

    `target_b`: (2,) x forward, y left, m, robot frame.

    Returns:
        (A,) in [-1, 1].
    """
    assert robot.twist is not None
    bearing = jnp.arctan2(target_b[1], target_b[0])
    speed_m_s, turn_rad_s = velocity_towards(robot.twist, bearing, CRUISE_M_S, ALIGNED_RAD, jnp)
    return robot.drive(speed_m_s, turn_rad_s, jnp)


def waypoint_follower(robot: RobotSpec, waypoint: int, observation: Observation, key: jax.Array) -> jax.Array:
    """Steer to one of the waypoints at the start of the observation (numbers 2i and 2i + 1); ignore objects."""
    del key
    vector = observation["state"] if isinstance(observation, Mapping) else observation
    return steer(robot, vector[2 * waypoint : 2 * waypoint + 2])


def make_random(env: Any) -> PolicyFn:
    """Build the random baseline."""
    return functools.partial(random_policy, env.action_size)


def make_follower(env: Any) -> PolicyFn:
    """Build the baseline that follows the shortest path."""
    config = env.config
    need_twist(env.robot, "policy follower")
    if "waypoints" not in config.observations:
        raise UserError(
            f"policy follower: observations are {', '.join(config.observations)}, "
            "expected waypoints among them; leave it out of --policies"
        )
    waypoint = min(max(round(LOOK_AHEAD_M / config.waypoint_spacing_m), 1), config.num_waypoints) - 1
    return functools.partial(waypoint_follower, env.robot, waypoint)


BASELINES: dict[str, Callable[[Any], PolicyFn]] = {"random": make_random, "follower": make_follower}
PLANNERS = ("avoider", "namo:W")
"""Planners on the host; W is the weight of pushing against detour, 0 to 1."""


def make_baseline(name: str, env: Any) -> PolicyFn | Planner:
    """Build a policy or planner that never learns, by name: random, follower, avoider or namo:W."""
    if name in BASELINES:
        return BASELINES[name](env)
    if name == "avoider":
        return Planner(env, None)
    kind, _, weight = name.partition(":")
    if kind == "namo":
        try:
            share = float(weight)
        except ValueError:
            raise UserError(f"policy namo: got {name!r}, expected a weight, as in namo:0.5") from None
        return Planner(env, share)
    choices = ", ".join(("learned", *BASELINES, *PLANNERS))
    raise UserError(f"--policies: got {name!r}, expected a choice from {choices}")
