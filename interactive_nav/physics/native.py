"""Step C MuJoCo on CPU threads behind `jax.pure_callback`: the default without a GPU.

Objects at rest sleep until touched. Sleep is engine state outside `PhysicsState`: it is cached beside the batch, and
dropped for environments whose incoming state is not, to the bit, the one last returned.
"""

import copy
import dataclasses
import functools
import threading
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from interactive_nav.config import NavConfig
from interactive_nav.physics import base
from interactive_nav.physics.base import Physics, PhysicsState, StepSignals, summarise_forces
from interactive_nav.physics.hook import NONE, Hook
from interactive_nav.scenes.contacts import from_sensors, sensor_addresses
from interactive_nav.scenes.slots import Slot, find_slots
from interactive_nav.scenes.world import World, build_spec

_W = mujoco.mjtWarning
_ENGINE_FAILURES = [w.value for w in (_W.mjWARN_BADQPOS, _W.mjWARN_BADQVEL, _W.mjWARN_BADQACC, _W.mjWARN_INERTIA)]
_OVERFLOWS = [_W.mjWARN_CONTACTFULL.value, _W.mjWARN_CNSTRFULL.value]


def with_feet_apart(world: World, slots: Sequence[Slot], scene: int, config: NavConfig) -> mujoco.MjModel:
    """Return a scene's model that steps bit for bit as the world's does, and faster.

    The broadphase measures every geom of colliding bodies, and most are feet. Here they are on separate bodies that
    collide with nothing, and explicit pairs let them touch the floor.
    """
    # Taking the feet out of the world's spec takes six times as long: MuJoCo lists all elements again for each.
    spec, names = build_spec(world.robot, scene, world.scenes, slots, config, feet=False), [slot.name for slot in slots]
    floor = spec.geom("floor")
    for name in names:
        legs = spec.body(name).add_body(name=f"{name}_feet", explicitinertial=True, mass=0.0, inertia=[0.0] * 3)
        for foot in [geom for geom in world.specs[scene].body(name).geoms if geom.name.startswith(f"{name}_foot_")]:
            shape = {"type": foot.type, "pos": foot.pos, "size": foot.size, "mass": 0.0}
            legs.add_geom(name=f"{foot.name}_apart", contype=0, conaffinity=0, **shape)
            # As the engine would mix them: the larger friction, and both have the same solref and solimp.
            spec.add_pair(
                geomname1=floor.name,
                geomname2=f"{foot.name}_apart",
                condim=max(floor.condim, foot.condim),
                friction=np.maximum(floor.friction, foot.friction)[[0, 0, 1, 2, 2]],
                solref=foot.solref,
                solimp=foot.solimp,
            )
    model = spec.compile()
    for name in names:
        model.body(f"{name}_feet").invweight0 = model.body(name).invweight0
    return model


class _Pool:
    """One `Batch` of a given size, and what it returned last."""

    def __init__(self, models: tuple[mujoco.MjModel, ...], size: int, threads: int, sleep: bool):
        self.batch = Batch(models[0], nsim=size, nthread=threads, persistent=sleep)
        self.scene, self.scale, self.models = np.zeros(size, np.int64), np.ones((size, 2)), [models[0]] * size
        self.qpos = np.full((size, models[0].nq), np.nan, np.float32)
        self.qvel = np.full((size, models[0].nv), np.nan, np.float32)
        self.state_qpos, self.state_qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.applied = self.batch.bind("xfrc_applied")
        self.state_warm, self.state_ctrl = self.batch.bind("qacc_warmstart"), self.batch.bind("ctrl")


class NativePhysics(Physics):
    """Steps each environment with its scene's model, in parallel threads."""

    name = "native"

    def __init__(self, world: World, config: NavConfig):
        self.nq, self.nv = world.models[0].nq, world.models[0].nv
        self._sensors = world.layout.force_sensors[:, None] + np.arange(3)
        self._config = config
        self._contacts = sensor_addresses(world.models[0]) if config.needs_contacts else None
        self._slots = world.layout.num_slots
        slots, self._robot = find_slots(world.scenes, world.small_objects), world.robot
        self._models = tuple(with_feet_apart(world, slots, scene, config) for scene in range(len(world.scenes)))
        # The feet's bodies stand between those of the slots.
        slot_body = np.array([self._models[0].body(slot.name).id for slot in slots], np.int32)
        self._layout = dataclasses.replace(world.layout, slot_body=slot_body)
        self._iterations = int(world.models[0].opt.iterations)
        for model in self._models:
            # A failed state must show, not be silently replaced by the model's default.
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
            if self._config.sleep:
                model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        self._scaled = base.make_scaling(self._models[0], self._layout)
        self.hook = Hook(world, config) if config.hook_force_n else None
        self._pools: dict[int, list[_Pool]] = {}
        self._lock = threading.Lock()

    def step_batch(self, scene, state, command, time_s):
        n = scene.shape[0]

        def shape_of(name: str) -> jax.ShapeDtypeStruct:
            shape = (n, self._slots) if name == "slot_force_n" else (n,)
            return jax.ShapeDtypeStruct(shape, jnp.float32 if name.endswith("force_n") else jnp.int32)

        qpos, qvel = (jax.ShapeDtypeStruct((n, size), jnp.float32) for size in (self.nq, self.nv))
        shapes = (
            PhysicsState(qpos, qvel, qvel),
            StepSignals(**{field.name: shape_of(field.name) for field in dataclasses.fields(StepSignals)}),
        )
        # One array: JAX takes 30 us to hand over each argument of a callback.
        columns = (state.qpos, state.qvel, state.qacc_warmstart, command, time_s[:, None], scene[:, None])
        if state.change is not None:
            scales = state.change.mass_scale, state.change.friction_scale
            columns += tuple(jnp.ones((n, 1)) if scale is None else scale[:, None] for scale in scales)
        columns = columns if state.hook is None else (state.hook, *columns)
        packed = jnp.concatenate([jnp.asarray(x, jnp.float32) for x in columns], 1)
        step = functools.partial(self._step_host, state.change is not None, state.hook is not None)
        return jax.pure_callback(step, shapes, packed, vmap_method="sequential")

    def _step_host(self, is_scaled: bool, has_hook: bool, packed):
        packed, scale, hook = np.asarray(packed), np.ones(2), None
        if has_hook:
            hook, packed = np.split(packed, [len(NONE)], 1)
        if is_scaled:
            packed, scale = packed[:, :-2], packed[:, -2:]
        qpos, qvel, warm, rest = np.split(packed, np.cumsum([self.nq, self.nv, self.nv]), 1)
        command, time_s, scene = np.nan_to_num(rest[:, :-2]), rest[:, -2], rest[:, -1].astype(np.int64)
        pool = self._take_pool(qpos)
        try:
            self._set_models(pool, scene, np.broadcast_to(scale, (len(packed), 2)))
            return self._step_pool(pool, PhysicsState(qpos, qvel, warm, hook=hook), command, time_s, scene)
        finally:
            with self._lock:
                self._pools[len(packed)].append(pool)

    def _take_pool(self, qpos: np.ndarray) -> _Pool:
        """Return a pool that nobody else is using (each JAX device calls from another thread), if possible the one that
        returned this state."""
        size = len(qpos)
        with self._lock:
            free = self._pools.setdefault(size, [])
            if free:
                equal = [np.equal(p.qpos, qpos).all(1).sum() for p in free]
                return free.pop(int(np.argmax(equal)))
        return _Pool(self._models, size, self._config.threads, self._config.sleep)

    def _set_models(self, pool: _Pool, scene: np.ndarray, scale: np.ndarray) -> None:
        """Give each environment its scene's model, or a copy with its `scale` [N, 2] of masses and friction."""
        changed = np.flatnonzero((pool.scene != scene) | (pool.scale != scale).any(1))
        for i in changed:
            pool.models[i] = model = self._models[scene[i]]
            if (scale[i] != 1.0).any():
                pool.models[i], fields = copy.copy(model), {name: getattr(model, name) for name in base.SCALED}
                for name, value in self._scaled(fields, base.ModelChange(*scale[i]), np).items():
                    getattr(pool.models[i], name)[:] = value
        if len(changed):
            pool.batch.set_models(pool.models)
            pool.qpos[changed] = np.nan
            pool.scene, pool.scale = scene.copy(), scale.copy()

    def _step_pool(self, pool: _Pool, state: PhysicsState, command, time_s, scene):
        batch, qpos, qvel = pool.batch, state.qpos, state.qvel
        finite = np.asarray(np.isfinite(qpos).all(1) & np.isfinite(qvel).all(1))
        resumed = np.equal(qpos, pool.qpos).all(1) & np.equal(qvel, pool.qvel).all(1)
        fresh = np.flatnonzero(~resumed)
        if len(fresh):
            batch.reset(fresh, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
            good = fresh[finite[fresh]]
            pool.state_qpos[good], pool.state_qvel[good] = qpos[good], qvel[good]
            pool.state_warm[good] = np.asarray(state.qacc_warmstart)[good]
        batch.warning[:] = 0
        sensed, iterations = self._advance(pool, command, time_s, scene, state.hook)
        raised = batch.warning[:, :, 1] > 0
        new_qpos, new_qvel = pool.state_qpos.astype(np.float32), pool.state_qvel.astype(np.float32)
        finite &= np.isfinite(new_qpos).all(1) & np.isfinite(new_qvel).all(1)
        nonfinite = ~finite | raised[:, _ENGINE_FAILURES].any(1)
        pool.qpos, pool.qvel = new_qpos, new_qvel
        pool.qpos[nonfinite] = np.nan
        contacts = None
        if self._contacts is not None:
            contacts = from_sensors(sensed, self._contacts, self._config.force_part, np)
        forces = summarise_forces(sensed[:, :, self._sensors], np, contacts, self._config)
        return (
            PhysicsState(new_qpos.copy(), new_qvel.copy(), pool.state_warm.astype(np.float32)),
            StepSignals(
                **forces,
                overflow=raised[:, _OVERFLOWS].any(1).astype(np.int32),
                left_out=np.zeros(len(qpos), np.int32),
                crowded=np.zeros(len(qpos), np.int32),
                unconverged=(iterations >= self._iterations).astype(np.int32),
                nonfinite=nonfinite.astype(np.int32),
            ),
        )

    def _advance(self, pool: _Pool, command, time_s, scene, hook: np.ndarray | None) -> tuple[Any, Any]:
        """Run the substeps and return sensor readings [N, substeps, ...], in which the hook's force counts like a
        contact's, and the most solver iterations [N]."""
        rounds = self._config.substeps if self._robot.control_every_substep or hook is not None else 1
        sensed, iterations = [], np.zeros(len(command), np.int64)
        for k in range(rounds):
            now_s = time_s + k * self._models[0].opt.timestep
            robot = self._layout.robot_state(pool.state_qpos, pool.state_qvel, now_s)
            if k == 0 or self._robot.control_every_substep:
                pool.state_ctrl[:] = np.nan_to_num(self._robot.controls(command, robot, np))
            if self.hook and hook is not None:
                place, states = hook[:, 0].astype(int), (pool.state_qpos, pool.state_qvel, pool.applied)
                pool.applied[:] = self.hook.applied(scene, hook, self._layout, place, *states)
            steps, names = self._config.substeps // rounds, ("sensordata", "solver_niter", "nisland")
            record = pool.batch.rollout(steps, record=names)
            sensed.append(record["sensordata"])
            if hook is not None:
                sensed[-1][:, :1, self._sensors[:-1]] += pool.applied[:, None, self._layout.slot_body, :3]
            niter = record["solver_niter"]
            # Without islands the engine reports one solve; what lies beyond the last island is stale.
            islands = np.maximum(record["nisland"].reshape(niter.shape[0], niter.shape[1], 1), 1)
            iterations = np.maximum(iterations, np.where(np.arange(niter.shape[-1]) < islands, niter, 0).max((1, 2)))
        return np.concatenate(sensed, 1), iterations
