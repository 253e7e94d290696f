"""Offer a batch of environments as Stable-Baselines3's `VecEnv`; `docs/examples/sb3_ppo.py` trains with it."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from interactive_nav.interop.gym_env import action_space_of, observation_space_of
from interactive_nav.interop.torch_bridge import TorchVectorEnv
from interactive_nav.pictures.camera import ThirdPerson
from interactive_nav_common.errors import ConfigError, optional

MISSING = "stable_baselines3 is not installed: pip install stable-baselines3"
Monitor, torch = optional("stable_baselines3.common.monitor", MISSING).Monitor, optional("torch", MISSING)


def _to_numpy(tree: Any) -> Any:
    return jax.tree.map(lambda x: x.cpu().numpy().copy(), tree)


class SB3VecEnv(optional("stable_baselines3.common.vec_env", MISSING).VecEnv):
    """Adapt `TorchVectorEnv` to Stable-Baselines3's interface of NumPy arrays, by copies.

    A finished episode's info has `terminal_observation`, `TimeLimit.truncated`, its scores (`env.metric_names`) and
    Monitor's `episode` with return `r` and length `l`, so no `VecMonitor` is needed.
    """

    def __init__(self, envs: TorchVectorEnv, render_mode: str | None = None):
        """Wrap a batch; with render_mode="rgb_array" it can be filmed. One without `final_obs` is a `ConfigError`."""
        if not envs.final_obs:
            raise ConfigError("envs has final_obs=False, expected True: Stable-Baselines3 needs last observations")
        self.envs, self.render_mode = envs, render_mode
        self._camera = ThirdPerson(envs.env) if render_mode else None
        super().__init__(envs.num_envs, observation_space_of(envs.env), action_space_of(envs.env))

    def reset(self) -> Any:
        """Return observations of new episodes; of those that `seed` decides, if it was called."""
        seed = self._seeds[0]
        self._reset_seeds()
        return _to_numpy(self.envs.reset(seed))

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = torch.tensor(actions, device=self.envs.device)

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        *step, info = self.envs.step(self._actions)
        obs, rewards, terminated, truncated = _to_numpy(step)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(t)} for t in truncated]
        if done.any():
            final_obs, scores = _to_numpy((info["final_obs"], info["final_info"]))
        for i in np.flatnonzero(done):
            infos[i] |= {name: float(score[i]) for name, score in scores.items()}
            infos[i]["terminal_observation"] = jax.tree.map(lambda x, i=i: x[i], final_obs)
            infos[i]["episode"] = {"r": infos[i].pop("sum_reward"), "l": int(infos[i].pop("length"))}
        return obs, rewards, done, infos

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self._camera.frames(self.envs.state) if self._camera else [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the attribute, which all environments share, once for each index."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, *_: Any, **__: Any) -> Any:
        """Refuse it, and `env_method`: environments share their attributes and methods."""
        raise NotImplementedError(f"cannot set or call {attr_name!r}: the environments are one program")

    env_method = set_attr

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each environment, save that the `Monitor`'s numbers are there."""
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]
