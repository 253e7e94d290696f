"""Planners on real physics: who touches, who reports no way, who pushes what."""

from __future__ import annotations

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav.task.rollout import episode_keys
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import UserError
from tests.toys import write_room
from train.scoring.evaluation import BatchPlayer
from train.scoring.policies import Planner, make_baseline


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    """A 1.5 m wide corridor, 5 m long, all but shut by two pushable cubes of 0.4 m side by side with another."""
    blocks = (("chair", 0.0, 0.43, 1.0, 0.5), ("chair", 0.0, 0.0, 1.0, 0.5), ("chair", 0.0, -0.43, 1.0, 0.5))
    corridor = write_room(tmp_path_factory.mktemp("planners") / "corridor", (5.0, 1.5), blocks)
    room = write_room(tmp_path_factory.mktemp("planners") / "room", (4.0, 3.0), (("chair", 0.0, 0.0, 1.0, 0.5),))
    return interactive_nav.make("turtlebot", [corridor, room], backend="native", num_objects=0, episode_steps=400)


def starts() -> EpisodeStart:
    """Two episodes, straight through the middle of each scene."""
    return EpisodeStart(
        scene_index=jnp.array([0, 1], jnp.int32),
        start_xy_w=jnp.array([[-1.5, 0.0], [-1.5, 0.0]]),
        start_yaw_rad=jnp.zeros(2),
        goal_xy_w=jnp.array([[1.8, 0.0], [1.5, 0.0]]),
        small_xy_w=jnp.zeros((2, 0, 2)),
        small_yaw_rad=jnp.zeros((2, 0)),
        small_placed=jnp.zeros((2, 0), bool),
    )


@pytest.fixture(scope="module")
def played(env):
    out, player = {}, BatchPlayer(env)
    for name in ("avoider", "namo:0", "namo:0.9"):
        planner = make_baseline(name, env)
        out[name] = (planner, player.play(planner, episode_keys(0, 2), 2, starts=starts()))
    return out


def test_the_avoider_never_touches_and_says_where_no_way_is(played):
    planner, episodes = played["avoider"]
    np.testing.assert_array_equal(episodes.metrics["success"], [0, 1])  # shut, and round the cube
    np.testing.assert_array_equal(episodes.metrics["interaction_steps"], 0)
    np.testing.assert_array_equal(episodes.metrics["force_sum_n"], 0)
    np.testing.assert_array_equal(episodes.metrics["effort_efficiency"], 1.0)
    assert planner.no_path >= 1 and "without a path" in planner.note
    assert episodes.metrics["path_efficiency"][1] > 0.85
    assert episodes.metrics["robot_path_m"][0] < 0.01  # it waits
    track = episodes.paths.robot_xy_w[1]
    track = track[np.isfinite(track[:, 0])]
    gap = np.linalg.norm(np.maximum(np.abs(track) - 0.2, 0.0), axis=-1)
    assert gap.min() > 0.18


def test_weight_0_pushes_and_a_large_weight_goes_round(played):
    follower, careful = played["namo:0"][1], played["namo:0.9"][1]
    assert follower.metrics["object_displacement_kg_m"][1] > 0.1
    assert careful.metrics["object_displacement_kg_m"][1] < 0.02 and careful.metrics["success"][1] == 1
    assert careful.metrics["effort_efficiency"][1] > follower.metrics["effort_efficiency"][1]
    # Where no way is free it pushes all the same.
    assert careful.metrics["interaction_steps"][0] > 3 and careful.metrics["success"][0] == 1


HOOK = {"backend": "native", "num_objects": 0, "control_mode": "twist", "hook_force_n": 100.0, "episode_steps": 600}


def play(env, policy, target, start, goal):
    """The metrics of one episode."""
    episode = EpisodeStart(
        scene_index=jnp.zeros(1, jnp.int32),
        start_xy_w=jnp.array([start]),
        start_yaw_rad=jnp.zeros(1),
        goal_xy_w=jnp.array([goal]),
        small_xy_w=jnp.zeros((1, 0, 2)),
        small_yaw_rad=jnp.zeros((1, 0)),
        small_placed=jnp.zeros((1, 0), bool),
        target=jnp.array([env.world.slots.names[0].index(target)], jnp.int32),
    )
    played = BatchPlayer(env).play(make_baseline(policy, env), episode_keys(0, 1), 1, starts=episode)
    return {name: float(value[0]) for name, value in played.metrics.items()}


@pytest.mark.parametrize("robot", [pytest.param("fetch", marks=pytest.mark.heavy), "turtlebot"])
def test_the_puller_opens_a_door_towards_it_and_drives_through(tmp_path, robot):
    room = write_room(tmp_path / "room", (4.0, 5.0), door=True, door_rad=(0.0, 1.5), door_y_m=-0.5)
    env = interactive_nav.make(robot, [room], task="clear", **HOOK)
    pulled, pushed = (play(env, policy, "door_0", [1.2, 1.2], [-0.6, -1.8]) for policy in ("puller", "namo:1"))
    assert pulled["success"] == 1 and pulled["opened"] == 1 and pulled["hook_torn"] == 0
    assert pulled["hook_steps"] > 50 and pulled["nonfinite"] == 0
    # Past 60 degrees: the leaf's 8 kg have their centre 0.4 m from the hinge.
    assert pulled["object_displacement_kg_m"] > 8 * 0.4 * np.pi / 3
    assert pushed["success"] == 0 and pushed["opened"] < 0.05 and pushed["hook_steps"] == 0


def test_the_puller_opens_doors_drawers_and_flaps(tmp_path):
    room = write_room(tmp_path / "room", (4.0, 4.0), (), door=True, kitchen=True, door_rad=(0.0, 1.5))
    env = interactive_nav.make("freight", [room], task="open", **HOOK)
    for target in ("door_0", "drawer_0", "cabinet_door_0"):
        scores = play(env, "puller", target, [-1.0, 0.0], [0.0, 0.5])
        assert scores["success"] == 1 and scores["opened"] == 1, target


def test_the_puller_needs_a_task_and_a_hook(env):
    got = "task is 'reach' and hook_force_n is 0.0, expected open or clear, and a hook; set env.task=clear"
    with pytest.raises(UserError, match=f"policy puller: {got}"):
        make_baseline("puller", env)


def test_names_and_weights_are_checked(env):
    with pytest.raises(UserError, match="got 'namo', expected a weight, as in namo:0.5"):
        make_baseline("namo", env)
    with pytest.raises(UserError, match="weight is 1.5, expected between 0 and 1"):
        Planner(env, 1.5)
    with pytest.raises(UserError, match="expected a choice from learned, random, follower, avoider, namo:W"):
        make_baseline("greedy", env)
    action = jax.vmap(cast(Any, make_baseline("random", env)))(jnp.zeros((3, 29)), episode_keys(0, 3))
    assert action.shape == (3, 2)
