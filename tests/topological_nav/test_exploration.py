"""Maps that are built while the robot drives: with the truth in a toy of two rooms, then with small networks."""

import numpy as np
import pytest

from interactive_nav_common.rotations import wrap_angle
from tests.toys import write_room
from topological_nav.__main__ import main
from topological_nav.config import EvaluationConfig
from topological_nav.evaluate.contest import Contest, contest_scenes
from topological_nav.exploration import SAME_M, Explorer
from topological_nav.learn.training import load_networks
from topological_nav.maps.graph import angles, lengths, load_map
from topological_nav.weights.export import packaged_weights

WORDS = ("backend=native", "seed=1")


def explored(scene, out, **settings):
    """The explorer with true sight, and what it has built after a while."""
    config = EvaluationConfig.of(backend="native", seed=1, **settings)
    (venue,) = contest_scenes(Contest((scene,), ("dense",), out, config, truth=True))
    explorer, seen = Explorer(venue), []
    explorer.play(lambda *of: seen.append(of))
    return explorer, explorer.built(), seen


@pytest.fixture(scope="module")
def toy(painted, tmp_path_factory):
    return explored(painted, tmp_path_factory.mktemp("toy"))


@pytest.mark.heavy
def test_it_explores_both_rooms_and_ends_when_no_heading_is_left(toy):
    explorer, built, seen = toy
    assert (built.map.xy_w[:, 0] < -0.5).sum() >= 2 and (built.map.xy_w[:, 0] > 0.5).sum() >= 2
    assert seen[-1][1:] == (1800, 1800) and seen[-2][1] < 1700  # not because the time was up
    assert not np.any(explorer._unexplored) and len(built.map.open_parts(0.5)[0]) == len(built.map.xy_w)
    # The score by hand: cells of the floor and nodes, one by one.
    floor = built.space.centres(0.35)
    near = [min(np.hypot(*(cell - node)) for node in built.map.xy_w) < 1.5 for cell in floor]
    assert built.scores["free floor within 1.5 m of a node"] == f"{np.mean(near):.3f}" and np.mean(near) > 0.9


def test_edges_have_the_angle_that_the_robot_left_by(toy):
    graph = toy[1].map
    there = {(a, b): angle for (a, b), angle in zip(graph.edges.tolist(), graph.angle_rad.tolist(), strict=True)}
    assert len(there) >= 2 * (len(graph.xy_w) - 1)
    for (a, b), angle in there.items():
        assert abs(wrap_angle(there[b, a] - angle)) == pytest.approx(np.pi, abs=1e-5)
    # The first run began at node 0 itself. Others began and ended less than 0.9 m from their nodes.
    off = np.abs(wrap_angle(graph.angle_rad - angles(graph.xy_w, graph.edges)))
    away = np.linalg.norm(graph.xy_w[graph.edges[:, 0]] - graph.xy_w[graph.edges[:, 1]], axis=1)
    assert off[0] < np.deg2rad(6.0) and np.median(off) < np.deg2rad(15.0)
    reach = np.arcsin(np.clip(2 * SAME_M / away, 0.0, 1.0)) + np.deg2rad(33.0)
    assert (off <= reach).all() and (away > SAME_M).all()
    assert graph.length_m == pytest.approx(lengths(graph.xy_w, graph.edges))


@pytest.mark.heavy
def test_a_seed_gives_one_map(toy, painted, tmp_path):
    first, again = toy[1].map, explored(painted, tmp_path)[1].map
    for name in ("xy_w", "edges", "p", "angle_rad"):
        assert (getattr(first, name) == getattr(again, name)).all()


def test_without_an_open_heading_a_line_says_what_to_change(tmp_path, capsys):
    cell = write_room(tmp_path / "cell", (1.6, 1.6), ())
    assert main(["explore", str(cell), "--truth", "-o", str(tmp_path), *WORDS]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "no heading is open for 1" in said and said.endswith("choose another seed or less passable")
    assert main(["explore", str(cell), "--truth", "-o", str(tmp_path), *WORDS, "limit_s=1"]) == 2
    assert "limit_s is 1, expected time to look about; raise it" in capsys.readouterr().err
    assert not (tmp_path / "cell.npz").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--truth", "--maps", "somewhere"), "--maps has no effect in 'explore'"),
        (("--truth", "episodes=3"), "episodes has no effect in 'explore'"),
    ],
)
def test_what_has_no_effect_is_refused(painted, words, said, capsys):
    assert main(["explore", str(painted), *words]) == 2
    assert said in capsys.readouterr().err


def test_networks_of_different_cameras_are_refused(made, capsys):
    runs = ["--localiser", str(made.rooms), "--detector", str(packaged_weights() / "passages")]
    assert main(["explore", str(made.scene), *runs, *WORDS]) == 2
    assert "learned from images with width = 32, the detector 128" in capsys.readouterr().err


@pytest.mark.heavy
def test_the_navigator_drives_by_a_map_that_was_explored(made, tmp_path, capsys):
    runs = ["--localiser", str(made.rooms), "--detector", str(made.passages)]
    assert main(["explore", str(made.scene), *runs, "-o", str(tmp_path), *WORDS, "limit_s=60", "passable=0.05"]) == 0
    networks, graph = load_networks(made.rooms, made.passages), load_map(tmp_path / "painted.npz")
    assert {name: graph.about[name] for name in networks.digests} == networks.digests
    assert graph.embeddings.shape[1] == 18 and np.linalg.norm(graph.embeddings, axis=-1) == pytest.approx(
        2**0.5, abs=1e-3
    )
    assert f"{tmp_path / 'painted.npz'}: {len(graph.xy_w)} nodes" in capsys.readouterr().out
    drive = ["navigate", str(made.scene), *runs, "--maps", str(tmp_path), "backend=native", "limit_s=2", "min_goal_m=1"]
    assert main([*drive, "-o", str(tmp_path / "drive.png")]) == 0
