"""Offer a batch of environments as Stable-Baselines3's `VecEnv` in place of Gymnasium's vector environment.

from stable_baselines3 import PPO
from interactive_nav.interop.sb3_env import SB3VecEnv
PPO("MlpPolicy", SB3VecEnv("turtlebot", ["scenes_mjcf/apartment_0"], num_envs=16)).learn(1_000_000)
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from interactive_nav.interop.gym_env import AutoresetMode, InteractiveNavVectorEnv

try:
    from stable_baselines3.common.monitor import Monitor  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError("stable_baselines3 is not installed: pip install stable-baselines3") from error


class SB3VecEnv(VecEnv):
    """`InteractiveNavVectorEnv` behind Stable-Baselines3's interface.

    A finished episode's info has `terminal_observation`, `TimeLimit.truncated`, its scores
    (`env.metric_names`) and Monitor's `episode` with return `r` and length `l`, so no `VecMonitor` is needed.
    """

    def __init__(self, robot: str, scenes: Sequence[str], num_envs: int = 16, **settings: Any):
        """Build it; errors are those of `InteractiveNavVectorEnv`.

        Args:
            robot: a name from `robot_names()`.
            scenes: scene folders; each episode draws one.
            num_envs: environments stepped together.
            **settings: of `NavConfig`'s parts.
        """
        self.envs = InteractiveNavVectorEnv(robot, scenes, num_envs, AutoresetMode.SAME_STEP, **settings)
        self.render_mode = self.envs.render_mode
        self._actions = np.zeros(self.envs.action_space.shape, np.float32)  # type: ignore[arg-type]
        self._returns = np.zeros(num_envs)
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)

    def reset(self) -> Any:
        """Return observations of new episodes; of those that `seed` decides, if it was called."""
        seeds = None if all(s is None for s in self._seeds) else list(self._seeds)
        self._reset_seeds()
        self._returns[:] = 0.0
        return self.envs.reset(seed=seeds)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Return observations, rewards, ends, and an info for each environment."""
        obs, rewards, terminated, truncated, info = self.envs.step(self._actions)
        self._returns += rewards
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(t)} for t in truncated]
        done = terminated | truncated
        for i in np.flatnonzero(done):
            scores = {name: float(info["final_info"][name][i]) for name in self.envs.env.metric_names}
            infos[i] |= scores
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["episode"] = {"r": float(self._returns[i]), "l": int(scores["episode_steps"])}
        self._returns[done] = 0.0
        return obs, rewards, done, infos

    def close(self) -> None:
        """Do nothing: there is nothing to release."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a third-person view of each environment, with render_mode="rgb_array"."""
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the attribute, which all environments share, once for each index."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse it: environments share their attributes."""
        raise NotImplementedError(f"cannot set {attr_name!r}: the environments are one program; make them anew")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Refuse it: environments share their methods."""
        raise NotImplementedError(f"cannot call {method_name!r}: the environments are one program")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each environment, save that the `Monitor`'s numbers are there."""
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]
