"""A two-wheeled point on an empty plane, with the contract of `InteractiveNav`: what learners are tested on.

Kinematics are exact, so a good policy reaches every goal by a nearly straight path; there is nothing to push,
so effort_efficiency is 1 and INS_0.5 = 0.5 P_eff + 0.5.
"""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import Env, State

from interactive_nav.config import NavConfig
from interactive_nav.robots import get_robot
from interactive_nav.task.terms import EPISODE_METRICS
from interactive_nav.task.wrappers import AutoResetEnv
from scenes_mjcf.schema import SceneMaps

WHEEL_RADIUS_M, TRACK_M, DT_S = 0.0352, 0.23, 0.1
SUCCESS_M = 0.333

ToyConfig = functools.partial(NavConfig.of, episode_steps=60, num_objects=1)
"""Settings of the toy: those that rows of results name."""


@flax.struct.dataclass
class ToyNav:
    """The part of NavInfo that evaluation reads."""

    scene_index: jax.Array
    start_xy_w: jax.Array
    goal_xy_w: jax.Array
    robot_pos_w: jax.Array
    yaw_rad: jax.Array
    object_pos_w: jax.Array
    memory: dict[str, jax.Array]
    step_count: jax.Array
    velocity: jax.Array
    """[2] speed along heading (m/s) and turning (rad/s) in the last step."""


class ToyEnv(Env):
    """One environment: reset(key), step(state, action); no auto-reset."""

    def __init__(self, config: NavConfig | None = None, nan_at_step: int | None = None, **_: Any):
        self.config = config or ToyConfig()
        self.robot, self.metric_names = get_robot("turtlebot"), EPISODE_METRICS
        maps = SceneMaps(np.ones((80, 80), bool), 0.1, (-4.0, -4.0), 0.0)
        self.scenes = (SimpleNamespace(name="plane", split="train", maps=maps, task_digest="task-1:plane"),)
        self.sensors = SimpleNamespace(sizes={"waypoints": 20, "goal": 3, "velocity": 6}, cameras=())
        self.world = SimpleNamespace(slots=SimpleNamespace(names=(("box_0",),), categories=(("box",),)))
        self.furniture_map = lambda scene: np.zeros((80, 80), bool)
        self.nan_at_step = nan_at_step

    @property
    def observation_size(self) -> int:
        return 29

    @property
    def action_size(self) -> int:
        return 2

    privileged_size = 3

    def privileged(self, state: State) -> jax.Array:
        """Goal minus position, world frame, and the share of time gone."""
        nav: ToyNav = state.info["nav"]
        time = nav.step_count / self.config.episode_steps
        return jnp.append((nav.goal_xy_w - nav.robot_pos_w[:2]) / 2.5, time)

    @property
    def backend(self) -> str:
        return "native"

    def _observe(self, nav: ToyNav) -> jax.Array:
        offset = nav.goal_xy_w - nav.robot_pos_w[:2]
        cos, sin = jnp.cos(nav.yaw_rad), jnp.sin(nav.yaw_rad)
        goal_b = jnp.stack([cos * offset[0] + sin * offset[1], -sin * offset[0] + cos * offset[1]])
        distance = jnp.linalg.norm(goal_b)
        along = jnp.minimum(0.2 * jnp.arange(1, 11), distance)
        waypoints_b = along[:, None] * goal_b[None] / jnp.maximum(distance, 1e-6)
        zero = jnp.zeros(1)
        velocity = jnp.concatenate([nav.velocity[:1], zero, zero, zero, zero, nav.velocity[1:]])
        return jnp.concatenate([waypoints_b.ravel(), goal_b, zero, velocity])

    def _metrics(self, nav: ToyNav, success: jax.Array, done: jax.Array) -> dict[str, jax.Array]:
        shortest = jnp.linalg.norm(nav.goal_xy_w - nav.start_xy_w)
        p_eff = success * jnp.clip(shortest / jnp.maximum(nav.memory["robot_path_m"], 1e-6), 0.0, 1.0)
        scores = {name: jnp.zeros(()) for name in EPISODE_METRICS} | {
            "success": success,
            "path_efficiency": p_eff,
            "effort_efficiency": jnp.ones(()),
            "kinematic_effort": jnp.ones(()),
            "dynamic_effort": jnp.ones(()),
            "ins_0.5": 0.5 * p_eff + 0.5,
            "robot_path_m": nav.memory["robot_path_m"],
            "shortest_path_m": shortest,
            "episode_steps": nav.step_count.astype(jnp.float32),
        }
        return {name: done * score for name, score in scores.items()}

    def reset(self, rng: jax.Array, limit_m: Any = jnp.inf) -> State:
        rng, key_distance, key_bearing, key_yaw = jax.random.split(rng, 4)
        distance = jax.random.uniform(key_distance, (), minval=1.0, maxval=jnp.minimum(2.5, limit_m))
        bearing, yaw = jax.random.uniform(key_bearing), jax.random.uniform(key_yaw)
        bearing = 2 * jnp.pi * bearing
        nav = ToyNav(
            scene_index=jnp.zeros((), jnp.int32),
            start_xy_w=jnp.zeros(2),
            goal_xy_w=distance * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)]),
            robot_pos_w=jnp.zeros(3),
            yaw_rad=2 * jnp.pi * yaw,
            object_pos_w=jnp.array([[3.0, 3.0, 0.0]]),
            memory={
                "object_path_m": jnp.zeros(1),
                "object_contact_steps": jnp.zeros(1, jnp.int32),
                "object_force_sum_n": jnp.zeros(1),
                "robot_path_m": jnp.zeros(()),
            },
            step_count=jnp.zeros((), jnp.int32),
            velocity=jnp.zeros(2),
        )
        zero = jnp.zeros(())
        info = {"nav": nav, "rng": rng, "truncation": zero, "time_out": zero}
        return State(None, self._observe(nav), zero, zero, self._metrics(nav, zero, zero), info)

    def draw(self, rng: jax.Array, **limit: jax.Array) -> State:
        return self.reset(rng, **limit)

    def observe(self, state: State) -> State:
        return state.replace(obs=self._observe(state.info["nav"]))  # type: ignore[attr-defined]

    def step(self, state: State, action: jax.Array) -> State:
        return self.observe(self.advance(state, action))

    def advance(self, state: State, action: jax.Array) -> State:
        nav: ToyNav = state.info["nav"]
        low, high = jnp.asarray(self.robot.action_low), jnp.asarray(self.robot.action_high)
        wheels = low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (high - low)
        left, right = wheels * WHEEL_RADIUS_M
        speed, turn = 0.5 * (left + right), (right - left) / TRACK_M
        yaw = nav.yaw_rad + turn * DT_S
        move = speed * DT_S * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
        pos = nav.robot_pos_w.at[:2].add(move)
        before = jnp.linalg.norm(nav.goal_xy_w - nav.robot_pos_w[:2])
        after = jnp.linalg.norm(nav.goal_xy_w - pos[:2])
        success = (after < SUCCESS_M).astype(jnp.float32)
        steps = nav.step_count + 1
        truncation = (steps >= self.config.episode_steps).astype(jnp.float32) * (1.0 - success)
        done = jnp.maximum(success, truncation)
        reward = before - after + 10.0 * success
        if self.nan_at_step is not None:
            reward = jnp.where(steps == self.nan_at_step, jnp.nan, reward)
        nav = nav.replace(  # type: ignore[attr-defined]
            robot_pos_w=pos,
            yaw_rad=yaw,
            memory=nav.memory | {"robot_path_m": nav.memory["robot_path_m"] + jnp.linalg.norm(move)},
            step_count=steps,
            velocity=jnp.stack([speed, turn]),
        )
        info = {**state.info, "nav": nav, "truncation": truncation, "time_out": truncation}
        return state.replace(  # type: ignore[attr-defined]
            reward=reward,
            done=done,
            metrics=self._metrics(nav, success, done),
            info=info,
        )


def batched(env: ToyEnv | None = None) -> AutoResetEnv:
    """The toy as learners take it: many at once, each finished episode followed by a new one."""
    return AutoResetEnv(env or ToyEnv())  # type: ignore[arg-type]
