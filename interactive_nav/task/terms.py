"""Define what an episode rewards, measures and remembers, each as one `Term`.

`InteractiveNav` starts, updates and evaluates every term in each control step. To add one, pass it to
`interactive_nav.make(..., terms=(...,))`; `docs/extend.md` has examples.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp

from interactive_nav import metrics
from interactive_nav.config import NavConfig
from interactive_nav.navigation.placement import DISTANCE_TOLERANCE_M
from interactive_nav.physics import PhysicsState, StepSignals
from interactive_nav.physics.base import TOUCH_FORCE_N
from interactive_nav.physics.hook import TORN
from interactive_nav.reward import interactive_navigation_reward
from interactive_nav.robots.links import make_links, repeated
from interactive_nav.sensing.boxes import CLEAR_M, box_gaps_m2, box_poses
from interactive_nav.sensing.sensors import stream
from interactive_nav.types import NavInfo, SceneTables
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import apply_axes, wrap_angle
from scenes_mjcf.categories import SEGMENTATIONS

STILL_M = 1e-4
"""A centre of mass that moves less than this in a control step (1 mm/s) counts as at rest: solver noise."""
SETTLE_STEPS = 5
"""Small objects that come to rest in an episode's first control steps, untouched, have not been moved."""
HAND_REACH_M = 0.05
"""An object counts as touched by the hand at most this far from its grip, in the plane and in height."""


@dataclasses.dataclass(frozen=True)
class Moment:
    """One environment between two control steps: what an observation may read."""

    config: NavConfig
    tables: SceneTables
    score_mass_kg: float
    """m_0 in the scores."""
    nav: NavInfo
    physics: PhysicsState
    rotation: jax.Array
    """(3, 3) the base's axes in the world, as columns."""


@dataclasses.dataclass(frozen=True)
class Step(Moment):
    """One environment after a control step, with its new pose and clock: what reward terms and metrics may read."""

    last: NavInfo
    """The same before the step."""
    signals: StepSignals
    rng: jax.Array
    """Key of the episode: derive keys with `interactive_nav.sensing.sensors.stream`, do not consume it."""
    touches: jax.Array
    """(M,) bool: the robot touched the movable object."""
    hits_structure: jax.Array
    """[] bool: it touched a wall or another fixed part."""
    clearance_m: jax.Array
    """[] m from the disc of its footprint to the nearest wall or object, at most `CLEAR_M`; 0 where `broken`."""
    lifted: jax.Array
    """[] bool: its base is `LIFT_M` above its standing height."""
    broken: jax.Array
    """[] bool: the state is not finite; `nav` has the pose before the step."""
    success: jax.Array
    """[] bool: it is at the goal."""


@dataclasses.dataclass(frozen=True)
class Term:
    """A reward term, a metric of the episode, an observation with memory, or a memory that others read.

    Functions are pure and see one environment.
    """

    name: str
    """Key in `state.metrics` and `NavInfo.memory` (`reward/<name>` of a reward), or the part of the observation."""
    doc: str
    """A description with its unit and range."""
    kind: Literal["reward", "metric", "observation", "memory"]
    value: Callable[[Any, Any], jax.Array] | None = None
    """(memory, Step) -> [] of a reward, which is added, or of a metric, reported in the episode's last step.
    (memory, Moment) -> (size,) of an observation. The memory is already updated."""
    start: Callable[[NavInfo], Any] | None = None
    """(nav) -> memory at the start of an episode; None: the term has no memory."""
    update: Callable[[Any, Step], Any] = lambda memory, step: memory
    """(memory, step) -> memory after a control step."""
    size: int = 0
    """Length of an observation."""

    def __post_init__(self) -> None:
        if (self.value is None) != (self.kind == "memory"):
            expected = _VALUES[self.kind]
            raise ConfigError(f"term '{self.name}' ({self.kind}): value is {self.value}, expected {expected}")
        if (self.size > 0) != (self.kind == "observation"):
            length = "its length" if self.kind == "observation" else "0"
            raise ConfigError(f"term '{self.name}': size is {self.size}, expected {length} for kind='{self.kind}'")
        if self.start is None and (self.update is not Term.update or self.kind == "memory"):
            raise ConfigError(f"term '{self.name}': has a memory but no start, expected (nav) -> memory; give start=")

    def evaluate(self, memory: Any, at: Any) -> jax.Array:
        """Return its value, of the shape that its kind has."""
        assert self.value is not None
        value, shape = jnp.asarray(self.value(memory, at)), (self.size,) if self.size else ()
        if value.shape != shape:
            raise ConfigError(f"term '{self.name}': its value has shape {value.shape}, expected {shape}")
        return value

    def updated(self, memory: Any, step: Step) -> Any:
        """Return its memory after a control step, of the shapes and types that it had."""
        new = self.update(memory, step)
        before, after = (jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", tree) for tree in (memory, new))
        if before != after:
            raise ConfigError(f"term '{self.name}': update returns {after}, expected what start returns: {before}")
        return new

    @property
    def key(self) -> str:
        """Return its key in `state.metrics` and `NavInfo.memory`."""
        return f"reward/{self.name}" if self.kind == "reward" else self.name


_VALUES = {
    **dict.fromkeys(("reward", "metric"), "(memory, Step) -> []"),
    **{"observation": "(memory, Moment) -> (size,)", "memory": "none; call it a metric to report it"},
}


def _moved_m(delta: jax.Array) -> jax.Array:
    """Return the length of displacements [..., 3] in a control step; 0 below `STILL_M`."""
    length = jnp.sqrt(jnp.sum(delta**2, -1))
    return jnp.where(length < STILL_M, 0.0, length)


def _count(name: str, doc: str, of: Callable[[Step], jax.Array]) -> Term:
    """Build a metric that counts control steps."""
    return Term(name, doc, "metric", lambda n, step: n, lambda nav: jnp.int32(0), lambda n, step: n + of(step))


def _whole(step: Step, flag: jax.Array) -> jax.Array:
    return (~step.broken).astype(jnp.int32) * flag.astype(jnp.int32)


def _object_path(path_m: jax.Array, step: Step) -> jax.Array:
    tables, nav, last = step.tables, step.nav, step.last
    pushed = jnp.where(tables.mass_kg[nav.scene_index, 1:] > 0, _moved_m(nav.object_pos_w - last.object_pos_w), 0.0)
    touched = last.memory["object_contact_steps"] + (~step.broken & step.touches) > 0
    settled = last.step_count >= SETTLE_STEPS
    counts = touched if step.config.kinematic_sum == "touched" else touched | settled
    return path_m + jnp.where(counts, pushed, 0.0)


def advance_odometry(
    pose: jax.Array, moved_w: jax.Array, yaw_rad: jax.Array, turned_rad: jax.Array, noise: jax.Array
) -> jax.Array:
    """Advance the dead reckoning `pose` (3,) x, y (m), yaw (rad, not wrapped) by one control step.

    It is relative to the episode's start. `moved_w` (2,) m is the true displacement, `noise` (2,) the relative error of
    distance and angle.
    """
    cos, sin = jnp.cos(pose[2] - yaw_rad), jnp.sin(pose[2] - yaw_rad)
    x, y = moved_w * (1 + noise[0])
    return pose + jnp.stack([cos * x - sin * y, sin * x + cos * y, turned_rad * (1 + noise[1])])


def _odometry(pose: jax.Array, step: Step) -> jax.Array:
    nav, last, noise = step.nav, step.last, step.config.odometry_noise
    slip = jnp.zeros(2)
    if noise:
        slip = noise * jax.random.normal(stream(step.rng, "odometry", last.step_count), (2,))
    moved = (nav.robot_pos_w - last.robot_pos_w)[:2]
    return advance_odometry(pose, moved, last.yaw_rad, wrap_angle(nav.yaw_rad - last.yaw_rad), slip)


def masses_kg(at: Moment) -> jax.Array:
    """Return (M + 1,) kg: the robot's for the scores, then the objects'."""
    tables_kg, dynamics = at.tables.mass_kg[at.nav.scene_index], at.nav.dynamics
    if dynamics is not None and "random_mass" in dynamics.drawn:
        tables_kg = tables_kg * dynamics.drawn["random_mass"]
    return tables_kg.at[0].set(at.score_mass_kg)


def _path_efficiency(memory: Any, step: Step) -> jax.Array:
    nav, clip = step.nav, step.config.clip_path_efficiency
    return metrics.path_efficiency(step.success, nav.shortest_path_m, nav.memory["robot_path_m"], clip)


def _counts(step: Step) -> jax.Array | float:
    return 1.0 if step.config.effort_on_failure else jnp.asarray(step.success, jnp.float32)


def _kinematic_effort(memory: Any, step: Step) -> jax.Array:
    paths = jnp.concatenate([step.nav.memory["robot_path_m"][None], step.nav.memory["object_path_m"]])
    return _counts(step) * metrics.kinematic_effort(masses_kg(step), paths)


def _dynamic_effort(memory: Any, step: Step) -> jax.Array:
    force_n, gravity = step.nav.memory["force_sum_n"], step.config.score_gravity_m_s2
    return _counts(step) * metrics.dynamic_effort(step.score_mass_kg, force_n, step.nav.step_count, gravity)


def _off_distance(memory: Any, step: Step) -> jax.Array:
    nav, config = step.nav, step.config
    near = jnp.linalg.norm(nav.start_xy_w - nav.goal_xy_w) < config.min_goal_distance_m - DISTANCE_TOLERANCE_M
    return near | (nav.shortest_path_m > config.max_goal_distance_m + DISTANCE_TOLERANCE_M)


def _reward(step: Step) -> dict[str, jax.Array]:
    config, before_m, after_m = step.config, step.last.geodesic_m, step.nav.geodesic_m
    interacts = jnp.any(step.touches)
    if config.interaction_with == "anything":
        interacts = step.signals.body_force_n > TOUCH_FORCE_N
    success, interacts = step.success.astype(jnp.float32), interacts.astype(jnp.float32)
    values = success, before_m, after_m, interacts, config.k_int, config.success_reward
    return interactive_navigation_reward(*values)[1]


TERMS = (
    Term("success", "Reward of reaching the goal.", "reward", lambda _, step: _reward(step)["success"]),
    Term("potential", "Geodesic progress, m.", "reward", lambda _, step: _reward(step)["potential"]),
    Term("interaction", "-k_int in a control step with a touched object.", "reward",
         lambda _, step: _reward(step)["interaction"]),
    Term("success", "1 where the goal was reached.", "metric", lambda _, step: step.success),
    Term("path_efficiency", "P_eff in [0, 1].", "metric", _path_efficiency),
    Term("effort_efficiency", "E_eff in [0, 1].", "metric",
         lambda _, step: 0.5 * (_kinematic_effort(_, step) + _dynamic_effort(_, step))),
    Term("kinematic_effort", "Share of moved mass times path that is the robot's, in [0, 1].", "metric",
         _kinematic_effort),
    Term("dynamic_effort", "Weight over weight and force, in (0, 1].", "metric", _dynamic_effort),
    Term("ins_0.5", "INS with alpha = 0.5, in [0, 1].", "metric",
         lambda _, step: metrics.interactive_navigation_score(
             _path_efficiency(_, step), 0.5 * (_kinematic_effort(_, step) + _dynamic_effort(_, step)), 0.5)),
    Term("robot_path_m", "l_0, m.", "metric", lambda path_m, step: path_m, lambda nav: jnp.zeros(()),
         lambda path_m, step: path_m + _moved_m(step.nav.robot_pos_w - step.last.robot_pos_w)),
    Term("shortest_path_m", "L*, m: the geodesic among static structure at the start.", "metric",
         lambda _, step: step.nav.shortest_path_m),
    Term("object_displacement_kg_m", "Sum of m_i l_i over the movable objects, kg m.", "metric",
         lambda _, step: jnp.sum(masses_kg(step)[1:] * step.nav.memory["object_path_m"])),
    Term("force_sum_n", "Sum of F_t over control steps, N.", "metric", lambda force_n, step: force_n,
         lambda nav: jnp.zeros(()), lambda force_n, step: force_n + jnp.where(step.broken, 0.0, step.signals.force_n)),
    Term("episode_steps", "Control steps.", "metric", lambda _, step: step.nav.step_count),
    Term("nonfinite", "1 where the state became not finite.", "metric", lambda _, step: step.broken),
    _count("interaction_steps", "With a touched movable object.", lambda step: _whole(step, jnp.any(step.touches))),
    _count("structure_steps", "With a touched wall.", lambda step: _whole(step, step.hits_structure)),
    _count("overflow_steps", "In which a contact or constraint buffer overflowed.", lambda step: step.signals.overflow),
    _count("left_out_steps", "In which an object within reach was not simulated (MJX's window was full).",
           lambda step: step.signals.left_out),
    _count("unconverged_steps", "In which the solver met its iteration limit.", lambda step: step.signals.unconverged),
    _count("crowded_steps", "In which more was awake than `active_dofs` has room for, and went unsolved.",
           lambda step: step.signals.crowded),
    Term("objects_dropped", "Small objects for which no free place was left: parked outside.", "metric",
         lambda _, step: step.nav.objects_dropped),
    Term("off_distance", "1 where start and goal are nearer or farther than the settings ask.", "metric",
         _off_distance),
    Term("lifted", "1 where the base was `LIFT_M` above its standing height.", "metric",
         lambda count, step: count > 0, lambda nav: jnp.int32(0),
         lambda count, step: count + _whole(step, step.lifted)),
    Term("clearance_m", "Distance from the footprint to the nearest wall or object, mean of control steps, m.",
         "metric", lambda sum_m, step: sum_m / step.nav.step_count, lambda nav: jnp.zeros(()),
         lambda sum_m, step: sum_m + step.clearance_m),
    Term("least_clearance_m", "The least of these distances in a control step, m.", "metric",
         lambda least_m, step: least_m, lambda nav: jnp.float32(CLEAR_M),
         lambda least_m, step: jnp.minimum(least_m, step.clearance_m)),
    Term("turning_rad_per_m", "Sum of the turns of control steps over l_0, which counts as at least 1 m, rad/m.",
         "metric", lambda turns, step: turns / jnp.maximum(step.nav.memory["robot_path_m"], 1.0),
         lambda nav: jnp.zeros(()),
         lambda turns, step: turns + jnp.abs(wrap_angle(step.nav.yaw_rad - step.last.yaw_rad))),
    Term("object_path_m", "(M,) l_i, m.", "memory", None,
         lambda nav: jnp.zeros(len(nav.object_pos_w)), _object_path),
    Term("object_contact_steps", "(M,) control steps in which the robot touched it.", "memory", None,
         lambda nav: jnp.zeros(len(nav.object_pos_w), jnp.int32),
         lambda count, step: count + (~step.broken & step.touches)),
    Term("object_force_sum_n", "(M,) sum over control steps of the largest net force, over substeps, on it, N.",
         "memory", None, lambda nav: jnp.zeros(len(nav.object_pos_w)),
         lambda force_n, step: force_n + jnp.where(step.broken, 0.0, step.signals.slot_force_n)),
    Term("touching", "(2,) bool: a movable object, a wall was touched in the last control step.", "memory", None,
         lambda nav: jnp.zeros(2, bool),
         lambda _, step: ~step.broken & jnp.stack([jnp.any(step.touches), step.hits_structure])),
    Term("odometry", "(3,) x, y (m) and yaw (rad) reckoned from the start's frame.", "observation",
         lambda pose, at: pose.at[2].set(wrap_angle(pose[2])), lambda nav: jnp.zeros(3), _odometry, 3),
)  # fmt: skip
"""The benchmark's terms, metrics in the order of the columns of rows."""
HOOK_TERMS = (
    Term("hook", "1 if it holds something, and x, y, z of the coupled point, robot frame, m; else 0.", "observation",
         lambda _, at: jnp.where(
             at.physics.hook[0] >= 0,
             jnp.append(1.0, (at.physics.hook[5:] - at.nav.robot_pos_w) @ at.rotation), 0.0), size=4),
    _count("hook_steps", "After which the hook held something.", lambda step: _whole(step, step.physics.hook[0] >= 0)),
    _count("hook_torn", "In which what the hook held was torn away.",
           lambda step: _whole(step, step.physics.hook[0] == TORN)),
)  # fmt: skip
"""The terms of a robot with a hook."""


def hand_term(env: Any) -> Term:
    """Return what an environment whose robot has a hand observes of it (`docs/add-a-robot.md`)."""
    world, robot = env.world, env.robot
    if not robot.hand:
        raise ConfigError(f"observations has 'hand', expected a robot with a hand; robot '{robot.name}' has none")
    model, bodies = world.models[0], world.layout.robot_bodies.tolist()
    links, hand = make_links(model, bodies), bodies.index(model.body(robot.hand).id)
    grip_b = model.site_pos[model.site_bodyid == bodies[hand]].sum(0)  # its only site; without one, its origin
    fingers = model.jnt_qposadr[model.body_parentid[model.jnt_bodyid] == bodies[hand]]

    def value(touched: jax.Array, at: Moment) -> jax.Array:
        scene, qpos, boxes = at.nav.scene_index, at.physics.qpos, env.sensors.boxes
        origin, axes = links.frames(qpos)[hand]
        place = origin + apply_axes(axes, repeated(qpos, grip_b))
        gaps_m2 = box_gaps_m2(boxes, scene, qpos, place[:2], (place[2] - HAND_REACH_M, place[2] + HAND_REACH_M))
        gaps_m2 = jnp.where(boxes.body < world.layout.num_slots, gaps_m2, CLEAR_M**2)
        box, gap_m = jnp.argmin(gaps_m2), jnp.minimum(jnp.sqrt(gaps_m2.min()), CLEAR_M)
        touches = jnp.append(touched, False)[jnp.asarray(boxes.body)[box]] & (gap_m <= HAND_REACH_M)
        kind = boxes.class_id[scene, box] / SEGMENTATIONS[boxes.classes].divisor
        middle = (box_poses(boxes, scene, qpos)[0][box] - place) @ at.rotation
        seen = jnp.where(gap_m < CLEAR_M, jnp.stack([touches, kind, *middle]), 0.0)
        return jnp.stack([*((place - at.nav.robot_pos_w) @ at.rotation), qpos[fingers].sum(), gap_m, *seen])

    doc = "Hand, m; opening, m; of the nearest movable body gap, m, touched, class, and middle from the hand, m."
    start, update = lambda nav: jnp.zeros(len(nav.object_pos_w), bool), lambda _, step: ~step.broken & step.touches
    return Term("hand", doc, "observation", value, start, update, 10)


EPISODE_METRICS = tuple(term.key for term in TERMS if term.kind == "metric")
REWARD_TERMS = tuple(term.key for term in TERMS if term.kind == "reward")
