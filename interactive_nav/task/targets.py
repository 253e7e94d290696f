"""Define the tasks beyond `reach`: open a door or drawer, go through a door that must be pulled, touch an object.

`build_targets` lists what each scene offers on the host; `Targets` and the terms use it inside jit.
"""

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.navigation.lookup import geodesic_at, goal_field
from interactive_nav.navigation.tables import FINE_CELLS, furniture_map, rest_poses
from interactive_nav.scenes.world import World
from interactive_nav.task.terms import Moment, Step, Term
from interactive_nav.types import NavInfo, SceneTables, Targets
from interactive_nav_common.grids import label, sampled_clearance
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.categories import SEGMENTATIONS
from scenes_mjcf.schema import SceneError

OPEN_RAD, OPEN_M = math.pi / 3, 0.2
"""A door is open when it has turned, a drawer when it has slid, this far from where it stood at the start."""
PAIRS = 1024
"""Pairs of start and goal of each scene, from which episodes are drawn."""
CATEGORIES = SEGMENTATIONS["all"].names
BESIDE_M = 0.5
"""A door's or drawer's goal is a free place within this distance of where the robot would stand before it."""
OPENING_REWARD = 5.0
"""Reward of opening the target; the share of it that is open pays this share."""
_OFFERS = {
    "open": "door or drawer that opens towards a place where the robot fits",
    "clear": "door between two rooms that must be pulled",
    "fetch": "piece of furniture beside which the robot fits",
}


def _offers(
    world: World, config: NavConfig, s: int, starts: np.ndarray
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield a target's slot, start places and goal places [n, 2] of a scene; `starts` [p, 2] are its free places."""
    slots, maps, radius_m = world.slots, world.scenes[s].maps, world.robot.footprint_radius_m
    fine_m, poses = config.nav_cell_m / FINE_CELLS, rest_poses(world, s)
    leaves = {m.name: poses[m.name] for m in world.scenes[s].movables if m.category == "door"}
    open_ = maps.traversable & ~furniture_map(world.scenes[s], leaves, world.robot.height_m)
    rooms = label(sampled_clearance(open_, maps.resolution_m, fine_m) >= radius_m)[0]

    def room_of(xy_w: np.ndarray) -> np.ndarray:
        cell = np.floor((xy_w - np.asarray(maps.origin_w)) / fine_m).astype(int)[..., ::-1]
        return rooms[tuple(np.clip(cell, 0, np.array(rooms.shape) - 1).T)]

    def nearest(xy_w: np.ndarray, most_m: float) -> np.ndarray:
        away_m = np.linalg.norm(starts - xy_w, axis=-1)
        return starts[[away_m.argmin()]] if away_m.min() < most_m else starts[:0]

    room_of_start = room_of(starts)
    for slot in np.flatnonzero(slots.occupied[s]):
        body = slots.bodies[s][slot]
        pos_w, quat = poses.get(slots.names[s][slot], (None, None))
        if pos_w is None or (body.joint is None) != (config.task == "fetch"):
            continue
        axes_w = matrix_from_quat(quat)
        com_w = pos_w + axes_w @ slots.com_b_m[s, slot]
        if body.joint is None:
            yield slot, starts, nearest(com_w[:2], radius_m + 1.0)
            continue
        at, (low, high) = world.rest_qpos[s, world.layout.slot_qpos[slot]], body.joint.range or (-np.inf, np.inf)
        axis_w, anchor_w = axes_w @ body.joint.axis, pos_w + axes_w @ body.joint.anchor_m
        arm, slides = com_w - anchor_w, body.joint.slides
        way = (axis_w if slides else np.cross(axis_w, arm))[:2] * (1 if high - at > at - low else -1)
        if max(high - at, at - low) < (OPEN_M if slides else OPEN_RAD) or np.linalg.norm(way) < 1e-3:
            continue
        way /= np.linalg.norm(way)
        if config.task == "open":
            handle_w = com_w if slides else com_w + arm
            goals = nearest(handle_w[:2] + way * (radius_m + 0.1), BESIDE_M)
            yield slot, starts[room_of_start == room_of(goals).max(initial=-1)], goals
        elif body.category == "door":
            reach_m = np.arange(0.1, 1.0, fine_m)[:, None]
            sides = [room_of(com_w[:2] + sign * reach_m * way) for sign in (1, -1)]
            near, far = (side[side > 0][:1].max(initial=0) for side in sides)
            if near and far and near != far:
                yield slot, starts[room_of_start == near], starts[room_of_start == far]


def build_targets(world: World, config: NavConfig, tables: SceneTables) -> Targets:
    """Return the targets of a task in every scene; raise `SceneError` for a scene that offers none."""
    slots, scenes, rng = world.slots, range(len(world.scenes)), np.random.default_rng(0)

    @jax.jit
    def paths_m(scene: int, pairs: jax.Array) -> jax.Array:
        def path_m(pair: jax.Array) -> jax.Array:
            return geodesic_at(tables, scene, goal_field(tables, scene, pair[1]), pair[0])  # type: ignore[arg-type]

        return jax.vmap(path_m)(pairs)

    rows = []
    for s in scenes:
        starts = np.asarray(tables.start_xy_w[s, : tables.num_starts[s]])
        offers = [(slot, a, b) for slot, a, b in _offers(world, config, s, starts) if len(a) and len(b)]
        count = math.ceil(PAIRS / max(len(offers), 1))
        drawn = [(slot, rng.choice(a, count), rng.choice(b, count)) for slot, a, b in offers]
        pairs = np.concatenate([np.zeros((0, 2, 2)), *(np.stack([a, b], 1) for _, a, b in drawn)])[:PAIRS]
        slot = np.repeat([slot for slot, *_ in drawn], count)[:PAIRS].astype(np.int32)
        path_m = np.asarray(paths_m(s, jnp.asarray(pairs, jnp.float32))) if len(pairs) else np.zeros(0)
        straight_m = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=-1)
        fits = np.flatnonzero((straight_m >= config.min_goal_distance_m) & (path_m <= config.max_goal_distance_m))
        if not len(fits):
            raise SceneError(
                f"{world.scenes[s].path}: has no {_OFFERS[config.task]} for robot '{world.robot.name}' at a distance "
                f"that the settings allow, expected one with task={config.task}; use other scenes, or task=reach"
            )
        fits = np.resize(fits, PAIRS)
        order = fits[np.argsort(path_m[fits], kind="stable")]
        rows.append((slot[order], pairs[order].astype(np.float32), path_m[order].astype(np.float32)))
    held, com_b, body = slots.held[:, None], slots.com_b_m, slots.pos_w_m
    hinge_w = body + np.einsum(
        "smij,smj->smi", slots.axes_w, np.where(held & ~slots.slides[:, None], slots.anchor_b_m, com_b)
    )
    span = np.where(slots.slides, OPEN_M, OPEN_RAD).astype(np.float32)
    numbers = *(np.stack(column) for column in zip(*rows, strict=True)), hinge_w.astype(np.float32), span
    address = np.where(slots.held, world.layout.slot_qpos, -1).astype(np.int32)
    return jax.device_put(Targets(*numbers, address, slots.class_ids("all").astype(np.int32)))  # type: ignore[call-arg]


def opened(tables: SceneTables, at: NavInfo, qpos: jax.Array) -> jax.Array:
    """Return [] in [0, 1]: the share of what counts as open by which an episode's target is; 0 without a joint."""
    targets, slot = tables.targets, at.target
    address = targets.address[slot]
    moved = jnp.abs(qpos[address] - tables.rest_qpos[at.scene_index, address]) / targets.span[slot]
    return jnp.where(address >= 0, jnp.clip(moved, 0.0, 1.0), 0.0)


def achieved(task: str, tables: SceneTables, at: NavInfo, qpos: jax.Array, touches: jax.Array) -> jax.Array:
    """Return [] bool: the target is open, or something of its category is among the touched objects (M,)."""
    if task == "open":
        return opened(tables, at, qpos) >= 1.0
    kinds = tables.targets.category[at.scene_index]
    return (touches & (kinds[:-1] == kinds[at.target])).any()


def _place(_: Any, at: Moment) -> jax.Array:
    """Return (6,) the target's centre of mass (3), its hinge (2; without one, its centre at rest), and what is open."""
    points_w = at.nav.object_pos_w[at.nav.target], at.tables.targets.hinge_w[at.nav.scene_index, at.nav.target]
    centre, hinge = ((point - at.nav.robot_pos_w) @ at.rotation for point in points_w)
    return jnp.concatenate([centre, hinge[:2], opened(at.tables, at.nav, at.physics.qpos)[None]])


def _category(_: Any, at: Moment) -> jax.Array:
    kinds = at.tables.targets.category[at.nav.scene_index]
    return jax.nn.one_hot(kinds[at.nav.target], len(CATEGORIES))


def _opening(shares: jax.Array, step: Step) -> jax.Array:
    share = opened(step.tables, step.nav, step.physics.qpos)
    return jnp.stack([jnp.where(step.broken, shares[0], share), shares[0]])


def target_terms(task: str) -> tuple[Term, ...]:
    """Return the terms that a task adds."""
    target = Term(
        "target", "Its centre and hinge (2), robot frame, m; share that is open.", "observation", _place, size=6
    )
    category = Term("category", "One-hot, of `CATEGORIES`.", "observation", _category, size=len(CATEGORIES))
    opening = Term(
        "opening", "Reward of opening the target, in sum up to `OPENING_REWARD`.", "reward",
        lambda shares, _: OPENING_REWARD * (shares[0] - shares[1]), lambda nav: jnp.zeros(2), _opening,
    )  # fmt: skip
    share = Term("opened", "Share of the target that is open.", "metric", lambda _, s: s.nav.memory[opening.key][0])
    return {"reach": (), "fetch": (category,)}.get(task, (target, opening, share))
