"""The simulator in a bare toy room of 6 x 4 m with one cube: distances, odometry and touches by hand."""

import dataclasses
import math

import numpy as np
import pytest

from interactive_nav_common.errors import UserError
from tests.toys import write_room
from topological_nav.ros.config import SimulatorConfig
from topological_nav.ros.simulator import build_simulator

CONFIG = SimulatorConfig(
    start=(-2.0, 1.0, 0.0), width=32, height=24, supersample=2, engine="rays", lidar_rays=4, lidar_fov_deg=360.0,
    lidar_range_m=4.5,
)  # fmt: skip


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("ros") / "room", (6.0, 4.0), (("chair", 1.4, -0.5, 5.0, 0.5),))


@pytest.fixture(scope="module")
def simulator(room):
    return build_simulator(room, CONFIG)


@pytest.fixture(scope="module")
def at_start(simulator):
    """What is sensed before a test has driven anywhere."""
    return simulator.sense()


def test_it_drives_ahead_until_it_meets_the_wall(simulator, at_start):
    first = at_start
    assert first.time_s == 0.0 and first.truth_w == pytest.approx([-2.0, 1.0, 0.0])
    assert first.odometry == pytest.approx([0, 0, 0])
    # The scanner is 0.17 m ahead: behind, to the right, ahead (out of range) and to the left.
    assert first.scan * 4.5 == pytest.approx([1.17, 3.0, 4.5, 1.0], abs=1e-4)
    assert first.images["rgb"].shape == (24, 32, 3) and first.images["rgb"].std() > 5
    for _ in range(20):
        now = simulator.step(0.5, 0.0)
    assert now.time_s == pytest.approx(2.0)
    assert now.odometry == pytest.approx([now.truth_w[0] + 2.0, 0.0, 0.0], abs=2e-3)
    assert 0.85 < now.odometry[0] < 1.0  # a metre, less what speeding up takes
    assert now.linear_b == pytest.approx([0.5, 0, 0], abs=0.02)
    assert now.scan[0] * 4.5 == pytest.approx(1.17 + now.odometry[0], abs=2e-3)
    assert not now.touches_structure and now.force_n == 0.0
    for _ in range(60):
        if now.touches_structure:
            break
        now = simulator.step(1.0, 0.0)
    # Its chassis ends 0.25 m ahead of its middle.
    assert now.touches_structure and not now.touches_movable and now.force_n > 1.0
    assert now.truth_w[0] == pytest.approx(2.75, abs=0.06)
    back = simulator.step(-0.5, 0.0)
    for _ in range(10):
        back = simulator.step(-0.5, 0.0)
    assert not back.touches_structure and back.truth_w[0] < now.truth_w[0] - 0.2


def test_it_turns_as_fast_as_it_is_told_and_pictures_change(simulator, at_start):
    del at_start  # before
    for _ in range(5):
        before = simulator.step(0.0, 0.0)
    for _ in range(20):
        after = simulator.step(0.0, 0.5)
    turned = math.remainder(after.heading_rad - before.heading_rad, math.tau)
    assert turned == pytest.approx(1.0, abs=0.15)  # less what speeding up takes
    assert math.remainder(after.odometry[2] - after.heading_rad, math.tau) == pytest.approx(0.0, abs=1e-4)
    assert after.angular_b[2] == pytest.approx(0.5, abs=0.25)  # tyres that scrub sideways do it in jerks
    assert np.abs(after.images["rgb"].astype(float) - before.images["rgb"]).mean() > 2


def test_pictures_span_the_field_of_view_that_is_asked_for(room, at_start):
    narrow = build_simulator(room, dataclasses.replace(CONFIG, fov_deg=40.0)).sense().images["rgb"]
    wide = at_start.images["rgb"]
    assert np.abs(narrow.astype(float) - wide).mean() > 2


def test_a_blocked_start_is_refused(room):
    with pytest.raises(UserError, match=r"start \(1.4, -0.5\) is 0.00 m from obstacles, expected at least"):
        build_simulator(room, SimulatorConfig(start=(1.4, -0.5, 0.0)))


def test_settings_are_checked():
    with pytest.raises(UserError, match="start is \\[1.0\\], expected x, y and yaw"):
        SimulatorConfig(start=(1.0,))
    with pytest.raises(UserError, match="lidar_fov_deg is 361"):
        SimulatorConfig(lidar_fov_deg=361.0)
