"""The stage cache: equal content is found again, anything else is computed; damage and limits."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest

from converters.geometry.boxes import Hull, OrientedBox
from converters.records.raw import RawScene, ScanMesh
from interactive_nav_common.jobs import cache
from interactive_nav_common.jobs.cache import KEEP_S, LIMIT_BYTES, StageCache, fingerprint, prune

CALLS: list[tuple] = []


def stage(points: np.ndarray, scale: float, extra=None):
    """Returns every kind of value that a stage may."""
    CALLS.append((points, scale))
    hull = Hull(points * scale, np.array([[0, 1, 2]]))
    values = [1, 2.5, np.float64(0.1) + 0.2, None, "text", True]
    return hull, values, (OrientedBox(points[0], np.eye(3), points[1]),), float("nan")


@pytest.fixture(autouse=True)
def no_calls():
    CALLS.clear()


POINTS = np.arange(9.0).reshape(3, 3)


def test_the_second_call_is_read_and_is_the_same(tmp_path):
    first = StageCache(tmp_path).call(stage, POINTS, 2.0)
    second = StageCache(tmp_path).call(stage, POINTS.copy(), 2.0)
    assert len(CALLS) == 1
    assert isinstance(second[0], Hull) and isinstance(second[2][0], OrientedBox)
    np.testing.assert_array_equal(second[0].vertices, first[0].vertices)
    assert second[0].faces.dtype == first[0].faces.dtype and second[1] == first[1] and np.isnan(second[3])
    assert all(type(a) is type(b) for a, b in zip(second[1], first[1], strict=True))
    assert [p.name[:6] for p in tmp_path.iterdir()] == ["stage-"]


@pytest.mark.parametrize(
    "arguments",
    [
        (POINTS + 1e-12, 2.0),
        (POINTS.astype(np.float32), 2.0),
        (POINTS.reshape(1, 9)[:, :9].reshape(3, 3).T.copy(), 2.0),
        (POINTS, 2),
        (POINTS, 2.0, "extra"),
        (POINTS, 2.0, [1, 2]),
        (POINTS, 2.0, {"a": POINTS}),
        (POINTS, 2.0, Hull(POINTS, POINTS)),
    ],
)
def test_any_difference_is_computed(tmp_path, arguments):
    store = StageCache(tmp_path)
    store.call(stage, POINTS, 2.0)
    store.call(stage, *arguments)
    assert len(CALLS) == 2


def test_names_and_reports_do_not_count(tmp_path):
    scan = ScanMesh(POINTS, np.array([[0, 1, 2]]), labels=np.zeros(3, int))
    raw = RawScene("a", "gibson", scan, "mine", {"x": "y"}, floor_height_m=0.0)
    store = StageCache(tmp_path)
    store.call(stage, POINTS, 1.0, raw)
    store.call(stage, POINTS, 1.0, dataclasses.replace(raw, name="b", licence="", warnings=("w",), sources={}))
    assert len(CALLS) == 1
    store.call(stage, POINTS, 1.0, dataclasses.replace(raw, floor_height_m=0.1))
    assert len(CALLS) == 2


def test_another_version_of_the_code_computes_again(tmp_path, monkeypatch):
    StageCache(tmp_path).call(stage, POINTS, 2.0)
    monkeypatch.setattr(cache, "fingerprint", lambda module: "newer")
    StageCache(tmp_path).call(stage, POINTS, 2.0)
    assert len(CALLS) == 2


@pytest.mark.parametrize("damage", [lambda b: b[:50], lambda b: b"", lambda b: b[:-40] + b"x" * 40])
def test_a_damaged_entry_is_made_again(tmp_path, damage):
    StageCache(tmp_path).call(stage, POINTS, 2.0)
    (entry,) = tmp_path.iterdir()
    good = entry.read_bytes()
    entry.write_bytes(damage(good))
    value = StageCache(tmp_path).call(stage, POINTS, 2.0)
    np.testing.assert_array_equal(value[0].vertices, POINTS * 2)
    assert entry.read_bytes() == good


def test_the_oldest_entries_go_first(tmp_path):
    for k in range(5):
        path = tmp_path / f"{k}.pkl"
        path.write_bytes(b"x" * 100)
        os.utime(path, (k, k))
    prune(tmp_path, 250, KEEP_S + 5.0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["3.pkl", "4.pkl"]


def test_what_was_used_within_the_hour_stays_whatever_its_size(tmp_path):
    now = 10_000.0
    for name, age_s in (("in_use", 5.0), ("unused", KEEP_S + 5.0), (".partial-01234567-new", 5.0)):
        (tmp_path / f"{name}.pkl").write_bytes(b"x" * 100)
        os.utime(tmp_path / f"{name}.pkl", (now - age_s, now - age_s))
    prune(tmp_path, 0, now)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".partial-01234567-new.pkl", "in_use.pkl"]


def test_what_a_killed_writer_left_goes_though_there_is_room(tmp_path):
    for name in (".partial-01234567-stage.pkl", "stage.pkl"):
        (tmp_path / name).write_bytes(b"x")
        os.utime(tmp_path / name, (0, 0))
    prune(tmp_path, LIMIT_BYTES, KEEP_S + 1.0)
    assert [p.name for p in tmp_path.iterdir()] == ["stage.pkl"]


def test_an_entry_that_vanishes_while_it_is_read_is_computed(tmp_path, monkeypatch):
    StageCache(tmp_path).call(stage, POINTS, 2.0)

    def gone(path):
        path.unlink()
        raise FileNotFoundError(path)

    monkeypatch.setattr(cache.joblib, "load", gone)
    StageCache(tmp_path).call(stage, POINTS, 2.0)
    assert len(CALLS) == 2 and len(list(tmp_path.iterdir())) == 1


def test_used_entries_are_marked(tmp_path):
    StageCache(tmp_path).call(stage, POINTS, 2.0)
    (entry,) = tmp_path.iterdir()
    os.utime(entry, (0, 0))
    StageCache(tmp_path).call(stage, POINTS, 2.0)
    assert len(CALLS) == 1 and entry.stat().st_mtime > 0
    os.utime(entry, (0, 0))
    StageCache(tmp_path, limit_bytes=0).call(stage, POINTS, 3.0)
    assert entry not in tmp_path.iterdir()


def test_the_fingerprint_follows_the_module_its_table_and_what_it_imports(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "ROOT", tmp_path)
    for name in ("cut", "boxes", "faces", "other"):
        (tmp_path / "converters" / "mesh").mkdir(parents=True, exist_ok=True)
        (tmp_path / "converters" / "mesh" / f"{name}.py").write_text("a = 1")
    folder = tmp_path / "converters" / "mesh"

    def digest() -> str:
        fingerprint.cache_clear()
        return fingerprint("converters.mesh.cut")

    digests = [digest()]
    for name, text in (
        ("cut.py", "def f():\n    from converters.mesh import boxes"),
        ("boxes.py", "from converters.mesh.faces import a"),
        ("faces.py", "a = 2"),
        ("cut.yaml", "- 1"),
    ):
        (folder / name).write_text(text)
        digests.append(digest())
    (folder / "other.py").write_text("a = 2")
    assert len(set(digests)) == 5 and digest() == digests[-1]
    fingerprint.cache_clear()


def square(x):
    return x * x


def test_many_calls_are_computed_once_each_and_what_is_there_is_read(tmp_path, monkeypatch, capsys):
    store = StageCache(tmp_path)
    store.call(square, 3)
    asked = []
    compute = cache._labelled
    monkeypatch.setattr(cache, "LEAST_EACH", 100)  # one process: this one
    monkeypatch.setattr(cache, "_labelled", lambda key, *rest: asked.append(rest[1]) or compute(key, *rest))
    assert store.call_many(square, [(2,), (3,), (2,), (5,)], "squares") == [4, 9, 4, 25]
    assert asked == [(2,), (5,)] and "squares: 2 of 2" in capsys.readouterr().err
    assert store.call_many(square, [(5,), (2,)], "squares") == [25, 4] and len(asked) == 2
    assert capsys.readouterr().err == ""


def test_what_is_done_before_an_error_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "LEAST_EACH", 100)
    with pytest.raises(TypeError):
        StageCache(tmp_path).call_many(square, [(2,), ("two",)], "squares")
    assert len(list(tmp_path.glob("square-*.pkl"))) == 1
