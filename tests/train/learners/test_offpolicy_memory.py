"""SAC and DDPG with memory: sequences of the replay, burn-in and resets by hand, a goal shown once, resuming."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import State
from brax.training.networks import FeedForwardNetwork
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav_common.errors import ConfigError
from tests.train.learners.test_memory import GRU, SignEnv
from tests.train.learners.test_offpolicy import tiny
from tests.train.learners.test_ppo import Recorder, copy_snapshot
from tests.train.learners.test_replay_buffer import DISCOUNT, ENVS, Step, ends, expected
from tests.train.toy_env import ToyConfig, batched
from tests.train.toy_pixels import SMALL, ToyPixels
from train.config import NetworkConfig, TrainConfig, resolve
from train.learners import memory, offpolicy
from train.learners.algorithms import ALGORITHMS
from train.learners.networks import Split

both = pytest.mark.parametrize("algorithm", ["sac", "ddpg"])
OFTEN = {"unroll_length": 4, "burn_in": 2}


def with_memory(algorithm: str, updates: int, network: NetworkConfig = GRU, **settings: Any) -> TrainConfig:
    return dataclasses.replace(tiny(algorithm, updates, **{**OFTEN, **settings}), network=network)


def summing() -> Split:
    """A network whose memory is a sum: encoder w * x, memory m + w * x, head the memory itself."""
    encoder = FeedForwardNetwork(lambda key: None, lambda _, w, x: w * x)
    head = FeedForwardNetwork(lambda key: None, lambda _, v, features: v * features)
    return Split(encoder.init, encoder.apply, encoder, head, lambda _, kept, features: kept + features)


def test_resets_and_burn_in_by_hand():
    """Six steps 1, 2, 4, 8, 16, 32 from a memory of 100, two of them burnt in, and an episode's end after 4 or 1."""
    observation = jnp.broadcast_to(2.0 ** jnp.arange(6), (2, 6))[..., None]
    over = jnp.zeros((2, 6), bool).at[0, 2].set(True).at[1, 0].set(True)
    at = jnp.broadcast_to(jnp.arange(3), (2, 3))
    history: Any = memory.History(observation, [jnp.full((2, 1), 100.0)], over, at, 2)  # type: ignore[call-arg]
    apply = memory.over_history(summing(), 0).apply

    def outputs(w: jax.Array, history: Any) -> jax.Array:
        return apply(None, {"encoder": w, "head": 1.0}, history)[..., 0]

    # First: 100 + 1 + 2 + 4, then the episode is over: 8, 8 + 16. Second, over after one step: 2 + 4 at the third.
    np.testing.assert_array_equal(outputs(jnp.array(1.0), history), [[107, 8, 24], [6, 14, 30]])
    np.testing.assert_array_equal(outputs(jnp.array(1.0), history.replace(at=at + 1)), [[8, 24, 56], [14, 30, 62]])
    # The derivative by w counts what came after the burn-in alone.
    slope = jax.jacobian(outputs)(jnp.array(1.0), history)
    np.testing.assert_array_equal(slope, [[4, 8, 24], [4, 12, 28]])
    longer = jax.jacobian(outputs)(jnp.array(1.0), history.replace(burn_in=0, at=at + 2))
    np.testing.assert_array_equal(longer, [[7, 8, 24], [6, 14, 30]])
    with pytest.raises(ConfigError, match="network.memory is 'gru', and the policy is played as a function"):
        apply(None, {"encoder": 1.0, "head": 1.0}, observation)


SLOTS = 9
insert = jax.jit(offpolicy.insert)
sample = jax.jit(functools.partial(offpolicy.sample, unroll_length=3, burn_in=2), static_argnums=(2, 3, 4))
histories = st.lists(st.lists(ends, min_size=ENVS, max_size=ENVS), min_size=SLOTS, max_size=15)


@settings(deadline=None, max_examples=40)
@given(history=histories, n_steps=st.sampled_from([1, 3]), seed=st.integers(0, 2**31 - 1))
def test_sequences_are_of_transitions_in_a_row(history: list[Step], n_steps: int, seed: int):
    """Each is what the plain ring's would be, step by step, and the memory is that of the sequence's first step."""
    vectors = jnp.zeros((ENVS, 2))
    replay = offpolicy.empty_replay(SLOTS, memory.History(vectors, [vectors]), 1)  # type: ignore[call-arg]
    for time, step in enumerate(history):
        ids = np.array([[time, env] for env in range(ENVS)], np.float32)
        rewards = np.array([1.0 + time + 0.125 * env for env in range(ENVS)], np.float32)
        done, truncated = np.array(step, np.float32).T
        seen: Any = memory.History(ids, [ids + 0.5])  # type: ignore[call-arg]
        replay = insert(replay, seen, ids[:, :1] + 100, rewards, done, truncated)
    drawn: Any = jax.device_get(sample(replay, jax.random.PRNGKey(seed), 24, n_steps, DISCOUNT))
    assert drawn.reward.shape == (8, 3) and drawn.observation.burn_in == 2
    oldest = max(0, len(history) - SLOTS)
    for i in range(8):
        before, after = drawn.observation, drawn.next_observation
        start, env = (int(x) for x in before.observation[i, 0])
        assert oldest <= start < len(history) - n_steps - 4
        times = start + np.arange(2 + 3 + n_steps)
        np.testing.assert_array_equal(before.observation[i], [[time, env] for time in times])
        np.testing.assert_array_equal(after.observation[i], before.observation[i])
        np.testing.assert_array_equal(before.over[i], [history[time][env][0] for time in times])
        np.testing.assert_array_equal(before.memory[0][i], [start + 0.5, env + 0.5])
        for j in range(3):
            time = start + 2 + j
            total, discount, truncation, next_time = expected(history, time, env, n_steps)
            assert before.at[i, j] == j and drawn.action[i, j, 0] == 100 + time
            assert float(drawn.reward[i, j]) == pytest.approx(total)
            assert float(drawn.discount[i, j]) == pytest.approx(discount)
            assert float(drawn.extras["state_extras"]["truncation"][i, j]) == truncation
            assert after.at[i, j] == next_time - start - 2


class ClockEnv(SignEnv):
    """Shows the time as well: without any input a new GRU remembers nothing."""

    observation_size = 3  # type: ignore[assignment]

    def observe(self, state: State) -> State:
        shown = super().observe(state)
        return shown.replace(obs=jnp.concatenate([shown.obs, 0.5 + 0.1 * state.info["step"][:, None]], -1))  # type: ignore


@pytest.fixture(scope="module", params=["sac", "ddpg", "shared", "images"])
def collected(request) -> Any:
    """An agent, its first learner, and the data after two updates' steps in episodes of 8 or 9 steps."""
    env: Any = batched(ToyPixels(ToyConfig(episode_steps=8))) if request.param == "images" else ClockEnv()
    network = dataclasses.replace(SMALL, memory="gru", memory_size=16) if request.param == "images" else GRU
    network = dataclasses.replace(network, share_encoder=request.param == "shared")
    config = with_memory("ddpg" if request.param == "ddpg" else "sac", 1, network, steps_per_update=12)
    agent = ALGORITHMS[config.algorithm].make_agent(env, config)
    first = offpolicy.start(agent, env, seed=0)
    collect = jax.jit(lambda data, key: offpolicy.collect(agent, env, first.learner, data, key)[0])
    data = collect(collect(first.env_state, jax.random.PRNGKey(1)), jax.random.PRNGKey(2))
    return agent, first.learner, data


def test_replayed_memory_is_that_of_the_rollout(collected):
    """With unchanged parameters outputs are those of the memory that the ring has at that very step.

    21 steps of all environments, three of them burnt in: each output is compared with one step from the memory that
    the ring holds before it. Without the first memory, or without resets, outputs are others.
    """
    agent, learner, data = collected
    policy, q = agent.networks.policy_network, agent.networks.q_network
    params, normalizer = agent.whole_policy(learner.policy_params, learner.q_params), learner.normalizer_params
    steps, number = data.replay.replace(position=(), filled=()), 18
    ring: Any = jax.tree.map(lambda x: x.swapaxes(0, 1)[:, 3:24], steps)

    def rows(x: jax.Array) -> jax.Array:
        """[envs, steps, ...] -> [envs * 18, ...], without the burn-in."""
        return x[:, 3:].reshape(-1, *x.shape[2:])

    kept = ring.observation.memory
    assert len(kept) == (1 if agent.shared else 2) and ring.done.any(1).all() and np.abs(kept[0][:, 0]).max() > 0
    at = jnp.broadcast_to(jnp.arange(number), (len(ring.done), number))
    history: Any = memory.History(ring.observation.observation, [x[:, 0] for x in kept], ring.done, at, 3)  # type: ignore

    def of_sequences(history: Any) -> list[np.ndarray]:
        outputs = policy.apply(normalizer, params, history)
        values = q.apply(normalizer, learner.q_params, history, ring.action[:, 3:])
        return [np.asarray(x).reshape(-1, x.shape[-1]) for x in (outputs, values)]

    now, then = jax.tree.map(rows, (ring.observation.observation, kept))
    acting, after = memory.advance((policy, q), (params, learner.q_params), normalizer, now, then)
    values = q.head.apply(None, learner.q_params["head"], after[-1], rows(ring.action))
    replayed = of_sequences(history)
    for got, single in zip(replayed, (acting.apply(), values), strict=True):
        np.testing.assert_allclose(got, single, atol=1e-6)
    forgotten = history.replace(memory=jax.tree.map(jnp.zeros_like, history.memory))
    endless = history.replace(over=jnp.zeros_like(history.over))
    for changed in (forgotten, endless):
        for got, right in zip(of_sequences(changed), replayed, strict=True):
            assert np.abs(got - right).max() > 1e-5


def test_memory_in_the_ring_is_zero_where_episodes_start(collected):
    """And nowhere else; the environments carry what the next step begins with."""
    agent, _, data = collected
    filled = int(data.replay.filled)
    done = np.asarray(data.replay.done)[:filled]
    for ring, kept in zip(data.replay.observation.memory, data.info["policy"], strict=True):
        ring = np.concatenate([np.asarray(ring)[:filled], np.asarray(kept)[None]])
        np.testing.assert_array_equal((ring[1:] == 0).all(-1), done)
        assert (ring[0] == 0).all() and ring.shape[-1] == agent.memory_size == 16


def test_a_gradient_step_trains_every_layer(collected):
    agent, learner, data = collected
    drawn = offpolicy.sample(data.replay, jax.random.PRNGKey(3), 64, 1, 0.9, 4, 2)
    after, metrics = jax.jit(agent.gradient_step)(learner, drawn, jax.random.PRNGKey(4))
    assert all(np.isfinite(value).all() for value in metrics.values())
    for name in ("policy_params", "q_params"):
        moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), getattr(after, name), getattr(learner, name))
        assert min(jax.tree.leaves(moved)) > 0


@pytest.mark.parametrize("algorithm", [pytest.param("sac", marks=pytest.mark.heavy), "ddpg"])
def test_resumed_run_equals_uninterrupted_one(algorithm):
    """Six updates, against two more from the snapshot after four, with its replay and memory."""
    train, config, recorder = ALGORITHMS[algorithm].train, with_memory(algorithm, 6), Recorder()
    whole = train(SignEnv(), config, recorder).snapshot
    assert int(whole.learner.gradient_steps) == 8
    half = next(s for s in recorder.saved if s.env_steps == 4 * 64)
    resumed = train(SignEnv(), config, Recorder(copy_snapshot(half))).snapshot
    jax.tree.map(np.testing.assert_array_equal, whole.learner, resumed.learner)
    jax.tree.map(np.testing.assert_array_equal, whole.env_state, resumed.env_state)
    without = dataclasses.replace(copy_snapshot(half), env_state=None)
    begun: Any = train(SignEnv(), with_memory(algorithm, 4), Recorder(without)).snapshot.env_state
    assert (begun.info["policy"][0] == 0).all() and int(begun.replay.filled) == 0


SIGN: dict[str, Any] = {
    "num_envs": 32,
    "steps_per_update": 9,
    "grad_steps_per_update": 16,
    "batch_size": 256,
    "min_replay_size": 1_024,
    "max_replay_size": 32_768,
    "discounting": 0.5,
    "actor_learning_rate": 3e-3,
    "critic_learning_rate": 3e-3,
    "tau": 0.05,
}


NOISY: dict[str, Any] = {
    "noise": "gaussian",
    "noise_sd": (0.5,),
    "target_update_period": 1,
    "actor_learning_rate": 3e-4,
}


@pytest.mark.parametrize(
    ("algorithm", "network", "low", "high"),
    [
        pytest.param("sac", GRU, 0.9, 1.0, marks=pytest.mark.heavy),
        ("sac", NetworkConfig(), 0.44, 0.56),
        pytest.param("ddpg", dataclasses.replace(GRU, share_encoder=True), 0.65, 1.0, marks=pytest.mark.heavy),
    ],
)
def test_a_goal_that_is_shown_once_takes_memory(algorithm, network, low, high):
    """Share of later steps that match after 8,640 steps, of three seeds: SAC 1.00 with memory, without it chance.

    DDPG, whose exploration noise counts, and whose policy saturates early: 0.75 to 0.96.
    """
    sequences = {"unroll_length": 8, "burn_in": 4} if network.memory != "none" else {}
    own = {"alpha_learning_rate": 3e-3} if algorithm == "sac" else NOISY
    config = dataclasses.replace(tiny(algorithm, 1, **{**SIGN, **sequences, **own}), network=network)
    steps = {"num_timesteps": 30 * 288, "log_every_steps": 5 * 288, "checkpoint_every_steps": 30 * 288}
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, **steps))
    matched = ALGORITHMS[algorithm].train(SignEnv(), config, Recorder()).metrics["episode/matched"]
    assert low <= matched <= high


def test_the_replay_counts_what_is_remembered():
    """By hand, each transition: 2 numbers, an action and a reward of 4 bytes, two flags, and 2 x 16 numbers."""
    config = with_memory("sac", 1)
    agent = ALGORITHMS["sac"].make_agent(SignEnv(), config)
    data: Any = offpolicy.start(agent, SignEnv(), 0).env_state
    each = 2 * 4 + 4 + 4 + 2 + 2 * 16 * 4
    assert offpolicy.nbytes(data.replay) == 32 * 16 * each + 8
    assert f"of {each} bytes each" in data.note
    small = dataclasses.replace(config, sac=dataclasses.replace(config.sac, replay_limit_gb=6e-5))
    with pytest.raises(ConfigError, match="lower sac.max_replay_size, lower network.memory_size, or raise"):
        offpolicy.start(ALGORITHMS["sac"].make_agent(SignEnv(), small), SignEnv(), 0)


def test_settings_of_sequences_are_checked():
    with pytest.raises(
        ConfigError, match="sac.burn_in is 2, which changes nothing here: expected network.memory 'gru'"
    ):
        resolve(tiny("sac", 6, burn_in=2), "native")
    with pytest.raises(
        ConfigError, match=r"at least 160: it must hold .* a sample \(burn_in \+ unroll_length \+ n_steps, 10 steps"
    ):
        resolve(with_memory("sac", 6, max_replay_size=9 * 16, min_replay_size=16, burn_in=5), "native")
    resolve(with_memory("sac", 6, max_replay_size=10 * 16, min_replay_size=16, burn_in=5), "native")
    with pytest.raises(ConfigError, match="network.action_features is 8, which changes nothing here"):
        resolve(tiny_with(NetworkConfig(action_features=8)), "native")
    assert (
        resolve(with_memory("ddpg", 6, dataclasses.replace(GRU, action_features=8)), "native").network.memory == "gru"
    )


def tiny_with(network: NetworkConfig) -> TrainConfig:
    return dataclasses.replace(tiny("sac", 6), network=network)
