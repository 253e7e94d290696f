"""One element's call of a batch function, under vmaps."""

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.physics.base import one_of_batch


def test_nested_vmaps_call_the_batch_function_once_with_all_elements():
    sizes = []

    def batch(a, tree):
        sizes.append(a.shape[0])
        return {"sum": a + tree["b"].sum(-1), "b": 2 * tree["b"]}

    def one(a, b):
        return one_of_batch(batch, (a, {"b": b}))

    a, b = jnp.arange(6.0).reshape(2, 3), jnp.arange(12.0).reshape(3, 4)
    out = jax.vmap(jax.vmap(one), in_axes=(0, None))(a, b)  # b is the same for the outer axis
    np.testing.assert_array_equal(out["sum"], np.asarray(a) + np.asarray(b).sum(-1))
    np.testing.assert_array_equal(out["b"], np.broadcast_to(2 * np.asarray(b), (2, 3, 4)))
    assert sizes[-1] == 6
    single = one(a[1, 2], b[2])
    np.testing.assert_array_equal(single["sum"], out["sum"][1, 2])
    assert sizes[-1] == 1
