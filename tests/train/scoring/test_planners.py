"""Paths by hand on small grids; planners on real physics: who touches, who reports no way, who pushes what."""

from __future__ import annotations

import math
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav.types import EpisodeStart
from interactive_nav_common.errors import UserError
from tests.toys import write_room
from train.scoring.planners import CELL_M, Footprints, PathGrid, Planner
from train.scoring.policies import make_yardstick
from train.scoring.rollout import episode_keys, run_episodes


def length(path):
    return CELL_M * np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()


def test_paths_by_hand():
    free = np.ones((20, 30), bool)
    ones = np.ones(free.shape)
    grid = PathGrid(free, ones)
    straight = grid.path((5, 2), (5, 22))
    assert length(straight) == pytest.approx(1.0) and tuple(straight[0]) == (5, 2) and tuple(straight[-1]) == (5, 22)
    # A knight's move each: 10 of (1, 2).
    assert length(grid.path((2, 2), (12, 22))) == pytest.approx(10 * CELL_M * math.sqrt(5))
    free[:19, 15] = False  # a wall with a gap on row 19 only
    path = PathGrid(free, ones).path((5, 2), (5, 28))
    assert (path[path[:, 1] == 15][:, 0] == 19).all() and (path[:, 1] == 15).any()
    free[19, 15] = False
    assert len(PathGrid(free, ones).path((5, 2), (5, 28))) == 0
    assert len(PathGrid(np.zeros((4, 4), bool), np.ones((4, 4))).path((0, 0), (3, 3))) == 0


def test_a_dear_cell_is_gone_round_only_if_that_is_shorter():
    free, cost = np.ones((21, 21), bool), np.ones((21, 21))
    cost[5:16, 10] = 1.5  # 0.05 m through at half as much again costs 0.025 m: cheaper than round
    assert (PathGrid(free, cost).path((10, 2), (10, 18))[:, 0] == 10).all()
    cost[5:16, 10] = 60.0
    path = PathGrid(free, cost).path((10, 2), (10, 18))
    assert abs(path[path[:, 1] == 10][:, 0] - 10).min() >= 5


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
    out = {}
    for name in ("avoider", "namo:0", "namo:0.9"):
        planner = make_yardstick(name, env)
        out[name] = (planner, run_episodes(env, planner, episode_keys(0, 2), 2, starts=starts()))
    return out


def test_the_avoider_never_touches_and_says_where_no_way_is(played):
    planner, episodes = played["avoider"]
    np.testing.assert_array_equal(episodes.metrics["success"], [0, 1])  # shut, and round the cube
    np.testing.assert_array_equal(episodes.metrics["interaction_steps"], 0)
    np.testing.assert_array_equal(episodes.metrics["force_sum_n"], 0)
    np.testing.assert_array_equal(episodes.metrics["effort_efficiency"], 1.0)
    assert planner.no_path >= 1 and "found no way" in planner.note
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


def test_footprints_cover_the_cube_below_the_robot_only(env):
    world = env.world
    model = world.models[1]
    slot = int(np.flatnonzero(world.occupied[1])[0])
    prints = Footprints(model, world.layout.slot_body[[slot]], 0.41, (-2.5, -2.0), (80, 100))
    qpos = world.rest_qpos[1].copy()
    (cells,) = prints.cells(qpos)
    r, c = np.unravel_index(cells, (80, 100))
    assert 64 <= len(cells) <= 100  # 8 x 8 cells of the 0.4 m cube, and a rim of half a cell
    assert -2.5 + (c.mean() + 0.5) * 0.05 == pytest.approx(0.0, abs=0.03)
    assert -2.0 + (r.mean() + 0.5) * 0.05 == pytest.approx(0.0, abs=0.03)
    qpos[world.layout.slot_qpos[slot] + 2] += 1.0
    assert len(prints.cells(qpos)[0]) == 0


def test_names_and_weights_are_checked(env):
    with pytest.raises(UserError, match="got 'namo', expected a weight, as in namo:0.5"):
        make_yardstick("namo", env)
    with pytest.raises(UserError, match="weight is 1.5, expected between 0 and 1"):
        Planner(env, 1.5)
    with pytest.raises(UserError, match="expected a choice from learned, random, follower, avoider, namo:W"):
        make_yardstick("greedy", env)
    action = jax.vmap(cast(Any, make_yardstick("random", env)))(jnp.zeros((3, 29)), episode_keys(0, 3))
    assert action.shape == (3, 2)
