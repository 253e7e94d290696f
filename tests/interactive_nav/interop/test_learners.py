"""Learners of other libraries solve the toy task, by the examples of the documentation; what each of them is given."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from interactive_nav.interop.torch_bridge import TorchVectorEnv
from tests.train.toy_env import ToyConfig, ToyEnv
from tests.train.toy_pixels import SIDE, ToyPixels

torch = pytest.importorskip("torch", reason="PyTorch is not installed")
EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
LIBRARIES = {"cleanrl_ppo": "torch", "rsl_rl_ppo": "rsl_rl", "sb3_ppo": "stable_baselines3", "skrl_ppo": "skrl"}


class Recorded(TorchVectorEnv):
    """Keeps whether each finished episode was a success."""

    successes: list[float] = []

    def step(self, actions):
        obs, reward, terminated, truncated, info = super().step(actions)
        if info:
            self.successes += info["final_info"]["success"][terminated | truncated].tolist()
        return obs, reward, terminated, truncated, info


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("example", LIBRARIES)
def test_an_example_solves_the_toy(example, tmp_path, one_thread, monkeypatch):
    pytest.importorskip(LIBRARIES[example], reason=f"{LIBRARIES[example]} is not installed")
    monkeypatch.chdir(tmp_path)
    module = SimpleNamespace(**runpy.run_path(str(EXAMPLES / f"{example}.py")))
    envs = Recorded(ToyEnv(), num_envs=64)
    envs.successes = []
    if example == "sb3_ppo":
        module.train(envs, 12 * 2048, n_steps=32, learning_rate=1e-3)
    else:
        module.train(envs, 12)
    assert np.mean(envs.successes[:100]) < 0.4  # a policy that has not learned yet
    assert np.mean(envs.successes[-100:]) > 0.9


@pytest.fixture
def pixels():
    return TorchVectorEnv(ToyPixels(ToyConfig(episode_steps=3)), num_envs=4, final_obs=False)


def test_rsl_rl_is_given_groups_and_time_limits(pixels):
    pytest.importorskip("rsl_rl", reason="rsl_rl is not installed")
    from interactive_nav.interop.rsl_rl_env import RslRlVecEnv

    env = RslRlVecEnv(pixels)
    env.episode_length_buf = torch.tensor([2, 0, 0, 0])
    assert env.max_episode_length == 3 and env.num_actions == 2
    obs, reward, done, extras = env.step(torch.zeros(4, 2))
    raw = pixels.state.obs["pixels/segmentation"]
    np.testing.assert_allclose(obs["pixels/segmentation"][:, 0], raw[..., 0] / 255.0, atol=1e-6)
    assert obs["pixels/depth"].shape == (4, 1, SIDE, SIDE) and obs["state"].shape == (4, 6)
    assert done.tolist() == extras["time_outs"].tolist() == [1, 0, 0, 0] and reward.shape == (4,)
    assert extras["log"]["/episode_steps"] == 3
    assert "log" not in env.step(torch.zeros(4, 2))[3]


def test_skrl_is_given_columns_and_flat_observations(pixels):
    pytest.importorskip("skrl", reason="skrl is not installed")
    from interactive_nav.interop.skrl_env import SkrlEnv

    env = SkrlEnv(pixels)
    obs, _ = env.reset()
    assert obs.shape == (4, 6 + 2 * SIDE * SIDE) and env.num_envs == 4 and env.action_space.shape == (2,)
    for _ in range(3):
        obs, reward, terminated, truncated, info = env.step(torch.zeros(4, 2))
        reward += 1.0  # as skrl does
        np.testing.assert_allclose(pixels.state.reward, reward[:, 0].numpy() - 1.0, atol=1e-6)
    assert reward.shape == terminated.shape == truncated.shape == (4, 1) and truncated.all()
    assert info["episode"]["episode_steps"] == 3
