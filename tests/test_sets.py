"""Sets of scenes: names in, folders out."""

import json
import re
import shutil
from pathlib import Path

import pytest

from converters.__main__ import main
from converters.generate.homes.config import TIERS
from converters.recipes import load_recipes
from interactive_nav.episodes import load_episode_file
from interactive_nav.scenes.scene import load_scene
from scenes_mjcf.schema import SceneError, load_manifest
from scenes_mjcf.sets import (
    COMMITTED,
    Member,
    SceneSet,
    existing,
    installed,
    read_set,
    scene_digest,
    scene_folders,
    write_set,
)

ROOT = Path(__file__).parents[1]
TRAIN = ["alder", "birch", "cedar", "elm", "hazel", "juniper", "linden", "maple"]


@pytest.fixture
def own(tmp_path: Path) -> Path:
    for name in ("one", "two", "three"):
        (tmp_path / "homes" / name).mkdir(parents=True)
        (tmp_path / "homes" / name / "scene.json").write_text("{}")
    members = {"one": Member("train", 1), "two": Member("test", 2), "three": Member("train", 3)}
    write_set(SceneSet("furnished", members), tmp_path / "homes" / "set.json")
    return tmp_path


def test_the_sparse_set_is_the_ten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert scene_folders(["sparse/train"]) == tuple(f"scenes_mjcf/{name}" for name in TRAIN)
    assert scene_folders(["sparse/test"]) == ("scenes_mjcf/rowan", "scenes_mjcf/willow")
    assert len(scene_folders(["sparse"])) == 10


@pytest.mark.parametrize(("tier", "seed"), [("furnished", 520_000), ("cluttered", 510_000)])
def test_a_committed_tier_lists_what_its_recipes_make(tier: str, seed: int) -> None:
    folder = ROOT / "scenes_mjcf" / tier
    listed, recipes = read_set(folder / "set.json"), load_recipes(folder / "recipes.yaml").scenes
    assert listed.tier == tier and {r.building.tier for r in recipes} == {tier}
    assert {r.name: (r.split, r.seed) for r in recipes} == {n: (m.split, m.seed) for n, m in listed.scenes.items()}
    assert sorted(m.split for m in listed.scenes.values()) == ["test"] * 3 + ["train"] * 8
    assert min(m.seed for m in listed.scenes.values()) == seed
    assert sum(r.building.artefacts == "phone" for r in recipes) == 2
    digests = [m.digest for m in listed.scenes.values()]
    assert len(set(digests)) == 11 and all(re.fullmatch("[0-9a-f]{64}", digest) for digest in digests)
    wanted = TIERS[tier]
    for name, member in listed.scenes.items():
        assert set(member.measures["must_push_share"]) == {"turtlebot", "fetch"}
        assert wanted.furniture_share - 0.12 < member.measures["movable_share"] < 0.4, name


ARRIVES = {
    ("cluttered", "turtlebot"): (0.50, 0.70),
    ("cluttered", "fetch"): (0.20, 0.45),
    ("furnished", "turtlebot"): (0.65, 1.0),
    ("furnished", "fetch"): (0.40, 0.95),
}
"""Share of a tier's episodes in which a planner that touches nothing finds a way."""


@pytest.mark.parametrize("robot", ["turtlebot", "fetch"])
@pytest.mark.parametrize("tier", ["furnished", "cluttered"])
def test_fixed_episodes_are_in_the_scenes_of_their_split(tier: str, robot: str) -> None:
    listed = read_set(ROOT / "scenes_mjcf" / tier / "set.json").scenes
    arrives = 0.0
    for split in ("train", "test"):
        file = load_episode_file(ROOT / "scenes_mjcf" / "episodes" / f"{tier}-{robot}-{split}.json.gz")
        of_split = [name for name, member in listed.items() if member.split == split]
        assert [name for name, _ in file.scenes] == of_split
        assert len(file.episodes) == 1000 and file.robot == robot and len(file.objects) == 4
        assert {row["scene"] for row in file.episodes} == set(range(len(of_split)))
        open_ = [not row["push_needed"] for row in file.episodes]
        arrives += sum(open_) / len(open_) * len(of_split) / len(listed)
    low, high = ARRIVES[tier, robot]
    assert low <= arrives <= high
    if tier == "cluttered":  # in each home to test in; one home spreads farther than its tier
        test = load_episode_file(ROOT / "scenes_mjcf" / "episodes" / f"{tier}-{robot}-test.json.gz").episodes
        for k in range(3):
            free = [not row["push_needed"] for row in test if row["scene"] == k]
            assert low - 0.15 <= sum(free) / len(free) <= high + 0.15


@pytest.mark.parametrize(("robot", "pushes"), [("turtlebot", 3), ("fetch", 0)])
def test_fixed_episodes_of_the_aws_house_are_in_the_scene_that_is_there(robot: str, pushes: int) -> None:
    file = load_episode_file(ROOT / "scenes_mjcf" / "episodes" / f"aws_house-{robot}.json.gz")
    assert file.scenes == (("aws_house", load_scene(ROOT / "scenes_mjcf" / "aws_house").task_digest),)
    assert len(file.episodes) == 200 and (file.robot, file.seed, len(file.objects)) == (robot, 7, 4)
    assert sum(row["push_needed"] for row in file.episodes) == pushes
    assert len({tuple(row["start_xy_w"]) for row in file.episodes}) == 200


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["furnished/furnished_008", "cluttered/cluttered_009"])
def test_a_scene_of_a_tier_is_made_as_it_is_listed(tmp_path: Path, name: str) -> None:
    tier, _, scene = name.partition("/")
    recipes = ROOT / "scenes_mjcf" / tier / "recipes.yaml"
    assert main(["generate-scenes", str(tmp_path), "--recipes", str(recipes), "--only", scene, "--jobs", "1"]) == 0
    listed = read_set(recipes.with_name("set.json")).scenes[scene]
    assert scene_digest(tmp_path / scene) == listed.digest
    assert load_manifest(tmp_path / scene).measures == listed.measures


def test_sets_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert scene_folders(["sparse/test"]) == tuple(str(ROOT / "scenes_mjcf" / name) for name in ("rowan", "willow"))


def test_own_sets_and_scenes_stand_side_by_side(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own)
    assert scene_folders(["homes/train", "homes/two", "elsewhere"]) == (
        "homes/one", "homes/three", "homes/two", "elsewhere",
    )  # fmt: skip
    assert scene_folders([own / "homes"]) == ("homes/one", "homes/three", "homes/two")


def test_what_is_missing_is_named_with_the_command(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own)
    (own / "homes" / "three" / "scene.json").unlink()
    with pytest.raises(SceneError, match="1 of 2 scenes .*'three'.*generate-scenes homes$"):
        scene_folders(["homes/train"])
    assert scene_folders(["homes/test"]) == ("homes/two",)


def test_a_set_without_scenes_of_a_split(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own)
    write_set(SceneSet("furnished", {"one": Member("train", 1)}), own / "homes" / "set.json")
    with pytest.raises(SceneError, match="no scene to test"):
        scene_folders(["homes/test"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tier": None}, "tier is null, expected a string"),
        ({"scenes": {"one": {"split": "valid", "seed": 1}}}, "one: split is 'valid', expected one of train, test"),
        ({"scenes": {"one": {"split": "train"}}}, "one: missing key 'seed'"),
        ({"scenes": {"../x": {"split": "train", "seed": 1}}}, "scenes: a name is '../x', expected one folder name"),
        ({"scenes": {"n" * 300: {"split": "train", "seed": 1}}}, "scenes: a name is 'n+...', expected one folder name"),
        ({"scene": {}}, "unknown key 'scene', did you mean 'scenes'"),
    ],
)
def test_a_broken_file_is_refused(own: Path, change: dict, message: str) -> None:
    path = own / "homes" / "set.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(SceneError, match=message):
        read_set(path)


@pytest.mark.parametrize("path", sorted(COMMITTED.glob("*.json")), ids=lambda path: path.stem)
def test_committed_sets_hold_the_scenes_that_are_there(path: Path) -> None:
    """What was made by another machine is the same task."""
    scenes = read_set(path)
    there = [name for name in scenes.scenes if (path.parent / scenes.folder / name / "scene.json").is_file()]
    assert there, "at least some scenes of every set are committed"
    for name in there:
        folder = path.parent / scenes.folder / name
        assert (load_manifest(folder).split, scene_digest(folder)) == (
            scenes.scenes[name].split,
            scenes.scenes[name].digest,
        )


def test_a_digest_passes_over_rounding_but_not_over_a_millimetre(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    shutil.copytree(ROOT / "scenes_mjcf" / "apartment_0", folder)
    digest, text = scene_digest(folder), (folder / "scene.xml").read_text()
    number = re.search(r'<body name="chair_0" pos="(-?\d+\.\d+) ', text)
    assert number is not None
    at = slice(number.start(1), number.end(1))
    for change_m, same in ((1e-9, True), (1e-3, False)):
        changed = text[: at.start] + f"{float(number[1]) + change_m:.12f}" + text[at.stop :]
        (folder / "scene.xml").write_text(changed)
        assert (scene_digest(folder) == digest) is same
    where = text.replace('<body name="chair_0"', '<site name="window_0" size="1 1 1"/><body name="chair_0"', 1)
    (folder / "scene.xml").write_text(where)
    assert where != text and scene_digest(folder) == digest  # where a window is moves nothing


def test_what_is_not_here_is_the_packages_or_the_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    assert scene_folders(["scenes_mjcf/alder"]) == (str(ROOT / "scenes_mjcf" / "alder"),)
    assert installed("scenes_mjcf/nowhere") == Path("scenes_mjcf/nowhere")
    (tmp_path / "scenes_mjcf" / "alder").mkdir(parents=True)
    assert installed("scenes_mjcf/alder") == Path("scenes_mjcf/alder"), "what is here comes first"


@pytest.fixture
def cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache's folder of a package whose furnished set is one scene, which is alder."""
    home = tmp_path / "package" / "furnished"
    digest = read_set(COMMITTED / "sparse.json").scenes["alder"].digest
    write_set(SceneSet("furnished", {"one": Member("test", 1, digest)}), home / "set.json")
    (home / "recipes.yaml").touch()
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("scenes_mjcf.sets.HERE", tmp_path / "package")
    monkeypatch.setattr("scenes_mjcf.sets.PACKAGED", {"furnished": home})
    monkeypatch.chdir(tmp_path)
    return tmp_path / "cache" / "package" / "furnished"


def test_every_packaged_home_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "list"]) == 0
    rows = [line.split(maxsplit=3) for line in capsys.readouterr().out.splitlines()]
    here = {name: place for _, _, name, place in rows}
    homes = [*TRAIN, "rowan", "willow", "apartment_0", "aws_house", "drawn/flat"]
    assert {name: here[name] for name in homes} == {name: str(ROOT / "scenes_mjcf" / name) for name in homes}
    assert [row[:3] for row in rows][:1] == [["sparse", "train", "alder"]] and len(rows) == len(here)


def test_a_scene_in_the_cache_is_found(cached: Path) -> None:
    shutil.copytree(ROOT / "scenes_mjcf" / "alder", cached / "one")
    assert scene_folders(["furnished/test"]) == ("cache/package/furnished/one",)
    assert installed("package/furnished/one") == cached / "one"


@pytest.mark.parametrize("left", ["another", "no scene.xml", "empty"])
def test_what_is_not_the_listed_scene_is_not_found_and_is_made_again(
    cached: Path, left: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(ROOT / "scenes_mjcf" / ("birch" if left == "another" else "alder"), cached / "one")
    for path in (cached / "one").iterdir() if left == "empty" else [cached / "one" / "scene.xml"] * (left[:2] == "no"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(SceneError, match="1 of 1 .*'one'.*not those that the set lists.* scenes make furnished$"):
        scene_folders(["furnished"])
    with pytest.raises(SceneError, match="not the scene that the set furnished lists; .* scenes make one$"):
        installed("package/furnished/one")
    assert main(["scenes", "list"]) == 0
    assert "one             in the cache is another scene" in capsys.readouterr().out

    def generate(wanted, report, log):
        assert wanted.only == ("one",) and wanted.overwrite and (wanted.out / "one").exists()
        shutil.rmtree(wanted.out / "one")
        shutil.copytree(ROOT / "scenes_mjcf" / "alder", wanted.out / "one")
        return []

    monkeypatch.setattr("converters.many.generate_scenes", generate)
    assert main(["scenes", "make", "one"]) == 0
    assert scene_folders(["furnished"]) == ("cache/package/furnished/one",)
    assert main(["scenes", "make", "one"]) == 0, "nothing is made a second time"


def test_scenes_that_are_made_by_name_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """The generator is stood in for, and so is the package: it gives alder, and cedar where birch was wanted."""
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("scenes_mjcf.sets.HERE", tmp_path / "package")
    monkeypatch.setattr("scenes_mjcf.sets.PACKAGED", {"sparse": tmp_path / "package"})
    monkeypatch.setattr("scenes_mjcf.sets.packaged_set", lambda name: read_set(COMMITTED / f"{name}.json"))
    shutil.copytree(ROOT / "scenes_mjcf" / "elm", tmp_path / "package" / "elm")
    assert main(["scenes", "make", "alder", "elm"]) == 1
    assert "alder: an earlier version of the generator wrote these scenes" in capsys.readouterr().out.replace("\n", " ")
    (tmp_path / "package" / "recipes.yaml").touch()
    asked = []

    def generate(wanted, report, log):
        asked.append((wanted.out, wanted.recipes, wanted.only))
        for name in wanted.only:
            given = "cedar" if name == "birch" else name
            shutil.copytree(ROOT / "scenes_mjcf" / given, wanted.out / name)
        return []

    monkeypatch.setattr("converters.many.generate_scenes", generate)
    assert main(["scenes", "make", "alder", "elm"]) == 0
    assert f"elm: is there, {tmp_path / 'package' / 'elm'}" in capsys.readouterr().out.replace("\n", "")
    assert main(["scenes", "make", "birch", "sparse/test"]) == 1
    assert "birch: not the scene that the set sparse lists" in capsys.readouterr().out
    out, recipes = tmp_path / "cache" / "package", tmp_path / "package" / "recipes.yaml"
    assert asked == [(out, recipes, ("alder",)), (out, recipes, ("birch", "rowan", "willow"))]
    assert main(["scenes", "make", "cedar", "aldr"]) == 2 and len(asked) == 2, "refused before anything is made"
    assert "no scene or set 'aldr', did you mean 'alder'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "right"),
    [
        ("aldr", "scenes_mjcf/alder"),
        ("scenes_mjcf/apartmnt_0", "scenes_mjcf/apartment_0"),
        ("clutered", "cluttered"),
        ("furnished/tset", "furnished/test"),
        ("some/where/cluttered010", "scenes_mjcf/cluttered/cluttered_010"),
    ],
)
def test_a_wrong_name_is_told_the_nearest(word: str, right: str) -> None:
    with pytest.raises(SceneError, match=f"expected a scene folder or a set .*, did you mean '{right}'"):
        load_scene(word)


def test_a_name_like_none_is_told_the_sets() -> None:
    with pytest.raises(SceneError, match=r"yscen: no such file; expected a scene folder or a set \(sparse, furnished"):
        load_scene("yscen")


def test_a_set_is_no_scene() -> None:
    for word in ("cluttered", "clutered"):
        with pytest.raises(
            SceneError, match=f"{word}: .* expected a scene folder, did you mean 'scenes_mjcf/cluttered/"
        ):
            existing(word)


def test_the_command_for_a_folder_with_a_space_can_be_typed(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_set(SceneSet("sparse", {"shed": Member("train", 1)}), Path("my homes/set.json"))
    with pytest.raises(SceneError) as missing:
        scene_folders(["my homes"])
    assert str(missing.value).endswith("make them: python -m converters generate-scenes 'my homes'")


def test_a_name_longer_than_a_file_may_have_names_no_scene():
    assert scene_folders(["x" * 300]) == ("x" * 300,)
