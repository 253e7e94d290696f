"""Offer the environment to those who do not use JAX, with Gymnasium's API on NumPy arrays::

    import gymnasium
    import interactive_nav.interop.gym_env  # registers the ids
    envs = gymnasium.make_vec("InteractiveNav-TurtleBot-v0", num_envs=64, scenes=["scenes_mjcf/apartment_0"])

Ids are InteractiveNav-<Robot>-v0, one for each name in `robot_names()`. `make` gives one environment,
`make_vec` a batch that steps as one compiled program. Keyword arguments are those of `interactive_nav.make`.
Environment i of a batch reset with seed s plays the episodes of a single environment reset with seed s + i; with
`scene_choice="slot"` it keeps scene i modulo their number, as a single one built with `slot=i`.
"""

import functools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import interactive_nav
from interactive_nav.pictures.camera import ThirdPerson
from interactive_nav.robots import robot_names
from interactive_nav.task.env import InteractiveNav
from interactive_nav.task.wrappers import NONFINITE_ACTIONS, reset_all, reset_where, step_all
from interactive_nav_common.errors import ConfigError, MissingPackage, missing
from scenes_mjcf.robot_facts import title

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise MissingPackage(missing(__name__, "gymnasium", "gymnasium")) from error

SCENES = ("scenes_mjcf/apartment_0",)
"""Come with the package; taken where none are given."""
VERSION = 0
"""Raised whenever reported numbers would move."""


_PROCESS = os.getpid()
_SPACES: list[spaces.Space] = []
"""Of observations and actions of the last environment, for one in a forked process, which cannot be built."""


def _forked() -> bool:
    return os.getpid() != _PROCESS


def _refuse_fork() -> None:
    """Refuse to run in a forked process, in which JAX waits forever for threads that only its parent has."""
    if _forked():
        raise ConfigError(
            "the environment runs in a forked process, in which JAX hangs; expected a spawned one: "
            'AsyncVectorEnv(..., context="spawn"), or vector_kwargs={"context": "spawn"} of gymnasium.make_vec'
        )


def env_id(robot: str) -> str:
    """Return Gymnasium's id of a robot's environment: turtlebot -> InteractiveNav-TurtleBot-v0."""
    name = title(robot) or "".join(part.capitalize() for part in robot.split("_"))
    return f"InteractiveNav-{name}-v{VERSION}"


def register_envs() -> None:
    """Register every robot's environment with Gymnasium; a second call changes nothing."""
    for robot in robot_names():
        if env_id(robot) not in gymnasium.registry:
            gymnasium.register(
                env_id(robot),
                entry_point=f"{__name__}:InteractiveNavEnv",
                vector_entry_point=f"{__name__}:InteractiveNavVectorEnv",
                kwargs={"robot": robot},
            )


def observation_space_of(env: InteractiveNav) -> spaces.Space:
    """Return a `Box` for a flat observation (unbounded float32), or a `Dict` of boxes for one in parts.

    Images are 0 to 255 as uint8, else 0 (normals: -1) to 1 in their dtype.
    """
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    obs = jax.eval_shape(env.reset, key).obs

    def box(name: str, x: Any) -> spaces.Box:
        image, dtype = name.startswith("pixels/"), np.dtype(x.dtype)
        high = 255 if dtype == np.uint8 else 1.0 if image else np.inf
        low = -1.0 if name.endswith("/normals") else 0 if image else -np.inf
        return spaces.Box(low, high, x.shape, dtype.type)

    if isinstance(obs, Mapping):
        return spaces.Dict({name: box(name, x) for name, x in obs.items()})
    return box("state", obs)


def action_space_of(env: InteractiveNav) -> spaces.Box:
    """Return [-1, 1], one per actuator."""
    return spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)


def _key(rng: np.random.Generator) -> np.ndarray:
    """Draw a (2,) u32 key from a generator."""
    return rng.integers(0, 2**32, size=2, dtype=np.uint32)


def _check_options(options: dict[str, Any] | None, allowed: Sequence[str]) -> dict[str, Any]:
    unknown = [name for name in options or {} if name not in allowed]
    if unknown:
        raise ConfigError(f"reset option {unknown[0]!r} is unknown; known options: {', '.join(allowed)}")
    return options or {}


def _to_numpy(tree: Any) -> Any:
    """Return copies that the caller owns: what JAX hands out is read-only."""
    return jax.tree.map(np.array, tree)


class InteractiveNavVectorEnv(VectorEnv):
    """N environments stepped by one compiled program.

    `autoreset_mode` says what follows an episode's end (https://farama.org/Vector-Autoreset-Mode):
    SAME_STEP (default): the same `step` returns the new episode's observation, the old one's last is in
    `info["final_obs"]` and its scores are in `info["final_info"]`; NEXT_STEP: the next `step` ignores
    the action and resets; DISABLED: `reset(options={"reset_mask": ended})` does.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}
    _state: Any = None
    slots: jax.Array | None = None
    """Numbers [N] of the environments, with `scene_choice="slot"`; None: 0 to N - 1."""

    def __init__(
        self,
        robot: str,
        scenes: Sequence[str] = SCENES,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        **settings: Any,
    ):
        """Build it from what `interactive_nav.make` takes; raise `ConfigError` as it does, or for another choice.

        Values of `autoreset_mode` are "SameStep", "NextStep" and "Disabled". With render_mode="rgb_array", `render`
        returns a third-person view of each environment.
        """
        if num_envs < 1:
            raise ConfigError(f"num_envs is {num_envs}, expected at least 1")
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ConfigError(f"render_mode is {render_mode!r}, expected one of {', '.join(modes)} or none")
        self.num_envs, self.autoreset_mode, self.render_mode = num_envs, AutoresetMode(autoreset_mode), render_mode
        self.env = interactive_nav.make(robot, scenes, **settings)
        self._camera = ThirdPerson(self.env)
        rate = round(1.0 / self.env.dt)
        self.metadata = {**self.metadata, "render_fps": rate, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = observation_space_of(self.env)
        self.single_action_space = action_space_of(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset = jax.jit(functools.partial(reset_all, self.env))
        self._reset_to = jax.jit(jax.vmap(self.env.reset_to))
        self._reset_where = jax.jit(functools.partial(reset_where, self.env))
        self._step = jax.jit(functools.partial(step_all, self.env, self.autoreset_mode.name))
        self._ended = jnp.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Draw an episode for each environment, or for some of them; raise `ConfigError` for unusable options.

        Args:
            seed: s gives environment i the seed s + i; or a list with one (or None) each. None: each goes on.
            options: `reset_mask` [N] bool: only these; `start`: an `EpisodeStart` with leaves [N, ...] to play.
        """
        _refuse_fork()
        seed = int(seed) if isinstance(seed, np.integer) else seed
        super().reset(seed=seed if isinstance(seed, int) else None)
        given = _check_options(options, ("reset_mask", "start"))
        if "reset_mask" in given and ("start" in given or self._state is None):
            raise ConfigError("reset option 'reset_mask' excludes 'start' and needs an earlier reset without it")
        keys = self._keys(seed)
        if "reset_mask" in given:
            mask = np.asarray(given["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise ConfigError(
                    f"reset_mask is {mask.dtype} of shape {mask.shape} with {np.count_nonzero(mask)} set, "
                    f"expected bool of shape ({self.num_envs},) with at least one set"
                )
            self._state = self._reset_where(self._state, keys, mask)
            self._ended = self._ended & ~mask
        else:
            self._state = self._reset_to(given["start"], keys) if "start" in given else self._reset(keys, self.slots)
            self._ended = jnp.zeros(self.num_envs, bool)
        return _to_numpy(self._state.obs), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance by one control period; see the class for what follows an episode's end."""
        _refuse_fork()
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step was called before reset")
        if self.autoreset_mode is AutoresetMode.DISABLED and bool(self._ended.any()):
            raise gymnasium.error.ResetNeeded(
                f"episodes of environments {np.flatnonzero(self._ended).tolist()} are over: "
                "reset(options={'reset_mask': terminated | truncated})"
            )
        self._state, was_over, stepped = self._step(self._state, jnp.asarray(actions, jnp.float32), self._ended)
        obs, reward, terminated, truncated, metrics = stepped
        self._ended = terminated | truncated
        info = self._info(obs, metrics, was_over)
        now = self._state.obs if self.autoreset_mode is AutoresetMode.SAME_STEP else obs
        return (*_to_numpy((now, reward, terminated, truncated)), info)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a third-person view of each environment; None without a render mode."""
        rendered = self.render_mode is not None and self._state is not None
        return self._camera.frames(self._state) if rendered else None

    def _keys(self, seed: int | Sequence[int | None] | None) -> jax.Array:
        n = self.num_envs
        seeds = list(range(seed, seed + n)) if isinstance(seed, int) else [None] * n if seed is None else list(seed)
        if len(seeds) != n:
            raise ConfigError(f"seed has {len(seeds)} entries, expected one for each of {n} environments")
        if self._state is not None:
            keys = np.array(self._state.info["rng"])
        else:
            keys = np.stack([_key(self.np_random) for _ in range(n)])
        for i, given in enumerate(seeds):
            if given is not None:
                keys[i] = _key(seeding.np_random(int(given))[0])
        return jnp.asarray(keys)

    def _info(self, obs: Any, metrics: dict[str, jax.Array], was_over: jax.Array) -> dict[str, Any]:
        """Return values with their masks `_name`, in the places where `SyncVectorEnv` has them."""
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        steps = (*self.env.reward_names, NONFINITE_ACTIONS)
        ended = np.array(self._ended)
        running = ~ended if same_step else ~np.array(was_over)
        info = _masked({name: metrics[name] for name in steps}, running)
        if not ended.any():
            return info
        scores = {name: metrics[name] for name in self.env.metric_names}
        if not same_step:
            return info | _masked(scores, ended)
        rows = _to_numpy(obs)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            final_obs[i] = jax.tree.map(lambda x, i=i: x[i].copy(), rows)
        final_info = _masked({name: metrics[name] for name in (*steps, *self.env.metric_names)}, ended)
        masks = {"_final_obs": ended, "_final_info": ended.copy()}
        return {**info, "final_obs": final_obs, "final_info": final_info, **masks}


class InteractiveNavEnv(gymnasium.Env):
    """One environment: a batch of one, whose values have no batch axis.

    Observations and actions are those of `interactive_nav.InteractiveNav`.
    `terminated` on success or a state that is no longer finite, `truncated` at the time limit.
    `info` holds the step's reward terms (`reward/...`), how many entries of the action were not finite and counted as
    0 (`nonfinite_actions`) and, on an episode's last step, its scores
    (`env.metric_names`: success, path_efficiency, effort_efficiency, ins_0.5, ...).
    `reset(options={"start": EpisodeStart})` plays a given episode.
    """

    metadata = InteractiveNavVectorEnv.metadata

    def __init__(
        self,
        robot: str,
        scenes: Sequence[str] = SCENES,
        render_mode: str | None = None,
        slot: int | None = None,
        **settings: Any,
    ):
        """Build it as `InteractiveNavVectorEnv`.

        With `scene_choice="slot"`, and only then, `slot` is its number in a batch, which decides its scene.
        """
        self.render_mode = render_mode
        if not (_forked() and _SPACES):  # Gymnasium's worker passes on what its first `reset` raises, nothing from here
            _refuse_fork()
            self.batch = InteractiveNavVectorEnv(robot, scenes, 1, AutoresetMode.DISABLED, render_mode, **settings)
            self.env, self.batch.slots = self.batch.env, _checked_slot(self.batch.env, slot)
            self.metadata = {**self.metadata, "render_fps": self.batch.metadata["render_fps"]}
            _SPACES[:] = self.batch.single_observation_space, self.batch.single_action_space
        self.observation_space, self.action_space = _SPACES  # pyright: ignore[reportAttributeAccessIssue]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw an episode, with a seed always the same ones from here on; an unknown option raises `ConfigError`."""
        _refuse_fork()
        super().reset(seed=seed)
        given = jax.tree.map(lambda x: jnp.asarray(x)[None], _check_options(options, ("start",)))
        obs, info = self.batch.reset(seed=seed, options=given)
        return _first(obs), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one control period; raise `gymnasium.error.ResetNeeded` before `reset` and after an end."""
        obs, *values, info = self.batch.step(np.asarray(action, np.float32)[None])
        reward, terminated, truncated = (value[0].item() for value in values)
        info = {name: float(value[0]) for name, value in info.items() if not name.startswith("_")}
        return _first(obs), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a (rows, columns, 3) u8 third-person view of the present state; None without a render mode."""
        frames = self.batch.render()
        return frames[0] if frames else None


def _first(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[0], tree)


def _masked(values: Mapping[str, jax.Array], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Return name -> values, 0 outside the mask, and _name -> mask; nothing where the mask is empty."""
    if not mask.any():
        return {}
    out = {}
    for name, value in values.items():
        out[name], out[f"_{name}"] = np.where(mask, np.asarray(value, np.float64), 0.0), mask.copy()
    return out


def _checked_slot(env: InteractiveNav, slot: int | None) -> jax.Array:
    """Return the number [1] that a single environment has in a batch."""
    chosen, count = env.config.scene_choice == "slot", len(env.scenes)
    if slot is not None and (not chosen or slot < 0):
        got = f"slot is {slot} with scene_choice={env.config.scene_choice!r}"
        raise ConfigError(f"{got}, expected 0 or more, with 'slot'")
    if chosen and slot is None and count > 1:
        raise ConfigError(
            f"scene_choice is 'slot' for one environment of {count} scenes, expected its number in a batch: give "
            "slot=I, make a batch (gymnasium.make_vec), or set scene_choice='episode'"
        )
    return jnp.asarray([slot or 0], jnp.int32)


register_envs()
