"""Offer a batch of environments as rsl_rl's `VecEnv`; `docs/examples/rsl_rl_ppo.py` trains with it."""

from collections.abc import Mapping
from typing import Any

from interactive_nav.interop.torch_bridge import TorchVectorEnv
from interactive_nav_common.errors import optional

MISSING = "rsl_rl is not installed: pip install rsl-rl-lib"
TensorDict = optional("tensordict", MISSING).TensorDict


class RslRlVecEnv(optional("rsl_rl.env", MISSING).VecEnv):
    """Adapt `TorchVectorEnv` to rsl_rl's interface, on its device (`docs/gymnasium.md` describes its observations).

    Time limits are in `extras["time_outs"]`, mean scores of finished episodes in `extras["log"]`. rsl_rl may assign to
    `episode_length_buf` to spread the ends of first episodes.
    """

    episode_length_buf = property(
        lambda self: self.envs.episode_steps, lambda self, steps: setattr(self.envs, "episode_steps", steps)
    )

    def __init__(self, envs: TorchVectorEnv):
        """Wrap a batch, which need not have `final_obs`."""
        self.envs, self.num_envs, self.num_actions, self.device = envs, envs.num_envs, envs.num_actions, envs.device
        self.cfg, self.max_episode_length = envs.env.config, envs.env.config.episode_steps
        self._obs = envs.reset()

    def get_observations(self) -> Any:
        parts = self._obs if isinstance(self._obs, Mapping) else {"policy": self._obs}
        return TensorDict({name: _channels_first(x) for name, x in parts.items()}, [self.num_envs], self.device)

    def step(self, actions: Any) -> tuple[Any, ...]:
        self._obs, reward, terminated, truncated, info = self.envs.step(actions)
        log = {"log": {f"/{name}": mean for name, mean in info["episode"].items()}} if info else {}
        return self.get_observations(), reward, (terminated | truncated).long(), {"time_outs": truncated.float()} | log


def _channels_first(x: Any) -> Any:
    return x if x.ndim != 4 else (x if x.is_floating_point() else x / 255).permute(0, 3, 1, 2)
