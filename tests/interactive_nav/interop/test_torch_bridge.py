"""JAX and PyTorch look at the same memory; a batch of environments hands tensors out and takes tensors in."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.interop.torch_bridge import to_jax, to_torch
from interactive_nav_common.errors import UserError

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
    with pytest.raises(UserError, match=r"shape \(2,\) requires a gradient, expected a detached one"):
        to_jax(torch.ones(2, requires_grad=True))


def test_the_batch_gives_and_takes_tensors(room):
    from interactive_nav.interop.gym_env import InteractiveNavVectorEnv

    envs = InteractiveNavVectorEnv(
        "turtlebot", [room], num_envs=3, arrays="torch", backend="native", num_objects=1, episode_steps=2
    )
    obs, _ = envs.reset(seed=1)
    for _ in range(2):
        obs, reward, terminated, truncated, info = envs.step(torch.zeros(3, 2))
    assert all(isinstance(x, torch.Tensor) for x in (obs, reward, terminated, truncated, info["final_obs"]))
    assert obs.shape == (3, 29) and truncated.all() and not terminated.any()
    assert (info["final_info"]["episode_steps"] == 2).all()
    assert obs.data_ptr() == envs._state.obs.unsafe_buffer_pointer()
