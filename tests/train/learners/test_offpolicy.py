"""What SAC and DDPG share: the loop around the replay, resuming, memory, divergence; each on the toy."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import types
from scipy.stats import kstest

from interactive_nav_common.errors import ConfigError
from tests.train.learners.test_ppo import Recorder, copy_snapshot
from tests.train.toy_env import ToyConfig, ToyEnv, batched
from tests.train.toy_pixels import SMALL, ToyPixels
from train.config import DDPGConfig, EnvConfig, OffPolicyConfig, RunConfig, SACConfig, TrainConfig
from train.learners import offpolicy
from train.learners.actor_critic import DDPG, SAC
from train.learners.algorithms import ALGORITHMS
from train.learners.learner import DivergedError, Snapshot, Update

STEPS = 16 * 4
"""Environment steps in an update of `tiny`."""


def tiny(algorithm: str, updates: int, **settings: Any) -> TrainConfig:
    """Updates of 64 steps, the first two of which only fill the replay."""
    sizes: dict[str, Any] = {
        "num_envs": 16,
        "steps_per_update": 4,
        "grad_steps_per_update": 2,
        "batch_size": 32,
        "min_replay_size": 3 * STEPS,
        "max_replay_size": 8 * STEPS,
        "policy_hidden_layer_sizes": (16,),
        "q_hidden_layer_sizes": (16,),
    }
    section = {"sac": SACConfig, "ddpg": DDPGConfig}[algorithm](**{**sizes, **settings})
    run = RunConfig(num_timesteps=updates * STEPS, log_every_steps=STEPS, checkpoint_every_steps=2 * STEPS)
    base = TrainConfig(env=EnvConfig(scenes=("toy",)), algorithm=algorithm, run=run)  # type: ignore[arg-type]
    return dataclasses.replace(base, **{algorithm: section})


def run(algorithm: str, updates: int, resume: Snapshot | None = None, env: Any = None) -> tuple[Recorder, Snapshot]:
    seen = Recorder(resume=resume)
    result = ALGORITHMS[algorithm].train(env or batched(), tiny(algorithm, updates), seen)
    return seen, result.snapshot


@pytest.fixture(scope="module")
def straight() -> dict[str, tuple[Recorder, Snapshot]]:
    """Six updates of each learner, which several tests look at."""
    return {name: run(name, 6) for name in ("sac", "ddpg")}


def copy(tree: Any) -> Any:
    """Arrays of their own: what a run begins from is donated to it."""
    return jax.tree.map(jnp.array, tree)


both = pytest.mark.parametrize("algorithm", ["sac", "ddpg"])


@pytest.mark.parametrize("algorithm", [pytest.param("sac", marks=pytest.mark.heavy), "ddpg"])
def test_nothing_is_learned_before_the_replay_is_full_enough(straight, algorithm):
    """Two updates fill 128 of 192; the third learns. Two gradient steps an update, one line a log interval."""
    seen, end = straight[algorithm]
    steps = [metrics["loss/gradient_steps"] for _, metrics in seen.logs]
    assert steps == [0.0, 0.0, 2.0, 2.0, 2.0, 2.0]
    assert [metrics["loss/replay_size"] for _, metrics in seen.logs] == [64, 128, 192, 256, 320, 384]
    assert [steps for steps, _ in seen.logs] == [64, 128, 192, 256, 320, 384]
    assert int(end.learner.gradient_steps) == 8
    first = ALGORITHMS[algorithm].template(batched(), tiny(algorithm, 6))
    same = jax.tree.map(np.array_equal, seen.saved[0].learner.q_params, end.learner.q_params)
    assert not any(jax.tree.leaves(same)) and first.gradient_steps == 0
    expected = {"critic_loss", "actor_loss", "q_mean", "replay_size", "gradient_steps", "reward_per_step"}
    expected |= {"alpha", "alpha_loss"} if algorithm == "sac" else set()
    assert expected == {name[5:] for name in seen.logs[-1][1] if name.startswith("loss/")}


@both
def test_who_never_learned_acts_at_random(straight, algorithm):
    """The 192 steps before the first gradient step are uniform in [-1, 1] (Kolmogorov-Smirnov), later ones are not."""
    _, end = straight[algorithm]
    data: Any = end.env_state
    at = int(data.replay.position)
    assert at == 24 and int(data.replay.filled) == 24
    actions = np.asarray(data.replay.action)
    assert kstest(actions[:12].ravel(), "uniform", (-1, 2)).pvalue > 1e-3
    if algorithm == "ddpg":  # deviation 0.2 a step around one action
        assert kstest(actions[12:24].ravel(), "uniform", (-1, 2)).pvalue < 1e-6


@both
def test_resumed_run_equals_uninterrupted_one(straight, algorithm):
    """Six updates, against two more from the snapshot after four, with its replay: the same to the last bit."""
    recorder, whole = straight[algorithm]
    half = next(s for s in recorder.saved if s.env_steps == 4 * STEPS)
    rest, resumed = run(algorithm, 6, resume=copy_snapshot(half))
    assert whole.env_steps == resumed.env_steps == 6 * STEPS
    jax.tree.map(np.testing.assert_array_equal, whole.learner, resumed.learner)
    jax.tree.map(np.testing.assert_array_equal, whole.env_state, resumed.env_state)
    assert [steps for steps, _ in rest.logs] == [5 * STEPS, 6 * STEPS]
    before, after = recorder.logs[-1][1], rest.logs[-1][1]
    same = [name for name in before if name not in ("env_steps_per_s", "compile_s")]
    assert {name: before[name] for name in same} == {name: after[name] for name in same}


@both
def test_resume_without_replay_fills_it_with_the_policy_before_it_learns_on(straight, algorithm):
    """From update 4 on: updates 5 and 6 only act, 7 learns; all count, none acts at random."""
    recorder, _ = straight[algorithm]
    saved = next(s for s in recorder.saved if s.env_steps == 4 * STEPS)
    rest, end = run(algorithm, 7, resume=dataclasses.replace(saved, env_state=None))
    assert [metrics["loss/gradient_steps"] for _, metrics in rest.logs] == [0.0, 0.0, 2.0]
    assert [steps for steps, _ in rest.logs] == [5 * STEPS, 6 * STEPS, 7 * STEPS]
    assert int(end.learner.gradient_steps) == int(saved.learner.gradient_steps) + 2
    data: Any = end.env_state
    assert int(data.replay.filled) == 12
    if algorithm == "ddpg":
        assert kstest(np.asarray(data.replay.action[:12]).ravel(), "uniform", (-1, 2)).pvalue < 1e-3


def test_info_is_the_environments(straight):
    _, end = straight["sac"]
    data: Any = end.env_state
    assert data.info is data.env_state.info and "ins_0.5" in data.info["episode_metrics"]
    assert data.note.startswith("replay of 512 transitions (32 steps of 16 environments) of 130 bytes each")


def test_collect_writes_what_happened_and_restarts_noise_with_the_episode():
    """DDPG on episodes of three steps: the ring's actions, played again, lead to all that it holds.

    Noise is 0 where an episode just ended.
    """
    config = tiny("ddpg", 1, steps_per_update=7)
    env = batched(ToyEnv(ToyConfig(episode_steps=3)))
    agent = DDPG.of(env, config)
    begin: Any = offpolicy.start(agent, env, 0)
    collect = jax.jit(lambda s, d: offpolicy.collect(agent, env, s, d, s.key))
    data, seen = collect(begin.learner, begin.env_state)
    replay = data.replay
    assert int(replay.filled) == int(replay.position) == 7

    def play(state, action):
        after = env.step(state, action)
        return after, (state.obs, after.reward, after.done > 0, after.info["truncation"] > 0)

    _, played = jax.jit(lambda state: jax.lax.scan(play, state, replay.action[:7]))(begin.env_state.env_state)
    observation, reward, done, truncated = map(np.asarray, played)
    np.testing.assert_allclose(replay.observation[:7], observation, atol=1e-6)
    np.testing.assert_allclose(replay.reward[:7], reward, atol=1e-6)
    np.testing.assert_array_equal(replay.observation[:7], seen["observation"])
    np.testing.assert_array_equal(replay.reward[:7], seen["reward"])
    np.testing.assert_array_equal(replay.done[:7], done)
    np.testing.assert_array_equal(replay.truncated[:7], truncated)
    assert float(seen["sums"]["episodes"].sum()) == done.sum() >= 2 * 16
    # Success within three steps from 1 m away is out of reach: every end is a time limit, at steps 2 and 5.
    assert (np.asarray(replay.truncated[:7]).sum(1) == [0, 0, 16, 0, 0, 16, 0]).all()
    assert (np.asarray(data.noise) != 0).all()
    data, _ = collect(begin.learner, data)  # seven more end at step 13: the third of an episode's three is step 14
    ended = np.asarray(data.env_state.done) > 0
    assert (np.asarray(data.noise)[ended] == 0).all() and (np.asarray(data.noise)[~ended] != 0).all()


def test_the_compiled_update_writes_the_replay_in_place_and_normalises_no_image():
    """With images: the ring is an argument that the result overwrites, and no temporary is as large as it."""
    config = dataclasses.replace(tiny("sac", 1, max_replay_size=16 * 16384), network=SMALL)
    env = batched(ToyPixels())
    agent = SAC.of(env, config)
    begin = offpolicy.start(agent, env, 0)
    data: Any = begin.env_state
    size = offpolicy.nbytes(data.replay)
    assert size == 16 * 16384 * (2 * 144 + 6 * 4 + 2 * 4 + 4 + 2) + 8
    compiled = (
        jax.jit(lambda s, d: offpolicy.update(agent, env, s, d), donate_argnums=1).lower(begin.learner, data).compile()
    )
    memory: Any = compiled.memory_analysis()
    assert memory.alias_size_in_bytes >= size
    assert memory.temp_size_in_bytes < size / 4
    place = data.replay.observation["pixels/depth"].unsafe_buffer_pointer()
    learner, data, update = compiled(begin.learner, data)
    assert data.replay.observation["pixels/depth"].unsafe_buffer_pointer() == place
    # Every step's vector once, and nothing else.
    velocities = np.asarray(update.batch["collected"]["observation"]["state"]).reshape(-1, 6)
    assert velocities.shape == (STEPS, 6) and set(learner.normalizer_params.mean) == {"state"}
    np.testing.assert_allclose(learner.normalizer_params.mean["state"], velocities.mean(0), atol=1e-5)


def test_a_replay_beyond_its_limit_is_refused():
    """512 transitions of 29 numbers, 2 actions and a reward of 4 bytes and two flags: 130 bytes each."""
    config = tiny("sac", 1, replay_limit_gb=6e-5)
    with pytest.raises(ConfigError) as caught:
        ALGORITHMS["sac"].train(batched(), config, Recorder())
    told = str(caught.value)
    assert "sac.replay_limit_gb is 6e-05, but the replay of 512 transitions" in told
    assert "of 130 bytes each" in told and "lower sac.max_replay_size, or raise" in told
    replay = offpolicy.empty_replay(32, jnp.zeros((16, 29)), 2)
    offpolicy.check_memory(dataclasses.replace(config.sac, replay_limit_gb=6.7e-5), replay, "sac")
    images = offpolicy.empty_replay(32, {"pixels/depth": jnp.zeros((16, 12, 12, 1))}, 2)
    with pytest.raises(ConfigError, match="choose env.image_dtype=uint8"):
        offpolicy.check_memory(config.sac, images, "sac")


def test_a_reward_that_is_no_number_stops_the_run_and_is_in_the_saved_batch(straight):
    """One goal of sixteen is nowhere: the first update that meets it."""

    class Keeper(Recorder):
        def on_diverged(self, before: Snapshot, update: Update) -> str:
            self.update = update
            return "here"

    saved = straight["ddpg"][0].saved[0]
    data: Any = saved.env_state
    nav = data.info["nav"]
    lost = {**data.info, "nav": nav.replace(goal_xy_w=nav.goal_xy_w.at[3].set(jnp.nan))}
    broken = data.replace(env_state=data.env_state.replace(info=lost))
    keeper = Keeper(resume=dataclasses.replace(saved, env_state=copy(broken)))
    with pytest.raises(DivergedError, match="reward_per_step.* not finite; batch and learner before it are in here"):
        ALGORITHMS["ddpg"].train(batched(), tiny("ddpg", 6), keeper)
    rewards = np.asarray(keeper.update.batch["collected"]["reward"])
    assert np.isnan(rewards[:, 3]).all() and np.isfinite(np.delete(rewards, 3, 1)).all()


@flax.struct.dataclass
class Counter:
    """A learner that only counts."""

    gradient_steps: jax.Array


@dataclasses.dataclass(frozen=True)
class Summing:
    """An agent whose metric is the sum of the rewards it is shown."""

    config: OffPolicyConfig

    def gradient_step(self, learner: Counter, transitions: types.Transition, key: jax.Array):
        del key
        return Counter(learner.gradient_steps + 1), {"sum": jnp.sum(transitions.reward)}


def test_the_saved_batch_is_the_first_that_was_not_finite():
    """One of 40 rewards is NaN: of ten batches of four, some hold it, and the first of those is kept."""
    sizes: dict[str, Any] = {"num_envs": 1, "max_replay_size": 41, "min_replay_size": 41}
    agent: Any = Summing(OffPolicyConfig(**sizes, batch_size=4, grad_steps_per_update=10))
    replay = offpolicy.empty_replay(41, jnp.zeros((1, 1)), 1)
    replay = replay.replace(  # type: ignore[attr-defined]
        reward=jnp.arange(41.0)[:, None].at[7].set(jnp.nan), filled=jnp.int32(41), position=jnp.int32(0)
    )
    learn = jax.jit(lambda replay, key: offpolicy.learn(agent, Counter(jnp.int32(0)), replay, key))
    found = 0
    for seed in range(6):
        key = jax.random.PRNGKey(seed)
        learner, metrics, batch = learn(replay, key)
        draws = [jax.random.split(k)[0] for k in jax.random.split(key, 10)]
        batches = [np.asarray(offpolicy.sample(replay, k, 4, 1, 0.99).reward) for k in draws]
        bad = [i for i, rewards in enumerate(batches) if np.isnan(rewards).any()]
        found += bool(bad)
        np.testing.assert_array_equal(batch.reward, batches[bad[0] if bad else 9])
        assert np.isnan(metrics["sum"]) == bool(bad) and int(learner.gradient_steps) == 10
        if not bad:
            np.testing.assert_allclose(metrics["sum"], np.sum(batches) / 10, rtol=1e-5)
    assert found > 0
    learner, metrics, _ = learn(replay.replace(filled=jnp.int32(40)), key)  # one short of min_replay_size
    assert int(learner.gradient_steps) == 0 and float(metrics["sum"]) == 0.0
