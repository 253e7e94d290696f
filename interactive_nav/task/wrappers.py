"""Connect learners: batch an environment whose finished episodes are followed by newly drawn ones.

Brax's auto-reset returns each environment's first state again, so an environment would repeat one
episode for ever, and what the task keeps in `info` would leak into it.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State, Wrapper

from interactive_nav.task.env import InteractiveNav
from interactive_nav_common.errors import ConfigError

DRAW_SHARE = 16
"""New episodes are drawn for this fraction of the batch at a time."""


def scene_of_slot(env: InteractiveNav, slot: jax.Array) -> jax.Array | None:
    """Return the scenes [...] that environments of these numbers keep; None where each episode draws one."""
    return slot % len(env.scenes) if env.config.scene_choice == "slot" else None


def reset_all(env: InteractiveNav, keys: jax.Array, slot: jax.Array | None = None) -> State:
    """Return N new episodes of [N, 2] keys, consumed, each in the scene that its environment keeps, if it keeps one.

    `slot` is [N] i32, numbers of the environments where these are a part of a larger batch; None: 0 to N - 1.
    """
    scene = scene_of_slot(env, jnp.arange(keys.shape[0]) if slot is None else slot)
    return jax.vmap(env.reset)(keys) if scene is None else jax.vmap(env.reset)(keys, scene)


def draw_where(env: InteractiveNav, current: tuple, over: jax.Array) -> tuple:
    """Draw new episodes where `over`, drawn for a part of the batch at a time: few end in one step.

    Args:
        current: physics, `nav` and `rng` of N environments; where an episode is over, its `rng` is consumed.
        over: [N] bool.

    Returns:
        As `current`; an environment that keeps its scene stays in it.
    """
    n = over.shape[0]
    share = max(1, n // DRAW_SHARE)

    def some(carry):
        current, pending = carry
        index = jnp.nonzero(pending, size=share, fill_value=n)[0]
        nav, rng = (jax.tree.map(lambda x: x[jnp.minimum(index, n - 1)], x) for x in current[-2:])
        kept = (nav.scene_index,) if env.config.scene_choice == "slot" else ()
        fresh = jax.vmap(env.draw)(rng, *kept)
        new = (fresh.pipeline_state, fresh.info["nav"], fresh.info["rng"])
        current = jax.tree.map(lambda old, x: old.at[index].set(x, mode="drop"), current, new)
        return current, pending.at[index].set(False, mode="drop")

    return jax.lax.while_loop(lambda carry: carry[1].any(), some, (current, over))[0]


def wrap_for_brax_training(
    env: Any, episode_length: int | None = None, action_repeat: int = 1, randomization_fn: Any = None
) -> AutoResetEnv:
    """Wrap an environment as Brax's learners' `wrap_env_fn`, as MuJoCo Playground has it: every episode is newly drawn.

    Args:
        env: what `interactive_nav.make` returns, or a wrapper of it: see `AutoResetEnv`.
        episode_length: at least the environment's `episode_steps`, which ends its episodes; None: that.
        action_repeat: control steps that an action is held for.
        randomization_fn: none: scenes and episodes are drawn by the environment.

    Raises:
        ConfigError: a shorter `episode_length`, a `randomization_fn`, or a wrapper that would be passed over.
    """
    steps = env.config.episode_steps
    if episode_length is not None and episode_length < steps:
        raise ConfigError(
            f"episode_length is {episode_length}, expected at least the environment's {steps}: "
            f"make it with episode_steps={episode_length}"
        )
    if randomization_fn is not None:
        raise ConfigError("randomization_fn is given, expected None: the environment draws its scenes by itself")
    return AutoResetEnv(env, action_repeat)


def _refuse_passed_over(env: Any) -> None:
    """Refuse wrappers whose `step` or `reset` is never called: a batch calls their finer parts."""
    while isinstance(env, Wrapper):
        changed = {name for name in ("reset", "step", "draw", "advance", "observe") if name in _overridden(type(env))}
        for name, part in (("step", "advance"), ("reset", "draw")):
            if name in changed and not changed & {part, "observe"}:
                raise ConfigError(
                    f"{type(env).__name__} overrides `{name}`, which a batch that resets itself never calls; expected "
                    f"`{part}` (the {name} without its observation) or `observe`: override that too"
                )
        env = env.env


def _overridden(kind: type) -> set[str]:
    return {name for base in kind.__mro__[: kind.__mro__.index(Wrapper)] for name in vars(base)}


class AutoResetEnv(Wrapper):
    """N environments as one natively batched Brax environment (`wrap_env=False` for Brax's learners).

    `reward`, `done`, `info["truncation"]`, `info["time_out"]` and `metrics` belong to the last step;
    where an episode ended, `obs`, `pipeline_state` and `info["nav"]` are those of a new one. `info` also has
    `steps` [N] (of the episode that the step belongs to), `episode_done` [N] and `episode_metrics`: name ->
    [N], the scores of the last finished episode, with `length` and `sum_reward`.
    """

    env: InteractiveNav

    def __init__(self, env: Any, action_repeat: int = 1):
        """Wrap an environment.

        Args:
            env: of one episode; wrappers of it override `draw`, `advance` and `observe`, parts of `reset` and `step`.
            action_repeat: control steps that an action is held for; rewards are summed.

        Raises:
            ConfigError: a wrapper that overrides `step` or `reset` alone, and so would never be called.
        """
        super().__init__(env)
        _refuse_passed_over(env)
        self.action_repeat = action_repeat

    def reset(self, rng: jax.Array, slot: jax.Array | None = None) -> State:
        """Return N states for [N, 2] keys; `slot` as in `reset_all`."""
        state = reset_all(self.env, rng, slot)
        zero = jnp.zeros(rng.shape[0])
        info = {
            **state.info,
            "steps": zero,
            "episode_done": zero,
            "running_reward": zero,
            "episode_metrics": {name: zero for name in (*self.env.metric_names, "length", "sum_reward")},
        }
        return state.replace(info=info)

    def step(self, state: State, action: jax.Array) -> State:
        """Return the states that follow N states and [N, A] actions."""
        # What ended in the last step has begun anew.
        stepped = jax.vmap(self.env.advance)(state.replace(done=jnp.zeros_like(state.done)), action)
        for _ in range(self.action_repeat - 1):
            paid = stepped.reward
            stepped = jax.vmap(self.env.advance)(stepped, action)
            stepped = stepped.replace(reward=paid + stepped.reward)
        done = stepped.done > 0
        steps = stepped.info["nav"].step_count.astype(jnp.float32)
        steps = jnp.where(done, stepped.metrics["episode_steps"], steps)
        total = state.info["running_reward"] + stepped.reward
        finished = {name: stepped.metrics[name] for name in self.env.metric_names}
        finished |= {"length": steps, "sum_reward": total}
        last = state.info["episode_metrics"]
        episode_metrics = {name: jnp.where(done, finished[name], last[name]) for name in last}

        moving = (stepped.pipeline_state, stepped.info["nav"], stepped.info["rng"])
        physics, nav, rng = draw_where(self.env, moving, done)
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
