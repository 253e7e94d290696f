"""Step with both implementations of MuJoCo MJX: `warp` (NVIDIA) and `jax` (any XLA device).

Each environment fills the slots of one small model from its scene's tables (`window.py`). The engine's data is rebuilt
from a template at every control step, so only `PhysicsState` is carried. On `warp`, objects at rest sleep, as in C
MuJoCo, which saves most of the solver's cost.
"""

import abc
import copy
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from interactive_nav.config import NavConfig
from interactive_nav.physics.base import Physics, PhysicsState, StepSignals, make_scaling, summarise_forces, uncommitted
from interactive_nav.physics.hook import Hook
from interactive_nav.physics.nearness import FAR_M, Measured
from interactive_nav.physics.warp_callbacks import keep_collector_out
from interactive_nav.physics.window import PhysicsWindow
from interactive_nav.scenes.contacts import from_sensors, part_of_contacts, rolling_geoms, sensor_addresses
from interactive_nav.scenes.slots import Layout
from interactive_nav.scenes.world import World

# Bits of MJX-Warp's OverflowType: constraint rows, their non-zeros, broadphase, narrowphase, convex collider,
# contact matches; then awake degrees of freedom, and the solver's iteration limit. A test compares them.
_DROPPED = 0b1011111
_CROWDED = 1 << 7
_UNCONVERGED = 1 << 9
_AWAKE = -(1 + 10)
"""MuJoCo's `tree_asleep` of what has just moved: it counts up to -1, from where it sleeps; a sleeper has its number."""
_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
"""First of the kinds of constraint rows that are contacts'."""
CCD_PER_ENV = 32
"""Pairs of boxes per environment that Warp's convex collider has room for at once; more are counted as overflow."""


class MjxPhysics(Physics):
    """Steps a batch with `mjx.step` under vmap; what the two implementations do apart is theirs."""

    def __init__(self, world: World, config: NavConfig, window: PhysicsWindow | None = None):
        self.window = window or PhysicsWindow(world, config)
        self._world, self._substeps = world, config.substeps
        self.nv = world.models[0].nv
        self.active_dofs = self.window.model.nv
        """That can be awake at a time."""
        self.contacts_per_env, self.constraints_per_env = config.contacts_per_env, config.constraints_per_env
        self.mj_model = self._host_model()
        self.mjx_model = uncommitted(mjx.put_model(self.mj_model, impl=self.name, device=jax.local_devices()[0]))
        self._scaled = make_scaling(self.mj_model, self.window.layout)
        layout = self.window.layout
        self._sensors = layout.force_sensors[:, None] + np.arange(3)
        self._config = config
        self.hook = Hook(world, config) if config.hook_force_n else None

    def _host_model(self) -> mujoco.MjModel:
        return self.window.model

    @abc.abstractmethod
    def _template(self, n: int) -> mjx.Data:
        """Return the engine's data that each of n environments starts a control step from."""

    def _placed(self, data: mjx.Data, scene: jax.Array, walls: jax.Array) -> mjx.Data:
        """Return the data of one environment with its walls where they stand."""
        return data

    def _resting(self, data: mjx.Data, awake: jax.Array) -> mjx.Data:
        """Return the data of one environment in which only these of the window's slots are awake."""
        return data

    @abc.abstractmethod
    def _substep_all(self, model: mjx.Model, data: mjx.Data, control: Callable) -> tuple[mjx.Data, Any, jax.Array]:
        """Run all substeps of a control step of one environment; return the last data, the forces [substeps, M + 1, 3]
        on slots and structure with what `from_sensors` gives of each substep, or None, and Warp's OverflowType bits."""

    def _pulls(self, data: mjx.Data) -> jax.Array:
        """Return the hook's force on each slot and the structure, [M + 1, 3]."""
        if self.hook is None:
            return jnp.zeros((len(self._sensors), 3))
        return jnp.pad(data.xfrc_applied[self.window.layout.slot_body, :3], ((0, 1), (0, 0)))

    def _controlled(self, data: mjx.Data, command: jax.Array, time_s: jax.Array) -> mjx.Data:
        robot = self.window.layout.robot_state(data.qpos, data.qvel, time_s)
        ctrl = self._world.robot.controls(command, robot, jnp)
        return data.replace(ctrl=jnp.asarray(ctrl, jnp.float32))

    def _step_one(self, template: mjx.Data, measured: Measured, scene, state: PhysicsState, command, time_s):
        window, hook = self.window, state.hook
        if hook is not None:  # What is held comes first, and is awake.
            held = jnp.arange(len(measured[0])) == hook[0]
            measured = jnp.where(held, -FAR_M, measured[0]), *measured[1:]
        chosen, walls, missed = window.select(measured)
        fields = window.fields(scene, chosen, walls)
        if state.change is not None:
            fields = self._scaled(window.with_given(fields, state.change.fields or {}), state.change, jnp)
        given = {} if state.change is None else state.change.fields or {}
        model = self.mjx_model.tree_replace({name: given[name] for name in given.keys() - fields.keys()}).replace(
            **{name: value.reshape(getattr(self.mjx_model, name).shape) for name, value in fields.items()}
        )
        inner = window.enter(state, chosen)
        data = template.replace(qpos=inner.qpos, qvel=inner.qvel, qacc_warmstart=inner.qacc_warmstart)
        data = self._resting(self._placed(data, scene, walls), window.awake(measured, chosen))
        data = self._controlled(data, command, time_s)

        def control(data, k):
            if self._world.robot.control_every_substep:
                data = self._controlled(data, command, time_s + k * self.mj_model.opt.timestep)
            if self.hook and hook is not None:
                place = jnp.where(hook[0] < 0, -1, window.places(chosen)[hook[0].astype(jnp.int32)])
                states = data.qpos, data.qvel, data.xfrc_applied
                data = data.replace(xfrc_applied=self.hook.applied(scene, hook, window.layout, place, *states))
            return data

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
            crowded=((failures & _CROWDED) != 0).astype(jnp.int32),
            unconverged=((failures & _UNCONVERGED) != 0).astype(jnp.int32),
            nonfinite=(~finite).astype(jnp.int32),
        )


class WarpPhysics(MjxPhysics):
    """MJX-Warp: its contact sensors give the forces, and its buffers may overflow."""

    name = "warp"

    def __init__(self, world: World, config: NavConfig, window: PhysicsWindow | None = None):
        keep_collector_out()
        self._sleeps = config.sleep and config.active_dofs != 0
        super().__init__(world, config, window)
        if self._sleeps:
            self.active_dofs = min(config.active_dofs or self.window.awake_at_rest, self.active_dofs)
        self._tree_of_slot = self.mj_model.body_treeid[self.window.layout.slot_body]
        if not (self.contacts_per_env and self.constraints_per_env):
            measured = measure_buffers(world, self.window, self.active_dofs)
            self.contacts_per_env = self.contacts_per_env or measured[0]
            self.constraints_per_env = self.constraints_per_env or measured[1]
        # Warp prints a line per overflow or unconverged solve: ours are counted instead.
        self.mjx_model = self.mjx_model.tree_replace({"opt._impl.warn_overflow": 0})
        self._contacts = sensor_addresses(self.mj_model) if config.needs_contacts else None

    def _template(self, n):
        return mjx.make_data(
            self.mj_model,
            impl="warp",
            naconmax=n * self.contacts_per_env,
            naccdmax=n * min(self.contacts_per_env, CCD_PER_ENV),
            njmax=self.constraints_per_env,
            nvmax=self.active_dofs if self._sleeps else None,
        )

    def _host_model(self):
        model = super()._host_model()
        if self._sleeps:
            model = copy.copy(model)
            model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        return model

    def _resting(self, data, awake):
        # The engine counts steps at rest before it lets a body sleep, and takes more than a control step for it. What
        # touches something awake wakes up within the step; it may not move at all before that.
        if not self._sleeps:
            return data
        impl, trees = data._impl, jnp.asarray(self._tree_of_slot)
        asleep = jnp.full(self.mj_model.ntree, _AWAKE).at[trees].set(jnp.where(awake, _AWAKE, trees))
        still = asleep[jnp.asarray(self.mj_model.dof_treeid)] >= 0
        qvel, warm = (jnp.where(still, 0.0, x) for x in (data.qvel, data.qacc_warmstart))
        new: dict[str, Any] = {
            "_impl.tree_asleep": asleep.astype(impl.tree_asleep.dtype),
            "_impl.tree_awake": (asleep < 0).astype(impl.tree_awake.dtype),
        }
        return data.replace(qvel=qvel, qacc_warmstart=warm).tree_replace(new)

    def _placed(self, data, scene, walls):
        # Warp computes the world poses of static geoms (walls) once, in make_data, from the one model
        # that it is given: each environment needs a separate one.
        xpos, xmat = self.window.static_poses(scene, walls)
        return data.replace(geom_xpos=xpos, geom_xmat=xmat)

    def _substep_all(self, model, data, control):
        # Unrolled: Warp's data mixes arrays with and without an environment axis, which a scan's carry cannot.
        collected, listed, failures = [], [], jnp.asarray(0, jnp.int32)
        for k in range(self._substeps):
            data = _engine_step(model, control(data, k) if k or self.hook else data)
            collected.append(data.sensordata[self._sensors] + self._pulls(data))
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
        self._slot_of_geom = _slot_of_geom(layout, self.mj_model)
        self._rolls = rolling_geoms(self.mj_model, world.robot, layout.robot_bodies)

    def _host_model(self):
        spec = self.window.spec.copy()
        for sensor in list(spec.sensors):
            spec.delete(sensor)
        return spec.compile()

    def _template(self, n):
        return mjx.make_data(self.mj_model, impl="jax")

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
        out = self._pulls(data)
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


def measure_buffers(world: World, window: PhysicsWindow, dofs: int, head_room: float = 1.6) -> tuple[int, int]:
    """Return contact slots and constraint rows per environment that the window needs, measured at rest.

    The small objects lie on the floor, and the window holds the bodies with the most contacts; those awake fit in
    `dofs` degrees of freedom with the robot, and sleeping ones make no contacts. `head_room` allows for pushed objects
    that touch each other. Metrics count overflows anyway.
    """
    contacts = rows = 0
    for model, qpos in zip(world.models, world.rest_qpos, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        per_body = np.bincount(model.geom_bodyid[data.contact.geom].ravel(), minlength=model.nbody)
        dims = int(data.contact.dim.max(initial=3))
        bodies = [world.layout.slot_body[g.slots] for g in window.groups]
        most = [ids[np.argsort(-per_body[ids])][: g.width] for ids, g in zip(bodies, window.groups, strict=True)]
        held = np.concatenate([ids for ids in most if len(ids)] or [np.zeros(0, int)])
        held = held[np.argsort(-per_body[held], kind="stable")]
        awake = held[np.cumsum(model.body_dofnum[held]) <= dofs - window.layout.robot_nv]
        in_window = int(per_body[awake].sum()) + int(per_body[world.layout.robot_bodies].sum())
        contacts = max(contacts, in_window)
        rows = max(rows, in_window * max(2 * (dims - 1), 1) + (data.nefc - data.ne - (data.efc_type >= _CONTACT).sum()))
    extra = 24
    contacts, rows = int(contacts * head_room) + extra, int(rows * head_room) + 4 * extra
    return contacts, -(-rows // 16) * 16
