"""Define the records of `reset` and `step`: frozen structs of arrays, with the shapes of one environment."""

from typing import Any

import flax.struct
import jax

FAILURES = ("nonfinite", "overflow_steps", "left_out_steps", "crowded_steps", "unconverged_steps")
"""Metrics of an episode that count what physics lost (`interactive_nav.physics.base.StepSignals`)."""
LOST = ("overflow_steps", "left_out_steps", "crowded_steps")
"""Those of them that are steps in which forces or bodies were missing."""
OF_OBJECTS = ("object_path_m", "object_contact_steps", "object_force_sum_n")
"""Terms whose memory rows report by category."""


@flax.struct.dataclass
class Targets:
    """Hold what a task with targets (`NavConfig.task`) draws episodes from; S scenes, k pairs, M movable slots."""

    slot: jax.Array
    """[S, k] i32 the target of each pair."""
    pair_xy_w: jax.Array
    """[S, k, 2, 2] f32 start and goal, m, by the length of the path between them."""
    path_m: jax.Array
    """[S, k] f32 that length."""
    hinge_w: jax.Array
    """[S, M, 3] f32 a point of the hinge; without one, the centre of mass at rest."""
    span: jax.Array
    """[M] f32 rad or m that count as open."""
    address: jax.Array
    """[M] i32 of the joint in qpos; -1: none."""
    category: jax.Array
    """[S, M + 1] i32 number in `interactive_nav.task.targets.CATEGORIES`; the last is the walls'."""


@flax.struct.dataclass
class SceneTables:
    """Hold constants of all scenes on the device; S scenes, M movable slots, padded alike.

    Navigation: n nodes, V corners, of which a node sees at most K; index V means none, infinitely far.
    """

    rest_qpos: jax.Array
    """[S, nq] f32 furniture at rest, robot and small objects parked."""
    mass_kg: jax.Array
    """[S, M + 1] f32, index 0 the robot; 0 for an empty slot."""
    com_m: jax.Array
    """[S, M, 3] f32 centre of mass in the body's frame."""
    node_of_cell: jax.Array
    """[S, rows, columns] i32 the node that stands for each cell."""
    grid_origin_w: jax.Array
    """[S, 2] f32 outer corner of cell [0, 0]."""
    node_xy_w: jax.Array
    """[S, n, 2] f32 free points that the nodes stand at."""
    visible: jax.Array
    """[S, n, K] u16 or i32 corners in each node's sight."""
    corner_xy_w: jax.Array
    """[S, V + 1, 2] f32."""
    corner_distance_m: jax.Array
    """[S, V + 1, V + 1] f32."""
    next_corner: jax.Array
    """[S, V + 1, V + 1] u16 or i32 the next corner on the way from the row's to the column's."""
    free: jax.Array
    """[S, R, C] bool fine cells that the robot's centre may be in."""
    start_xy_w: jax.Array
    """[S, p, 2] f32 middles of fine cells all over which the robot stands clear of structure and furniture."""
    num_starts: jax.Array
    """[S] i32."""
    goal_xy_w: jax.Array
    """[S, g, 2] f32 middles of fine cells of goals: as the starts, or clear of structure only."""
    num_goals: jax.Array
    """[S] i32."""
    clutter_xy_w: jax.Array
    """[S, q, 2] f32 middles of fine cells all over which the largest small object lies clear."""
    num_clutter: jax.Array
    """[S] i32."""
    fallback_pairs_xy_w: jax.Array
    """[S, k, 2, 2] f32 starts and goals (middles of fine cells) as far apart as required, where drawing finds none."""
    targets: Targets | None = None
    """None: the task is `reach`."""
    cell_m: float = flax.struct.field(pytree_node=False, default=0.1)
    """Side of a navigation cell."""
    fine_m: float = flax.struct.field(pytree_node=False, default=0.05)
    """Side of a fine cell."""
    sight_samples: int = flax.struct.field(pytree_node=False, default=64)
    """Samples of a line of sight: denser than the thinnest wall, across the largest scene."""


@flax.struct.dataclass
class GoalField:
    """An episode's goal and what every corner of its scene has left to it."""

    xy_w: jax.Array
    """(2,) f32, m."""
    corner_m: jax.Array
    """(V + 1,) f32 geodesic distance from each corner; infinite for the last, which is none."""
    next_corner: jax.Array
    """(V + 1,) i32 where the path goes next; V: straight to the goal."""


@flax.struct.dataclass
class EpisodeDynamics:
    """What an episode drew: setting -> value, of `random_wheel_slip` left and right. Delays of at most K steps hold
    (K, A) commands, the newest last, and observations: of the last K + 1 steps in turn, then the episode's first."""

    drawn: dict[str, jax.Array]
    commands: jax.Array | None
    seen: Any


Detour = tuple[GoalField, jax.Array] | None


@flax.struct.dataclass
class NavInfo:
    """The task's memory of one episode."""

    scene_index: jax.Array
    """[] i32."""
    goal_xy_w: jax.Array
    """(2,) f32, m."""
    goal_field: GoalField
    """What the geodesic needs to know of the goal."""
    start_xy_w: jax.Array
    """(2,) f32, m."""
    robot_pos_w: jax.Array
    """(3,) f32, m: base frame."""
    yaw_rad: jax.Array
    """[] f32."""
    waypoints_b: jax.Array
    """(W, 2) f32, m, robot frame."""
    object_pos_w: jax.Array
    """(M, 3) f32, m: centres of mass."""
    geodesic_m: jax.Array
    """[] f32 distance to the goal for the body, from which the potential follows: among static structure, and round
    heavy furniture with `potential_round`."""
    shortest_path_m: jax.Array
    """[] f32 L*: the distance among static structure at the start."""
    objects_dropped: jax.Array
    """[] i32 small objects without a free place: parked outside."""
    step_count: jax.Array
    """[] i32 control steps done."""
    memory: dict[str, Any]
    """The memory of each term, by its key (`interactive_nav.task.terms`)."""
    round_field: Detour = None
    """With `potential_round`: what the geodesic round heavy furniture needs to know, and [] bool whether it counts."""
    dynamics: EpisodeDynamics | None = None
    """With random dynamics."""
    target: jax.Array | None = None
    """[] i32 slot of the target, in tasks with one."""


@flax.struct.dataclass
class EpisodeStart:
    """What one draw of an episode decides."""

    scene_index: jax.Array
    """[] i32."""
    start_xy_w: jax.Array
    """(2,) f32, m."""
    start_yaw_rad: jax.Array
    """[] f32."""
    goal_xy_w: jax.Array
    """(2,) f32, m."""
    small_xy_w: jax.Array
    """(num_objects, 2) f32."""
    small_yaw_rad: jax.Array
    """(num_objects,) f32."""
    small_placed: jax.Array
    """(num_objects,) bool; False: parked."""
    target: jax.Array | None = None
    """[] i32 slot of the target, in tasks with one."""
