"""Choose actions without learning: at random, along the shortest path, or by a plan in the scene's state.

A policy is a pure function (observation, key) -> action (A,) in [-1, 1] of one environment; batch it with `jax.vmap`
and a key for each, so that episodes are independent.

Planners run on the host, for many episodes at once, and read the state: positions, mass and friction of objects. They
bound other policies (paper section IV): the avoider goes around every object, the NAMO-style planner weighs pushing
against detours (`interactive_nav.navigation.ways`).
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.navigation.ways import Ways
from interactive_nav.robots.spec import RobotSpec, TwistMap
from interactive_nav.task.rollout import HostPolicy, PolicyFn
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import UserError
from interactive_nav_common.rotations import wrap_angle
from train.scoring import PLANNERS, POLICIES

Observation = jax.Array | Mapping[str, jax.Array]

LOOK_AHEAD_M = 0.4
CRUISE_M_S = 0.5
ALIGNED_RAD = jnp.pi / 3
"""Beyond this bearing the follower turns on the spot."""


def steer(robot: RobotSpec, target_b: jax.Array) -> jax.Array:
    """Return actions (A,) in [-1, 1] towards `target_b` (2,), m, robot frame: the faster, the better aligned."""
    assert robot.twist is not None
    bearing = jnp.arctan2(target_b[1], target_b[0])
    speed_m_s, turn_rad_s = velocity_towards(robot.twist, bearing, CRUISE_M_S, ALIGNED_RAD, jnp)
    return robot.drive(speed_m_s, turn_rad_s, jnp)


def make_random(env: Any) -> PolicyFn:
    """Build the baseline that draws actions uniformly."""
    return lambda observation, key: jax.random.uniform(key, (env.action_size,), minval=-1.0, maxval=1.0)


def make_follower(env: Any) -> PolicyFn:
    """Build the baseline that follows the shortest path, by a waypoint of the observation; it ignores objects."""
    config = env.config
    need_twist(env.robot, "policy follower")
    if "waypoints" not in config.observations:
        raise UserError(
            f"policy follower: observations are {', '.join(config.observations)}, "
            "expected waypoints among them; choose another policy"
        )
    first = 2 * min(max(round(LOOK_AHEAD_M / config.waypoint_spacing_m), 1), config.num_waypoints) - 2

    def follow(observation: Observation, key: jax.Array) -> jax.Array:
        vector = observation["state"] if isinstance(observation, Mapping) else observation
        return steer(env.robot, vector[first : first + 2])

    return follow


REPLAN_STEPS = 10
"""Control steps between two plans of an episode, where something has moved."""
MOVED_M = 0.02
PLAN_AHEAD_M = 0.25
PLAN_CRUISE_M_S = 0.4
PLAN_ALIGNED_RAD = math.pi / 6
"""Beyond this bearing the planners turn on the spot."""
TURN_GAIN_PER_S = 4.0
MAX_TURN_RAD_S = 2.0


def velocity_towards(
    twist: TwistMap, bearing_rad: Any, cruise_m_s: float, aligned_rad: float, xp: Any
) -> tuple[Any, Any]:
    """Return linear (m/s) and angular (rad/s) velocity [...] towards points: the faster, the better aligned.

    `twist`: the robot's limits, of its control mode; `bearing_rad`: [...] of the points, 0 ahead, positive to the left.
    """
    most, cruise = min(MAX_TURN_RAD_S, twist.max_angular_rad_s), min(cruise_m_s, twist.max_linear_m_s)
    speed_m_s = xp.where(xp.abs(bearing_rad) < aligned_rad, cruise * xp.cos(bearing_rad), 0.0)
    return speed_m_s, xp.clip(TURN_GAIN_PER_S * bearing_rad, -most, most)


def need_twist(robot: RobotSpec, who: str) -> None:
    """Raise `UserError` where a robot's control mode takes no base velocity."""
    if robot.twist is None:
        raise UserError(
            f"{who}: robot '{robot.name}' takes no base velocity in control mode '{robot.control_mode}', expected one "
            "of its modes that does; choose another policy"
        )


@dataclasses.dataclass(frozen=True)
class PlannedRoute:
    """A path to the goal for one episode."""

    path_w: np.ndarray
    """[p, 2] m; empty where there is none."""
    object_pos_w: np.ndarray
    """[M, 3] of the objects when it was planned."""
    step: int


class Planner(HostPolicy):
    """Plan and steer episodes from their states; `weight` of `Ways`: 0 pushes everything, None avoids everything."""

    def __init__(self, env: Any, weight: float | None):
        if weight is not None and not 0.0 <= weight <= 1.0:
            raise UserError(f"policy namo: weight is {weight}, expected between 0 and 1, as in namo:0.5")
        need_twist(env.robot, "policy avoider" if weight is None else "policy namo")
        self._env, self._weight = env, weight
        self._ways = Ways(env, weight)
        self._plans: dict[int, PlannedRoute] = {}
        self.no_path = 0
        """Plans without a path."""
        self.plans = 0

    @property
    def note(self) -> str:  # type: ignore[override]
        """Return how often there was no path."""
        return f"{self.plans:,} plans, {self.no_path:,} of them without a path" if self._weight is None else ""

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> np.ndarray:
        """Return actions [N, A] of one control step, on plans that are as old as what has moved allows."""
        nav = state.info["nav"]
        qpos = np.asarray(state.pipeline_state.qpos)
        pos, yaw = np.asarray(nav.robot_pos_w)[:, :2], np.asarray(nav.yaw_rad)
        goal, scene, objects = np.asarray(nav.goal_xy_w), np.asarray(nav.scene_index), np.asarray(nav.object_pos_w)
        linear, angular = np.zeros(len(pos)), np.zeros(len(pos))
        for i in np.flatnonzero(running):
            plan = self._plans.get(int(episode[i]))
            started = nav.step_count[i] == 0  # a teacher's environments go through many episodes
            if plan is None or started or (step - plan.step >= REPLAN_STEPS and self._stale(plan, pos[i], objects[i])):
                path = self._ways.way(int(scene[i]), qpos[i], pos[i], goal[i])
                self.plans += 1
                self.no_path += not len(path)
                plan = self._plans[int(episode[i])] = PlannedRoute(path, objects[i].copy(), step)
            if len(plan.path_w):
                linear[i], angular[i] = self._steer(plan.path_w, pos[i], yaw[i])
        return np.asarray(self._env.robot.drive(linear, angular, np), np.float32)

    @staticmethod
    def _stale(plan: PlannedRoute, pos: np.ndarray, objects: np.ndarray) -> bool:
        moved = np.linalg.norm(objects - plan.object_pos_w, axis=-1).max(initial=0.0) > MOVED_M
        off = len(plan.path_w) > 0 and np.linalg.norm(plan.path_w - pos, axis=-1).min() > 0.15
        return bool(moved or off)

    def _steer(self, path: np.ndarray, pos: np.ndarray, yaw: float) -> tuple[float, float]:
        """Return linear (m/s) and angular (rad/s) velocity towards a point a little ahead on the path."""
        nearest = int(np.argmin(np.linalg.norm(path - pos, axis=-1)))
        ahead = path[nearest:]
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ahead, axis=0), axis=-1))])
        target = ahead[min(int(np.searchsorted(along, PLAN_AHEAD_M)), len(ahead) - 1)]
        offset = target - pos
        bearing = wrap_angle(math.atan2(offset[1], offset[0]) - yaw)
        return velocity_towards(self._env.robot.twist, float(bearing), PLAN_CRUISE_M_S, PLAN_ALIGNED_RAD, np)


def make_baseline(name: str, env: Any) -> PolicyFn | Planner:
    """Build a policy or planner that never learns, by name: random, follower, avoider or namo:W (W as in `Planner`)."""
    plain = {"random": make_random, "follower": make_follower, "avoider": lambda env: Planner(env, None)}
    if name in plain:
        return plain[name](env)
    kind, _, weight = name.partition(":")
    if kind == "namo":
        try:
            share = float(weight)
        except ValueError:
            raise UserError(f"policy namo: got {name!r}, expected a weight, as in namo:0.5") from None
        return Planner(env, share)
    known = (*POLICIES, *PLANNERS)
    raise UserError(f"--policies: got {name!r}, expected a choice from {', '.join(known)}{nearest(name, known)}")
