"""Select the part of a `World` that can move near a robot, for MJX to step instead of the whole building.

MJX steps every body of its model, and its cost grows with bodies, contacts and pairs of boxes. Here the model has a few
empty slots and walls, which each environment fills at every control step with the bodies nearest to its robot.
"""

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
_POSE = ("xpos", "xmat")
_Owners = list[tuple[np.ndarray, np.ndarray, np.ndarray]]
_A_GEOM = mujoco.mjtObj.mjOBJ_GEOM


@dataclasses.dataclass(frozen=True)
class _Group:
    """Slots of one kind: `width` of them are in the window at a time."""

    slots: np.ndarray
    """[m] slots of the world."""
    width: int
    first: int
    """Of the window's slots."""


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
        # What is needed with the robot at random places, everything at rest.
        measured = widths_at(self._nearness.counts(self._reach_m)) if None in limits.values() else {}
        self.widths = {kind: measured[kind] if limit is None else limit for kind, limit in limits.items()}
        """Kind of slot, and `walls` -> how many at a time; 0: all."""
        there = {kind: len(slots) for kind, slots in self._slots.items()} | {"walls": len(layout.wall_geoms)}
        counts = np.bincount(world.slots.box_slot, minlength=layout.num_slots)
        self._boxes = {kind: int(counts[slots].max(initial=0)) for kind, slots in self._slots.items()}
        self.room = {kind: min(width or there[kind], there[kind]) for kind, width in self.widths.items()}
        """Kind of slot, and `walls` -> how many there is room for."""
        self.n_walls = self.room["walls"]
        slots = tuple((kind, self._boxes[kind]) for kind in self._slots for _ in range(self.room[kind]))
        self.spec, self.model, self.layout = build_empty_spec(world.robot, slots, self.n_walls, config)
        self.groups, first = (), 0
        for kind, width in self.room.items():
            if kind != "walls" and width:
                self.groups += (_Group(self._slots[kind], width, first),)
                first += width
        self._tables = self._build_tables()
        self._owners = _owners(layout, world.models[0]), _owners(self.layout, self.model)

    @functools.cached_property
    def awake_at_rest(self) -> int:
        """Return the degrees of freedom of the robot and the objects near it at 999 of 1,000 random places.

        They are rounded up to one less than a multiple of the solver's tile, which costs the same.
        """
        counts = self._nearness.counts(self.world.robot.footprint_radius_m + TOUCH_M)
        dofs = sum(n * (1 if kind in ("hinge", "slide") else 6) for kind, n in counts.items() if kind != "walls")
        need = self.layout.robot_nv + int(np.quantile(dofs, SHARE, method="higher"))
        return -(-(need + 1) // TILE) * TILE - 1

    def _group_tables(self, group: _Group) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return field -> [width, ...] rows of the window's model; [scenes, m, ...] values of slots to fill them."""
        kind, tables = self.world.layout.slot_kind[group.slots[0]], {name: [] for name in FIELDS}
        for model in self.world.models:
            outer, padding = _rows(model, self.world.layout, group.slots, self._boxes[kind], kind)
            hidden = _HIDDEN | {"geom_pos": model.body_ipos[outer["body_ipos"]][:, None]}
            for name, rows in outer.items():
                values = getattr(model, name)[rows]
                if name in hidden:
                    values = np.where(padding.reshape(padding.shape + (1,) * (values.ndim - 2)), hidden[name], values)
                tables[name].append(values)
        inner = _rows(self.model, self.layout, group.first + np.arange(group.width), self._boxes[kind], kind)
        return inner[0], {name: np.stack(values) for name, values in tables.items()}

    def _build_tables(self) -> list[tuple[np.ndarray, dict[str, jax.Array]]]:
        """Return tables of all possible rows of the window's model, so that one gather makes a field.

        A field's table has the rows of each scene's slots and walls, then those of the window's model. [4, rows] locate
        the window's rows: at `of_scene * scene + first + step * pick[at]`, with the indices `pick` of `select`.
        """
        base, *every = [_values(model) for model in (self.model, *self.world.models)]
        scenes, geoms, walls = len(every), self.world.layout.wall_geoms, (*_GEOM, *_POSE)
        of_walls = {name: np.stack([values[name][geoms] for values in every]) for name in walls}
        sources = [(group.first, *self._group_tables(group)) for group in self.groups]
        sources.append((self.layout.num_slots, dict.fromkeys(walls, self.layout.wall_geoms[:, None]), of_walls))
        out = []
        for names in (_BODY, _GEOM, _JOINT, _DOF, _QPOS, _POSE):
            mine, size = [source for source in sources if names[0] in source[1]], 0
            place = of_scene, first, step, at = np.zeros((4, len(base[names[0]])), np.int32)
            for start, rows, values in mine:
                its = rows[names[0]].reshape(len(rows[names[0]]), -1)
                first[its], step[its] = size + np.arange(its.shape[1]), its.shape[1]
                at[its] = start + np.arange(len(its))[:, None]
                size += values[names[0]].shape[1] * its.shape[1]
            of_scene[step > 0], first[step == 0] = size, scenes * size + np.flatnonzero(step == 0)
            tables = {}
            for name in names:
                parts = [of[name].reshape(scenes, -1, *base[name].shape[1:]) for _, _, of in mine]
                rows = np.concatenate(parts, 1).reshape(-1, *base[name].shape[1:]) if parts else base[name][:0]
                tables[name] = np.float32(np.concatenate([rows, base[name]]))
            out.append((place, jax.device_put(tables)))
        return out

    def measure(self, scene: jax.Array, state: PhysicsState) -> Measured:
        """Return `Nearness.measure` of one environment's scene, [] i32, and state of the whole world."""
        return self._nearness.measure(scene, state, self._reach_m)

    def select(self, measured: Measured) -> tuple[tuple[jax.Array, ...], jax.Array, jax.Array]:
        """Return [width] slot indices per group, [walls] wall indices, and [] i32, 1 if something was left out."""
        near, moving, walls = measured
        chosen, missed = [], jnp.zeros((), bool)
        for group in self.groups:
            if group.width == len(group.slots):
                chosen.append(jnp.arange(group.width))
                continue
            gap, moves = near[group.slots], moving[group.slots]
            needed = (gap < 0) | moves
            _, index = jax.lax.top_k(-(gap - _MOVING_BONUS_M * moves - _FIRST_M * needed), group.width)
            missed |= needed.sum() > group.width
            chosen.append(index)
        if self.n_walls == len(walls):
            return tuple(chosen), jnp.arange(self.n_walls), missed.astype(jnp.int32)
        _, index = jax.lax.top_k(-walls, self.n_walls)
        missed |= (walls < 0).sum() > self.n_walls
        return tuple(chosen), index, missed.astype(jnp.int32)

    def awake(self, measured: Measured, chosen: tuple[jax.Array, ...]) -> jax.Array:
        """Return [window slots] bool: what moves, or the robot may already touch; all else rests."""
        near, moving, _ = measured
        awake = moving | (near < AWAKE_M - REACH_M)
        return awake[self._inside(chosen)[:-1]]

    def fields(self, scene: jax.Array, chosen: tuple[jax.Array, ...], walls: jax.Array) -> dict[str, jax.Array]:
        """Return values of all `FIELDS` of the window's model, in MuJoCo's shapes."""
        pick, out = jnp.concatenate([*chosen, walls]), {}
        for (of_scene, first, step, at), tables in self._tables[:-1]:
            index = of_scene * scene + first + step * pick[at]
            out |= {name: table[index] for name, table in tables.items()}
        return out

    def with_given(self, fields: dict[str, jax.Array], given: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Return `fields` with the values of `given` in all rows that neither slots nor walls fill."""
        for (_, _, step, _), tables in self._tables[:-1]:
            for name in tables.keys() & given.keys():
                value, filled = fields[name], (step > 0).reshape(-1, *[1] * (fields[name].ndim - 1))
                fields = fields | {name: jnp.where(filled, value, given[name].reshape(value.shape))}
        return fields

    def static_poses(self, scene: jax.Array, walls: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return world positions [ngeom, 3] and matrices [ngeom, 3, 3] of the geoms, right where these never move."""
        (of_scene, first, step, at), tables = self._tables[-1]
        index = of_scene * scene + first + step * jnp.pad(walls, (self.layout.num_slots, 0))[at]
        return tables["xpos"][index], tables["xmat"][index]

    def _inside(self, chosen: tuple[jax.Array, ...]) -> jax.Array:
        """Return the world's slots [window slots + 1] that are in the window; last, for the robot, how many it has."""
        slots = [jnp.asarray(group.slots)[i] for group, i in zip(self.groups, chosen, strict=True)]
        return jnp.concatenate([*slots, jnp.asarray([self.world.layout.num_slots])])

    def places(self, chosen: tuple[jax.Array, ...]) -> jax.Array:
        """Return where in the window the world's slots and, last, the robot are, [M + 1]; -1 for what is outside."""
        inside, outside = self._inside(chosen), jnp.full(self.world.layout.num_slots + 1, -1)
        return outside.at[inside].set(jnp.arange(len(inside)), unique_indices=True)

    def enter(self, state: PhysicsState, chosen: tuple[jax.Array, ...]) -> PhysicsState:
        """Return the window's state out of the world's."""
        q, v = _addresses(*self._owners, self._inside(chosen))
        return PhysicsState(state.qpos[q], state.qvel[v], state.qacc_warmstart[v])

    def leave(self, state: PhysicsState, inner: PhysicsState, chosen: tuple[jax.Array, ...]) -> PhysicsState:
        """Return the world's new state: what is outside of the window stays, at rest."""
        places, (worlds, mine) = self.places(chosen), self._owners
        (q, v), (has_q, has_v) = _addresses(mine, worlds, places), (places[owner] >= 0 for _, owner, _ in worlds)
        qvel, warm = (jnp.where(has_v, x[v], 0.0) for x in (inner.qvel, inner.qacc_warmstart))
        return PhysicsState(jnp.where(has_q, inner.qpos[q], state.qpos), qvel, warm)

    def spread_forces(self, forces: jax.Array, chosen: tuple[jax.Array, ...]) -> jax.Array:
        """Spread [..., window slots + 1, 3] forces to [..., world slots + 1, 3], the structure last; 0 elsewhere."""
        places = self.places(chosen)
        return jnp.where(places[:, None] >= 0, forces[..., places, :], 0.0)


def _values(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return all fields, and the world poses that the geoms have in `qpos0`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    poses = {"xpos": data.geom_xpos.copy(), "xmat": data.geom_xmat.reshape(-1, 3, 3).copy()}
    return {name: getattr(model, name) for name in FIELDS} | poses


def _owners(layout: Layout, model: mujoco.MjModel) -> _Owners:
    """Return, for qpos and for qvel, where each slot and, last, the robot begins; each number's owner; its offset."""
    out = []
    for name, size in (("qpos", model.nq), ("qvel", model.nv)):
        first, numbers = np.append(getattr(layout, f"slot_{name}"), getattr(layout, f"robot_{name}")), np.arange(size)
        owner = np.where(first <= numbers[:, None], first, -1).argmax(-1)
        out.append((first, owner, numbers - first[owner]))
    return out


def _addresses(of: _Owners, to: _Owners, slots: jax.Array) -> tuple[jax.Array, ...]:
    """Return where in one state's qpos and qvel the numbers of another are, whose owners are these slots of it."""
    pairs = zip(of, to, strict=True)
    return tuple(jnp.asarray(first)[slots[owner]] + offset for (first, _, _), (_, owner, offset) in pairs)


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
