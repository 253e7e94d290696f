"""JAX and PyTorch look at the same memory; a batch of environments takes tensors and returns them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav.interop.torch_bridge import TorchVectorEnv, to_jax, to_torch
from interactive_nav.task.wrappers import reset_all, step_all
from interactive_nav_common.errors import UserError
from tests.train.toy_env import ToyConfig, ToyEnv

torch = pytest.importorskip("torch", reason="PyTorch is not installed")


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.int32, jnp.uint8, jnp.bool_])
def test_a_tensor_of_an_array_is_the_same_memory(dtype):
    array = jnp.arange(12).reshape(3, 4).astype(dtype)
    tensor = to_torch(array)
    assert tensor.data_ptr() == array.unsafe_buffer_pointer()
    np.testing.assert_array_equal(tensor.numpy(), np.asarray(array))
    back = to_jax(tensor)
    assert back.unsafe_buffer_pointer() == array.unsafe_buffer_pointer() and back.dtype == dtype


def test_an_array_of_a_tensor_is_the_same_memory():
    tensor = torch.arange(64, dtype=torch.float32).reshape(32, 2)
    array = to_jax(tensor)
    assert array.unsafe_buffer_pointer() == tensor.data_ptr()
    np.testing.assert_array_equal(np.asarray(array), tensor.numpy())
    assert to_jax(tensor.T).tolist() == tensor.T.tolist()  # not contiguous: copied, values kept


def test_trees_keep_their_structure():
    tree = {"obs": jnp.ones(3), "more": (jnp.zeros((2, 2)), "text", 5)}
    out = to_torch(tree)
    assert isinstance(out["obs"], torch.Tensor) and out["more"][1:] == ("text", 5)
    assert jax.tree.map(lambda x: x.tolist(), to_jax({"a": [out["obs"]]})) == {"a": [[1.0, 1.0, 1.0]]}


def test_a_tensor_with_a_gradient_is_refused():
    with pytest.raises(UserError, match=r"shape \(2,\) requires a gradient, expected none; call .detach"):
        to_jax(torch.ones(2, requires_grad=True))


@pytest.fixture(scope="module")
def env(room):
    return interactive_nav.make("turtlebot", [room], backend="native", num_objects=1, episode_steps=2)


def test_a_batch_takes_and_returns_tensors(env):
    envs = TorchVectorEnv(env, num_envs=3)
    first = envs.reset(seed=1)
    keys = jax.random.split(jax.random.split(jax.random.PRNGKey(1))[1], 3)
    state = jax.jit(lambda keys: reset_all(env, keys))(keys)
    np.testing.assert_array_equal(first, state.obs)
    step = jax.jit(lambda state, actions: step_all(env, "DISABLED", state, actions, jnp.zeros(3, bool)))
    for k, actions in enumerate(np.random.default_rng(0).uniform(-1, 1, (2, 3, 2)).astype(np.float32)):
        obs, reward, terminated, truncated, info = envs.step(torch.as_tensor(actions))
        state, _, (last, rewards, _, _, metrics) = step(state, actions)  # the environment without auto-reset
        np.testing.assert_allclose(reward, rewards, atol=1e-6)
        assert all(isinstance(x, torch.Tensor) for x in (obs, reward, terminated, truncated))
        assert not terminated.any() and truncated.tolist() == [k == 1] * 3 and bool(info) == (k == 1)
    assert obs.data_ptr() == envs.state.obs.unsafe_buffer_pointer()
    np.testing.assert_allclose(info["final_obs"], last, atol=1e-6)
    assert not np.array_equal(obs, last)
    for name in env.metric_names:
        np.testing.assert_allclose(info["final_info"][name], metrics[name], rtol=1e-5, atol=1e-6)
    assert info["episode"]["length"] == 2 and (info["final_info"]["episode_steps"] == 2).all()
    np.testing.assert_array_equal(envs.reset(seed=1), first)
    assert not np.array_equal(envs.reset(), first)


def test_rows_of_running_episodes_do_not_count():
    envs = TorchVectorEnv(ToyEnv(ToyConfig(episode_steps=5)), num_envs=4, final_obs=False)
    envs.reset(seed=0)
    envs.episode_steps = torch.tensor([0, 3, 0, 2])
    assert envs.episode_steps.tolist() == [0, 3, 0, 2]
    ends, infos, rewards = [], [], []
    for _ in range(4):
        _, reward, terminated, truncated, info = envs.step(torch.zeros(4, 2))
        rewards.append(reward)
        ends.append(truncated.tolist())
        infos.append(info)
        assert not terminated.any()
    assert ends == [[False] * 4, [False, True, False, False], [False, False, False, True], [False] * 4]
    assert [sorted(info) for info in infos] == [[], ["episode", "final_info"], ["episode", "final_info"], []]
    assert infos[1]["episode"]["episode_steps"] == 5  # as counted from the assigned steps
    assert infos[2]["episode"]["sum_reward"] == pytest.approx(sum(r[3].item() for r in rewards[:3]), abs=1e-6)


def test_wrong_use_of_a_batch_is_refused_in_one_line():
    with pytest.raises(UserError, match="num_envs is 0, expected at least 1"):
        TorchVectorEnv(ToyEnv(), 0)
    with pytest.raises(UserError, match="step was called before reset"):
        TorchVectorEnv(ToyEnv(), 2).step(torch.zeros(2, 2))
