"""Clearances and straight ways in rooms whose walls are known."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import ConfigError
from topological_nav.scenes.space import FreeSpace, free_space, shadow, spread


@pytest.fixture(scope="module")
def space(room) -> FreeSpace:
    """4 x 3 m about the origin, a cube of 0.4 m at (0.7, 0)."""
    return free_space(load_scene(room), 1.1)


def test_clearance_is_the_distance_to_the_nearest_wall_or_cube(space):
    # (-1.525, 0.025) is the centre of a cell; the wall stands at x = -2, so 0.475 m away, to the cell's border.
    assert space.at(np.array([-1.525, 0.025])) == pytest.approx(0.475)
    # (0.225, 0.025): the cube's left face stands at 0.5, so 0.275 m.
    assert space.at(np.array([0.225, 0.025])) == pytest.approx(0.275)
    assert space.at(np.array([0.7, 0.0])) == 0.0
    assert space.at(np.array([50.0, 0.0])) == 0.0


def test_what_hangs_above_the_robot_is_no_obstacle(room):
    # The cube is 0.4 m high: the lowest that its centre (0.2) less its half diagonal (0.346) can be is below any robot.
    assert free_space(load_scene(room), 0.01).at(np.array([0.7, 0.0])) == 0.0
    assert free_space(load_scene(room), -1.0).at(np.array([0.7, 0.0])) > 0.0


@pytest.mark.parametrize(
    ("start", "end", "margin", "free"),
    [
        ((-1.5, 0.0), (0.45, 0.0), 0.0, True),  # up to 5 cm before the cube
        ((-1.5, 0.0), (0.55, 0.0), 0.0, False),  # into it
        ((-1.5, 0.0), (0.45, 0.0), 0.1, False),  # too near for a margin of 10 cm
        ((-1.5, 0.0), (0.35, 0.0), 0.1, True),
        ((0.7, 1.2), (0.7, -1.2), 0.0, False),  # through it
        ((1.2, 1.2), (1.2, -1.2), 0.2, True),  # past it, 0.3 m beside
        ((1.2, 1.2), (1.2, -1.2), 0.4, False),
        ((1.5, 0.0), (2.5, 0.0), 0.0, False),  # through the wall
    ],
)
def test_straight_ways(space, start, end, margin, free):
    assert bool(space.segment_free(np.array(start), np.array(end), 50, margin)) is free
    assert bool(space.segment_free(np.array(end), np.array(start), 50, margin)) is free


def test_a_thin_obstacle_between_two_points_is_missed_as_the_definition_has_it():
    """Two points look at both ends only; 50 look every 2 m / 49 = 4.1 cm, less than a cell."""
    clearance = np.full((1, 60), 1.0)
    clearance[0, 30] = 0.0
    thin = FreeSpace(clearance, 0.05, (0.0, 0.0))
    start, end = np.array([0.5, 0.02]), np.array([2.5, 0.02])
    assert bool(thin.segment_free(start, end, 2, 0.0)) is True
    assert bool(thin.segment_free(start, end, 50, 0.0)) is False


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.6))
def test_sampled_places_have_the_clearance_and_differ(space, seed, least):
    places = space.sample(np.random.default_rng(seed), 20, least)
    assert (space.at(places) >= least).all()
    assert len(np.unique(places, axis=0)) == 20


def test_too_little_space_is_said(space):
    with pytest.raises(ConfigError, match="cells are at least 1.4 m from obstacles, expected 100"):
        space.sample(np.random.default_rng(0), 100, 1.4)


def test_spread_takes_the_farthest_each_time():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [10.0, 0.0], [4.0, 0.0]])
    # From whichever the first is, the next is the farthest from it, the third the farthest from both.
    for seed in range(8):
        first, second, third = spread(points, 3, np.random.default_rng(seed))
        assert second == {0: 2, 1: 2, 2: 0, 3: 2}[first]
        assert third == {0: 3, 1: 3, 2: 3, 3: 0}[first]
    assert len(spread(points, 9, np.random.default_rng(0))) == 4


def test_shadows_of_boxes_by_hand():
    box = np.array([[0.5, 0.0, 1.0, 1, 0, 0, 0, 0.5, 0.25, 1.0]])
    flat = shadow(box, np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    assert flat.equals(shapely.box(1.0, 1.75, 2.0, 2.25))
    quarter = np.array([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])  # x becomes y
    np.testing.assert_allclose(shadow(box, np.zeros(3), quarter).bounds, (-0.25, 0, 0.25, 1.0), atol=1e-9)
    # Fallen over forward, its height of 2 m lies along x.
    forward = np.array([math.sqrt(0.5), 0, math.sqrt(0.5), 0])
    np.testing.assert_allclose(shadow(box, np.zeros(3), forward).bounds, (0, -0.25, 2.0, 0.25), atol=1e-9)
