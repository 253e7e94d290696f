"""Step a batch of environments for each way in which Gymnasium starts new episodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from interactive_nav.task.env import InteractiveNav
from interactive_nav.task.wrappers import draw_where

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode


NONFINITE_ACTIONS = "nonfinite_actions"
"""Entries of a step's action that are no finite number; the environment takes 0 for them."""


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def reset_where(env: InteractiveNav, state: Any, keys: jax.Array, mask: jax.Array) -> Any:
    """Start new episodes where `mask`."""
    info = state.info
    physics, nav, rng = draw_where(env, (state.pipeline_state, info["nav"], _where(mask, keys, info["rng"])), mask)
    of_step = (state.reward, state.done, state.metrics, info["truncation"], info["time_out"])
    reward, done, metrics, truncation, time_out = jax.tree.map(lambda x: jnp.where(mask, 0.0, x), of_step)
    info = {**info, "nav": nav, "rng": rng, "truncation": truncation, "time_out": time_out}
    new = state.replace(pipeline_state=physics, reward=reward, done=done, metrics=metrics, info=info)
    return new.replace(obs=_where(mask, jax.vmap(env.observe)(new).obs, state.obs))


def step(
    env: InteractiveNav, mode: AutoresetMode, state: Any, actions: jax.Array, ended: jax.Array
) -> tuple[Any, jax.Array, tuple[Any, ...]]:
    """Return the state after a step and, where the mode has it, a reset; which episodes were over before, so that
    nothing but a reset was done; and observation, reward, terminated, truncated and metrics."""
    stepped = new = jax.vmap(env.step)(state, actions)
    same = mode.name == "SAME_STEP"
    if mode.name != "DISABLED":
        due, keys = (stepped.done > 0, stepped.info["rng"]) if same else (ended, state.info["rng"])
        new = jax.lax.cond(due.any(), lambda s: reset_where(env, s, keys, due), lambda s: s, stepped)
    reported = new if mode.name == "NEXT_STEP" else stepped
    truncated = reported.info["truncation"] > 0
    over = ended if mode.name == "NEXT_STEP" else jnp.zeros_like(ended)
    metrics = {**reported.metrics, NONFINITE_ACTIONS: (~jnp.isfinite(actions)).sum(-1).astype(jnp.float32)}
    return new, over, (reported.obs, reported.reward, (reported.done > 0) & ~truncated, truncated, metrics)
