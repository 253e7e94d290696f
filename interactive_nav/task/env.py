"""Define InteractiveNav, a Brax environment with pure `reset` and `step`, by wiring parts together.

Episodes follow section IV of Interactive Gibson (Xia et al. 2020); `docs/design.md` lists where paper and code differ.
"""

import dataclasses
import functools
import operator
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from interactive_nav.config import SIGNALS, NavConfig
from interactive_nav.navigation.lookup import (
    all_free,
    cell_centre,
    geodesic_at,
    goal_field,
    grid_waypoints_at,
    waypoints_at,
)
from interactive_nav.navigation.placement import draw_episode, place_small
from interactive_nav.navigation.tables import LOW_M, build_tables, furniture_map, rest_poses, round_tables
from interactive_nav.physics import PhysicsState, StepSignals, make_physics
from interactive_nav.physics.base import TOUCH_FORCE_N
from interactive_nav.physics.hook import COUPLING_M, NONE, Hook
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.scene import Scene
from interactive_nav.scenes.slots import parking_spot
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.boxes import CLEAR_M, apply_axes, body_poses, box_gaps_m2
from interactive_nav.sensing.sensors import Sensors
from interactive_nav.task.dynamics import Dynamics
from interactive_nav.task.privileged import PRIVILEGED_SIZE, privileged_state
from interactive_nav.task.targets import TERMS_OF_TASKS, achieved, build_targets, reaching_terms
from interactive_nav.task.terms import HOOK_TERMS, TERMS, Moment, Step, Term, hand_term
from interactive_nav.types import Detour, EpisodeStart, GoalField, NavInfo
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import matrix_from_quat

LIFT_M = 0.2
"""A base that rises this far above its standing height has left the floor (the original's early failure)."""


class InteractiveNav(Env):
    """A robot reaches a goal in a cluttered home; pushing things aside is allowed and costs something.

    Observation: f32 (29,) by default, a dict with images, see `interactive_nav.sensing.sensors`.
    Action: f32 (A,) in [-1, 1], one per actuator (wheels: left, right).
    Reward: the sum of its reward terms: success + potential + interaction, see `interactive_nav.reward`.
    Done: success, time limit, a non-finite state, or dropped contacts; `info["truncation"]` is 1 where the
    episode was cut by the time limit or by dropped contacts, `info["time_out"]` for the former alone. `done` stays 1
    until a reset, and pays nothing.
    Metrics: `metric_names` are the episode's scores on its last step and 0 before, so that their sum over an episode
    is the score; `reward_names` are each step's reward terms.
    """

    def __init__(self, robot: RobotSpec, scenes: tuple[Scene, ...], config: NavConfig, terms: Sequence[Term] = ()):
        """Build models, tables and physics of loaded scenes, with added `terms`; raise what `make` does."""
        robot = robot.symmetric() if config.symmetric_actions else robot
        robot = robot.hooked() if config.hook_force_n else robot
        self.robot, self.scenes, self.config = robot, scenes, config
        self.world = build_world(robot, scenes, config)
        self.tables = build_tables(self.world, config)
        if config.task != "reach":
            self.tables = self.tables.replace(targets=build_targets(self.world, config, self.tables))
        limit = config.potential_round
        self._round = round_tables(self.world, self.tables, config, limit) if limit else None
        self.physics = make_physics(self.world, config)
        self.dynamics = Dynamics(config, robot)
        self.hook: Hook | None = self.physics.hook
        terms = (*terms, *(HOOK_TERMS if self.hook else ()), *TERMS_OF_TASKS[config.task], *reaching_terms(self))
        observed = config.observations
        self.terms = (*(t for t in TERMS if t.kind != "observation" or t.name in observed), *terms)
        keys = [t.key for t in self.terms]
        repeated = [key for key in keys if keys.count(key) > 1]
        repeated += [t.name for t in terms if t.kind == "observation" and t.name in SIGNALS]
        if repeated:
            raise ConfigError(f"terms: two are called '{repeated[0]}', expected different names; rename one")
        self.metric_names = tuple(t.key for t in self.terms if t.kind == "metric")
        self.reward_names = tuple(t.key for t in self.terms if t.kind == "reward")
        extra = {t.name: t.size for t in terms if t.kind == "observation"}
        self.terms += (hand_term(self),) if "hand" in observed else ()
        self.sensors = Sensors(self.world, config, self.physics.name, extra)
        self.success_distance_m = config.success_distance_m or robot.body_width_m
        total, base = self.world.robot_mass_kg, self.world.models[0].body_mass[self.world.layout.robot_bodies[0]]
        masses_kg = {"total": total, "links": total - robot.root_link_kg, "base": float(base)}
        self.score_mass_kg = masses_kg[config.robot_mass]  # m_0 as the scores take it
        self._constants = config, self.tables, self.score_mass_kg
        self._small_radius_m = jnp.asarray([o.radius_m for o in self.world.small_objects], jnp.float32)
        self._num_small = len(self.world.small_objects)
        self._parking = jnp.asarray([parking_spot(i) for i in range(self._num_small)], jnp.float32).reshape(-1, 2)

    @property
    def backend(self) -> str:
        """Return the physics backend in use: warp, jax or native."""
        return self.physics.name

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:  # type: ignore[override]
        """Return the length of the observation; with images, the shape under each key."""
        return self.sensors.observation_size

    @property
    def action_size(self) -> int:
        """Return the number of actions."""
        return self.robot.action_size

    @property
    def dt(self) -> float:
        """Return the control period, s."""
        return self.config.control_dt_s

    def furniture_map(self, scene: int) -> np.ndarray:
        """Return [rows, columns] bool on a scene's map: where furniture stands at rest, below the robot's height."""
        return furniture_map(self.scenes[scene], rest_poses(self.world, scene), self.robot.height_m)

    def reset(self, rng: jax.Array, scene: jax.Array | None = None) -> State:
        """Return the first state of a new episode; `rng`, one key, is consumed; `scene`, [] i32, is drawn if None."""
        return self.observe(self.draw(rng, scene))

    def draw(self, rng: jax.Array, scene: jax.Array | None = None, **limit: jax.Array) -> State:
        """Do `reset` without an observation: `obs` is empty until `observe`; `limit` is as in `draw_start`."""
        rng, key = jax.random.split(rng)
        return self._begin(self.draw_start(key, scene, **limit), rng)

    def draw_start(self, key: jax.Array, scene: jax.Array | None = None, **limit: jax.Array) -> EpisodeStart:
        """Return an episode's start; `key` is consumed, `scene` [] i32 drawn if None, `limit` may hold `limit_m` []."""
        radii_m = self._small_radius_m, self.robot.footprint_radius_m
        return draw_episode(key, self.tables, *radii_m, self.config, scene, **limit)

    def strew(self, key: jax.Array, start: EpisodeStart) -> EpisodeStart:
        """Return one environment's given episode with its small objects drawn: clear of start, goal and each other."""
        key_place, key_turn = jax.random.split(key)
        free, scene = [start.start_xy_w, start.goal_xy_w], start.scene_index
        xy, ok = place_small(key_place, self.tables, scene, self._small_radius_m, free, self.robot.footprint_radius_m)
        turn = jax.random.uniform(key_turn, ok.shape, minval=-jnp.pi, maxval=jnp.pi)
        return start.replace(small_xy_w=xy, small_yaw_rad=turn, small_placed=ok)

    def reset_to(self, start: EpisodeStart, rng: jax.Array) -> State:
        """Return the first state of a given episode (fixed evaluation episodes, tests), with `rng` for the next one."""
        return self.observe(self._begin(start, rng))

    def _begin(self, start: EpisodeStart, rng: jax.Array) -> State:
        physics = self.initial_physics(start)
        pos_w, rotation = self._robot_pose(physics)
        scene = start.scene_index
        goal = goal_field(self.tables, scene, start.goal_xy_w)
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
            waypoints_b=self._waypoints(scene, goal, detour, pos_w, rotation),
            shortest_path_m=geodesic_at(self.tables, scene, goal, pos_w[:2]),
            objects_dropped=jnp.sum(~start.small_placed).astype(jnp.int32),
            round_field=detour,
            target=start.target,
            **self._at_start(scene, physics, geodesic_m),
        )
        zero = jnp.zeros(())
        info = {"nav": self._remember(nav), "rng": rng, "truncation": zero, "time_out": zero}
        names = (*self.metric_names, *self.reward_names)
        state = State(physics, (), zero, zero, {name: zero for name in names}, info)  # pyright: ignore[reportArgumentType]
        return self.dynamics.begin(state, self._observation)

    def _at_start(self, scene: jax.Array, physics: PhysicsState, geodesic_m: jax.Array) -> dict[str, Any]:
        """Return the fields of `NavInfo` that change within an episode, as they are at its start."""
        pos_w, rotation = self._robot_pose(physics)
        poses = {
            "robot_pos_w": pos_w,
            "yaw_rad": _yaw(rotation),
            "object_pos_w": self._object_positions(scene, physics),
        }
        return poses | {"geodesic_m": geodesic_m, "step_count": jnp.zeros((), jnp.int32), "memory": {}}

    def _remember(self, nav: NavInfo) -> NavInfo:
        return nav.replace(memory={t.key: t.start(nav) for t in self.terms if t.start})

    def _resumed(self, nav: NavInfo, physics: PhysicsState, again: jax.Array) -> NavInfo:
        """Return `nav`, reset where a wrapper such as Brax's auto-reset has put the first physics back (`again`)."""
        scene, geodesic_m = nav.scene_index, nav.shortest_path_m
        if self.config.potential == "quantised" or self._round:
            geodesic_m = self._geodesic(scene, nav.goal_field, nav.round_field, self._robot_pose(physics)[0])
        first = self._remember(nav.replace(**self._at_start(scene, physics, geodesic_m)))
        return jax.tree.map(lambda new, old: old if new is old else jnp.where(again, new, old), first, nav)

    def step(self, state: State, action: jax.Array) -> State:
        """Advance one environment by a control period; clip `action` (A,) to [-1, 1], with non-finite entries as 0."""
        state = self.advance(state, action)
        return self.observe(state, blank=state.metrics["nonfinite"] > 0)

    def observe(self, state: State, blank: jax.Array | bool = False) -> State:
        """Return the state with the observation of where it is now; zeros where `blank`, as after a broken step."""
        state = self.dynamics.show(state, self._observation(state))
        return state.replace(obs=jax.tree.map(lambda x: jnp.where(blank, jnp.zeros_like(x), x), state.obs))

    def _observation(self, state: State) -> jax.Array | dict[str, jax.Array]:
        """Return the observation of where the state is now, without delay."""
        at = self._moment(state)
        parts = [t for t in self.terms if t.kind == "observation"]
        remembered = {t.name: t.evaluate(at.nav.memory.get(t.key), at) for t in parts}
        return self.sensors.observe(at.physics, at.nav, state.info["rng"], remembered)

    def _moment(self, state: State) -> Moment:
        physics: PhysicsState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        return Moment(*self._constants, state.info["nav"], physics, self._robot_pose(physics)[1])

    privileged_size = PRIVILEGED_SIZE

    def privileged(self, state: State) -> jax.Array:
        """Return the true state (`privileged_size`,) f32 of one environment; see `privileged_state`."""
        return privileged_state(self._moment(state), self.sensors.boxes)

    def advance(self, state: State, action: jax.Array) -> State:
        """Do `step` without an observation: `obs` stays what it was until `observe`."""
        config, nav = self.config, state.info["nav"]
        action = jnp.where(jnp.isfinite(action), action, 0.0)
        command = jnp.asarray(self.robot.command(action, jnp), jnp.float32)
        before: PhysicsState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        again = before.control_steps < nav.step_count
        nav = self._resumed(nav, before, again)
        over = (state.done > 0) & ~again
        time_s = nav.step_count * self.config.control_dt_s
        nav, command, change = self.dynamics.execute(nav, command, state.info.get("model"))
        before = before.replace(change=change)  # pyright: ignore[reportAttributeAccessIssue]
        before = self._grip(self.hook, nav, before, command[-1]) if self.hook else before
        physics, signals = self.physics.step(nav.scene_index, before, command, time_s)
        physics = self.hook.held(nav.scene_index, before.hook, physics) if self.hook else physics
        step = self._measure(nav, physics, signals, state.info["rng"])
        nav = step.nav
        physics = physics.replace(control_steps=nav.step_count)  # pyright: ignore[reportAttributeAccessIssue]

        # Contacts were dropped: what the robot did is no longer certain, and the episode ends here.
        lost = ~step.broken & (signals.overflow > 0)
        lifted = ~step.broken & ~lost & ~step.success & step.lifted & config.fail_when_lifted
        timed_out = ~step.success & ~step.broken & ~lost & ~lifted & (nav.step_count >= config.episode_steps)
        done = (step.success | timed_out | lifted | step.broken | lost).astype(jnp.float32)
        truncated = timed_out | lost if config.bootstrap_at_time_limit else lost
        ends = {"truncation": truncated.astype(jnp.float32), "time_out": timed_out.astype(jnp.float32)}

        memory = {t.key: t.updated(step.last.memory[t.key], step) for t in self.terms if t.start}
        nav = nav.replace(memory=memory)
        step = dataclasses.replace(step, nav=nav)
        scored = [t for t in self.terms if t.kind in ("reward", "metric")]
        values = {t.key: t.evaluate(memory.get(t.key), step) for t in scored}
        metrics = {name: done * jnp.asarray(values[name], jnp.float32) for name in self.metric_names}
        rewards = {name: values[name] for name in self.reward_names}
        reward = functools.reduce(operator.add, rewards.values())
        if not self.physics.reports_convergence:
            metrics["unconverged_steps"] = jnp.where(done > 0, jnp.nan, 0.0)

        # After its end an episode pays nothing and scores nothing more; that its physics broke is still reported.
        old = state.metrics | {name: jnp.zeros(()) for name in rewards}
        old |= {"nonfinite": jnp.maximum(old["nonfinite"], metrics["nonfinite"])}
        new = metrics | rewards
        old = {name: old[name] for name in new}, {name: state.info[name] for name in ends}, 0.0, 1.0
        new, ends, reward, done = jax.tree.map(lambda a, b: jnp.where(over, a, b), old, (new, ends, reward, done))
        info = state.info | {"nav": nav} | ends
        return state.replace(pipeline_state=physics, reward=reward, done=done, metrics=state.metrics | new, info=info)

    def _measure(self, last: NavInfo, physics: PhysicsState, signals: StepSignals, rng: jax.Array) -> Step:
        """Return a control step with the new pose and clock; a broken one leaves positions as they were."""
        scene, broken = last.scene_index, signals.nonfinite > 0
        pos_w, rotation = self._robot_pose(physics)
        rotation = jnp.where(broken, jnp.eye(3), rotation)
        pos_w = jnp.where(broken, last.robot_pos_w, pos_w)
        nav = last.replace(
            robot_pos_w=pos_w,
            yaw_rad=jnp.where(broken, last.yaw_rad, _yaw(rotation)),
            waypoints_b=self._waypoints(scene, last.goal_field, last.round_field, pos_w, rotation),
            object_pos_w=jnp.where(broken, last.object_pos_w, self._object_positions(scene, physics)),
            geodesic_m=self._geodesic(scene, last.goal_field, last.round_field, pos_w),
            step_count=last.step_count + 1,
        )
        flies = self.robot.kind == "flying"
        goal_w = jnp.concatenate([nav.goal_xy_w, jnp.full(1, self.robot.spawn_height_m if flies else 0.0)])
        away = (goal_w - pos_w)[: 3 if self.config.success_in_3d or flies else 2]
        at_goal = jnp.linalg.norm(away) < self.success_distance_m
        touches = (self.tables.mass_kg[scene, 1:] > 0) & (signals.slot_force_n > TOUCH_FORCE_N)
        if self.config.task in ("open", "fetch", "lift"):
            at_goal = achieved(self.config.task, self.tables, nav, physics.qpos, touches)
        success = at_goal & ~broken & (signals.overflow == 0)
        hits_structure = signals.structure_force_n > TOUCH_FORCE_N
        lifted = pos_w[2] - self.robot.spawn_height_m > LIFT_M
        gaps_m2 = box_gaps_m2(self.sensors.boxes, scene, physics.qpos, pos_w[:2], (LOW_M, self.robot.height_m))
        near_m = jnp.sqrt(gaps_m2.min(initial=CLEAR_M**2))
        clearance_m = jnp.where(broken, 0.0, jnp.maximum(near_m - self.robot.footprint_radius_m, 0.0))
        moment = nav, physics, rotation, last, signals, rng
        return Step(*self._constants, *moment, touches, hits_structure, clearance_m, lifted, broken, success)

    def _grip(self, hook: Hook, nav: NavInfo, physics: PhysicsState, wish: jax.Array) -> PhysicsState:
        """Return the physics state after the hook's command `wish` []; see `Hook.grip`."""
        scene, boxes, scale = nav.scene_index, self.sensors.boxes, 1.0
        x, y, z = hook.point_w(physics)
        gaps_m2 = box_gaps_m2(boxes, scene, physics.qpos, jnp.stack([x, y]), (z - COUPLING_M, z + COUPLING_M))
        gaps_m2 = jnp.where(boxes.body < self.world.layout.num_slots, gaps_m2, CLEAR_M**2)
        if nav.dynamics is not None:
            scale = nav.dynamics.drawn.get("random_mass", scale)
        return hook.grip(scene, physics, wish, jnp.asarray(boxes.body)[jnp.argmin(gaps_m2)], gaps_m2.min(), scale)

    def initial_physics(self, start: EpisodeStart) -> PhysicsState:
        """Return the physics' state that a given episode starts with."""
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
        hook, zero = jnp.asarray(NONE) if self.hook else None, jnp.zeros((), jnp.int32)
        return PhysicsState(qpos=qpos, qvel=still, qacc_warmstart=still, control_steps=zero, hook=hook)

    def _robot_pose(self, physics: PhysicsState) -> tuple[jax.Array, jax.Array]:
        at = self.world.layout.robot_qpos
        return physics.qpos[at : at + 3], matrix_from_quat(physics.qpos[at + 3 : at + 7])

    def _object_positions(self, scene: jax.Array, physics: PhysicsState) -> jax.Array:
        """Return (M, 3) centres of mass in the world frame."""
        pos_w, axes_w = body_poses(self.sensors.boxes, scene, physics.qpos)
        return pos_w[:-1] + apply_axes(axes_w[:-1], self.tables.com_m[scene])

    def _geodesic(self, scene: jax.Array, goal: GoalField, detour: Detour, pos_w: jax.Array) -> jax.Array:
        """Return [] m: the distance from which the potential follows."""
        xy = pos_w[:2]
        if self.config.potential == "quantised":
            xy = cell_centre(self.tables, scene, xy)
        plain_m = geodesic_at(self.tables, scene, goal, xy)
        if not (self._round and detour):
            return plain_m
        return jnp.where(detour[1], geodesic_at(self._round, scene, detour[0], xy), plain_m)

    def _waypoints(
        self, scene: jax.Array, goal: GoalField, detour: Detour, pos_w: jax.Array, rotation: jax.Array
    ) -> jax.Array:
        config = self.config
        points_at = grid_waypoints_at if config.waypoint_style == "grid" else waypoints_at
        ahead = pos_w[:2], config.num_waypoints, config.waypoint_spacing_m
        world = points_at(self.tables, scene, goal, *ahead)
        if self._round and detour and config.waypoints_round:
            world = jnp.where(detour[1], points_at(self._round, scene, detour[0], *ahead), world)
        offset = jnp.concatenate([world - pos_w[None, :2], jnp.zeros((len(world), 1))], -1)
        return (offset @ rotation)[:, :2]


def _yaw(rotation: jax.Array) -> jax.Array:
    return jnp.arctan2(rotation[1, 0], rotation[0, 0])
