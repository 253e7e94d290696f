"""Let a teacher, a planner or another run's policy, label the states that a student visits (`clone.teacher`)."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from brax.envs.base import Wrapper
from jax.experimental import io_callback

from interactive_nav.config import SensorConfig
from interactive_nav_common.errors import ConfigError
from train.config import EnvConfig
from train.learners.memory import RecurrentPolicy, lost
from train.runs.run import build_env, check_alike
from train.runs.run_folder import RunFolder
from train.scoring.evaluation import load_policy
from train.scoring.policies import Planner, make_baseline

Teach = Callable[[Any, jax.Array], jax.Array]
"""(states of N environments, key) -> actions [N, A] in [-1, 1]; planners run on the host, so they are not pure."""


class TaughtEnv(Wrapper):
    """One environment with `teach`, which returns what the teacher would do in its states."""

    def __init__(self, teacher: str, config: EnvConfig, build_env: Callable[[EnvConfig], Any] = build_env):
        """Build an environment and its teacher: a planner or baseline by name, or a run folder."""
        super().__init__(build_env(config))
        if teacher in ("avoider", "follower") or teacher.startswith("namo:"):
            policy = make_baseline(teacher, self.env)
            self.teach: Teach = _on_host(policy, self.env) if isinstance(policy, Planner) else _batched(policy)
        elif Path(teacher).is_dir():
            self.teach = _of_run(RunFolder(Path(teacher)), config, self.env, build_env)
        else:
            raise ConfigError(f"clone.teacher is {teacher!r}, expected avoider, namo:W, follower, or a run folder")


def _batched(policy: Any, see: Callable[[Any], Any] = lambda state: state.obs) -> Teach:
    def teach(state: Any, key: jax.Array) -> jax.Array:
        keys = jax.random.split(key, state.done.shape[0])
        return jax.vmap(lambda state, key: policy(see(state), key))(state, keys)

    return teach


def _of_run(folder: RunFolder, config: EnvConfig, env: Any, build_env: Callable[[EnvConfig], Any]) -> Teach:
    """Return a run's best policy, which observes the student's world with its own sensors, without delay."""
    run = folder.read_config()
    sensors = {field.name: getattr(run.env, field.name) for field in dataclasses.fields(SensorConfig)}
    world = dataclasses.replace(config, **sensors, random_sensor_delay_steps=(0, 0))
    of_waypoints = ["env.num_waypoints", "env.waypoint_spacing_m", "env.waypoint_style", "env.waypoints_round"]
    of_waypoints += ["env.potential_round"] if run.env.waypoints_round else []
    run = dataclasses.replace(run, env=world)
    check_alike("clone.teacher", folder, run, [(name, name) for name in of_waypoints])
    seen = build_env(world)
    policy, _ = load_policy(folder, run, seen, "best", deterministic=True)
    if isinstance(policy, RecurrentPolicy):
        raise lost("a teacher")
    kept, read = ({term.key for term in getattr(each, "terms", ()) if term.start} for each in (env, seen))
    if lacking := ", ".join(sorted(read - kept)):
        got = f"clone.teacher: {folder.path} observes {lacking}, which the student's environment does not remember"
        raise ConfigError(f"{got}, expected it among env.observations; add it, or choose another teacher")
    return _batched(policy, lambda state: seen.observe(state).obs)


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
