"""Define the tasks with a target: open a door or drawer, pull a door open and go through, touch or lift an object.

`build_targets` lists what each scene offers, on the host; the rest works on one environment inside jit.
"""

import math
from collections.abc import Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from interactive_nav.config import NavConfig
from interactive_nav.navigation.lookup import geodesic_at, goal_field
from interactive_nav.navigation.tables import FINE_CELLS, furniture_map, rest_poses
from interactive_nav.scenes.world import World
from interactive_nav.task.terms import Moment, Step, Term
from interactive_nav.types import NavInfo, SceneTables, Targets
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.grids import label, sampled_clearance, value_near
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.categories import SEGMENTATIONS
from scenes_mjcf.schema import SceneError

OPEN_RAD, OPEN_M = math.pi / 3, 0.2
"""A door is open when it has turned, a drawer when it has slid, this far from where it stood at the start."""
LIFT_M, CARRY_M, LIFT_KG = 0.1, 0.5, 6.0
"""An object is lifted when its centre of mass is this far above, and this far aside of, its place at the start. Tipping
it over raises it less. Targets have at most this mass, the payload of Fetch's arm."""
BESIDE_M = 0.5
"""The robot fits before a handle if it fits within this distance of the place straight before it."""
PAIRS = 1024
"""Pairs of start and goal of each scene, from which episodes are drawn."""
OPENING_REWARD = 5.0
"""Sum of the rewards of opening or lifting a target."""
NEAR_M = 1.0
"""The way of a hook at a hand to the target pays from this distance on."""
CATEGORIES = SEGMENTATIONS["all"].names


def opening(world: World, s: int, slot: int, arm_w: np.ndarray) -> tuple[float, np.ndarray]:
    """Return how far a held body of a scene can move from rest, rad or m, and where its centre then goes.

    This is a vector (2,) in the plane, for a centre that is `arm_w` (3,), m, from the hinge.
    """
    slots, tie = world.slots, cast(Any, world.slots.bodies[s][slot]).joint
    ends = np.array(tie.range or (-math.pi, math.pi)) - world.rest_qpos[s, world.layout.slot_qpos[slot]]
    most = ends[np.abs(ends).argmax()]
    axis_w = slots.axes_w[s, slot] @ slots.axis_b[s, slot] * most
    return abs(most), (axis_w if tie.slides else np.cross(axis_w, arm_w))[:2]


def _offers(world: World, config: NavConfig, s: int, places: np.ndarray) -> Iterator[tuple]:
    """Yield a scene's targets: slot, and start and goal places [n, 2] among those where the robot fits, [p, 2] m."""
    scene, radius_m, poses = world.scenes[s], world.robot.footprint_radius_m, rest_poses(world, s)
    fine_m, maps = config.nav_cell_m / FINE_CELLS, scene.maps
    doors = {body.name: poses[body.name] for body in scene.movables if body.category == "door"}
    free = maps.traversable & ~furniture_map(scene, doors, world.robot.height_m)
    rooms = label(sampled_clearance(free, maps.resolution_m, fine_m) >= radius_m)[0]
    room = value_near(rooms, fine_m, maps.origin_w, places)

    def nearest(xy_w: np.ndarray, most_m: float) -> np.ndarray:
        away_m = np.linalg.norm(places - xy_w, axis=-1)
        return np.flatnonzero((away_m == away_m.min()) & (away_m < most_m))[:1]

    for body in scene.movables:
        slot, tie, (pos_w, quat) = world.slots.names[s].index(body.name), body.joint, poses[body.name]
        axes_w = matrix_from_quat(quat)
        com_w = pos_w + axes_w @ body.com_m
        if tie is None:
            if config.task == "fetch" or (config.task == "lift" and body.mass_kg <= LIFT_KG):
                yield slot, places, places[nearest(com_w[:2], radius_m + 1.0)]
            continue
        arm_w = np.zeros(3) if tie.slides else com_w - pos_w - axes_w @ tie.anchor_m
        most, opens_w = opening(world, s, slot, arm_w)
        length = np.linalg.norm(opens_w)
        if most < (OPEN_M if tie.slides else OPEN_RAD) or length < 1e-3:
            continue
        if config.task == "open":
            at = nearest((com_w + arm_w)[:2] + opens_w / length * (radius_m + 0.1), BESIDE_M)
            yield slot, places[room == room[at].max(initial=0)], places[at]
        elif config.task == "clear" and body.category == "door":
            away_m = np.arange(radius_m, 1.0, fine_m)[:, None] * np.array([[[1]], [[-1]]])
            sides = value_near(rooms, fine_m, maps.origin_w, com_w[:2] + away_m * opens_w / length)
            near, far = (side[side > 0][:1].max(initial=0) for side in sides.T)
            if near != far:
                yield slot, places[(room == near) & (near > 0)], places[(room == far) & (far > 0)]


def build_targets(world: World, config: NavConfig, tables: SceneTables) -> Targets:
    """Return a task's targets in every scene; raise `SceneError` for a scene that offers none."""
    slots, rng, rows = world.slots, np.random.default_rng(0), []

    def path_m_of(scene: int, pair: jax.Array) -> jax.Array:
        return geodesic_at(tables, scene, goal_field(tables, scene, pair[1]), pair[0])  # pyright: ignore[reportArgumentType]

    paths_m = jax.jit(jax.vmap(path_m_of, (None, 0)))
    for s, scene in enumerate(world.scenes):
        places = np.asarray(tables.start_xy_w[s, : tables.num_starts[s]])
        offers = [offer for offer in _offers(world, config, s, places) if len(offer[1]) and len(offer[2])]
        drawn = [offers[i] for i in rng.integers(len(offers), size=PAIRS)] if offers else []
        pairs = np.array([(rng.choice(a), rng.choice(b)) for _, a, b in drawn], np.float32).reshape(-1, 2, 2)
        slot, path_m = np.array([offer[0] for offer in drawn]), np.asarray(paths_m(s, pairs))
        straight_m = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=-1)
        fits = np.flatnonzero((straight_m >= config.min_goal_distance_m) & (path_m <= config.max_goal_distance_m))
        if not len(fits):
            raise SceneError(
                f"{scene.path}: offers robot '{world.robot.name}' no target of task '{config.task}' at a distance that "
                "the settings allow, expected at least one; use other scenes or another task"
            )
        fits = np.resize(fits, PAIRS)
        order = fits[np.argsort(path_m[fits])]
        rows.append((slot[order], pairs[order], path_m[order]))
    slot, pairs, path_m = (np.stack(column) for column in zip(*rows, strict=True))
    hung = (slots.held & ~slots.slides)[:, None]
    hinge_w = slots.pos_w_m + (slots.axes_w @ np.where(hung, slots.anchor_b_m, slots.com_b_m)[..., None])[..., 0]
    span, address = np.where(slots.slides, OPEN_M, OPEN_RAD), np.where(slots.held, world.layout.slot_qpos, -1)
    numbers = np.int32(slot), pairs, path_m, np.float32(hinge_w), np.float32(span), np.int32(address)
    return Targets(*map(jnp.asarray, (*numbers, slots.class_ids("all").astype(np.int32))))


def opened(tables: SceneTables, at: NavInfo, qpos: jax.Array) -> jax.Array:
    """Return [] in [0, 1]: how far an episode's target is open, as a share of what counts.

    For an object without a joint, lifting it counts for one half, and carrying it while it is lifted for the other.
    """
    targets: Any = tables.targets
    address = targets.address[at.target]
    moved = jnp.abs(qpos[address] - tables.rest_qpos[at.scene_index, address]) / targets.span[at.target]
    away_m = at.object_pos_w[at.target] - targets.hinge_w[at.scene_index, at.target]
    lifted, carried = jnp.clip(away_m[2] / LIFT_M, 0.0, 1.0), jnp.clip(jnp.linalg.norm(away_m[:2]) / CARRY_M, 0.0, 1.0)
    return jnp.where(address >= 0, jnp.clip(moved, 0.0, 1.0), 0.5 * lifted * (1.0 + carried))


def achieved(task: str, tables: SceneTables, at: NavInfo, qpos: jax.Array, touches: jax.Array) -> jax.Array:
    """Return [] bool: the target is open or lifted, or in `fetch` an object of its category is touched (M,)."""
    if task in ("open", "lift"):
        return opened(tables, at, qpos) >= 1.0
    kinds = tables.targets.category[at.scene_index]  # pyright: ignore[reportOptionalMemberAccess]
    return (touches & (kinds[:-1] == kinds[at.target])).any()


def _place(_: Any, at: Moment) -> jax.Array:
    targets: Any = at.tables.targets
    points_w = at.nav.object_pos_w[at.nav.target], targets.hinge_w[at.nav.scene_index, at.nav.target]
    centre, hinge = ((point - at.nav.robot_pos_w) @ at.rotation for point in points_w)
    return jnp.concatenate([centre, hinge[:2], opened(at.tables, at.nav, at.physics.qpos)[None]])


def _category(_: Any, at: Moment) -> jax.Array:
    targets: Any = at.tables.targets
    return jax.nn.one_hot(targets.category[at.nav.scene_index, at.nav.target], len(CATEGORIES))


def _opening(shares: jax.Array, step: Step) -> jax.Array:
    share = opened(step.tables, step.nav, step.physics.qpos)
    return jnp.stack([jnp.where(step.broken, shares[0], share), shares[0]])


def reaching_terms(env: Any) -> tuple[Term, ...]:
    """Return what pays for the way of a hook at a hand to the target, and for its hold, in `open` and `lift`."""
    at_hand = env.hook is not None and env.hook.at_hand
    if env.config.task == "lift" and not at_hand:
        got = f"hook_force_n is {env.config.hook_force_n} and control_mode '{env.robot.control_mode}' with task 'lift'"
        raise ConfigError(f"{got}, expected a hook at a hand; set hook_force_n=100 and control_mode=hand")
    if env.config.task not in ("open", "lift") or not at_hand:
        return ()

    def near(nav: NavInfo, physics: Any) -> jax.Array:
        away_m = jnp.linalg.norm(env.hook.point_w(physics) - nav.object_pos_w[nav.target])
        holds = physics.hook[0] == nav.target
        return jnp.where(holds, 1.0, jnp.clip(1.0 - away_m / NEAR_M, 0.0, 1.0) / 2.0)

    def update(shares: jax.Array, step: Step) -> jax.Array:
        return jnp.stack([jnp.where(step.broken, shares[0], near(step.nav, step.physics)), shares[0]])

    doc = "The change of the hook's nearness to the target; 1 where it holds it."
    return (Term("reaching", doc, "reward", lambda pair, _: pair[0] - pair[1], lambda nav: jnp.zeros(2), update),)


_CATEGORY = Term("category", "Of what to touch, one-hot.", "observation", _category, size=len(CATEGORIES))
_OPENING = (
    Term("target", "Its centre (3), hinge (2), robot frame, m; share open or lifted.", "observation", _place, size=6),
    Term("opening", "`OPENING_REWARD` times the change of the share that is open or lifted.", "reward",
         lambda shares, _: OPENING_REWARD * (shares[0] - shares[1]), lambda nav: jnp.zeros(2), _opening),
    Term("opened", "Share of what counts as open or lifted.", "metric",
         lambda _, step: step.nav.memory["reward/opening"][0]),
)  # fmt: skip
TERMS_OF_TASKS: dict[str, tuple[Term, ...]] = {"reach": (), "fetch": (_CATEGORY,)}
TERMS_OF_TASKS |= dict.fromkeys(("open", "clear", "lift"), _OPENING)
