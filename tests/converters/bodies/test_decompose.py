"""Decomposition: hulls of known shapes, the cache, and its two failures."""

from __future__ import annotations

import dataclasses

import joblib
import numpy as np
import pytest
import trimesh

from converters.bodies import decompose
from converters.bodies.decompose import DecomposeConfig, decompose_all
from converters.records.errors import StageFailed
from interactive_nav_common.jobs.cache import StageCache
from tests.converters import tiny_raw

CONFIG = DecomposeConfig()


def table() -> tuple[np.ndarray, np.ndarray]:
    mesh = tiny_raw.table_cad()
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def test_a_table_becomes_a_top_and_four_legs(hull_cache):
    hulls = decompose_all({"table": table()}, CONFIG, 1, hull_cache).hulls["table"]
    assert 5 <= len(hulls) <= CONFIG.max_convex_hull
    low = np.min([h.vertices.min(axis=0) for h in hulls], axis=0)
    high = np.max([h.vertices.max(axis=0) for h in hulls], axis=0)
    np.testing.assert_allclose([low, high], [(-0.5, -0.35, -0.3), (0.5, 0.35, 0.3)], atol=0.03)
    # 0.06 m3 of top and 4 * 0.00384 m3 of legs; voxels of the preprocessing thicken it somewhat.
    volume = sum(trimesh.Trimesh(h.vertices, h.faces).volume for h in hulls)
    assert 0.06 < volume < 0.11
    assert all(trimesh.Trimesh(h.vertices, h.faces).is_convex for h in hulls)


def test_the_cache_is_used_and_a_damaged_entry_is_made_again(tmp_path, hull_cache, monkeypatch):
    vertices, faces = table()
    first = decompose_all({"a": (vertices, faces)}, CONFIG, 1, hull_cache).hulls["a"]
    (entry,) = [
        p for p in hull_cache.glob("hulls-*.pkl") if joblib.load(p)[0].vertices.tobytes() == first[0].vertices.tobytes()
    ]
    own = tmp_path / entry.name
    own.write_bytes(entry.read_bytes()[:100])  # cut short
    made = decompose_all({"a": (vertices, faces)}, CONFIG, 1, tmp_path)
    again = made.hulls["a"]
    assert 20 < made.worker_mib < 2000
    assert own.read_bytes() == entry.read_bytes()
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)

    def no_process(*args, **kwargs):
        raise AssertionError("a cached mesh must not be decomposed")

    monkeypatch.setattr(decompose, "_job", no_process)
    there = decompose_all({"a": (vertices, faces), "b": (vertices, faces)}, CONFIG, 1, tmp_path)
    cached = there.hulls
    assert there.worker_mib == 0
    assert len(cached["a"]) == len(cached["b"]) == len(first)


def test_the_key_follows_content_and_parameters_only(tmp_path):
    vertices, faces = table()

    def key(vertices, faces, **changes):
        return StageCache(tmp_path).key(
            "hulls", decompose.WORKER, vertices, faces, dataclasses.replace(CONFIG, **changes)
        )

    assert key(vertices, faces) == key(vertices.copy(), faces.copy(), timeout_s=1.0)
    assert len({key(vertices, faces), key(vertices * 1.001, faces), key(vertices, faces, threshold=0.2)}) == 3


def test_a_failing_and_a_slow_model_get_their_convex_hull(tmp_path):
    late = decompose_all({"table": table()}, dataclasses.replace(CONFIG, timeout_s=0.0), 1, tmp_path)
    assert late.fallbacks == {"table": "coacd ran past 0 s on table"}
    (hull,) = late.hulls["table"]
    # The top, 1.0 x 0.6 x 0.1, and under it a prismatoid of 0.6 that narrows to the legs' 0.98 x 0.58.
    want = 0.06 + 0.6 / 6 * (1.0 * 0.6 + 4 * 0.99 * 0.59 + 0.98 * 0.58)
    assert trimesh.Trimesh(hull.vertices, hull.faces).volume == pytest.approx(want)
    assert list(tmp_path.iterdir()) == []  # tried again the next time


def test_a_crash_of_coacd_gets_the_convex_hull(tmp_path, monkeypatch):
    job_of = decompose._job

    def crash(key, vertices, faces, *others):
        return job_of(key, vertices, faces + 10**6, *others)

    monkeypatch.setattr(decompose, "_job", crash)  # faces of vertices that are not there
    done = decompose_all({"broken": table(), "copy": table()}, CONFIG, 1, tmp_path)
    assert (
        list(done.fallbacks) == ["broken", "copy"] and "coacd failed on broken (exit code" in done.fallbacks["broken"]
    )
    with pytest.raises(StageFailed, match="decompose: coacd failed on broken"):
        decompose_all({"broken": table()}, CONFIG, 1, tmp_path, strict=True)


def test_strictly_a_slow_model_is_an_error(tmp_path):
    with pytest.raises(StageFailed, match="coacd ran past 0 s on table"):
        decompose_all({"table": table()}, dataclasses.replace(CONFIG, timeout_s=0.0), 1, tmp_path, strict=True)


def test_a_full_disk_is_no_fault_of_the_model(tmp_path, monkeypatch):
    (tmp_path / "full.py").write_text(f"raise SystemExit({decompose.CANNOT_WRITE})")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(decompose, "WORKER", "full")
    with pytest.raises(OSError, match="cannot be written"):
        decompose_all({"table": table()}, CONFIG, 1, tmp_path)


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, hull_cache):
    (tmp_path / "file").write_text("")
    made = decompose_all({"table": table()}, CONFIG, 1, tmp_path / "file" / "cache")
    known = decompose_all({"table": table()}, CONFIG, 1, hull_cache)
    assert made.fallbacks == {} and len(made.hulls["table"]) == len(known.hulls["table"])


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(tmp_path))
    assert decompose.cache_folder() == tmp_path / "converters"
    monkeypatch.delenv("INTERACTIVE_NAV_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "x"))
    assert decompose.cache_folder() == tmp_path / "x" / "interactive_nav" / "converters"
