"""The navigator with networks: a trained local policy, and another camera, from the command to the rows."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from interactive_nav.robots import get_robot
from interactive_nav.scenes.world import world_poses
from interactive_nav_common.config import replace
from interactive_nav_common.errors import ConfigError, FileError
from interactive_nav_common.rows import read_rows
from scenes_mjcf.look import Lens
from tests.topological_nav.conftest import Made
from topological_nav.__main__ import main
from topological_nav.config import DataConfig, EvaluationConfig
from topological_nav.data.domains import PRESETS, as_seen_from
from topological_nav.drives.driving import local_policy
from topological_nav.evaluate import contest as rows
from topological_nav.evaluate.contest import Contest, ContestScene, contest_scenes
from topological_nav.evaluate.evaluation import NavigatorPlayer
from topological_nav.learn.learning import WEIGHTS
from topological_nav.learn.training import load_trained, save_trained
from topological_nav.maps.build import drawn_for
from topological_nav.maps.graph import load_map, save_map
from topological_nav.navigate.navigator import DRIVE
from topological_nav.scenes.rendering import SceneRenderer, camera_pose
from topological_nav.scenes.space import RECORDED

WORDS = ("episodes=2", "batch=2", "images=6", "limit_s=12", "backend=native", "max_turn_rad_s=2.0", "passable=0.05")
CONFIG = EvaluationConfig.of(
    episodes=2, batch=2, images=6, limit_s=12.0, backend="native", max_turn_rad_s=2.0, passable=0.05
)


@pytest.fixture(scope="module")
def contest(made: Made, steered, tmp_path_factory):
    """The painted rooms, seen by networks and driven by the trained policy."""
    maps = tmp_path_factory.mktemp("contest") / "maps"
    maps.mkdir()
    shutil.copy(made.map, maps / "painted.npz")
    with pytest.MonkeyPatch.context() as patch:
        from interactive_nav.scenes.scene import load_scene

        patch.setitem(RECORDED, load_scene(made.scene).digest, ((-3.0, -2.0, -0.05, 2.0), (0.05, -2.0, 3.0, 2.0)))
        yield Contest(
            (made.scene,), ("dense",), maps.parent / "out", CONFIG,
            maps=maps, localiser=made.rooms, detector=made.passages, policy=str(steered),
        )  # fmt: skip


class Recorded:
    """A policy, and everything that it was shown and remembered."""

    def __init__(self, policy):
        self.policy, self.calls = policy, []

    def start(self, batch):
        return self.policy.start(batch)

    def act(self, state, images):
        new, linear, angular = self.policy.act(state, images)
        before, after = (jax.tree.map(np.array, s) for s in (state, new))
        self.calls.append((before, images.copy(), after, linear, angular))
        return new, linear, angular


@pytest.fixture(scope="module")
def watched(contest):
    """One episode of runs of 2 s played with everything recorded; nowhere is near enough to the goal to end it."""
    config = replace(CONFIG, episodes=1, batch=1, limit_s=30.0, run_s=2.0, success_m=0.01, glance=False)
    (venue,) = contest_scenes(dataclasses.replace(contest, config=config))
    navigator = venue.navigator("dense")
    navigator.policy = Recorded(navigator.policy)
    steps = []

    def watch(time_s, seen, state):
        steps.append((time_s, seen, state, len(navigator.policy.calls)))

    played = NavigatorPlayer(venue.player, config, navigator, venue.camera, watch).play(venue.episodes)
    return venue, navigator.policy, steps, played


@pytest.mark.heavy
def test_a_trained_policy_starts_every_run_with_a_fresh_memory_and_keeps_it_within(watched):
    _, policy, steps, played = watched
    started = [steps[i][3] - 1 for i in range(len(steps)) if steps[i][2].run_started[0]]
    assert played.runs[0] >= 2 and len(started) >= 2
    for number, (before, *_) in enumerate(policy.calls):
        if number in started:
            assert all((x == 0).all() for x in jax.tree.leaves(before))
        else:
            same = jax.tree.map(lambda x, y: (x == y).all(), before, policy.calls[number - 1][2])
            assert all(jax.tree.leaves(same)) and any((x != 0).any() for x in jax.tree.leaves(before))
    # Ten looks a second while it drives.
    assert len(policy.calls) == sum(int(state.phase[0] == DRIVE) for _, _, state, *_ in steps)


def test_it_is_shown_level_images_of_where_the_robot_is_and_its_words_are_commands(watched):
    venue, policy, steps, _ = watched
    renderer = SceneRenderer(venue.scene, Lens(32, 32, venue.networks.camera.fov_deg))
    world = venue.player.env.world
    robot, about = get_robot("ttbot"), policy.policy.about
    acted = [i for i in range(1, len(steps)) if steps[i][3] > steps[i - 1][3]]
    for i in acted[:: max(1, len(acted) // 5)]:
        _, seen, state, count = steps[i]
        _, images, _, linear, angular = policy.calls[count - 1]
        assert images.shape == (1, 32, 32, 3) and images.dtype == np.uint8
        names, own, pos_w, quat_w = world_poses(world, 0, seen.qpos)
        bodies = names[own:], pos_w[:, own:], quat_w[:, own:]
        expected = renderer.draw(camera_pose(robot, seen.xy_w, seen.yaw_rad, np.zeros(1)), bodies)
        assert (images == expected).all()
        assert (images != renderer.draw(camera_pose(robot, seen.xy_w, seen.yaw_rad, np.array([0.35])))).any()
        assert (state.linear[0], state.angular[0]) == (linear[0], angular[0])
        assert linear[0] in about["linear_m_s"] and angular[0] in about["angular_rad_s"]


def test_its_memory_stays_with_its_episode_when_others_are_over(contest):
    (venue,) = contest_scenes(contest)
    navigator = venue.navigator("dense")
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (60, 3, 32, 32, 3), np.uint8)
    state = navigator.start(np.array([0, 1, 2], np.int32))
    state = dataclasses.replace(
        state, phase=np.full(3, DRIVE, np.int8), node=np.array([1, 2, 3], np.int32), run_end_s=np.full(3, 99.0),
        watch_s=np.full(3, 99.0), began_s=np.zeros(3),
    )  # fmt: skip
    rows = np.array([2, 0])
    for t in range(5):
        state = navigator.step(state, images[t], np.zeros(3), 0.1 * t)
    fewer = state.take(rows)
    assert all(len(x) == 2 for x in jax.tree.leaves(fewer.hidden))
    for t in range(5, 10):
        state = navigator.step(state, images[t], np.zeros(3), 0.1 * t)
        fewer = navigator.step(fewer, images[t][rows], np.zeros(2), 0.1 * t)
        assert (fewer.linear == state.linear[rows]).all() and (fewer.angular == state.angular[rows]).all()
    for whole, part in zip(jax.tree.leaves(state.hidden), jax.tree.leaves(fewer.hidden), strict=True):
        assert whole[rows] == pytest.approx(part, abs=1e-5) and np.abs(whole[0] - whole[2]).max() > 1e-3


def words_of(contest):
    return [
        *("--maps", str(contest.maps), "--localiser", str(contest.localiser), "--detector", str(contest.detector)),
        *("--policy", contest.policy),
    ]


@pytest.mark.heavy
def test_rows_say_which_policy_drove_and_by_what_it_saw(contest, tmp_path, capsys):
    words = ["evaluate", str(contest.scenes[0]), "--contenders", "dense", "-o", str(tmp_path), *words_of(contest)]
    assert main([*words, *WORDS]) == 0
    assert "2 episodes; tables in summary.md" in capsys.readouterr().out
    rows = read_rows(sorted((tmp_path / "rows").glob("*.parquet"))).to_pylist()
    assert [(r["policy"], r["sight"], r["domain"]) for r in rows] == [(contest.policy, "networks", "clean")] * 2
    assert all(r["runs"] >= 1 and r["localisations"] >= 1 for r in rows)
    out = tmp_path / "one.png"
    words = ["navigate", str(contest.scenes[0]), "--episode", "1", "-o", str(out), *words_of(contest)]
    assert main([*words, *(word for word in WORDS if word != "batch=2")]) == 0
    told = capsys.readouterr().out
    assert f"after {rows[1]['duration_s']:.0f} s and {rows[1]['path_m']:.1f} m" in told and "drives" in told


def test_other_weights_of_the_policy_are_another_question(contest, steered, tmp_path):
    other = tmp_path / "run"
    shutil.copytree(steered, other)
    stems = set()
    for name in ("passage", str(other), None):
        if name is None:
            weights = bytearray((other / WEIGHTS).read_bytes())
            weights[-1] ^= 1
            (other / WEIGHTS).write_bytes(bytes(weights))
        (venue,) = contest_scenes(dataclasses.replace(contest, policy=name or str(other)))
        stems.add(rows._stem(venue, "dense"))
    assert len(stems) == 3


def test_everything_that_the_navigator_sees_goes_through_the_other_camera(contest, monkeypatch):
    (clean,), (venue,) = (contest_scenes(dataclasses.replace(contest, domain=name)) for name in ("clean", "camera"))
    journeys, rng = venue.episodes, np.random.default_rng(0)
    xy, yaw = rng.uniform(-1, 1, (3, 2)), rng.uniform(-3, 3, 3)
    plain, seen = clean.camera(xy, yaw), venue.camera(xy, yaw)
    assert (seen == as_seen_from(plain, PRESETS["camera"], xy, yaw)).all() and (seen != plain).mean() > 0.5
    # Who else is looked at does not matter.
    assert (venue.camera(xy[1:2], yaw[1:2]) == seen[1:2]).all()
    navigator, looked = venue.navigator("dense"), []
    monkeypatch.setattr(navigator, "goal_nodes", lambda images, around: looked.append(images) or np.zeros(2, np.int32))
    player = NavigatorPlayer(venue.player, CONFIG, navigator, venue.camera)
    player.begin(journeys)
    goals = as_seen_from(
        clean.camera(journeys.goal_xy_w, np.zeros(2)), PRESETS["camera"], journeys.goal_xy_w, np.zeros(2)
    )
    assert looked[0].shape == (2, 6, 32, 32, 3) and (looked[0][:, 0] == goals).all()
    assert rows._stem(clean, "dense") != rows._stem(venue, "dense")


def test_a_map_collected_in_the_target_domain_is_driven_on_there(contest, made, steered, tmp_path, capsys):
    """Adapted networks, their map of images of the other camera, and the trained policy seeing through them."""
    source, adapted = load_trained(made.rooms), tmp_path / "adapted"
    moved = {**source.variables, "batch_stats": jax.tree.map(lambda x: 1.1 * x, source.variables["batch_stats"])}
    adapted.mkdir()
    about = {**source.about, "adapted_from": source.about["digest"]}
    saved = save_trained(adapted, dataclasses.replace(source, variables=moved, about=about))
    networks = ["--localiser", str(adapted), "--detector", str(made.passages)]
    maps = tmp_path / "maps"
    words = ["adapt", "map", str(made.scene), "--target", str(made.data), *networks, "-o", str(maps / "painted.npz")]
    assert main([*words, "domain=light"]) == 0
    words = ["evaluate", str(made.scene), "--contenders", "dense", "-o", str(tmp_path / "out"), "--maps", str(maps)]
    words += [*networks, "--policy", str(steered), "--domain", "light", *WORDS, "episodes=1"]
    assert main(words) == 0
    (row,) = read_rows(sorted((tmp_path / "out" / "rows").glob("*.parquet"))).to_pylist()
    assert (row["domain"], row["policy"], row["sight"]) == ("light", str(steered), "networks") and row["runs"] >= 1
    there = dataclasses.replace(contest, maps=maps, localiser=adapted, domain="light")
    (venue,) = contest_scenes(there)
    policy = venue.navigator("dense").policy
    assert policy.networks[0].about["digest"] == saved.about["digest"]  # type: ignore[attr-defined]
    # Not through others that it never met.
    saved = save_trained(adapted, dataclasses.replace(saved, about={**about, "adapted_from": "another"}))
    (venue,) = contest_scenes(there)
    with pytest.raises(FileError, match="is not the network that .* learned with"):
        local_policy(there.policy, None, there.config, venue.networks)  # type: ignore[arg-type]


def test_images_are_drawn_by_the_maps_engine_and_lens(contest, made, tmp_path):
    read = load_map(made.map)
    about = {**read.about, "data": {**read.about["data"], "engine": "gl", "fov_deg": 70.0}}
    save_map(dataclasses.replace(read, about=about), tmp_path / "painted.npz")
    (venue,), (other,) = (contest_scenes(dataclasses.replace(contest, maps=maps)) for maps in (contest.maps, tmp_path))
    assert venue.networks is not None and venue.drawn == venue.networks.camera
    assert (other.drawn.engine, other.drawn.fov_deg) == ("gl", 70.0)
    assert rows._stem(venue, "dense") != rows._stem(other, "dense")


def test_a_cpu_draws_images_at_most_twice_as_large(contest, monkeypatch):
    learned = DataConfig(width=128, height=96, supersample=5)
    assert drawn_for(learned, None) == dataclasses.replace(learned, supersample=2)
    assert drawn_for(learned, 5) == learned and drawn_for(learned, 7).supersample == 7
    assert drawn_for(dataclasses.replace(learned, supersample=1), None).supersample == 1
    (venue,) = contest_scenes(contest)
    (finer,) = contest_scenes(dataclasses.replace(contest, config=dataclasses.replace(CONFIG, supersample=2)))
    assert (venue.drawn.supersample, finer.drawn.supersample) == (1, 2)
    assert (venue.request("dense")["drawn"][-1], finer.request("dense")["drawn"][-1]) == (1, 2)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert drawn_for(learned, None) == learned


def test_a_film_shows_the_navigators_view_with_more_pixels(contest):
    venue, blurred = (contest_scenes(dataclasses.replace(contest, domain=of))[0] for of in ("clean", "blur"))
    where = venue.episodes.start_xy_w[:1], np.zeros(1)
    assert venue.film_camera is not None
    (small,), (large,) = venue.camera(*where), venue.film_camera(*where)
    assert small.shape == (32, 32, 3) and large.shape == (480, 480, 3)
    averaged = large.reshape(32, 15, 32, 15, 3).mean((1, 3))
    assert np.ptp(small) > 50 and np.abs(averaged - small).mean() < 4
    assert blurred.film_camera is blurred.camera  # its blur is in pixels
    assert ContestScene(venue.scene.path, contest, None).film_camera is None


def test_true_views_through_a_camera_with_errors_are_refused(contest):
    with pytest.raises(ConfigError, match="--domain blur is of images, --truth has none"):
        dataclasses.replace(contest, domain="blur", truth=True)
