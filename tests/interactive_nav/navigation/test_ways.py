"""Ways by hand on small grids; which episodes of a shut corridor and of an open room need a push."""

from __future__ import annotations

import math

import numpy as np
import pytest

import interactive_nav
from interactive_nav import episodes
from interactive_nav.navigation.ways import CELL_M, Footprints, PathGrid, Ways
from tests.toys import write_room


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
    corridor = write_room(tmp_path_factory.mktemp("ways") / "corridor", (5.0, 1.5), blocks)
    room = write_room(tmp_path_factory.mktemp("ways") / "room", (4.0, 3.0), (("chair", 0.0, 0.0, 1.0, 0.5),))
    return interactive_nav.make("turtlebot", [corridor, room], backend="native", num_objects=0, episode_steps=400)


def test_footprints_cover_the_cube_below_the_robot_only(env):
    world = env.world
    model = world.models[1]
    slot = int(np.flatnonzero(world.slots.occupied[1])[0])
    prints = Footprints(model, world.layout.slot_body[[slot]], 0.41, (-2.5, -2.0), (80, 100))
    qpos = world.rest_qpos[1].copy()
    (cells,) = prints.cells(qpos)
    r, c = np.unravel_index(cells, (80, 100))
    assert 64 <= len(cells) <= 100  # 8 x 8 cells of the 0.4 m cube, and a rim of half a cell
    assert -2.5 + (c.mean() + 0.5) * 0.05 == pytest.approx(0.0, abs=0.03)
    assert -2.0 + (r.mean() + 0.5) * 0.05 == pytest.approx(0.0, abs=0.03)
    qpos[world.layout.slot_qpos[slot] + 2] += 1.0
    assert len(prints.cells(qpos)[0]) == 0


def test_ways_and_whether_there_is_one(env):
    """Round the cube; none through the shut corridor, unless something may be pushed."""
    qpos, goal = env.world.rest_qpos, np.array([1.5, 0.0])
    careful, pushing = Ways(env, None), Ways(env, 0.5)
    for scene, open_ in ((0, False), (1, True)):
        way = careful.way(scene, qpos[scene], -goal, goal)
        assert bool(len(way)) is careful.exists(scene, qpos[scene], -goal, goal) is open_
        through = pushing.way(scene, qpos[scene], -goal, goal)
        assert pushing.exists(scene, qpos[scene], -goal, goal)
        np.testing.assert_array_equal(through[-1], goal)
        # Beside the cubes of either scene there is a way to the near side of them.
        assert careful.exists(scene, qpos[scene], -goal, np.array([-0.8, 0.0]))
    gap = np.linalg.norm(np.maximum(np.abs(way) - 0.2, 0.0), axis=-1)
    assert gap.min() > env.robot.footprint_radius_m
    # A goal in the wall, and one that no free cell stands for.
    assert not careful.exists(1, qpos[1], -goal, np.array([9.0, 0.0])) and not len(
        careful.way(1, qpos[1], -goal, np.array([9.0, 0.0]))
    )


def test_episodes_say_whether_a_push_is_needed(env):
    """In the corridor where start and goal lie on either side of the cubes; in the room nowhere."""
    file = episodes.draw_episode_file(env, 24, seed=1)
    for row in file.episodes:
        sides = {row["start_xy_w"][0] > 0, row["goal_xy_w"][0] > 0}
        assert row["push_needed"] is (row["scene"] == 0 and len(sides) == 2)
    assert {(row["scene"], row["push_needed"]) for row in file.episodes} == {(0, True), (0, False), (1, False)}
