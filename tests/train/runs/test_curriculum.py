"""A curriculum, near goals first, by hand, in batches and over a resumed run; and episodes that are tried again."""

from __future__ import annotations

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import interactive_nav
from interactive_nav.task.curriculum import Curriculum
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.errors import ConfigError
from tests.train.toy_env import ToyEnv
from tests.train.toy_run import build_toy, toy_config
from train.config import RunConfig, resolve
from train.runs import checkpoint
from train.runs.run import train_run
from train.scoring.policies import make_follower

QUIET = Console(file=io.StringIO())


def after(course, done, success):
    return course.after(jnp.array(done, bool), jnp.array(success, jnp.float32))


def test_the_limit_grows_by_half_when_the_average_of_its_own_episodes_suffices():
    """Four environments, limits from 2 to 4 m, half must succeed."""
    start = jnp.full(4, 2.0)
    course = after(Curriculum(start, start, jnp.zeros(4), 4.0, 0.5), [1, 1, 0, 0], [1, 1, 0, 0])
    np.testing.assert_allclose(course.success, 1 - 0.75**2)
    assert course.limit_m.tolist() == [2.0] * 4
    course = after(course, [0, 0, 1, 0], [0, 0, 1, 0])  # 0.4375 + 0.25 * 0.5625 = 0.578
    assert course.limit_m.tolist() == [3.0] * 4 and course.success.tolist() == [0.0] * 4
    assert course.drawn_m.tolist() == [2.0, 2.0, 3.0, 2.0] and course.allowed_m.tolist() == [3.0] * 4
    course = after(course, [1, 1, 0, 1], [1, 1, 0, 1])  # drawn under the old limit: they do not count
    assert course.success.tolist() == [0.0] * 4 and course.drawn_m.tolist() == [3.0] * 4
    failed = after(course, [1, 1, 1, 1], [0, 0, 0, 0])
    assert failed.limit_m.tolist() == [3.0] * 4 and failed.success.tolist() == [0.0] * 4
    course = after(course, [1, 1, 1, 0], [1, 1, 1, 0])  # 1 - 0.75 ** 3 = 0.578; 4.5 is more than the last limit
    assert course.limit_m.tolist() == [4.0] * 4 and np.isinf(course.allowed_m).all()
    assert after(course, [1, 1, 1, 1], [1, 1, 1, 1]).limit_m.tolist() == [4.0] * 4


def played(policy, steps=400):
    """The batch after some steps, and the greatest distance of an episode's goal under each limit."""
    env = ToyEnv()
    batch = AutoResetEnv(env)
    batch.curriculum = (1.2, 2.4, 0.7)

    def step(state, key):
        new = batch.step(state, policy(env)(state.obs, key))
        return new, (new.info["curriculum"].drawn_m, jnp.linalg.norm(new.info["nav"].goal_xy_w, axis=-1))

    first = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), 16))
    last, seen = jax.jit(lambda s: jax.lax.scan(step, s, jax.random.split(jax.random.PRNGKey(1), steps)))(first)
    drawn_m, goal_m = map(np.asarray, seen)
    return last, {float(m): float(goal_m[drawn_m == m].max()) for m in np.unique(drawn_m)}


def test_the_limit_grows_with_success_and_stays_without():
    last, farthest_m = played(lambda env: jax.vmap(make_follower(env), (0, None)))
    np.testing.assert_allclose(list(farthest_m), [1.2, 1.8, 2.4], rtol=1e-6)
    limited, full = list(farthest_m.items())[:-1], farthest_m[max(farthest_m)]
    assert all(0.95 * limit < goal <= limit for limit, goal in limited) and full > 2.4  # the toy's farthest is 2.5 m
    assert float(last.info["episode_metrics"]["curriculum_m"].max()) == pytest.approx(2.4)
    last, farthest_m = played(lambda env: lambda obs, key: jnp.zeros((16, 2)) - 1.0)
    assert len(farthest_m) == 1 and float(last.info["curriculum"].limit_m[0]) == pytest.approx(1.2)
    assert float(last.info["curriculum"].success[0]) < 0.1


def test_without_a_curriculum_a_batch_is_what_it_was(room):
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=1, episode_steps=3)
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    state = jax.jit(AutoResetEnv(env).reset)(keys)
    assert "curriculum" not in state.info and "curriculum_m" not in state.info["episode_metrics"]
    plain = jax.jit(jax.vmap(env.reset))(keys)
    jax.tree.map(np.testing.assert_array_equal, (state.obs, state.info["nav"]), (plain.obs, plain.info["nav"]))


def limit_m(result) -> float:
    return float(result.snapshot.env_state.info["curriculum"].limit_m[0])


def with_course(config, course):
    return dataclasses.replace(config, run=dataclasses.replace(config.run, curriculum=course))


@pytest.mark.parametrize(("needed", "reached_m", "scored"), [(0.0, 2.0, True), (1.0, 1.2, False)])
def test_a_run_goes_on_from_its_limit_and_scores_checkpoints_of_all_distances_only(
    tmp_path, needed, reached_m, scored, monkeypatch
):
    config = with_course(toy_config(tmp_path, updates=8, env_state_limit_mb=0.0), (1.2, 2.0, needed))
    result, folder, _ = train_run(config, QUIET, build_env=build_toy)
    assert limit_m(result) == pytest.approx(reached_m)
    last = checkpoint.list_checkpoints(folder.checkpoints)[-1]
    assert last.curriculum_m == pytest.approx(reached_m) and (last.score is not None) == scored
    assert folder.read_metrics()[-1]["episode/curriculum_m"] == pytest.approx(reached_m, rel=0.2)
    # Nothing grows any more: what the run that goes on has, it has from the checkpoint.
    monkeypatch.setattr(Curriculum, "after", lambda self, done, success: self)
    longer = dataclasses.replace(config, run=dataclasses.replace(config.run, num_timesteps=10 * 256))
    result, _, _ = train_run(longer, QUIET, build_env=build_toy)
    assert result.snapshot.env_steps == 10 * 256
    assert limit_m(result) == pytest.approx(reached_m)


@pytest.mark.parametrize("course", [(0.9, 3.0, 0.8), (3.0, 2.0, 0.8)])
def test_a_curriculum_that_cannot_be_is_refused(tmp_path, course):
    config = with_course(toy_config(tmp_path), course)
    with pytest.raises(ConfigError, match=r"run.curriculum is \(.*rising distances above .*distance_m \(1.0\)"):
        resolve(config, "native")
    with pytest.raises(ConfigError, match="run.devices=1"):
        resolve(dataclasses.replace(config, run=RunConfig(curriculum=(2.0, 3.0, 0.8), devices=2)), "native")
