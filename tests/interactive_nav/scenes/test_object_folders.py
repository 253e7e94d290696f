"""Small objects from folders: what is read, where they stand, what episodes and replays know of them."""

from __future__ import annotations

import hashlib
import json
import re
import shutil

import jax
import numpy as np
import pytest
import trimesh

import interactive_nav
from converters.single_object import ObjectConfig, convert_object
from interactive_nav import episodes
from interactive_nav.config import make_config
from interactive_nav.pictures.replay import EpisodePlayer, load_replay, save_replay
from interactive_nav.scenes.objects import Box, load_object, pick, small_objects
from interactive_nav.scenes.slots import bodies_by_name
from interactive_nav_common.errors import UserError
from scenes_mjcf.schema import SceneError


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A crate, and a ramp whose box is turned."""
    base = tmp_path_factory.mktemp("objects")
    trimesh.creation.box((0.3, 0.2, 0.1)).export(base / "toy_crate.stl")
    slab = trimesh.creation.box((0.3, 0.1, 0.02))
    slab.apply_transform(trimesh.transformations.rotation_matrix(0.5, (0, 1, 0)))
    foot = trimesh.creation.box((0.26, 0.1, 0.02)).apply_translation((0, 0, slab.bounds[0, 2] + 0.01))
    (slab + foot).export(base / "ramp.stl")
    for name, mass in (("toy_crate", 2.0), ("ramp", 0.5)):
        convert_object(base / f"{name}.stl", base / name, ObjectConfig(mass_kg=mass, timeout_s=60), base / "cache")
    return [str(base / "toy_crate"), str(base / "ramp")]


@pytest.fixture(scope="module")
def env(room, folders):
    return interactive_nav.make("turtlebot", [room], backend="native", objects=folders, num_objects=3, episode_steps=5)


def test_folders_are_dealt_in_turn_and_stand_on_the_floor(folders):
    three = small_objects(3, "train", folders)
    assert [(o.name, o.category, o.mass_kg) for o in three] == [
        ("toy_crate", "toy", 2.0), ("ramp", "other", 0.5), ("toy_crate", "toy", 2.0)]  # fmt: skip
    crate, ramp = three[:2]
    assert crate.radius_m == pytest.approx(np.hypot(0.15, 0.1), abs=0.01)
    assert crate.height_m == pytest.approx(0.1, abs=0.01)
    for obj in three:
        assert min(z for b in obj.boxes for _, _, z in b.corners_m) == pytest.approx(0.0, abs=1e-9)
    assert crate.segmentation_id == 9 and ramp.segmentation_id == 0
    assert small_objects(2, "test", ()) == pick(2, "test")


def test_a_turned_box_has_turned_corners():
    half = np.sqrt(0.5)
    turned = Box((0.0, 0.0, 1.0), (0.3, 0.1, 0.2), (half, 0.0, half, 0.0))  # a quarter about y
    assert max(z for _, _, z in turned.corners_m) == pytest.approx(1.3)
    assert max(x for x, _, _ in turned.corners_m) == pytest.approx(0.2)


def test_the_built_in_objects_keep_the_digest_of_stored_episodes():
    task = [hashlib.sha256(repr([o.task_parts for o in pick(n)]).encode()).hexdigest() for n in (10, 4)]
    assert [digest[:16] for digest in task] == ["e49911a1f2003b44", "82affa07f96cfa3a"]


def test_they_rest_where_an_episode_puts_them(env):
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    first = np.array(state.pipeline_state.qpos)
    step = jax.jit(env.step)
    for _ in range(5):
        state = step(state, np.zeros(2, np.float32))
    last = np.array(state.pipeline_state.qpos)
    for at in env.world.layout.slot_qpos[:3]:
        np.testing.assert_allclose(last[at : at + 7], first[at : at + 7], atol=3e-3)
    np.testing.assert_allclose(env.world.slots.mass_kg[0, :3], (2.0, 0.5, 2.0))
    assert env.world.slots.names[0][:3] == ("toy_small_0", "other_small_1", "toy_small_2")
    crate = env.world.models[0].body("toy_small_0")
    a, b, c = 0.3, 0.2, 0.1
    want = 2.0 / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(sorted(crate.inertia), sorted(want), rtol=0.15)


def test_episodes_know_the_objects(env, room, folders):
    file = episodes.draw_episode_file(env, 2, 0)
    assert file.objects == ("toy", "other", "toy")
    starts = episodes.starts_of(file, env)
    assert starts.small_xy_w.shape == (2, 3, 2)
    for other in ({"objects": folders[::-1]}, {"objects": folders[:1]}, {}):
        strange = interactive_nav.make("turtlebot", [room], backend="native", num_objects=3, **other)
        with pytest.raises(episodes.EpisodeFileError, match="or other models; set num_objects=3 and the same objects"):
            episodes.starts_of(file, strange)


@pytest.mark.parametrize(
    ("name", "before", "after", "same"),
    [
        ("object.xml", r'<inertial pos="0 0 [^"]*"', '<inertial pos="0 0 0.07"', False),
        ("object.xml", r'diaginertia="[^"]*"', 'diaginertia="8 16 21"', False),
        ("assets/toy_crate_hull_0.obj", r"\nv \S+ ", "\nv -0.31 ", False),
        ("object.xml", r'rgba="0.3 0.6 0.9 0.5"', 'rgba="1 0 0 1"', True),
    ],
)
def test_episodes_know_how_an_object_moves_and_not_how_it_looks(room, folders, tmp_path, name, before, after, same):
    def digest(folder):
        env = interactive_nav.make("turtlebot", [room], backend="native", objects=[str(folder)], num_objects=1)
        return episodes.draw_episode_file(env, 1, 0).objects_digest

    shutil.copytree(folders[0], tmp_path / "toy_crate")
    text = (tmp_path / "toy_crate" / name).read_text()
    changed = re.sub(before, after, text, count=1)
    assert changed != text
    (tmp_path / "toy_crate" / name).write_text(changed)
    assert (digest(tmp_path / "toy_crate") == digest(folders[0])) is same


def test_replays_draw_the_objects(env, tmp_path):
    replay = EpisodePlayer(env, lambda obs, key: jax.numpy.zeros(2)).play(jax.random.PRNGKey(1), 0)
    save_replay(replay, tmp_path / "r.npz")
    again = load_replay(tmp_path / "r.npz")
    assert again.objects == replay.objects and again.small == env.world.small_objects
    thing = bodies_by_name(env.scenes[0], again.small)["other_small_1"]
    assert thing.category == "other"
    np.testing.assert_array_equal(thing.rows, env.world.small_objects[1].rows)


def test_refusals(tmp_path, folders):
    with pytest.raises(UserError, match=r"objects is 'a/b', expected a list of object folders; write \['a/b'\]"):
        make_config(objects="a/b")
    with pytest.raises(UserError, match="small_objects is 'test', expected train, its default"):
        make_config(objects=folders, small_objects="test")
    with pytest.raises(SceneError, match="object.json: cannot be read .*made by 'python -m converters object'"):
        load_object(tmp_path)
    about = json.loads((tmp_path.parent / folders[0] / "object.json").read_text())
    (tmp_path / "object.json").write_text(json.dumps(about | {"category": "ship"}))
    (tmp_path / "object.xml").write_text("<mujoco/>")
    with pytest.raises(SceneError, match="category is 'ship', expected one of chair"):
        load_object(tmp_path)
    (tmp_path / "object.json").write_text(json.dumps(about))
    with pytest.raises(SceneError, match="no body named 'toy_crate'"):
        load_object(tmp_path)
