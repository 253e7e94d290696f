"""Product code under JAX's own checks: no array that silently gains an axis, no NaN, no tracer that outlives its trace.

The first holds in the whole suite (`tests/conftest.py`); the others cost time, so a few programs stand for the rest.
"""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav import metrics, reward
from interactive_nav.navigation.lookup import geodesic_at, goal_field, waypoints_at
from interactive_nav.task.wrappers import AutoResetEnv
from tests.train.learners.test_offpolicy import tiny
from tests.train.learners.test_ppo import make_config
from tests.train.toy_env import batched
from train.learners.algorithms import ALGORITHMS

PROMOTES = "import jax.numpy as jnp; jnp.zeros((2, 3)) + jnp.zeros(3)"


HASTE = {"xla_backend_optimization_level": 0}
"""Programs that run once."""


def checked(program: Callable[..., Any]) -> Callable[..., Any]:
    """The program compiled; a tracer that outlives its trace raises, and NaN in what it returns."""
    compiled = jax.jit(program, compiler_options=HASTE)

    def run(*args: Any) -> Any:
        with jax.checking_leaks():
            compiled.trace(*args)
        with jax.debug_nans(True):
            return compiled(*args)

    return run


@pytest.fixture(scope="module")
def env(room):
    return interactive_nav.make("turtlebot", [room], backend="native", num_objects=2, episode_steps=1)


def test_an_array_that_gains_an_axis_is_refused():
    with pytest.raises(ValueError, match="jax_numpy_rank_promotion='raise'"):
        jnp.add(jnp.zeros((2, 3)), jnp.zeros(3))
    started = subprocess.run([sys.executable, "-c", PROMOTES], capture_output=True, text=True)
    assert started.returncode == 1 and "jax_numpy_rank_promotion='raise'" in started.stderr


def test_programs_that_tests_start_compile_as_the_tests_do():
    """Who sets XLA's flags adds to those of `tests/conftest.py`: other flags give other last digits."""
    texts = {path.name: path.read_text("utf-8") for path in Path(__file__).parent.rglob("*.py")}
    sets = {name for name, text in texts.items() if '"XLA_FLAGS":' in text}
    assert {"test_sharding.py", "test_brax_compat.py"} <= sets
    assert [name for name in sets if "environ['XLA_FLAGS']}" not in texts[name]] == []


def test_a_nan_and_a_leaked_tracer_are_refused():
    kept = []

    def progress_of(before_m, after_m):
        return reward.interactive_navigation_reward(0.0, before_m, after_m, 0.0, 0.1)[1]["potential"]

    def keeps(before_m, after_m):
        kept.append(before_m)
        return progress_of(before_m, after_m)

    progress = checked(progress_of)
    assert progress(np.float32(2.0), np.float32(1.0)) == 1.0
    with pytest.raises(FloatingPointError, match="nan"):
        progress(np.float32(np.inf), np.float32(np.inf))
    with pytest.raises(Exception, match="Leaked"):
        checked(keeps)(2.0, 1.0)


def test_rewards_and_scores():
    """Episodes that moved, that stood still and that were never begun, as NumPy has them."""
    success, shortest_m, path_m = np.array([1.0, 1.0, 0.0]), np.array([2.0, 0.0, 3.0]), np.array([2.5, 0.0, 0.0])
    masses_kg, paths_m = np.full((3, 2), 5.0), np.array([[2.5, 0.5], [0.0, 0.0], [0.0, 0.0]])
    forces_n, steps = np.array([[3.0], [0.0], [0.0]]), np.array([10, 1, 0])

    def scores(success, shortest_m, path_m, masses_kg, paths_m, forces_n, steps):
        p_eff = metrics.path_efficiency(success, shortest_m, path_m)
        e_eff = metrics.effort_efficiency(masses_kg, paths_m, forces_n, steps)
        total, _ = reward.interactive_navigation_reward(success, path_m, shortest_m, forces_n[..., 0] > 0, 0.1)
        return p_eff, e_eff, metrics.interactive_navigation_score(p_eff, e_eff, 0.5), total

    episodes = (success, shortest_m, path_m, masses_kg, paths_m, forces_n, steps)
    for got, want in zip(checked(scores)(*episodes), scores(*episodes), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-6)


def test_ways(env):
    """A way across an empty part of the room is straight, at the goal too, where its length is 0."""
    start, goal = jnp.array([-1.5, -1.0]), jnp.array([1.5, -1.0])

    def seen(xy):
        scene = jnp.zeros((), jnp.int32)
        field = goal_field(env.tables, scene, goal)
        return geodesic_at(env.tables, scene, field, xy), waypoints_at(env.tables, scene, field, xy, 4, 0.2)

    places = jnp.stack([start, goal])
    (far_m, near_m), waypoints = checked(jax.vmap(seen))(places)
    np.testing.assert_allclose([far_m, near_m], [3.0, 0.0], atol=0.01)
    np.testing.assert_allclose(waypoints[0], [[-1.3, -1.0], [-1.1, -1.0], [-0.9, -1.0], [-0.7, -1.0]], atol=1e-5)
    np.testing.assert_allclose(waypoints[1], [goal] * 4, atol=1e-5)


def test_an_environment_and_its_new_episodes(env):
    auto = AutoResetEnv(env)
    keys, action = jax.random.split(jax.random.PRNGKey(0), 2), jnp.full((2, 2), 0.5)
    begun = jax.jit(auto.reset, compiler_options=HASTE)(keys)
    state = checked(auto.step)(begun, action)
    np.testing.assert_array_equal(state.info["episode_done"], 1.0)
    assert (state.info["nav"].goal_xy_w != begun.info["nav"].goal_xy_w).all()
    assert np.isfinite(state.obs).all()


@pytest.mark.parametrize("algorithm", ["ppo", *(pytest.param(a, marks=pytest.mark.heavy) for a in ("sac", "ddpg"))])
def test_an_update_of_a_learner(algorithm):
    env = batched()
    config = make_config(1) if algorithm == "ppo" else tiny(algorithm, 1, min_replay_size=1)
    learned = ALGORITHMS[algorithm]
    agent = learned.make_agent(env, config)
    start, update = functools.partial(learned.start, agent, env, 0), functools.partial(learned.update, agent, env)

    def begun():
        begin = start()
        return begin.learner, begin.env_state

    begin = jax.jit(begun, compiler_options=HASTE)()
    learner, _, seen = checked(update)(*begin)
    assert bool(seen.finite) and all(np.isfinite(x).all() for x in jax.tree.leaves(learner))
    assert seen.losses.get("gradient_steps", 2.0) == 2.0
