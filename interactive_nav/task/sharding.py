"""Spread a natively batched environment over several devices: one program, equal shares.

    env = ShardedEnv(AutoResetEnv(interactive_nav.make(...)))       # all devices, of all processes
    state = jax.jit(env.reset)(jax.random.split(key, num_envs))     # leaves are sharded along their first axis

Environments are independent, so nothing is exchanged between devices in `reset` and `step`; what a learner
computes from the sharded arrays (means, gradients) XLA reduces over the devices by itself.

Several machines or processes: call `start_distributed` first in each of them, before anything else uses JAX.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from interactive_nav_common.errors import ConfigError

AXIS = "i"
"""Name of the mesh's axis, as in Brax."""


class ShardedEnv(Wrapper):
    """Steps equal shares of a batch on each device."""

    def __init__(self, env: Env, devices: Sequence[Any] | None = None):
        """Wrap an environment."""
        super().__init__(env)
        self.mesh = Mesh(np.asarray(devices if devices is not None else jax.devices()), (AXIS,))
        self.sharding = NamedSharding(self.mesh, PartitionSpec(AXIS))
        spec = PartitionSpec(AXIS)
        self._reset = jax.shard_map(env.reset, mesh=self.mesh, in_specs=(spec, spec), out_specs=spec, check_vma=False)
        self._step = jax.shard_map(env.step, mesh=self.mesh, in_specs=(spec, spec), out_specs=spec, check_vma=False)

    @property
    def num_devices(self) -> int:
        """Return the number of devices that share the batch."""
        return self.mesh.size

    def reset(self, rng: jax.Array) -> State:
        """Return N states for [N, 2] keys."""
        if rng.shape[0] % self.num_devices:
            raise ConfigError(
                f"{rng.shape[0]} environments over {self.num_devices} devices, expected a multiple: "
                f"take {self.num_devices * max(1, rng.shape[0] // self.num_devices)}"
            )
        # Each device sees its share alone: it must be given which environments these are.
        whole = rng, jnp.arange(rng.shape[0])
        return self._reset(*(jax.lax.with_sharding_constraint(x, self.sharding) for x in whole))

    def step(self, state: State, action: jax.Array) -> State:
        """Return the states that follow N states and [N, A] actions."""
        return self._step(state, jax.lax.with_sharding_constraint(action, self.sharding))


def start_distributed(coordinator: str, num_processes: int, process_id: int) -> None:
    """Join processes, on one machine or several, into one JAX program.

    Every process runs the same script with another `process_id`; afterwards `jax.devices()` are the devices
    of all of them and `ShardedEnv` spreads over all.
    """
    if not 0 <= process_id < num_processes:
        raise ConfigError(f"process_id is {process_id}, expected 0 to {num_processes - 1}")
    if not coordinator.rpartition(":")[2].isdigit():
        raise ConfigError(f"coordinator is {coordinator!r}, expected host:port such as 10.0.0.1:1234")
    jax.distributed.initialize(coordinator, num_processes, process_id)
