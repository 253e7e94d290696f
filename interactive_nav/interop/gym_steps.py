"""A batch of environments and its state in, the next state out, for each way of Gymnasium's to begin new episodes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from gymnasium.vector import AutoresetMode

from interactive_nav.task.env import InteractiveNav
from interactive_nav.task.wrappers import draw_where


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def reset_where(env: InteractiveNav, state: Any, keys: jax.Array, mask: jax.Array) -> Any:
    """New episodes where `mask`."""
    info = state.info
    physics, nav, rng = draw_where(env, (state.pipeline_state, info["nav"], _where(mask, keys, info["rng"])), mask)
    of_step = (state.reward, state.done, state.metrics, info["truncation"], info["time_out"])
    reward, done, metrics, truncation, time_out = jax.tree.map(lambda x: jnp.where(mask, 0.0, x), of_step)
    info = {**info, "nav": nav, "rng": rng, "truncation": truncation, "time_out": time_out}
    new = state.replace(pipeline_state=physics, reward=reward, done=done, metrics=metrics, info=info)
    return new.replace(obs=_where(mask, jax.vmap(env.observe)(new).obs, state.obs))


def _outcome(state: Any) -> tuple[Any, ...]:
    truncated = state.info["truncation"] > 0
    return state.obs, state.reward, (state.done > 0) & ~truncated, truncated, dict(state.metrics)


def _step_same(env: InteractiveNav, state: Any, actions: jax.Array, ended: jax.Array) -> tuple[Any, ...]:
    stepped = jax.vmap(env.step)(state, actions)
    done = stepped.done > 0
    new = jax.lax.cond(done.any(), lambda s: reset_where(env, s, s.info["rng"], done), lambda s: s, stepped)
    return new, jnp.zeros_like(done), _outcome(stepped)


def _step_next(env: InteractiveNav, state: Any, actions: jax.Array, ended: jax.Array) -> tuple[Any, ...]:
    stepped = jax.vmap(env.step)(state, actions)
    new = jax.lax.cond(ended.any(), lambda s: reset_where(env, s, state.info["rng"], ended), lambda s: s, stepped)
    return new, ended, _outcome(new)


def _step_only(env: InteractiveNav, state: Any, actions: jax.Array, ended: jax.Array) -> tuple[Any, ...]:
    stepped = jax.vmap(env.step)(state, actions)
    return stepped, jnp.zeros_like(ended), _outcome(stepped)


STEPS = {
    AutoresetMode.SAME_STEP: _step_same,
    AutoresetMode.NEXT_STEP: _step_next,
    AutoresetMode.DISABLED: _step_only,
}
"""What follows an episode's end: (env, state, actions, ended) -> (state, was over, outcome)."""
