"""Rates of stepping are counted in the units that they say."""

from benchmarks.steps_per_second import simulation
from tests.toys import write_room


def test_a_control_step_is_five_of_physics(tmp_path):
    folder = write_room(tmp_path / "room")
    row = simulation("turtlebot", [str(folder)], "native", 4, 20, {"num_objects": 0})
    assert abs(row["physics_steps_per_s"] - 5 * row["env_steps_per_s"]) <= 3
    assert row["env_steps"] == 80 and row["nonfinite"] == 0
