"""The commands: what they write, draw and refuse."""

import signal

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.distance import cdist

from docs.studies import rooms as rooms_study
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.jobs import progress
from topological_nav.__main__ import main
from topological_nav.maps.graph import load_map
from topological_nav.scenes import space as rooms


def test_the_map_has_nodes_in_both_rooms_and_images_around_each(made):
    digest = load_scene(made.scene).digest
    read = load_map(made.map, digest)
    assert np.bincount(read.room).min() >= 3
    assert read.embeddings.shape == (len(read.xy_w), 18, 24 // 3 * 1 + 32)
    assert np.linalg.norm(read.embeddings, axis=-1) == pytest.approx(np.sqrt(2), abs=1e-4)
    away = np.linalg.norm(read.xy_w[read.edges[:, 0]] - read.xy_w[read.edges[:, 1]], axis=1)
    assert away.max() < 2.5 and ((read.p > 0) & (read.p < 1)).all()
    # A node's own images lead back to it, or to one that saw the same.
    nodes = read.embeddings.astype(float)
    away = np.stack([cdist(nodes[:, 5], nodes[:, k], "sqeuclidean") for k in range(18)]).min(0)
    assert (away.argmin(1) == np.arange(len(nodes))).mean() > 0.8 and away.min(1).max() < 1e-6
    assert set(read.about) >= {"localiser", "detector", "settings", "data"}


def test_every_command_draws(made):
    for path in (made.data / "preview.png", made.rooms / "curves.png", made.map.with_suffix(".png")):
        picture = np.asarray(Image.open(path).convert("RGB"))
        assert picture.shape[0] > 200 and picture.std() > 10


def test_the_nearest_image_of_a_node_may_judge_its_edges(made, tmp_path, capsys):
    out = tmp_path / "nearest.npz"
    runs = ["--localiser", str(made.rooms), "--detector", str(made.passages)]
    assert main(["map", str(made.scene), *runs, "-o", str(out), "edge_image=nearest", "check=3"]) == 0
    told = capsys.readouterr().out
    assert "edges judged as on the plan" in told
    assert told.count("localised by 18 images") == 2 and told.count("localised by 1 image,") == 2
    first, second = load_map(made.map), load_map(out)
    assert (first.edges == second.edges).all() and (first.xy_w == second.xy_w).all()
    assert np.abs(first.p - second.p).max() > 0.01
    # Where an edge runs along one of the 18 headings, both looked at the same image.
    along = np.abs((first.angle_rad / np.deg2rad(20) + 0.5) % 1 - 0.5) < 1e-4
    assert first.p[along] == pytest.approx(second.p[along], abs=1e-4)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["data", "nowhere"], "nowhere: no such file"),
        (["data", "nowhere", "heading=3"], "unknown key 'heading', did you mean 'headings'?"),
        (["evaluate", "S", "--contenders", "expert,expert"], "contenders are expert, expert, expected each once"),
        (["train", "rooms", "--data", "nowhere"], "nowhere: is no dataset"),
        (["map", "nowhere", "--localiser", "gone", "--detector", "gone"], "gone: holds no trained network"),
    ],
)
def test_mistakes_are_one_line(words, told, capsys):
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("topological_nav: ") and told in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "unused"),
    [
        (["navigate", "S", "--truth", "--localiser", "R"], "--localiser"),
        (["navigate", "S", "--truth", "--detector", "R"], "--detector"),
        (["navigate", "S", "--truth", "--maps", "M"], "--maps"),
        (["navigate", "S", "--truth", "supersample=2"], "supersample"),
        (["navigate", "S", "--truth", "match=nearest"], "match"),
        (["navigate", "S", "thinned=0.3"], "thinned"),
        (["navigate", "S", "batch=3"], "batch"),
        (["navigate", "S", "--truth", "glance=false", "watch_s=2"], "watch_s"),
        (["evaluate", "S", "--contenders", "expert", "--truth"], "--truth"),
        (["evaluate", "S", "--contenders", "expert", "--maps", "M"], "--maps"),
        (["evaluate", "S", "--contenders", "expert", "--policy", "passage"], "--policy"),
        (["evaluate", "S", "--contenders", "expert", "--domain", "light"], "--domain"),
        (["evaluate", "S", "--contenders", "expert", "swings=3"], "swings"),
        (["evaluate", "S", "--contenders", "dense", "--ppo", "R"], "--ppo"),
        (["evaluate", "S", "--contenders", "dense", "thinned=0.3"], "thinned"),
        (["train", "rooms", "--localiser", "R"], "--localiser"),
        (["train", "rooms", "--grid"], "--grid"),
        (["train", "passages", "--detector", "R"], "--detector"),
        (["train", "passages", "pitch=up"], "pitch"),
        (["train", "policy", "--grid", "alpha=3"], "alpha"),
        (["adapt", "map", "S", "epochs=5"], "epochs"),
        (["adapt", "map", "S", "seed=5"], "seed"),
        (["adapt", "map", "S", "--data", "D", "--target", "T"], "--data"),
        (["adapt", "features", "--detector", "R"], "--detector"),
        (["adapt", "features", "passable=0.4"], "passable"),
        (["adapt", "passages", "--localiser", "R"], "--localiser"),
        (["adapt", "passages", "epochs=5"], "epochs"),
    ],
)
def test_what_would_change_nothing_is_refused(words, unused, capsys):
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"topological_nav: {unused} has no effect ") and error.count("\n") == 1


def test_a_stop_before_the_work_begins_is_one_line(monkeypatch, capsys):
    def stopped(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("topological_nav.commands.run_data", stopped)
    assert main(["data", "nowhere"]) == 128 + signal.SIGINT
    assert capsys.readouterr().err == "topological_nav: stopped; give the same command again\n"


def test_a_room_classifier_judges_no_passages(made, capsys, tmp_path):
    runs = ["--localiser", str(made.rooms), "--detector", str(made.rooms)]
    assert main(["map", str(made.scene), *runs, "-o", str(tmp_path / "map.npz")]) == 2
    assert "the detector was trained for 'rooms', expected a run of 'train passages'" in capsys.readouterr().err


def test_rooms_of_a_scene_are_compared_in_a_figure(made, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(rooms, "CLUSTERED", 120)
    out = tmp_path / "rooms.png"
    assert rooms_study.main([str(made.scene), "-o", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines] == ["kmeans", "gmm", "spectral"]
    assert Image.open(out).size[0] > 800


def test_time_left_is_told_by_what_this_run_has_done_so_far(monkeypatch, capsys):
    clock = iter((400.0, 420.0, 500.0))  # after five minutes of compiling
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(clock))
    with progress.bar() as tell:
        for done in (20, 25, 30, 31, 100):
            tell("cedar", done, 100)
    # 20 were there before; then 10 in 20 s, so 140 s for the other 70.
    assert capsys.readouterr().err.splitlines() == [
        "cedar: 20 of 100",
        "cedar: 30 of 100, 140 s left",
        "cedar: 100 of 100, 0 s left",
    ]
