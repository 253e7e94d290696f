"""Episode files: the same episodes for everybody, and one clear line for each way a file does not fit."""

import dataclasses
import gzip
import hashlib
import json
import shutil
import types
from pathlib import Path

import jax
import numpy as np
import pytest

import interactive_nav
from interactive_nav import episodes
from interactive_nav.episodes import EpisodeFileError
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import UserError
from scenes_mjcf.schema import load_maps, save_maps
from tests.toys import write_room


@pytest.fixture(scope="module")
def env(room, two_rooms):
    return interactive_nav.make("turtlebot", [room, two_rooms], backend="native", num_objects=3)


@pytest.fixture(scope="module")
def made(env):
    return episodes.draw_episode_file(env, 6, seed=4)


def test_round_trip_and_the_same_episodes_as_reset(env, made, tmp_path):
    path = tmp_path / "deep" / "episodes.json"
    episodes.save_episode_file(made, path)
    assert episodes.load_episode_file(path) == made
    assert len(path.read_text().splitlines()) < 60  # one line an episode
    starts = episodes.starts_of(episodes.load_episode_file(path), env)
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.PRNGKey(4), i))(np.arange(6))
    want = jax.jit(jax.vmap(env.reset))(keys)
    got = jax.jit(jax.vmap(env.reset_to))(starts, keys)
    np.testing.assert_allclose(got.pipeline_state.qpos, want.pipeline_state.qpos, atol=1e-5)
    np.testing.assert_allclose(got.info["nav"].goal_xy_w, want.info["nav"].goal_xy_w, atol=1e-6)
    lengths = [row["shortest_path_m"] for row in made.episodes]
    np.testing.assert_allclose(got.info["nav"].shortest_path_m, lengths, atol=1e-5)
    assert {0, 1} == {row["scene"] for row in made.episodes}
    # A longer file begins with the same episodes.
    assert episodes.draw_episode_file(env, 2, seed=4).episodes == made.episodes[:2]


def test_episodes_without_small_objects(room):
    bare = interactive_nav.make("turtlebot", [room], backend="native", num_objects=0)
    made = episodes.draw_episode_file(bare, 2, seed=1)
    starts = episodes.starts_of(made, bare)
    assert starts.small_placed.shape == (2, 0) and starts.small_placed.dtype == bool
    np.testing.assert_allclose(starts.goal_xy_w, [row["goal_xy_w"] for row in made.episodes], atol=1e-6)


@pytest.mark.parametrize("backend", ["jax", "warp"])
def test_the_same_file_gives_the_same_episodes_on_every_backend(env, made, room, two_rooms, backend):
    if backend == "warp":
        pytest.importorskip("warp", reason="the package warp-lang (extra 'warp') is not installed")
    other = interactive_nav.make("turtlebot", [room, two_rooms], backend=backend, num_objects=3)
    keys = jax.random.split(jax.random.PRNGKey(0), 6)
    want, got = (jax.jit(jax.vmap(e._begin))(episodes.starts_of(made, e), keys) for e in (env, other))
    assert other.backend == backend
    np.testing.assert_array_equal(got.pipeline_state.qpos, want.pipeline_state.qpos)
    for name in ("scene_index", "goal_xy_w", "shortest_path_m", "object_pos_w"):
        np.testing.assert_allclose(getattr(got.info["nav"], name), getattr(want.info["nav"], name), atol=1e-6)


def test_scenes_are_found_by_content_not_by_place(env, made, room, two_rooms):
    turned = interactive_nav.make("turtlebot", [two_rooms, room], backend="native", num_objects=3)
    starts = episodes.starts_of(made, turned)
    np.testing.assert_array_equal(starts.scene_index, [1 - row["scene"] for row in made.episodes])


def _changed(folder, copy, name, before, after):
    """A scene in a copy of the folder, in whose file `name` the text `before` has become `after`."""
    shutil.copytree(folder, copy)
    text = (copy / name).read_text()
    assert before in text
    (copy / name).write_text(text.replace(before, after))
    return load_scene(copy)


@pytest.mark.parametrize(
    ("name", "before", "after", "same"),
    [
        ("scene.xml", 'pos="0.7 0', 'pos="0.8 0', False),
        ("scene.json", '"category": "chair"', '"category": "sofa"', False),
        ("scene.xml", '<body name="chair_0"', '<!-- repainted --> <body name="chair_0"', True),
        ("scene.xml", 'name="chair_0_box_0"', 'name="chair_0_box_0" rgba="1 0 0 1"', True),
        ("scene.json", "CC0-1.0", "CC-BY-4.0", True),
    ],
)
def test_a_scenes_task_is_told_by_what_decides_it_not_by_looks(room, tmp_path, name, before, after, same):
    assert (_changed(room, tmp_path / "room", name, before, after).task_digest == load_scene(room).task_digest) is same


@pytest.mark.parametrize(
    "other",
    [
        {"blocks": (("chair", 0.7, 0.0, 5.0, 0.05),)},
        {"blocks": (("chair", 0.7, 0.0, 6.0, 0.5),)},
        {"half_m": (0.2, 0.2, 0.25)},
    ],
)
def test_friction_mass_and_size_are_part_of_the_task(room, tmp_path, other):
    assert load_scene(write_room(tmp_path / "room")).task_digest == load_scene(room).task_digest
    assert load_scene(write_room(tmp_path / "other", **other)).task_digest != load_scene(room).task_digest


def test_hulls_and_maps_are_part_of_the_task(room, tmp_path):
    source = Path(__file__).parents[2] / "scenes_mjcf" / "apartment_0"
    first = load_scene(source).task_digest
    # As it was when files with it were made: a new way to compute it needs a new prefix.
    assert first == "task-1:0abb63e83942bd5301b9ea98992b675ff87287e19d3d4155a3556927a6fcfa9d"
    shutil.copytree(source, tmp_path / "apartment_0")
    (tmp_path / "apartment_0" / "assets" / "chair_0.png").write_bytes((source / "assets" / "chair_1.png").read_bytes())
    assert load_scene(tmp_path / "apartment_0").task_digest == first
    hull = tmp_path / "apartment_0" / "assets" / "chair_0_hull_0.obj"
    hull.write_bytes((source / "assets" / "chair_1_hull_0.obj").read_bytes())
    assert load_scene(tmp_path / "apartment_0").task_digest != first
    shutil.copytree(room, tmp_path / "room")
    maps = load_maps(room)
    save_maps(dataclasses.replace(maps, traversable=maps.traversable & (np.arange(maps.traversable.shape[1]) > 5)),
              tmp_path / "room")  # fmt: skip
    assert load_scene(tmp_path / "room").task_digest != load_scene(room).task_digest


def test_less_friction_is_refused(env, made, tmp_path):
    slippery = load_scene(write_room(tmp_path / "room", blocks=(("chair", 0.7, 0.0, 5.0, 0.05),)))
    other = types.SimpleNamespace(robot=env.robot, world=env.world, tables=env.tables, config=env.config,
                                  scenes=(slippery, *env.scenes[1:]))  # fmt: skip
    with pytest.raises(EpisodeFileError, match="scene 'room' has digest .*: its content changed since"):
        episodes.starts_of(made, other)  # pyright: ignore[reportArgumentType]


def test_files_that_do_not_fit_are_refused(env, made, room):
    def refused(message, file=made, where=env):
        with pytest.raises(EpisodeFileError, match=message):
            episodes.starts_of(file, where)

    refused(
        "made for robot 'fetch' .*, the environment has robot 'turtlebot'", dataclasses.replace(made, robot="fetch")
    )
    other = tuple((name, "0" * 64) for name, _ in made.scenes)
    refused("scene 'room' has digest 000000000000, .* its content changed", dataclasses.replace(made, scenes=other))
    elsewhere = tuple((f"{name}_2", "0" * 64) for name, _ in made.scenes)
    refused("needs scene 'room_2' .* add it to --scenes", dataclasses.replace(made, scenes=elsewhere))
    refused("made with 3 small objects .* set num_objects=3", dataclasses.replace(made, objects_digest="x"))
    longer = ({**made.episodes[0], "shortest_path_m": 9.0}, *made.episodes[1:])
    refused("episode 0: shortest_path_m is 9.000 m", dataclasses.replace(made, episodes=longer))
    with pytest.raises(UserError, match="episodes is 0, expected at least 1"):
        episodes.draw_episode_file(env, 0, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(version=2), "version is 2, expected 1"),
        (lambda d: d.update(format="x"), "not an episode file"),
        (lambda d: d.pop("robot"), "missing key 'robot'"),
        (lambda d: d["episodes"][0].pop("goal_xy_w"), r"episodes\[0\]: missing key 'goal_xy_w'"),
        (
            lambda d: d["episodes"][1].update(start_yaw_rad=float("nan")),
            r"\[1\]: start_yaw_rad is NaN, expected a finite",
        ),
        (
            lambda d: d["episodes"][1].update(start_yaw_rad=10**400),
            r"\[1\]: start_yaw_rad is 10+\.\.\., expected a finite",
        ),
        (lambda d: d["episodes"][1].update(scene=7), r"episodes\[1\] is in scene 7 with 3 objects, expected one of 2"),
        (lambda d: d["episodes"][1].update(scene=0.5), r"episodes\[1\]: scene is 0.5, expected a whole number"),
        (lambda d: d["episodes"][1].update(start_xy_w=[1.0]), r"start_xy_w is \[1.0\], expected a list of 2"),
        (lambda d: d.update(episodes=[]), "episodes is \\[\\], expected at least one"),
        (lambda d: d.update(seed=float("inf")), "seed is Infinity, expected a finite number"),
        (lambda d: d.update(objects=[["chair"]] * 3), r"objects\[0\] is \[\"chair\"\], expected a string"),
    ],
)
def test_damaged_files_are_named(made, tmp_path, change, message):
    path = tmp_path / "episodes.json"
    episodes.save_episode_file(made, path)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(EpisodeFileError, match=message):
        episodes.load_episode_file(path)


def test_several_files_are_one(env, made, room, tmp_path):
    """Scenes of both, once each; every row keeps its scene."""
    alone = interactive_nav.make("turtlebot", [room], backend="native", num_objects=3)
    second = episodes.draw_episode_file(alone, 2, seed=9)
    for name, file in (("a", made), ("b", second)):
        episodes.save_episode_file(file, tmp_path / f"{name}.json")
    both, digest = episodes.load_episode_files([tmp_path / "b.json", tmp_path / "a.json"])
    assert [name for name, _ in both.scenes] == ["room", "two_rooms"] and len(both.episodes) == 8
    starts = episodes.starts_of(both, env)
    for part, rows in ((second, slice(0, 2)), (made, slice(2, 8))):
        expected = episodes.starts_of(part, env)
        np.testing.assert_array_equal(starts.scene_index[rows], expected.scene_index)
        np.testing.assert_array_equal(starts.small_xy_w[rows], expected.small_xy_w)
    one, of_one = episodes.load_episode_files([tmp_path / "a.json"])
    assert one == made and of_one == hashlib.sha256((tmp_path / "a.json").read_bytes()).hexdigest()[:16] != digest
    episodes.save_episode_file(dataclasses.replace(second, robot="fetch"), tmp_path / "c.json")
    with pytest.raises(EpisodeFileError, match=r"c.json: made for robot .fetch. with 3 small objects, "):
        episodes.load_episode_files([tmp_path / "a.json", tmp_path / "c.json"])


def test_packed_files(made, tmp_path):
    plain, packed = tmp_path / "episodes.json", tmp_path / "episodes.json.gz"
    episodes.save_episode_file(made, plain)
    episodes.save_episode_file(made, packed)
    assert episodes.load_episode_file(packed) == made and packed.stat().st_size < 0.7 * plain.stat().st_size
    assert gzip.decompress(packed.read_bytes()) == plain.read_bytes()
    again = tmp_path / "again.json.gz"
    episodes.save_episode_file(made, again)
    assert again.read_bytes() == packed.read_bytes()  # no time of day in it
    for damage in (packed.read_bytes()[:60], plain.read_bytes()):
        packed.write_bytes(damage)
        with pytest.raises(EpisodeFileError, match="not readable as packed with gzip"):
            episodes.load_episode_file(packed)


def test_the_command_line(room, tmp_path, capsys):
    out = tmp_path / "e.json"
    words = ["make", "--scenes", str(room), "--episodes", "3", "--seed", "1", "--num-objects", "2", "-o", str(out)]
    assert episodes.main(words) == 0
    assert "3 episodes in 1 scenes" in capsys.readouterr().out
    file = episodes.load_episode_file(out)
    assert (file.seed, len(file.episodes), file.objects) == (1, 3, ("basket", "shoe"))
    assert episodes.main(["make", "--scenes", str(tmp_path / "nowhere"), "-o", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("interactive_nav.episodes: ") and "no such file" in line
    with pytest.raises(EpisodeFileError, match="absent.json: no such file; make one with"):
        episodes.load_episode_file(tmp_path / "absent.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(EpisodeFileError, match="not readable as JSON"):
        episodes.load_episode_file(tmp_path / "bad.json")
