"""A new algorithm, added as docs/extend.md describes, trains, resumes, is exported and plays like the built-in ones."""

from __future__ import annotations

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from interactive_nav.task.rollout import episode_keys
from interactive_nav_common.runs.weights import read_weights
from tests.train.learners.td3 import ALGORITHM, TD3, TrainConfigWithTD3
from tests.train.learners.test_sac import KEY, transitions
from tests.train.toy_env import batched
from tests.train.toy_run import build_toy, toy_config
from train import config_io
from train.config import AUTO
from train.learners.algorithms import ALGORITHMS
from train.learners.learner import Snapshot
from train.runs import checkpoint
from train.runs.checkpoint import CheckpointError
from train.runs.run import train_run
from train.runs.run_folder import RunFolder
from train.scoring.evaluation import BatchPlayer, load_policy

WORDS = (
    *("algorithm=td3", "td3.num_envs=16", "td3.steps_per_update=8", "td3.grad_steps_per_update=4", "td3.batch_size=32"),
    *("td3.min_replay_size=256", "td3.max_replay_size=512", "td3.n_steps=2", "td3.learning_rate=1e-2"),
    *("td3.policy_hidden_layer_sizes=[16]", "td3.q_hidden_layer_sizes=[16]"),
)


@pytest.fixture
def added(monkeypatch):
    """What the steps of docs/extend.md change in the package."""
    monkeypatch.setattr(config_io, "TrainConfig", TrainConfigWithTD3)
    monkeypatch.setitem(AUTO, "td3", AUTO["sac"])
    monkeypatch.setitem(ALGORITHMS, "td3", ALGORITHM)


def config_of(out_dir, updates):
    run = dataclasses.replace(toy_config(out_dir).run, num_timesteps=128 * updates, log_every_steps=128)
    base = TrainConfigWithTD3(env=toy_config(out_dir).env, run=dataclasses.replace(run, checkpoint_every_steps=256))
    return config_io.apply_overrides(base, WORDS)


def test_every_algorithm_has_sizes_and_a_learner():
    assert set(AUTO) == set(ALGORITHMS) == {"ppo", "sac", "ddpg", "clone"}


def test_the_actor_is_delayed(added):
    config = config_of("unused", 1)
    agent = TD3.of(batched(), config)
    step = jax.jit(agent.gradient_step)
    learners = [agent.init(KEY, KEY)]
    for _ in range(2):
        learners.append(step(learners[-1], transitions(29), KEY)[0])
    kernels = [np.asarray(each.policy_params["params"]["hidden_0"]["kernel"]) for each in learners]
    np.testing.assert_array_equal(kernels[1], kernels[0])
    assert np.abs(kernels[2] - kernels[1]).max() == pytest.approx(1e-2, rel=1e-3)  # Adam's first step
    critics = [jax.tree.leaves(each.q_params)[0] for each in learners]
    assert all((new != old).any() for old, new in zip(critics, critics[1:], strict=False))


def test_it_trains_resumes_and_its_export_plays_the_same(added, tmp_path):
    quiet = Console(file=io.StringIO())
    for updates in (3, 6):  # the second continues the first
        result, folder, _ = train_run(config_of(tmp_path, updates), quiet, build_env=build_toy)
    config, env = folder.read_config(), build_toy(folder.read_config().env)
    assert result.completed and config.algorithm == "td3" and config.td3.n_steps == 2
    assert result.metrics["loss/gradient_steps"] == 4
    path, meta = checkpoint.find(folder.checkpoints, "last")
    template = ALGORITHMS["td3"].template(env, config)
    learner = checkpoint.load_learner(path, template)
    assert int(learner.gradient_steps) == 4 * 6 - 4  # the first update fills the replay
    # Exporting stores these small matrices in half precision: what is of half precision stays as it is.
    halves = jax.tree.map(lambda x: x.astype(jnp.float16).astype(x.dtype), learner.policy_params)
    whole = RunFolder(tmp_path / "whole")
    snapshot = Snapshot(meta.env_steps, learner.replace(policy_params=halves), None)
    path = checkpoint.save_snapshot(whole.checkpoints, snapshot, meta, 1, 0.0)
    exported = RunFolder(tmp_path / "exported")
    checkpoint.keep_policy(path, exported.checkpoints / path.name)
    tensors, _ = read_weights(exported.checkpoints / path.name / "policy.safetensors", CheckpointError, "")
    parts = {name.partition("/")[0] for name in tensors}
    assert parts == {"policy_params", "normalizer_params"}
    player, keys = BatchPlayer(env), episode_keys(3, 12)
    policies = [load_policy(run, config, env, "last", True, player.cached)[0] for run in (whole, exported, folder)]
    policies.append(jax.tree_util.Partial(policies[0].func, template))
    played = [player.play(policy, keys) for policy in policies]
    for name, scores in played[0].metrics.items():
        np.testing.assert_array_equal(played[1].metrics[name], scores)
        np.testing.assert_allclose(played[2].metrics[name], scores, atol=0.05)
    driven_m = played[0].metrics["robot_path_m"]
    assert np.isfinite(driven_m).all() and np.abs(played[3].metrics["robot_path_m"] - driven_m).max() > 0.1
