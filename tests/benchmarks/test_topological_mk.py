"""Every command of benchmarks/topological.mk is one that the command line takes, in an order that can work."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from topological_nav.__main__ import parser
from topological_nav.adapt_config import AdaptConfig
from topological_nav.config import (
    DataConfig,
    DriveConfig,
    EvaluationConfig,
    ExportConfig,
    MapConfig,
    PolicyConfig,
    passage_config,
    room_config,
)
from topological_nav.settings import overridden
from train.config_io import load

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def listed(*words: str) -> str:
    command = ("make", "-n", "-f", "benchmarks/topological.mk", "RUNS=/nowhere", "PPO=runs/x", *words)
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def settings_of(arguments):
    if arguments.command == "data":
        return DriveConfig() if arguments.drives else DataConfig()
    if arguments.command == "train":
        return {"rooms": room_config, "passages": passage_config, "policy": PolicyConfig}[arguments.task]()
    return {"map": MapConfig, "evaluate": EvaluationConfig, "adapt": AdaptConfig, "export": ExportConfig}[
        arguments.command
    ]()


@pytest.mark.parametrize("size", ["full", "cpu"])
def test_all_commands_are_understood_and_made_in_order(size):
    commands = [
        shlex.split(line)
        for line in re.findall(r"if python -m topological_nav (.*?) >>/nowhere", listed(f"SIZE={size}"))
    ]
    # Four datasets, five networks, ten maps, policy, three evaluations of ten scenes each on its own and then summed
    # up, two of another domain, two adaptations, four maps of them, export.
    assert len(commands) == len({tuple(words) for words in commands}) == 4 + 5 + 10 + 1 + 3 * 11 + 2 + 2 + 4 + 1
    made: set[str] = set()
    for words in commands:
        settings = [word for word in words if re.match(r"\w+=", word)]
        arguments = parser().parse_args([word for word in words if word not in settings])
        overridden(settings_of(arguments), settings)
        out = str(arguments.out)
        for name in ("localiser", "detector", "data", "target", "maps"):
            needed = getattr(arguments, name, None)
            if needed is not None and str(needed).startswith("/nowhere"):
                assert any(done == str(needed) or done.startswith(f"{needed}/") for done in made), (words, name)
        made.add(out)


def test_a_policy_told_the_goal_is_trained_where_none_is_given():
    shown = listed("SIZE=full", "PPO=/nowhere/ppo")
    (words,) = [shlex.split(line) for line in re.findall(r"if python -m train (.*?) >>/nowhere", shown)]
    name, settings = words[words.index("--config") + 1], [w for w in words if re.match(r"[\w.]+=", w)]
    config = load(name, settings)
    assert (config.env.robot, len(config.env.scenes), config.run.name) == ("ttbot", 8, "ppo")
    assert not re.findall(r"if python -m train ", listed("SIZE=full"))


def test_commands_are_spread_over_gpus():
    shown = re.findall(r"^mkdir .*; if python -m .*$", listed("GPUS=0 1 2 3"), re.M)
    assert len(shown) > 50
    assert all("set -- 0 1 2 3; shift $(( $$ % 4 )); export CUDA_VISIBLE_DEVICES=$1;" in line for line in shown)
    assert "CUDA_VISIBLE_DEVICES" not in listed()


def test_another_size_is_refused():
    with pytest.raises(subprocess.CalledProcessError) as refused:
        listed("SIZE=tiny")
    assert "SIZE is 'tiny', expected full or cpu" in refused.value.stderr
