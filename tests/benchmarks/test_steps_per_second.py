"""Windows are proposed from what was needed, and hold it."""

import numpy as np

from benchmarks.steps_per_second import LEFT_OUT_SHARE, SETTINGS, simulation, windows
from tests.toys import write_room

# Six cubes round the start that the robot cannot leave by far, one far away.
NEAR = tuple(("chair", 0.62 * np.cos(a), 0.62 * np.sin(a), 5.0, 0.5) for a in np.linspace(0, 2 * np.pi, 7)[:-1])


def test_what_is_needed_is_counted_and_proposed(tmp_path):
    folder = write_room(tmp_path / "room", (3.0, 3.0), (*NEAR, ("table", 1.2, 1.2, 9.0, 0.5)))
    row = windows("turtlebot", [str(folder)], "native", 8, 60, {"num_objects": 1, "min_goal_distance_m": 0.5})
    assert set(row["proposed"]) == set(SETTINGS.values()) and set(row["needs"]) == set(SETTINGS)
    assert 0 < row["env_steps"] <= 8 * 6
    free = row["needs"]["free"]
    assert 1 <= free["0.5"] <= free["1.0"] <= 7 and row["proposed"]["active_furniture"] == free["1.0"]
    assert row["proposed_left_out_share"] <= LEFT_OUT_SHARE
    assert row["needs"]["hinge"]["1.0"] == 0 and row["proposed"]["active_doors"] == 1, "0 would stand for all"
    # The default window holds five pieces: what it would have left out is the share that needs more.
    assert (row["left_out_share"] > 0) == (free["1.0"] > 5)


def test_a_control_step_is_five_of_physics(tmp_path):
    folder = write_room(tmp_path / "room")
    row = simulation("turtlebot", [str(folder)], "native", 4, 20, {"num_objects": 0})
    assert abs(row["physics_steps_per_s"] - 5 * row["env_steps_per_s"]) <= 3
    assert row["env_steps"] == 80 and row["nonfinite"] == 0
