"""Many homes are built once, by processes, as few are built here; those that exceed the memory are refused."""

from __future__ import annotations

import hashlib

import jax
import numpy as np
import pytest

import interactive_nav
from interactive_nav.scenes import many
from interactive_nav.scenes.scene import load_scenes
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.jobs import cache
from tests.toys import write_room
from train.learners.learner import reset_envs


@pytest.fixture
def homes(tmp_path, monkeypatch):
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(tmp_path / "cache"))
    return [write_room(tmp_path / "a"), write_room(tmp_path / "b", (5.0, 3.0), (("table", 1.0, 0.5, 9.0, 0.4),))]


def make(homes):
    return interactive_nav.make("turtlebot", homes, backend="jax", num_objects=1)


def test_many_homes_are_as_few_and_are_built_once(tmp_path, homes, monkeypatch):
    few = make(homes)
    assert not (tmp_path / "cache" / "homes").exists()
    monkeypatch.setattr(many, "FEW", 1)
    built = make(homes)
    kept = sorted(path.name.partition("-")[0] for path in (tmp_path / "cache" / "homes").iterdir())
    assert kept == ["places", "places", "read_scene", "read_scene", "settle", "settle"]
    monkeypatch.setattr(cache.joblib, "Parallel", None)  # nothing is left to compute
    read = make(homes)
    for env in (built, read):
        for new, old in zip(jax.tree.leaves(env.tables), jax.tree.leaves(few.tables), strict=True):
            np.testing.assert_array_equal(new, old)
        np.testing.assert_array_equal(env.world.rest_qpos, few.world.rest_qpos)
        assert [s.task_digest for s in env.scenes] == [s.task_digest for s in few.scenes]


def test_a_home_that_has_changed_is_read_again(tmp_path, homes, monkeypatch):
    monkeypatch.setattr(many, "FEW", 1)

    def kept() -> int:
        return len(list((tmp_path / "cache" / "homes").glob("read_scene-*")))

    first = load_scenes(homes)
    assert kept() == 2
    xml = homes[1] / "scene.xml"
    xml.write_text(xml.read_text() + "\n")
    second = load_scenes(homes)
    assert second[0].digest == first[0].digest and kept() == 3
    assert second[1].digest == hashlib.sha256(xml.read_bytes() + (homes[1] / "maps.npz").read_bytes()).hexdigest()
    (homes[0] / "assets" / "new.png").write_text("")  # a mesh or texture may have changed as well
    load_scenes(homes)
    assert kept() == 4


def test_homes_and_environments_that_exceed_the_memory_are_refused(homes, monkeypatch):
    # 3 homes of 4 numbers of 4 bytes take 48 bytes: 16 each, so 40 bytes have room for 2, and two devices for all.
    monkeypatch.setattr(many, "free_bytes", lambda: 40)
    shapes = {"a": jax.ShapeDtypeStruct((3, 4), np.float32)}
    with pytest.raises(ConfigError, match=r"^3 homes take 4.8e-08 GB of each device, .* take 2 homes or fewer$"):
        many.check_device_memory("homes", 3, shapes)
    many.check_device_memory("homes", 3, shapes, devices=2)
    with pytest.raises(ConfigError, match=r"^2 homes take .* take 0 homes or fewer$"):
        make(homes)


def test_the_memory_of_environments_is_that_of_their_states(monkeypatch):
    class Large:
        def reset(self, keys):
            return jax.numpy.zeros((len(keys), 10**9))

    class Agent:
        class config:
            num_envs = 4096

    # 4 GB each, so 100 GB have room for 25; nothing is allocated to find out.
    monkeypatch.setattr(many, "free_bytes", lambda: 10**11)
    with pytest.raises(ConfigError, match=r"^4,096 environments take 1.64e\+04 GB .* take 25 environments or fewer$"):
        reset_envs(Agent(), Large(), jax.random.PRNGKey(0))  # pyright: ignore[reportArgumentType]


def test_the_free_memory_is_what_the_device_says_or_the_machines(monkeypatch):
    class Device:
        def memory_stats(self):
            return {"bytes_limit": 100, "bytes_in_use": 30}

    assert 2**28 < many.free_bytes() < 2**50
    monkeypatch.setattr(jax, "local_devices", lambda: [Device()])
    assert many.free_bytes() == 70
