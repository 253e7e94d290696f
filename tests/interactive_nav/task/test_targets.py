"""Tasks with a target: what scenes offer against other ways to see it, when a target is open or touched, and files."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import ndimage

import interactive_nav
from interactive_nav import episodes
from interactive_nav.episodes import EpisodeFileError
from interactive_nav.task.targets import CARRY_M, CATEGORIES, LIFT_M, OPENING_REWARD, achieved, opened
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.schema import SceneError
from tests.interactive_nav.robots.test_wheeled_doors import READY
from tests.toys import write_room

HOOK = {"backend": "native", "num_objects": 0, "control_mode": "twist", "hook_force_n": 100.0}
FRONT_M, GAP_M, LEAF_M = 0.2865, 0.05, 0.7
"""From the Freight's axle to its hook; from there to what it couples to; from the door's hinge to where it is held."""


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A door, a drawer, a flap, two chairs and a table."""
    blocks = ("chair", 1.5, 0.0, 5.0, 0.5), ("chair", -1.5, 1.0, 5.0, 0.5), ("table", 1.5, -1.2, 9.0, 0.5)
    folder = tmp_path_factory.mktemp("targets") / "room"
    return write_room(folder, (6.0, 4.0), blocks, door=True, kitchen=True, door_rad=(0.0, 1.5))


@pytest.fixture(scope="module")
def opening(room):
    return interactive_nav.make("freight", [room], task="open", **HOOK)


def slots_of(env):
    return {env.world.slots.names[0][slot] for slot in np.asarray(env.tables.targets.slot[0])}


def start_at(env, x_m, y_m, yaw_rad, goal, target):
    f32 = [jnp.asarray(value, jnp.float32) for value in ([x_m, y_m], yaw_rad, goal)]
    none = jnp.zeros((0, 2)), jnp.zeros(0), jnp.zeros(0, bool)
    slot = jnp.int32(env.world.slots.names[0].index(target))
    return EpisodeStart(jnp.int32(0), f32[0], f32[1], f32[2], *none, slot)


def test_a_door_is_open_at_60_degrees_and_a_drawer_at_20_cm(opening):
    env = opening
    assert slots_of(env) == {"door_0", "drawer_0", "cabinet_door_0"}
    for name, enough in (("door_0", np.pi / 3), ("drawer_0", 0.2)):
        state = env.reset_to(start_at(env, 0.0, 0.0, 0.0, [2.0, 1.0], name), jax.random.PRNGKey(0))
        slot = env.world.slots.names[0].index(name)
        at = int(env.world.layout.slot_qpos[slot])
        nav, qpos = state.info["nav"], state.pipeline_state.qpos
        for share, done in ((0.0, False), (0.5, False), (0.99, False), (1.01, True)):
            moved = qpos.at[at].add(share * enough)
            assert float(opened(env.tables, nav, moved)) == pytest.approx(min(share, 1.0), abs=1e-3)
            touches = jnp.ones(env.world.layout.num_slots, bool)
            assert bool(achieved("open", env.tables, nav, moved, touches)) == done


def test_the_observation_has_the_hinge_and_the_centre_in_the_robots_frame(opening):
    env = opening
    state = env.reset_to(start_at(env, 0.5, -0.5, np.pi / 2, [2.0, 1.0], "door_0"), jax.random.PRNGKey(0))
    model = env.world.models[0]
    data = mujoco.MjData(model)
    data.qpos[:] = state.pipeline_state.qpos
    mujoco.mj_forward(model, data)
    body = int(env.world.layout.slot_body[env.world.slots.names[0].index("door_0")])
    centre, hinge = data.xipos[body], data.xanchor[model.body_jntadr[body]]
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a quarter to the left
    base = np.asarray(state.info["nav"].robot_pos_w)
    want = [*(turn @ (centre - base)), *(turn @ (hinge - base))[:2], 0.0]
    # The hook's four numbers come before.
    np.testing.assert_allclose(state.obs[-6:], want, atol=1e-4)


def test_who_pulls_the_door_open_is_paid_and_done(opening):
    """The robot drives backwards on a circle about the hinge, at (-1, -1.9) m."""
    env, yaw = opening, np.radians(-70.0)
    x_m, y_m = np.array([-1 + LEAF_M, -1.88]) - (FRONT_M + GAP_M) * np.array([np.cos(yaw), np.sin(yaw)])
    state = env.reset_to(start_at(env, x_m, y_m, yaw, [2.0, 1.0], "door_0"), jax.random.PRNGKey(0))
    step, paid = jax.jit(env.step), 0.0
    for k in range(60):
        action = jnp.asarray(env.robot.drive(np.float64(-0.2 * (k > 1)), np.float64(0.26 * (k > 1))), jnp.float32)
        state = step(state, action.at[-1].set(1.0))
        paid += float(state.metrics["reward/opening"])
        if state.done:
            break
    assert state.done and float(state.metrics["success"]) == 1.0 and float(state.metrics["opened"]) == 1.0
    assert paid == pytest.approx(OPENING_REWARD, abs=1e-4)
    assert float(state.metrics["reward/success"]) == 10.0
    # The leaf's path counts as that of an object which is pushed: 8 kg, whose centre is 0.4 m from the hinge.
    robot_kg_m = env.world.robot_mass_kg * float(state.metrics["robot_path_m"])
    effort = robot_kg_m / (robot_kg_m + 8.0 * 0.4 * np.pi / 3)
    assert float(state.metrics["kinematic_effort"]) == pytest.approx(effort, abs=5e-3)


@pytest.mark.parametrize("home", ["alder", "elm"])
def test_clear_has_its_goal_behind_a_door_that_opens_towards_the_start(home):
    """Rooms by flood fill of the map with the shut leaves' shadows; the leaf swings over the start's room."""
    env = interactive_nav.make("freight", [f"scenes_mjcf/{home}"], task="clear", **HOOK)
    world, maps, targets = env.world, env.scenes[0].maps, env.tables.targets
    assert targets is not None
    model = world.models[0]
    data = mujoco.MjData(model)
    data.qpos[:] = world.rest_qpos[0]
    doors = [m.name for m in env.scenes[0].movables if m.category == "door"]
    slots = {name: world.slots.names[0].index(name) for name in doors}
    radius = int(np.ceil(env.robot.footprint_radius_m / maps.resolution_m)) - 1

    def shadow():
        mujoco.mj_forward(model, data)
        cells = np.zeros(maps.traversable.shape, bool)
        for name in doors:
            body = int(world.layout.slot_body[slots[name]])
            for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)):
                along = np.linspace(-1, 1, 41)
                size, axes = model.geom_size[geom], data.geom_xmat[geom].reshape(3, 3)
                points = data.geom_xpos[geom] + np.stack([along * size[0], 0 * along, 0 * along], -1) @ axes.T
                columns, rows = ((points[:, :2] - maps.origin_w) / maps.resolution_m).astype(int).T
                cells[rows, columns] = True
        return cells

    def rooms(blocked):
        away: Any = ndimage.distance_transform_edt(maps.traversable & ~blocked)
        numbers: Any = ndimage.label(away > radius)
        return numbers[0]

    def room_of(labels, xy_w):
        columns, rows = ((xy_w - maps.origin_w) / maps.resolution_m).astype(int).T
        return labels[rows, columns]

    shut, static = rooms(shadow()), rooms(np.zeros(maps.traversable.shape, bool))
    pairs, slot = np.asarray(targets.pair_xy_w[0]), np.asarray(targets.slot[0])
    starts, goals = room_of(shut, pairs[:, 0]), room_of(shut, pairs[:, 1])
    known = (starts > 0) & (goals > 0)
    assert known.mean() > 0.9 and (starts != goals)[known].all()
    assert (room_of(static, pairs[:, 0]) == room_of(static, pairs[:, 1]))[known].all()
    assert (np.diff(targets.path_m[0]) >= 0).all()
    for name in doors:
        mine = known & (slot == slots[name])
        if not mine.any():
            continue
        joint = model.body_jntadr[world.layout.slot_body[slots[name]]]
        at = model.jnt_qposadr[joint]
        ends = model.jnt_range[joint]
        data.qpos[at] += (ends - data.qpos[at])[np.abs(ends - data.qpos[at]).argmax()] / 2
        mujoco.mj_forward(model, data)
        half_open = data.xipos[world.layout.slot_body[slots[name]]][:2]
        data.qpos[:] = world.rest_qpos[0]
        near = np.linalg.norm(pairs[mine] - half_open, axis=-1)
        # Half open, the leaf is nearer to where those start who are near than to any of the goals.
        assert near[:, 0].min() < near[:, 1].min()


def test_fetch_counts_any_object_of_the_category(room):
    env = interactive_nav.make("freight", [room], task="fetch", **HOOK)
    assert slots_of(env) == {"chair_0", "chair_1", "table_0"}
    names = env.world.slots.names[0]
    state = env.reset_to(start_at(env, 0.0, 0.0, 0.0, [2.0, 1.0], "chair_0"), jax.random.PRNGKey(0))
    for touched, done in (("chair_1", True), ("chair_0", True), ("table_0", False), ("door_0", False)):
        touches = jnp.zeros(len(names), bool).at[names.index(touched)].set(True)
        assert bool(achieved("fetch", env.tables, state.info["nav"], jnp.zeros(0), touches)) == done
    seen = np.asarray(state.obs)[-len(CATEGORIES) :]
    assert CATEGORIES[int(np.argmax(seen))] == "chair" and seen.sum() == 1
    step = jax.jit(env.step)  # from 0.3 m before the first chair, which is at x = 1.5
    state = env.reset_to(start_at(env, 0.7, 0.0, 0.0, [2.5, 1.5], "chair_1"), jax.random.PRNGKey(0))
    for _ in range(20):
        state = step(state, jnp.asarray(env.robot.drive(np.float64(0.5), np.float64(0.0)), jnp.float32))
        if state.done:
            break
    assert state.done and float(state.metrics["success"]) == 1.0 and int(state.metrics["interaction_steps"]) == 1


def test_fetch_lifts_a_chair_and_carries_it_aside(tmp_path):
    """The arm is in a pose whose grip is 0.05 m before the chair's back; 5 kg are lifted, 7 kg are no target."""
    blocks = ("chair", 1.13, 0.0, 5.0, 0.5), ("chair", -1.5, 1.0, 7.0, 0.5)
    folder = write_room(tmp_path / "lift", (6.0, 4.0), blocks, half_m=(0.15, 0.2, 0.4))
    hand = {**HOOK, "control_mode": "hand", "task": "lift", "k_int": 0.0}
    env = interactive_nav.make("fetch", [folder], **hand)
    assert slots_of(env) == {"chair_0"}
    state: Any = env.reset_to(start_at(env, 0.0, 0.0, 0.0, [-2.5, 1.5], "chair_0"), jax.random.PRNGKey(0))
    at = jnp.array([int(env.world.models[0].joint(f"fetch_{name}").qposadr[0]) for name in READY])
    qpos = state.pipeline_state.qpos.at[at].set(jnp.array([*READY.values()], jnp.float32))
    state, paid = state.replace(pipeline_state=state.pipeline_state.replace(qpos=qpos)), []
    step = jax.jit(env.step)
    for steps, turn, up in ((5, 0.0, 0.0), (25, 0.0, 0.2), (60, 0.4, 0.15)):
        for _ in range(steps):
            command = np.array([0.0, turn, 0.0, 0.0, up, 0.04, 1.0])
            state = step(state, jnp.asarray(env.robot.action(command), jnp.float32))
            paid.append([float(state.metrics[f"reward/{name}"]) for name in ("opening", "reaching", "success")])
            if state.done:
                break
    chair_m = np.asarray(state.info["nav"].object_pos_w[0])
    assert state.done and float(state.metrics["success"]) == 1.0 and int(state.pipeline_state.hook[0]) == 0
    assert chair_m[2] >= 0.4 + LIFT_M and np.linalg.norm(chair_m[:2] - [1.13, 0.0]) >= CARRY_M
    np.testing.assert_allclose(np.sum(paid, 0), [OPENING_REWARD, 1.0, 10.0], atol=1e-3)
    # The arm bears the chair's weight for most of the time.
    assert 0.5 * 5.0 * 9.81 < float(state.metrics["force_sum_n"]) / len(paid) < 100.0


def test_lifted_is_half_of_a_share_and_carried_is_the_rest(tmp_path):
    folder = write_room(tmp_path / "lift", (6.0, 4.0), (("chair", 1.0, 0.0, 5.0, 0.5),))
    env = interactive_nav.make("fetch", [folder], **{**HOOK, "control_mode": "hand", "task": "lift"})
    state: Any = env.reset_to(start_at(env, 0.0, 0.0, 0.0, [-2.5, 1.5], "chair_0"), jax.random.PRNGKey(0))
    nav, qpos = state.info["nav"], state.pipeline_state.qpos
    for up_m, aside_m, share in (
        (0, 0, 0),
        (0, 0.6, 0),
        (0.05, 0, 0.25),
        (0.2, 0, 0.5),
        (0.1, 0.25, 0.75),
        (0.2, 0.6, 1),
    ):
        moved = nav.replace(object_pos_w=nav.object_pos_w.at[0].add(jnp.array([aside_m, 0.0, up_m])))
        assert float(opened(env.tables, moved, qpos)) == pytest.approx(share, abs=1e-3)
    for settings, got in (
        ({"control_mode": "twist"}, "100.0 and control_mode 'twist'"),
        ({"hook_force_n": 0}, "0 and"),
    ):
        with pytest.raises(ConfigError, match=f"{got}.* with task 'lift', expected a hook at a hand"):
            interactive_nav.make("fetch", [folder], **{**HOOK, "control_mode": "hand", "task": "lift", **settings})


def test_the_command_draws_episodes_of_lift(tmp_path, capsys):
    blocks = ("chair", 1.0, 0.0, 5.0, 0.5), ("table", -1.0, 1.0, 9.0, 0.5)
    folder = str(write_room(tmp_path / "lift", (6.0, 4.0), blocks))
    words = ["make", "--task", "lift", "--scenes", folder, "--num-objects", "0", "--episodes", "3"]
    assert episodes.main([*words, "--robot", "fetch", "-o", str(tmp_path / "lift.json")]) == 0
    file = episodes.load_episode_file(tmp_path / "lift.json")
    assert file.task == "lift" and [row["target"] for row in file.episodes] == ["chair_0"] * 3
    assert episodes.main([*words, "--robot", "turtlebot", "-o", str(tmp_path / "none.json")]) == 2
    assert "robot 'turtlebot' has no control mode 'hand'" in capsys.readouterr().err


def test_draws_keep_the_largest_distance(opening):
    keys = jax.random.split(jax.random.PRNGKey(1), 64)
    starts = jax.vmap(lambda key: opening.draw_start(key, limit_m=jnp.float32(1.5)))(keys)
    straight_m = np.linalg.norm(starts.start_xy_w - starts.goal_xy_w, axis=-1)
    assert straight_m.max() <= 1.5 and straight_m.min() >= 1.0 and len(np.unique(starts.target)) > 1


def test_a_file_has_the_targets(opening, room, tmp_path):
    made = episodes.draw_episode_file(opening, 8, seed=3)
    episodes.save_episode_file(made, tmp_path / "open.json")
    file = episodes.load_episode_file(tmp_path / "open.json")
    assert file == made and file.task == "open" and {row["target"] for row in file.episodes} <= slots_of(opening)
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.PRNGKey(3), i))(np.arange(8))
    want = jax.vmap(lambda key: opening.draw_start(jax.random.split(key)[1]))(keys)
    np.testing.assert_array_equal(episodes.starts_of(file, opening).target, want.target)
    reach = interactive_nav.make("freight", [room], **HOOK)
    with pytest.raises(EpisodeFileError, match="has robot 'freight' and task 'reach'; make"):
        episodes.starts_of(file, reach)
    rows = [*file.episodes[:3], file.episodes[3] | {"target": "door_9"}]
    with pytest.raises(
        EpisodeFileError, match="episode 3: target is no body of its scene, expected one; make it again"
    ):
        episodes.starts_of(dataclasses.replace(file, episodes=tuple(rows)), opening)


def test_a_scene_without_targets_is_refused(tmp_path):
    bare = write_room(tmp_path / "bare", (5.0, 4.0))
    for task in ("open", "clear"):
        with pytest.raises(SceneError, match=f"offers robot 'freight' no target of task '{task}'"):
            interactive_nav.make("freight", [bare], task=task, **HOOK)
