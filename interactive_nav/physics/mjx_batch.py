"""MuJoCo MJX, both of its implementations: `warp` (NVIDIA) and `jax` (any XLA device).

Scenes differ only in model fields, which are stacked once as [scene, ...] tables; each environment takes
its scene's rows. The engine's data is rebuilt from a template at every control step, so only
`PhysicsState` is carried.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from interactive_nav.physics.base import Physics, PhysicsState, StepSignals, summarise_forces
from interactive_nav.robots.spec import RobotState
from interactive_nav.world import World

# Fields that only C MuJoCo reads, or that MJX derives again.
_UNUSED_BY_MJX = {
    "bvh_aabb",
    "dof_M0",
    "dof_length",
    "body_sameframe",
    "geom_sameframe",
    "body_simple",
    "dof_simplenum",
    "bvh_nodeid",
    "bvh_child",
    "bvh_depth",
}
BATCHABLE = frozenset(
    {
        *("geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb", "geom_friction"),
        *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat"),
        *("body_subtreemass", "body_invweight0", "body_gravcomp"),
        *("dof_invweight0", "dof_damping", "dof_frictionloss"),
        *("jnt_axis", "jnt_pos", "jnt_range", "qpos0", "qpos_spring"),
    }
)
"""Model fields that may differ between scenes under one compiled program."""


def differing_fields(models: tuple[mujoco.MjModel, ...]) -> tuple[str, ...]:
    """Names of model arrays that differ between models of equal structure.

    Raises:
        ValueError: two models differ in shape, or in a field that cannot be batched.
    """
    first, names = models[0], []
    for name in dir(first):
        value = None if name.startswith("_") else getattr(first, name, None)
        if not isinstance(value, np.ndarray) or name in _UNUSED_BY_MJX:
            continue
        others = [getattr(m, name) for m in models[1:]]
        if any(o.shape != value.shape for o in others):
            raise ValueError(f"model field {name} has shapes {[value.shape, *[o.shape for o in others]]}, expected one")
        if any(not np.array_equal(o, value) for o in others):
            if name not in BATCHABLE:
                raise ValueError(f"model field {name} differs between scenes, but MJX cannot batch it")
            names.append(name)
    return tuple(names)


class MjxPhysics(Physics):
    """Steps a batch with `mjx.step` under vmap."""

    def __init__(self, world: World, substeps: int, impl: str, contacts_per_env: int, constraints_per_env: int):
        self.name = impl
        self._world, self._substeps = world, substeps
        self.contacts_per_env, self.constraints_per_env = contacts_per_env, constraints_per_env
        host = world.models[0]
        self.nq, self.nv = host.nq, host.nv
        if impl == "jax":
            # MJX-JAX has no contact sensors between bodies: forces are summed from its contacts instead.
            host = _without_sensors(world.specs[0])
        self._host = host
        self._model = mjx.put_model(host, impl=impl)
        if impl == "warp":
            # Warp prints a line per overflow or unconverged solve: ours are counted instead.
            self._model = self._model.tree_replace({"opt._impl.warn_overflow": 0})
        self._fields = differing_fields(world.models)
        self._tables = {
            name: jnp.asarray(np.stack([np.asarray(getattr(m, name), np.float32) for m in world.models])).reshape(
                (len(world.models), *getattr(self._model, name).shape)
            )
            for name in self._fields
        }
        # Warp computes the world poses of static geoms (walls) once, in make_data, from the one model that it
        # is given: with several scenes each environment needs its own scene's.
        self._static_pose = _geom_poses(world.models) if impl == "warp" and len(world.models) > 1 else None
        self._sensors = world.layout.force_sensors[:, None] + np.arange(3)
        self._slot_of_geom = _slot_of_geom(world, host)

    def step_batch(self, scene, state, command, time_s):
        n = scene.shape[0]
        if self.name == "warp":
            template = mjx.make_data(
                self._host, impl="warp", naconmax=n * self.contacts_per_env, njmax=self.constraints_per_env
            )
        else:
            template = mjx.make_data(self._host, impl="jax")

        def control(data, command, time_s):
            layout = self._world.layout
            robot = RobotState(
                data.qpos[layout.robot_qpos : layout.robot_qpos + layout.robot_nq],
                data.qvel[layout.robot_qvel : layout.robot_qvel + layout.robot_nv],
                time_s,
            )
            ctrl = self._world.robot.controls(command, robot, jnp)
            return data.replace(ctrl=jnp.asarray(ctrl, jnp.float32))

        every = self._world.robot.control_every_substep
        dt = self._host.opt.timestep

        def one(scene, state: PhysicsState, command, time_s):
            model = self._model.replace(**{k: table[scene] for k, table in self._tables.items()})
            data = template.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart)
            data = control(data, command, time_s)
            if self._static_pose is not None:
                xpos, xmat = self._static_pose
                data = data.replace(geom_xpos=xpos[scene], geom_xmat=xmat[scene])
            if self.name == "jax":

                def substep(data, k):
                    if every:
                        data = control(data, command, time_s + k * dt)
                    data = mjx.step(model, data)
                    return data, self._forces_from_contacts(data)

                data, forces = jax.lax.scan(substep, data, jnp.arange(self._substeps))
                overflow = jnp.asarray(0, jnp.int32)
            else:
                # Unrolled: Warp's data mixes arrays with and without an environment axis, which a scan's
                # carry cannot.
                collected, overflow = [], jnp.asarray(0, jnp.int32)
                for k in range(self._substeps):
                    if every and k:
                        data = control(data, command, time_s + k * dt)
                    data = mjx.step(model, data)
                    collected.append(data.sensordata[self._sensors])
                    overflow |= self._overflowed(data)
                forces = jnp.stack(collected)
            return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), forces, overflow

        new, forces, overflow = jax.vmap(one)(scene, state, command, time_s)
        force_n, slot_n, structure_n = summarise_forces(forces)
        finite = jnp.isfinite(new.qpos).all(-1) & jnp.isfinite(new.qvel).all(-1)
        return new, StepSignals(
            force_n=force_n,
            slot_force_n=slot_n,
            structure_force_n=structure_n,
            overflow=overflow,
            nonfinite=(~finite).astype(jnp.int32),
        )

    def _overflowed(self, data) -> jax.Array:
        from mujoco.mjx.third_party.mujoco_warp._src.types import OverflowType

        dropped = int(
            OverflowType.NEFC
            | OverflowType.NJMAX_NNZ
            | OverflowType.BROADPHASE
            | OverflowType.NARROWPHASE
            | OverflowType.CCD
            | OverflowType.CONTACT_MATCH
        )
        return ((data._impl.overflow & dropped) != 0).astype(jnp.int32)

    def _forces_from_contacts(self, data) -> jax.Array:
        """[M + 1, 3] net force of the robot on each slot and the structure, world frame, from MJX-JAX's contacts."""
        contact, efc = data._impl.contact, data._impl.efc_force
        out = jnp.zeros((len(self._sensors), 3))
        dims, address = np.asarray(contact.dim), np.asarray(contact.efc_address)
        slot = jnp.asarray(self._slot_of_geom)
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
        return out


def _geom_poses(models: tuple[mujoco.MjModel, ...]) -> tuple[jax.Array, jax.Array]:
    """World poses of all geoms at `qpos0`, per scene: positions [S, ngeom, 3] and matrices [S, ngeom, 3, 3]."""
    positions, matrices = [], []
    for model in models:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        positions.append(data.geom_xpos.copy())
        matrices.append(data.geom_xmat.reshape(-1, 3, 3).copy())
    return jnp.asarray(np.stack(positions), jnp.float32), jnp.asarray(np.stack(matrices), jnp.float32)


_ROBOT = -2


def _slot_of_geom(world: World, model: mujoco.MjModel) -> np.ndarray:
    """[ngeom] movable slot of each geom; M for the structure, `_ROBOT` for the robot, -1 for the floor."""
    layout = world.layout
    slot_of_body = np.full(model.nbody, -1)
    slot_of_body[layout.slot_body] = np.arange(layout.num_slots)
    slot_of_body[layout.structure_body] = layout.num_slots
    slot_of_body[layout.robot_bodies] = _ROBOT
    return slot_of_body[model.geom_bodyid]


def _without_sensors(spec: mujoco.MjSpec) -> mujoco.MjModel:
    spec = spec.copy()
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    return spec.compile()


def measure_buffers(world: World, head_room: float = 1.6) -> tuple[int, int]:
    """Contact slots and constraint rows per environment that the scenes need, measured at rest.

    The small objects are laid out on the floor, everything else rests; `head_room` leaves place for a
    robot that pushes objects into each other. What overflows all the same is counted in the metrics.

    Returns:
        (contacts, constraint rows) per environment.
    """
    contacts = rows = 0
    for model, qpos in zip(world.models, world.rest_qpos, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        contacts, rows = max(contacts, data.ncon), max(rows, data.nefc)
    extra = 24
    contacts, rows = int(contacts * head_room) + extra, int(rows * head_room) + 4 * extra
    return contacts, -(-rows // 16) * 16
