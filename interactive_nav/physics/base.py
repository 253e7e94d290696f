"""Define the interface of physics backends: step batched states by commands and return contact signals.

The carried state is small and the same on every backend (`qpos`, `qvel`, the solver's warm start), so resets are
`jnp.where` and checkpoints are portable.
"""

import abc
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import custom_batching

from interactive_nav.config import TaskRules
from interactive_nav.scenes.slots import Layout
from interactive_nav.scenes.world import FLOOR_FRICTION


def _many(batch: Callable[..., Any], args: tuple) -> Any:
    @custom_batching.custom_vmap
    def many(*args):
        return batch(*args)

    @many.def_vmap
    def rule(axis_size, in_batched, *args):
        args = jax.tree.map(
            lambda x, batched: x if batched else jnp.broadcast_to(x, (axis_size, *x.shape)), args, tuple(in_batched)
        )
        inner = jax.tree.leaves(args)[0].shape[1]
        out = _many(batch, jax.tree.map(lambda x: x.reshape((axis_size * inner, *x.shape[2:])), args))
        out = jax.tree.map(lambda x: x.reshape((axis_size, inner, *x.shape[1:])), out)
        return out, jax.tree.map(lambda _: True, out)

    return many(*args)


def one_of_batch(batch: Callable[..., Any], args: tuple) -> Any:
    """Return a batch function's result for one element; vmaps of it call the batch function once, with all elements."""
    return jax.tree.map(lambda x: x[0], _many(batch, jax.tree.map(lambda x: x[None], args)))


TOUCH_FORCE_N = 1e-4
"""A body counts as touched when the robot's net force on it exceeds this in any substep."""


@flax.struct.dataclass
class ModelChange:
    """How an environment's model differs from its scene's: [] f32 factors of the mass and friction of all movable
    objects; for MJX-JAX dotted names of fields -> values, for all rows but those that scenes fill. None: not."""

    mass_scale: Any
    friction_scale: Any
    fields: Any = None


@flax.struct.dataclass
class PhysicsState:
    """State of one environment's physics: JAX or NumPy arrays, with leading batch axes as the caller has them."""

    qpos: Any
    """[nq] f32."""
    qvel: Any
    """[nv] f32."""
    qacc_warmstart: Any
    """[nv] f32."""
    control_steps: Any = None
    """[] i32 since the episode began: the environment's clock, which backends leave out."""
    change: ModelChange | None = None
    """Of the model, for the next control step, which backends leave out too."""
    hook: Any = None
    """[8] f32, laid out as `hook.NONE`; None without a hook."""


@flax.struct.dataclass
class StepSignals:
    """What one control step did; M movable slots."""

    force_n: Any
    """[] f32: F_t, N: mean over substeps of the norm of the robot's summed contact force on all but the floor, or
    what the options `force_part` and `force_sum` make of it."""
    slot_force_n: Any
    """[M] f32: largest norm over substeps of the net force on each slot's body, N."""
    structure_force_n: Any
    """[] f32: the same for walls and other fixed structure, N."""
    body_force_n: Any
    """[] f32: largest summed normal force over substeps of all but wheels and casters on all but the floor, N; 0
    unless an option looks at single contacts."""
    overflow: Any
    """[] i32: 1 if a contact, constraint or broadphase buffer overflowed in any substep: contacts were dropped."""
    left_out: Any
    """[] i32: 1 if an object within the robot's reach was not simulated, because MJX's window was full."""
    unconverged: Any
    """[] i32: 1 if the solver met its iteration limit in any substep."""
    crowded: Any
    """[] i32: 1 if more degrees of freedom were awake in any substep than there was room for: some went unsolved."""
    nonfinite: Any
    """[] i32: 1 if the new state is not finite or the engine gave up on it."""


class Physics(abc.ABC):
    """A backend: steps N environments at once by `substeps` physics steps."""

    name: str
    nv: int
    reports_convergence = True
    """Whether `StepSignals.unconverged` is reported."""
    hook: Any = None
    """The robot's `Hook`, if it has one."""

    @abc.abstractmethod
    def step_batch(
        self, scene: jax.Array, state: PhysicsState, command: jax.Array, time_s: jax.Array
    ) -> tuple[PhysicsState, StepSignals]:
        """Return the states and signals, leaves [N, ...], one control period later.

        `scene` is [N] i32; `command` [N, A] f32 is held and goes through the robot's control law; `time_s` [N] f32
        counts from the start of the episode.
        """

    def step(
        self, scene: jax.Array, state: PhysicsState, command: jax.Array, time_s: jax.Array | float = 0.0
    ) -> tuple[PhysicsState, StepSignals]:
        """Step one environment as `step_batch`; under any number of `vmap`s all environments step in one call."""
        return one_of_batch(self.step_batch, (scene, state, command, jnp.asarray(time_s, jnp.float32)))


def uncommitted(tree: Any) -> Any:
    """Return the tree with its arrays on no device in particular, as constants of a sharded program must be.

    `device_put` compiles nothing, unlike `jnp.asarray`, which compiles a program for each shape.
    """
    return jax.tree.map(lambda x: jax.device_put(np.asarray(x)) if isinstance(x, jax.Array) else x, tree)


_MASS = {"body_mass": 1, "body_inertia": 1, "body_subtreemass": 1, "body_invweight0": -1, "dof_invweight0": -1}
"""Fields -> the power of the mass that they grow with. Contacts are as soft as before, and rest poses the same."""
SCALED = (*_MASS, "geom_friction", "pair_friction")


def make_scaling(model: mujoco.MjModel, layout: Layout) -> Callable[[dict, ModelChange, Any], dict[str, Any]]:
    """Return (fields, change, numpy or jax.numpy) -> fields of one environment, those in `SCALED` changed."""
    bodies = np.isin(np.arange(model.nbody), layout.slot_body)
    bodies |= bodies[model.body_parentid]  # such as its feet
    geoms = bodies[model.geom_bodyid]
    pairs = geoms[model.pair_geom1] | geoms[model.pair_geom2]
    rows = dict.fromkeys(_MASS, bodies) | {"dof_invweight0": bodies[model.dof_bodyid]}
    rows["geom_friction"], rows["pair_friction"] = (
        geoms[:, None] * (np.arange(3) < 1),
        pairs[:, None] * (np.arange(5) < 2),
    )

    def scaled(fields: dict[str, Any], change: ModelChange, xp: Any) -> dict[str, Any]:
        out = dict(fields)
        for name in fields.keys() & set(SCALED):
            scale = change.mass_scale if name in _MASS else change.friction_scale
            if scale is not None:
                value, mine = fields[name], rows[name]
                # A pair has the larger friction of its two geoms, and the floor's stays.
                least = FLOOR_FRICTION if name == "pair_friction" else 0.0
                new = xp.maximum(value * scale ** _MASS.get(name, 1), least)
                out[name] = xp.where(mine.reshape(*mine.shape, *[1] * (value.ndim - mine.ndim)), new, value)
        return out

    return scaled


PAPER_FORCE = TaskRules()
"""The paper's: everything that touches, summed as vectors."""


def summarise_forces(
    force_w: Any, xp: Any = jnp, contacts: Any = None, options: TaskRules = PAPER_FORCE
) -> dict[str, Any]:
    """Return the force fields of `StepSignals` from the contact forces of all substeps.

    `force_w` [..., substeps, M + 1, 3], N, is the net force on each slot, the structure last; `contacts` come from
    `from_sensors`, leaves [..., substeps, (3)], or are None if no option needs them.
    """
    each = xp.sqrt((force_w**2).sum(-1)).max(-2)
    vector = force_w.sum(-2) if contacts is None or options.force_part == "full" else contacts[0]
    length = xp.sqrt((vector**2).sum(-1))
    if contacts is not None and options.force_sum == "contacts":
        length = contacts[1]
    force = length[..., -1] if options.force_sum == "last_substep" else length.mean(-1)
    body = xp.zeros_like(force) if contacts is None else contacts[2].max(-1)
    values = {
        "force_n": force,
        "slot_force_n": each[..., :-1],
        "structure_force_n": each[..., -1],
        "body_force_n": body,
    }
    return {name: value.astype(np.float32) for name, value in values.items()}
