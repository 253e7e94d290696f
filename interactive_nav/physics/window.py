"""Select the part of a `World` that can move near a robot: what MJX steps instead of the whole building.

Objects at rest far from the robot stay where they are, so only the nearest ones need to be simulated. C
MuJoCo leaves the others out by letting them sleep; MJX steps every body of its model, and its cost grows
with the number of bodies, contacts and pairs of boxes. Here the model has a few empty slots and walls, and at
every control step each environment fills them with what is nearest to its robot. All slots give the whole building.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.physics.base import PhysicsState
from interactive_nav.physics.nearness import REACH_M, SHARE, TOUCH_M, Measured, Nearness, widths_at
from interactive_nav.scenes.slots import Layout
from interactive_nav.scenes.world import FEET, World, build_empty_spec

AWAKE_M = 0.05
"""What is this near to the robot's footprint stays awake: it may be pushed slowly, and is not stopped for it."""
TILE = 16
"""MJX-Warp's solver pads the degrees of freedom that are awake, and one column, to a multiple of this."""
_MOVING_BONUS_M = 2.0
"""Moving objects rank as if they were this much nearer."""
_FIRST_M = 1e3
"""What can be met, or moves, ranks before all else: where there is room for what is needed, nothing is left out."""

_BODY = (
    *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat"),
    *("body_subtreemass", "body_invweight0", "body_gravcomp"),
)
_GEOM = ("geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb", "geom_friction")
_JOINT = ("jnt_axis", "jnt_pos", "jnt_range")
_DOF = ("dof_invweight0", "dof_damping", "dof_frictionloss")
_QPOS = ("qpos0", "qpos_spring")
FIELDS = (*_BODY, *_GEOM, *_JOINT, *_DOF, *_QPOS)
"""Model fields that differ between environments under one compiled program."""
_HIDDEN = {
    "geom_size": np.full(3, 1e-3),
    "geom_quat": np.array([1.0, 0, 0, 0]),
    "geom_rbound": np.linalg.norm(np.full(3, 1e-3)),
    "geom_aabb": np.array([0, 0, 0, 1e-3, 1e-3, 1e-3]),
}
"""Padding boxes: too small to be met, at the body's centre of mass."""
_A_GEOM = mujoco.mjtObj.mjOBJ_GEOM
_WALL = ("geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb")


@dataclasses.dataclass(frozen=True)
class _Group:
    """Slots of one kind: `width` of them are in the window at a time."""

    slots: np.ndarray
    """[m] slots of the world."""
    width: int
    first: int
    """Of the window's slots."""
    tables: dict[str, jax.Array]
    """Field -> [scenes, m, ...] values of the slot's body, boxes, joint or degrees of freedom."""
    rows: dict[str, np.ndarray]
    """Field -> [width, ...] rows of the window's model that they fill."""
    outer: dict[str, np.ndarray]
    """Field -> [m, ...] rows of the world's models."""


class PhysicsWindow:
    """A small model, and the way between the world's state and it."""

    def __init__(self, world: World, config: NavConfig):
        self.world = world
        layout = world.layout
        kinds = np.asarray(layout.slot_kind)
        limits = {"small": config.active_small, "free": config.active_furniture, "hinge": config.active_doors}
        limits["slide"] = config.active_doors
        self._slots = {kind: np.flatnonzero(kinds == kind) for kind in limits}
        self._nearness = Nearness(world)
        self._reach_m = world.robot.footprint_radius_m + REACH_M
        limits["walls"] = config.active_walls
        measured = widths_at(self.needs_at_rest) if None in limits.values() else {}
        self.widths = {kind: measured[kind] if limit is None else limit for kind, limit in limits.items()}
        """Kind of slot, and `walls` -> how many at a time; 0: all."""
        there = {kind: len(slots) for kind, slots in self._slots.items()} | {"walls": len(layout.wall_geoms)}
        counts = np.bincount(world.slots.box_slot, minlength=layout.num_slots)
        self._boxes = {kind: int(counts[slots].max(initial=0)) for kind, slots in self._slots.items()}
        self._tables = {kind: self._group_tables(kind) for kind, slots in self._slots.items() if len(slots)}
        self._wall_tables = self._walls()
        self.room = {kind: min(width or there[kind], there[kind]) for kind, width in self.widths.items()}
        """Kind of slot, and `walls` -> how many there is room for."""
        self.n_walls = self.room["walls"]
        slots = tuple((kind, self._boxes[kind]) for kind in self._tables for _ in range(self.room[kind]))
        self.spec, self.model, self.layout = build_empty_spec(world.robot, slots, self.n_walls, config)
        self.groups, first = (), 0
        for kind, (tables, outer) in self._tables.items():
            width = self.room[kind]
            rows, _ = _rows(self.model, self.layout, np.arange(first, first + width), self._boxes[kind], kind)
            self.groups += (_Group(self._slots[kind], width, first, tables, rows, outer),)
            first += width
        self._wall_rows = self.layout.wall_geoms
        self._base = {name: np.asarray(getattr(self.model, name), np.float32) for name in FIELDS}
        xpos, xmat = _static_poses(self.model)
        self._xpos, self._xmat = jax.device_put((np.float32(xpos), np.float32(xmat)))

    @functools.cached_property
    def needs_at_rest(self) -> dict[str, np.ndarray]:
        """Return [P] of each kind of slot, and of walls: needed with the robot at random places, everything at rest."""
        return self._nearness.counts(self._reach_m)

    @functools.cached_property
    def awake_at_rest(self) -> int:
        """Return the degrees of freedom of the robot and of what it meets at 999 of 1,000 random places.

        They are rounded up to one less than a multiple of the solver's tile, which costs the same.
        """
        counts = self._nearness.counts(self.world.robot.footprint_radius_m + TOUCH_M)
        dofs = sum(n * (1 if kind in ("hinge", "slide") else 6) for kind, n in counts.items() if kind != "walls")
        need = self.layout.robot_nv + int(np.quantile(dofs, SHARE, method="higher"))
        return -(-(need + 1) // TILE) * TILE - 1

    def _group_tables(self, kind: str) -> tuple[dict[str, jax.Array], dict[str, np.ndarray]]:
        tables: dict[str, list[np.ndarray]] = {name: [] for name in FIELDS}
        outer: dict[str, np.ndarray] = {}
        for model in self.world.models:
            outer, padding = _rows(model, self.world.layout, self._slots[kind], self._boxes[kind], kind)
            hidden = _HIDDEN | {"geom_pos": model.body_ipos[outer["body_ipos"]][:, None]}
            for name, rows in outer.items():
                values = getattr(model, name)[rows]
                if name in hidden:
                    values = np.where(padding.reshape(padding.shape + (1,) * (values.ndim - 2)), hidden[name], values)
                tables[name].append(values)
        return jax.device_put({name: np.float32(np.stack(values)) for name, values in tables.items()}), outer

    def _walls(self) -> dict[str, jax.Array]:
        world, geoms = self.world, self.world.layout.wall_geoms
        tables = {name: np.stack([getattr(m, name)[geoms] for m in world.models]) for name in _WALL}
        poses = [_static_poses(m) for m in world.models]
        tables["xpos"] = np.stack([xpos[geoms] for xpos, _ in poses])
        tables["xmat"] = np.stack([xmat[geoms] for _, xmat in poses])
        return jax.device_put({k: np.float32(v) for k, v in tables.items()})

    def measure(self, scene: jax.Array, state: PhysicsState) -> Measured:
        """Return `Nearness.measure` of one environment's scene, [] i32, and state of the whole world."""
        return self._nearness.measure(scene, state, self._reach_m)

    def select(self, measured: Measured) -> tuple[tuple[jax.Array, ...], jax.Array, jax.Array]:
        """Return what goes into the window of one environment.

        This is, per group, [width] indices into its slots; [walls] indices of walls; [] i32, 1 if something within
        reach had to be left out.
        """
        near, moving, walls = measured
        chosen, missed = [], jnp.zeros((), bool)
        for group in self.groups:
            if group.width == len(group.slots):
                chosen.append(jnp.arange(group.width))
                continue
            gap, moves = near[group.slots], moving[group.slots]
            needed = (gap < 0) | moves
            _, index = jax.lax.top_k(-(gap - _MOVING_BONUS_M * moves - _FIRST_M * needed), group.width)
            missed |= jnp.any(needed.at[index].set(False))
            chosen.append(index)
        if self.n_walls == len(walls):
            return tuple(chosen), jnp.arange(self.n_walls), missed.astype(jnp.int32)
        _, index = jax.lax.top_k(-walls, self.n_walls)
        missed |= jnp.any((walls < 0).at[index].set(False))
        return tuple(chosen), index, missed.astype(jnp.int32)

    def needs(self, measured: Measured) -> dict[str, jax.Array]:
        """Return how many of each kind can be met, or move, in one environment: [] i32 by kind of slot, and walls."""
        near, moving, walls = measured
        needed = (near < 0) | moving
        counts = {kind: needed[jnp.asarray(slots)].sum() for kind, slots in self._slots.items()}
        return {**counts, "walls": (walls < 0).sum()}

    def awake(self, measured: Measured, chosen: tuple[jax.Array, ...]) -> jax.Array:
        """Return [window slots] bool: what moves, or the robot may already touch; all else rests."""
        near, moving, _ = measured
        awake = moving | (near < AWAKE_M - REACH_M)
        return jnp.concatenate([awake[jnp.asarray(g.slots)[i]] for g, i in zip(self.groups, chosen, strict=True)])

    def fields(self, scene: jax.Array, chosen: tuple[jax.Array, ...], walls: jax.Array) -> dict[str, jax.Array]:
        """Return values of all `FIELDS` of the window's model, in MuJoCo's shapes."""
        out = {name: jnp.asarray(value) for name, value in self._base.items()}
        for group, index in zip(self.groups, chosen, strict=True):
            for name, rows in group.rows.items():
                out[name] = out[name].at[rows].set(group.tables[name][scene, index])
        for name in _WALL:
            out[name] = out[name].at[self._wall_rows].set(self._wall_tables[name][scene, walls])
        return out

    def static_poses(self, scene: jax.Array, walls: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return world positions [ngeom, 3] and matrices [ngeom, 3, 3] of the geoms, right where these never move."""
        xpos = self._xpos.at[self._wall_rows].set(self._wall_tables["xpos"][scene, walls])
        return xpos, self._xmat.at[self._wall_rows].set(self._wall_tables["xmat"][scene, walls])

    def _addresses(self, chosen: tuple[jax.Array, ...]) -> list[tuple[jax.Array, jax.Array]]:
        """Return addresses in the window and in the world of the robot and each group: of qpos, then of qvel."""
        inner, outer, addresses = self.layout, self.world.layout, []
        for name, field, count in (
            ("robot_qpos", "qpos0", inner.robot_nq),
            ("robot_qvel", "dof_damping", inner.robot_nv),
        ):
            robot = (jnp.arange(count) + getattr(of, name) for of in (inner, outer))
            here = [jnp.ravel(group.rows[field]) for group in self.groups]
            there = [jnp.asarray(group.outer[field])[i].ravel() for group, i in zip(self.groups, chosen, strict=True)]
            addresses.append(
                tuple(jnp.concatenate([first, *rest]) for first, rest in zip(robot, (here, there), strict=True))
            )
        return addresses

    def enter(self, state: PhysicsState, chosen: tuple[jax.Array, ...]) -> PhysicsState:
        """Return the window's state out of the world's."""
        (q_in, q_out), (v_in, v_out) = self._addresses(chosen)
        qpos, still = jnp.zeros(self.model.nq, jnp.float32), jnp.zeros(self.model.nv, jnp.float32)
        qvel, warm = (still.at[v_in].set(x[v_out]) for x in (state.qvel, state.qacc_warmstart))
        return PhysicsState(qpos.at[q_in].set(state.qpos[q_out]), qvel, warm)

    def leave(self, state: PhysicsState, inner: PhysicsState, chosen: tuple[jax.Array, ...]) -> PhysicsState:
        """Return the world's new state: what is outside of the window stays, at rest."""
        (q_in, q_out), (v_in, v_out) = self._addresses(chosen)
        still = jnp.zeros_like(state.qvel)
        qvel, warm = (still.at[v_out].set(x[v_in]) for x in (inner.qvel, inner.qacc_warmstart))
        return PhysicsState(state.qpos.at[q_out].set(inner.qpos[q_in]), qvel, warm)

    def spread_forces(self, forces: jax.Array, chosen: tuple[jax.Array, ...]) -> jax.Array:
        """Spread [..., window slots + 1, 3] forces to [..., world slots + 1, 3], the structure last; 0 elsewhere."""
        slots = self.world.layout.num_slots
        out = jnp.zeros((*forces.shape[:-2], slots + 1, 3), forces.dtype)
        for group, index in zip(self.groups, chosen, strict=True):
            mine = forces[..., group.first : group.first + group.width, :]
            out = out.at[..., jnp.asarray(group.slots)[index], :].set(mine)
        return out.at[..., slots, :].set(forces[..., -1, :])


def _rows(
    model: mujoco.MjModel, layout: Layout, slots: np.ndarray, boxes: int, kind: str
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return field -> its rows [m, ...] of slots of one kind; of geoms `boxes` and the feet, and which are padding."""
    body = layout.slot_body[slots]
    names = [*(f"box_{i}" for i in range(boxes)), *(f"foot_{i}" for i in range(FEET))]
    ids = [[mujoco.mj_name2id(model, _A_GEOM, f"{model.body(b).name}_{name}") for name in names] for b in body]
    geoms = np.array(ids, int).reshape(len(body), len(names))
    padding = geoms < 0  # a body's first geom stands for it
    geoms = np.where(padding, geoms[:, :1], geoms)
    n_q, n_v = (1, 1) if kind in ("hinge", "slide") else (7, 6)
    rows: dict[str, np.ndarray] = {**dict.fromkeys(_BODY, body), **dict.fromkeys(_GEOM, geoms)}
    rows |= dict.fromkeys(_JOINT, model.body_jntadr[body])
    rows |= dict.fromkeys(_DOF, layout.slot_qvel[slots][:, None] + np.arange(n_v))
    return rows | dict.fromkeys(_QPOS, layout.slot_qpos[slots][:, None] + np.arange(n_q)), padding


def _static_poses(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.geom_xpos.copy(), data.geom_xmat.reshape(-1, 3, 3).copy()
