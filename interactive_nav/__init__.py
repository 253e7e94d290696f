"""Interactive navigation on MuJoCo MJX: scene folders in, a batched Brax environment out.

    env = interactive_nav.make("turtlebot", scenes=["scenes_mjcf/apartment_0"])
    state = jax.jit(jax.vmap(env.reset))(keys)
    state = jax.jit(jax.vmap(env.step))(state, action)
"""

from __future__ import annotations

import dataclasses
import difflib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# The scenes' tables are constants of `reset` and `step`, tens to hundreds of megabytes. Without this, JAX
# writes them as text into every program that it compiles (measured: 23 s instead of 8 s for a small room).
# JAX reads it once, at its own import: import interactive_nav first, or set the variable yourself.
os.environ.setdefault("JAX_USE_SIMPLIFIED_JAXPR_CONSTANTS", "1")

from interactive_nav import geodesic, metrics, reward  # noqa: E402
from interactive_nav.config import NavConfig  # noqa: E402
from interactive_nav.env import InteractiveNav  # noqa: E402
from interactive_nav.robots import get_robot, robot_names  # noqa: E402
from interactive_nav.scene import load_scene  # noqa: E402


def make(robot: str, scenes: Sequence[str | Path], **settings: Any) -> InteractiveNav:
    """Builds an environment.

    Args:
        robot: a name from `robot_names()`.
        scenes: scene folders; each episode draws one.
        **settings: fields of `NavConfig`, such as backend, num_objects, observations, k_int, episode_steps.

    Returns:
        A `brax.envs.Env` with pure `reset` and `step` for one environment; batch it with `jax.vmap`.

    Raises:
        ValueError: unknown robot or setting (the message names the nearest valid one), impossible value,
            or an unusable scene (`SceneError`).
    """
    fields = {f.name for f in dataclasses.fields(NavConfig)}
    for key in settings:
        if key not in fields:
            near = difflib.get_close_matches(key, fields, 1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise ValueError(f"unknown setting '{key}'; {hint}known settings: {', '.join(sorted(fields))}")
    if isinstance(scenes, (str, Path)):
        raise ValueError(f"scenes is {str(scenes)!r}, expected a list of scene folders; write [{str(scenes)!r}]")
    spec = get_robot(robot)
    config = NavConfig(**settings)
    return InteractiveNav(spec, tuple(load_scene(s) for s in scenes), config)


__all__ = [
    "InteractiveNav",
    "NavConfig",
    "geodesic",
    "get_robot",
    "load_scene",
    "make",
    "metrics",
    "reward",
    "robot_names",
]
