"""The state machine by hand: fake eyes whose images say what is to be seen, headings that are reached at once."""

import dataclasses
import math

import jax
import numpy as np
import pytest
from simple_pid import PID

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import wrap_angle
from tests.topological_nav.maps.test_graph import hand_map
from topological_nav.config import NavigatorConfig
from topological_nav.navigate import navigator as nav
from topological_nav.navigate.navigator import (
    ARRIVED,
    DRIVE,
    FACE,
    LEAN,
    LOCALISE,
    STOPPED,
    SWING,
    TIMED_OUT,
    Navigator,
)

SQUARE = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
"""Nodes 0 to 3 around a square of 2 m; edges reach 2.9 m, so that its diagonals are edges too."""


class Told:
    """Images are (node, p): where they were taken, and the probability that the way ahead is free."""

    summed = True
    nodes = 4

    def distances(self, images, heading_rad):
        return np.abs(images[:, :1] - np.arange(self.nodes)) * 1.0

    def passage(self, images, ahead_m):
        return np.broadcast_to(images[:, 1:2], ahead_m.shape)


class Counting:
    """A policy that counts its steps: drives at 0.01 m/s per step done, turns by its first image's p."""

    def start(self, batch):
        return {"steps": np.zeros(batch, np.int32)}

    def act(self, state, images):
        steps = state["steps"] + 1
        return {"steps": steps}, 0.01 * steps, images[:, 1] * 0.1


def square(p=None, **settings):
    """A navigator on the square, 6 images a node."""
    made = hand_map(p or {}, SQUARE)
    made = dataclasses.replace(made, embeddings=np.zeros((4, 6, 2), np.float32))
    return Navigator(made, Told(), Counting(), NavigatorConfig(**{"images": 6, "metre_cost": 0.0, **settings}))


def seen(*rows):
    return np.array(rows, float)


class Robot:
    """Turns to where the navigator wants in no time; one episode."""

    def __init__(self, navigator, goal, heading=0.05):
        self.navigator, self.state = navigator, navigator.start(np.array([goal]))
        self.heading, self.time, self.events = heading, 0.0, []

    def step(self, node, p=0.0, dt=0.1):
        """One step at a node, the way ahead free with p."""
        target = self.state.target_rad[0]
        if self.state.phase[0] in nav.TURNING and not math.isnan(target):
            self.heading = float(target)
        self.state = self.navigator.step(self.state, seen((node, p)), np.array([self.heading]), self.time)
        self.linear, self.angular = self.state.linear, self.state.angular
        self.events.append(self.state)
        self.time = round(self.time + dt, 6)
        return int(self.state.phase[0])

    def localise(self, node, p=0.0):
        """Looks about at a node."""
        while True:
            self.step(node, p)
            if self.events[-1].localised[0]:
                return


def test_localisation_looks_along_each_heading_and_sums():
    robot = Robot(square(), goal=2, heading=math.radians(50))
    headings = []
    for k, node in enumerate((2, 0, 2, 2, 1, 2)):
        assert robot.state.looks[0] == k
        while robot.state.looks[0] == k:
            robot.step(node)
        headings.append(math.degrees(robot.heading))
    # From 50 degrees the nearest of 0, 60, 120, ... is 60.
    assert headings == pytest.approx([60, 120, -180, -120, -60, 0], abs=1e-6)
    # Sums of |image - node| over 2, 0, 2, 2, 1, 2: node 0: 9, node 1: 5, node 2: 3, node 3: 9.
    assert robot.state.evidence[0].tolist() == [9.0, 5.0, 3.0, 9.0]
    assert robot.events[-1].localised[0] and robot.events[-1].arrived[0]
    assert robot.state.phase[0] == ARRIVED and robot.state.node[0] == 2


def test_nearest_takes_the_least_distance():
    navigator = square()
    navigator.sight.summed = False  # type: ignore[misc]
    robot = Robot(navigator, goal=3)
    robot.localise(1)
    assert robot.state.evidence[0].tolist() == [1.0, 0.0, 1.0, 2.0] and robot.state.node[0] == 1


def test_after_localising_it_faces_the_edge_and_drives_when_the_detector_agrees():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}), goal=2)  # straight 0.5, by node 1 0.81
    robot.localise(0)
    assert robot.state.phase[0] == FACE and robot.navigator.map.edges[robot.state.edge[0]].tolist() == [0, 1]
    assert robot.state.target_rad[0] == pytest.approx(0.0) and robot.linear[0] == 0.0
    assert robot.step(0, p=0.5) == DRIVE  # the threshold itself counts as agreeing
    assert robot.events[-1].run_started[0] and robot.linear[0] == pytest.approx(0.01)
    assert robot.angular[0] == pytest.approx(0.05)


class Free(Told):
    """Images are (node, how far the way is free, m)."""

    def passage(self, images, ahead_m):
        return (images[:, 1:2] >= ahead_m).astype(float)


@pytest.mark.parametrize(
    ("edge", "settings", "asked_m"),
    [
        ((0, 1), {}, 1.7),  # 2 m less 0.3 m
        ((0, 2), {}, 2.0),  # the diagonal: 2.83 m less 0.3 m, but 2 m at most
        ((0, 2), {"ahead_m": 2.6}, 2.828 - 0.3),
        ((0, 1), {"slack_m": 0.0}, 2.0),
        ((0, 1), {"slack_m": 5.0}, 1.0),  # half of the edge at most
    ],
)
def test_an_edge_is_driven_where_the_way_is_free_for_its_length(edge, settings, asked_m):
    for free_m, phase in ((asked_m + 0.01, DRIVE), (asked_m - 0.01, SWING)):
        navigator = square({edge: 0.99}, **settings)
        navigator.sight = Free()
        robot = Robot(navigator, goal=edge[1])
        robot.localise(0)
        assert robot.navigator.map.edges[robot.state.edge[0]].tolist() == list(edge)
        assert robot.step(0, p=free_m) == phase


def test_without_an_edge_a_metre_is_enough_and_the_most_open_heading_is_the_one_free_that_far():
    for free_m, phase in ((1.01, DRIVE), (0.99, SWING)):
        made = square().map
        made = dataclasses.replace(made, edges=made.edges[:0], p=made.p[:0], angle_rad=made.angle_rad[:0])
        robot = Robot(Navigator(made, Free(), Counting(), NavigatorConfig(images=6)), goal=3)
        robot.localise(0)
        assert robot.state.edge[0] == -1 and robot.step(0, p=free_m) == phase
    # With one: no heading is free for 1.7 m, the third is for 1 m.
    navigator = square({(0, 1): 0.99})
    navigator.sight = Free()
    robot = Robot(navigator, goal=1)
    robot.localise(0)
    for free_m in (0.9, 0.2, 1.1, 0.5):
        assert robot.step(0, p=free_m) == SWING
        if free_m == 1.1:
            third = robot.heading
    assert robot.state.best_p[0] == 1.0 and robot.state.best_rad[0] == pytest.approx(third)


def test_twelve_runs_of_five_seconds_each_with_a_fresh_hidden_state():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}, glance=False), goal=2)
    robot.localise(0)
    began = robot.time
    linear = []
    while robot.step(0, p=0.9) == DRIVE:
        linear.append(float(robot.linear[0]))
    events = robot.events[-len(linear) - 1 :]
    assert [round(0.1 * i, 1) for i, e in enumerate(events) if e.run_ended[0]] == [5.0 * k for k in range(1, 13)]
    assert [round(0.1 * i, 1) for i, e in enumerate(events) if e.run_started[0]] == [5.0 * k for k in range(12)]
    assert len(linear) == 600 and robot.time - began == pytest.approx(60.1)
    assert linear == pytest.approx([0.01 * (1 + i % 50) for i in range(600)])
    assert robot.state.phase[0] == LOCALISE and robot.linear[0] == 0.0 and robot.angular[0] == 0.0
    assert robot.state.looks[0] == 0 and robot.state.evidence[0].tolist() == [0.0] * 4


def test_a_glance_at_a_neighbour_plans_from_there():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}), goal=2)
    robot.localise(0)
    robot.step(0, p=0.9)
    for _ in range(49):
        assert robot.step(1, p=0.9) == DRIVE  # within a run nobody looks where it is
    assert robot.step(1, p=0.9) == FACE and robot.events[-1].glanced[0] and robot.events[-1].run_ended[0]
    assert robot.state.node[0] == 1 and robot.state.target_rad[0] == pytest.approx(math.pi / 2)
    # It goes on counting: after twelve runs in all it looks about, wherever it is.
    assert robot.step(1, p=0.9) == DRIVE and robot.state.run[0] == 1
    ended = 1
    while robot.step(1, p=0.9) != LOCALISE:
        ended += int(robot.events[-1].run_ended[0])
    assert ended == 11 and robot.events[-1].run_ended[0] and robot.state.run[0] == 0


def test_a_glance_at_the_goal_is_checked_by_looking_about():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}), goal=2)
    robot.localise(0)
    robot.step(0, p=0.9)
    for _ in range(50):
        robot.step(2, p=0.9)
    assert robot.state.phase[0] == LOCALISE and not robot.events[-1].arrived[0]
    robot.localise(2)
    assert robot.state.phase[0] == ARRIVED


def test_a_glance_chooses_among_the_node_and_its_neighbours():
    # A chain of four: 0 - 1 - 2 - 3, 2 m apart.
    made = hand_map({}, ((0.0, 0.0), (2.0, 0.0), (4.0, 0.0), (6.0, 0.0)))
    made = dataclasses.replace(made, embeddings=np.zeros((4, 6, 2), np.float32))
    robot = Robot(Navigator(made, Told(), Counting(), NavigatorConfig(images=6)), goal=3)
    robot.localise(0)
    robot.step(0, p=0.9)
    for _ in range(50):
        robot.step(0, p=0.9)
    # Still there: it turns along the edge once more.
    assert robot.state.phase[0] == FACE and robot.state.run[0] == 1 and robot.state.node[0] == 0
    assert not robot.events[-1].glanced[0]
    robot.step(0, p=0.9)
    for _ in range(50):
        robot.step(3, p=0.9)  # looks like node 3, which cannot be: of 0 and 1, 1 is more like it
    assert robot.events[-1].glanced[0] and robot.state.node[0] == 1 and robot.state.phase[0] == FACE


def swings(robot, node, p):
    """Headings asked until it drives or plans anew, degrees from the edge's angle; p by heading."""
    asked, base = [], robot.state.base_rad[0]
    while robot.state.phase[0] in (FACE, SWING):
        target = robot.state.target_rad[0]
        asked.append(round(math.degrees(wrap_angle(target - base)), 3))
        robot.step(node, p(asked[-1]))
        if robot.events[-1].blocked[0]:
            break
    return asked


def test_it_swings_left_and_right_wider_and_wider_until_the_detector_agrees():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}, swing_deg=10.0), goal=2)
    robot.localise(0)
    assert swings(robot, 0, lambda a: 0.9 if a == -20 else 0.1) == [0, 10, -10, 20, -20]
    assert robot.state.phase[0] == DRIVE and robot.heading == pytest.approx(math.radians(-20))


def test_a_blocked_edge_costs_more_and_another_way_is_taken():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}, swings=1, swing_deg=20.0), goal=2)
    robot.localise(0)
    assert swings(robot, 0, lambda _: 0.2) == [0, 20, -20]
    # Straight: -log 0.5 = 0.69; by node 1 now 0.21 + 3.
    assert robot.state.phase[0] == FACE and robot.events[-1].blocked[0]
    assert robot.navigator.map.edges[robot.state.edge[0]].tolist() == [0, 2]
    assert robot.state.target_rad[0] == pytest.approx(math.pi / 4)
    assert robot.state.penalty[0].sum() == nav.PENALTY


def test_without_another_way_it_looks_all_round_and_leaves_by_the_most_open_heading():
    only = {(0, 1): 0.9, (1, 2): 0.9, (0, 2): 1e-6, (0, 3): 1e-6, (3, 2): 1e-6}
    robot = Robot(square(only, swings=1, swing_deg=60.0), goal=2)
    robot.localise(0)
    assert swings(robot, 0, lambda a: 0.4 if a == 60 else 0.2) == [0, 60, -60]
    assert robot.state.phase[0] == SWING and robot.state.penalty[0].sum() == nav.PENALTY
    assert swings(robot, 0, lambda _: 0.3) == [120, -120, -180]
    assert robot.state.phase[0] == LEAN and robot.state.target_rad[0] == pytest.approx(math.radians(60))
    assert robot.step(0, 0.2) == DRIVE
    # Blocked once more it costs no more, and behind it is a way out.
    for _ in range(50):
        robot.step(0, 0.2)
    assert swings(robot, 0, lambda _: 0.2) == [0, 60, -60]
    assert swings(robot, 0, lambda a: 0.5 if a == -120 else 0.2) == [120, -120]
    assert robot.state.phase[0] == DRIVE and robot.state.penalty[0].sum() == nav.PENALTY + 1.0  # of the run in vain


def driven(robot, node, runs=1, p=0.9):
    """Faces the edge and drives along it, found at a node after each run; the edge's ends."""
    robot.step(robot.state.node[0], p)
    assert robot.state.phase[0] == DRIVE
    edge = robot.navigator.map.edges[robot.state.edge[0]].tolist()
    while runs:
        robot.step(node, p)
        runs -= int(robot.events[-1].run_ended[0])
    return edge


def test_an_edge_driven_in_vain_costs_more_each_time():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}, retry_cost=0.3), goal=2)
    robot.localise(0)
    # By node 1: -2 log 0.9 = 0.21; straight: -log 0.5 = 0.69.
    assert driven(robot, 0) == [0, 1]
    assert driven(robot, 0) == [0, 1]  # 0.51
    assert driven(robot, 0) == [0, 2]  # 0.81 by node 1
    assert driven(robot, 0) == [0, 1]  # 0.99 straight
    assert driven(robot, 1) == [0, 2]  # 1.11 by node 1; and so it gets to node 1, nearer to its head than node 0
    edges = robot.navigator.map.edges.tolist()
    assert {tuple(e): c for e, c in zip(edges, robot.state.penalty[0], strict=True) if c} == pytest.approx(
        {(0, 1): 0.9, (0, 2): 0.3}
    )


def test_of_ways_nearly_as_free_the_shorter_is_taken():
    """From 0 to 2 of the square: 4 m by 1, or the diagonal of 2.83 m."""
    ways = {(0, 1): 0.99, (1, 2): 0.99, (0, 2): 0.9}
    for metre_cost, taken in (
        (0.0, [0, 1]),  # 0.020 against 0.105
        (0.05, [0, 1]),  # 0.220 against 0.247
        (0.1, [0, 2]),  # 0.420 against 0.388
    ):
        navigator = square(ways, metre_cost=metre_cost)
        assert navigator.map.edges[navigator.map.next_edge(0, 2)].tolist() == taken
    # A wall is not driven into for being near: 4.605 + 0.283 against 0.420.
    navigator = square({**ways, (0, 2): 0.01}, metre_cost=0.1)
    assert navigator.map.edges[navigator.map.next_edge(0, 2)].tolist() == [0, 1]


def test_a_success_forgets_nothing():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}, retry_cost=0.2), goal=2)
    robot.localise(0)
    assert [driven(robot, node) for node in (0, 1)] == [[0, 1], [0, 1]]
    assert robot.state.node[0] == 1 and robot.state.penalty[0].sum() == pytest.approx(0.2)


def test_without_glances_the_localisation_judges_the_edge():
    robot = Robot(square({(0, 1): 0.9, (1, 2): 0.9}, glance=False, retry_cost=1.0), goal=2)
    robot.localise(0)
    assert driven(robot, 3, runs=12) == [0, 1]
    assert robot.state.penalty[0].sum() == 0.0  # not known yet
    robot.localise(0)
    assert robot.state.penalty[0].sum() == 1.0 and driven(robot, 1, runs=12) == [0, 2]


class Line:
    """Images are (x, p): how far along a line of nodes 2 m apart they were taken."""

    summed = True

    def distances(self, images, heading_rad):
        return np.abs(images[:, :1] - 2.0 * np.arange(3))

    def passage(self, images, ahead_m):
        return np.broadcast_to(images[:, 1:2], ahead_m.shape)


def line(**settings):
    """Nodes 0 to 2 on a line, which `Line` sees."""
    made = hand_map({}, ((0.0, 0.0), (2.0, 0.0), (4.0, 0.0)))
    made = dataclasses.replace(made, embeddings=np.zeros((3, 6, 2), np.float32))
    robot = Robot(Navigator(made, Line(), Counting(), NavigatorConfig(**{"images": 6, **settings})), goal=2)  # type: ignore[arg-type]
    robot.localise(0.0)
    robot.step(0.0, p=0.9)
    assert robot.state.phase[0] == DRIVE
    return robot


def test_a_run_ends_where_the_edges_head_is_passed():
    robot, x = line(), 0.0
    while robot.state.phase[0] == DRIVE:
        x = round(x + 0.07, 6)
        robot.step(x, p=0.9)
    # 3.5 m in 5 s. Looks every 0.5 s: at 0.35 (not yet node 1), ..., 1.75, 2.1: 0.10 m from it, 2.45: 0.45 m.
    assert x == pytest.approx(2.45) and robot.events[-1].run_ended[0] and robot.events[-1].glanced[0]
    assert robot.state.node[0] == 1 and robot.state.phase[0] == FACE and robot.state.run[0] == 1
    robot, x = line(watch_s=0.0), 0.0
    while robot.state.phase[0] == DRIVE:
        x = round(x + 0.07, 6)
        robot.step(x, p=0.9)
    assert x == pytest.approx(3.5)


def test_where_the_map_has_no_way_it_tries_headings_that_never_repeat():
    made = hand_map({}, ((0.0, 0.0), (2.0, 0.0), (20.0, 0.0), (22.0, 0.0)))
    made = dataclasses.replace(made, embeddings=np.zeros((4, 6, 2), np.float32))
    robot = Robot(Navigator(made, Told(), Counting(), NavigatorConfig(images=6)), goal=3)
    robot.localise(0)
    assert robot.events[-1].lost[0] and robot.state.edge[0] == -1 and robot.state.phase[0] == FACE
    assert math.degrees(wrap_angle(robot.state.target_rad[0] - robot.heading)) == pytest.approx(137.508, abs=1e-3)
    assert robot.step(0, 0.9) == DRIVE


def test_time_runs_out():
    robot = Robot(square(limit_s=2.0), goal=2)
    robot.time = 100.0  # of a clock that did not start with the episode
    for _ in range(20):
        assert robot.step(0) != TIMED_OUT
    assert robot.step(0) == TIMED_OUT and robot.events[-1].timed_out[0]
    assert robot.linear[0] == robot.angular[0] == 0.0
    robot.step(2)
    assert robot.state.phase[0] == TIMED_OUT and not robot.events[-1].timed_out[0]


def test_who_knows_better_may_stop_it():
    navigator = square()
    state = navigator.stop(navigator.start(np.array([1, 2])), np.array([True, False]))
    assert state.phase.tolist() == [STOPPED, LOCALISE] and state.over.tolist() == [True, False]


def test_turning_is_what_simple_pid_computes():
    config = NavigatorConfig(images=6, kp=1.5, ki=0.7, kd=0.2, max_turn_rad_s=0.8)
    navigator = square(**{k: getattr(config, k) for k in ("kp", "ki", "kd", "max_turn_rad_s")})
    state = navigator.start(np.array([2]))
    state = dataclasses.replace(
        state, phase=np.array([FACE], np.int8), target_rad=np.array([3.0]), began_s=np.zeros(1), clock_s=np.zeros(1)
    )
    pid = PID(
        1.5, 0.7, 0.2, setpoint=0.0, sample_time=None, output_limits=(-0.8, 0.8), differential_on_measurement=False
    )
    heading, time = 2.0, 0.0
    for k in range(40):
        dt = 0.1 if k % 3 else 0.15
        time += dt
        state = navigator.step(state, seen((0, 0.0)), np.array([heading]), time)
        expected = pid(-float(wrap_angle(3.0 - heading)), dt=dt)
        if state.phase[0] != FACE:  # reached
            break
        assert state.angular[0] == pytest.approx(expected, abs=1e-9) and state.linear[0] == 0.0
        heading += 0.9 * state.angular[0] * dt
    assert k > 10 and abs(wrap_angle(3.0 - heading)) <= math.radians(3.0)
    assert wrap_angle(np.array([math.pi, -math.pi, 3 * math.pi / 2])).tolist() == pytest.approx(
        [-math.pi, -math.pi, -math.pi / 2]
    )


def script(seed, steps=900):
    """A robot in a world of chance: nodes, passages and how fast it turns."""
    rng = np.random.default_rng(seed)
    return (
        rng.integers(0, 4, steps // 50 + 1).repeat(50)[:steps],
        rng.uniform(0, 1, steps),
        rng.uniform(0.5, 1.5, steps),
    )


def played(navigator, goals, seeds, garbage=False, steps=900):
    """States after every step of a batch, as flat arrays."""
    state, heading = navigator.start(np.array(goals)), np.array([0.3 * s for s in seeds])
    scripts, out = [script(s, steps) for s in seeds], []
    for t in range(steps):
        images = seen(*[(nodes[t], p[t]) for nodes, p, _ in scripts])
        if garbage:
            images[~navigator.looks(state, heading, 0.1 * t)] = np.nan
        state = navigator.step(state, images, heading, 0.1 * t)
        heading = heading + state.angular * [gain[t] for *_, gain in scripts] * 0.1
        out.append(state)
    return out


def assert_same(a, b, rows_a=slice(None), rows_b=slice(None)):
    """Whether two plays are equal, row by row."""
    for one, two in zip(a, b, strict=True):
        for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
            np.testing.assert_array_equal(x[rows_a], y[rows_b])


def test_episodes_of_a_batch_know_nothing_of_each_other():
    navigator = square(swings=2, images=3)
    together = played(navigator, [1, 2, 3], [5, 6, 7])
    phases = {int(p) for state in together for p in state.phase}
    assert {LOCALISE, FACE, SWING, DRIVE} <= phases
    for i, (goal, seed) in enumerate(zip([1, 2, 3], [5, 6, 7], strict=True)):
        assert_same(together, played(navigator, [goal], [seed]), slice(i, i + 1))


def test_images_that_are_not_looked_at_may_be_anything():
    navigator = square(swings=2, images=3)
    assert_same(played(navigator, [1, 2], [8, 9]), played(navigator, [1, 2], [8, 9], garbage=True))


def test_a_step_leaves_its_state_as_it_was():
    navigator = square()
    state = played(navigator, [1, 2], [3, 4], steps=200)[-1]
    before = jax.tree.map(np.copy, state)
    navigator.step(state, seen((1, 0.9), (2, 0.9)), np.zeros(2), 20.0)
    for x, y in zip(jax.tree.leaves(state), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(x, y)


def test_goals_are_found_by_their_images():
    navigator = square()
    images = np.array([[(2, 0), (2, 0)], [(0, 0), (1, 0)], [(3, 0), (1, 0)]], float)
    # The second is as far from 0 as from 1, the third as far from 1 as from 2 and 3: the first of equals.
    assert navigator.goal_nodes(images, np.array([0.0, 1.0])).tolist() == [2, 0, 1]


def test_images_must_be_a_share_of_the_maps():
    with pytest.raises(ConfigError, match="images is 4, expected a divisor of 6"):
        square(images=4)
