"""A sweep's file: every combination becomes a run with the settings it should have, and mistakes are told."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
import yaml

from interactive_nav_common.commands import parse
from interactive_nav_common.errors import ConfigError
from scenes_mjcf import sets
from train import evaluate
from train.config_io import preset_names
from train.scoring import session
from train.sweep import spec
from train.sweep.__main__ import main
from train.sweep.folder import SweepFolder, words_of_evaluation

ROOT = Path(__file__).parents[3]
FILE = """
name: small
preset: "{env.robot}_ppo"
grid:
  env.robot: [turtlebot]
  env.k_int: [0.0, 1.0]
  run.seed: [0, 1]
settings:
  run: {num_timesteps: 1000000}
  ppo.learning_rate: 1e-4
overrides:
  - where: {env.k_int: 1.0}
    settings: {ppo.entropy_cost: 0.5, run.num_timesteps: 2e6}
    launch: {runs_per_gpu: 2}
  - where: {env.k_int: [0.0, 1.0], run.seed: 1}
    settings: {ppo.entropy_cost: 0.25}
skip:
  - {env.k_int: 0.0, run.seed: 1}
evaluate: {episodes: 50, scenes: [scenes_mjcf/rowan]}
launch: {runs_per_gpu: 4}
"""


def sweep_of(text: str) -> spec.Sweep:
    return spec.expand(yaml.safe_load(text), "s.yaml", "s")


def test_every_combination_but_the_skipped_has_its_own_settings():
    sweep = sweep_of(FILE)
    assert [run.name for run in sweep.runs] == [
        "turtlebot-k_int0-seed0",
        "turtlebot-k_int1-seed0",
        "turtlebot-k_int1-seed1",
    ]
    configs = [run.config for run in sweep.runs]
    assert [c.env.k_int for c in configs] == [0.0, 1.0, 1.0]
    assert [c.run.seed for c in configs] == [0, 0, 1]
    # Later layers win: preset (0.01), then each matching override in order.
    assert [c.ppo.entropy_cost for c in configs] == [0.01, 0.5, 0.25]
    assert [c.run.num_timesteps for c in configs] == [1_000_000, 2_000_000, 2_000_000]
    assert {c.ppo.learning_rate for c in configs} == {1e-4}
    assert {c.run.out_dir for c in configs} == {"sweeps/small/runs"}
    assert [run.launch.runs_per_gpu for run in sweep.runs] == [4, 2, 2]
    assert sweep.config.evaluate.episodes == 50 and sweep.config.evaluate.scenes == ("scenes_mjcf/rowan",)
    assert sweep.runs[1].cell == sweep.runs[2].cell == ("turtlebot", "1.0")


def test_machines_can_share_a_sweep():
    sweep = sweep_of(FILE)
    names = [run.name for run in sweep.runs]
    only = spec.select(sweep, ["env.k_int=1.0", "run.seed=1,0"])
    assert [run.name for run in only.runs] == names[1:]
    for where, message in (
        (["env.k_int=2"], "env.k_int is 2, expected one of [0.0, 1.0]"),
        (["k_int=1"], "'k_int' is no axis of the grid, did you mean 'env.k_int'?"),
        (["env.k_int"], "expected setting=value"),
        (["env.k_int=0.0", "env.k_int=1.0"], "no run of the sweep is left"),
    ):
        with pytest.raises(ConfigError) as error:
            spec.select(sweep, where)
        assert message in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("grid:", "gird:", "s.yaml: unknown key 'gird', did you mean 'grid'?"),
        ("env.k_int: [0.0, 1.0]\n", "k_int: [0.0, 1.0]\n", "grid: unknown key 'k_int', did you mean 'env.k_int'?"),
        ("[0.0, 1.0]\n", "[0.0, 1.0, x]\n", "env.k_int is 'x', expected a number"),
        ("env.k_int: [0.0, 1.0]\n", "env.k_int: 1.0\n", "grid: env.k_int is 1.0, expected a list"),
        ("env.robot: [turtlebot]", "run.name: [a]", "grid: run.name is chosen by the sweep"),
        ("episodes: 50", "episodes: 0", "evaluate.episodes is 0, expected at least 1"),
        ("episodes: 50", "episods: 50", "unknown key 'evaluate.episods', did you mean"),
        ("episodes: 50", "checkpoint: newest", "checkpoint is 'newest', expected best, last or a number"),
        ("runs_per_gpu: 4", "jax_memory_share: 0", "launch.jax_memory_share is 0.0, expected between 0.01 and 1"),
        ("runs_per_gpu: 2", "runs_per_gup: 2", "unknown key 'launch.runs_per_gup', did you mean"),
        ("env.k_int: 1.0}", "env.k_int: 3.0}", "overrides[0]: env.k_int is 3.0, expected one of [0.0, 1.0]"),
        (
            "- where: {env.k_int: 1.0}",
            "- were: {env.k_int: 1.0}",
            "overrides[0]: unknown key 'were', did you mean 'where'",
        ),
        (
            "ppo.entropy_cost: 0.5",
            "ppo.entropy_cots: 0.5",
            "unknown key 'ppo.entropy_cots', did you mean 'ppo.entropy_cost'",
        ),
        (
            '"{env.robot}_ppo"',
            '"{env.robt}_ppo"',
            "preset: {env.robt} is no axis of the grid, did you mean 'env.robot'?",
        ),
        ('"{env.robot}_ppo"', '"{env.robot}_pop"', "no preset 'turtlebot_pop', did you mean 'turtlebot_ppo'?"),
        ("name: small", "name: a/b", "name is 'a/b', expected one folder name"),
        ("run.seed: [0, 1]", "run.seed: [0, 1, 1]", "two runs are named 'turtlebot-k_int1-seed1'"),
        ("  - {env.k_int: 0.0, run.seed: 1}", "  {}", "skip is {}, expected a list"),
        ("ppo.learning_rate: 1e-4", "ppo.num_envs: 1000", "expected a multiple of ppo.num_envs"),
        ("- {env.k_int: 0.0, run.seed: 1}", "- {env.robot: turtlebot}", "no run is left of the grid"),
    ],
)
def test_mistakes_name_the_file_the_key_and_the_reason(old, new, message):
    assert old in FILE
    with pytest.raises(ConfigError) as error:
        sweep_of(
            FILE.replace(old, new).replace(
                "ppo.num_envs: 1000", "ppo: {num_envs: 1000, batch_size: 64, num_minibatches: 2}"
            )
        )
    assert message in str(error.value), str(error.value)


def test_every_sweep_of_the_package_can_be_run(monkeypatch):
    """Those in homes that are not committed too, once these are made."""
    of_set = sets._members
    homes = ["cluttered_000", "cluttered_001"]
    monkeypatch.setattr(sets, "_members", lambda word: homes if word.startswith("cluttered/") else of_set(word))
    assert {"kint", "cluttered"} <= set(preset_names(spec.SWEEP_DIR))
    for name in preset_names(spec.SWEEP_DIR):
        assert spec.load_sweep(name).runs
    sweep = spec.load_sweep("cluttered")
    assert {len(run.config.env.scenes) for run in sweep.runs} == {2} and len(sweep.runs) == 54
    assert {run.config.env.num_objects for run in sweep.runs} == {4}


def test_fixed_episodes_of_each_run_s_robot_are_played(monkeypatch):
    monkeypatch.chdir(ROOT)
    files = ["scenes_mjcf/episodes/sparse-{robot}-train.json.gz", "scenes_mjcf/episodes/sparse-{robot}-test.json.gz"]
    text = FILE.replace("episodes: 50", f"episode_files: {json.dumps(files)}").replace(
        "[turtlebot]", "[turtlebot, fetch]"
    )
    folder = SweepFolder(sweep_of(text))
    asked = {run.config.env.robot: folder.request(run) for run in folder.sweep.runs}
    assert {robot: (a.episodes, a.seed, a.balanced) for robot, a in asked.items()} == dict.fromkeys(
        ("turtlebot", "fetch"), (2000, 0, False)
    )
    assert asked["fetch"].episode_file != asked["turtlebot"].episode_file != ""
    fetch = next(run for run in folder.sweep.runs if run.config.env.robot == "fetch")
    words = words_of_evaluation(folder, [fetch.name], ("-m", "train.evaluate"))
    given = [word for flag, word in itertools.pairwise(words) if flag == "--episode-file"]
    assert given == [name.replace("{robot}", "fetch") for name in files]
    understood = parse(evaluate.Evaluate, "tool", words[3:])
    played, digest = session.read_episodes(understood.episode_file, understood.episodes)
    assert (len(played.episodes), digest) == (asked["fetch"].episodes, asked["fetch"].episode_file)


def test_a_wrong_file_is_one_line_and_exit_2(tmp_path, capsys):
    for words, message in (
        (["kitn"], "no sweep 'kitn', did you mean 'kint'?"),
        ([str(tmp_path / "no.yaml")], "no.yaml: no such file; expected a YAML file"),
        ([], "missing NAME|PATH"),
        (["kint", "--time-limit", "0"], "--time-limit is 0.0, expected a positive number"),
    ):
        assert main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("train.sweep: ") and message in line
