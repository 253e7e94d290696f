"""InteractiveNav, a Brax environment: keys and actions in, states out; wiring only.

`reset` and `step` are pure, jit-able and vmap-able; every constant is made in `__init__`. Episodes follow
section IV of Interactive Gibson (Xia et al. 2020); where paper and code differ, `docs/design.md` says which
is meant.
"""

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from interactive_nav.config import NavConfig
from interactive_nav.navigation.lookup import (
    all_free,
    cell_centre,
    geodesic_at,
    goal_field,
    grid_waypoints_at,
    waypoints_at,
)
from interactive_nav.navigation.placement import draw_episode, place_small
from interactive_nav.navigation.tables import build_tables, furniture_map, rest_poses, round_tables
from interactive_nav.physics import PhysicsState, StepSignals, make_physics
from interactive_nav.physics.base import TOUCH_FORCE_N
from interactive_nav.reward import interactive_navigation_reward
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.slots import parking_spot
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.boxes import body_poses, rotate
from interactive_nav.sensing.observation import advance_odometry, waypoints_in_body
from interactive_nav.sensing.sensors import TRAIL, TRAIL_STEPS, Sensors
from interactive_nav.task.episode_scores import episode_scores, score_mass_kg
from interactive_nav.types import EPISODE_METRICS, EpisodeStart, GoalField, NavInfo
from interactive_nav_common.rotations import matrix_from_quat, wrap_angle

STILL_M = 1e-4
"""A centre of mass that moves less than this in a control step (1 mm/s) counts as at rest: solver noise."""
SETTLE_STEPS = 5
"""Small objects that come to rest in an episode's first control steps, untouched, have not been moved."""
LIFT_M = 0.2
"""A base that rises this far above its standing height has left the floor (the original's early failure)."""
REWARD_TERMS = ("reward/success", "reward/potential", "reward/interaction")


class InteractiveNav(Env):
    """A robot reaches a goal in a cluttered home; pushing things aside is allowed and costs something.

    Observation: f32 (29,) by default, see `interactive_nav.sensing.observation`; a dict with images, see
    `interactive_nav.sensing.sensors`.
    Action: f32 (A,) in [-1, 1], one per actuator (wheels: left, right).
    Reward: success + potential + interaction, see `interactive_nav.reward`.
    Done: success, time limit, a non-finite state, or dropped contacts; `info["truncation"]` is 1 where the
    episode was cut by the time limit or by dropped contacts, `info["time_out"]` for the former alone. `done` stays 1
    until a reset, and pays nothing.
    Metrics: `EPISODE_METRICS` are the episode's scores on its last step and 0 before, so that their sum
    over an episode is the score; `REWARD_TERMS` are each step's reward terms.
    """

    def __init__(self, robot: RobotSpec, scenes: tuple[Scene, ...], config: NavConfig):
        """Builds models, tables and the physics backend, for one loaded scene or more.

        Raises:
            ConfigError: settings that do not fit each other or the backend.
            SceneError: a scene with no room.
        """
        robot = robot.symmetric() if config.rules.symmetric_actions else robot
        self.robot, self.scenes, self.config = robot, scenes, config
        self.world = build_world(robot, scenes, config)
        self.tables = build_tables(self.world, config.rules)
        limit = config.rules.potential_round
        self._round = round_tables(self.world, self.tables, config.rules, limit) if limit else None
        self.physics = make_physics(self.world, config)
        self.sensors = Sensors(self.world, config, self.physics.name)
        self.success_distance_m = config.rules.success_distance_m or robot.body_width_m
        self.score_mass_kg = score_mass_kg(self.world, config.rules)
        self._small_radius_m = jnp.asarray([o.radius_m for o in self.world.small_objects], jnp.float32)
        self._num_small = len(self.world.small_objects)
        self._parking = jnp.asarray([parking_spot(i) for i in range(self._num_small)], jnp.float32).reshape(-1, 2)

    @property
    def backend(self) -> str:
        """Physics backend in use: warp, jax or native."""
        return self.physics.name

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:  # type: ignore[override]
        """Length of the observation; with images, the shape under each key."""
        return self.sensors.observation_size

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return self.robot.action_size

    @property
    def dt(self) -> float:
        """Control period, s."""
        return self.config.physics.control_dt_s

    def furniture_map(self, scene: int) -> np.ndarray:
        """[rows, columns] bool on a scene's map: where furniture stands at rest, below the robot's height."""
        return furniture_map(self.scenes[scene], rest_poses(self.world, scene), self.robot.height_m)

    def reset(self, rng: jax.Array, scene: jax.Array | None = None) -> State:
        """The first state of a new episode; `rng`, one key, is consumed, and `scene`, [] i32, is drawn where None."""
        return self.observe(self.draw(rng, scene))

    def draw(self, rng: jax.Array, scene: jax.Array | None = None) -> State:
        """`reset` without an observation: `obs` is empty until `observe`."""
        rng, key = jax.random.split(rng)
        return self._begin(self.draw_start(key, scene), rng)

    def draw_start(self, key: jax.Array, scene: jax.Array | None = None) -> EpisodeStart:
        """What an episode starts from, as `reset` draws it: `key` is consumed, `scene` is [] i32, None: drawn."""
        return draw_episode(
            key,
            self.tables,
            self._small_radius_m,
            self.robot.footprint_radius_m,
            self.config.rules.min_goal_distance_m,
            self.config.rules.max_goal_distance_m,
            scene,
            self.config.rules.goal_clear,
            self.config.rules.random_object_yaw,
        )

    def strew(self, key: jax.Array, start: EpisodeStart) -> EpisodeStart:
        """One environment's given episode with its small objects drawn: clear of start, goal and each other."""
        key_place, key_turn = jax.random.split(key)
        free, scene = [start.start_xy_w, start.goal_xy_w], start.scene_index
        xy, ok = place_small(key_place, self.tables, scene, self._small_radius_m, free, self.robot.footprint_radius_m)
        turn = jax.random.uniform(key_turn, ok.shape, minval=-jnp.pi, maxval=jnp.pi)
        return start.replace(small_xy_w=xy, small_yaw_rad=turn, small_placed=ok)

    def reset_to(self, start: EpisodeStart, rng: jax.Array) -> State:
        """The first state of a given episode (fixed evaluation episodes, tests); it carries `rng` for its next one."""
        return self.observe(self._begin(start, rng))

    def _begin(self, start: EpisodeStart, rng: jax.Array) -> State:
        physics = self.initial_physics(start)
        pos_w, rotation = self._robot_pose(physics)
        scene = start.scene_index
        goal = goal_field(self.tables, scene, start.goal_xy_w)
        waypoints_b = self._waypoints(scene, goal, pos_w, rotation)
        if self._round:
            ends = jnp.stack([start.start_xy_w, start.goal_xy_w])
            detour = goal_field(self._round, scene, start.goal_xy_w), all_free(self._round, scene, ends)
        else:
            detour = None
        geodesic_m = self._geodesic(scene, goal, detour, pos_w)
        nav = NavInfo(
            scene_index=scene,
            goal_xy_w=start.goal_xy_w,
            goal_field=goal,
            start_xy_w=start.start_xy_w,
            waypoints_b=waypoints_b,
            shortest_path_m=geodesic_at(self.tables, scene, goal, pos_w[:2]),
            objects_dropped=jnp.sum(~start.small_placed).astype(jnp.int32),
            round_field=detour,
            **self._at_start(scene, physics, geodesic_m),
        )
        zero = jnp.zeros(())
        info = {"nav": nav, "rng": rng, "truncation": zero, "time_out": zero}
        names = (*EPISODE_METRICS, *REWARD_TERMS)
        return State(physics, (), zero, zero, {name: zero for name in names}, info)  # pyright: ignore[reportArgumentType]

    def _at_start(self, scene: jax.Array, physics: PhysicsState, geodesic_m: jax.Array) -> dict[str, jax.Array]:
        """The fields of `NavInfo` that tell of the way since the start, with nothing done yet."""
        pos_w, rotation = self._robot_pose(physics)
        zero, count, slots = jnp.zeros(()), jnp.zeros((), jnp.int32), self.world.layout.num_slots
        counts = ("interaction_steps", "structure_steps", "overflow_steps", "left_out_steps", "unconverged_steps")
        return {
            "robot_pos_w": pos_w,
            "yaw_rad": _yaw(rotation),
            "object_pos_w": self._object_positions(scene, physics),
            "geodesic_m": geodesic_m,
            "robot_path_m": zero,
            "object_path_m": jnp.zeros(slots),
            "object_contact_steps": jnp.zeros(slots, jnp.int32),
            "object_force_sum_n": jnp.zeros(slots),
            "force_sum_n": zero,
            **dict.fromkeys((*counts, "lifted_steps", "step_count"), count),
            "odometry": jnp.zeros(3),
            "touching": jnp.zeros(2, bool),
            "trail_w": jnp.tile(pos_w[:2], (max(TRAIL) + 1 if "trail" in self.sensors.sizes else 0, 1)),
        }

    def _of_physics(self, nav: NavInfo, physics: PhysicsState, again: jax.Array) -> NavInfo:
        """The task's memory that belongs to this physics: none yet where a wrapper (Brax's auto-reset) has put the
        episode's first state back, which the clock in it tells (`again`)."""
        scene, geodesic_m = nav.scene_index, nav.shortest_path_m
        if self.config.rules.potential == "quantised" or self._round:
            geodesic_m = self._geodesic(scene, nav.goal_field, nav.round_field, self._robot_pose(physics)[0])
        first = self._at_start(scene, physics, geodesic_m)
        return nav.replace(**{name: jnp.where(again, value, getattr(nav, name)) for name, value in first.items()})

    def step(self, state: State, action: jax.Array) -> State:
        """Advances one environment by one control period.

        `action` is (A,) in [-1, 1]; it is clipped, and non-finite entries count as 0.
        """
        state = self.advance(state, action)
        return self.observe(state, blank=state.metrics["nonfinite"] > 0)

    def observe(self, state: State, blank: jax.Array | bool = False) -> State:
        """The state with the observation of where it is now; zeros where `blank`, as after a broken step."""
        nav: NavInfo = state.info["nav"]
        obs = self.sensors.observe(state.pipeline_state, nav, state.info["rng"])  # pyright: ignore[reportArgumentType]
        return state.replace(obs=jax.tree.map(lambda x: jnp.where(blank, jnp.zeros_like(x), x), obs))

    def advance(self, state: State, action: jax.Array) -> State:
        """`step` without an observation: `obs` stays what it was until `observe`."""
        action = jnp.where(jnp.isfinite(action), action, 0.0)
        command = jnp.asarray(self.robot.command(action, jnp), jnp.float32)
        before: PhysicsState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        again = before.control_steps < state.info["nav"].step_count
        last = nav = self._of_physics(state.info["nav"], before, again)
        over = (state.done > 0) & ~again
        physics, signals = self.physics.step(
            nav.scene_index, before, command, nav.step_count * self.config.physics.control_dt_s
        )
        broken = signals.nonfinite > 0
        nav = self._advance(nav, physics, signals, broken, state.info["rng"])
        physics = physics.replace(control_steps=nav.step_count)  # pyright: ignore[reportAttributeAccessIssue]

        # Contacts were dropped: what the robot did is no longer known, and the episode ends here.
        lost = ~broken & (signals.overflow > 0)

        flies = self.robot.kind == "flying"
        goal_w = jnp.concatenate([nav.goal_xy_w, jnp.full(1, self.robot.spawn_height_m if flies else 0.0)])
        away = goal_w - nav.robot_pos_w
        away = away if self.config.rules.success_in_3d or flies else away[:2]
        success = ~broken & ~lost & (jnp.linalg.norm(away) < self.success_distance_m)
        lifted = ~broken & ~lost & ~success & (nav.lifted_steps > 0) & self.config.rules.fail_when_lifted
        if self.config.rules.interaction_with == "anything":
            interacts = signals.body_force_n > TOUCH_FORCE_N
        else:
            interacts = self._touches(nav.scene_index, signals)
        reward, terms = interactive_navigation_reward(
            success.astype(jnp.float32),
            last.geodesic_m,
            nav.geodesic_m,
            interacts.astype(jnp.float32),
            self.config.rules.k_int,
            self.config.rules.success_reward,
        )
        timed_out = ~success & ~broken & ~lost & ~lifted & (nav.step_count >= self.config.rules.episode_steps)
        done = (success | timed_out | lifted | broken | lost).astype(jnp.float32)
        values = episode_scores(nav, self.config.rules, self.tables, self.score_mass_kg, success, broken)
        values = {name: done * value for name, value in values.items()}
        if not self.physics.tells_convergence:
            values["unconverged_steps"] = jnp.where(done > 0, jnp.nan, 0.0)
        values |= {f"reward/{name}": term for name, term in terms.items()}
        truncated = timed_out | lost if self.config.rules.bootstrap_at_time_limit else lost
        told = {"truncation": truncated.astype(jnp.float32), "time_out": timed_out.astype(jnp.float32)}
        # After its end an episode pays nothing and scores nothing more; that its physics broke is still told.
        terms = {f"reward/{name}": jnp.zeros(()) for name in terms}
        old = {**state.metrics, **terms, "nonfinite": jnp.maximum(state.metrics["nonfinite"], values["nonfinite"])}
        old = {name: old[name] for name in values}, {name: state.info[name] for name in told}, 0.0, 1.0
        new = values, told, reward, done
        values, told, reward, done = jax.tree.map(lambda a, b: jnp.where(over, a, b), old, new)
        return state.replace(
            pipeline_state=physics,
            reward=reward,
            done=done,
            metrics={**state.metrics, **values},
            info={**state.info, "nav": nav, **told},
        )

    def initial_physics(self, start: EpisodeStart) -> PhysicsState:
        """The physics' state that a given episode begins with."""
        layout = self.world.layout
        qpos = self.tables.rest_qpos[start.scene_index]
        yaw, at = start.start_yaw_rad, layout.robot_qpos
        pose = [*start.start_xy_w, self.robot.spawn_height_m, jnp.cos(yaw / 2), 0.0, 0.0, jnp.sin(yaw / 2)]
        qpos = qpos.at[at : at + 7].set(jnp.stack([jnp.asarray(v, jnp.float32) for v in pose]))
        if self._num_small:
            xy = jnp.where(start.small_placed[:, None], start.small_xy_w, self._parking)
            half, zeros = start.small_yaw_rad / 2, jnp.zeros(self._num_small)
            columns = [xy[:, 0], xy[:, 1], zeros, jnp.cos(half), zeros, zeros, jnp.sin(half)]
            address = layout.slot_qpos[: self._num_small, None] + np.arange(7)
            qpos = qpos.at[address].set(jnp.stack(columns, -1))
        still = jnp.zeros(self.physics.nv, jnp.float32)
        return PhysicsState(qpos=qpos, qvel=still, qacc_warmstart=still, control_steps=jnp.zeros((), jnp.int32))

    def _robot_pose(self, physics: PhysicsState) -> tuple[jax.Array, jax.Array]:
        at = self.world.layout.robot_qpos
        return physics.qpos[at : at + 3], matrix_from_quat(physics.qpos[at + 3 : at + 7])

    def _object_positions(self, scene: jax.Array, physics: PhysicsState) -> jax.Array:
        """(M, 3) centres of mass in the world frame."""
        pos_w, axes_w = body_poses(self.sensors.boxes, scene, physics.qpos)
        return pos_w[:-1] + rotate(axes_w[:-1], self.tables.com_m[scene])

    def _touches(self, scene: jax.Array, signals: StepSignals) -> jax.Array:
        occupied = self.tables.mass_kg[scene, 1:] > 0
        return jnp.any(occupied & (signals.slot_force_n > TOUCH_FORCE_N))

    def _geodesic(
        self, scene: jax.Array, goal: GoalField, detour: tuple[GoalField, jax.Array] | None, pos_w: jax.Array
    ) -> jax.Array:
        """[] m: the distance that the potential is made of."""
        xy = pos_w[:2]
        if self.config.rules.potential == "quantised":
            xy = cell_centre(self.tables, scene, xy)
        plain_m = geodesic_at(self.tables, scene, goal, xy)
        if not (self._round and detour):
            return plain_m
        return jnp.where(detour[1], geodesic_at(self._round, scene, detour[0], xy), plain_m)

    def _waypoints(self, scene: jax.Array, goal: GoalField, pos_w: jax.Array, rotation: jax.Array) -> jax.Array:
        rules = self.config.rules
        points_at = grid_waypoints_at if rules.waypoint_style == "grid" else waypoints_at
        world = points_at(self.tables, scene, goal, pos_w[:2], rules.num_waypoints, rules.waypoint_spacing_m)
        return waypoints_in_body(world, pos_w, rotation)

    def _advance(
        self, nav: NavInfo, physics: PhysicsState, signals: StepSignals, broken: jax.Array, rng: jax.Array
    ) -> NavInfo:
        """The task's memory after a step; a broken step leaves positions and totals as they were."""
        scene, goal = nav.scene_index, nav.goal_field
        pos_w, rotation = self._robot_pose(physics)
        rotation = jnp.where(broken, jnp.eye(3), rotation)
        pos_w = jnp.where(broken, nav.robot_pos_w, pos_w)
        objects = jnp.where(broken, nav.object_pos_w, self._object_positions(scene, physics))
        travelled = _moved(pos_w - nav.robot_pos_w)
        pushed = jnp.where(self.tables.mass_kg[scene, 1:] > 0, _moved(objects - nav.object_pos_w), 0.0)
        contact_steps = nav.object_contact_steps + (~broken & (signals.slot_force_n > TOUCH_FORCE_N))
        touched = contact_steps > 0
        settled = nav.step_count >= SETTLE_STEPS
        counts = touched if self.config.rules.kinematic_sum == "touched" else touched | settled
        pushed = jnp.where(counts, pushed, 0.0)
        ok = (~broken).astype(jnp.int32)
        lifted = pos_w[2] - self.robot.spawn_height_m > LIFT_M
        yaw = jnp.where(broken, nav.yaw_rad, _yaw(rotation))
        touches, hits_wall = self._touches(scene, signals), signals.structure_force_n > TOUCH_FORCE_N
        slip = self.sensors.odometry_error(rng, nav.step_count)
        return nav.replace(
            robot_pos_w=pos_w,
            yaw_rad=yaw,
            waypoints_b=self._waypoints(scene, goal, pos_w, rotation),
            object_pos_w=objects,
            geodesic_m=self._geodesic(scene, goal, nav.round_field, pos_w),
            robot_path_m=nav.robot_path_m + travelled,
            object_path_m=nav.object_path_m + pushed,
            object_contact_steps=contact_steps,
            object_force_sum_n=nav.object_force_sum_n + jnp.where(broken, 0.0, signals.slot_force_n),
            force_sum_n=nav.force_sum_n + jnp.where(broken, 0.0, signals.force_n),
            interaction_steps=nav.interaction_steps + ok * touches.astype(jnp.int32),
            structure_steps=nav.structure_steps + ok * hits_wall.astype(jnp.int32),
            overflow_steps=nav.overflow_steps + signals.overflow,
            left_out_steps=nav.left_out_steps + signals.left_out,
            unconverged_steps=nav.unconverged_steps + signals.unconverged,
            lifted_steps=nav.lifted_steps + ok * lifted.astype(jnp.int32),
            step_count=nav.step_count + 1,
            odometry=advance_odometry(
                nav.odometry, (pos_w - nav.robot_pos_w)[:2], nav.yaw_rad, wrap_angle(yaw - nav.yaw_rad), slip
            ),
            touching=~broken & jnp.stack([touches, hits_wall]),
            trail_w=jnp.where(
                (nav.step_count + 1) % TRAIL_STEPS == 0,
                jnp.concatenate([pos_w[None, :2], nav.trail_w])[: len(nav.trail_w)],
                nav.trail_w,
            ),
        )


def _yaw(rotation: jax.Array) -> jax.Array:
    return jnp.arctan2(rotation[1, 0], rotation[0, 0])


def _moved(delta: jax.Array) -> jax.Array:
    """[..., 3] displacement in a control step to metres travelled; below `STILL_M`, 0."""
    length = jnp.sqrt(jnp.sum(delta**2, -1))
    return jnp.where(length < STILL_M, 0.0, length)
