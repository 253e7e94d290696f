"""Gait training: the environment against hand arithmetic, its start at the script, and an export that acts alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.robots.gait import load_network, scripted_gait
from interactive_nav.robots.spec import RobotState
from train.gait import GaitCallbacks, GaitEnv, export, get_gait, main, train_config
from train.learners import ppo

N = 4


@pytest.fixture(scope="module")
def env():
    return GaitEnv(get_gait("ant"), "native")


@pytest.fixture(scope="module")
def programs(env):
    return jax.jit(env.reset), jax.jit(env.step)


def test_without_corrections_the_robot_follows_its_script(env, programs):
    reset, step = programs
    state = reset(jax.random.split(jax.random.PRNGKey(0), N))
    assert state.obs.shape == (N, env.observation_size) == (N, 14 + 2 * 8)
    for _ in range(60):
        state = step(state, jnp.zeros((N, env.action_size)))
    assert not state.done.any() and np.isfinite(state.obs).all()
    # 1.2 s of its tuned trot: the best reward of a step is 0.2 * (2 + 1 + 0.2 + 0.5 + 0.5).
    assert 0.4 < float(state.reward.mean()) < 0.84
    np.testing.assert_allclose(state.info["steps"], 60)


def test_a_fallen_robot_starts_anew(env, programs):
    reset, step = programs
    state = reset(jax.random.split(jax.random.PRNGKey(1), N))
    qpos = state.pipeline_state.qpos.at[1, 3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0]))  # on its back
    state = state.replace(pipeline_state=state.pipeline_state.replace(qpos=qpos))
    state = step(state, jnp.zeros((N, env.action_size)))
    np.testing.assert_array_equal(state.done, [0, 1, 0, 0])
    np.testing.assert_allclose(state.reward[1], -1.0)
    assert state.info["episode_metrics"]["fallen"][1] == 1 and state.info["truncation"][1] == 0
    assert state.pipeline_state.qpos[1, 2] > 0.1 and state.info["steps"][1] == 0


def test_training_begins_at_the_script_and_exports_what_it_acts(env, tmp_path):
    config = train_config("native", N, seed=0, num_timesteps=128, log_every=128)
    parts = ppo.make_parts(config.ppo, env.observation_size, env.action_size)
    callbacks = GaitCallbacks("ant", tmp_path, float("inf"), parts)
    snapshot = callbacks.restore(ppo.start(parts, env, 0))
    assert snapshot is not None
    callbacks.on_checkpoint(snapshot)
    network = load_network(tmp_path / "ant.npz")
    observation = np.random.default_rng(0).normal(size=(5, env.observation_size)).astype(np.float32)
    act = ppo.make_policy(parts, snapshot.learner, deterministic=True)
    action, _ = act(jnp.asarray(observation), jax.random.PRNGKey(0))
    np.testing.assert_allclose(network(observation, np), action, atol=2e-3)
    assert np.abs(action).max() < 0.2
    assert (tmp_path / "ant.npz").stat().st_size < 300_000
    np.testing.assert_allclose(export(parts, snapshot.learner)(observation, np), action, atol=1e-5)


def test_the_command_trains_and_writes_a_network(tmp_path, capsys):
    arguments = "--robot ant --backend native --num-envs 4 --steps 256 --log-every 128 --max-seconds 300 --out"
    assert main([*arguments.split(), str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum("steps/s" in line for line in lines) == 2
    network, gait = load_network(tmp_path / "ant.npz"), get_gait("ant")
    state = RobotState(np.zeros((1, 15)), np.zeros((1, 14)), np.zeros(1))
    assert scripted_gait(gait)(np.zeros((1, 2)), state, np).shape == (1, 8)
    assert network(np.zeros((1, gait.observation_size)), np).shape == (1, 8)
    assert main(["--robot", "ant", "--backend", "native", "--num-envs", "4", "--evaluate", str(tmp_path)]) == 0
    script, corrected = capsys.readouterr().out.splitlines()
    assert script.startswith("ant, script: ") and corrected.startswith("ant, network: ")
    # The script does not fall, nor does it after two updates that began at it.
    assert "fallen 0.000  length 500.000" in script


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--num-envs", "0"], "--num-envs: 0, expected above 0"),
        (["--max-seconds", "nan"], "--max-seconds: nan, expected above 0"),
        (["--backend", "gpu"], "invalid choice: 'gpu'"),
        (["--evaluate", "/nowhere"], "--evaluate /nowhere: holds no ant.npz; train it first"),
    ],
)
def test_impossible_settings_are_refused(words, message, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--robot", "ant", *words])
    assert ended.value.code == 2 and message in capsys.readouterr().err
