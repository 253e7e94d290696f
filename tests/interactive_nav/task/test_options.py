"""Every option row of the reference benchmark's table 11, each seen to change what it says and nothing else."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import interactive_nav
from interactive_nav.config import ORIGINAL_CODE, make_config
from interactive_nav.scenes.contacts import from_sensors, rolling_geoms, sensor_addresses
from interactive_nav.sensing.description import describe
from interactive_nav.task.terms import SETTLE_STEPS
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav.types import EpisodeStart
from interactive_nav_common.config import replace
from interactive_nav_common.errors import ConfigError, UserError
from scenes_mjcf.categories import SEGMENTATIONS, MaskClasses
from tests.toys import write_room

N = 3
MASS_KG, FRICTION = 1.0, 0.5


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """A 4 x 3 m room with a block of 1 kg 0.7 m ahead of where the tests start."""
    return write_room(
        tmp_path_factory.mktemp("options") / "pushed", (4.0, 3.0), (("basket", 0.0, 0.0, MASS_KG, FRICTION),)
    )


@functools.cache
def make(scene, **settings):
    """One environment for each setting of settings: they are asked for again."""
    return interactive_nav.make("turtlebot", [scene], backend="native", num_objects=0, **settings)


def start(goal=(1.6, 0.0), x=-0.7) -> EpisodeStart:
    """Heading along x towards the block; every environment alike."""
    return EpisodeStart(
        scene_index=jnp.zeros(N, jnp.int32),
        start_xy_w=jnp.broadcast_to(jnp.array([x, 0.0]), (N, 2)),
        start_yaw_rad=jnp.zeros(N),
        goal_xy_w=jnp.broadcast_to(jnp.asarray(goal), (N, 2)),
        small_xy_w=jnp.zeros((N, 0, 2)),
        small_yaw_rad=jnp.zeros((N, 0)),
        small_placed=jnp.zeros((N, 0), bool),
    )


# Wheels of 10 rad/s (0.35 m/s ahead), and both still (action 0 is 6.25 rad/s).
AHEAD, STILL = 0.2, -1.0 / 3.0


_RESETS: dict[bool, Any] = {}


def begin(env, goal=(1.6, 0.0), x=-0.7):
    """First state, which only options of waypoints and potential change: the others share a compiled reset."""
    config = env.config
    special = (config.waypoint_style, config.potential, config.potential_round) != (
        "ahead",
        "continuous",
        None,
    )
    if special or False not in _RESETS:
        reset = jax.jit(jax.vmap(env.reset_to))
        _RESETS[special] = reset
    return _RESETS[special](start(goal, x), jax.random.split(jax.random.PRNGKey(0), N))


@functools.cache
def stepper(env):
    """A step without its observation."""
    return jax.jit(jax.vmap(env.advance))


def play(env, actions, goal=(1.6, 0.0), x=-0.7):
    """States after each action, the first before any; (left, right) actions, or one for both."""
    states, step = [begin(env, goal, x)], stepper(env)
    for action in actions:
        states.append(step(states[-1], jnp.broadcast_to(jnp.asarray(action, jnp.float32), (N, 2))))
    return states


def value(states, name):
    infos = [s.info["nav"] for s in states]
    return np.array([np.asarray(nav.memory[name] if name in nav.memory else getattr(nav, name))[0] for nav in infos])


@pytest.fixture(scope="module")
def paper(pushed):
    return play(make(pushed), [AHEAD] * 30)


def test_the_original_code_at_once():
    config = make_config(variant="code", episode_steps=200)
    changed = {k: getattr(config, k) for k in ORIGINAL_CODE}
    assert changed == {**ORIGINAL_CODE, "episode_steps": 200}
    assert ORIGINAL_CODE["episode_steps"] == 500 and not config.bootstrap_at_time_limit
    with pytest.raises(UserError, match="variant is 'codes', expected one of paper, code"):
        make_config(variant="codes")
    assert make_config() == make_config(variant="paper")


@pytest.mark.parametrize(
    "setting",
    ["interaction_with", "kinematic_sum", "force_part", "force_sum", "robot_mass", "waypoint_style", "scene_choice"],
)
def test_a_word_that_is_no_choice_is_refused(setting):
    with pytest.raises(UserError, match=f"{setting} is 'nonsense', expected one of "):
        make_config(**{setting: "nonsense"})


def test_horizon_and_terminal_time_limit(pushed):
    env = make(pushed, episode_steps=4)
    states = play(env, [STILL] * 4)
    assert [float(s.done[0]) for s in states] == [0, 0, 0, 0, 1] and float(states[-1].info["truncation"][0]) == 1
    env = make(pushed, episode_steps=4, bootstrap_at_time_limit=False)
    last = play(env, [STILL] * 4)[-1]
    assert float(last.done[0]) == 1 and float(last.info["truncation"][0]) == 0 and float(last.info["time_out"][0]) == 1


def test_success_in_3d_counts_the_height(pushed):
    # 0.3 m away in the plane, 0.2 m up: 0.36 m in space, and success is below 0.333 m.
    for in_3d, reached in ((False, 1.0), (True, 0.0)):
        env = make(pushed, success_in_3d=in_3d)
        state = play(env, [], goal=(-0.4, 0.0))[0]
        physics = state.pipeline_state.replace(qpos=state.pipeline_state.qpos.at[:, 2].set(0.25))
        after = stepper(env)(state.replace(pipeline_state=physics), jnp.full((N, 2), STILL))
        assert 0.13 < float(after.info["nav"].robot_pos_w[0, 2]) < 0.25  # it has begun to fall
        assert float(after.metrics["success"][0]) == reached


def test_a_lifted_robot_is_recorded_and_fails_if_asked(pushed):
    for ends in (False, True):
        env = make(pushed, fail_when_lifted=ends, episode_steps=2)
        state = play(env, [])[0]
        physics = state.pipeline_state.replace(qpos=state.pipeline_state.qpos.at[:, 2].set(0.4))
        step = stepper(env)
        after = step(state.replace(pipeline_state=physics), jnp.full((N, 2), STILL))
        assert float(after.done[0]) == float(ends) and float(after.info["truncation"][0]) == 0
        last = after if ends else step(after, jnp.full((N, 2), STILL))
        assert float(last.metrics["lifted"][0]) == 1 and float(last.metrics["success"][0]) == 0
    assert float(play(make(pushed, episode_steps=1), [STILL])[-1].metrics["lifted"][0]) == 0


def test_interaction_with_walls_costs_only_if_asked(pushed):
    for what, cost in (("movables", 0.0), ("anything", -0.1)):
        last = play(make(pushed, interaction_with=what), [-1.0] * 12, x=-1.7)[-1]  # -0.44 m/s to the wall at x = -2
        assert float(last.info["nav"].memory["structure_steps"][0]) > 3
        assert float(last.metrics["reward/interaction"][0]) == pytest.approx(cost)


def test_wheels_on_the_floor_are_no_interaction(pushed):
    states = play(make(pushed, interaction_with="anything"), [STILL, AHEAD, AHEAD])
    assert all(float(s.metrics["reward/interaction"][0]) == 0 for s in states)


def test_kinematic_sum_from_the_first_touch_on(pushed, paper):
    env = make(pushed)
    # The block slides by itself, untouched, after the first half second: it counts for the paper's sum only.
    state = play(env, [STILL] * SETTLE_STEPS)[-1]
    at = env.world.layout.slot_qvel[0]
    physics = state.pipeline_state.replace(qvel=state.pipeline_state.qvel.at[:, at].set(1.0))
    for kind, counted in (("touched", False), ("all", True)):
        env = make(pushed, kinematic_sum=kind)
        after = stepper(env)(state.replace(pipeline_state=physics), jnp.full((N, 2), STILL))
        assert (float(after.info["nav"].memory["object_path_m"][0, 0]) > 0.03) == counted
    both = [play(make(pushed, kinematic_sum="touched"), [AHEAD] * 30)[-1], paper[-1]]
    paths = [float(s.info["nav"].memory["object_path_m"][0, 0]) for s in both]
    assert paths[0] == pytest.approx(paths[1], abs=2e-3) and paths[0] > 0.2  # only the robot moves it


def forces(states):
    return np.diff(value(states, "force_sum_n"))


def test_full_force_is_friction_and_more_and_its_normal_part_is_less(pushed, paper):
    full = forces(paper)
    normal = forces(play(make(pushed, force_part="normal"), [AHEAD] * 30))
    contacts = forces(play(make(pushed, force_sum="contacts"), [AHEAD] * 30))
    last = forces(play(make(pushed, force_sum="last_substep"), [AHEAD] * 30))
    pushing = slice(20, 30)
    # That the force is right is tested beside the backends; here, that each option reaches the score.
    assert (full[pushing] >= normal[pushing] - 1e-3).all()
    assert 1.02 * normal[pushing].mean() < full[pushing].mean() < 1.3 * normal[pushing].mean()
    assert (contacts[pushing] >= full[pushing] - 1e-3).all()  # triangle inequality
    assert 0.5 < last[pushing].mean() / full[pushing].mean() < 2.0
    assert not np.allclose(last[pushing], full[pushing], rtol=1e-3)
    touched = np.flatnonzero(full > 0)[0]
    assert touched > 3
    for each in (normal, contacts, last):
        assert (each[:touched] == 0).all()  # driving freely is exactly 0


def test_the_listed_contacts_sum_to_the_net_force(pushed):
    """With friction the vector sum of the listed forces has the horizontal part of the net force's normal part."""
    env = make(pushed, force_part="normal")
    model = env.world.models[0]
    data = mujoco.MjData(model)
    data.qpos[:] = env.world.rest_qpos[0]
    at, slot = env.world.layout.robot_qpos, env.world.layout.slot_qpos[0]
    data.qpos[at : at + 7] = [data.qpos[slot] - 0.365, 0, 0, 1, 0, 0, 0]
    data.qvel[env.world.layout.robot_qvel] = 0.3
    data.ctrl[:] = 10.0
    net = np.zeros(3)
    for _ in range(15):  # until it pushes
        if np.linalg.norm(net) > 0.5:
            break
        mujoco.mj_step(model, data)
        net = data.sensordata[env.world.layout.force_sensors[0] + np.arange(3)].copy()
    vector, norm, touch = from_sensors(data.sensordata, sensor_addresses(model), "full", np)
    assert np.linalg.norm(net) > 0.5
    # The block's face is vertical: the normal part is the net force's horizontal part along x, up to sign.
    assert abs(vector[0]) == pytest.approx(abs(net[0]), rel=0.01)  # the robot pitches a little
    assert touch == pytest.approx(np.abs(vector).max(), rel=0.05)
    assert norm >= np.linalg.norm(net) - 1e-6


def test_wheels_and_casters_are_exempt_where_the_original_exempts_them(pushed):
    """A robot that stands on the block touches it with two wheels and a caster only."""
    for settings, force_n, cost in (
        ({}, 2.673 * 9.81, -0.1),
        ({"force_part": "normal"}, 0.0, -0.1),
        ({"interaction_with": "anything"}, 2.673 * 9.81, 0.0),
    ):
        env = make(pushed, **settings)
        state, step = begin(env), stepper(env)
        pose = jnp.array([0.0, 0.0, 0.4])
        physics = state.pipeline_state.replace(qpos=state.pipeline_state.qpos.at[:, :3].set(pose))
        state = state.replace(pipeline_state=physics)
        forces_n = [0.0]
        for _ in range(12):
            state = step(state, jnp.full((N, 2), STILL))
            forces_n.append(float(state.info["nav"].memory["force_sum_n"][0]))
        assert np.abs(np.asarray(state.info["nav"].robot_pos_w[0]) - pose).max() < 0.01  # stands there
        assert np.diff(forces_n)[-3:].mean() == pytest.approx(force_n, rel=0.03, abs=1e-3)
        assert float(state.metrics["reward/interaction"][0]) == pytest.approx(cost)
    # Each of the four is told apart from the body by name.
    model = make(pushed, force_part="normal").world.models[0]
    layout, robot = env.world.layout, env.robot
    named = {model.geom(int(g)).name for g in np.flatnonzero(rolling_geoms(model, robot, layout.robot_bodies))}
    assert len(named) == 4 and all("wheel" in name or "caster" in name for name in named)


def test_robot_mass_variants_and_gravity(pushed, paper):
    base = 2.473
    for which, mass in (("total", 2.673), ("base", base), ("links", 2.673)):
        env = make(pushed, robot_mass=which, score_gravity_m_s2=9.8, episode_steps=30)
        assert env.score_mass_kg == pytest.approx(mass)
        last = play(env, [AHEAD] * 30)[-1]
        nav = last.info["nav"]
        work = mass * float(nav.memory["robot_path_m"][0])
        kinematic = work / (work + MASS_KG * float(nav.memory["object_path_m"][0, 0]))
        dynamic = mass * 9.8 * 30 / (mass * 9.8 * 30 + float(nav.memory["force_sum_n"][0]))
        assert float(last.metrics["kinematic_effort"][0]) == pytest.approx(kinematic, rel=1e-4)
        assert float(last.metrics["dynamic_effort"][0]) == pytest.approx(dynamic, rel=1e-4)
    heavy = dataclasses.replace(env.robot, root_link_kg=1.0)
    other = interactive_nav.InteractiveNav(heavy, env.scenes, replace(env.config, robot_mass="links"))
    assert other.score_mass_kg == pytest.approx(1.673)


def test_unclipped_path_efficiency_and_effort_on_failure(pushed):
    # 0.45 m to go, success 0.333 m before it.
    for clip in (True, False):
        env = make(pushed, clip_path_efficiency=clip, min_goal_distance_m=0.1)
        state, step = begin(env, goal=(-0.25, 0.0)), stepper(env)
        for _ in range(20):
            state = step(state, jnp.full((N, 2), AHEAD))
            if float(state.done[0]):
                break
        ratio = 0.45 / float(state.metrics["robot_path_m"][0])
        assert float(state.metrics["success"][0]) == 1 and ratio > 1.5
        assert float(state.metrics["path_efficiency"][0]) == pytest.approx(1.0 if clip else ratio, rel=0.01)
    for counts in (True, False):
        last = play(make(pushed, effort_on_failure=counts, episode_steps=1), [STILL])[-1]
        assert float(last.metrics["effort_efficiency"][0]) == float(counts)
        assert float(last.metrics["ins_0.5"][0]) == 0.5 * counts


def test_grid_waypoints_in_the_observation(pushed):
    env = make(pushed, waypoint_style="grid")
    state = play(env, [])[0]
    # From (-0.7, 0), heading along x: the robot's own cell comes first, then every 0.2 m.
    points = np.asarray(state.info["nav"].waypoints_b[0]) + [-0.7, 0.0]
    assert np.linalg.norm(points[0] - [-0.7, 0.0]) < 0.08
    np.testing.assert_allclose(np.diff(points[:, 0]), 0.2, atol=1e-4)
    ahead = np.asarray(play(make(pushed), [])[0].info["nav"].waypoints_b[0])
    np.testing.assert_allclose(ahead[:, 0], 0.2 * np.arange(1, 11), atol=1e-4)


def test_a_quantised_potential_moves_in_steps_of_a_cell(pushed, paper):
    smooth = np.diff(value(paper, "geodesic_m"))[2:9]
    steps = np.diff(value(play(make(pushed, potential="quantised"), [AHEAD] * 12), "geodesic_m"))[2:]
    np.testing.assert_allclose(smooth, -0.035, atol=0.006)
    assert ((np.abs(steps) < 1e-3) | (np.abs(steps + 0.1) < 0.01)).all() and (steps < -0.05).sum() in (3, 4)


def round_a_square_m(half_m, radius_m, start_x, goal_x):
    """Length of a disc's shortest way past a square on the origin, from one place on the x axis to another: tangents to
    the circles about two of its corners, arcs, and the straight piece between them."""
    total = 2 * half_m
    for away in (abs(start_x) - half_m, goal_x - half_m):
        gap = math.hypot(away, half_m)
        heading = math.atan2(half_m, away) + math.asin(radius_m / gap)
        total += math.sqrt(gap**2 - radius_m**2) + radius_m * heading
    return total


def test_the_potential_goes_round_what_is_heavy_where_there_is_a_way(pushed, paper, tmp_path):
    env = make(pushed, potential_round=0.05)  # the block's friction is 0.5 kg, the robot weighs 2.7 kg
    states = play(env, [AHEAD] * 30)
    way_m = round_a_square_m(0.2, env.robot.footprint_radius_m, -0.7, 1.6)
    assert value(states, "geodesic_m")[0] == pytest.approx(way_m, abs=0.03)
    # The robot presses on: the plain potential pays for that, this one hardly does. Nothing else knows of it.
    assert value(paper, "geodesic_m")[[0, -1]] == pytest.approx([2.3, 2.3 - 0.95], abs=0.12)
    for name in ("shortest_path_m", "waypoints_b", "robot_pos_w", "object_path_m"):
        np.testing.assert_allclose(value(states, name), value(paper, name), atol=1e-5)
    rewards = np.array([np.asarray(s.metrics["reward/potential"])[0] for s in states[1:]])
    np.testing.assert_allclose(rewards, -np.diff(value(states, "geodesic_m")), atol=1e-5)

    guided = make(pushed, potential_round=0.05, waypoints_round=True)
    led = play(guided, [AHEAD] * 3)
    heavy = "furniture whose friction exceeds 0.05 of the robot's weight"
    assert describe(guided)["inputs"]["waypoints"]["avoids"] == heavy
    assert "avoids" not in describe(env)["inputs"]["waypoints"]
    radius_m, begin = env.robot.footprint_radius_m, np.asarray(led[0].info["nav"].waypoints_b)[0] + [-0.7, 0.0]
    assert (np.abs(begin).max(-1) > 0.2 + radius_m / math.sqrt(2) - 0.05).all()  # a disc there leaves the block alone
    assert np.linalg.norm(np.diff(begin, axis=0), axis=-1).sum() == pytest.approx(9 * 0.2, abs=0.05)
    np.testing.assert_allclose(value(led, "geodesic_m")[0], value(states, "geodesic_m")[0])
    assert np.abs(value(led, "waypoints_b") - value(paper, "waypoints_b")[:4]).max() > 0.3
    with pytest.raises(ConfigError, match="waypoints_round"):
        make(pushed, waypoints_round=True)

    light = play(make(pushed, potential_round=0.2), [])
    np.testing.assert_allclose(value(light, "geodesic_m"), 2.3, atol=1e-3)
    row = tuple(("basket", 0.0, y, MASS_KG, FRICTION) for y in (-1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.2))
    shut = write_room(tmp_path / "closed", (4.0, 3.0), row)
    closed = play(make(shut, potential_round=0.05, waypoints_round=True), [])
    assert not closed[0].info["nav"].round_field[1].any()
    np.testing.assert_allclose(value(closed, "geodesic_m"), 2.3, atol=1e-3)
    np.testing.assert_allclose(value(closed, "waypoints_b")[0, :, 1], 0.0, atol=1e-3)


def test_each_slot_keeps_its_scene(pushed, room):
    env = interactive_nav.make(
        "turtlebot", [pushed, room], backend="native", num_objects=0, episode_steps=3, scene_choice="slot"
    )
    auto = AutoResetEnv(env)
    state = jax.jit(auto.reset)(jax.random.split(jax.random.PRNGKey(3), 5))
    step = jax.jit(auto.step)
    goals = []
    for _ in range(7):
        np.testing.assert_array_equal(state.info["nav"].scene_index, [0, 1, 0, 1, 0])
        goals.append(np.asarray(state.info["nav"].goal_xy_w))
        state = step(state, jnp.full((5, 2), STILL))
    assert not np.array_equal(goals[0], goals[-1])  # new episodes did begin


def test_unchecked_goals_may_lie_under_furniture_and_objects_may_face_alike(pushed):
    free, checked = make(pushed, goal_clear=False), make(pushed)
    assert int(free.tables.num_goals[0]) > int(checked.tables.num_goals[0])
    goals = np.asarray(free.tables.goal_xy_w[0])[: int(free.tables.num_goals[0])]
    assert (np.abs(goals) < 0.15).all(1).any()  # the block covers |x|, |y| < 0.2 m
    env = interactive_nav.make("turtlebot", [pushed], backend="native", num_objects=3, random_object_yaw=False)
    draws = jax.jit(jax.vmap(env.draw_start))(jax.random.split(jax.random.PRNGKey(1), 20))
    assert (np.asarray(draws.small_yaw_rad) == 0).all() and np.asarray(draws.start_yaw_rad).std() > 0.5


def test_desks_are_tables_in_the_mask_unless_five_classes_are_asked_for(tmp_path):
    blocks = (("desk", 0.8, 0.5, 9.0, 0.5), ("table", 0.8, -0.5, 9.0, 0.5))
    scene = write_room(tmp_path / "desks", (4.0, 3.0), blocks)
    found: tuple[tuple[MaskClasses, set[int]], ...] = ((4, {0, 4}), (5, {0, 4, 11}), ("all", {0, 3, 6}))
    first = None
    for classes, ids in found:
        env = make(scene, observations=("segmentation",), segmentation_classes=classes, image_size=32)
        first = first or jax.jit(jax.vmap(env._begin))(start(), jax.random.split(jax.random.PRNGKey(0), N))
        mask = (
            np.asarray(jax.jit(jax.vmap(env.observe))(first).obs["pixels/segmentation"])[0, ..., 0]
            * SEGMENTATIONS[classes].divisor
        )
        assert set(np.round(mask).astype(int).ravel()) == ids
        if classes == 5:  # y to the left: the desk is in the left half of the picture
            assert (np.round(mask) == 11)[:, :16].any() and not (np.round(mask) == 11)[:, 16:].any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"backend": "native", "active_furniture": 3}, "active_furniture is 3, .*: expected backend auto, jax or warp"),
        ({"backend": "native", "active_dofs": 31}, "active_dofs is 31, .*: expected backend auto or warp"),
        ({"backend": "jax", "threads": 2}, "threads is 2, .*: expected backend auto or native"),
        ({"backend": "native", "contacts_per_env": 50}, "contacts_per_env is 50, .*: expected backend auto or warp"),
        (
            {"image_dtype": "uint8"},
            "image_dtype is 'uint8', .*: expected one of depth, segmentation, rgb",
        ),
        ({"observations": ("segmentation",), "depth_noise": 0.1}, "depth_noise is 0.1, .*: expected depth among"),
        ({"lidar_rays": 3}, "lidar_rays is 3, .*: expected lidar among observations; or leave it out"),
        ({"odometry_noise": 0.1}, "odometry_noise is 0.1, .*: expected odometry among observations"),
        ({"num_objects": 0, "objects": ("a",)}, r"objects is \('a',\), .*: expected num_objects above 0"),
        ({"num_objects": 0, "small_objects": "test"}, "small_objects is 'test', .*: expected num_objects above 0"),
    ],
)
def test_a_setting_that_changes_nothing_is_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        make_config(**settings)


def test_settings_that_say_what_holds_anyway_are_taken():
    assert make_config(backend="native", active_furniture=0, threads=2).active_furniture == 0
    either = make_config(active_furniture=3, contacts_per_env=50, threads=2)  # auto: for whichever it becomes
    assert (either.active_furniture, either.contacts_per_env, either.threads) == (3, 50, 2)
    seen = make_config(observations=("lidar", "depth"), lidar_rays=3, depth_noise=0.1, image_size=32)
    assert (seen.lidar_rays, seen.depth_noise, seen.image_size) == (3, 0.1, 32)
