"""Files of others: none blocks, none unpacks to gigabytes, aliases of YAML repeat little."""

from __future__ import annotations

import gzip
import lzma
import os
import zlib

import numpy as np
import pytest
import yaml

from interactive_nav import episodes
from interactive_nav.scenes.objects import load_object
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.config import read_words
from interactive_nav_common.errors import ConfigError, FileError, UserError, readable
from interactive_nav_common.files import is_locked, locked
from interactive_nav_common.records import Reader, read_metrics
from interactive_nav_common.rows import read_rows
from interactive_nav_common.runs.weights import read_weights
from interactive_nav_common.untrusted import reading
from interactive_nav_common.untrusted.reading import Loader, check_named, read_npz, unpack
from tests.toys import write_room
from train import config_io

BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)
MERGE = "m0: &m0 {a: 1}\n" + "".join(f"m{k + 1}: &m{k + 1} {{<<: [{', '.join([f'*m{k}'] * 10)}]}}\n" for k in range(6))
CIRCLE = "a: &a {b: [*a]}"


@pytest.mark.parametrize("text", [BOMB, MERGE, CIRCLE])
def test_aliases_that_stand_for_much_are_refused_in_one_line(tmp_path, text):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"c.yaml: not readable as YAML .*aliases repeat") as refused:
        config_io.load_config(str(tmp_path / "c.yaml"))
    assert len(str(refused.value)) < 400 and "\n" not in str(refused.value)


def test_a_few_anchors_mean_what_yaml_says():
    text = "base: &base {a: 1, b: [2, 3]}\nmine: {<<: *base, a: 4}\nseeds: [&s 5, *s]\n"
    mine = {"base": {"a": 1, "b": [2, 3]}, "mine": {"a": 4, "b": [2, 3]}, "seeds": [5, 5]}
    assert yaml.load(text, Loader) == yaml.safe_load(text) == mine
    assert read_words(["x=[&a 1, *a]"]) == {"x": [1, 1]}


@pytest.mark.parametrize(("kind", "packed"), [("gzip", gzip.compress), ("zlib", zlib.compress), ("xz", lzma.compress)])
def test_unpacking_ends_at_a_bound(monkeypatch, kind, packed):
    monkeypatch.setattr(reading, "MOST_TEXT", 2**20)
    assert unpack(packed(b"abc" * 1000), kind) == b"abc" * 1000
    with pytest.raises(ValueError, match="packed with .*: cut short"):
        unpack(packed(os.urandom(999))[:-9], kind)
    with pytest.raises(ValueError, match=f"not readable as packed with {kind}"):
        unpack(b"no such thing", kind)
    with pytest.raises(ValueError, match="more than 1 MiB"):
        unpack(packed(bytes(2**20 + 1)), kind)


def test_a_large_archive_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MOST_ARRAYS", 2**24)
    np.savez_compressed(tmp_path / "maps.npz", a=np.zeros(2**24, np.uint8))
    bomb = read_npz(tmp_path / "maps.npz", FileError, "make it again")
    with pytest.raises(FileError, match=r"maps.npz: not readable .*unpacks to 16 MiB, expected at most 16"), bomb:
        pytest.fail("opened")
    np.savez_compressed(tmp_path / "good.npz", a=np.zeros(10_000_000, np.uint8))
    with read_npz(tmp_path / "good.npz", FileError, "make it again") as arrays:
        assert arrays["a"].shape == (10_000_000,)


def test_bombs_in_the_files_of_runs_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MOST_TEXT", 2**20)
    bomb = gzip.compress(b" " * (2**20 + 1))
    for name in ("e.json.gz", "metrics.jsonl.gz"):
        (tmp_path / name).write_bytes(bomb)
    with pytest.raises(UserError, match="e.json.gz: not readable .*it unpacks to more than 1 MiB.*; make one with"):
        episodes.load_episode_file(tmp_path / "e.json.gz")
    with pytest.raises(FileError, match="unpacks to more than 1 MiB"):
        read_metrics(tmp_path / "metrics.jsonl.gz")
    (tmp_path / "weights.safetensors.xz").write_bytes(lzma.compress(bytes(2**20 + 1)))
    with pytest.raises(UserError, match=r"weights.safetensors.xz: not readable .*unpacks to more than 1 MiB"):
        read_weights(tmp_path / "weights.safetensors.xz", FileError, "make it again")


@pytest.mark.parametrize("special", ["fifo", "zero"])
def test_what_is_no_regular_file_is_not_opened(tmp_path, special):
    path = tmp_path / "a.yaml"
    os.mkfifo(path) if special == "fifo" else path.symlink_to("/dev/zero")
    (tmp_path / "b.parquet").symlink_to(path)
    (tmp_path / "c.json.gz").symlink_to(path)
    reads = [
        lambda: Reader(FileError, "make it again").json(path),
        lambda: config_io.load_config(str(path)),
        lambda: read_rows([tmp_path / "b.parquet"]),
        lambda: episodes.load_episode_file(tmp_path / "c.json.gz"),
        lambda: read_metrics(path),
        lambda: is_locked(path),
    ]
    for read in reads:
        with pytest.raises(UserError, match="no regular file but a FIFO, socket or device"):
            read()
    with pytest.raises(FileError, match="no regular file"), readable(path, FileError, "make it again"):
        pytest.fail("opened")


def test_a_scene_that_names_a_device_is_refused(tmp_path):
    room = write_room(tmp_path / "room")
    os.mkfifo(room / "assets" / "pipe.obj")
    xml = (room / "scene.xml").read_text()
    for named in ("assets/pipe.obj", "/dev/zero"):
        (room / "scene.xml").write_text(
            xml.replace("<worldbody", f"<asset><mesh file='{named}'/></asset><worldbody", 1)
        )
        with pytest.raises(UserError, match="no regular file but a FIFO, socket or device"):
            load_scene(room)
    (tmp_path / "one.xml").write_text("<mujoco><compiler meshdir='room'/><include file='two.xml'/></mujoco>")
    (tmp_path / "two.xml").write_text("<mujoco><asset><hfield file='assets/pipe.obj'/></asset></mujoco>")
    with pytest.raises(FileError, match="pipe.obj: not readable .*no regular file"):
        check_named(tmp_path / "one.xml", FileError, "convert it again")


def test_an_object_that_names_a_device_is_refused(tmp_path):
    about = '{"name": "a", "category": "chair", "friction": 0.5}'
    (tmp_path / "object.json").write_text(about)
    (tmp_path / "object.xml").write_text("<mujoco><asset><texture fileup='/dev/zero'/></asset></mujoco>")
    with pytest.raises(UserError, match="/dev/zero: not readable .*no regular file"):
        load_object(tmp_path)


def test_a_lock_that_is_a_link_does_not_overwrite_where_it_leads(tmp_path):
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "lock").symlink_to(tmp_path / "precious")
    with pytest.raises(FileError, match="lock: cannot be opened"), locked(tmp_path / "lock", "busy"):
        pytest.fail("locked")
    assert (tmp_path / "precious").read_text() == "mine"
