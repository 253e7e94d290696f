"""PPO with a critic that sees the true state: the actor does not, and plays and is exported without it."""

from __future__ import annotations

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from interactive_nav.task.privileged import PRIVILEGED, PrivilegedEnv
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.errors import ConfigError
from tests.train.toy_env import ToyEnv
from tests.train.toy_pixels import SMALL, ToyPixels
from tests.train.toy_run import build_toy, toy_config
from train import evaluate, export
from train.config import NetworkConfig, SACConfig, validate
from train.learners import ppo
from train.runs.run import train_run

VECTOR = NetworkConfig(critic_inputs="privileged")
PICTURES = dataclasses.replace(SMALL, critic_inputs="privileged")
MEMORY = dataclasses.replace(VECTOR, memory="gru", memory_size=8)


@pytest.mark.parametrize(("make_env", "network"), [(ToyEnv, VECTOR), (ToyPixels, PICTURES)], ids=["vector", "images"])
def test_the_true_state_moves_the_critic_and_never_the_actor(make_env, network):
    env = make_env()
    config = dataclasses.replace(toy_config("unused"), network=network)
    parts = ppo.make_agent(env, config)
    state = ppo.start(parts, AutoResetEnv(PrivilegedEnv(env)), 0)
    assert state.env_state is not None
    learner, seen = state.learner, state.env_state.obs
    other = {**seen, PRIVILEGED: seen[PRIVILEGED] + 1.0}
    of_policy, of_value = ppo.whole_params(learner.params)

    def logits(observation):
        return parts.nets.policy_network.apply(learner.normalizer_params, of_policy, observation)

    def value(observation):
        return parts.nets.value_network.apply(learner.normalizer_params, of_value, observation)

    bare = {name: x for name, x in seen.items() if name != PRIVILEGED}
    bare = bare["state"] if make_env is ToyEnv else bare
    np.testing.assert_array_equal(logits(other), logits(seen))
    np.testing.assert_array_equal(logits(bare), logits(seen))
    assert (jnp.abs(value(other) - value(seen)) > 1e-6).all()
    known = seen["state"] + 1.0
    assert (jnp.abs(value({**seen, "state": known}) - value(seen)) > 1e-6).all()  # and it sees the vector, too
    if make_env is ToyPixels:
        dark = {**seen, "pixels/depth": jnp.zeros_like(seen["pixels/depth"])}
        np.testing.assert_array_equal(value(dark), value(seen))
        assert (logits(dark) != logits(seen)).any()


def test_the_same_policy_starts_with_either_critic():
    first = [
        ppo.make_agent(ToyEnv(), dataclasses.replace(toy_config("unused"), network=network)).init(
            jax.random.PRNGKey(3), jax.random.PRNGKey(4)
        )
        for network in (NetworkConfig(), VECTOR)
    ]
    policies = [(learner.params.policy, learner.normalizer_params) for learner in first]
    jax.tree.map(np.testing.assert_array_equal, *policies)


@pytest.mark.parametrize("network", [VECTOR, pytest.param(MEMORY, marks=pytest.mark.heavy)], ids=["vector", "memory"])
def test_a_run_learns_values_and_plays_without_the_true_state(network, tmp_path):
    config = dataclasses.replace(toy_config(tmp_path, updates=6), network=network)
    result, folder, _ = train_run(config, Console(file=io.StringIO()), build_env=build_toy)
    assert result.completed and np.isfinite(result.metrics["loss/v_loss"])
    words = ["--policies", "learned", "--episodes", "4", "--seed", "8"]
    assert evaluate.main([str(folder.path), *words], build_env=build_toy) == 0
    if network is VECTOR:
        out = tmp_path / "policy.onnx"
        assert export.main([str(folder.path), "-o", str(out)], build_env=build_toy) == 0 and out.stat().st_size > 1000


def test_other_learners_refuse_it():
    config = dataclasses.replace(toy_config("unused"), algorithm="sac", ppo=type(toy_config("unused").ppo)())
    with pytest.raises(ConfigError, match="critic_inputs is 'privileged' with algorithm sac, expected algorithm ppo"):
        validate(dataclasses.replace(config, sac=SACConfig(), network=VECTOR))
