"""Offer a batch of environments as rsl_rl's `VecEnv`; `docs/examples/rsl_rl_ppo.py` trains with it."""

from collections.abc import Mapping
from typing import Any

from interactive_nav.interop.torch_bridge import TorchVectorEnv
from interactive_nav_common.errors import MissingPackage

try:
    import torch  # pyright: ignore[reportMissingImports]
    from rsl_rl.env import VecEnv  # pyright: ignore[reportMissingImports]
    from tensordict import TensorDict  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingPackage("rsl_rl is not installed: pip install rsl-rl-lib") from error


class RslRlVecEnv(VecEnv):
    """`TorchVectorEnv` behind rsl_rl's interface, on its device.

    A flat observation is the group `policy`. One in parts has a group for each, images as float32 in 0 to 1 with their
    channels first. Time limits are in `extras["time_outs"]`, mean scores of finished episodes in `extras["log"]`.
    """

    def __init__(self, envs: TorchVectorEnv):
        """Wrap a batch, which need not have `final_obs`."""
        self.envs, self.num_envs, self.num_actions, self.device = envs, envs.num_envs, envs.num_actions, envs.device
        self.cfg, self.max_episode_length = envs.env.config, envs.env.config.episode_steps
        self._obs = envs.reset()

    @property
    def episode_length_buf(self) -> torch.Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the steps that the present episodes have taken; rsl_rl may assign others to spread their ends."""
        return self.envs.episode_steps

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self.envs.episode_steps = steps

    def get_observations(self) -> TensorDict:
        """Return the present observations by group."""
        parts = self._obs if isinstance(self._obs, Mapping) else {"policy": self._obs}
        return TensorDict({name: _channels_first(x) for name, x in parts.items()}, [self.num_envs], self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Return observations, rewards, ends and extras."""
        self._obs, reward, terminated, truncated, info = self.envs.step(actions)
        log = {f"/{name}": mean for name, mean in info.get("episode", {}).items()}
        extras = {"time_outs": truncated.float()} | ({"log": log} if log else {})
        return self.get_observations(), reward, (terminated | truncated).long(), extras


def _channels_first(x: torch.Tensor) -> torch.Tensor:
    if x.ndim != 4:
        return x
    return (x / 255 if x.dtype == torch.uint8 else x).permute(0, 3, 1, 2)
