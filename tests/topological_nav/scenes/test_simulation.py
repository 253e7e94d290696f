"""What episodes tell of the physics behind them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from interactive_nav.pictures.scene_model import SCENE, SceneModel
from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import body_names
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import world_poses
from interactive_nav.task.rollout import episode_keys
from scenes_mjcf.look import Lens, trace
from topological_nav.scenes.rendering import (
    SceneRenderer,
    Snapshot,
    camera_pose,
    episode_starts,
    make_env,
    scene_camera,
)


def test_an_episode_with_lost_contacts_or_left_out_bodies_is_broken(room):
    env = make_env([room], "turtlebot", "native", num_objects=0)
    starts = episode_starts(np.zeros((3, 2)) - 1.0, np.zeros(3), np.ones((3, 2)), 0)
    state = jax.jit(jax.vmap(env.reset_to))(starts, episode_keys(0, 3))
    assert Snapshot.of(state).broken.tolist() == [False] * 3
    for name in ("overflow_steps", "left_out_steps", "crowded_steps"):
        nav = state.info["nav"]
        lost = nav.replace(memory=nav.memory | {name: jnp.asarray([0, 1, 0], nav.memory[name].dtype)})
        seen = Snapshot.of(state.replace(info={**state.info, "nav": lost}))
        assert seen.broken.tolist() == [False, True, False]
        assert seen.xy_w == pytest.approx(Snapshot.of(state).xy_w)


def test_pushed_furniture_and_small_objects_are_seen_where_they_are(room):
    """Against C MuJoCo's rays: nothing but the pixels of what moved differs from the picture of the world at rest."""
    scene, robot, lens = load_scene(room), get_robot("ttbot"), Lens(64, 48, 90.0)
    env = make_env([room], "ttbot", "native", num_objects=3)
    starts, keys = episode_starts(np.full((1, 2), -1.0), np.zeros(1), np.ones((1, 2)), 3), episode_keys(0, 1)
    state = jax.jit(jax.vmap(env.reset_to))(jax.vmap(env.strew)(keys, starts), keys)
    model = SceneModel(env.robot, scene, env.world.small_objects)
    xy, yaw, qpos = np.full((2, 2), -1.4), np.full(2, 0.8), np.repeat(np.asarray(state.pipeline_state.qpos), 2, 0)
    names, own, pos_w, _ = world_poses(env.world, 0, qpos)
    little = [names.index(name) for name in body_names(env.world.small_objects)]
    assert len(little) == 3 and np.abs(pos_w[0, little, :2]).max() < 2.5  # in the room
    chair = env.world.layout.slot_qpos[next(i for i, n in enumerate(env.world.slots.names[0]) if n == "chair_0")]
    qpos[1, chair : chair + 2] += (0.3, -0.4)
    camera = scene_camera(SceneRenderer(scene, lens, small=env.world.small_objects), robot, env.world)
    rest, now, pushed = camera(xy[:1], yaw[:1])[0], *camera(xy, yaw, qpos)
    pose, shown = camera_pose(robot, xy[0], yaw[0], np.zeros(())), []
    for row in (None, *qpos):
        if row is not None:
            model.pose(env.world, 0, row)
        shown.append(trace(model.model, model.data, pose, lens, SCENE)[1])
    for picture, before, geoms, old in ((now, rest, shown[1], shown[0]), (pushed, now, shown[2], shown[1])):
        moved = geoms != old
        differs = (picture != before).any(-1)
        assert moved.sum() > 20 and (differs & moved).sum() > 0.8 * moved.sum()
        near = np.asarray(ndimage.binary_dilation(moved, iterations=1), bool)
        assert (differs & ~near).sum() <= 0.002 * differs.size
