"""Build a batched Brax environment for interactive navigation on MuJoCo MJX from scene folders::

    env = interactive_nav.make("turtlebot", scenes=["scenes_mjcf/apartment_0"])
    state = jax.jit(jax.vmap(env.reset))(keys)
    state = jax.jit(jax.vmap(env.step))(state, action)

Importing the package is cheap: JAX and MuJoCo are imported with what is first used of it.
"""

import importlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from interactive_nav import mjx_without_warp
from interactive_nav_common.errors import ConfigError

# The scenes' tables are constants of `reset` and `step`, tens to hundreds of megabytes. Without this, JAX
# writes them as text into every program that it compiles (measured: 23 s instead of 8 s for a small room; 2.9 MB of
# text for each cluttered home instead of 0.4 MB for any number of them). It is to be JAX's default (jax issue 29679).
# JAX reads it once, when it is imported: import interactive_nav first, or set the variable yourself.
os.environ.setdefault("JAX_USE_SIMPLIFIED_JAXPR_CONSTANTS", "1")
# With one thread (one core) JAX's CPU client never ends a callback whose large argument it has yet to copy (a thousand
# environments of cluttered homes on native); XLA takes the number of its threads from here.
if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) == 1:
    os.environ.setdefault("NPROC", "2")
mjx_without_warp.hush()

if TYPE_CHECKING:
    from interactive_nav import geodesic, metrics, reward
    from interactive_nav.config import NavConfig
    from interactive_nav.robots import RobotSpec, get_robot, robot_names
    from interactive_nav.scenes.scene import load_scene
    from interactive_nav.task.env import InteractiveNav
    from interactive_nav.task.terms import Term
    from interactive_nav.task.wrappers import wrap_for_brax_training

_HOME = {
    "InteractiveNav": "task.env",
    "NavConfig": "config",
    "get_robot": "robots",
    "load_scene": "scenes.scene",
    "robot_names": "robots",
    "wrap_for_brax_training": "task.wrappers",
}
_MODULES = ("geodesic", "metrics", "reward")


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"interactive_nav.{name}")
    if name in _HOME:
        return getattr(importlib.import_module(f"interactive_nav.{_HOME[name]}"), name)
    raise AttributeError(f"module 'interactive_nav' has no attribute {name!r}; it has {', '.join(__all__)}")


def make(
    robot: "str | RobotSpec", scenes: Sequence[str | Path], terms: "Sequence[Term]" = (), **settings: Any
) -> "InteractiveNav":
    """Build a `brax.envs.Env` with pure `reset` and `step` for one environment; batch it with `jax.vmap`.

    Args:
        robot: what `get_robot` takes, or a spec that it returns.
        scenes: scene folders, or sets of them (`cluttered/train`); each episode draws one.
        terms: reward terms, metrics and observations to add (`interactive_nav.task.terms`).
        **settings: of `NavConfig`'s parts, such as backend, num_objects, observations, k_int, episode_steps; or
            `variant="code"` for the values of the original's code where it differs from its paper.

    Raises:
        ConfigError, FileError: as `get_robot`, or an unknown setting or impossible value.
        SceneError: an unusable scene.
    """
    from interactive_nav.config import make_config
    from interactive_nav.robots import RobotSpec, get_robot
    from interactive_nav.scenes.scene import load_scenes
    from interactive_nav.task.env import InteractiveNav
    from scenes_mjcf.sets import scene_folders

    if isinstance(scenes, (str, Path)):
        raise ConfigError(f"scenes is {str(scenes)!r}, expected a list of scene folders; write [{str(scenes)!r}]")
    config = make_config(**settings)
    spec = robot if isinstance(robot, RobotSpec) else get_robot(robot, config.control_mode)
    return InteractiveNav(spec, load_scenes(scene_folders(scenes)), config, terms)


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
    "wrap_for_brax_training",
]
