"""A run remembers a robot that a file describes: resuming, evaluating and replaying, wherever it is moved to."""

from __future__ import annotations

import dataclasses
import io
import shutil

import pyarrow.parquet as pq
import pytest
from rich.console import Console

from interactive_nav.pictures import replay
from interactive_nav.robots import get_robot
from interactive_nav_common.commands import parse
from interactive_nav_common.config import replace
from interactive_nav_common.errors import FileError
from tests.interactive_nav.robots.urdf import cart
from tests.toys import write_room
from tests.train.toy_run import UPDATE_STEPS, build_toy, toy_config
from train import evaluate
from train import replay as replay_program
from train.__main__ import Train
from train.config import EnvConfig, TrainConfig
from train.config_io import apply_overrides, with_robot
from train.runs.run import train_run
from train.runs.run_folder import RunFolder

pytestmark = pytest.mark.filterwarnings("ignore:.*(meets furniture|an octagon)")


def with_own(config, path):
    return dataclasses.replace(config, env=replace(config.env, robot=str(path)))


def train(config, **more):
    return train_run(config, Console(file=io.StringIO()), **more)[1]


def test_both_spellings_of_the_option_name_a_robot(tmp_path):
    path = tmp_path / 'my "porter".urdf'
    words = parse(Train, "tool", ["--config", "demo", "--robot", str(path)])
    assert with_robot(["run.seed=1"], None) == ["run.seed=1"]
    assert apply_overrides(TrainConfig(), with_robot(words.settings, words.robot)).env.robot == str(path)
    assert apply_overrides(TrainConfig(), ["env.robot=a/b.py:porter"]).env.robot == "a/b.py:porter"


def test_a_run_goes_on_with_the_file_that_it_began_with(tmp_path):
    path = tmp_path / "porter.urdf"
    path.write_text(cart())
    config = with_own(toy_config(tmp_path / "runs", updates=2), path)
    folder = train(config, build_env=build_toy)
    assert folder.read_config().env.robot == str(folder.path / "robot" / "porter.urdf")
    assert '"robot": "porter"' in folder.summary.read_text()
    more = dataclasses.replace(config, run=dataclasses.replace(config.run, num_timesteps=4 * UPDATE_STEPS))
    copy = tmp_path / "elsewhere" / "porter.urdf"
    copy.parent.mkdir()
    shutil.copyfile(path, copy)
    train(with_own(more, copy), build_env=build_toy)  # of the same content, in another place
    train(with_own(more, folder.read_config().env.robot), build_env=build_toy)  # as --resume does
    path.write_text(cart().replace('mass value="12"', 'mass value="13"'))
    with pytest.raises(FileError, match=r"has env.robot = 'porter.urdf, sha256 \w+', this one 'porter.urdf, sha256"):
        train(more, build_env=build_toy)
    with pytest.raises(FileError, match="has env.robot = 'porter.urdf, sha256.*this one 'turtlebot'; set run.name"):
        train(with_own(more, "turtlebot"), build_env=build_toy)


@pytest.mark.heavy
def test_a_moved_run_is_evaluated_replayed_and_drawn(tmp_path, monkeypatch):
    (tmp_path / "porter.urdf").write_text(cart())
    toy, room = toy_config(tmp_path / "runs", updates=2), write_room(tmp_path / "room")
    env = EnvConfig.of(scenes=(str(room),), backend="native", episode_steps=12, num_objects=2)
    config = with_own(TrainConfig(env=env, ppo=toy.ppo, run=toy.run), tmp_path / "porter.urdf")
    folder = train(config)
    assert replay_program.main([str(folder.path), "--policies", "random"]) == 0
    shutil.move(folder.path, tmp_path / "moved")
    (tmp_path / "porter.urdf").unlink()
    monkeypatch.chdir(tmp_path / "moved")
    assert evaluate.main([".", "--episodes", "2", "--policies", "learned,random"]) == 0
    rows = pq.read_table("evaluation/episodes.parquet").to_pydict()
    assert set(rows["robot"]) == {"porter"} and len(rows["success"]) == 4
    played = replay.load_replay(tmp_path / "moved" / "replays" / "random-episode0.npz")
    assert get_robot(played.robot).name == "porter"
    assert RunFolder(tmp_path / "moved").read_config().env.robot == str(tmp_path / "moved" / "robot" / "porter.urdf")
