import dataclasses

import pandas
import pytest

import interactive_nav
from docs.studies.policies.detours import by_detour, detours_m, main
from interactive_nav import episodes
from tests.toys import write_room


def test_scores_stand_by_what_the_way_round_heavy_furniture_costs(tmp_path, capsys):
    room = write_room(tmp_path / "homes" / "room", (4.0, 3.0), (("basket", 0.0, 0.0, 40.0, 0.5),), split="test")
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=0)
    file = episodes.draw_episode_file(env, 2, 0)
    ways = [((-0.7, y), (1.6, y)) for y in (0.0, 1.0)]  # through the block's middle, and past it
    chosen = [
        {**row, "start_xy_w": list(start), "goal_xy_w": list(goal), "shortest_path_m": 2.3}
        for row, (start, goal) in zip(file.episodes, ways, strict=True)
    ]
    episodes.save_episode_file(dataclasses.replace(file, episodes=chosen), tmp_path / "two.json")
    found = detours_m("turtlebot", [str(room)], str(tmp_path / "two.json"), 1.0)
    # By hand, round the two corners of a square of 0.4 m as a disc of the robot's radius: tests of options.
    assert found == pytest.approx([0.21, 0.0], abs=0.03)
    heavier = detours_m("turtlebot", [str(room)], str(tmp_path / "two.json"), 20.0)  # of 2.7 kg: nothing is that heavy
    assert heavier == pytest.approx([0.0, 0.0], abs=1e-4)

    score = {"success": 1.0, "path_efficiency": 0.8, "effort_efficiency": 0.6, "ins_0.5": 0.7}
    lost = {"success": 0.0, "path_efficiency": 0.0, "effort_efficiency": 0.8, "ins_0.5": 0.4}
    own = {"policy": "learned", "algorithm": "ppo", "k_int": 0.1, "robot": "turtlebot", "split": "test"}
    planner = {**own, "policy": "namo:1"}
    rows = [{**own, **score, "episode": 0}, {**own, **lost, "episode": 0}, {**own, **score, "episode": 1},
            {**planner, **score, "episode": 0}]  # fmt: skip
    table = by_detour(pandas.DataFrame(rows), found)
    assert table.loc[("PPO, k_int 0.1", "below 0.3 m")].tolist() == [1, 0.5, 0.4, 0.7, 0.55, 1]
    assert table.loc[("PPO, k_int 0.1", "below 0.05 m")].tolist() == [1, 1.0, 0.8, 0.6, 0.7, 0]
    assert table.loc[("namo:1", "below 0.3 m"), "ins_0.5"] == 0.7 and len(table) == 3

    pandas.DataFrame(rows).to_parquet(tmp_path / "rows.parquet")
    asked = ["--scenes", str(room), "--episode-file", str(tmp_path / "two.json"), "--episodes", "1"]
    assert main([str(tmp_path / "rows.parquet"), *asked]) == 0
    told = capsys.readouterr().out
    assert "below 0.3 m" in told and "below 0.05 m" not in told  # the first episode alone
