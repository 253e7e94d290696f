"""Passage labels and lengths by hand, balance, and splits that share no source."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import ConfigError
from tests.topological_nav.maps.test_sight import two_rooms_space
from topological_nav.config import DataConfig
from topological_nav.data.dataset import balanced, draw_passages, free_lengths, held_out, logits_at
from topological_nav.scenes.space import find_rooms, free_space


@pytest.fixture(scope="module")
def drawn(two_rooms):
    space = free_space(load_scene(two_rooms), 1.1)
    rooms = find_rooms(space, "kmeans", 2, None, 0, 0.2)
    config = DataConfig(
        passage_length_m=1.5, passage_lengths_m=(0.7, 1.5, 2.2), passage_sources=8, passage_margin_m=0.1
    )
    return space, config, draw_passages(space, rooms, config, np.random.default_rng(0))


def test_labels_are_the_plans(drawn):
    space, config, passages = drawn
    end = passages.xy_w + 1.5 * np.stack([np.cos(passages.heading_rad), np.sin(passages.heading_rad)], -1)
    for xy, to, free in zip(passages.xy_w, end, passages.free[:, 1], strict=True):
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
        mine = passages.free[passages.test == held, 1]
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


def test_labels_of_all_lengths_are_the_plans_and_never_free_again(drawn):
    space, config, passages = drawn
    step = np.stack([np.cos(passages.heading_rad), np.sin(passages.heading_rad)], -1)
    every = [space.segment_free(passages.xy_w, passages.xy_w + m * step, 50, 0.1) for m in config.passage_lengths_m]
    ruled = np.stack(every, -1)
    # Where the rule itself does not contradict itself it is the label.
    sure = (ruled[:, :-1] >= ruled[:, 1:]).all(1)
    assert sure.mean() > 0.95 and (passages.free[sure] == ruled[sure]).all()
    assert (passages.free[:, :-1] >= passages.free[:, 1:]).all()
    # All four answers occur: blocked within 0.7 m, within 1.5 m, within 2.2 m, free.
    assert set(passages.free.sum(1).tolist()) == {0, 1, 2, 3}


def test_the_scored_length_decides_where_points_contradict_each_other():
    """Rules for 1, 2, 3 and 4 m; 2 m is scored."""
    ruled = {1.0: [0, 1, 0, 1], 2.0: [1, 0, 0, 1], 3.0: [0, 1, 0, 0], 4.0: [1, 1, 1, 1]}

    class Ruled:
        """Free space that answers by length."""

        def segment_free(self, start, end, points, margin_m):
            return np.array(ruled[round(float(np.linalg.norm(end[0] - start[0])), 6)], bool)

    config = DataConfig(passage_length_m=2.0, passage_lengths_m=(1.0, 2.0, 3.0, 4.0))
    free = free_lengths(Ruled(), np.zeros((4, 2)), np.zeros(4), config)  # type: ignore[arg-type]
    expected = [[1, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0], [1, 1, 0, 0]]
    assert free.astype(int).tolist() == expected


def test_a_wall_1_3_m_ahead_is_free_for_a_metre():
    """Walls stand 1.3 m ahead and 1.6 m behind; a way keeps 0.225 m from them."""
    places = np.array([[-1.4, 0.0], [-1.4, 0.0]])
    free = free_lengths(two_rooms_space(), places, np.array([0.0, np.pi]), DataConfig())
    assert free.astype(int).tolist() == [[1, 1, 0, 0, 0], [1, 1, 0, 0, 0]]
    wider = free_lengths(two_rooms_space(), places, np.array([0.0, np.pi]), DataConfig(passage_margin_m=0.0))
    assert wider.astype(int).tolist() == [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0]]


def test_logits_between_lengths_by_hand():
    logits, own = np.array([[4.0, 2.0, -4.0], [1.0, 0.0, -1.0]]), (0.5, 1.0, 2.0)
    assert logits_at(logits, own, np.array([1.0, 2.0])).tolist() == [2.0, -1.0]
    # 0.75 m: half way from 4 to 2; 1.25 m: a quarter of the way from 0 to -1.
    assert logits_at(logits, own, np.array([0.75, 1.25])).tolist() == [3.0, -0.25]
    assert logits_at(logits, own, np.array([0.1, 9.0])).tolist() == [4.0, -1.0]
    assert logits_at(logits, own, 1.5).tolist() == [-1.0, -0.5]
    assert logits_at(logits, own, np.array([[0.5, 1.5], [2.0, 0.2]])).tolist() == [[4.0, -1.0], [-1.0, 1.0]]
    assert logits_at(logits[:, :1], (2.0,), np.array([[0.5, 2.5], [1.0, 2.0]])).tolist() == [[4.0, 4.0], [1.0, 1.0]]
    assert logits_at(logits[:0], own, np.zeros(0)).shape == (0,)


def test_lengths_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match="passage_length_m is 1.2, expected one of passage_lengths_m .* add it"):
        DataConfig(passage_length_m=1.2)
    for wrong in ((), (2.0, 1.0), (1.0, 1.0, 2.0), (0.0, 2.0)):
        with pytest.raises(ConfigError, match="expected ascending lengths from 0.05 m on"):
            DataConfig(passage_lengths_m=wrong)
    assert DataConfig().passage_column == 3


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
