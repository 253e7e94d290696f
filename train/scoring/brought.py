"""Play a policy given as `name=module:factory`: any Python callable, NumPy, JAX or PyTorch, on the host."""

import dataclasses
import re
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from interactive_nav.interop.onnx_file import OnnxError, OnnxFile
from interactive_nav.sensing.description import describe, difference, inputs_of
from interactive_nav.task.rollout import HostPolicy
from interactive_nav_common.errors import ConfigError, UserError
from interactive_nav_common.imports import first_line, import_function

TAKEN = ("learned", "random", "follower", "avoider", "namo", "puller", "keyboard", "ros")
EXPECTED = "expected [name=]module:factory, [name=]path/to/file.py:factory or [name=]policy.onnx"


class PolicyError(UserError):
    """A policy of the user's that cannot be loaded, raises, or returns what are no actions."""


@dataclasses.dataclass(frozen=True)
class PlayedEnv:
    """What a policy's factory receives about the environment that it is to play in."""

    robot: str
    scenes: tuple[str, ...]
    observations: dict[str, jax.ShapeDtypeStruct]
    """Name -> `.shape` and `.dtype` of one environment's: `state`, the vector, and images such as `pixels/depth`."""
    state_parts: dict[str, slice]
    """Part of `state` -> where it stands: `waypoints` (x0, y0, x1, ... m, robot frame), `goal`, `velocity`, ..."""
    action_size: int
    """Actions are clipped to [-1, 1]."""
    control_dt_s: float
    max_linear_m_s: float
    """Of the base; NaN, as the next one, where the control mode takes no base velocity."""
    max_angular_rad_s: float
    drive: Callable[[Any, Any], np.ndarray]
    """Linear (m/s) and angular (rad/s) velocity [B] of the base -> actions [B, A]."""


def describe_env(env: Any) -> PlayedEnv:
    obs = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), np.uint32)).obs
    ends = np.cumsum([0, *env.sensors.sizes.values()]).tolist()
    twist = env.robot.twist
    return PlayedEnv(
        robot=env.robot.name,
        scenes=tuple(scene.name for scene in env.scenes),
        observations=dict(obs) if isinstance(obs, Mapping) else {"state": obs},
        state_parts=dict(zip(env.sensors.sizes, map(slice, ends, ends[1:]), strict=False)),
        action_size=env.action_size,
        control_dt_s=env.config.control_dt_s,
        max_linear_m_s=twist.max_linear_m_s if twist else np.nan,
        max_angular_rad_s=twist.max_angular_rad_s if twist else np.nan,
        drive=env.robot.drive,
    )


def named(word: str) -> str:
    """Return `name=module:factory` or `name=policy.onnx` of a word of `--policy`; what has no name gets the place's."""
    name, equals, place = word.rpartition("=")
    module, _, factory = place.rpartition(":")
    if place.endswith(".onnx"):
        default = Path(place).stem
    elif module and factory.isidentifier():
        default = f"{Path(module).stem if module.endswith('.py') else module}:{factory}"
    else:
        raise ConfigError(f"--policy: got {word!r}, {EXPECTED}")
    name = name if equals else default
    if not re.fullmatch(r"[\w.:+-]+", name) or name.partition(":")[0] in TAKEN:
        raise ConfigError(
            f"--policy: name is {name!r}, expected letters, digits and any of _ . : + -, and none of {', '.join(TAKEN)}"
        )
    return f"{name}={place}"


class OnnxPolicy:
    """A policy of an ONNX file that `interactive-nav export` wrote, for the environments that it fits."""

    def __init__(self, path: str | Path, env: Any):
        self._file, self._env = OnnxFile(path), env
        try:
            differs = difference(self._file.about, describe(env))
        except (KeyError, TypeError, AttributeError):
            raise OnnxError(f"{path}: has no description, expected a file of interactive-nav export") from None
        if differs:
            raise OnnxError(f"{path}: {differs}; choose a policy of this robot and these observations, or set env.*")

    def __call__(self, observations: Mapping[str, np.ndarray], first: Any) -> np.ndarray:
        """Return actions [B, A]."""
        return self._file.run("action", inputs_of(self._env, observations))


class BroughtPolicy(HostPolicy):
    """A callable of the user's; see `docs/benchmark-your-policy.md`."""

    def __init__(self, word: str, env: Any):
        self._name, _, place = word.partition("=")
        if place.endswith(".onnx"):
            self._act: Any = OnnxPolicy(place, env)
        else:
            factory = import_function(place, "--policy", EXPECTED, PolicyError)
            self._act = self._call("factory", factory, describe_env(env))
        if not callable(self._act):
            raise self._error(f"its factory returned type {type(self._act).__name__}, expected a callable")
        self._size = env.action_size
        self._obs: dict[str, np.ndarray] = {}
        self._first_episode = 0

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> np.ndarray:
        """Return actions [N, A] of one control step; the policy always sees the whole batch, finished episodes too."""
        obs = state.obs if isinstance(state.obs, Mapping) else {"state": state.obs}
        if step == 0:
            self._obs = {name: np.array(value) for name, value in obs.items()}
            self._first_episode = int(episode[0])
            if hasattr(self._act, "reset"):
                self._call("reset", self._act.reset, np.array(episode))
        places = episode - self._first_episode
        for name, value in obs.items():
            self._obs[name][places] = np.asarray(value)
        count = len(next(iter(self._obs.values())))
        copies = {name: value.copy() for name, value in self._obs.items()}  # it may keep them, or write into them
        got = self._call("policy", self._act, copies, np.full(count, step == 0))
        if got is None:
            raise self._error(
                f"returned None at step {step}, expected actions {(count, self._size)}; is there a return?"
            )
        actions = self._call("policy's actions", _on_host, got)
        if actions.shape != (count, self._size):
            raise self._error(f"actions have shape {actions.shape}, expected {(count, self._size)}")
        actions = np.where(running[:, None], actions[places], 0.0)
        bad = np.flatnonzero(~np.isfinite(actions).all(1))
        if len(bad):
            raise self._error(
                f"actions of episode {episode[bad[0]]} at step {step} are {actions[bad[0]]}, expected finite numbers"
            )
        return actions

    def _call(self, what: str, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:
            frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename != __file__]
            theirs = [frame for frame in frames if "site-packages" not in frame.filename] or frames
            where = f" at {Path(theirs[-1].filename).name}:{theirs[-1].lineno}" if theirs else ""
            raise self._error(f"{what}: raised {first_line(error)}{where}") from error

    def _error(self, text: str) -> PolicyError:
        return PolicyError(f"policy {self._name}: {text}")


def _on_host(actions: Any) -> np.ndarray:
    """Return actions of NumPy, JAX or PyTorch (on any device, with or without a gradient) as f32."""
    if hasattr(actions, "detach"):
        actions = actions.detach().cpu()
    return np.asarray(actions, np.float32)
