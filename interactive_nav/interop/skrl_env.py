"""Offer a batch of environments to skrl; `docs/examples/skrl_ppo.py` trains with it."""

from typing import Any

from interactive_nav.interop.gym_env import action_space_of, observation_space_of
from interactive_nav.interop.torch_bridge import TorchVectorEnv
from interactive_nav_common.errors import MissingPackage

try:
    import torch  # pyright: ignore[reportMissingImports]
    from skrl.envs.wrappers.torch import Wrapper  # pyright: ignore[reportMissingImports]
    from skrl.utils.spaces.torch import flatten_tensorized_space  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingPackage("skrl is not installed: pip install skrl torch") from error


class SkrlEnv(Wrapper):
    """`TorchVectorEnv` behind skrl's interface, on its device; an observation in parts is flattened, as skrl has it.

    Mean scores of finished episodes are in `info["episode"]`, which skrl's trainers log.
    """

    def __init__(self, envs: TorchVectorEnv):
        """Wrap a batch, which need not have `final_obs`."""
        super().__init__(envs)
        self._observation_space, self._action_space = observation_space_of(envs.env), action_space_of(envs.env)

    @property
    def observation_space(self) -> Any:
        """Return the space of one environment's observation."""
        return self._observation_space

    @property
    def action_space(self) -> Any:
        """Return [-1, 1], one per actuator."""
        return self._action_space

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Begin new episodes everywhere."""
        return _flat(self._env.reset()), {}

    def step(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, Any]:
        """Return observations, and rewards and ends as columns."""
        obs, *columns, info = self._env.step(actions)
        # Copied: skrl adds the value of what follows a time limit to the rewards in place.
        reward, terminated, truncated = (x[:, None].clone() for x in columns)
        return _flat(obs), reward, terminated, truncated, info

    def state(self) -> None:
        """Return None: there is no state beside the observation."""

    def render(self, *_: Any, **__: Any) -> None:
        """Do nothing: films are made of a trained policy."""

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


def _flat(obs: Any) -> Any:
    return flatten_tensorized_space(obs)
