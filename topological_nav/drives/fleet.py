"""Routes in, what the expert did on them out: thousands of drives as one batch of the environment's physics."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import interactive_nav
from interactive_nav.task.env import InteractiveNav
from interactive_nav_common.errors import UserError
from interactive_nav_common.rows import Rows
from scenes_mjcf.robot_facts import ROBOTS
from topological_nav.config import DriveConfig
from topological_nav.drives.expert import CONTROL_S, Terrain, command, scan_points
from topological_nav.scenes.rendering import need_engine
from topological_nav.scenes.simulation import episode_starts

SEGMENT = 25
"""Control steps a program; between two of them the host looks whether any drive still goes on."""
LIDAR_B = {name: facts.lidar_b for name, facts in ROBOTS.items() if facts.lidar_b is not None}
"""Scanners by robot, m in the base's frame."""


@dataclasses.dataclass(frozen=True)
class Tasks(Rows):
    """Drives of one batch over several scenes; B of them."""

    scene: np.ndarray
    """[B] i32."""
    goals: np.ndarray
    """[B, legs] i32 fields of the terrain, one a leg."""
    goals_w: np.ndarray
    """[B, legs, 2] m, the nodes they lead to."""
    legs: np.ndarray
    """[B] i32."""
    start_xy_w: np.ndarray
    """[B, 2] m."""
    start_yaw_rad: np.ndarray
    """[B]."""


def make_env(scenes: Sequence[Path], config: DriveConfig) -> InteractiveNav:
    """The environment of the drives: furniture at rest, no small objects, the robot commanded by velocities."""
    need_engine(config.backend)
    if config.robot not in LIDAR_B:
        raise UserError(f"robot is '{config.robot}', expected one with a scanner: {', '.join(LIDAR_B)}")
    return interactive_nav.make(
        config.robot,
        [str(scene) for scene in scenes],
        backend=config.backend,
        control_mode="twist",
        control_dt_s=CONTROL_S,
        num_objects=0,
        observations=("lidar",),
        lidar_rays=config.lidar_rays,
        lidar_fov_deg=config.lidar_fov_deg,
        lidar_range_m=config.lidar_range_m,
        lidar_pos_m=LIDAR_B[config.robot],
        episode_steps=10**6,
        # All that stands in the scene can be met: what MJX's window would leave out would not be felt.
        active_furniture=0,
        active_small=0,
        active_doors=0,
        active_walls=0,
    )


class Fleet:
    """Drives batches of a fixed size; compiled once."""

    def __init__(self, env: InteractiveNav, terrain: Terrain, config: DriveConfig):
        """Takes what stays the same."""
        self._env, self._terrain, self._config = env, terrain, config
        size = env.robot.size_m
        assert size is not None
        self._half_m = jnp.asarray(size[:2], jnp.float32) / 2
        self._begin, self._segment = jax.jit(self._begun), jax.jit(self._driven)

    def drive(self, tasks: Tasks, told: Callable[[int], None] = lambda _: None) -> dict[str, np.ndarray]:
        """Drives until all have arrived or run out of time.

        Returns:
            Fields of `dataset.Drives`: those of control steps [B, T, ...], where rows after a drive's `steps` [B] mean
            nothing; and `reached` and `broken` [B].
        """
        placed = jax.tree.map(jnp.asarray, dataclasses.asdict(tasks))
        carry, parts = self._begin(placed), []
        while True:
            carry, part = self._segment(self._terrain, placed, carry)
            parts.append(jax.device_get(part))
            ended = int(carry["ended"].sum())
            told(ended)
            if ended == len(tasks):
                break
        outcome = {name: np.asarray(carry[name]) for name in ("steps", "reached", "broken")}
        return {name: np.concatenate([part[name] for part in parts]).swapaxes(0, 1) for name in parts[0]} | outcome

    def _begun(self, tasks: dict[str, Any]) -> dict[str, Any]:
        count = len(tasks["scene"])
        start = episode_starts(tasks["start_xy_w"], tasks["start_yaw_rad"], tasks["goals_w"][:, 0], 0, tasks["scene"])
        state = jax.vmap(self._env.reset_to)(start, jnp.zeros((count, 2), jnp.uint32))
        no = jnp.zeros(count, bool)
        zero = jnp.zeros(count, jnp.int32)
        counts = dict.fromkeys(("leg", "leg_steps", "steps"), zero) | dict.fromkeys(("ended", "reached", "broken"), no)
        return {"state": state, "velocity": jnp.zeros((count, 2)), **counts}

    def _driven(self, terrain: Terrain, tasks: dict[str, Any], carry: dict[str, Any]):
        return jax.lax.scan(lambda c, _: self._step(terrain, tasks, c), carry, None, length=SEGMENT)

    def _step(self, terrain: Terrain, tasks: dict[str, Any], carry: dict[str, Any]):
        config, state = self._config, carry["state"]
        nav = state.info["nav"]
        pose = jnp.concatenate([nav.robot_pos_w[:, :2], nav.yaw_rad[:, None]], 1)
        xy_b = LIDAR_B[config.robot][:2]
        rows = jnp.arange(len(pose))
        goal = tasks["goals"][rows, carry["leg"]]

        def ask(scene, goal, pose, velocity, ranges):
            points = scan_points(ranges * config.lidar_range_m, config, xy_b)
            return command(terrain, scene, goal, pose, velocity, points, self._half_m, config)

        asked, gap = jax.vmap(ask)(tasks["scene"], goal, pose, carry["velocity"], state.obs)
        going = ~carry["ended"]
        asked = jnp.where(going[:, None], asked, 0.0)
        action = self._env.robot.drive(asked[:, 0], asked[:, 1], jnp)
        state = jax.vmap(self._env.step)(state, action)
        nav, memory = state.info["nav"], state.info["nav"].memory
        away = jnp.linalg.norm(nav.robot_pos_w[:, :2] - tasks["goals_w"][rows, carry["leg"]], axis=-1)
        arrived = going & (away < config.reached_m)
        leg = carry["leg"] + arrived
        broken = going & (
            (state.metrics["nonfinite"] > 0) | (memory["overflow_steps"] > 0) | (memory["left_out_steps"] > 0)
        )
        done = arrived & (leg >= tasks["legs"]) & ~broken
        leg_steps = jnp.where(arrived, 0, carry["leg_steps"] + going)
        out = {
            "state": state,
            "velocity": asked,
            "leg": jnp.minimum(leg, tasks["legs"] - 1),
            "leg_steps": leg_steps,
            "steps": carry["steps"] + going,
            "ended": carry["ended"] | done | broken | (leg_steps >= round(config.leg_s / CONTROL_S)),
            "reached": carry["reached"] | done,
            "broken": carry["broken"] | broken,
        }
        return out, {"pose_w": pose, "command": asked, "gap_m": gap, "touching": memory["touching"]}
