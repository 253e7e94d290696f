"""Every command of benchmarks/topological.mk is one that the command line takes, in an order that can work."""

import dataclasses
import re
import shlex
import shutil
import subprocess
from collections.abc import Collection
from pathlib import Path

import pytest

from interactive_nav_common.commands import parse
from topological_nav.__main__ import COMMANDS
from topological_nav.config import (
    TASKS,
    DataConfig,
    DriveConfig,
    EvaluationConfig,
    ExportConfig,
    MapConfig,
    PolicyConfig,
)
from topological_nav.data.domains import AdaptConfig
from topological_nav.drives.imitation import GRIDS
from topological_nav.presets import configured
from train.config_io import load_config

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def listed(*words: str) -> str:
    command = (
        "make",
        "--no-print-directory",
        "-n",
        "-f",
        "benchmarks/topological.mk",
        "RUNS=/nowhere",
        "PPO=runs/x",
        *words,
    )
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def settings_of(arguments):
    command = type(arguments).__name__.lower()
    if command == "data":
        return DriveConfig() if arguments.drives else DataConfig()
    if command == "train":
        return {**TASKS, "policy": PolicyConfig()}[arguments.task]
    return {"map": MapConfig, "evaluate": EvaluationConfig, "adapt": AdaptConfig, "export": ExportConfig}[command]()


def part_of(arguments) -> str:
    """The part of a preset that a command reads."""
    command = type(arguments).__name__.lower()
    return "drives" if getattr(arguments, "drives", False) else getattr(arguments, "task", command)


def commands_of(shown: str) -> list[list[str]]:
    """Words of each command of `topological_nav`; those over two lines as one."""
    joined = shown.replace("\\\n", " ")
    return [shlex.split(line) for line in re.findall(r"if python -m topological_nav (.*?) >>/nowhere", joined)]


def understood(words: list[str], made: Collection[str]):
    """Arguments and settings of a command; what it reads in RUNS is made before."""
    arguments = parse(COMMANDS, "tool", words)
    for name in ("localiser", "detector", "data", "target", "maps"):
        value = getattr(arguments, name, None)
        for needed in map(str, value if isinstance(value, tuple) else (value,)):
            if needed.startswith("/nowhere"):
                assert any(done == needed or done.startswith(f"{needed}/") for done in made), (words, name)
    return arguments, configured(settings_of(arguments), arguments.settings, part_of(arguments))


@pytest.mark.parametrize("size", ["full", "cpu"])
def test_all_commands_are_understood_and_made_in_order(size):
    commands = commands_of(listed(f"SIZE={size}"))
    # Four datasets, four networks, ten maps, policy, three evaluations of ten scenes each on its own and then summed
    # up, two of another domain, two adaptations, four maps of them, export.
    assert len(commands) == len({tuple(words) for words in commands}) == 4 + 4 + 10 + 1 + 3 * 11 + 2 + 2 + 4 + 1
    made: set[str] = set()
    for words in commands:
        made.add(str(understood(words, made)[0].out))


def test_furnished_homes_climb_from_the_reports_navigator_to_ours():
    commands = commands_of(listed("SIZE=homes", "PPO="))
    # 48 homes of images and of drives, their joint dataset, two networks, a policy, ten maps of either kind, eight
    # rungs, ours, six variants and an expert in ten homes each, export.
    count = 48 + 48 + 1 + 2 + 1 + 20 + 10 * (8 + 1 + 6 + 1) + 1
    assert len(commands) == len({tuple(words) for words in commands}) == count
    made: set[str] = set()
    rungs = {}
    for words in commands:
        arguments, settings = understood(words, made)
        made.add(str(arguments.out))
        if "ladder" in str(arguments.out) and "furnished_020" in arguments.scenes[0]:
            rungs[int(str(arguments.out)[-1])] = settings
    names = ("images", "match", "glance", "watch_s", "metre_cost", "retry_cost", "asked_m", "slack_m")
    ours = EvaluationConfig(limit_s=600.0, backend="native")
    changed = [[n for n in names if getattr(rungs[k], n) != getattr(rungs.get(k + 1, ours), n)] for k in range(8)]
    # watch_s says nothing without glances, and slack_m nothing where one length is asked for.
    rises = ["images", "match", "glance watch_s", "watch_s", "metre_cost", "retry_cost", "asked_m slack_m", "slack_m"]
    assert [" ".join(names) for names in changed] == rises and rungs[0].goal_images == 1


def test_the_report_is_one_graph_that_ends_in_its_tables():
    shown = listed("SIZE=report", "PPO=")
    assert shown.rstrip().endswith("python -m topological_nav tables /nowhere")
    made, done = set(), {}
    for words in commands_of(shown):
        arguments, settings = understood(words, made)
        assert "preset=report" in words
        made.add(str(arguments.out))
        done[str(arguments.out).removeprefix("/nowhere/")] = arguments, settings
        if type(arguments).__name__ == "Evaluate":
            assert settings.limit_s == 175.0 and settings.images == settings.goal_images == 1
    networks = {"rooms", "rooms-up", "rooms-down", "passages", "alexnet", "policy-grid", "adapted-passages"}
    scenes = {f"maps/{Path(one).name}.npz" for one in done["data-passages"][0].scenes}
    homes = [Path(one).name for one in done["data"][0].scenes]
    data = {"data", "data-passages", "data-unseen"}
    data |= {f"{folder}/{home}" for folder in ("parts", "drives", "embedded") for home in homes}
    data |= {f"passage-parts/{Path(one).name}" for one in done["data-passages"][0].scenes}
    pairs = {f"policy-grid/alpha-{alpha:g}-lambda-{lam:g}": (alpha, lam) for alpha, lam in GRIDS["report"]}
    assert set(done) == networks | scenes | data | {*pairs, "evaluation", "evaluation-policy"} and len(scenes) == 10
    # A pair by itself is what the grid looks for.
    assert {name: (done[name][1].alpha, done[name][1].lam) for name in pairs} == pairs
    assert {dataclasses.replace(done[name][1], alpha=10.0, lam=0.1) for name in pairs} == {done["policy-grid"][1]}
    assert [done[name][1].pitch for name in ("rooms-up", "rooms", "rooms-down")] == ["up", "level", "down"]
    passages, policy = done["passages"][1], done["evaluation-policy"][0].policy
    seven = {Path(one).name for one in done["data-passages"][0].scenes} - set(passages.test_scenes)
    assert (len(seven), passages.test_scenes) == (7, ("maple", "rowan", "willow"))
    alpha, lam = policy.removeprefix("/nowhere/policy-grid/alpha-").split("-lambda-")
    assert done["policy-grid"][0].grid and (float(alpha), float(lam)) in GRIDS[done["policy-grid"][1].pairs]
    assert done["evaluation-policy"][0].contenders == "dense,sparse"
    # As many drives as the report has, but for a few.
    assert sum(done[f"drives/{home}"][1].drives for home in homes) == 2488


def with_given_networks(*words: str):
    """Output in RUNS -> arguments and settings of its command, where the source's networks lie in RUNS already."""
    made, done = {"/nowhere/rooms", "/nowhere/passages"}, {}
    for command in commands_of(listed(*words, "-o", "/nowhere/done/rooms", "-o", "/nowhere/done/passages")):
        arguments, settings = understood(command, made)
        made.add(str(arguments.out))
        done[str(arguments.out).removeprefix("/nowhere/")] = arguments, settings
    return done


@pytest.mark.parametrize("size", ["full", "cpu"])
def test_another_renderer_is_a_target_without_training_again(size):
    done = with_given_networks(f"SIZE={size}", "renderer")
    maps = [f"maps-{which}-gl/{scene}.npz" for which in ("unadapted", "adapted") for scene in ("rowan", "willow")]
    adapted = ["features-gl", "adapted-passages-gl", *maps]
    driven = ["evaluation-unadapted-gl", "evaluation-adapted-gl"]
    assert sorted(done) == sorted(["data", "data-gl", "data-gl-unseen", *adapted, *driven])
    assert [done[name][1].engine for name in ("data", "data-gl", "data-gl-unseen")] == ["warp", "gl", "gl"]
    # The same positions and passages, drawn by another engine.
    assert dataclasses.replace(done["data-gl"][1], engine="warp") == done["data"][1]
    assert done["data-gl"][0].scenes == done["data"][0].scenes
    assert {done[name][1].domain for name in adapted} == {"clean"}
    targets = {name: str(done[name][0].target).removeprefix("/nowhere/") for name in adapted}
    assert targets == dict.fromkeys(adapted, "data-gl-unseen") | {"features-gl": "data-gl"}
    for name, (localiser, detector) in {
        "unadapted": ("rooms", "passages"),
        "adapted": ("features-gl", "adapted-passages-gl"),
    }.items():
        arguments, _ = done[f"evaluation-{name}-gl"]
        assert (arguments.contenders, arguments.domain) == ("dense", "clean")
        assert str(arguments.maps) == f"/nowhere/maps-{name}-gl"
        of_map, _ = done[f"maps-{name}-gl/willow.npz"]
        for used in (arguments, of_map):
            assert (str(used.localiser), str(used.detector)) == (f"/nowhere/{localiser}", f"/nowhere/{detector}")


@pytest.mark.parametrize(
    ("target", "suffix", "domain", "adapted"),
    [
        ("transfer-policy", "", "camera", ("features", "adapted-passages")),
        ("renderer-policy", "-gl", "clean", ("features-gl", "adapted-passages-gl")),
    ],
)
def test_the_learned_policy_drives_where_the_baseline_did(target, suffix, domain, adapted):
    networks = ("-o", "/nowhere/done/policy")
    done = with_given_networks("SIZE=full", target, *networks)
    before = with_given_networks("SIZE=full", "transfer" if not suffix else "renderer", *networks)
    assert done.keys() - before.keys() == {f"evaluation-{w}{suffix}-policy" for w in ("unadapted", "adapted")}
    for which, seeing in (("unadapted", ("rooms", "passages")), ("adapted", adapted)):
        arguments, settings = done[f"evaluation-{which}{suffix}-policy"]
        baseline, same = before[f"evaluation-{which}{suffix}"]
        assert settings == same and arguments.scenes == baseline.scenes and arguments.contenders == "dense"
        assert (arguments.domain, arguments.maps) == (domain, baseline.maps) == (baseline.domain, arguments.maps)
        for used in (arguments, baseline):
            assert (str(used.localiser), str(used.detector)) == tuple(f"/nowhere/{name}" for name in seeing)
        assert (arguments.policy, baseline.policy) == ("/nowhere/policy", None)


def test_thousands_of_episodes_are_one_batch():
    maps = [word for scene in ("cedar", "rowan") for word in ("-o", f"/nowhere/done/map-{scene}")]
    commands = commands_of(listed("SIZE=full", "batch", *maps, "-o", "/nowhere/done/policy"))
    for words, scene in zip(commands, ("cedar", "rowan"), strict=True):
        arguments, settings = understood(words, {"/nowhere/rooms", "/nowhere/passages", "/nowhere/maps"})
        assert [Path(one).name for one in arguments.scenes] == [scene]
        assert (settings.backend, settings.episodes, settings.batch) == ("warp", 4000, 4000)


@pytest.mark.parametrize("size", ["full", "cpu"])
def test_a_scanned_room_is_a_target_where_it_is_given(size):
    done = with_given_networks(f"SIZE={size}", "scan", "SCAN=/elsewhere/room")
    maps = ["maps-unadapted-scan/scan.npz", "maps-adapted-scan/scan.npz"]
    adapted = ["features-scan", "adapted-passages-scan", *maps]
    assert sorted(done) == sorted(["data", "data-scan", "data-scan-passages", *adapted])
    kept = ("num_rooms", "max_per_room", "passage_sources", "passage_length_m", "test_share")
    assert [tuple(getattr(done[name][1], k) for k in kept) for name in ("data-scan", "data-scan-passages")] == [
        (1, 40, 60, 2.0, 0.2),
        (1, 2, 80, 1.0, 0.3),
    ]
    assert {done[name][1].domain for name in adapted} == {"clean"}
    targets = {name: str(done[name][0].target).removeprefix("/nowhere/") for name in adapted}
    assert targets == dict.fromkeys(adapted, "data-scan") | {"adapted-passages-scan": "data-scan-passages"}
    folders = [done[name][0].scenes for name in ("data-scan", "data-scan-passages")]
    assert folders == [("/elsewhere/room",)] * 2 and {str(done[name][0].scene) for name in maps} == {"/elsewhere/room"}
    assert str(done[maps[1]][0].localiser) == "/nowhere/features-scan"


def test_without_a_scan_it_says_how_to_name_one():
    with pytest.raises(subprocess.CalledProcessError) as refused:
        listed("scan")
    assert "SCAN is not given, expected the folder of a converted scene: SCAN=FOLDER" in refused.value.stderr
    assert "scan" not in listed()


def test_a_policy_told_the_goal_is_trained_where_none_is_given():
    shown = listed("SIZE=full", "PPO=/nowhere/ppo")
    (words,) = [shlex.split(line) for line in re.findall(r"if python -m train (.*?) >>/nowhere", shown)]
    name, settings = words[words.index("--config") + 1], [w for w in words if re.match(r"[\w.]+=", w)]
    config = load_config(name, settings)
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
    assert "SIZE is 'tiny', expected full, cpu, report or homes" in refused.value.stderr
