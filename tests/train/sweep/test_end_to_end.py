"""One small sweep with the real programs: two seeds trained in a room, scored there and in another, drawn."""

from __future__ import annotations

import pytest
import yaml

from interactive_nav_common.rows import read_rows
from tests.toys import write_room
from train.figures import __main__ as cli
from train.sweep.__main__ import main

pytestmark = pytest.mark.slow


@pytest.mark.heavy
def test_from_a_file_to_pictures(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # a few steps only: compiling well would take longer
    seen = write_room(tmp_path / "den")
    unseen = write_room(tmp_path / "attic", (4.5, 3.0), split="test")
    sizes = {"num_envs": 4, "unroll_length": 8, "batch_size": 4, "num_minibatches": 2}
    plain = {
        "out_dir": str(tmp_path),
        "preset": "demo",
        "grid": {"run.seed": [0, 1]},
        "settings": {
            "env": {"scenes": [str(seen)], "episode_steps": 8, "num_objects": 0},
            "ppo": {**sizes, "num_updates_per_batch": 1},
            "run": {"num_timesteps": 256, "log_every_steps": 64, "checkpoint_every_steps": 128},
        },
        "evaluate": {"scenes": [str(seen), str(unseen)], "episodes": 6, "record": 2, "batch": 4},
        "launch": {"slots": 2},  # nearly all of a run's time is compiling, on one core
    }
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(plain))
    assert main([str(path)]) == 0, capfd.readouterr()
    rows = read_rows(list((tmp_path / "tiny" / "rows").glob("*.parquet"))).to_pydict()
    assert sorted(set(rows["run"])) == ["seed0", "seed1"] and len(rows["run"]) == 12
    assert rows["scene"] == ["den", "attic"] * 6 and rows["split"] == ["train", "test"] * 6
    assert set(rows["train_env_steps"]) == {256} and set(rows["seed"]) == {0, 1}
    # Both runs played the same episodes.
    assert rows["shortest_path_m"][:6] == rows["shortest_path_m"][6:]
    assert len(set(rows["shortest_path_m"])) == 6
    assert cli.main([str(tmp_path / "tiny"), "-o", str(tmp_path / "figures")]) == 0
    made = {picture.stem for picture in (tmp_path / "figures").iterdir()}
    assert {"ins_over_alpha_turtlebot", "path_effort_turtlebot", "seen_unseen", "learning_curves"} <= made
    capfd.readouterr()
    assert main([str(path)]) == 0 and "started" not in capfd.readouterr().out
