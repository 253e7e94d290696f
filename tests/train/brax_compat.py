"""Puts back `jax.device_put_replicated`, which Brax 0.14.2 calls and JAX 0.10 lacks (google/brax#671).

Needed wherever Brax's own `train` functions are called on such a JAX. `install()` goes, with this file, when
Brax releases a version that does without; `tests/train/learners/test_brax_compat.py` says when that is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

# Brax's pmap axis. Any other name makes a pure_callback inside its pmap fail ('mesh should be the same').
AXIS_NAME = "i"


def device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """A copy of every leaf on each device, stacked.

    Args:
        tree: leaves [...].
        devices: local devices, as for `jax.pmap`.

    Returns:
        The tree with leaves [len(devices), ...], shard d on devices[d].
    """
    sharding = NamedSharding(Mesh(np.asarray(devices), (AXIS_NAME,)), PartitionSpec(AXIS_NAME))

    def put(leaf: Any) -> jax.Array:
        leaf = jnp.asarray(leaf)
        return jax.device_put(jnp.broadcast_to(leaf, (len(devices), *leaf.shape)), sharding)

    return jax.tree.map(put, tree)


def install() -> None:
    """Makes `jax.device_put_replicated` callable where JAX lacks it; an existing one is left alone."""
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = device_put_replicated  # type: ignore[attr-defined]
