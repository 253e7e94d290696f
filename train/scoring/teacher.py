"""Let a planner label the states that a student visits (`clone.teacher`)."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from brax.envs.base import Wrapper
from jax.experimental import io_callback

from interactive_nav_common.errors import ConfigError
from train.config import EnvConfig
from train.runs.run import build_env
from train.scoring.policies import Planner, make_baseline

Teach = Callable[[Any, jax.Array], jax.Array]
"""(states of N environments, key) -> actions [N, A] in [-1, 1]; planners run on the host, so they are not pure."""


class TaughtEnv(Wrapper):
    """One environment with `teach`, which returns what the teacher would do in its states."""

    def __init__(self, teacher: str, config: EnvConfig, build_env: Callable[[EnvConfig], Any] = build_env):
        """Build an environment and its teacher, a planner or baseline by name."""
        super().__init__(build_env(config))
        if teacher not in ("avoider", "follower") and not teacher.startswith("namo:"):
            raise ConfigError(f"clone.teacher is {teacher!r}, expected avoider, namo:W or follower")
        policy = make_baseline(teacher, self.env)
        self.teach: Teach = _on_host(policy, self.env) if isinstance(policy, Planner) else _batched(policy)


def _batched(policy: Any) -> Teach:
    def teach(state: Any, key: jax.Array) -> jax.Array:
        return jax.vmap(policy)(state.obs, jax.random.split(key, state.done.shape[0]))

    return teach


def _on_host(planner: Planner, env: Any) -> Teach:
    """Return a planner that compiled programs call; its plans are of the episodes that are under way."""
    step = 0

    def act(qpos: Any, nav: Any) -> np.ndarray:
        nonlocal step
        step, every = step + 1, np.arange(len(nav.yaw_rad))
        physics = SimpleNamespace(qpos=np.asarray(qpos))
        state = SimpleNamespace(info={"nav": nav}, pipeline_state=physics)
        return np.asarray(planner.act(state, every, every >= 0, step), np.float32)

    def teach(state: Any, key: jax.Array) -> jax.Array:
        shape = jax.ShapeDtypeStruct((state.done.shape[0], env.action_size), np.float32)
        unread: dict[str, Any] = {"goal_field": None, "round_field": None, "dynamics": None, "memory": {}}
        nav = state.info["nav"].replace(**unread)  # large, and planners do without
        # In order, because plans are kept from step to step.
        return io_callback(act, shape, state.pipeline_state.qpos, nav, ordered=True)

    return teach
