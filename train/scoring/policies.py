"""Choose actions without learning: at random, along the shortest path, or by a plan in the scene's state.

A policy is a pure function (observation, key) -> action (A,) in [-1, 1] of one environment; batch it with `jax.vmap`
and a key for each, so that episodes are independent.

Planners run on the host, for many episodes at once, and read the state: positions, mass and friction of objects. They
bound other policies (paper section IV): the avoider goes around every object, the NAMO-style planner weighs pushing
against detours (`interactive_nav.navigation.ways`), and the puller opens doors and drawers with a hook.
"""

import dataclasses
import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.navigation.ways import Ways
from interactive_nav.robots.spec import RobotSpec, TwistMap
from interactive_nav.task.rollout import HostPolicy, PolicyFn
from interactive_nav.task.targets import opening
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


_READ = "robot_pos_w", "yaw_rad", "goal_xy_w", "scene_index", "object_pos_w", "step_count", "target"
"""Fields of `NavInfo` that planners read."""
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
    goal_xy_w: np.ndarray
    object_pos_w: np.ndarray
    """[M, 3] of the objects when it was planned."""
    step: int


class Planner(HostPolicy):
    """Plan and steer episodes from their states; `weight` of `Ways`: 0 pushes everything, None avoids everything."""

    barred = False
    """Whether doors that are shut are obstacles."""

    def __init__(self, env: Any, weight: float | None, name: str = "namo"):
        if weight is not None and not 0.0 <= weight <= 1.0:
            raise UserError(f"policy namo: weight is {weight}, expected between 0 and 1, as in namo:0.5")
        need_twist(env.robot, f"policy {name}")
        self._env, self._weight = env, weight
        self._ways = Ways(env, weight, barred=self.barred)
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
        nav, physics = state.info["nav"], state.pipeline_state
        parts = {name: getattr(nav, name) for name in _READ} | {"qpos": physics.qpos}
        parts |= {"hook": physics.hook} if getattr(physics, "hook", None) is not None else {}
        parts = {name: np.asarray(part) for name, part in parts.items() if part is not None}
        commands = np.zeros((3, len(episode)))
        for i in np.flatnonzero(running):
            at = {name: part[i] for name, part in parts.items()}
            commands[:, i] = self._command(SimpleNamespace(**at, episode=int(episode[i]), step=step))
        actions = np.array(self._env.robot.drive(*commands[:2], np), np.float32)
        actions[:, -1] += commands[2]  # the hook's
        return actions

    def _command(self, at: Any) -> tuple[float, float, float]:
        """Return one episode's linear (m/s) and angular (rad/s) velocity, and the hook's action."""
        return *self._drive(at, at.goal_xy_w), 0.0

    def _drive(self, at: Any, goal_xy_w: np.ndarray) -> tuple[float, float]:
        """Return velocities along a plan to a place (2,), m."""
        pos, plan = at.robot_pos_w[:2], self._plans.get(at.episode)
        # A teacher's environments go through many episodes.
        if plan is None or at.step_count == 0 or (plan.goal_xy_w != goal_xy_w).any() or self._stale(plan, at):
            path = self._ways.way(int(at.scene_index), at.qpos, pos, goal_xy_w)
            self.plans += 1
            self.no_path += not len(path)
            plan = self._plans[at.episode] = PlannedRoute(path, goal_xy_w.copy(), at.object_pos_w.copy(), at.step)
        return self._steer(plan.path_w, pos, at.yaw_rad) if len(plan.path_w) else (0.0, 0.0)

    @staticmethod
    def _stale(plan: PlannedRoute, at: Any) -> bool:
        moved = np.linalg.norm(at.object_pos_w - plan.object_pos_w, axis=-1).max(initial=0.0) > MOVED_M
        off = len(plan.path_w) > 0 and np.linalg.norm(plan.path_w - at.robot_pos_w[:2], axis=-1).min() > 0.15
        return bool(moved or off) and at.step - plan.step >= REPLAN_STEPS

    def _steer(self, path: np.ndarray, pos: np.ndarray, yaw: float) -> tuple[float, float]:
        """Return linear (m/s) and angular (rad/s) velocity towards a point a little ahead on the path."""
        nearest = int(np.argmin(np.linalg.norm(path - pos, axis=-1)))
        ahead = path[nearest:]
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ahead, axis=0), axis=-1))])
        target = ahead[min(int(np.searchsorted(along, PLAN_AHEAD_M)), len(ahead) - 1)]
        bearing = _bearing(target - pos, yaw)
        return velocity_towards(self._env.robot.twist, bearing, PLAN_CRUISE_M_S, PLAN_ALIGNED_RAD, np)


def _bearing(way_w: np.ndarray, yaw_rad: float) -> float:
    return float(wrap_angle(math.atan2(way_w[1], way_w[0]) - yaw_rad))


PULL_M_S = 0.1
"""Speed of coupling and of backing off: the wheels of light robots slip if they turn faster."""
BEFORE_M, EDGE, ENOUGH = 0.3, 0.9, 1.25
"""Distance from hook to target at which the robot turns to it; share of a leaf's width at which it couples; and share
of what counts as open at which it lets go."""
PATIENCE_STEPS, LEAVE_STEPS = 60, 15
"""Control steps in which nothing happens, after which the puller couples again; and those in which it then backs away
from what it has opened, so as not to shut it."""


class Puller(Planner):
    """Pull the target open with the hook, as often as it takes, then drive to the goal like `namo:1`.

    The robot couples near a leaf's free edge and backs off on a circle about the hinge, or straight from a drawer.
    """

    barred = True

    def __init__(self, env: Any):
        if env.config.task not in ("open", "clear") or not env.hook:
            got = f"task is '{env.config.task}' and hook_force_n is {env.config.hook_force_n}"
            remedy = "set env.task=clear env.hook_force_n=100, or choose another policy"
            raise UserError(f"policy puller: {got}, expected open or clear, and a hook; {remedy}")
        super().__init__(env, 1.0, "puller")
        self._targets, self._starts_w = jax.tree.map(np.asarray, (env.tables.targets, env.tables.start_xy_w))
        self._front_m = float(env.hook.point_b[0])
        self._pulls: dict[int, tuple[str, int, float, np.ndarray]] = {}
        """Episode -> phase (reach the place, couple, pull, leave, pass to the goal); the step in which it began or the
        target last moved; how far that was open; and the place (2,), m, from which the robot turns to the target."""

    def _command(self, at: Any) -> tuple[float, float, float]:
        self._look(at)
        if at.step_count == 0 or at.episode not in self._pulls:
            self._pulls[at.episode] = "reach", at.step, at.share, self._place(at)
        last, since, share, place_w = self._pulls[at.episode]
        late, held, phase = at.step - since > PATIENCE_STEPS, at.hook[0] == at.target, last
        fell_shut = phase == "pass" and at.share < 0.5 and (at.robot_pos_w[:2] - at.grip_w) @ at.opens_w > 0
        if phase == "leave":
            phase = "pass" if at.step - since > LEAVE_STEPS else "leave"
        elif phase != "pass" and (at.share >= at.enough or (late and at.share >= 1.0)):
            phase = "leave"
        elif fell_shut or (phase != "pass" and late) or (phase == "pull" and not held):
            phase, place_w = "reach", self._place(at)
        elif phase == "reach" and np.linalg.norm(at.robot_pos_w[:2] - place_w) < 0.1:
            phase = "couple"
        elif phase == "couple" and held:
            phase = "pull"
        if late or phase != last or (abs(at.share - share) > 0.02 and phase != "leave"):
            self._pulls[at.episode] = phase, at.step, at.share, place_w
        if phase == "couple":
            bearing = _bearing(at.grip_w - at.robot_pos_w[:2], at.yaw_rad)
            speeds = velocity_towards(self._env.robot.twist, bearing, PULL_M_S, 0.1, np)
            return *speeds, 1.0 if at.hook[0] < 0 else -1.0
        if phase in ("pull", "leave"):
            return (*self._back_off(at), 1.0) if phase == "pull" else (-2 * PULL_M_S, 0.0, -1.0)
        return *self._drive(at, at.goal_xy_w if phase == "pass" else place_w), -1.0

    def _look(self, at: Any) -> None:
        """Add to `at` how far the target is open and has to be (1: open), its hinge, where to couple (2,), m, the unit
        vector (2,) along which that moves, and whether it turns left (1), right (-1) or not (0)."""
        targets, scene, slot, world = self._targets, int(at.scene_index), int(at.target), self._env.world
        span, address, hinge_w = targets.span[slot], targets.address[slot], targets.hinge_w[scene, slot]
        arm_w = at.object_pos_w[slot] - hinge_w
        most, opens_w = opening(world, scene, slot, arm_w)
        at.share = abs(at.qpos[address] - world.rest_qpos[scene, address]) / span
        at.enough = min(ENOUGH, 0.97 * most / span)
        at.hinge_w, at.opens_w = hinge_w[:2], opens_w / max(np.linalg.norm(opens_w), 1e-9)
        lever_m = arm_w[0] * at.opens_w[1] - arm_w[1] * at.opens_w[0]
        at.turns = np.sign(lever_m) * (abs(lever_m) > 0.05)  # a flap, on a level hinge, comes straight out
        at.grip_w = at.hinge_w + arm_w[:2] * (2 * EDGE if at.turns else 1.0)

    def _place(self, at: Any) -> np.ndarray:
        """Return where the robot fits, (2,) m, next to a place before the target where the circle begins."""
        arm_w, scene = at.grip_w - at.hinge_w, at.scene_index
        inwards = min(abs(at.turns) * self._front_m / max(np.linalg.norm(arm_w), 1e-3), 0.8)
        away_w = at.opens_w * math.sqrt(1 - inwards**2) - arm_w / max(np.linalg.norm(arm_w), 1e-3) * inwards
        places = self._starts_w[scene, : self._env.tables.num_starts[scene]]
        off_w = places - at.grip_w - (self._front_m + BEFORE_M) * away_w
        return places[np.linalg.norm(off_w, axis=-1).argmin()]

    def _back_off(self, at: Any) -> tuple[float, float]:
        """Return velocities backwards, on a circle about the hinge that keeps the hook where it holds the leaf."""
        from_w, held_m = at.robot_pos_w[:2] - at.hinge_w, np.linalg.norm(at.hook[5:7] - at.hinge_w)
        radius_m = np.linalg.norm(from_w)
        ahead_w = at.turns * np.array([from_w[1], -from_w[0]]) if at.turns else -at.opens_w
        off_m = radius_m - math.sqrt(max(held_m**2 - self._front_m**2, 0.01))
        bearing = _bearing(ahead_w, at.yaw_rad) + at.turns * np.clip(2.0 * off_m, -0.4, 0.4)
        return -PULL_M_S, at.turns * PULL_M_S / radius_m + 2.0 * bearing


def make_baseline(name: str, env: Any) -> PolicyFn | Planner:
    """Build a policy or planner that never learns, by a name in `train.scoring` (W of namo:W as in `Planner`)."""
    plain = {"random": make_random, "follower": make_follower, "puller": Puller}
    plain["avoider"] = lambda env: Planner(env, None, "avoider")
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
