"""Recipes: parsed, refused by name; one tiny scene made, kept, made again with the same bytes."""

from __future__ import annotations

import errno
import hashlib
import os
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from converters import recipes
from converters.__main__ import main
from converters.generate import GenerationError
from converters.generate.models.cad import HOME_TEST_MODELS, HOME_TRAIN_MODELS
from converters.pipeline import ConvertConfig
from converters.recipes import chosen, load_recipes, make_scenes, parse_recipes
from interactive_nav_common.errors import FileError
from scenes_mjcf.schema import SceneError

SCENES = Path(__file__).parents[2] / "scenes_mjcf"
TINY = """
conversion: {structure_faces: 2500, object_faces: 200, structure_texture: 64, object_texture: 32}
shared:
  one: &one {floor_area_m2: 12, n_rooms: 1, n_doors: 0, n_windows: 0, furniture_share: 0.08, voxel_m: 0.05}
scenes:
  hut: {split: train, seed: 1, building: {<<: *one}}
  shed: {split: test, seed: 2, building: {<<: *one}}
"""


def good() -> dict:
    return {"scenes": {"a": {"split": "train", "seed": 1, "building": {"n_rooms": 4, "n_windows": [3, 5]}}}}


def test_a_number_stands_for_a_range_and_the_split_chooses_the_models():
    data = good()
    data["scenes"]["b"] = {"split": "test", "seed": 2}
    a, b = parse_recipes(data, "x").scenes
    assert (a.building.n_rooms, a.building.n_windows) == ((4, 4), (3, 5))
    assert a.building.models == HOME_TRAIN_MODELS and b.building.models == HOME_TEST_MODELS
    assert b.building.tier == "sparse" and b.building.artefacts == "phone" and b.building.must_push == {}


def test_a_tier_makes_a_home_with_the_split_s_models():
    data = good()
    settings = {"n_rooms": 5, "must_push_fetch": None}
    data["scenes"]["a"] = {"split": "test", "seed": 1, "tier": "cluttered", "building": settings}
    home = parse_recipes(data, "x").scenes[0].building
    assert home.tier == "cluttered" and home.furniture_share == 0.33
    assert home.n_rooms == (5, 5) and home.models == HOME_TEST_MODELS
    assert home.must_push == {"turtlebot": (0.08, 0.3)}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tier", "furnisht"], "error: settings: tier is 'furnisht', expected one of sparse, furnished, cluttered"),
        (
            ["--tier", "furnished", "furniture_shar=0.2"],
            "unknown key 'furniture_shar', did you mean 'furniture_share'?",
        ),
        (["--tier", "furnished", "furniture_share=0.9"], "furniture_share is 0.9, expected between 0 and 0.38"),
        (["--tier", "furnished", "furniture_share=x"], 'furniture_share is "x", expected a number'),
        (["--tier", "furnished", "n_chairs=3"], "unknown key 'n_chairs'"),
        (["n_rooms=[3"], 'settings: n_rooms is "[3", expected a list'),
        (["n_rooms"], "unrecognized n_rooms (--help lists all)"),
    ],
)
def test_wrong_tiers_and_settings_of_one_building_are_told_in_a_line(tmp_path, capsys, words, message):
    assert main(["generate", str(tmp_path / "home"), "--seed", "1", *words]) == 2
    told = capsys.readouterr().err.strip()
    assert message in told and "\n" not in told and not (tmp_path / "home").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(scene={}), "unknown key 'scene', did you mean 'scenes'"),
        (lambda d: d["scenes"].update(a=3), "scenes: a: got 3, expected a mapping"),
        (lambda d: d["scenes"]["a"].update(split=["train"]), r'split is \["train"\], expected one of train, test'),
        (lambda d: d["scenes"]["a"].update(split="val"), "split is 'val', expected one of train, test"),
        (lambda d: d["scenes"]["a"].update(tier="full"), "building: tier is 'full', expected one of sparse, furnished"),
        (lambda d: d["scenes"]["a"]["building"].update(n_chairs=3), "building: unknown key 'n_chairs'"),
        (lambda d: d["scenes"]["a"].update(seed=-1), "seed is -1, expected a whole number"),
        (lambda d: d["scenes"]["a"]["building"].update(n_room=4), "unknown key 'n_room', did you mean 'n_rooms'"),
        (lambda d: d["scenes"]["a"]["building"].update(n_rooms="4"), 'n_rooms is "4", expected a list'),
        (
            lambda d: d["scenes"]["a"]["building"].update(n_rooms=[5, 4]),
            "n_rooms is .5, 4., expected at least 1, ascending",
        ),
        (lambda d: d["scenes"]["a"]["building"].update(models=["x"]), "unknown key 'models'"),
        (
            lambda d: d["scenes"]["a"]["building"].update(leaves_at_walls=1),
            "leaves_at_walls is 1, expected true",
        ),
        (lambda d: d.update(conversion={"object_face": 3}), "unknown key 'object_face', did you mean 'object_faces'"),
        (lambda d: d.update(conversion={"object_faces": 0.5}), "object_faces is 0.5, expected a whole number"),
    ],
)
def test_bad_recipes_are_named(change, message):
    data = good()
    change(data)
    with pytest.raises(GenerationError, match=message):
        parse_recipes(data, "x")


@pytest.mark.parametrize("name", ["../victim", ".", "..", "/{0}/victim", "", ".recipes", "a\\\\\\\\b", "n" * 101])
def test_a_name_that_leads_elsewhere_removes_nothing(tmp_path, capsys, name):
    out, name = tmp_path / "out", name.replace("/{0}", str(tmp_path))
    for kept in (out / "other" / "scene.json", tmp_path / "victim" / "scene.json"):
        kept.parent.mkdir(parents=True)
        kept.write_text("mine")
    (out / "recipes.yaml").write_text(f'scenes: {{"{name}": {{split: train, seed: 1}}}}')
    before = digest(tmp_path)
    assert main(["generate-scenes", str(out), "--overwrite", "--recipes", str(out / "recipes.yaml")]) == 2
    assert "scenes: a name is '" in (told := capsys.readouterr().err) and "expected one folder name" in told
    assert digest(tmp_path) == before


def test_a_home_without_a_plan_or_with_other_shares_takes_the_next_of_its_seeds(tmp_path, monkeypatch):
    tried: list[int] = []
    shares: dict[int, float] = {}  # of the pairs for Fetch, by try
    broken: set[int] = set()  # tries whose scene fails a gate

    def generate(raw, seed, report, building):
        tried.append(seed)
        if len(tried) < given:
            raise GenerationError(f"seed {seed}: no")

    def convert(raw, made, config, report):
        measures = {"must_push_share": {"turtlebot": 0.05, "fetch": shares.get(len(tried), 0.3)}}
        gates = (SimpleNamespace(name="drift_hulls", passed=len(tried) not in broken),)
        return SimpleNamespace(manifest=SimpleNamespace(measures=measures), gates=gates)

    def made(recipe):
        tried.clear()
        return recipes._generated(recipe, ConvertConfig(), tmp_path, lambda stage, share: None)

    monkeypatch.setattr(recipes, "generate_building", generate)
    monkeypatch.setattr(recipes, "convert", convert)
    (home,) = parse_recipes({"scenes": {"a": {"split": "train", "seed": 3, "tier": "furnished"}}}, "r").scenes
    (sparse,) = parse_recipes({"scenes": {"a": {"split": "train", "seed": 3}}}, "r").scenes
    given = 3
    assert made(home)[1] == "seed 2000003 in place of 3 (no)"
    assert tried == [3, 1_000_003, 2_000_003]
    given, shares = 0, {1: 0.7233, 2: 0.421, 3: 0.42}  # asked: at most 0.40, met to within 0.02
    made(home)
    assert tried == [3, 1_000_003, 2_000_003]
    shares, broken = {}, {1}
    made(home)
    assert tried == [3, 1_000_003]
    shares, broken = dict.fromkeys(range(9), 0.9), set()
    assert made(sparse)[1] == "seed 3"  # any share will do
    with pytest.raises(
        GenerationError, match="a: none of 5 seeds: seed 4000003: must_push_fetch is 0.9 once converted: expected 0.0"
    ):
        made(home)
    given = 99
    with pytest.raises(GenerationError, match="seed 4000003: no"):
        made(sparse)
    assert len(tried) == 5


def test_missing_and_unreadable_files_and_unknown_names(tmp_path, capsys):
    with pytest.raises(GenerationError, match="no such file"):
        load_recipes(tmp_path / "recipes.yaml")
    (tmp_path / "recipes.yaml").write_text("scenes: [")
    assert main(["generate-scenes", str(tmp_path)]) == 2
    assert "not readable as YAML" in capsys.readouterr().err
    (tmp_path / "recipes.yaml").write_text(TINY)
    assert main(["generate-scenes", str(tmp_path), "--only", "hat"]) == 2
    assert capsys.readouterr().err.strip() == "error: no recipe named 'hat', did you mean 'hut'?; known: hut, shed"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recipes.yaml"]


def digest(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.mark.heavy
def test_scenes_are_made_kept_and_made_again_with_the_same_bytes(tmp_path, hull_cache, monkeypatch):
    monkeypatch.setattr("converters.pipeline.cache_folder", lambda: hull_cache)
    (tmp_path / "recipes.yaml").write_text(TINY)
    tiny, lines, shares = load_recipes(tmp_path / "recipes.yaml"), [], []
    hut = chosen(tiny, tmp_path, ("hut",))
    failed = make_scenes(hut, tiny.conversion, tmp_path, report=lambda _, s: shares.append(s), log=lines.append)
    assert set(failed) == {"hut"} and shares[-1] == pytest.approx(1.0) and shares == sorted(shares)
    assert (tmp_path / "hut" / "preview.png").is_file() and not (tmp_path / "shed").exists()
    first = digest(tmp_path / "hut")
    assert chosen(tiny, tmp_path, ("hut",), log=lines.append) == ()
    assert lines[-1] == "hut: is there, kept"
    make_scenes(chosen(tiny, tmp_path, ("hut",), overwrite=True), tiny.conversion, tmp_path, overwrite=True)
    assert digest(tmp_path / "hut") == first
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hut", "recipes.yaml"]


def test_an_interruption_leaves_the_old_scene_and_no_litter(tmp_path, monkeypatch):
    (tmp_path / "hut").mkdir()
    (tmp_path / "hut" / "scene.json").write_text("old")
    (tmp_path / "recipes.yaml").write_text(TINY)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recipes, "convert", stop)
    with pytest.raises(KeyboardInterrupt):
        tiny = load_recipes(tmp_path / "recipes.yaml")
        make_scenes(chosen(tiny, tmp_path, ("hut",), overwrite=True), tiny.conversion, tmp_path, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hut", "recipes.yaml"]
    assert (tmp_path / "hut" / "scene.json").read_text() == "old"


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """A recipe folder in which generating, converting and drawing write one file each."""
    (tmp_path / "recipes.yaml").write_text(TINY)

    def generate(folder: Path, *_: object) -> None:
        folder.mkdir()

    def convert(_: Path, folder: Path, *__: object) -> SimpleNamespace:
        folder.mkdir()
        (folder / "scene.json").write_text("new")
        return SimpleNamespace(gates=())

    monkeypatch.setattr(recipes, "generate_building", generate)
    monkeypatch.setattr(recipes, "convert", convert)
    monkeypatch.setattr(recipes, "preview", lambda folder, target: target.write_text("drawn"))
    return load_recipes(tmp_path / "recipes.yaml")


def test_a_scene_that_cannot_be_put_in_place_leaves_the_old_one(tmp_path, quick, monkeypatch):
    (tmp_path / "hut").mkdir()
    (tmp_path / "hut" / "scene.json").write_text("old")
    rename = Path.rename

    def full(self: Path, target: Path) -> Path:
        if self.name == "hut" and self.parent != tmp_path:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(FileError, match="hut: cannot be written .No space left"):
        make_scenes(chosen(quick, tmp_path, ("hut",), overwrite=True), {}, tmp_path, overwrite=True)
    assert (tmp_path / "hut" / "scene.json").read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hut", "recipes.yaml"]


@pytest.mark.parametrize(
    "error", [ValueError("a cannot\n be b"), IndexError("a cannot be b"), SceneError("a cannot be b")]
)
def test_a_scene_whose_preview_fails_is_kept_and_its_line_names_the_error(tmp_path, quick, monkeypatch, error):
    draw, lines = recipes.preview, []

    def fail(folder: Path, target: Path) -> None:
        if folder.name == "hut":
            raise error
        draw(folder, target)

    monkeypatch.setattr(recipes, "preview", fail)
    out = tmp_path / "my homes"
    assert make_scenes(chosen(quick, out), {}, out, log=lines.append) == {"hut": [], "shed": []}
    assert [p.name for p in sorted((out / "hut").iterdir())] == ["scene.json"]
    assert (out / "shed" / "preview.png").read_text() == "drawn"
    again = f"try again with: python -m converters preview '{out}/hut' -o '{out}/hut/preview.png'"
    assert lines == [
        f"hut: train, seed 1, every gate passes; no preview: {type(error).__name__}: a cannot be b; {again}",
        "shed: test, seed 2, every gate passes",
    ]


def test_a_full_disk_while_drawing_is_no_missing_preview(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(recipes, "preview", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
    with pytest.raises(OSError, match="full"):
        make_scenes(chosen(quick, tmp_path), {}, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recipes.yaml"]


def test_what_a_killed_generator_left_goes_with_the_next(tmp_path, quick):
    left = tmp_path / ".hut.part-7-01234567"
    left.mkdir()
    os.utime(left, (0, 0))
    make_scenes(chosen(quick, tmp_path, ("hut",)), {}, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hut", "recipes.yaml"]


@pytest.mark.parametrize(
    ("failure", "code", "words"),
    [
        (KeyboardInterrupt(), 130, "interrupted; "),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), 2, "No space left on device; "),
    ],
)
@pytest.mark.parametrize(
    ("fails_at", "old", "written"),
    [("hut", (), ""), ("shed", (), "hut"), ("shed", ("hut",), ""), ("shed", ("--overwrite", "hut"), "hut")],
)
def test_the_last_word_names_what_was_written(
    tmp_path, quick, monkeypatch, capsys, failure, code, words, fails_at, old, written
):
    convert = recipes.convert

    def fail(source: Path, folder: Path, *rest: object) -> object:
        if folder.name == fails_at:
            raise failure
        return convert(source, folder, *rest)  # pyright: ignore

    monkeypatch.setattr(recipes, "convert", fail)
    for name in old[-1:]:
        (tmp_path / name).mkdir()
    assert main(["generate-scenes", str(tmp_path), "--jobs", "1", *old[:-1]]) == code
    told = f"written before: {tmp_path / written}" if written else "nothing was written"
    assert capsys.readouterr().err.endswith(f"{words}{told}\n")


def test_a_scene_that_another_generator_made_meanwhile_is_kept(tmp_path, quick):
    lines: list[str] = []

    def log(line: str) -> None:
        lines.append(line)
        (tmp_path / "shed").mkdir(exist_ok=True)  # while the first is made

    assert set(make_scenes(chosen(quick, tmp_path), {}, tmp_path, log=log)) == {"hut"}
    assert lines[-1] == "shed: is there, kept" and list((tmp_path / "shed").iterdir()) == []


def test_a_home_of_a_seed_that_gives_none_is_another_seeds_and_says_so(tmp_path, monkeypatch, capsys):
    from converters import generate

    tried: list[int] = []

    def refuse(folder, seed, report, config):
        tried.append(seed)
        if len(tried) < 3:
            raise GenerationError(f"seed {seed}: no room" if tried[0] < 9 else "OUT is there")

    monkeypatch.setattr(generate, "generate_building", refuse)
    assert main(["generate", str(tmp_path / "a b"), "--seed", "5", "--tier", "furnished"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert shlex.split(printed.partition("with: ")[2])[2:] == ["converters", "convert", f"{tmp_path}/a b", "SCENE_DIR"]
    assert tried == [5, 1_000_005, 2_000_005] and "building of seed 2000005 in place of 5 (no room); convert" in printed
    tried.clear()
    assert main(["generate", str(tmp_path / "a"), "--seed", "9", "--tier", "furnished"]) == 2 and tried == [9]
    assert "OUT is there" in capsys.readouterr().err
