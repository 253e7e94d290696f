"""SAC against Brax's own arithmetic, by hand where hands reach, and on toys it must learn."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.training import gradients, types
from brax.training.agents.sac import losses as sac_losses

from tests.train.learners.test_ppo import Recorder
from tests.train.toy_env import ToyEnv, batched
from tests.train.toy_pixels import SMALL, ToyPixels
from train.config import EnvConfig, NetworkConfig, RunConfig, SACConfig, TrainConfig
from train.learners import networks
from train.learners.actor_critic import SAC, SACState
from train.learners.algorithms import ALGORITHMS

SIZES: dict[str, Any] = {"policy_hidden_layer_sizes": (16,), "q_hidden_layer_sizes": (16,)}
KEY = jax.random.PRNGKey(5)


def make(env: ToyEnv, network: NetworkConfig = SMALL, **settings: Any) -> SAC:
    section = SACConfig(**{**SIZES, **settings})
    config = TrainConfig(env=EnvConfig(scenes=("toy",)), algorithm="sac", network=network, sac=section)
    return SAC.of(batched(env), config)


def transitions(size: networks.ObservationSize, count: int = 12) -> types.Transition:
    """Made up, the fourth a failure, the eighth cut by the clock."""

    def draw(key: jax.Array, name: str, shape: tuple[int, ...]) -> Any:
        if name.startswith(networks.PIXELS):
            return jax.random.randint(key, (count, *shape), 0, 256).astype(jnp.uint8)
        return jax.random.normal(key, (count, *shape))

    keys = jax.random.split(jax.random.PRNGKey(1), 4)
    observation: Any
    following: Any
    if isinstance(size, int):
        observation, following = (draw(key, "", (size,)) for key in keys[:2])
    else:
        observation, following = ({n: draw(key, n, tuple(s)) for n, s in size.items()} for key in keys[:2])
    done = jnp.zeros(count).at[3].set(1.0).at[7].set(1.0)
    return types.Transition(  # type: ignore[call-arg]
        observation=observation,
        action=jax.random.uniform(keys[2], (count, 2), minval=-1.0),
        reward=jax.random.normal(keys[3], (count,)),
        discount=1.0 - done,
        next_observation=following,
        extras={"policy_extras": {}, "state_extras": {"truncation": jnp.zeros(count).at[7].set(1.0)}},  # type: ignore[arg-type]
    )


def learner_of(agent: SAC) -> SACState:
    """A new learner whose normaliser has seen something and whose targets lag."""
    learner = jax.jit(agent.init)(KEY, KEY)
    seen = jax.tree.map(lambda x: 3.0 * x + 1.0, networks.vector_part(transitions(agent.size).observation))
    lagging = jax.tree.map(lambda x: 0.5 * x, learner.q_params)
    return learner.replace(  # type: ignore[attr-defined]
        normalizer_params=networks.update_normalizer(learner.normalizer_params, seen), target_q_params=lagging
    )


def test_a_gradient_step_equals_that_of_brax():
    """Brax's losses, optimisers and keys, put together as its `sgd_step` does: the same parameters afterwards."""
    agent = make(
        ToyEnv(),
        target_entropy_per_action=-0.5,
        actor_learning_rate=1e-2,
        critic_learning_rate=1e-2,
        alpha_learning_rate=3e-4,
        discounting=0.9,
        reward_scaling=2.0,
    )
    start, data, tau = learner_of(agent), transitions(29), agent.config.tau
    ours, metrics = jax.jit(agent.gradient_step)(start, data, KEY)

    alpha_loss, critic_loss, actor_loss = sac_losses.make_losses(agent.networks, 2.0, 0.9, action_size=2)
    _, key_alpha, key_critic, key_actor = jax.random.split(KEY, 4)
    norm, alpha = start.normalizer_params, jnp.exp(start.alpha_params)

    def step(loss: Any, rate: float, state: Any, *arguments: Any) -> tuple[Any, Any, Any]:
        update = gradients.gradient_update_fn(loss, optax.adam(rate), pmap_axis_name=None)
        return jax.jit(update)(*arguments, optimizer_state=state)

    loss_alpha, log_alpha, _ = step(
        alpha_loss,
        3e-4,
        start.alpha_optimizer_state,
        start.alpha_params,
        start.policy_params,
        norm,
        data,
        key_alpha,
    )
    loss_q, q_params, q_state = step(
        critic_loss,
        1e-2,
        start.q_optimizer_state,
        start.q_params,
        start.policy_params,
        norm,
        start.target_q_params,
        alpha,
        data,
        key_critic,
    )
    loss_policy, policy_params, policy_state = step(
        actor_loss,
        1e-2,
        start.policy_optimizer_state,
        start.policy_params,
        norm,
        start.q_params,
        alpha,
        data,
        key_actor,
    )
    target = jax.tree.map(lambda x, y: x * (1 - tau) + y * tau, start.target_q_params, q_params)
    theirs = (policy_params, policy_state, q_params, q_state, target, log_alpha)
    mine = (
        ours.policy_params,
        ours.policy_optimizer_state,
        ours.q_params,
        ours.q_optimizer_state,
        ours.target_q_params,
        ours.alpha_params,
    )
    # Same arithmetic, compiled in other pieces; Adam's first step has the size of the learning rate, 1e-2.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-5), mine, theirs)
    told = [metrics[name] for name in ("alpha_loss", "critic_loss", "actor_loss", "alpha")]
    np.testing.assert_allclose(told, [loss_alpha, loss_q, loss_policy, jnp.exp(log_alpha)], rtol=1e-5)
    assert int(ours.gradient_steps) == 1


def test_target_entropy_is_what_is_asked_for():
    """The temperature's loss is alpha (-log pi - target): from -0.5 to -1 for each of two actions adds alpha * 1."""
    data, losses = transitions(29), []
    for each in (-0.5, -1.0):
        agent = make(ToyEnv(), target_entropy_per_action=each)
        alpha_loss, _, _ = agent.losses()
        learner = learner_of(agent)
        losses.append(alpha_loss(jnp.log(0.25), learner.policy_params, learner.normalizer_params, data, KEY))
    np.testing.assert_allclose(losses[1] - losses[0], 0.25, rtol=1e-4)


def test_a_step_cut_by_the_clock_teaches_the_critics_nothing():
    """Whatever reward and next observation step 7 shows, the critics move alike; of a plain step they would not."""
    agent = make(ToyEnv())
    learner, data = learner_of(agent), transitions(29)
    step = jax.jit(agent.gradient_step)
    usual, _ = step(learner, data, KEY)
    changed, other = (
        step(
            learner,
            data._replace(
                reward=data.reward.at[i].add(5.0),
                next_observation=data.next_observation.at[i].add(1.0),  # type: ignore[union-attr]
            ),
            KEY,
        )[0]
        for i in (7, 6)
    )
    jax.tree.map(np.testing.assert_array_equal, usual.q_params, changed.q_params)
    assert not all(jax.tree.leaves(jax.tree.map(np.array_equal, usual.q_params, other.q_params)))


def test_a_shared_encoder_is_moved_by_the_critics_alone():
    """The policy owns a head; its loss leaves the encoder alone, and the targets have an encoder of their own."""
    agent = make(ToyPixels(), dataclasses.replace(SMALL, share_encoder=True))
    learner, data = learner_of(agent), transitions(ToyPixels().observation_size)
    assert set(learner.policy_params) == {"head"} and set(learner.q_params) == {"encoder", "head"}
    step = jax.jit(agent.gradient_step)
    after, _ = step(learner, data, KEY)
    moved = jax.tree.map(
        lambda a, b: float(jnp.abs(a - b).max()), after.q_params["encoder"], learner.q_params["encoder"]
    )
    assert min(jax.tree.leaves(moved)) > 1e-5
    # Where every step is cut the critics learn nothing, and the policy's loss still moves its head.
    extras = {"policy_extras": {}, "state_extras": {"truncation": jnp.ones(12)}}
    still, _ = step(learner, data._replace(extras=extras), KEY)
    jax.tree.map(np.testing.assert_array_equal, still.q_params, learner.q_params)
    assert not all(jax.tree.leaves(jax.tree.map(np.array_equal, still.policy_params, learner.policy_params)))
    tau, lagging = agent.config.tau, learner.target_q_params["encoder"]
    expected = jax.tree.map(lambda x, y: (1 - tau) * x + tau * y, lagging, after.q_params["encoder"])
    target = after.target_q_params["encoder"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), target, expected)
    # And what acts is the head behind that encoder.
    whole = {**after.policy_params, "encoder": after.q_params["encoder"]}
    logits = agent.networks.policy_network.apply(after.normalizer_params, whole, data.observation)
    action, _ = agent.policy(after, deterministic=True)(data.observation, KEY)
    np.testing.assert_allclose(action, np.tanh(logits[:, :2]), atol=1e-5)


def test_critics_of_the_state_alone_see_no_image():
    agent = make(ToyPixels(), dataclasses.replace(SMALL, critic_inputs="state"))
    learner, data = learner_of(agent), transitions(ToyPixels().observation_size)
    assert "image" not in learner.q_params["encoder"]["params"]
    assert "image" in learner.policy_params["encoder"]["params"]
    observation: Any = data.observation
    black = {**observation, "pixels/depth": jnp.zeros_like(observation["pixels/depth"])}
    q = [
        agent.networks.q_network.apply(learner.normalizer_params, learner.q_params, seen, data.action)
        for seen in (observation, black)
    ]
    assert q[0].shape == (12, 2)
    np.testing.assert_array_equal(*q)


@pytest.mark.parametrize("env", [ToyEnv(), ToyPixels()], ids=["vector", "picture"])
def test_layer_normalisation_is_the_critics_alone(env):
    for wanted in (False, True):
        shapes: Any = jax.eval_shape(make(env, q_layer_norm=wanted).init, KEY, KEY)
        assert ("LayerNorm" in str(shapes.q_params)) == wanted
        assert "LayerNorm" not in str(shapes.policy_params)


def test_policy_and_template_are_those_of_the_config():
    config = TrainConfig(env=EnvConfig(scenes=("toy",)), algorithm="sac", sac=SACConfig(**SIZES, initial_alpha=0.25))
    env = batched()
    learner = ALGORITHMS["sac"].template(env, config)
    assert float(jnp.exp(learner.alpha_params)) == pytest.approx(0.25)
    observation = transitions(29).observation
    drawn = [
        ALGORITHMS["sac"].policy(env, config, learner, False)(observation, jax.random.PRNGKey(i))[0] for i in (0, 1)
    ]
    modes = [
        ALGORITHMS["sac"].policy(env, config, learner, True)(observation, jax.random.PRNGKey(i))[0] for i in (0, 1)
    ]
    assert drawn[0].shape == (12, 2) and not np.array_equal(drawn[0], drawn[1])
    np.testing.assert_array_equal(modes[0], modes[1])


LEARNING: dict[str, Any] = {
    "num_envs": 32,
    "steps_per_update": 4,
    "grad_steps_per_update": 8,
    "batch_size": 64,
    "min_replay_size": 1_024,
    "max_replay_size": 32_768,
    "n_steps": 3,
    "discounting": 0.97,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "policy_hidden_layer_sizes": (32,),
    "q_hidden_layer_sizes": (32,),
}

WIDER: dict[str, Any] = {"policy_hidden_layer_sizes": (64, 64), "q_hidden_layer_sizes": (64, 64)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "steps", "settings"),
    [
        (ToyEnv(), 8_192, {"grad_steps_per_update": 16, "initial_alpha": 0.05, **WIDER}),
        pytest.param(ToyPixels(), 12_288, {"initial_alpha": 0.01}, marks=pytest.mark.heavy),
    ],
    ids=["vector", "picture"],
)
def test_learns_the_toy(env, steps, settings):
    """From random (0.03 success) to at least 0.9 in so few steps; in pictures only the image shows the goal."""
    section = SACConfig(**{**LEARNING, "alpha_learning_rate": 1e-3, "tau": 0.02, **settings})
    config = TrainConfig(
        env=EnvConfig(scenes=("toy",)),
        algorithm="sac",
        network=SMALL,
        sac=section,
        run=RunConfig(num_timesteps=steps, log_every_steps=2_048, checkpoint_every_steps=steps),
    )
    seen = Recorder()
    result = ALGORITHMS["sac"].train(batched(env), config, seen)
    assert seen.logs[0][1]["episode/success"] < 0.3
    assert result.metrics["episode/success"] >= 0.9
    assert result.snapshot.env_steps == steps
