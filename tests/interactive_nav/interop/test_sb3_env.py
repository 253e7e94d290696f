"""Stable-Baselines3's view: its own checks of a VecEnv's returns, and a short PPO run through it."""

import numpy as np
import pytest

sb3 = pytest.importorskip("stable_baselines3", reason="stable_baselines3 is not installed")


@pytest.fixture(scope="module")
def envs(room):
    from interactive_nav.interop.sb3_env import SB3VecEnv

    return SB3VecEnv("turtlebot", [room], num_envs=4, backend="native", num_objects=1, episode_steps=8)


def test_an_episodes_end_is_told_as_stable_baselines_expects(envs):
    envs.seed(3)
    first = envs.reset()
    total = np.zeros(4)
    for step in range(8):
        obs, rewards, done, infos = envs.step(np.zeros((4, 2), np.float32))
        total += rewards
        assert not done.any() or step == 7
    assert done.all() and all(info["TimeLimit.truncated"] for info in infos)
    for i, info in enumerate(infos):
        assert info["episode"]["l"] == 8 and info["episode"]["r"] == pytest.approx(total[i], abs=1e-5)
        assert info["terminal_observation"].shape == (29,)
        assert not np.array_equal(info["terminal_observation"], obs[i])
        assert 0.0 <= info["ins_0.5"] <= 1.0
    envs.seed(3)
    np.testing.assert_array_equal(envs.reset(), first)
    assert not np.array_equal(envs.reset(), first)


def test_ppo_learns_through_it(envs):
    model = sb3.PPO("MlpPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(128)
    assert model.num_timesteps == 128
    assert len(model.ep_info_buffer) == 16 and model.ep_info_buffer[0]["l"] == 8
    changed = [not np.array_equal(a, b.detach()) for a, b in zip(before, model.policy.parameters(), strict=True)]
    assert any(changed) and all(np.isfinite(p.detach().numpy()).all() for p in model.policy.parameters())
