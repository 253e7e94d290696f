"""Connect learners: batch an environment whose finished episodes are followed by newly drawn ones.

Brax's auto-reset returns each environment's first state again, so an environment would repeat one
episode for ever, and what the task keeps in `info` would leak into it.

    env = ShardedEnv(AutoResetEnv(interactive_nav.make(...)))       # all devices, of all processes
    state = jax.jit(env.reset)(jax.random.split(key, num_envs))     # leaves are sharded along their first axis

Environments are independent: devices exchange nothing in `reset` and `step`. Of several machines or processes, each
calls `start_distributed` before anything else uses JAX.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.tree_util import tree_leaves_with_path

from interactive_nav.task.curriculum import Curriculum
from interactive_nav.task.env import InteractiveNav
from interactive_nav_common.errors import ConfigError

AXIS = "i"
"""Name of the mesh's axis, as in Brax."""
NONFINITE_ACTIONS = "nonfinite_actions"
"""Entries of a step's action that are no finite number; the environment takes 0 for them."""
DRAW_SHARE = 16
"""New episodes are drawn for this fraction of the batch at a time."""


def reset_all(env: InteractiveNav, keys: jax.Array, slot: jax.Array | None = None, **limit: jax.Array) -> State:
    """Return N new episodes of [N, 2] keys, consumed, each in the scene that its environment keeps, if any.

    `slot` [N] i32 numbers environments of a part of a larger batch; None: 0 to N - 1. `limit` may hold `limit_m` [N].
    """
    slot = jnp.arange(keys.shape[0]) if slot is None else slot
    kept = (slot % len(env.scenes),) if env.config.scene_choice == "slot" else ()
    return jax.vmap(env.observe)(jax.vmap(env.draw)(keys, *kept, **limit))


def draw_where(env: InteractiveNav, current: tuple, over: jax.Array, **limit: jax.Array) -> tuple:
    """Return physics, `nav` and `rng` of N environments with new episodes where `over` [N], whose `rng` is consumed.

    They are drawn in small groups, as few end in one step. Environments may keep their scene. `limit` is as above.
    """
    n = over.shape[0]
    share = max(1, n // DRAW_SHARE)

    def some(carry):
        current, pending = carry
        index = jnp.nonzero(pending, size=share, fill_value=n)[0]
        nav, rng, near = jax.tree.map(lambda x: x[jnp.minimum(index, n - 1)], (*current[-2:], limit))
        kept = (nav.scene_index,) if env.config.scene_choice == "slot" else ()
        fresh = jax.vmap(env.draw)(rng, *kept, **near)
        new = (fresh.pipeline_state, fresh.info["nav"], fresh.info["rng"])
        current = jax.tree.map(lambda old, x: old.at[index].set(x, mode="drop"), current, new)
        return current, pending.at[index].set(False, mode="drop")

    return jax.lax.while_loop(lambda carry: carry[1].any(), some, (current, over))[0]


def where_rows(mask: jax.Array, new: Any, old: Any) -> Any:
    """Return `new` where `mask` [N], else `old`: pytrees of [N, ...]."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def reset_where(env: InteractiveNav, state: Any, keys: jax.Array, mask: jax.Array) -> Any:
    """Start new episodes where `mask`."""
    info = state.info
    physics, nav, rng = draw_where(env, (state.pipeline_state, info["nav"], where_rows(mask, keys, info["rng"])), mask)
    of_step = (state.reward, state.done, state.metrics, info["truncation"], info["time_out"])
    reward, done, metrics, truncation, time_out = jax.tree.map(lambda x: jnp.where(mask, 0.0, x), of_step)
    info = {**info, "nav": nav, "rng": rng, "truncation": truncation, "time_out": time_out}
    new = state.replace(pipeline_state=physics, reward=reward, done=done, metrics=metrics, info=info)
    new = jax.vmap(env.observe)(new)
    return new.replace(obs=where_rows(mask, new.obs, state.obs))


def step_all(
    env: InteractiveNav, mode: str, state: Any, actions: jax.Array, ended: jax.Array
) -> tuple[Any, jax.Array, tuple[Any, ...]]:
    """Return the state after a step and, where Gymnasium's mode has it, a reset; which episodes were over before, so
    that nothing but a reset was done; and observation, reward, terminated, truncated and metrics."""
    stepped = new = jax.vmap(env.step)(state, actions)
    same = mode == "SAME_STEP"
    if mode != "DISABLED":
        due, keys = (stepped.done > 0, stepped.info["rng"]) if same else (ended, state.info["rng"])
        new = jax.lax.cond(due.any(), lambda s: reset_where(env, s, keys, due), lambda s: s, stepped)
    reported = new if mode == "NEXT_STEP" else stepped
    truncated = reported.info["truncation"] > 0
    over = ended if mode == "NEXT_STEP" else jnp.zeros_like(ended)
    metrics = {**reported.metrics, NONFINITE_ACTIONS: (~jnp.isfinite(actions)).sum(-1).astype(jnp.float32)}
    return new, over, (reported.obs, reported.reward, (reported.done > 0) & ~truncated, truncated, metrics)


def wrap_for_brax_training(
    env: Any, episode_length: int | None = None, action_repeat: int = 1, randomization_fn: Any = None
) -> "AutoResetEnv":
    """Wrap an environment as Brax's learners' `wrap_env_fn`, as MuJoCo Playground has it: every episode is newly drawn.

    `episode_length` is at least the environment's `episode_steps`, which ends its episodes. On backend `jax`,
    `randomization_fn` maps `env.physics.mjx_model` to it with N values of some fields, of which environment i keeps
    number i, and axes: 0 for these, else None. Rows of objects and walls stay the scenes'. For the rest, and errors,
    see `AutoResetEnv`.
    """
    steps = env.config.episode_steps
    if episode_length is not None and episode_length < steps:
        raise ConfigError(
            f"episode_length is {episode_length}, expected at least the environment's {steps}: "
            f"make it with episode_steps={episode_length}"
        )
    wrapped = AutoResetEnv(env, action_repeat)
    if randomization_fn is not None:
        wrapped.models = _varied_fields(env.unwrapped, randomization_fn)
    return wrapped


def _varied_fields(env: InteractiveNav, randomization_fn: Callable[[Any], tuple[Any, Any]]) -> dict[str, jax.Array]:
    """Return dotted name -> [N, ...] of the fields of MJX's model that Playground's `randomization_fn` varies."""
    if env.backend != "jax":
        raise ConfigError(
            f"randomization_fn is given with backend='{env.backend}', expected backend='jax'; or use the settings "
            "random_mass, random_friction and their like, which every backend takes"
        )
    models, axes = randomization_fn(env.physics.mjx_model)  # pyright: ignore[reportAttributeAccessIssue]
    at = {jax.tree_util.keystr(path, simple=True, separator="."): axis for path, axis in tree_leaves_with_path(axes)}
    if not at or set(at.values()) != {0}:
        raise ConfigError(f"randomization_fn varies axes {at}, expected axis 0 of one or more fields, else None")
    return {name: operator.attrgetter(name)(models) for name in at}


def _refuse_passed_over(env: Any) -> None:
    """Refuse wrappers whose `step` or `reset` is never called: a batch calls their finer parts."""
    while isinstance(env, Wrapper):
        bases = type(env).__mro__[: type(env).__mro__.index(Wrapper)]
        changed = {name for base in bases for name in vars(base)} & {"reset", "step", "draw", "advance", "observe"}
        for name, part in (("step", "advance"), ("reset", "draw")):
            if name in changed and not changed & {part, "observe"}:
                raise ConfigError(
                    f"{type(env).__name__} overrides `{name}`, which a batch that resets itself never calls; expected "
                    f"`{part}` (the {name} without its observation) or `observe`: override that too"
                )
        env = env.env


class AutoResetEnv(Wrapper):
    """N environments as one natively batched Brax environment (`wrap_env=False` for Brax's learners).

    `reward`, `done`, `info["truncation"]`, `info["time_out"]` and `metrics` belong to the last step;
    where an episode ended, `obs`, `pipeline_state` and `info["nav"]` are those of a new one. `info` also has
    `steps` [N] (of the episode that the step belongs to), `episode_done` [N] and `episode_metrics`: name ->
    [N], the scores of the last finished episode, with `length` and `sum_reward`. With `final_obs`, that is the
    observation after the step, of the old episode where it ended.
    """

    env: InteractiveNav

    curriculum: tuple[float, float, float] | None = None
    """First limit and last, and the success needed: see `Curriculum`, which `info["curriculum"]` then is. The score
    `curriculum_m` is the limit that an episode was drawn under."""

    def __init__(self, env: Any, action_repeat: int = 1, final_obs: bool = False):
        """Wrap an environment of one episode, or a wrapper of it.

        An action is held for `action_repeat` control steps, whose rewards are summed. With `final_obs`, every step
        observes twice. A wrapper that overrides `step` or `reset` alone would never be called, which is a
        `ConfigError`: their parts `draw`, `advance` and `observe` are.
        """
        super().__init__(env)
        _refuse_passed_over(env)
        self.action_repeat, self.final_obs = action_repeat, final_obs
        self.models: dict[str, jax.Array] = {}

    def reset(self, rng: jax.Array, slot: jax.Array | None = None) -> State:
        """Return N states for [N, 2] keys; `slot` as in `reset_all`."""
        zero, course, limit = jnp.zeros(rng.shape[0]), {}, {}
        scores = [*self.env.metric_names, "length", "sum_reward"]
        if self.curriculum:
            first, scores = zero + self.curriculum[0], [*scores, "curriculum_m"]
            course["curriculum"] = Curriculum(first, first, zero, *self.curriculum[1:])  # type: ignore[call-arg]
            limit["limit_m"] = first
        state = reset_all(self.env, rng, slot, **limit)
        info = {
            **state.info,
            **course,
            "steps": zero,
            "episode_done": zero,
            "running_reward": zero,
            "episode_metrics": {name: zero for name in scores},
        }
        for name, value in self.models.items():
            if slot is None and len(value) != len(rng):
                raise ConfigError(
                    f"randomization_fn varies {len(value)} models, expected one per environment: {len(rng)}"
                )
            index = jnp.arange(len(rng)) if slot is None else slot % len(value)
            info["model"] = info.get("model", {}) | {name: jnp.asarray(value)[index]}
        return state.replace(info=info | ({"final_obs": state.obs} if self.final_obs else {}))

    def step(self, state: State, action: jax.Array) -> State:
        """Return the states that follow N states and [N, A] actions."""
        # What ended in the last step has begun anew.
        delayed = self.env.config.random_sensor_delay_steps[1] > 0  # looks at every step
        advance = jax.vmap(self.env.step if self.final_obs or delayed else self.env.advance)
        stepped = advance(state.replace(done=jnp.zeros_like(state.done)), action)
        for _ in range(self.action_repeat - 1):
            paid = stepped.reward
            stepped = advance(stepped, action)
            stepped = stepped.replace(reward=paid + stepped.reward)
        done = stepped.done > 0
        steps = stepped.info["nav"].step_count.astype(jnp.float32)
        steps = jnp.where(done, stepped.metrics["episode_steps"], steps)
        total = state.info["running_reward"] + stepped.reward
        finished = {name: stepped.metrics[name] for name in self.env.metric_names}
        finished |= {"length": steps, "sum_reward": total}
        course, limit = {}, {}
        if self.curriculum:
            finished["curriculum_m"] = state.info["curriculum"].drawn_m
            course["curriculum"] = state.info["curriculum"].after(done, finished["success"])
            limit["limit_m"] = course["curriculum"].allowed_m
        last = state.info["episode_metrics"]
        episode_metrics = {name: jnp.where(done, finished[name], last[name]) for name in last}

        moving = (stepped.pipeline_state, stepped.info["nav"], stepped.info["rng"])
        physics, nav, rng = draw_where(self.env, moving, done, **limit)
        info = {
            **stepped.info,
            **course,
            "nav": nav,
            "rng": rng,
            "steps": steps,
            "episode_done": stepped.done,
            "running_reward": jnp.where(done, 0.0, total),
            "episode_metrics": episode_metrics,
        } | ({"final_obs": stepped.obs} if self.final_obs else {})
        # Observed once, after new episodes have begun: images cost as much as physics.
        return jax.vmap(self.env.observe)(stepped.replace(pipeline_state=physics, info=info))


class ShardedEnv(Wrapper):
    """Steps equal shares of a batch on each device."""

    def __init__(self, env: Env, devices: Sequence[Any] | None = None):
        super().__init__(env)
        self.mesh = Mesh(np.asarray(devices if devices is not None else jax.devices()), (AXIS,))
        spec = PartitionSpec(AXIS)
        self.sharding, self.replicated = NamedSharding(self.mesh, spec), NamedSharding(self.mesh, PartitionSpec())
        self._reset = jax.shard_map(env.reset, mesh=self.mesh, in_specs=(spec, spec), out_specs=spec, check_vma=False)
        self._step = jax.shard_map(env.step, mesh=self.mesh, in_specs=(spec, spec), out_specs=spec, check_vma=False)

    @property
    def num_devices(self) -> int:
        return self.mesh.size

    def reset(self, rng: jax.Array) -> State:
        """Return N states for [N, 2] keys; raise `ConfigError` unless N is a multiple of the devices."""
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

    Every process runs the same script with another `process_id`; `jax.devices()` then lists all devices.
    """
    if not 0 <= process_id < num_processes:
        raise ConfigError(f"process_id is {process_id}, expected 0 to {num_processes - 1}")
    if not coordinator.rpartition(":")[2].isdigit():
        raise ConfigError(f"coordinator is {coordinator!r}, expected host:port such as 10.0.0.1:1234")
    jax.distributed.initialize(coordinator, num_processes, process_id)
