"""A TurtleBot in a bare toy room of 6 x 4 m: pictures, scans and odometry by hand."""

import math

import numpy as np
import pytest

import interactive_nav
from interactive_nav.ros.__main__ import main
from interactive_nav.ros.simulator import NEEDED, RosSimulator, compose
from interactive_nav_common.errors import UserError
from tests.toys import write_room

CHAIR = 2
"""Its class id."""


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    room = write_room(tmp_path_factory.mktemp("ros") / "room", (6.0, 4.0), (("chair", 1.4, -1.5, 5.0, 0.5),))
    observed = ("depth", "segmentation", "rgb", *NEEDED)
    sizes = {"image_size": 33, "lidar_rays": 4, "lidar_fov_deg": 360.0, "num_objects": 0}
    return interactive_nav.make("turtlebot", [room], backend="native", observations=observed, **sizes)


def test_sensors_are_those_of_the_environment_in_si_units(env):
    simulator = RosSimulator(env, start=(-1.0, 0.5, math.pi / 2))
    now = simulator.sense()
    assert now.odometry == pytest.approx([-1.0, 0.5, math.pi / 2], abs=1e-4)  # the map's
    assert now.scan * 5.6 == pytest.approx([2.5, 4.0, 1.5, 2.0], abs=1e-3)  # behind, right, ahead, left
    depth, ids, rgb = (now.images[name] for name in ("depth", "segmentation", "rgb"))
    assert (depth.shape, depth.dtype, ids.dtype, rgb.shape, rgb.dtype) == (
        (33, 33),
        "float32",
        "uint8",
        (33, 33, 3),
        "uint8",
    )
    # The camera is 0.087 m behind the middle of the base.
    assert depth[16, 16] == pytest.approx(1.587, abs=2e-3) and depth.max() <= 5.0
    assert rgb.std() > 5 and not ids.any()  # structure
    facing = RosSimulator(env, start=(0.0, -1.5, 0.0)).sense().images
    assert facing["segmentation"][16, 16] == CHAIR and 0.8 < facing["depth"][16, 16] < 1.487
    for _ in range(10):
        now = simulator.step(0.3, 0.0)
    assert now.odometry == pytest.approx(now.truth_w, abs=1e-3) and now.truth_w[1] > 0.6


def test_a_start_in_a_wall_is_refused(env):
    with pytest.raises(UserError, match=r"start \(-3.0, 0.5\) is not where the robot has room"):
        RosSimulator(env, start=(-3.0, 0.5, 0.0))


def test_poses_are_composed():
    assert compose(np.array([1.0, 2.0, math.pi / 2]), np.array([3.0, 1.0, 0.5])) == pytest.approx(
        [0, 5, math.pi / 2 + 0.5]
    )


def test_a_start_that_is_no_pose_is_one_line(capsys):
    assert main(["simulate", "room", "--start", "1,2"]) == 2
    assert "--start is '1,2', expected X,Y,YAW" in capsys.readouterr().err
