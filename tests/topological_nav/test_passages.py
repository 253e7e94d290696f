"""Passage labels by hand, balance, and splits that share no source."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav.scene import load_scene
from topological_nav.config import DataConfig
from topological_nav.passages import balanced, draw_passages, held_out
from topological_nav.rooms import find_rooms
from topological_nav.space import free_space


@pytest.fixture(scope="module")
def drawn(two_rooms):
    space = free_space(load_scene(two_rooms), 1.1)
    rooms = find_rooms(space, "kmeans", 2, None, 0, 0.2)
    config = DataConfig(passage_length_m=1.5, passage_sources=8, passage_margin_m=0.1)
    return space, config, draw_passages(space, rooms, config, np.random.default_rng(0))


def test_labels_are_the_plans(drawn):
    space, config, passages = drawn
    end = passages.xy_w + 1.5 * np.stack([np.cos(passages.heading_rad), np.sin(passages.heading_rad)], -1)
    for xy, to, free in zip(passages.xy_w, end, passages.free, strict=True):
        points = [xy + (to - xy) * i / 49 for i in range(50)]
        assert free == all(space.at(p) >= config.passage_margin_m - 1e-9 for p in points)


def test_sources_keep_clear_and_look_all_round(drawn):
    space, config, passages = drawn
    assert (space.at(passages.xy_w) >= config.passage_clearance_m).all()
    one = passages.source == passages.source[0]
    turns = np.rad2deg(np.diff(np.sort(passages.heading_rad[one])))
    assert np.allclose(turns % 36.0, 0.0, atol=1e-6) or np.allclose(turns % 36.0, 36.0, atol=1e-6)


def test_both_splits_are_balanced_and_share_no_source(drawn):
    _, _, passages = drawn
    for held in (False, True):
        mine = passages.free[passages.test == held]
        assert len(mine) > 0 and mine.sum() * 2 == len(mine)
    assert not set(passages.source[passages.test]) & set(passages.source[~passages.test])
    places = [set(map(tuple, passages.xy_w[passages.test == held])) for held in (False, True)]
    assert not places[0] & places[1]


def test_a_wall_ahead_is_blocked_and_a_gap_is_free(drawn):
    """The partition of the two rooms stands at x = 0 from y = -2 to 1; above it is a gap of 1 m."""
    space = drawn[0]
    blocked = space.segment_free(np.array([-0.8, -1.0]), np.array([1.2, -1.0]), 50, 0.0)
    gap = space.segment_free(np.array([-0.8, 1.5]), np.array([1.2, 1.5]), 50, 0.3)
    narrow = space.segment_free(np.array([-0.8, 1.5]), np.array([1.2, 1.5]), 50, 0.6)
    assert (bool(blocked), bool(gap), bool(narrow)) == (False, True, False)


def test_balance_by_hand():
    labels = np.array([True, True, True, False, True, False])
    kept = balanced(np.array([0, 1, 2, 3, 5]), labels, np.random.default_rng(0))
    assert len(kept) == 4 and {3, 5} <= set(kept.tolist()) and 4 not in kept
    assert len(balanced(np.array([0, 1]), labels, np.random.default_rng(0))) == 0


@settings(deadline=None)
@given(st.integers(0, 40), st.floats(0.01, 0.99), st.integers(0, 1000))
def test_of_two_or_more_some_are_held_out_and_some_are_not(count, share, seed):
    held = held_out(count, share, np.random.default_rng(seed))
    assert len(held) == count
    assert held.sum() == (0 if count < 2 else min(max(round(count * share), 1), count - 1))
