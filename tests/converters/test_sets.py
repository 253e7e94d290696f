"""Sets of homes: a tier and a number in, recipes, scene folders and a list of them out."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import sys
import time
from pathlib import Path

import pytest
import yaml

from converters import many
from converters.__main__ import main
from converters.generate.homes.config import GenerationError
from converters.generating import GenerateScenes
from converters.recipes import load_recipes
from interactive_nav_common.jobs.processes import Job, Launcher
from scenes_mjcf.schema import load_manifest, save_manifest
from scenes_mjcf.sets import read_set, scene_digest, scene_folders

SCENES = Path(__file__).parents[2] / "scenes_mjcf"


class Copier(Launcher):
    """Whose command copies its scene; 002 gives none, and whoever works on 003 is killed."""

    def __init__(self, out: Path):
        super().__init__(2)
        self.out, self.commands, self.closed = out, [], 0

    def start(self, job: Job) -> str | None:
        said, code = {
            "furnished_002": (f"error: {job.name}: no room", 2),
            "furnished_003": (f"1/1 {job.name}: drawing", 3),
        }.get(job.name, (f"{job.name}: train, seed 1, every gate passes", 0))
        act = f"import os; print({said!r}, flush=True); os._exit({code})"
        begun = super().start(dataclasses.replace(job, command=(sys.executable, "-c", act)))
        if begun is not None:
            self.commands.append(list(job.command))
            if not code:
                shutil.copytree(SCENES / "apartment_0", self.out / job.name)
        return begun

    def close(self) -> None:
        self.closed += 1


def test_a_tiers_recipes_name_seeds_and_splits(tmp_path: Path) -> None:
    many.begin_set(tmp_path / "homes", "furnished", 10, 500)
    recipes = load_recipes(tmp_path / "homes" / "recipes.yaml")
    assert [(r.name, r.seed, r.split, r.building.tier) for r in recipes.scenes][7:9] == [
        ("furnished_007", 507, "train", "furnished"),
        ("furnished_008", 508, "test", "furnished"),
    ]
    assert [r.split for r in recipes.scenes].count("test") == 2
    many.begin_set(tmp_path / "homes", "furnished", 10, 500)  # the same again is no error
    with pytest.raises(GenerationError, match="holds other recipes than 11 of tier furnished from seed 500"):
        many.begin_set(tmp_path / "homes", "furnished", 11, 500)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tier", "messy"], "tier is 'messy', expected one of sparse, furnished, cluttered"),
        (["--tier", "furnished", "--seed", "-1"], "seed is -1, expected a whole number"),
        ([], "recipes.yaml: no such file"),
        (["--seed", "0"], "--seed has no effect without --tier; leave it out"),
        (["--count", "3"], "--count has no effect without --tier; leave it out"),
        (["--tier", "furnished", "--recipes", "r.yaml"], "--recipes has no effect with --tier, which writes them"),
        (["--ray-address", "here:1"], "--ray-address has no effect without --launcher ray; leave it out"),
    ],
)
def test_wrong_words_are_one_line_and_leave_nothing(tmp_path: Path, capsys, words: list[str], message: str) -> None:
    assert main(["generate-scenes", str(tmp_path / "homes"), *words]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not (tmp_path / "homes").exists()


def test_scenes_are_made_side_by_side_listed_and_found_by_name(tmp_path: Path, monkeypatch) -> None:
    out, lines, shares = tmp_path / "homes", [], []
    many.begin_set(out, "furnished", 10)
    runner = Copier(out)
    monkeypatch.setattr(many, "Launcher", lambda jobs: runner)
    wanted = GenerateScenes(out=out, jobs=2)
    failed = many.generate_scenes(wanted, lambda _, share: shares.append(share), lines.append)
    assert sorted(failed) == ["furnished_002", "furnished_003"]
    made = [command[command.index("--only") + 1 :] for command in runner.commands]
    names = [f"furnished_{k:03d}" for k in range(10)]
    assert made == [[name] for name in names]
    assert runner.closed == 1 and shares[-1] == 1.0
    assert runner.commands[0][:4] == [sys.executable, "-m", "converters", "generate-scenes"]
    assert "furnished_002: no room" in lines and "furnished_003: exit code 3, " in "\n".join(lines)
    assert not (out / "set.json").exists()

    wanted = GenerateScenes(out=out, tier="furnished", count=10, seed=many.SEEDS, jobs=1)
    monkeypatch.setattr(many, "make_scenes", lambda todo, *_: {recipe.name: ["drift_boxes"] for recipe in todo})
    assert many.generate_scenes(wanted, lambda _, share: None, lines.append) == ["furnished_002", "furnished_003"]
    assert lines[-8:] == [f"{name}: is there, kept" for name in names if name[-3:] not in ("002", "003")]
    members = read_set(out / "set.json").scenes
    assert members["furnished_000"].digest == scene_digest(SCENES / "apartment_0")
    assert members["furnished_002"].digest == ""
    monkeypatch.chdir(tmp_path)
    assert scene_folders(["homes/test"]) == ("homes/furnished_008", "homes/furnished_009")


def test_a_scene_that_differs_from_the_list_is_told(tmp_path: Path) -> None:
    (tmp_path / "recipes.yaml").write_text(
        yaml.safe_dump({"scenes": {name: {"split": "train", "seed": 4} for name in ("one", "two")}})
    )
    for name, source in (("one", "apartment_0"), ("two", "alder")):
        shutil.copytree(SCENES / source, tmp_path / name)
    recipes, lines = load_recipes(tmp_path / "recipes.yaml"), []
    first = many.list_set(recipes, tmp_path, lines.append)
    assert first.tier == "sparse" and lines == []
    shutil.rmtree(tmp_path / "two")
    shutil.copytree(SCENES / "birch", tmp_path / "two")
    assert many.list_set(recipes, tmp_path, lines.append) == first
    manifest = load_manifest(tmp_path / "one")  # converted anew: the same scene, seen in more detail
    measures = manifest.measures | {"specific_surface_1_m": 9.0}
    save_manifest(dataclasses.replace(manifest, measures=measures), tmp_path / "one")
    assert many.list_set(recipes, tmp_path).scenes["one"].measures["specific_surface_1_m"] == 9.0
    assert lines == [f"two: not the scene that {tmp_path / 'set.json'} lists"]


def test_processes_that_still_run_are_ended(tmp_path: Path) -> None:
    act = "import os, sys, time; print(os.getpid(), flush=True); time.sleep(60 * (sys.argv[1] == 'slow')); sys.exit(3)"
    commands = {name: [sys.executable, "-c", act, name] for name in ("slow", "quick", "late")}
    launcher = Launcher(2)
    began = time.monotonic()
    with contextlib.closing(many.run_commands(commands, launcher, tmp_path, lambda *_: None, "scenes")) as results:
        name, code, printed = next(results)
    assert (name, code) == ("quick", 3) and printed.strip().isdecimal()
    assert launcher.ended() == [] and time.monotonic() - began < 30 and list(tmp_path.iterdir()) == []
