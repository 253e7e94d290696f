"""The seam to learners: a batched environment whose finished episodes are followed by newly drawn ones.

Brax's own auto-reset returns each environment's first state again, so an environment would repeat one
episode for ever, and what the task keeps in `info` would leak into it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from interactive_nav.task.env import EPISODE_METRICS, InteractiveNav

DRAW_SHARE = 16
"""New episodes are drawn for this fraction of the batch at a time."""


def scene_of_slot(env: InteractiveNav, slot: jax.Array) -> jax.Array | None:
    """[...] scenes that environments with these numbers in their batch keep; None where each episode draws one."""
    return slot % len(env.scenes) if env.config.rules.scene_choice == "slot" else None


class AutoResetEnv(Env):
    """N environments as one natively batched Brax environment (`wrap_env=False` for Brax's learners).

    `reward`, `done`, `info["truncation"]`, `info["time_out"]` and `metrics` belong to the step just made;
    where an episode ended, `obs`, `pipeline_state` and `info["nav"]` are those of a new one. `info` also has
    `steps` [N] (of the episode that the step belongs to), `episode_done` [N] and `episode_metrics`: name ->
    [N], the scores of the last finished episode, with `length` and `sum_reward`.
    """

    def __init__(self, env: InteractiveNav):
        self.env = env

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:  # type: ignore[override]
        """Length of the observation; with images, the shape under each key."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """Physics backend in use."""
        return self.env.backend

    @property
    def unwrapped(self) -> InteractiveNav:  # type: ignore[override]
        """The single environment."""
        return self.env

    def reset(self, rng: jax.Array, slot: jax.Array | None = None) -> State:
        """[N, 2] keys to N states.

        Args:
            rng: the keys.
            slot: [N] i32 numbers of the environments where these are a part of a larger batch; None: 0 to N - 1.
        """
        slot = jnp.arange(rng.shape[0]) if slot is None else slot
        scene = scene_of_slot(self.env, slot)
        state = jax.vmap(self.env.reset)(rng) if scene is None else jax.vmap(self.env.reset)(rng, scene)
        zero = jnp.zeros(rng.shape[0])
        info = {
            **state.info,
            "steps": zero,
            "episode_done": zero,
            "running_reward": zero,
            "episode_metrics": {name: zero for name in (*EPISODE_METRICS, "length", "sum_reward")},
        }
        return state.replace(info=info)

    def step(self, state: State, action: jax.Array) -> State:
        """N states and [N, A] actions to N states."""
        stepped = jax.vmap(self.env.advance)(state, action)
        done = stepped.done > 0
        steps = stepped.info["nav"].step_count.astype(jnp.float32)
        total = state.info["running_reward"] + stepped.reward
        finished = {name: stepped.metrics[name] for name in EPISODE_METRICS}
        finished |= {"length": steps, "sum_reward": total}
        last = state.info["episode_metrics"]
        episode_metrics = {name: jnp.where(done, finished[name], last[name]) for name in last}

        moving = (stepped.pipeline_state, stepped.info["nav"], stepped.info["rng"])
        physics, nav, rng = self._with_new_episodes(moving, done)
        info = {
            **stepped.info,
            "nav": nav,
            "rng": rng,
            "steps": steps,
            "episode_done": stepped.done,
            "running_reward": jnp.where(done, 0.0, total),
            "episode_metrics": episode_metrics,
        }
        # Observed once, after new episodes have begun: images cost as much as physics.
        return jax.vmap(self.env.observe)(stepped.replace(pipeline_state=physics, info=info))

    def _with_new_episodes(self, current, done: jax.Array):
        """Draws new episodes where `done`, a part of the batch at a time: few end in one step."""
        n = done.shape[0]
        share = max(1, n // DRAW_SHARE)

        def some(carry):
            current, pending = carry
            index = jnp.nonzero(pending, size=share, fill_value=n)[0]
            nav, rng = (jax.tree.map(lambda x: x[jnp.minimum(index, n - 1)], x) for x in current[-2:])
            if self.env.config.rules.scene_choice == "slot":
                fresh = jax.vmap(self.env.draw)(rng, nav.scene_index)
            else:
                fresh = jax.vmap(self.env.draw)(rng)
            new = (fresh.pipeline_state, fresh.info["nav"], fresh.info["rng"])
            current = jax.tree.map(lambda old, x: old.at[index].set(x, mode="drop"), current, new)
            return current, pending.at[index].set(False, mode="drop")

        return jax.lax.while_loop(lambda carry: carry[1].any(), some, (current, done))[0]
