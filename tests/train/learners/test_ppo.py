"""PPO against Brax's own, by hand where hands reach, and on a toy it must learn."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as brax_ppo

from tests.train import brax_compat
from tests.train.toy_env import ToyConfig, ToyEnv, batched
from train.config import EnvConfig, PPOConfig, RunConfig, TrainConfig
from train.learners import ppo
from train.learners.algorithms import ALGORITHMS
from train.learners.learner import Snapshot, Update, episode_sums

SMALL = PPOConfig(
    num_envs=16,
    unroll_length=8,
    batch_size=16,
    num_minibatches=2,
    num_updates_per_batch=2,
    policy_hidden_layer_sizes=(16,),
    value_hidden_layer_sizes=(16,),
)


class Recorder:
    """Callbacks that keep everything in memory."""

    def __init__(self, resume: Snapshot | None = None):
        self.resume, self.logs, self.saved = resume, [], []

    def restore(self, template: Snapshot) -> Snapshot | None:
        return self.resume

    def should_stop(self) -> bool:
        return False

    def on_start(self, snapshot: Snapshot, total_steps: int) -> None:
        self.total_steps = total_steps

    def on_update(self, env_steps: int) -> None:
        pass

    def on_log(self, env_steps: int, metrics: dict[str, float]) -> None:
        self.logs.append((env_steps, metrics))

    def on_checkpoint(self, snapshot: Snapshot) -> None:
        self.saved.append(copy_snapshot(snapshot))

    def on_diverged(self, before: Snapshot, update: Update) -> str:
        raise AssertionError("diverged")


def copy_snapshot(snapshot: Snapshot) -> Snapshot:
    return Snapshot(snapshot.env_steps, *(jax.tree.map(jnp.array, (snapshot.learner, snapshot.env_state))))


def make_config(updates: int, **settings: Any) -> TrainConfig:
    config = dataclasses.replace(SMALL, **settings)
    steps = 8 * 16 * 2
    run = RunConfig(num_timesteps=updates * steps, log_every_steps=steps, checkpoint_every_steps=2 * steps)
    return TrainConfig(env=EnvConfig(scenes=("toy",)), ppo=config, run=run)


def test_updates_equal_those_of_brax():
    """Two updates from one seed end at the parameters that Brax's own loop ends at."""
    brax_compat.install()
    config = make_config(2)
    ours = ALGORITHMS["ppo"].train(batched(), config, Recorder()).snapshot.learner
    c = config.ppo
    with jax.numpy_rank_promotion("allow"):  # Brax's statistics promote
        _, params, _ = brax_ppo.train(
            batched(),
            num_timesteps=config.run.num_timesteps,
            max_devices_per_host=1,
            wrap_env=False,
            num_envs=c.num_envs or 0,
            episode_length=60,
            learning_rate=c.learning_rate,
            entropy_cost=c.entropy_cost,
            discounting=c.discounting,
            unroll_length=c.unroll_length or 0,
            batch_size=c.batch_size or 0,
            num_minibatches=c.num_minibatches or 0,
            num_updates_per_batch=c.num_updates_per_batch,
            normalize_observations=True,
            clipping_epsilon=c.clipping_epsilon,
            gae_lambda=c.gae_lambda,
            max_grad_norm=c.max_grad_norm,
            network_factory=lambda *a, **k: ppo_networks.make_ppo_networks(
                *a, **k, policy_hidden_layer_sizes=(16,), value_hidden_layer_sizes=(16,)
            ),
            seed=config.run.seed,
            num_evals=1,
            run_evals=False,
        )
    theirs = (params[0].mean, params[0].std, params[1], params[2])
    mine = (ours.normalizer_params.mean, ours.normalizer_params.std, ours.params.policy, ours.params.value)
    # Same arithmetic, compiled in other pieces: float32 rounding only. An update moves weights by about 1e-2.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-5), mine, theirs)


@pytest.mark.heavy
def test_the_step_size_falls_in_equal_steps_to_its_final_value():
    def trained(**settings: Any) -> tuple[list[float], Any]:
        result = ALGORITHMS["ppo"].train(batched(), make_config(3, **settings), recorder := Recorder())
        return [metrics["loss/learning_rate"] for _, metrics in recorder.logs], result.snapshot.learner.params

    rates, falling = trained(learning_rate=6e-4, final_learning_rate=0.0)
    # An update takes four steps of Adam (two passes over two minibatches), and there are three updates.
    np.testing.assert_allclose(rates, [6e-4, 6e-4 * 8 / 12, 6e-4 * 4 / 12], rtol=1e-5)
    level, same = trained(learning_rate=6e-4, final_learning_rate=6e-4)
    np.testing.assert_allclose(level, 6e-4, rtol=1e-5)
    constant = trained(learning_rate=6e-4)[1]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-7), same, constant)
    away = jax.tree.map(lambda a, b: np.abs(a - b).max(), falling, constant)
    assert max(jax.tree.leaves(away)) > 1e-4


def test_time_limit_bootstraps_once():
    """GAE by hand: T = 2, discount 0.5, lambda 1, rewards 1, values 10 then 20; step two hits the limit.

    Cut step: no delta, so its target is its own value, 20, and its advantage is 0.
    Step before it: target 1 + 0.5 * 20 = 11, advantage 11 - 10 = 1; the next episode's value (99) is unseen.
    Were the end a failure instead: step two's target is 1; step one's 1 + 0.5 * 1 = 1.5.
    """
    rewards, values = jnp.ones((2, 1)), jnp.array([[10.0], [20.0]])
    cut, never = jnp.array([[0.0], [1.0]]), jnp.zeros((2, 1))
    bootstrap = jnp.array([99.0])
    targets, advantages = ppo_losses.compute_gae(cut, never, rewards, values, bootstrap, 1.0, 0.5)
    np.testing.assert_allclose(targets[:, 0], [11.0, 20.0])
    np.testing.assert_allclose(advantages[:, 0], [1.0, 0.0])
    targets, _ = ppo_losses.compute_gae(never, cut, rewards, values, bootstrap, 1.0, 0.5)
    np.testing.assert_allclose(targets[:, 0], [1.5, 1.0])


def test_collect_keeps_sequences_of_one_environment():
    config = make_config(1)
    env = batched(ToyEnv(ToyConfig(episode_steps=5)))
    parts = ppo.make_agent(env, config)
    start = ppo.start(parts, env, seed=0)
    _, data, sums = jax.jit(lambda s, e: ppo.collect(parts, env, s, e, jax.random.PRNGKey(3)))(
        start.learner, start.env_state
    )
    assert data.observation.shape == (32, 8, 29)
    assert data.next_observation.shape == (32, 1, 29)
    # Inside a sequence, at an episode's end (and only there) the goal jumps: the environment began a new one.
    # The robot moves at most 0.088 m a step, so the distance to the goal cannot change by more.
    distance = np.linalg.norm(np.asarray(data.observation)[..., 20:22], axis=-1)
    jumped = np.abs(np.diff(distance, axis=1)) > 0.089
    ended = np.asarray(data.discount)[:, :-1] == 0
    assert ended.any() and not (jumped & ~ended).any()
    # 16 envs x 16 steps with a limit of 5: three time limits each, unless an episode succeeded before.
    assert float(sums["episodes"]) == (np.asarray(data.discount) == 0).sum() >= 48
    truncated = np.asarray(data.extras["state_extras"]["truncation"])
    assert (truncated <= 1 - np.asarray(data.discount)).all() and truncated.sum() > 0


def test_episode_sums_count_ended_episodes_only():
    info = {
        "episode_done": jnp.array([[1.0, 0.0], [0.0, 1.0]]),
        "episode_metrics": {"success": jnp.array([[1.0, jnp.nan], [5.0, 0.5]])},
    }
    sums = episode_sums(info)
    assert float(sums["success"]) == 1.5 and float(sums["episodes"]) == 2.0


@pytest.fixture(scope="module")
def straight() -> tuple[Recorder, Snapshot]:
    """Four updates at once, with a snapshot after two."""
    seen = Recorder()
    return seen, ALGORITHMS["ppo"].train(batched(), make_config(4), seen).snapshot


def test_resumed_run_equals_uninterrupted_one(straight):
    """Four updates, against two more from the snapshot after two: the same numbers to the last bit."""
    recorder, whole = straight
    half = recorder.saved[0]
    assert half.env_steps == 2 * 256
    rest = Recorder(resume=copy_snapshot(half))
    resumed = ALGORITHMS["ppo"].train(batched(), make_config(4), rest).snapshot
    assert whole.env_steps == resumed.env_steps == 4 * 256
    jax.tree.map(np.testing.assert_array_equal, whole.learner, resumed.learner)
    jax.tree.map(np.testing.assert_array_equal, whole.env_state, resumed.env_state)
    assert [steps for steps, _ in rest.logs] == [768, 1024]
    before, after = recorder.logs[-1][1], rest.logs[-1][1]
    same = [name for name in before if name not in ("env_steps_per_s", "compile_s")]
    assert {name: before[name] for name in same} == {name: after[name] for name in same}


def test_resume_without_environments_begins_new_episodes(straight):
    rest = Recorder(resume=dataclasses.replace(copy_snapshot(straight[0].saved[0]), env_state=None))
    result = ALGORITHMS["ppo"].train(batched(), make_config(3), rest)
    assert result.snapshot.env_steps == 3 * 256 and result.completed
    # The first update restarts 16 episodes at step 0: after 16 steps none has run longer than that.
    env_state: Any = result.snapshot.env_state
    assert int(np.max(env_state.info["nav"].step_count)) <= 16


@pytest.mark.slow
def test_learns_the_toy():
    """From random to at least 0.95 success: 0.992 to 1.0 of five seeds, 0 where nothing is paid."""
    config = TrainConfig(
        env=EnvConfig(scenes=("toy",)),
        ppo=PPOConfig(
            num_envs=64,
            unroll_length=16,
            batch_size=64,
            num_minibatches=4,
            learning_rate=2e-3,
            discounting=0.97,
            policy_hidden_layer_sizes=(64, 64),
            value_hidden_layer_sizes=(64, 64),
        ),
        run=RunConfig(num_timesteps=65_536, log_every_steps=8_192, checkpoint_every_steps=65_536),
    )
    seen = Recorder()
    result = ALGORITHMS["ppo"].train(batched(), config, seen)
    assert seen.logs[0][1]["episode/success"] < 0.6
    assert result.metrics["episode/success"] >= 0.95
    assert result.metrics["episode/ins_0.5"] >= 0.95
