"""Windows, classes and thinning by hand."""

import dataclasses

import numpy as np
import pytest

from topological_nav.config import PolicyConfig
from topological_nav.drives import imitation as sequences
from topological_nav.drives.dataset import Drives

CONFIG = PolicyConfig(steps=5)
VALUES = sequences.class_values(CONFIG, 0.5, 0.5)


def drives_of(*commands) -> Drives:
    """Drives with given angular velocities, all at 0.5 m/s."""
    steps = [len(c) for c in commands]
    total = sum(steps)
    flags = np.ones(len(steps), bool)
    asked = np.stack([np.full(total, 0.5), np.concatenate(commands)], -1).astype(np.float32)
    return Drives(
        np.zeros(len(steps), np.int32),
        ~flags,
        np.concatenate([[0], np.cumsum(steps)]),
        np.zeros((total, 3), np.float32),
        asked,
        np.zeros((total, 2), bool),
        np.zeros(total, np.float32),
        flags,
        ~flags,
        np.zeros((len(steps), 2)),
    )


@pytest.mark.parametrize(
    ("steps", "window", "overlap", "expected"),
    [
        (50, 50, 40, [0]),
        (59, 50, 40, [0]),
        (60, 50, 40, [0, 10]),
        (85, 50, 40, [0, 10, 20, 30]),
        (12, 50, 40, [0]),
        (150, 50, 0, [0, 50, 100]),
        (7, 5, 4, [0, 1, 2]),
    ],
)
def test_windows_begin_where_the_overlap_allows(steps, window, overlap, expected):
    assert sequences.window_starts(steps, window, overlap).tolist() == expected


def test_velocities_become_the_nearest_class():
    linear, angular = VALUES
    assert linear.tolist() == [0.0, 0.25, 0.5] and angular.tolist() == [-0.5, -0.25, 0.0, 0.25, 0.5]
    assert sequences.classes(np.array([0.0, 0.1, 0.125, 0.13, 0.3, 0.5]), linear).tolist() == [0, 0, 0, 1, 1, 2]
    assert sequences.classes(np.array([-0.6, -0.3, -0.1, 0.0, 0.1, 0.2, 0.4]), angular).tolist() == [
        0,
        1,
        2,
        2,
        2,
        3,
        4,
    ]


def test_windows_stay_in_their_drive_and_end_with_it():
    made = sequences.make_sequences(drives_of(np.arange(7) / 14, np.zeros(3)), np.array([0, 1]), CONFIG, VALUES, 0.4)
    # 7 steps: windows of 5 at 0, 1 and 2; 3 steps: one that is cut short.
    assert made.rows.tolist() == [
        [0, 1, 2, 3, 4, 5],
        [1, 2, 3, 4, 5, 6],
        [2, 3, 4, 5, 6, 6],
        [7, 8, 9, 9, 9, 9],
    ]
    assert made.valid.sum(1).tolist() == [5, 5, 5, 3]
    assert made.followed.sum(1).tolist() == [5, 5, 4, 2]
    # 0, .07, .14, .21, .29, .36, .43 rad/s.
    assert made.angular[0].tolist() == [2, 2, 3, 3, 3] and made.angular[2].tolist() == [3, 3, 3, 3, 4]
    assert (made.linear == 2).all()
    assert len(sequences.make_sequences(drives_of(np.zeros(3)), np.array([], int), CONFIG, VALUES, 0.0)) == 0


def test_four_seconds_at_ten_hertz_are_forty_steps():
    made = sequences.make_sequences(drives_of(np.zeros(75)), np.array([0]), PolicyConfig(), VALUES, 4.0)
    assert made.rows[:, 0].tolist() == [0, 10, 20]


def test_nearly_straight_windows_are_thinned():
    bends = np.r_[np.full(2, 0.5), np.zeros(8)]
    drives = drives_of(*[np.zeros(10)] * 400, *[bends] * 50, np.r_[0.5, np.zeros(9)])
    config = PolicyConfig(steps=10, straight_kept=0.3)
    made = sequences.make_sequences(drives, np.arange(451), config, VALUES, 0.0)
    assert sequences.turning_share(made, config)[[0, 400, 450]].tolist() == [0.0, 0.2, 0.1]
    kept = sequences.thinned(made, config)
    turning = sequences.turning_share(kept, config) >= 0.2
    assert turning.sum() == 50  # 0.2 is not below 0.2
    assert 85 <= (~turning).sum() <= 155  # 401 x 0.3 = 120, four standard deviations 37
    assert len(sequences.thinned(made, dataclasses.replace(config, straight_kept=1.0))) == 451
    assert len(sequences.thinned(made, dataclasses.replace(config, straight_kept=0.0))) == 50
    again = sequences.thinned(made, config)
    assert (again.rows == kept.rows).all()


def test_padding_does_not_count_as_straight():
    made = sequences.make_sequences(drives_of(np.array([0.5, 0.0])), np.array([0]), CONFIG, VALUES, 0.0)
    assert sequences.turning_share(made, CONFIG).tolist() == [0.5]


def test_a_mirror_swaps_left_and_right():
    made = sequences.make_sequences(
        drives_of(np.array([0.5, 0.25, 0.0, -0.25, -0.5])), np.array([0]), CONFIG, VALUES, 0.0
    )
    turned = sequences.mirrored(made, 5, CONFIG)
    assert turned.angular.tolist() == [[0, 1, 2, 3, 4]] and made.angular.tolist() == [[4, 3, 2, 1, 0]]
    assert turned.rows.tolist() == [[5, 6, 7, 8, 9, 9]] and (turned.linear == made.linear).all()
    assert len(type(made).joined([made, turned])) == 2
