"""The report's figures: what is drawn is what networks, maps and episodes say."""

from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.patches import Wedge
from PIL import Image

from interactive_nav_common.records import RUNS
from topological_nav.__main__ import main
from topological_nav.config import EvaluationConfig
from topological_nav.drives.dataset import drive_images, load_drives
from topological_nav.drives.driving import load_policy
from topological_nav.evaluate.contest import Contest, contest_scenes
from topological_nav.figures import report
from topological_nav.figures.report import closest, errors, errors_figure, reason, round_figure, strip_figure


def venue(made, tmp_path, policy="passage") -> Any:
    runs = {"maps": made.map.parent, "map_files": {"painted": made.map}}
    runs |= {"localiser": made.rooms, "detector": made.passages, "policy": str(policy)}
    return contest_scenes(Contest((made.scene,), ("dense",), tmp_path, EvaluationConfig(), **runs))[0]


def test_probabilities_of_a_drive_are_those_that_the_policy_acts_by(steered, driven):
    policy, drives = load_policy(steered), load_drives(driven)
    rows, images = next(drive_images(driven))
    k = int(rows[0])
    images = images[: drives.steps[k]]
    linear, angular = policy.probabilities(images)
    assert linear.shape == (len(images), 3) and angular.shape == (len(images), 5)
    for p in (linear, angular):
        assert p.sum(1) == pytest.approx(np.ones(len(images)), abs=1e-5)
    state = policy.start(1)
    for t, image in enumerate(images):
        state, forward, turn = policy.act(state, image[None])
        assert policy.about["linear_m_s"][linear[t].argmax()] == forward[0]
        assert policy.about["angular_rad_s"][angular[t].argmax()] == turn[0]
    figure = strip_figure(policy, images, drives.command[drives.rows(k)])
    axes: Any = figure.axes
    *frames, first, second, _ = axes
    assert len(frames) == 8 and np.array_equal(frames[0].images[0].get_array(), images[0])
    np.testing.assert_array_equal(first.images[0].get_array(), linear.T)
    np.testing.assert_array_equal(second.images[0].get_array(), angular.T)
    np.testing.assert_array_equal(second.lines[0].get_ydata(), drives.command[drives.rows(k), 1])
    plt.close("all")


def test_the_share_of_steps_that_agree_by_hand():
    likely = np.array([0, 0, 1, 2])
    driver: Any = SimpleNamespace(
        about={"linear_m_s": [0.0, 0.25, 0.5], "angular_rad_s": [-1.0, 0.0, 1.0]},
        probabilities=lambda _: (np.eye(3)[likely], np.eye(3)[likely]),
    )
    commands = np.array([[0.1, -0.9], [0.2, 0.4], [0.3, 0.1], [0.5, 0.6]])
    figure = strip_figure(driver, np.zeros((4, 6, 8, 3), np.uint8), commands)
    # 0.1, 0.3 and 0.5 m/s are nearest to classes 0, 1, 2; 0.2 to 1. -0.9, 0.1 and 0.6 rad/s to 0, 1, 2; 0.4 to 1.
    assert [axis.get_title().rsplit(" in ")[1] for axis in figure.axes[-3:-1]] == ["75% of the steps"] * 2
    plt.close("all")


def test_sectors_around_a_place_are_as_long_as_the_detector_is_sure(made, tmp_path):
    there = venue(made, tmp_path)
    node, heading = 2, 2 * np.pi * np.arange(18) / 18
    xy = np.repeat(there.map.xy_w[[node]].astype(float), 18, 0)
    p = there.networks.detector.passage(there.camera(xy, heading), 1.2)
    axis, *cells = round_figure(there, node).axes
    sectors = [patch for patch in axis.patches if isinstance(patch, Wedge)]
    assert [sector.r for sector in sectors] == pytest.approx(1.2 * p)
    assert [(s.theta1 + s.theta2) / 2 for s in sectors] == pytest.approx(np.rad2deg(heading))
    titles = [cell.get_title() for cell in cells if cell.images]
    assert titles == [f"{20 * k}°: {value:.2f}" for k, value in enumerate(p)]
    plt.close("all")


def test_the_closest_image_is_the_nearest_of_all_pairs():
    rng = np.random.default_rng(0)
    queries, seen = rng.normal(size=(3, 4)), rng.normal(size=(5, 4))
    apart = np.linalg.norm(queries[:, None] - seen, axis=-1)
    query, at, away = closest(queries, seen)
    assert (query, at) == np.unravel_index(apart.argmin(), apart.shape) and away == pytest.approx(apart.min())
    assert closest(np.array([[3.0, 4.0]]), np.array([[9.0, 9.0], [0.0, 0.0]])) == (0, 1, 5.0)


def test_errors_by_hand():
    free = np.array([True, True, True, False, False, False])
    p = np.array([0.9, 0.3, 0.1, 0.6, 0.4, 0.95])
    positives, negatives = errors(free, p)
    assert positives.tolist() == [5, 3] and negatives.tolist() == [2, 1]
    images = np.arange(6, dtype=np.uint8)[:, None, None, None] * np.ones((1, 6, 8, 3), np.uint8)
    figure: Any = errors_figure(images, free, {"before (C)": p})
    shown = [[int(axis.images[0].get_array().max()) for axis in band.axes if axis.images] for band in figure.subfigs]
    assert shown == [[0, 1, 2, 3, 4, 5], [5, 3], [2, 1]]
    assert [band._suptitle.get_text() for band in figure.subfigs[1:]] == [
        "before (C), false positives: 2 of 3 images without a passage",
        "before (C), false negatives: 2 of 3 images with a passage",
    ]
    plt.close("all")


def test_why_an_episode_was_lost_by_hand():
    driven: Any = SimpleNamespace(
        xy_w=np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [0.0, 1.0]]),
        phase=np.array([0, 1, 2, 4]),
        journey=SimpleNamespace(goal_xy_w=np.array([[3.0, 3.0]])),
        played=SimpleNamespace(broken=[False], blocked=[2], lost=[1]),
    )
    assert reason(driven) == (
        "out of time, never nearer than 2.0 m; 2 times no open heading, 1 times no way in the map; 25% of the time "
        "driving, 25% looking about, 50% turning to edges"
    )


@pytest.fixture(scope="module")
def drawn(made, driven, steered, tmp_path_factory):
    """The command over a folder of runs of the painted scene, and what it said."""
    runs = tmp_path_factory.mktemp("runs")
    (runs / "drives").symlink_to(driven)
    (runs / "data-unseen").symlink_to(made.data)
    words = ["--target", str(made.data), "--detector", str(made.passages), "fine_tune_epochs=1", "domain=blur"]
    assert main(["adapt", "passages", "-o", str(runs / "adapted-passages"), *words]) == 0
    networks = ["--localiser", str(made.rooms), "--detector", str(made.passages), "--policy", str(steered)]
    (runs / "maps").mkdir()
    (runs / "maps" / "painted.npz").symlink_to(made.map)
    played = ["--maps", str(runs / "maps"), "episodes=2", "limit_s=15", "backend=native"]
    assert main(["figures", str(runs), "--scene", str(made.scene), *networks, *played]) == 0
    return runs


def test_one_command_draws_all(drawn):
    names = {path.stem.removeprefix("figure-") for path in (drawn / "figures").glob("*.png")}
    assert names >= {"8", "9", "10", "11", "16-17", "18", "22-24"}
    for path in (drawn / "figures").glob("*.png"):
        assert np.asarray(Image.open(path).convert("RGB")).std() > 10


def test_listed_errors_are_those_of_the_confusion(drawn, made, monkeypatch):
    kept = {}
    monkeypatch.setattr(report, "errors_figure", lambda images, free, judged: kept.update(free=free, judged=judged))
    run = drawn / "adapted-passages"
    assert [name for name, _ in report.transferred(run, made.data, made.passages)] == ["22-24"]
    results = RUNS.json(run / "results.json")
    for name, p in zip("CD", kept["judged"].values(), strict=True):
        (_, positives), (negatives, _) = results[name]["confusion"]
        assert [len(rows) for rows in errors(kept["free"], p)] == [positives, negatives]


def test_what_is_missing_takes_a_line_each(made, tmp_path, capsys):
    networks = ["--localiser", str(made.rooms), "--detector", str(made.passages), "--maps", str(tmp_path)]
    (tmp_path / "painted.npz").symlink_to(made.map)
    words = ["--scene", str(made.scene), *networks, "-o", str(tmp_path / "out"), "episodes=1", "limit_s=1"]
    assert main(["figures", str(tmp_path), *words, "backend=native"]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("without figures ")]
    assert [line.split(": ")[0] for line in said] == [
        f"without figures {n}" for n in ("8 and 9", "13 to 17", "22 to 24")
    ]
    assert "none of 1 episodes on each map was won; try more with episodes=N" in said[1]
