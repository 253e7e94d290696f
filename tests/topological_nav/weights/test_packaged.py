"""What is used where nothing is named; `navigate` with packaged weights alone; the weights of this package."""

import dataclasses
import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.config import overlay
from interactive_nav_common.errors import FileError
from topological_nav.__main__ import main
from topological_nav.config import RUNS, DataConfig
from topological_nav.data.dataset import draw_passages
from topological_nav.data.folders import renderer_of
from topological_nav.drives.driving import load_policy
from topological_nav.learn.training import load_networks
from topological_nav.maps.build import drawn_for
from topological_nav.maps.graph import load_map, save_map
from topological_nav.scenes.rendering import camera_pose
from topological_nav.scenes.space import find_rooms, free_space, recorded_rooms
from topological_nav.weights import export as packaged
from topological_nav.weights.export import choose, fitting_map, packaged_weights

ROOT = Path(__file__).parents[3]


@pytest.fixture()
def here(tmp_path, monkeypatch):
    """An empty working folder, and a package without weights: its folder is returned."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(packaged, "packaged_weights", lambda: tmp_path / "package")
    return tmp_path / "package"


def finish(*runs):
    for run in map(Path, runs):
        run.mkdir(parents=True)
        (run / "network.json").write_text("{}")


def test_what_is_named_is_used(here):
    finish(here / "rooms", here / "passages", here / "policy")
    chosen = choose(Path("a"), Path("b"))
    assert (chosen.localiser, chosen.detector, chosen.policy, chosen.source) == (Path("a"), Path("b"), "passage", "")
    assert chosen.maps == (RUNS / "maps",) and not chosen.renewed
    assert choose(Path("a"), Path("b"), "c").policy == "c"


def test_own_runs_come_before_the_package(here, capsys):
    finish(here / "rooms", here / "passages", here / "policy", RUNS / "rooms", RUNS / "passages")
    chosen = choose(None, None)
    assert (chosen.localiser, chosen.detector) == (RUNS / "rooms", RUNS / "passages")
    assert chosen.policy == "passage" and chosen.maps == (RUNS / "maps",) and not chosen.renewed
    chosen.report()
    line = f"networks: {RUNS}/rooms and {RUNS}/passages"
    assert capsys.readouterr().err == f"{line}; local policy: passage\n" and chosen.source == line
    finish(RUNS / "policy")
    assert choose(None, None).policy == str(RUNS / "policy")
    assert choose(None, None, "passage").policy == "passage"


def test_the_package_is_used_where_a_run_is_missing_or_not_finished(here):
    finish(here / "rooms", here / "passages", here / "policy", RUNS / "rooms")
    (RUNS / "passages").mkdir()
    origin = {"networks": {"rooms": {"commit": "0123456789abcdef", "device": "NVIDIA H200"}}}
    (here / "export.json").write_text(json.dumps(origin))
    chosen = choose(None, None)
    assert (chosen.localiser, chosen.detector) == (here / "rooms", here / "passages")
    assert chosen.policy == str(here / "policy") and chosen.renewed
    assert chosen.maps == (RUNS / "maps-packaged", here / "maps")
    assert chosen.source == f"networks: rooms and passages of the package, {here}"
    # One that is named, or not needed, does not have to be there; its policy would be another's.
    some = choose(None, Path("mine"))
    assert (some.localiser, some.detector, some.policy) == (RUNS / "rooms", Path("mine"), "passage")
    assert choose(None, None, needs=("rooms",)).localiser == RUNS / "rooms"
    assert choose(None, None, needs=("passages",)).detector == here / "passages"


def test_without_any_the_remedy_is_named(here, capsys):
    with pytest.raises(FileError, match=r"of rooms and passages: neither runs/topological nor .* rooms\)"):
        choose(None, None)
    with pytest.raises(FileError, match=r"networks of passages.*train passages\) or name a run folder: --detector RUN"):
        choose(Path("mine"), None)
    for words in (
        ["map", "nowhere"],
        ["navigate", "nowhere"],
        ["evaluate", "nowhere"],
        ["adapt", "features"],
        ["adapt", "map", "nowhere"],
    ):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert error.startswith("topological_nav: no trained networks of rooms") and error.count("\n") == 1


@pytest.mark.heavy
def test_a_map_fits_its_scene_and_networks_alone(made, exported, here, tmp_path):
    chosen = dataclasses.replace(
        choose(exported / "rooms", exported / "passages"), maps=(tmp_path / "one", exported / "maps")
    )
    digest = load_scene(made.scene).digest
    assert fitting_map(chosen, "painted", digest) == exported / "maps" / "painted.npz"
    assert fitting_map(chosen, "painted", "0" * 64) is None and fitting_map(chosen, "other", digest) is None
    own = load_map(made.map)
    save_map(dataclasses.replace(own, about={**own.about, "localiser": "x"}), tmp_path / "one" / "painted.npz")
    assert fitting_map(chosen, "painted", digest) == exported / "maps" / "painted.npz"
    save_map(own, tmp_path / "one" / "painted.npz")
    assert fitting_map(chosen, "painted", digest) == tmp_path / "one" / "painted.npz"


@pytest.mark.heavy
def test_navigate_works_with_the_package_alone(made, exported, here, capsys):
    """Its own map first; without one it is made once and kept; one of other networks is made anew."""
    shutil.copytree(exported, here)
    words = ["navigate", str(made.scene), "limit_s=12", "images=3", "backend=native"]
    kept, picture = RUNS / "maps-packaged" / "painted.npz", RUNS / "navigate" / "painted-0.png"
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert f"networks: rooms and passages of the package, {here}" in err and f"local policy: {here}/policy" in err
    assert "looked about: at node" in out and "next: node" in out and not kept.exists()
    assert np.asarray(Image.open(picture).convert("RGB")).std() > 10

    shutil.rmtree(here / "maps")
    assert main([*words, "--policy", "passage"]) == 0
    out, err = capsys.readouterr()
    assert f"painted has no map of these networks yet; it is made once and kept in {kept}" in err
    assert "local policy: passage" in err and f"{kept}: " in out and kept.with_suffix(".png").is_file()
    own, there = load_map(made.map), load_map(kept)
    assert there.embeddings == pytest.approx(own.embeddings, abs=0.02)

    before = kept.stat().st_mtime_ns
    assert main([*words, "--policy", "passage"]) == 0
    assert "it is made once" not in capsys.readouterr().err and kept.stat().st_mtime_ns == before
    save_map(dataclasses.replace(there, about={**there.about, "detector": "of an older package"}), kept)
    assert main([*words, "--policy", "passage"]) == 0
    assert "it is made once" in capsys.readouterr().err
    assert load_map(kept).about == there.about


@pytest.mark.heavy
def test_a_map_of_own_runs_is_made_but_never_written_over(made, here, capsys):
    for task, run in (("rooms", made.rooms), ("passages", made.passages)):
        shutil.copytree(run, RUNS / task)
    kept = RUNS / "maps" / "painted.npz"
    own = load_map(made.map)
    save_map(dataclasses.replace(own, about={**own.about, "detector": "f" * 64}), kept)
    words = ["navigate", str(made.scene), "limit_s=2", "backend=native"]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert f"networks: {RUNS}/rooms and {RUNS}/passages" in error and "was built with detector ffffffffffff" in error
    assert load_map(kept).about["detector"] == "f" * 64
    kept.unlink()
    assert main(words) == 0
    assert "it is made once" in capsys.readouterr().err
    np.testing.assert_array_equal(load_map(kept).embeddings, own.embeddings)


@pytest.mark.heavy
def test_rows_of_exported_networks_are_not_those_of_the_runs(made, exported):
    from topological_nav.config import EvaluationConfig
    from topological_nav.evaluate.contest import Contest, contest_scenes

    asked = []
    for home in (made.rooms.parent, exported):
        files = {"painted": made.map}
        contest = Contest(
            (made.scene,), ("dense",), made.map, EvaluationConfig(), map_files=files,
            localiser=home / "rooms", detector=home / "passages",
        )  # fmt: skip
        asked.append(contest_scenes(contest)[0].request("dense"))
    assert asked[0]["map"] == asked[1]["map"]
    assert asked[1]["networks"] == [f"{stored}-fp16" for stored in asked[0]["networks"]]


needs_weights = pytest.mark.skipif(
    not packaged_weights().is_dir(),
    reason="topological_nav/weights/exported is not there: none are committed",
)


@needs_weights
def test_the_packaged_weights_are_small_and_say_where_they_come_from():
    folder = packaged_weights()
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    about = json.loads((folder / "export.json").read_text())
    assert size < 8 * 2**20 and {"rooms", "passages"} <= set(about["networks"])
    for task in about["networks"]:
        row = about["networks"][task]
        assert len(row["commit"].removesuffix("+dirty")) == 40 and row["device"] and row["command"]
        assert (folder / task / "config.yaml").stat().st_size > 0
        assert json.loads((folder / task / "network.json").read_text())["export"]["precision"] == "fp16"
        assert json.loads((folder / task / "results.json").read_text())["task"] == task
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    installed = {path for pattern in patterns["topological_nav"] for path in (ROOT / "topological_nav").glob(pattern)}
    assert {path for path in folder.rglob("*") if path.is_file()} <= installed


@needs_weights
def test_the_packaged_networks_tell_free_ways_from_blocked_ones():
    """In a committed scene, ways and labels drawn as a dataset draws them, with a seed of their own."""
    folder = packaged_weights()
    networks = load_networks(folder / "rooms", folder / "passages")
    data = networks.camera
    scene, robot = load_scene(ROOT / "scenes_mjcf" / "cedar"), get_robot(data.robot)
    space, known = free_space(scene, robot.height_m), recorded_rooms(scene.digest)
    rooms = find_rooms(space, data.room_method, data.num_rooms, known, data.seed, data.clearance_m)
    asked = overlay(DataConfig(), networks[1].about["data"], "network.json")
    ways = draw_passages(space, rooms, asked, np.random.default_rng(99))
    picked = np.concatenate(
        [
            np.flatnonzero(ways.free[:, asked.passage_column] == label)[:: max(1, len(ways) // 36)][:18]
            for label in (0, 1)
        ]
    )
    pose = camera_pose(robot, ways.xy_w[picked], ways.heading_rad[picked], np.zeros(len(picked)))
    images = renderer_of(scene, drawn_for(data, None)).draw(pose)
    embedded = networks[0].embed(images)
    width = networks[0].about["width"]
    assert embedded.shape == (len(picked), 10 * width)  # 2 and 8 times the width: after the stages 3 and 5
    assert np.linalg.norm(embedded, axis=-1) == pytest.approx(np.sqrt(2), abs=1e-3)
    p = networks[1].passage(images, asked.passage_length_m)
    free = ways.free[picked, asked.passage_column]
    assert p[free].mean() > p[~free].mean() + 0.3
    assert ((p > 0.5) == free).mean() > 0.7
    if not (folder / "policy").is_dir():
        return
    policy = load_policy(folder / "policy")
    _, linear, angular = policy.act(policy.start(len(images)), images)
    assert np.isin(linear, policy.about["linear_m_s"]).all() and np.isin(angular, policy.about["angular_rad_s"]).all()
