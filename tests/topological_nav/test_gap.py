"""What stands between the navigator and its robot, by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from topological_nav.config import EvaluationConfig
from topological_nav.evaluate.evaluation import DrivenEpisodes, NavigatorPlayer
from topological_nav.gap import Gap, GapConfig
from topological_nav.scenes.rendering import Snapshot

NUMBERS = np.array([4, 9])


def velocities(gap, commands):
    return [tuple(v.tolist() for v in gap.executed(np.array(c[0]), np.array(c[1]), k)) for k, c in enumerate(commands)]


def test_a_gain_of_a_half_halves_what_is_executed():
    gap = Gap(GapConfig(linear_gain=0.5, angular_gain=2.0), 0, NUMBERS, 0.2)
    assert velocities(gap, [([0.4, 0.0], [0.3, -0.5])]) == [([0.2, 0.0], [0.6, -1.0])]


def test_commands_come_late_and_stay_with_their_robot():
    gap = Gap(GapConfig(delay_steps=2), 0, NUMBERS, 0.2)
    first = [([0.1, 0.2], [1.0, 2.0]), ([0.3, 0.4], [3.0, 4.0])]
    assert velocities(gap, first) == [([0.0, 0.0], [0.0, 0.0])] * 2
    gap.keep(np.array([1]))
    assert velocities(gap, [([0.5], [5.0])] * 3) == [([0.2], [2.0]), ([0.4], [4.0]), ([0.5], [5.0])]


def test_a_compass_drifts_by_three_degrees_in_half_a_minute():
    gap = Gap(GapConfig(compass_drift_deg=6.0, compass_deg=-1.0), 0, NUMBERS, 0.2)
    assert np.degrees(gap.heading(np.array([0.0, math.pi / 2]), 30.0)) == pytest.approx([2.0, 92.0])
    assert np.degrees(gap.heading(np.zeros(2), 0.0)) == pytest.approx([-1.0, -1.0])


def test_wheels_slip_by_a_share_of_their_speed_whoever_else_is_in_the_batch():
    many = Gap(GapConfig(slip=0.1), 3, np.arange(4000), 0.2)
    linear, angular = many.executed(np.full(4000, 0.4), np.zeros(4000), 7)
    # Two sides of 0.4 m/s, each off by 0.04 m/s: their mean by 0.04 / sqrt(2), their difference by 0.04 sqrt(2) / 0.4.
    assert (linear.mean(), linear.std()) == pytest.approx((0.4, 0.04 / math.sqrt(2)), rel=0.05)
    assert angular.std() == pytest.approx(0.1 * math.sqrt(2), rel=0.05)
    few = Gap(GapConfig(slip=0.1), 3, NUMBERS, 0.2)
    assert few.executed(np.full(2, 0.4), np.zeros(2), 7)[0].tolist() == linear[NUMBERS].tolist()
    assert few.executed(np.full(2, 0.4), np.zeros(2), 8)[0].tolist() != linear[NUMBERS].tolist()
    still = few.executed(np.zeros(2), np.zeros(2), 9)
    assert not np.any(still)


def test_by_default_nothing_is_between():
    assert velocities(Gap(GapConfig(), 0, NUMBERS, 0.2), [([0.4, 0.1], [0.3, -0.5])]) == [([0.4, 0.1], [0.3, -0.5])]


class Mind:
    """A navigator that always looks, and keeps what it is given; images are places along x."""

    config = SimpleNamespace(images=1, goal_images=None)

    def __init__(self):
        self.given = []

    def goal_nodes(self, images, around):
        return np.zeros(len(images))

    def start(self, goal):
        return SimpleNamespace(linear=np.array([0.4, 0.2]), angular=np.zeros(2))

    def stop(self, state, rows):
        return state

    def looks(self, state, heading_rad, time_s):
        return np.ones(2, bool)

    def step(self, state, images, heading_rad, time_s):
        self.given.append((images.tolist(), np.degrees(heading_rad).round(6).tolist()))
        return state


def test_a_player_shows_the_last_image_and_the_compass_and_drives_what_is_executed():
    robot = SimpleNamespace(body_width_m=0.4, drive=lambda v, w, xp: xp.stack([v, w], -1))
    player = SimpleNamespace(env=SimpleNamespace(dt=0.1, robot=robot, strew=abs))
    config = EvaluationConfig.of(linear_gain=0.5, image_steps=3, compass_drift_deg=600.0)
    mind = Mind()
    contender = NavigatorPlayer(player, config, mind, lambda xy, yaw, qpos: xy[:, 0])  # type: ignore[arg-type]
    two = np.zeros(2)
    contender.begin(DrivenEpisodes(NUMBERS, np.zeros((2, 2)), two, np.zeros((2, 2)), two, two, two, two))
    actions = []
    for step in range(5):
        at = np.array([[step, 0.0], [10.0 + step, 0.0]])
        now = Snapshot(at, np.zeros(2), two, two > 0, two > 0, np.zeros((2, 7)), two > 0)
        actions.append(contender.step(None, now, np.ones(2, bool), step)[0].tolist())
    assert [images for images, _ in mind.given] == [[0.0, 10.0]] * 3 + [[3.0, 13.0]] * 2
    # 600 degrees a minute are one in a control step.
    assert [headings for _, headings in mind.given] == [[float(k)] * 2 for k in range(5)]
    assert actions == [[[pytest.approx(0.2), 0.0], [pytest.approx(0.1), 0.0]]] * 5
