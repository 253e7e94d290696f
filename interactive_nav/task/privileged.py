"""Add the true state to observations, for critics: in dicts, beside the policy's parts, as Brax has it."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State, Wrapper

from interactive_nav.navigation.lookup import free_at
from interactive_nav.sensing.boxes import BoxTables, body_poses, half_sizes_m
from interactive_nav.task.terms import Moment, masses_kg

PRIVILEGED = "privileged_state"
"""Its key in the observation; `value_obs_key` of Brax's PPO."""
NEAREST, REACH_M = 8, 5.0
"""Movable objects that it describes, and the distance beyond which one is left out."""
OF_TASK, OF_OBJECT = 10, 10
MAP_SIDE, MAP_SPACING_M = 9, 0.3
PRIVILEGED_SIZE = OF_TASK + OF_OBJECT * NEAREST + MAP_SIDE**2
HOME_M = 10.0
"""Unit of distances across a home."""


def privileged_state(at: Moment, boxes: BoxTables) -> jax.Array:
    """Return (PRIVILEGED_SIZE,) f32 of one environment, zeros where the state is not finite.

    The task: goal (2) in the robot's frame, robot (2) and geodesic distance, each in units of `HOME_M`; cosine and sine
    of the robot's yaw, share of time left, touches of an object and of a wall. Then each of the `NEAREST` movable
    objects within `REACH_M`: 1, centre of mass (3) in the robot's frame in units of `REACH_M`, cosine and sine of its
    yaw against the robot's, half sizes (3) in m, ln(1 + mass in kg) / 5; 0 where there is none. Last, the true map: 1
    where the robot's centre may stand, at `MAP_SIDE` squared points `MAP_SPACING_M` apart around it, in its frame,
    from behind on the right to the left, then forwards.
    """
    nav, scene = at.nav, at.nav.scene_index
    pos_w, cos, sin = nav.robot_pos_w, jnp.cos(nav.yaw_rad), jnp.sin(nav.yaw_rad)

    def turned(xy: jax.Array, sin: jax.Array) -> jax.Array:
        """Turn vectors [..., 2] by the robot's yaw; with `-sin` back, into its frame."""
        return jnp.stack([cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], -1)

    to_goal = turned(nav.goal_xy_w - pos_w[:2], -sin)
    distances = jnp.stack([*to_goal, *pos_w[:2], nav.geodesic_m]) / HOME_M
    left = 1.0 - nav.step_count / at.config.episode_steps
    task = [distances, jnp.stack([cos, sin, left]), nav.memory["touching"].astype(jnp.float32)]

    mass_kg, offset_w = masses_kg(at)[1:], nav.object_pos_w - pos_w[None]
    distance_m = jnp.where(mass_kg > 0, jnp.linalg.norm(offset_w[:, :2], axis=-1), jnp.inf)
    axis_b = turned(body_poses(boxes, scene, at.physics.qpos)[1][: len(mass_kg), :2, 0], -sin)
    heading = axis_b / jnp.maximum(jnp.linalg.norm(axis_b, axis=-1, keepdims=True), 1e-6)
    place = jnp.concatenate([turned(offset_w, -sin), offset_w[:, 2:]], -1) / REACH_M
    ones, mass = jnp.ones((len(mass_kg), 1)), jnp.log1p(mass_kg)[:, None] / 5
    rows = jnp.concatenate([ones, place, heading, half_sizes_m(boxes)[scene], mass], -1)
    rows = jnp.where(distance_m[:, None] < REACH_M, rows, 0.0)[jnp.argsort(distance_m)[:NEAREST]]
    objects = jnp.pad(rows, [(0, NEAREST - len(rows)), (0, 0)]).reshape(-1)

    side = (jnp.arange(MAP_SIDE) - MAP_SIDE // 2) * MAP_SPACING_M
    ahead_left = jnp.stack(jnp.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    free = free_at(at.tables, scene, pos_w[None, :2] + turned(ahead_left, sin))
    whole = jnp.concatenate([*task, objects, free.astype(jnp.float32)])
    return jnp.where(jnp.isfinite(whole).all(), whole, 0.0)


class PrivilegedEnv(Wrapper):
    """One environment with `privileged_state` in its observations."""

    @property
    def observation_size(self) -> Any:  # type: ignore[override]
        size: Any = self.env.observation_size
        known = size if isinstance(size, Mapping) else {"state": size}
        return {**known, PRIVILEGED: self.env.privileged_size}  # type: ignore[attr-defined]

    def _with(self, state: Any) -> State:
        known = state.obs if isinstance(state.obs, Mapping) else {"state": state.obs}
        return state.replace(obs={**known, PRIVILEGED: self.env.privileged(state)})  # type: ignore[attr-defined]

    def reset(self, *given: Any) -> State:
        """Return the first state, with the true state."""
        return self._with(self.env.reset(*given))

    def step(self, state: State, action: jax.Array) -> State:
        """Return the next state, with the true state."""
        return self._with(self.env.step(state, action))

    def observe(self, *given: Any) -> State:
        """Observe, and add the true state."""
        return self._with(self.env.observe(*given))  # type: ignore[attr-defined]


def without_privileged(observation: Any) -> Any:
    """Return an observation, or its size, as the policy takes it: a vector alone bare."""
    if not isinstance(observation, Mapping) or PRIVILEGED not in observation:
        return observation
    rest = {name: value for name, value in observation.items() if name != PRIVILEGED}
    return rest["state"] if rest.keys() == {"state"} else rest
