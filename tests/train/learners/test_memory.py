"""Memory in PPO, and run folders in SAC: a goal shown once, replayed sequences, resets, checkpoints, evaluation."""

from __future__ import annotations

import dataclasses
import io
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Env, State
from rich.console import Console

from interactive_nav.task.rollout import episode_keys, policy_key_of
from interactive_nav_common.errors import ConfigError
from tests.train.learners.test_ppo import Recorder, copy_snapshot
from tests.train.toy_env import ToyConfig, ToyEnv, batched
from tests.train.toy_pixels import SMALL, ToyPixels
from tests.train.toy_run import build_toy, toy_config
from train import export
from train.config import EnvConfig, NetworkConfig, PPOConfig, RunConfig, SACConfig, TrainConfig, resolve
from train.learners import memory, ppo
from train.learners.algorithms import ALGORITHMS
from train.runs import checkpoint
from train.runs.run import train_run
from train.scoring.evaluation import BatchPlayer, load_policy

GRU = NetworkConfig(memory="gru", memory_size=16, state_features=16)
STEPS = 9


class SignEnv(Env):
    """Shows a sign in an episode's first step, and pays 1 in each of the eight later steps whose action has it.

    A batch that resets itself, without physics. The environments' first episodes start at different steps.
    """

    observation_size, action_size, backend = 2, 1, "native"  # type: ignore[assignment]

    def observe(self, state: State) -> State:
        first = (state.info["step"] == 0).astype(jnp.float32)
        return state.replace(obs=jnp.stack([first * state.info["sign"], first], -1))  # type: ignore[attr-defined]

    def reset(self, rng: jax.Array) -> State:
        zero = jnp.zeros(len(rng))
        step = jnp.arange(len(rng)) % STEPS * 1.0
        info: dict[str, Any] = {"rng": rng, "step": step, "sign": self.draw(rng), "truncation": zero, "matched": zero}
        info |= {"episode_done": zero, "episode_metrics": {"matched": zero}}
        return self.observe(State(None, jnp.zeros((len(rng), 2)), zero, zero, {}, info))

    @staticmethod
    def draw(keys: jax.Array) -> jax.Array:
        return jax.vmap(lambda key: jnp.where(jax.random.bernoulli(key), 1.0, -1.0))(keys)

    def step(self, state: State, action: jax.Array) -> State:
        info = state.info
        reward = ((action[:, 0] * info["sign"] > 0) & (info["step"] > 0)).astype(jnp.float32)
        step, matched = info["step"] + 1, info["matched"] + reward
        done = (step == STEPS).astype(jnp.float32)
        keys = jax.vmap(lambda key: jax.random.split(key)[0])(info["rng"])
        info = info | {
            "rng": keys,
            "step": jnp.where(done > 0, 0.0, step),
            "sign": jnp.where(done > 0, self.draw(keys), info["sign"]),
            "matched": jnp.where(done > 0, 0.0, matched),
            "episode_done": done,
            "episode_metrics": {"matched": matched / (STEPS - 1)},
        }
        return self.observe(state.replace(reward=reward, done=done, info=info))  # type: ignore[attr-defined]


def sign_config(network: NetworkConfig, updates: int) -> TrainConfig:
    """Sequences of 12 steps, so that most begin within an episode of nine."""
    settings = PPOConfig(
        num_envs=64,
        unroll_length=12,
        batch_size=64,
        num_minibatches=2,
        learning_rate=3e-3,
        policy_hidden_layer_sizes=(16,),
        value_hidden_layer_sizes=(16,),
    )
    steps = 64 * 2 * 12
    run = RunConfig(num_timesteps=updates * steps, log_every_steps=5 * steps, checkpoint_every_steps=10 * steps)
    return TrainConfig(env=EnvConfig(scenes=("toy",)), network=network, ppo=settings, run=run)


def test_a_goal_that_is_shown_once_takes_memory():
    """Share of later steps that match, of four seeds: 0.99 with memory, 0.48 to 0.51 (chance) without."""
    seen = [
        ALGORITHMS["ppo"].train(SignEnv(), sign_config(network, 30), Recorder()).metrics["episode/matched"]
        for network in (GRU, NetworkConfig())
    ]
    assert seen[0] > 0.9
    assert 0.44 < seen[1] < 0.56


@pytest.fixture(scope="module", params=["vector", "shared", "images"])
def collected(request) -> Any:
    """Parts, first learner, environments after two updates' steps, and the second's sequences."""
    env: Any = batched(ToyPixels(ToyConfig(episode_steps=8))) if request.param == "images" else SignEnv()
    network = GRU
    if request.param == "images":
        network = dataclasses.replace(SMALL, memory="gru", memory_size=16)
    network = dataclasses.replace(network, share_encoder=request.param == "shared")
    parts = ppo.make_agent(env, sign_config(network, 1))
    start = ppo.start(parts, env, seed=0)
    collect = jax.jit(lambda e, key: ppo.collect(parts, env, start.learner, e, key))
    env_state, _, _ = collect(start.env_state, jax.random.PRNGKey(1))
    env_state, data, _ = collect(env_state, jax.random.PRNGKey(2))
    return parts, start.learner, env_state, data


def test_replayed_sequences_have_the_log_probabilities_of_the_rollout(collected):
    """Before any gradient step the probability ratio is 1 throughout; without the first memory, or resets, it is not.

    Of 128 sequences of 12 steps each crosses an episode's end, and most start within an episode.
    """
    parts, learner, _, data = collected
    whole = ppo.whole_params(learner.params)
    networks = (parts.nets.policy_network, parts.nets.value_network)
    normalizer, distribution = learner.normalizer_params, parts.nets.parametric_action_distribution

    def log_probs(data: Any) -> np.ndarray:
        def encoded(observation: Any) -> list[jax.Array]:
            each = zip(networks, whole, data.extras["memory"], strict=False)
            return [network.encoder.apply(normalizer, params["encoder"], observation) for network, params, _ in each]

        data = data._replace(observation=encoded(data.observation), next_observation=encoded(data.next_observation))
        replayed = memory.replay(networks, whole, data)
        logits = networks[0].head.apply(None, whole[0]["head"], replayed.observation[0])
        return np.asarray(distribution.log_prob(logits, data.extras["policy_extras"]["raw_action"]))

    expected = np.asarray(data.extras["policy_extras"]["log_prob"])
    np.testing.assert_allclose(log_probs(data), expected, atol=1e-5)
    forgotten = {**data.extras, "memory": jax.tree.map(jnp.zeros_like, data.extras["memory"])}
    assert np.abs(log_probs(data._replace(extras=forgotten)) - expected).max() > 1e-3
    assert (np.asarray(data.discount) == 0).any(1).all()
    assert np.abs(log_probs(data._replace(discount=jnp.ones_like(data.discount))) - expected).max() > 1e-3


def test_memory_after_a_reset_is_that_of_a_new_episode(collected):
    parts, learner, env_state, data = collected
    fresh = parts.first_memory()
    assert len(fresh) == len(env_state.info["policy"]) == (1 if parts.shared else 2)
    # Zero in those environments whose episode ended in the last step, and only there.
    over = np.asarray(env_state.done) > 0
    assert over.any()  # with images all of them: their episodes start and end together
    for kept, first in zip(env_state.info["policy"], fresh, strict=True):
        np.testing.assert_array_equal(np.asarray(kept)[over], np.asarray(first)[over])
        assert np.abs(np.asarray(kept)[~over]).max(-1).min(initial=1.0) > 0
    blank = memory.forget([jnp.ones((2, 3))], jnp.array([True, False]))
    np.testing.assert_array_equal(blank[0], [[0.0] * 3, [1.0] * 3])
    assert parts.groups == 1 and data.extras["memory"][0].shape == (128, 1, 16)


def test_a_loss_through_sequences_trains_every_layer(collected):
    """Gradients reach encoder, memory and head of actor and critic."""
    parts, learner, _, data = collected
    _, params, losses = jax.jit(lambda s, d: ppo.learn(parts, s, d, s.normalizer_params, jax.random.PRNGKey(3)))(
        learner, data
    )
    assert all(np.isfinite(loss).all() for loss in losses.values())
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), params, learner.params)
    assert min(jax.tree.leaves(moved)) > 0


def test_resumed_run_equals_uninterrupted_one():
    """Twenty updates, against ten more from the snapshot after ten: the same numbers to the last bit."""
    config, recorder = sign_config(GRU, 20), Recorder()
    whole = ALGORITHMS["ppo"].train(SignEnv(), config, recorder).snapshot
    half = recorder.saved[0]
    assert half.env_steps == whole.env_steps // 2
    assert np.abs(np.asarray(half.env_state.info["policy"][0])).max() > 0
    resumed = ALGORITHMS["ppo"].train(SignEnv(), config, Recorder(copy_snapshot(half))).snapshot
    jax.tree.map(np.testing.assert_array_equal, whole.learner, resumed.learner)
    jax.tree.map(np.testing.assert_array_equal, whole.env_state, resumed.env_state)
    without = dataclasses.replace(copy_snapshot(half), env_state=None)
    begun: Any = ALGORITHMS["ppo"].train(SignEnv(), config, Recorder(without)).snapshot.env_state
    assert begun.info["policy"][0].shape == (64, 16)


# Four updates of 256 steps, the first of which only fills the replay.
SAC = SACConfig(num_envs=16, steps_per_update=16, grad_steps_per_update=2, batch_size=16, unroll_length=4, burn_in=2)
SAC = dataclasses.replace(SAC, min_replay_size=500, max_replay_size=1024)
SAC = dataclasses.replace(SAC, policy_hidden_layer_sizes=(16,), q_hidden_layer_sizes=(16,))


@pytest.fixture(scope="module", params=["ppo", pytest.param("sac", marks=pytest.mark.heavy)])
def run(request, tmp_path_factory) -> Any:
    """A run folder that was stopped after two updates and continued to four, and one that was not."""
    quiet, out = Console(file=io.StringIO()), tmp_path_factory.mktemp("memory")
    changed = {"algorithm": request.param, **({"sac": SAC, "ppo": PPOConfig()} if request.param == "sac" else {})}
    for name, sittings in (("stopped", (2, 4)), ("straight", (4,))):
        for updates in sittings:
            config = dataclasses.replace(toy_config(out / name, updates), network=GRU, **changed)
            result, folder, _ = train_run(config, quiet, build_env=build_toy)
            assert result.completed
    return out, folder, result.snapshot


def test_a_run_folder_keeps_memory(run):
    out, folder, straight = run
    paths = [out / name / "toy" / "checkpoints" / "000000001024" for name in ("stopped", "straight")]
    one, other = (checkpoint.load_learner(path, straight.learner) for path in paths)
    jax.tree.map(np.testing.assert_array_equal, one, other)
    assert folder.read_config().network == GRU
    plain = dataclasses.replace(folder.read_config(), network=NetworkConfig())
    with pytest.raises(checkpoint.CheckpointError, match="not a checkpoint of this learner .* use the run's config"):
        load_policy(folder, plain, ToyEnv(), "last", True)


@pytest.mark.parametrize("deterministic", [True, False])
def test_evaluation_carries_memory_through_each_episode(run, deterministic):
    """Scores equal those of a loop that keeps the actor's memory by hand, 0 at each start; forgetting changes it."""
    _, folder, snapshot = run
    env, config = ToyEnv(ToyConfig(episode_steps=12)), folder.read_config()
    policy, _ = load_policy(folder, config, env, "last", deterministic)
    keys = episode_keys(5, 6)
    played = BatchPlayer(env).play(policy, keys, record=6)
    agent, driven_m = ALGORITHMS[config.algorithm].make_agent(env, config), {True: [], False: []}
    act, step = jax.jit(agent.recurrent_policy(snapshot.learner, deterministic)), jax.jit(env.step)
    for key in keys:
        for keeps in (True, False):
            state, kept, t = env.reset(key), [jnp.zeros(16)], 0
            while not state.done:
                action, extras = act(state.obs, kept, jax.random.fold_in(policy_key_of(key), t))
                state, kept, t = step(state, action), extras["memory"] if keeps else kept, t + 1
            driven_m[keeps].append(float(state.metrics["robot_path_m"]))
            assert t == 12
    np.testing.assert_allclose(played.metrics["robot_path_m"], driven_m[True], rtol=1e-4)
    assert np.abs(np.array(driven_m[True]) - driven_m[False]).max() > 1e-3
    np.testing.assert_array_equal(played.metrics["episode_steps"], 12)
    assert np.isfinite(played.paths.robot_xy_w).all()


def test_it_is_refused_where_nothing_keeps_memory(run, tmp_path):
    _, folder, snapshot = run
    env, config = ToyEnv(), folder.read_config()
    refused = "network.memory is 'gru', and the policy is played as .* expected network.memory 'none', or an evaluation"
    policy, _ = load_policy(folder, config, env, "last", True)
    keys = jax.random.split(jax.random.PRNGKey(0))
    with pytest.raises(ConfigError, match=refused):
        jax.vmap(policy)(jnp.zeros((2, 29)), keys)
    with pytest.raises(ConfigError, match=refused):
        ALGORITHMS[config.algorithm].policy(env, config, snapshot.learner, True)(jnp.zeros((2, 29)), keys[0])
    with pytest.raises(ConfigError, match="played as an ONNX file"):
        export.main.__wrapped__([str(folder.path), "-o", str(tmp_path / "policy.onnx")], build_env=build_toy)
    with pytest.raises(
        ConfigError, match="memory is 'gru' with algorithm clone, expected algorithm ppo or sac or ddpg; change"
    ):
        resolve(TrainConfig(toy_config(tmp_path).env, "clone", GRU), "native")
    for algorithm in ("sac", "ddpg"):
        assert resolve(TrainConfig(toy_config(tmp_path).env, algorithm, GRU), "native").network == GRU
    with pytest.raises(ConfigError, match="memory_size is 64, which changes nothing here: expected memory 'gru'"):
        NetworkConfig(memory_size=64)
    assert resolve(dataclasses.replace(toy_config(tmp_path), network=GRU), "native").network == GRU
