"""Offer a batch of environments to skrl; `docs/examples/skrl_ppo.py` trains with it."""

from types import SimpleNamespace
from typing import Any

from interactive_nav.interop.gym_env import action_space_of, observation_space_of
from interactive_nav.interop.torch_bridge import TorchVectorEnv
from interactive_nav_common.errors import optional

MISSING = "skrl is not installed: pip install skrl torch"
flatten = optional("skrl.utils.spaces.torch", MISSING).flatten_tensorized_space


class SkrlEnv(optional("skrl.envs.wrappers.torch", MISSING).Wrapper):
    """Adapt `TorchVectorEnv` to skrl's interface, with flat observations and mean scores in `info["episode"]`."""

    def __init__(self, envs: TorchVectorEnv):
        """Wrap a batch, which need not have `final_obs`."""
        super().__init__(envs)
        spaces = {"observation_space": observation_space_of(envs.env), "action_space": action_space_of(envs.env)}
        self._unwrapped = SimpleNamespace(num_envs=envs.num_envs, **spaces)  # where the base class looks

    def reset(self) -> tuple[Any, dict[str, Any]]:
        return flatten(self._env.reset()), {}

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Return observations, rewards, terminated and truncated as columns, and `info`."""
        obs, *columns, info = self._env.step(actions)
        # Copied: skrl adds the value of what follows a time limit to the rewards in place.
        return (flatten(obs), *(x[:, None].clone() for x in columns), info)

    def state(self) -> None:
        """Return None: there is no state beside the observation."""

    def render(self, *_: Any, **__: Any) -> None:
        """Do nothing: films are made of a trained policy."""

    def close(self) -> None:
        """Do nothing: there is nothing to release."""
