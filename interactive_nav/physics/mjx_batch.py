"""Step with both implementations of MuJoCo MJX: `warp` (NVIDIA) and `jax` (any XLA device).

Environments differ only in model fields: each fills the slots of one small model from its scene's tables
(`window.py`). The engine's data is rebuilt from a template at every control step, so only `PhysicsState` is carried.
A step costs as the degrees of freedom of its model do, and most environments need few: `TieredPhysics` steps each part
of a batch in the smallest window that holds it.
"""

import abc
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from interactive_nav.config import NavConfig, WindowTier, parse_window_tiers
from interactive_nav.physics.base import Physics, PhysicsState, StepSignals, summarise_forces, uncommitted
from interactive_nav.physics.nearness import Measured
from interactive_nav.physics.warp_callbacks import keep_collector_out
from interactive_nav.physics.window import PhysicsWindow
from interactive_nav.scenes.contacts import from_sensors, part_of_contacts, rolling_geoms, sensor_addresses
from interactive_nav.scenes.slots import Layout
from interactive_nav.scenes.world import World

# Bits of MJX-Warp's OverflowType: constraint rows, their non-zeros, broadphase, narrowphase, convex collider,
# contact matches; and the solver's iteration limit. A test compares them with the engine's.
_DROPPED = 0b1011111
_UNCONVERGED = 1 << 9
_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
"""First of the kinds of constraint rows that are contacts'."""
CCD_PER_ENV = 32
"""Pairs of boxes per environment that Warp's convex collider has room for at once; more are counted as overflow."""
KINDS: tuple[str, ...] = ("free", "small", "hinge", "walls")
"""Of what a `WindowTier` has room for, in its order; as many that slide as hang on hinges."""
AUTO_SHARES = (0.7, 0.2)
"""Of a batch, in measured tiers."""
HEAD_ROOM = 2.0
"""Measured tiers let this many times as many environments need more as were counted."""
LEAST_ENVS = 64
"""In smaller batches all environments have the whole window: launching kernels is what costs there."""


class MjxPhysics(Physics):
    """Steps a batch with `mjx.step` under vmap; what the two implementations do apart is theirs."""

    def __init__(self, world: World, config: NavConfig, window: PhysicsWindow | None = None):
        self.window = window or PhysicsWindow(world, config)
        self._world, self._substeps = world, config.substeps
        self.nv = world.models[0].nv
        self.contacts_per_env, self.constraints_per_env = config.contacts_per_env, config.constraints_per_env
        self._host = self._host_model()
        self._model = uncommitted(mjx.put_model(self._host, impl=self.name))
        layout = self.window.layout
        self._sensors = layout.force_sensors[:, None] + np.arange(3)
        self._config = config

    def _host_model(self) -> mujoco.MjModel:
        return self.window.model

    @abc.abstractmethod
    def _template(self, n: int) -> mjx.Data:
        """Return the engine's data that each of n environments starts a control step from."""

    def _placed(self, data: mjx.Data, scene: jax.Array, walls: jax.Array) -> mjx.Data:
        """Return the data of one environment with its walls where they stand."""
        return data

    @abc.abstractmethod
    def _substep_all(self, model: mjx.Model, data: mjx.Data, control: Callable) -> tuple[mjx.Data, Any, jax.Array]:
        """Run all substeps of a control step of one environment; return the last data, the forces [substeps, M + 1, 3]
        on slots and structure with what `from_sensors` gives of each substep, or None, and Warp's OverflowType bits."""

    def _controlled(self, data: mjx.Data, command: jax.Array, time_s: jax.Array) -> mjx.Data:
        robot = self.window.layout.robot_state(data.qpos, data.qvel, time_s)
        ctrl = self._world.robot.controls(command, robot, jnp)
        return data.replace(ctrl=jnp.asarray(ctrl, jnp.float32))

    def _step_one(self, template: mjx.Data, measured: Measured, scene, state: PhysicsState, command, time_s):
        window = self.window
        chosen, walls, missed = window.select(measured)
        fields = window.fields(scene, chosen, walls)
        model = self._model.replace(
            **{name: value.reshape(getattr(self._model, name).shape) for name, value in fields.items()}
        )
        inner = window.enter(state, chosen)
        data = template.replace(qpos=inner.qpos, qvel=inner.qvel, qacc_warmstart=inner.qacc_warmstart)
        data = self._controlled(self._placed(data, scene, walls), command, time_s)

        def control(data, k):
            if not self._world.robot.control_every_substep:
                return data
            return self._controlled(data, command, time_s + k * self._host.opt.timestep)

        data, (forces, contacts), failures = self._substep_all(model, data, control)
        out = window.leave(state, PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), chosen)
        return out, (window.spread_forces(forces, chosen), contacts), failures, missed

    def step_batch(self, scene, state, command, time_s):
        return self.step_measured(jax.vmap(self.window.measure)(scene, state), scene, state, command, time_s)

    def step_measured(
        self, measured: Measured, scene: jax.Array, state: PhysicsState, command: jax.Array, time_s: jax.Array
    ) -> tuple[PhysicsState, StepSignals]:
        """Step as `step_batch`, given what is near: leaves [N, ...]."""
        one = functools.partial(self._step_one, self._template(scene.shape[0]))
        new, (forces, contacts), failures, missed = jax.vmap(one)(measured, scene, state, command, time_s)
        finite = jnp.isfinite(new.qpos).all(-1) & jnp.isfinite(new.qvel).all(-1)
        return new, StepSignals(
            **summarise_forces(forces, jnp, contacts, self._config),
            overflow=((failures & _DROPPED) != 0).astype(jnp.int32),
            left_out=missed,
            unconverged=((failures & _UNCONVERGED) != 0).astype(jnp.int32),
            nonfinite=(~finite).astype(jnp.int32),
        )


class WarpPhysics(MjxPhysics):
    """MJX-Warp: its contact sensors give the forces, and its buffers may overflow."""

    name = "warp"

    def __init__(self, world: World, config: NavConfig, window: PhysicsWindow | None = None):
        keep_collector_out()
        super().__init__(world, config, window)
        if not (self.contacts_per_env and self.constraints_per_env):
            measured = measure_buffers(world, self.window)
            self.contacts_per_env = self.contacts_per_env or measured[0]
            self.constraints_per_env = self.constraints_per_env or measured[1]
        # Warp prints a line per overflow or unconverged solve: ours are counted instead.
        self._model = self._model.tree_replace({"opt._impl.warn_overflow": 0})
        self._contacts = sensor_addresses(self._host) if config.needs_contacts else None

    def _template(self, n):
        return mjx.make_data(
            self._host,
            impl="warp",
            naconmax=n * self.contacts_per_env,
            naccdmax=n * min(self.contacts_per_env, CCD_PER_ENV),
            njmax=self.constraints_per_env,
        )

    def _placed(self, data, scene, walls):
        # Warp computes the world poses of static geoms (walls) once, in make_data, from the one model
        # that it is given: each environment needs a separate one.
        xpos, xmat = self.window.static_poses(scene, walls)
        return data.replace(geom_xpos=xpos, geom_xmat=xmat)

    def _substep_all(self, model, data, control):
        # Unrolled: Warp's data mixes arrays with and without an environment axis, which a scan's carry cannot.
        collected, listed, failures = [], [], jnp.asarray(0, jnp.int32)
        for k in range(self._substeps):
            data = _engine_step(model, control(data, k) if k else data)
            collected.append(data.sensordata[self._sensors])
            if self._contacts is not None:
                listed.append(from_sensors(data.sensordata, self._contacts, self._config.force_part, jnp))
            failures |= data._impl.overflow
        contacts = jax.tree.map(lambda *x: jnp.stack(x), *listed) if listed else None
        return data, (jnp.stack(collected), contacts), failures


class JaxPhysics(MjxPhysics):
    """MJX-JAX: it has no contact sensors between bodies, so forces are summed from its contacts instead."""

    name = "jax"
    reports_convergence = False

    def __init__(self, world: World, config: NavConfig, window: PhysicsWindow | None = None):
        super().__init__(world, config, window)
        layout = self.window.layout
        self._slot_of_geom = _slot_of_geom(layout, self._host)
        self._rolls = rolling_geoms(self._host, world.robot, layout.robot_bodies)

    def _host_model(self):
        return _without_sensors(self.window.spec)

    def _template(self, n):
        return mjx.make_data(self._host, impl="jax")

    def _substep_all(self, model, data, control):
        def substep(data, k):
            data = _engine_step(model, control(data, k))
            return data, self._forces_from_contacts(data)

        data, forces = jax.lax.scan(substep, data, jnp.arange(self._substeps))
        # Its buffers are static, and it does not report its solver's iterations.
        return data, forces, jnp.asarray(0, jnp.int32)

    def _forces_from_contacts(self, data) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array] | None]:
        """Return from MJX-JAX's contacts the robot's net force [M + 1, 3] on each slot and the structure, world frame;
        and, where an option asks, what `from_sensors` gives on the other backends."""
        contact, efc = data._impl.contact, data._impl.efc_force
        out = jnp.zeros((len(self._sensors), 3))
        dims, address = np.asarray(contact.dim), np.asarray(contact.efc_address)
        slot, rolls = jnp.asarray(self._slot_of_geom), jnp.asarray(self._rolls)
        sums = (jnp.zeros(3), jnp.zeros(()), jnp.zeros(())) if self._config.needs_contacts else None
        for dim in np.unique(dims):
            at = np.flatnonzero((dims == dim) & (address >= 0))
            rows = efc[address[at][:, None] + np.arange(1 if dim == 1 else 2 * (dim - 1))]
            # Pyramidal cone: the normal force is the sum over the pyramid's edges, a tangential one the
            # difference of its pair of edges times the friction coefficient.
            local = rows.sum(-1)[:, None]
            if dim >= 3:
                pairs = rows.reshape(len(at), dim - 1, 2)[:, :2]
                local = jnp.concatenate([local, (pairs[..., 0] - pairs[..., 1]) * contact.friction[at, :2]], -1)
            force = jnp.einsum("nk,nkj->nj", local, contact.frame[at][:, : local.shape[1]])
            first, second = slot[contact.geom[at, 0]], slot[contact.geom[at, 1]]
            # A contact's frame points from its first geom to its second, and its force acts on the second.
            given = jnp.where((first == _ROBOT)[:, None], force, -force)
            target = jnp.where(first == _ROBOT, second, jnp.where(second == _ROBOT, first, -1))
            out = out.at[jnp.maximum(target, 0)].add(jnp.where(target[:, None] >= 0, given, 0.0))
            if sums is None:
                continue
            local = jnp.where((target >= 0)[:, None], local, 0.0)
            normal = jnp.where((first == _ROBOT)[:, None], contact.frame[at][:, 0], -contact.frame[at][:, 0])
            rolling = rolls[contact.geom[at]].any(-1)
            part = self._config.force_part
            everything = part_of_contacts(local, normal, part, jnp)
            of_body = part_of_contacts(jnp.where(rolling[:, None], 0.0, local), normal, part, jnp)
            chosen = (of_body[0], of_body[1] if part == "normal" else everything[1], of_body[2])
            sums = (sums[0] + chosen[0], sums[1] + chosen[1], sums[2] + chosen[2])
        return out, sums


_ROBOT = -2


def _slot_of_geom(layout: Layout, model: mujoco.MjModel) -> np.ndarray:
    """Return the [ngeom] movable slot of each geom; M for the structure, `_ROBOT` for the robot, -1 for the floor."""
    slot_of_body = np.full(model.nbody, -1)
    slot_of_body[layout.slot_body] = np.arange(layout.num_slots)
    slot_of_body[layout.structure_body] = layout.num_slots
    slot_of_body[layout.robot_bodies] = _ROBOT
    return slot_of_body[model.geom_bodyid]


def _engine_step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    with jax.numpy_rank_promotion("allow"):  # MJX counts on it
        return mjx.step(model, data)


def _without_sensors(spec: mujoco.MjSpec) -> mujoco.MjModel:
    spec = spec.copy()
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    return spec.compile()


def measure_buffers(world: World, window: PhysicsWindow, head_room: float = 1.6) -> tuple[int, int]:
    """Return contact slots and constraint rows per environment that the window needs, measured at rest.

    Everything rests, the small objects laid out on the floor; the window holds the bodies with the most contacts.
    `head_room` leaves place for a robot that pushes objects into each other. Metrics count what overflows anyway.
    """
    contacts = rows = 0
    for model, qpos in zip(world.models, world.rest_qpos, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        per_body = np.bincount(model.geom_bodyid[data.contact.geom].ravel(), minlength=model.nbody)
        dims = int(data.contact.dim.max(initial=3))
        slots = [np.sort(per_body[world.layout.slot_body[g.slots]])[::-1][: g.width].sum() for g in window.groups]
        in_window = int(sum(slots)) + int(per_body[world.layout.robot_bodies].sum())
        contacts = max(contacts, in_window)
        rows = max(rows, in_window * max(2 * (dims - 1), 1) + (data.nefc - data.ne - (data.efc_type >= _CONTACT).sum()))
    extra = 24
    contacts, rows = int(contacts * head_room) + extra, int(rows * head_room) + 4 * extra
    return contacts, -(-rows // 16) * 16


def tier_sizes(count: int, shares: Sequence[float] | np.ndarray) -> tuple[int, ...]:
    """Return the environments in each tier, smallest window first: `count` in all, the last has the rest, one or more.

    `count` is N, at least 1; `shares` are of all tiers but the last.
    """
    ends = [min(round(count * end), count - 1) for end in np.cumsum(shares)]
    return tuple(int(size) for size in np.diff([0, *ends, count]))


def assign(needed: jax.Array, sizes: Sequence[int]) -> tuple[jax.Array, ...]:
    """Return the environments [size] i32 of each tier, in order of what they need, equal ones in the batch's order.

    `needed` is [N] i32, the first tier that holds what the environment needs. Spare places of larger tiers go to those
    that need less; where too many need a large one, the first of them get less than they need. `sizes` are N in all.
    """
    return tuple(jnp.split(jnp.argsort(needed, stable=True), np.cumsum(sizes)[:-1]))


def propose_tiers(counts: Mapping[str, np.ndarray], shares: Sequence[float] = AUTO_SHARES) -> tuple[WindowTier, ...]:
    """Return tiers of these shares that fit the counts: each the least quantile of all kinds alike that suffices.

    `counts` are [P] of each kind of slot, and of walls; `shares` of the batch, of all tiers but the last.
    """
    counts = {**counts, "hinge": np.maximum(counts["hinge"], counts.get("slide", 0))}
    kinds = np.stack([counts[kind] for kind in KINDS])
    tiers = []
    for share, below in zip(shares, np.cumsum(shares), strict=True):
        least, widths = 1 - (1 - below) / HEAD_ROOM, kinds.max(1)
        for quantile in np.linspace(least, 1, 101):
            widths = np.quantile(kinds, quantile, axis=1, method="higher")
            if (kinds <= widths[:, None]).all(0).mean() >= least:
                break
        tiers.append(WindowTier(share, *map(int, widths)))
    return tuple(tiers)


class TieredPhysics(Physics):
    """Several engines of one backend, each with its window and its share of the batch."""

    def __init__(self, make: Callable[..., MjxPhysics], world: World, config: NavConfig):
        """Build the engines; `make` takes a world, settings and a window."""
        whole = make(world, config)
        self.name, self.nv, self.window = whole.name, whole.nv, whole.window
        self.reports_convergence = whole.reports_convergence
        words = config.windows
        proposed = propose_tiers(whole.window.needs_at_rest) if words is None else parse_window_tiers(words)
        self.shares = tuple(tier.share for tier in proposed)
        wanted = (dict(zip(KINDS, tier[1:], strict=True)) | {"slide": tier.doors} for tier in proposed)
        self.tiers = (*(make(world, config, whole.window.narrower(widths, config)) for widths in wanted), whole)

    def needed(self, counts: Mapping[str, jax.Array]) -> jax.Array:
        """Return [N] i32, the first tier that holds what each environment needs, or the last: `counts` are [N] each."""
        rooms = [tier.window.room for tier in self.tiers[:-1]]
        small = [jnp.stack([counts[kind] > width for kind, width in room.items()]).any(0) for room in rooms]
        return jnp.stack(small).sum(0)

    def step_batch(self, scene, state, command, time_s):
        if scene.shape[0] < LEAST_ENVS:
            return self.tiers[-1].step_batch(scene, state, command, time_s)
        measured = jax.vmap(self.window.measure)(scene, state)
        needed = self.needed(jax.vmap(self.window.needs)(measured))
        places = assign(needed, tier_sizes(scene.shape[0], self.shares))
        whole = (measured, scene, state, command, time_s)
        parts = [
            tier.step_measured(*jax.tree.map(lambda x, rows=rows: x[rows], whole))
            for tier, rows in zip(self.tiers, places, strict=True)
            if len(rows)
        ]
        back = jnp.argsort(jnp.concatenate(places))
        return jax.tree.map(lambda *x: jnp.concatenate(x)[back], *parts)
