"""Stable-Baselines3's view of a batch, with its own checks of a VecEnv's returns."""

import numpy as np
import pytest

import interactive_nav
from interactive_nav.interop.torch_bridge import TorchVectorEnv
from interactive_nav_common.errors import UserError
from tests.train.toy_env import ToyEnv

sb3 = pytest.importorskip("stable_baselines3", reason="stable_baselines3 is not installed")


@pytest.fixture(scope="module")
def envs(room):
    from interactive_nav.interop.sb3_env import SB3VecEnv

    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=1, episode_steps=8)
    return SB3VecEnv(TorchVectorEnv(env, num_envs=4), render_mode="rgb_array")


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

    assert [image.shape for image in envs.get_images()] == [(360, 480, 3)] * 4


def test_a_batch_without_last_observations_is_refused():
    from interactive_nav.interop.sb3_env import SB3VecEnv

    with pytest.raises(UserError, match="envs has final_obs=False, expected True"):
        SB3VecEnv(TorchVectorEnv(ToyEnv(), 2, final_obs=False))
