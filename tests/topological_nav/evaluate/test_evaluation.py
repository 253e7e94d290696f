"""Bookkeeping of episodes by hand, then the whole machinery in simulation with the truth in the place of networks."""

import dataclasses
import importlib.util
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

import interactive_nav
from interactive_nav.scenes.scene import load_scene
from interactive_nav.task.rollout import Player, episode_keys
from interactive_nav_common.config import replace
from interactive_nav_common.errors import ConfigError, FileError
from interactive_nav_common.rows import read_rows
from tests.topological_nav.maps.test_sight import two_rooms_space
from tests.toys import write_room
from topological_nav.__main__ import main
from topological_nav.config import EvaluationConfig
from topological_nav.evaluate import contest as contests
from topological_nav.evaluate.contest import Contest, ContestScene, _stem, contest_scenes, play_contest
from topological_nav.evaluate.evaluation import Contender, DrivenEpisodes, blocking, count_of, draw_episodes, learned
from topological_nav.navigate.navigator import Events
from topological_nav.scenes.rendering import Snapshot, episode_starts
from topological_nav.scenes.space import RECORDED, find_rooms
from topological_nav.weights import export as packaged
from train.config import EnvConfig, TrainConfig
from train.config_io import to_yaml
from train.runs.run_folder import RunFolder
from train.scoring.policies import make_follower

APARTMENT = "scenes_mjcf/apartment_0"


class Rails:
    """A player of robots on a line: each drives 0.2 m per step and touches objects in the given steps."""

    def __init__(self):
        world = SimpleNamespace(small_objects=())
        self.env = SimpleNamespace(dt=0.1, world=world, strew=abs)

    def rollout(self, policy, keys, starts, fewest, on_progress):
        episode = np.arange(len(keys))
        x, over = np.asarray(starts.start_xy_w, float)[:, 0], np.zeros(len(keys), bool)
        for step in range(1000):
            if over.all():
                break
            ahead, ends = policy.act((x, step, episode), episode, ~over, step)
            x, over = x + ahead * ~over, over | ends
            on_progress(int(over.sum()), step)


class Line(Contender):
    """Runs of 1 s (ten steps) with a pause of 0.5 s between them, in which it turns on the spot."""

    def __init__(self, config, touches=None, arrives=None):
        super().__init__(Rails(), config)  # type: ignore[arg-type]
        self._touches, self._arrives = touches or {}, arrives or {}

    def look(self, state):
        x, step, number = state
        movable = np.array([step in self._touches.get(int(n), ()) for n in number])
        none = np.zeros(len(x), bool)
        return Snapshot(np.stack([x, 0 * x], -1), 0 * x, 0.2 * step + 0 * x, movable, none, np.zeros((len(x), 7)), none)

    def step(self, state, now, running, step):
        x, _, number = state
        at, none = step % 15, np.zeros(len(x), bool)
        arrived = np.array([self._arrives.get(int(n)) == step for n in number])
        events = Events(
            localised=arrived, glanced=none, lost=none, blocked=none, arrived=arrived,
            run_started=none | (at == 0), run_ended=none | (at == 10), timed_out=none | (step >= 60),
        )  # fmt: skip
        return 0.2 * (at < 10), events


def line_journeys(goals) -> DrivenEpisodes:
    n = len(goals)
    goal = np.stack([np.array(goals, float), np.zeros(n)], -1)
    zero = np.zeros(n)
    return DrivenEpisodes(np.arange(n), np.zeros((n, 2)), zero, goal, zero, zero + 1, np.array(goals, float), goal)


def test_an_episode_is_won_where_a_run_ends_near_the_goal():
    # Runs end at steps 10, 25, 40, 55, at x = 2, 4, 6, 8.
    config = EvaluationConfig.of(run_s=1.0, success_m=1.5)
    found = Line(config).play(line_journeys([2.0, 3.0, 5.49, 5.51, 30.0]))
    assert found.success.tolist() == [True, True, True, True, False]
    # 3 m: 1 m away at the end of the first run. 5.49: 1.49 m away after the second; 5.51: only after the third.
    assert found.duration_s.tolist() == pytest.approx([1.0, 1.0, 2.5, 4.0, 6.0])
    assert found.runs.tolist() == [1, 1, 2, 3, 4]
    assert found.goal_m.tolist() == pytest.approx([0.0, 1.0, 1.49, 0.49, 22.0])
    assert not found.arrived.any() and found.path_m[:2].tolist() == pytest.approx([2.0, 2.0])
    assert [len(t) for t in found.track_w[:2]] == [4, 4]
    assert found.track_w[0][-1].tolist() == pytest.approx([2.0, 0.0])


def test_contacts_count_by_runs_and_by_seconds():
    # State k is seen after k steps. Run 1: steps 1 to 10, run 2: 16 to 25; 11 to 15 turn on the spot.
    touches = {0: {3, 4, 9}, 1: {12, 13}, 2: {10, 16}, 3: {11}}
    found = Line(EvaluationConfig.of(run_s=1.0), touches).play(line_journeys([4.9] * 4))
    assert found.duration_s.tolist() == pytest.approx([2.5] * 4) and found.runs.tolist() == [2] * 4
    assert found.contact_runs.tolist() == [1, 0, 2, 0]
    assert found.contact_s.tolist() == pytest.approx([0.3, 0.2, 0.2, 0.1])


def test_a_run_that_its_episode_cuts_short_counts():
    found = Line(EvaluationConfig.of(run_s=1.0), {0: {2}}, {0: 4, 1: 12}).play(line_journeys([9.0, 9.0]))
    assert found.success.tolist() == [True, True] and found.arrived.tolist() == [True, True]
    assert found.runs.tolist() == [1, 1] and found.contact_runs.tolist() == [1, 0]
    assert found.localisations.tolist() == [1, 1] and found.duration_s.tolist() == pytest.approx([0.4, 1.2])


def test_scenes_have_episodes_by_their_area():
    def of(area):
        scene = type("S", (), {"manifest": type("M", (), {"floor_area_m2": area})})
        return count_of(scene, EvaluationConfig())  # type: ignore[arg-type]

    assert [of(33.2), of(79.9), of(145.3)] == [25, 40, 60]
    assert count_of(None, EvaluationConfig.of(episodes=7)) == 7  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def rooms():
    space = two_rooms_space()
    return space, find_rooms(space, "kmeans", 2, None, 0, 0.2)


def test_episodes_lead_from_room_to_room_and_are_fixed(rooms):
    space, labels = rooms
    config = EvaluationConfig.of(seed=3)
    found = draw_episodes("ab" * 32, space, labels, 20, config)
    assert (found.start_room != found.goal_room).all() and found.number.tolist() == list(range(20))
    assert (np.linalg.norm(found.start_xy_w - found.goal_xy_w, axis=1) > 2.5).all()
    assert (space.at(found.start_xy_w) >= 0.35).all() and (space.at(found.goal_xy_w) >= 0.35).all()
    fewer = draw_episodes("ab" * 32, space, labels, 5, config)
    assert (fewer.start_xy_w == found.start_xy_w[:5]).all() and (fewer.yaw_rad == found.yaw_rad[:5]).all()
    assert (draw_episodes("ab" * 32, space, labels, 5, EvaluationConfig.of(seed=4)).yaw_rad != fewer.yaw_rad).any()
    assert (draw_episodes("cd" * 32, space, labels, 5, config).yaw_rad != fewer.yaw_rad).any()


def test_the_narrowest_place_of_a_path_is_the_doorway_and_the_widest_object_stands_there(rooms):
    space, labels = rooms
    found = draw_episodes("ab" * 32, space, labels, 12, EvaluationConfig())
    # The doorway is at x = 0, y from 1 to 2; paths through it keep 0.25 m from the corner at y = 1.
    far = np.minimum(*(np.linalg.norm(found.narrow_xy_w - end, axis=1) for end in (found.start_xy_w, found.goal_xy_w)))
    assert (space.at(found.narrow_xy_w) >= 0.25).all() and far.max() > 1.0
    beside = np.abs(found.start_xy_w[:, 0]) + np.abs(found.goal_xy_w[:, 0]) > 4.0  # both ends are far from the doorway
    assert (
        beside.any() and (np.abs(found.narrow_xy_w[beside, 0]) < 0.4).all() and (found.narrow_xy_w[beside, 1] > 1).all()
    )
    starts = episode_starts(found.start_xy_w, found.yaw_rad, found.goal_xy_w, 3)
    blocked = blocking(starts, found, [0.1, 0.3, 0.2])
    assert blocked.small_placed.tolist() == [[False, True, False]] * 12
    assert np.asarray(blocked.small_xy_w[:, 1]) == pytest.approx(found.narrow_xy_w, abs=1e-6)
    with pytest.raises(ConfigError, match="blocked=true needs a small object to block the way with; set objects=1"):
        Contest((Path(APARTMENT),), ("expert",), Path("out"), EvaluationConfig.of(blocked=True))


def test_the_shortest_way_is_as_long_as_over_eight_neighbours_or_shorter(rooms):
    space, labels = rooms
    found = draw_episodes("ab" * 32, space, labels, 6, EvaluationConfig())
    free = space.clearance_m >= 0.25
    index = np.arange(free.size).reshape(free.shape)
    a, b, w = [], [], []
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one = np.argwhere(free)
        two = one + [dr, dc]
        ok = ((two >= 0) & (two < free.shape)).all(1)
        one, two = one[ok], two[ok]
        ok = free[two[:, 0], two[:, 1]]
        a.append(index[tuple(one[ok].T)])
        b.append(index[tuple(two[ok].T)])
        w.append(np.full(ok.sum(), np.hypot(dr, dc) * space.resolution_m))
    graph = csr_array((np.concatenate(w), (np.concatenate(a), np.concatenate(b))), shape=(free.size,) * 2)

    def cell(xy):
        column, row = np.floor((xy - space.origin_w) / space.resolution_m).astype(int)
        return index[row, column]

    for start, goal, shortest in zip(found.start_xy_w, found.goal_xy_w, found.shortest_m, strict=True):
        eight = dijkstra(graph, directed=False, indices=cell(start))[cell(goal)]
        straight = np.linalg.norm(start - goal)
        # Of 16 directions, but round no corner that a diagonal would cut.
        assert straight <= shortest <= eight * 1.01 and eight <= shortest * 1.0824


def test_a_scene_without_such_episodes_is_refused(rooms):
    space, labels = rooms
    with pytest.raises(ConfigError, match="0 of 3 episodes .* more than 50.0 m apart"):
        draw_episodes("ab" * 32, space, labels, 3, EvaluationConfig.of(min_goal_m=50.0))


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """Two rooms of 3 x 4 m joined by a gap of 1 m, nothing in them; their plan is recorded."""
    folder = write_room(tmp_path_factory.mktemp("evaluated") / "toy", (6.0, 4.0), (), partition=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(RECORDED, load_scene(folder).digest, ((-3.0, -2.0, -0.05, 2.0), (0.05, -2.0, 3.0, 2.0)))
        yield folder


def held(toy, out, **settings):
    config = EvaluationConfig.of(**{"backend": "native", "episodes": 4, "limit_s": 300.0, "batch": 4, **settings})
    return Contest((toy,), ("dense", "expert"), out, config, truth=True)


def numbers(rows: pa.Table) -> dict[str, np.ndarray]:
    """What must be the same when the same is played again."""
    return {field.name: rows[field.name].to_numpy() for field in rows.schema if pa.types.is_floating(field.type)}


@pytest.fixture(scope="module")
def first(toy, tmp_path_factory):
    """The toy's contest, played in one go."""
    contest = held(toy, tmp_path_factory.mktemp("first"))
    scenes = contest_scenes(contest)
    return contest, scenes, play_contest(contest, scenes)


def test_with_true_sight_the_navigator_finds_the_other_room(first):
    *_, rows = first
    by = {name: [r for r in rows.to_pylist() if r["contender"] == name] for name in ("dense", "expert")}
    assert [r["success"] for r in by["dense"]] == [1.0] * 4 and [r["success"] for r in by["expert"]] == [1.0] * 4
    assert [r["start_x_w"] for r in by["dense"]] == [r["start_x_w"] for r in by["expert"]]
    assert np.mean([r["spl"] for r in by["expert"]]) > 0.9
    assert all(r["sight"] == "truth" and r["localisations"] >= 1 and r["runs"] >= 1 for r in by["dense"])
    assert all(r["within"] for r in by["expert"]) and not any(r["broken"] for r in rows.to_pylist())


def test_the_contest_is_won_as_before(first):
    """Golden numbers of the loop that played before `rollout` did, on C MuJoCo."""
    *_, rows = first
    by = {name: [r for r in rows.to_pylist() if r["contender"] == name] for name in ("dense", "expert")}
    assert [r["duration_s"] for r in by["dense"]] == pytest.approx([32.8, 49.7, 35.8, 97.7], abs=0.11)
    assert [r["path_m"] for r in by["dense"]] == pytest.approx([3.1453, 7.5912, 4.5799, 14.6799], abs=2e-3)
    assert [r["goal_m"] for r in by["dense"]] == pytest.approx([1.4132, 0.7745, 1.0009, 0.3713], abs=2e-3)
    assert [(r["runs"], r["localisations"]) for r in by["dense"]] == [(2, 1), (5, 1), (3, 1), (11, 1)]
    assert [r["path_m"] for r in by["expert"]] == pytest.approx([3.7638, 5.6447, 5.3205, 5.0502], abs=2e-3)
    assert [(r["runs"], r["duration_s"]) for r in by["expert"]] == [(2, 10.0), (3, 15.0), (3, 15.0), (3, 15.0)]


@pytest.mark.heavy
def test_who_else_is_in_the_batch_does_not_matter_and_a_stopped_contest_goes_on(first, toy, tmp_path):
    contest, scenes, expected = first
    other = dataclasses.replace(contest, out=tmp_path, config=dataclasses.replace(contest.config, batch=2))

    class Enough(Exception):
        pass

    def stop(what, done, total):
        if done >= 3:
            raise Enough

    with pytest.raises(Enough):
        play_contest(other, scenes, stop)
    kept = sorted((tmp_path / "rows").glob("*.parquet"))
    assert 2 <= len(read_rows(kept)) < 8  # whole batches only
    times = {path: path.stat().st_mtime_ns for path in kept}
    told = []
    rows = play_contest(other, scenes, lambda what, done, total: told.append((done, total)))
    assert told[0][0] >= len(read_rows(kept)) and told[-1] == (8, 8)
    assert {path: path.stat().st_mtime_ns for path in kept} == times
    ours, theirs = numbers(rows), numbers(expected)
    for name in set(ours) - {"wall_s"}:
        # What is compiled for another size of batch rounds differently.
        assert ours[name] == pytest.approx(theirs[name], abs=1e-3), name
    assert rows.select(["runs", "localisations", "episode", "contender"]).equals(
        expected.select(["runs", "localisations", "episode", "contender"])
    )
    assert play_contest(other, scenes, lambda *_: pytest.fail("played again")).equals(rows)


def test_another_question_is_played_anew(first, toy, tmp_path):
    contest, (venue,), _ = first
    names = {_stem(venue, "dense")}
    for change in ({"seed": 1}, {"passable": 0.6}, {"thinned": 0.9}):
        changed = dataclasses.replace(contest, config=replace(contest.config, **change))
        names.add(_stem(ContestScene(toy, changed, None), "dense"))
    names.add(_stem(venue, "sparse"))
    assert len(names) == 5
    bigger = dataclasses.replace(contest, config=dataclasses.replace(contest.config, batch=1, episodes=9))
    assert _stem(ContestScene(toy, bigger, None), "dense") in names


def test_the_commands_draw_and_tell(first, toy, capsys, tmp_path):
    contest, _, rows = first
    words = ["episodes=4", "limit_s=300", "backend=native", "batch=4", "--truth"]
    assert main(["evaluate", str(toy), "--contenders", "dense,expert", "-o", str(contest.out), *words]) == 0
    told = capsys.readouterr().out
    assert "8 episodes; tables in summary.md" in told and "dense" in told
    assert "| expert | toy | 4 | 1.00 [0.51, 1.00] |" in (contest.out / "summary.md").read_text()
    assert (contest.out / "toy.png").stat().st_size > 20_000
    out, film = tmp_path / "one.png", tmp_path / "one.mp4"
    words.remove("batch=4")
    assert main(["navigate", str(toy), "--episode", "2", "-o", str(out), "--video", str(film), *words]) == 0
    told = capsys.readouterr().out
    row = next(r for r in rows.to_pylist() if r["contender"] == "dense" and r["episode"] == 2)
    assert f"reached the goal after {row['duration_s']:.0f} s and {row['path_m']:.1f} m" in told
    assert "looked about: at node" in told and "drives" in told
    assert out.stat().st_size > 20_000 and film.stat().st_size > 5_000
    assert film.read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["evaluate", "nowhere", "--contenders", "dens"], "contender is 'dens', expected a choice from dense, sparse"),
        (["evaluate", "nowhere", "--contenders", "ppo"], "contender ppo needs the run folder of a trained policy"),
        (["evaluate", "nowhere", "a/nowhere"], "scenes are nowhere, nowhere, expected different names"),
        (["evaluate", "nowhere", "--truth"], "nowhere: no such file"),
        (["evaluate", "nowhere", "--localiser", "gone"], "no trained networks of passages"),
        (["evaluate", APARTMENT, "--localiser", "gone", "--detector", "gone"], "gone: holds no trained network"),
        (["evaluate", "nowhere", "--domain", "fog"], "domain is 'fog', expected one of clean, lens"),
        (["navigate", "nowhere", "--video", "a.avi"], "expected a name that ends in .mp4"),
        (["navigate", APARTMENT, "--truth", "--episode", "25"], "episode is 25, expected 0 to 24"),
    ],
)
def test_mistakes_are_one_line(words, told, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(packaged, "packaged_weights", lambda: tmp_path / "none")
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("topological_nav: ") and told in error and error.count("\n") == 1


def test_a_policy_that_learned_on_a_gpu_is_played_without_one(toy, tmp_path, monkeypatch, capsys):
    """Unless the settings themselves ask for what is not here."""
    trained = TrainConfig(env=EnvConfig.of(backend="warp"))
    RunFolder(tmp_path).config.write_text(to_yaml(trained))
    usual = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "warp" else usual(name, *a))
    monkeypatch.setattr("train.scoring.evaluation.load_policy", lambda folder, config, *_, **__: (config.env, None))
    scene = load_scene(toy)
    player, env = contests._learned(tmp_path, scene, EvaluationConfig())
    assert (player.env.backend, env.backend, env.scenes) == ("native", "native", (str(scene.path),))
    assert "trained with backend warp, which is not here; played with native" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="backend=warp needs warp-lang"):
        contests._learned(tmp_path, scene, EvaluationConfig.of(backend="warp"))


def test_a_policy_must_be_there_and_look_at_images(toy, tmp_path):
    contest = dataclasses.replace(held(toy, tmp_path), policy=str(tmp_path / "gone"))
    with pytest.raises(FileError, match="gone: holds no trained policy"):
        play_contest(contest, contest_scenes(contest))
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "policy.json").write_text("{}")
    with pytest.raises(ConfigError, match="looks at images, --truth has none"):
        contest = dataclasses.replace(contest, policy=str(tmp_path / "there"))
        play_contest(contest, contest_scenes(contest))


@pytest.mark.heavy
def test_in_a_real_home_true_sight_finds_most_goals(tmp_path):
    config = EvaluationConfig.of(backend="native", episodes=8, limit_s=600.0, batch=8)
    contest = Contest((Path(APARTMENT),), ("dense",), tmp_path, config, truth=True)
    rows = play_contest(contest, contest_scenes(contest))
    assert np.mean(rows["success"].to_numpy()) >= 0.85
    assert np.mean(rows["spl"].to_numpy()) >= 0.6
    assert np.mean(rows["within"].to_numpy()) >= 0.85
    assert load_scene(APARTMENT).split == rows["split"].to_pylist()[0]


def test_a_policy_told_the_goal_plays_the_same_episodes(first, toy):
    """By the baseline that follows waypoints, in an environment with small objects, which stay away."""
    contest, (venue,), _ = first
    env = interactive_nav.make("ttbot", [toy], control_mode="twist", backend="native", num_objects=1)
    journeys = venue.episodes
    found = learned(Player(env, {}), contest.config, make_follower(env)).play(journeys)
    assert found.success.all() and (found.goal_m < 1.5).all() and not found.localisations.any()
    # Runs follow each other: an episode lasts whole runs.
    assert found.duration_s == pytest.approx(5.0 * found.runs)
    starts = episode_starts(journeys.start_xy_w, journeys.yaw_rad, journeys.goal_xy_w, 1)
    start = jax.jit(jax.vmap(env.reset_to))(starts, episode_keys(0, journeys.number))
    assert np.abs(np.asarray(start.info["nav"].object_pos_w)[:, 0, 0]).min() > 100.0  # parked


def test_one_array_tells_what_the_state_holds():
    rng = np.random.default_rng(0)
    nav = {
        "robot_pos_w": rng.normal(size=(3, 3)),
        "yaw_rad": rng.normal(size=3),
        "robot_path_m": rng.uniform(0, 90, 3),
        "touching": np.array([[True, False, True], [False, True, False], [False, False, True]]),
        "overflow_steps": np.array([0, 2, 0], np.int32),
        "left_out_steps": np.array([0, 0, 1], np.int32),
        "crowded_steps": np.zeros(3, np.int32),
    }
    nav = {
        name: jnp.asarray(value, value.dtype if value.dtype != float else jnp.float32) for name, value in nav.items()
    }
    physics = SimpleNamespace(qpos=jnp.asarray(rng.normal(size=(3, 9)), jnp.float32))
    pose = {name: nav.pop(name) for name in ("robot_pos_w", "yaw_rad")}
    info, metrics = {"nav": SimpleNamespace(**pose, memory=nav)}, {"nonfinite": jnp.zeros(3)}
    state = SimpleNamespace(info=info, metrics=metrics, pipeline_state=physics)
    seen = Snapshot.of(state)
    assert (seen.xy_w == np.asarray(pose["robot_pos_w"])[:, :2]).all() and seen.xy_w.dtype == float
    assert (seen.yaw_rad == np.asarray(pose["yaw_rad"])).all()
    assert (seen.path_m == np.asarray(nav["robot_path_m"])).all()
    assert seen.movable.tolist() == [True, False, False]
    assert seen.wall.tolist() == [False, True, False]
    assert seen.broken.tolist() == [False, True, True]
    assert (seen.qpos == np.asarray(physics.qpos)).all()


@pytest.mark.heavy
def test_the_expert_passes_where_furniture_leaves_a_quarter_of_a_metre(tmp_path):
    """A table closes a room of maple to the expert's grid: it stood still in 18 of 60 episodes."""
    config = EvaluationConfig.of(backend="native", episodes=8, batch=8, limit_s=90.0)
    contest = Contest((Path("scenes_mjcf/maple"),), ("expert",), tmp_path, config)
    rows = play_contest(contest, contest_scenes(contest)).to_pylist()
    assert [r["success"] for r in rows] == [1.0] * 8 and min(r["path_m"] for r in rows) > 2.5
