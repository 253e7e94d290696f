"""The replacement for `jax.device_put_replicated`, and the day it can go."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from tests.train import brax_compat


def test_replicates_onto_each_device():
    device = jax.local_devices()[0]
    out = brax_compat.device_put_replicated({"a": jnp.arange(3.0), "b": 2}, [device])
    assert out["a"].shape == (1, 3) and out["b"].shape == (1,)
    np.testing.assert_array_equal(out["a"][0], [0.0, 1.0, 2.0])
    # What pmap makes of it: each device sees its own copy.
    doubled = jax.pmap(lambda x: 2 * x, axis_name=brax_compat.AXIS_NAME)(out["a"])
    np.testing.assert_array_equal(doubled[0], [0.0, 2.0, 4.0])


def test_two_devices_hold_a_copy_each():
    # The number of host devices is fixed when JAX starts, so this needs a process of its own.
    program = (
        "import jax, jax.numpy as jnp; from tests.train import brax_compat\n"
        "out = brax_compat.device_put_replicated(jnp.array([1., 2.]), jax.local_devices())\n"
        "assert out.shape == (2, 2), out.shape\n"
        "assert [s.data.tolist() for s in out.addressable_shards] == [[[1., 2.]], [[1., 2.]]]\n"
        "assert {s.device for s in out.addressable_shards} == set(jax.local_devices())\n"
    )
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": ":".join(filter(None, sys.path))},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_is_still_needed():
    from brax.training.agents.ppo import train as brax_train

    message = "tests/train/brax_compat.py is no longer needed: delete it, its callers' install() and this test"
    given = getattr(jax, "device_put_replicated", None)
    assert given is None or given is brax_compat.device_put_replicated, message
    assert "jax.device_put_replicated" in inspect.getsource(brax_train), message
