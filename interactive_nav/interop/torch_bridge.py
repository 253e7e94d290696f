"""Step environments with PyTorch tensors, which share JAX's memory through DLPack (example: `docs/gymnasium.md`).

Both sides look at the same bytes on the same device. JAX takes its arrays to be constant, so write into a tensor that
came from JAX only after `clone()`, and into one that was handed to JAX not at all.
"""

from typing import Any

import jax
import jax.numpy as jnp

from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav_common.errors import ConfigError, optional

MISSING = "PyTorch is not installed; follow https://pytorch.org/get-started"


def to_torch(tree: Any) -> Any:
    """Convert the JAX arrays of a pytree to PyTorch tensors on the same device, without a copy; keep other leaves."""
    torch = optional("torch", MISSING)
    return jax.tree.map(lambda x: torch.from_dlpack(x) if isinstance(x, jax.Array) else x, tree)


def to_jax(tree: Any) -> Any:
    """Convert PyTorch tensors of a pytree to JAX arrays on the same device; keep other leaves.

    Only tensors that are not contiguous, or on the CPU not aligned to 64 bytes, are copied. One that requires a
    gradient raises `ConfigError`.
    """
    torch = optional("torch", MISSING)

    def convert(x: Any) -> Any:
        if not isinstance(x, torch.Tensor):
            return x
        if x.requires_grad:
            raise ConfigError(f"tensor of shape {tuple(x.shape)} requires a gradient, expected none; call .detach()")
        return jnp.from_dlpack(x.contiguous())

    return jax.tree.map(convert, tree)


class TorchVectorEnv:
    """Step N environments as one compiled program on tensors; finished episodes are followed by new ones at once.

    After an episode's end `obs` belongs to the new one, everything else to the step. `info` is empty unless an episode
    ended; then it has `final_obs` [N, ...], `final_info`, name -> [N] scores (`env.metric_names`, `length`,
    `sum_reward`), valid where an episode ended, and `episode`, their means.
    """

    def __init__(self, env: Any, num_envs: int, cpu: bool = False, final_obs: bool = True):
        """Wrap what `interactive_nav.make` returns.

        Tensors are where the simulation runs, but on the CPU with `cpu` or if PyTorch cannot use the GPU. With
        `final_obs`, which Stable-Baselines3 needs, every step observes twice. No environment is a `ConfigError`.
        """
        torch = optional("torch", MISSING)
        if num_envs < 1:
            raise ConfigError(f"num_envs is {num_envs}, expected at least 1")
        self.env, self.num_envs, self.num_actions, self.final_obs = env, num_envs, env.action_size, final_obs
        self._home, self._key = jax.devices()[0], jax.random.PRNGKey(0)
        self.state: Any = None
        shared = self._home.platform == "gpu" and torch.cuda.is_available() and not cpu
        self.device = torch.device(f"cuda:{self._home.local_hardware_id}" if shared else "cpu")
        batch = AutoResetEnv(env, final_obs=final_obs)

        def step(state: Any, actions: jax.Array) -> tuple[Any, ...]:
            state = batch.step(state, actions)
            over, truncated = state.done > 0, state.info["truncation"] > 0
            scores = jnp.stack(list(state.info["episode_metrics"].values()))  # one array to hand over
            means = jnp.where(over, scores, 0.0).sum(-1) / jnp.maximum(over.sum(), 1)
            return state, over & ~truncated, truncated, scores, means

        self._reset, self._step = jax.jit(batch.reset), jax.jit(step)

    def reset(self, seed: int | None = None) -> Any:
        """Begin new episodes everywhere, with a seed always the same ones; return the observations [N, ...]."""
        self._key, key = jax.random.split(self._key if seed is None else jax.random.PRNGKey(seed))
        self.state = self._reset(jax.random.split(key, self.num_envs))
        return self._out(self.state.obs)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Return observations, rewards, terminated, truncated and `info` after [N, A] actions in [-1, 1]."""
        if self.state is None:
            raise ConfigError("step was called before reset")
        actions = jax.device_put(to_jax(actions.detach().float()), self._home)
        self.state, *ends, scores, means = self._step(self.state, actions)
        obs, reward, terminated, truncated = self._out((self.state.obs, self.state.reward, *ends))
        info = {}
        if (terminated | truncated).any():
            names, (scores, means) = self.state.info["episode_metrics"], self._out((scores, means))
            info = {
                "final_info": dict(zip(names, scores, strict=True)),
                "episode": dict(zip(names, means, strict=True)),
            }
            info |= {"final_obs": self._out(self.state.info["final_obs"])} if self.final_obs else {}
        return obs, reward, terminated, truncated, info

    @property
    def episode_steps(self) -> Any:
        """Return the control steps [N] that the present episodes have taken; assign to it to shift their time limit."""
        return self._out(self.state.info["nav"].step_count)

    @episode_steps.setter
    def episode_steps(self, steps: Any) -> None:
        nav = self.state.info["nav"].replace(step_count=jax.device_put(to_jax(steps.int()), self._home))
        self.state = self.state.replace(info=self.state.info | {"nav": nav})

    def _out(self, tree: Any) -> Any:
        return to_torch(jax.device_put(tree, jax.devices("cpu")[0]) if self.device.type == "cpu" else tree)
