"""Teachers: a student that drives itself learns what to do in states that the teacher never visits."""

from __future__ import annotations

import dataclasses
import functools
import io
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import interactive_nav
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.errors import ConfigError
from tests.train.toy_env import ToyEnv
from tests.train.toy_pixels import SMALL, ToyPixels
from tests.train.toy_run import build_toy, toy_config
from train.config import CloneConfig, NetworkConfig, PPOConfig, RunConfig, SACConfig
from train.learners.algorithms import ALGORITHMS
from train.learners.clone import CloneData
from train.runs import run
from train.scoring.evaluation import load_policy
from train.scoring.policies import Planner, make_follower
from train.scoring.teacher import TaughtEnv

SIZES = {"num_envs": 16, "unroll_length": 16, "grad_steps_per_update": 50, "batch_size": 128}
QUIET = Console(file=io.StringIO())


def taught(out_dir, name, **clone):
    config = toy_config(out_dir)
    settings = CloneConfig(**{**SIZES, "policy_hidden_layer_sizes": (32, 32), "buffer_steps": 4096, **clone})
    length = RunConfig(out_dir=str(out_dir), name=name, num_timesteps=16 * 256, log_every_steps=1024)
    return dataclasses.replace(config, algorithm="clone", ppo=PPOConfig(), clone=settings, run=length)


def build_either(config):
    return (ToyPixels if "depth" in config.observations else ToyEnv)(build_toy(config).config)


def train_taught(config, build_env=build_toy):
    build = functools.partial(TaughtEnv, config.clone.teacher, build_env=build_env)
    return run.train_run(config, QUIET, build_env=build)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two students of the follower: `watched` saw its drives only, `dagger` drove itself."""
    out = tmp_path_factory.mktemp("taught")
    configs = [taught(out, n, teacher="follower", student_share=s) for n, s in (("watched", 0.0), ("dagger", 1.0))]
    return {c.run.name: (c, *train_taught(c)[:2]) for c in configs}


@pytest.mark.heavy
def test_a_student_that_drives_agrees_with_the_teacher_where_the_other_never_was(runs):
    """States of a random driver: it turns away from the goal, which the follower never does."""
    env = ToyEnv()
    batch, key = AutoResetEnv(env), jax.random.PRNGKey(5)

    def step(state, key):
        new = batch.step(state, jax.random.uniform(key, (64, 2), minval=-1.0, maxval=1.0))
        return new, state.obs

    _, seen = jax.lax.scan(step, batch.reset(jax.random.split(key, 64)), jax.random.split(key, 40))
    seen = seen.reshape(-1, 29)
    teacher = jax.vmap(make_follower(env), (0, None))(seen, key)
    error = {}
    for name, (config, result, _) in runs.items():
        policy = ALGORITHMS["clone"].policy(env, config, result.snapshot.learner, True)
        error[name] = float(((policy(seen, key)[0] - teacher) ** 2).mean())
    assert error["dagger"] < 0.5 * error["watched"], error
    assert error["dagger"] < 0.2 * float(np.var(teacher)), error


@pytest.mark.heavy
def test_a_run_with_a_privileged_critic_teaches_a_student_that_sees_images(tmp_path):
    start = toy_config(tmp_path, updates=1)
    start = dataclasses.replace(start, network=NetworkConfig(critic_inputs="privileged"))
    _, folder, _ = run.train_run(start, QUIET, build_env=build_toy)
    config = taught(tmp_path, "pixels", teacher=str(folder.path), buffer_steps=512)
    seen = dataclasses.replace(config.env, observations=("velocity", "depth", "segmentation"))
    length = dataclasses.replace(config.run, num_timesteps=3 * 256)
    config = dataclasses.replace(config, env=seen, network=SMALL, run=length)
    result, _, _ = train_taught(config, build_either)
    data: Any = result.snapshot.env_state
    assert int(data.taken) == 3 * 256 and len(data.action) == 512  # the oldest of 768 are gone
    env = TaughtEnv(str(folder.path), config.env, build_either)
    state = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(1), 5))
    policy, _ = load_policy(folder, folder.read_config(), ToyEnv(), "best", True)
    vector = jax.vmap(ToyEnv().observe)(state).obs
    expected = jax.vmap(policy, (0, None))(vector, jax.random.PRNGKey(3))
    assert float(jnp.ptp(expected, 0).min()) > 0.001  # labels depend on the state
    np.testing.assert_allclose(env.teach(state, jax.random.PRNGKey(2)), expected, atol=1e-6)
    led = dataclasses.replace(config.env, waypoints_round=True, potential_round=1.0)
    with pytest.raises(ConfigError, match="clone.teacher: env.waypoints_round is True, expected False, as in .*toy;"):
        TaughtEnv(str(folder.path), led, build_either)
    far = dataclasses.replace(config.env, waypoint_spacing_m=0.4)
    with pytest.raises(ConfigError, match="clone.teacher: env.waypoint_spacing_m is 0.4, expected 0.2, as in .*toy;"):
        TaughtEnv(str(folder.path), far, build_either)


def test_reinforcement_goes_on_from_a_clone_with_another_critic(runs, tmp_path):
    _, cloned, folder = runs["dagger"]
    config = toy_config(tmp_path, updates=1, init=str(folder.path))
    ppo = dataclasses.replace(config.ppo, policy_hidden_layer_sizes=(32, 32), learning_rate=1e-12)
    network = dataclasses.replace(config.network, critic_inputs="privileged")
    config = dataclasses.replace(config, ppo=ppo, network=network)
    result, _, _ = run.train_run(config, QUIET, build_env=build_toy)
    learner, old = result.snapshot.learner, cloned.snapshot.learner
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), learner.params.policy, old.params.policy)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"ppo": PPOConfig(policy_hidden_layer_sizes=(16,))},
            r"ppo.policy_hidden_layer_sizes is \(16,\), expected \(32, 32\), as in .*dagger; set it so",
        ),
        (
            {"ppo": PPOConfig(policy_hidden_layer_sizes=(32, 32), normalize_observations=False)},
            "ppo.normalize_observations is False, expected True",
        ),
        (
            {"ppo": PPOConfig(policy_hidden_layer_sizes=(32, 32)), "network": NetworkConfig(memory="gru")},
            "network.memory is 'gru', expected 'none'",
        ),
        (
            {"algorithm": "sac", "sac": SACConfig(min_replay_size=128)},
            "algorithm is sac, and that of .*dagger clone, expected ppo or clone for both; leave it out",
        ),
    ],
)
def test_a_policy_of_another_network_is_refused_in_one_line(runs, tmp_path, changes, message):
    folder = runs["dagger"][2]
    start = dataclasses.replace(toy_config(tmp_path / "runs", init=str(folder.path)), ppo=PPOConfig())
    with pytest.raises(ConfigError, match=f"^run.init: {message}[^\n]*$"):
        run.train_run(dataclasses.replace(start, **changes), QUIET, build_env=build_toy)
    assert not (tmp_path / "runs").exists()  # the corrected command begins with nothing in its way


def test_the_newest_rows_replace_the_oldest():
    data = CloneData(None, jnp.zeros((4, 1)), jnp.zeros((4, 2)), jnp.int32(0))

    def rows(*values):
        return jnp.array(values)[:, None], jnp.stack([jnp.array(values)] * 2, 1)

    data = data.keep(rows(1.0, 2.0, 3.0))
    assert data.observation[:, 0].tolist() == [1, 2, 3, 0] and int(data.taken) == 3
    data = data.keep(rows(4.0, 5.0))
    assert data.observation[:, 0].tolist() == [5, 2, 3, 4] and data.action[:, 1].tolist() == [5, 2, 3, 4]
    data = data.keep(rows(6.0, 7.0, 8.0, 9.0, 10.0))  # more than there is room for
    assert sorted(data.observation[:, 0].tolist()) == [7, 8, 9, 10]


def test_a_planner_labels_the_students_states(room, tmp_path):
    config = taught(tmp_path, "namo", teacher="namo:1", num_envs=2, unroll_length=4, grad_steps_per_update=2)
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=1, episode_steps=60)
    given = TaughtEnv("namo:1", config.env, lambda _: env)
    state = jax.jit(AutoResetEnv(given).reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    label = jax.jit(given.teach)(state, jax.random.PRNGKey(0))
    expected = Planner(env, 1.0).act(state, np.arange(2), np.ones(2, bool), 0)
    np.testing.assert_allclose(label, expected, atol=1e-6)
    here = dataclasses.replace(config.env, scenes=(str(room),), num_objects=1)
    short = dataclasses.replace(config.run, num_timesteps=24, log_every_steps=24, checkpoint_every_steps=24)
    result, _, _ = train_taught(dataclasses.replace(config, env=here, run=short), run.build_env)
    data: Any = result.snapshot.env_state
    assert int(data.taken) == 24 and np.abs(data.action[:24]).max() > 0.01 and not data.action[24:].any()


def test_settings_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="student_share is 0.5, which changes nothing here: expected a teacher"):
        CloneConfig(student_share=0.5)
    with pytest.raises(
        ConfigError, match="demonstrations is 'a.parquet', which changes nothing here: expected no teach"
    ):
        CloneConfig(teacher="follower", demonstrations="a.parquet")
    with pytest.raises(ConfigError, match="or set clone.teacher"):
        run.train_run(taught(tmp_path / "runs", "b", buffer_steps=100_000), QUIET, build_env=build_toy)
    with pytest.raises(ConfigError, match="clone.teacher is 'nobody', expected avoider, namo:W, follower, or a run"):
        train_taught(taught(tmp_path / "runs", "c", teacher="nobody"))
    assert not (tmp_path / "runs").exists()
