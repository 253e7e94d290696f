"""Conversions that go wrong: one line, the right exit code, nothing half-written; and those that are mended."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from converters import pipeline
from converters.__main__ import main
from converters.bodies import decompose
from converters.pipeline import ConvertConfig, convert
from converters.records.errors import SceneRejected, StageFailed
from interactive_nav_common.errors import FileError
from scenes_mjcf.schema import load_manifest
from tests.converters import tiny_raw

SMALL = ConvertConfig(structure_texture=64, object_texture=32)
WORDS = ("structure_texture=64", "object_texture=32")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def one_line(capsys) -> str:
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("error: ") and "Traceback" not in error
    return error


@pytest.fixture
def cached(monkeypatch, hull_cache):
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(hull_cache))
    return hull_cache


def write_cad(root: Path, mesh: trimesh.Trimesh) -> None:
    path = root / "cad/04379243/table-a/models/model_normalized.obj"
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices]
    path.write_text("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]) + "\n")


def test_an_open_non_manifold_model_with_dead_faces_converts(gibson_raw, tmp_path):
    """Half of the table's top is missing, a fin hangs on an edge, and some faces have no area."""
    table = tiny_raw.table_cad()
    faces = np.vstack([table.faces[2:], [[0, 1, 20], [0, 1, 21], [0, 1, 22], [5, 5, 6]]])
    write_cad(gibson_raw, trimesh.Trimesh(table.vertices, faces, process=False))
    converted = convert(gibson_raw, tmp_path / "out", SMALL, cache=tmp_path / "cache")
    manifest = load_manifest(tmp_path / "out")
    assert [o.name for o in manifest.objects] == ["table_0", "basket_0"]
    assert any("is not manifold" in w for w in manifest.warnings)
    assert manifest.collision["convex_hull_only"] == []
    assert {g.name for g in converted.gates if not g.passed} == set()


def test_coacd_failing_on_one_object(gibson_raw, tmp_path, monkeypatch):
    job_of = decompose._job

    def crash(key, vertices, faces, *others):
        table = np.ptp(vertices[:, 0]) == 1.0  # the basket is narrower
        return job_of(key, vertices, faces + 10**6 * table, *others)

    monkeypatch.setattr(decompose, "_job", crash)
    convert(gibson_raw, tmp_path / "out", SMALL, cache=tmp_path / "cache")
    manifest = load_manifest(tmp_path / "out")
    assert manifest.collision["convex_hull_only"] == ["table-a"]
    assert {o.name: o.n_hulls for o in manifest.objects} == {"table_0": 1, "basket_0": 1}
    warning, gate = manifest.warnings
    assert warning.startswith("coacd failed on table-a") and warning.endswith("its convex hull stands for it")
    assert gate == "unseen_hulls: table_0 is worst"  # a robot does not get below its top
    config = ConvertConfig(structure_texture=64, object_texture=32, strict=True)
    with pytest.raises(StageFailed, match="coacd failed on table-a"):
        convert(gibson_raw, tmp_path / "strict", config, cache=tmp_path / "cache")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cache", "gibson", "out"]


def test_the_timeout_is_an_option(gibson_raw, tmp_path, monkeypatch):
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(tmp_path / "cache"))
    source, out = str(gibson_raw), tmp_path / "out"
    assert main(["convert", source, str(out), "--timeout", "0.001", "--strict", *WORDS]) == 2
    assert not out.exists()
    assert main(["convert", source, str(out), "--timeout", "0.001", *WORDS]) == 1  # the gate on what is hit unseen
    assert not load_manifest(out).gates["unseen_hulls"]["passed"]
    assert load_manifest(out).collision["convex_hull_only"] == ["basket-a", "table-a"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: (r / "mesh_z_up.obj").write_bytes(b"\xff\xfe\x00garbage"), "mesh_z_up.obj"),
        (lambda r: (r / "mesh_z_up.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "not finite"),
        (lambda r: (r / "floors.txt").write_text("0.3 0.4"), "less than 1 m apart"),
        (lambda r: (r / "windows.txt").write_text("0 0 0 1 1"), "a lower and an upper corner a line"),
        (lambda r: (r / "windows.txt").write_text("0 0 0 1 0.1 -1"), "a box without volume"),
        (lambda r: (r / "alignments.json").write_text("[" * 100000), "not readable as JSON"),
        (lambda r: (r / "floor_trav_0.png").write_bytes(b"x"), "not readable as an image"),
        (lambda r: shutil.rmtree(r / "cad"), "put the model there"),
        (
            lambda r: Image.fromarray(np.full((50, 50), 255, np.uint8)).save(r / "floor_trav_0.png"),
            "covers 0.5 x 0.5 m",
        ),
    ],
)
def test_one_clear_line_and_nothing_written(gibson_raw, tmp_path, capsys, cached, change, words):
    change(gibson_raw)
    out = tmp_path / "scenes" / "out"
    assert main(["convert", str(gibson_raw), str(out)]) == 2
    assert words in one_line(capsys)
    assert list(out.parent.iterdir()) == []


def test_strict_refuses_what_would_be_repaired(gibson_raw, tmp_path, capsys, cached):
    (gibson_raw / "paint.png").unlink()
    assert main(["convert", str(gibson_raw), str(tmp_path / "out"), "--strict"]) == 2
    assert "paint.png', which is missing" in one_line(capsys)
    assert not (tmp_path / "out").exists()


FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


FILES = ("table_0_visual.obj", "structure.png", "hull_0.obj", "scene.xml", "maps.npz", "scene.json")


@pytest.mark.parametrize(
    "suffix", [f if f in ("structure.png", "scene.json") else pytest.param(f, marks=pytest.mark.heavy) for f in FILES]
)
def test_disk_full_at_any_file(pristine, tmp_path, capsys, cached, monkeypatch, suffix):
    """The write of one file fails half-way: what was there before stays, nothing else is left."""
    write_text, save, open_zip = Path.write_text, Image.Image.save, np.savez_compressed

    def text(self, data, *args, **kwargs):
        if self.name.endswith(suffix):
            write_text(self, data[: len(data) // 2], *args, **kwargs)
            raise FULL
        return write_text(self, data, *args, **kwargs)

    def picture(self, target, *args, **kwargs):
        if str(target).endswith(suffix):
            Path(target).write_bytes(b"\x89PNG")
            raise FULL
        return save(self, target, *args, **kwargs)

    def arrays(target, *args, **kwargs):
        if str(target).endswith(suffix):
            Path(target).write_bytes(b"PK")
            raise FULL
        return open_zip(target, *args, **kwargs)

    monkeypatch.setattr(Path, "write_text", text)
    monkeypatch.setattr(Image.Image, "save", picture)
    monkeypatch.setattr(np, "savez_compressed", arrays)
    out = tmp_path / "scenes" / "out"
    out.mkdir(parents=True)
    (out / "old.bin").write_bytes(b"old")
    assert main(["convert", str(pristine / "gibson"), str(out), "--overwrite", *WORDS]) == 2
    error = one_line(capsys)
    assert "No space left on device" in error and str(out) in error and "nothing was written" in error
    assert [p.name for p in out.parent.iterdir()] == ["out"] and contents(out) == {"old.bin": b"old"}


def test_a_cache_on_a_full_disk_costs_nothing(gibson_raw, tmp_path, monkeypatch):
    def full(value, target):
        Path(target).write_bytes(b"\x80")
        raise FULL

    monkeypatch.setattr("interactive_nav_common.jobs.cache.joblib.dump", full)
    convert(gibson_raw, tmp_path / "out", SMALL, cache=tmp_path / "cache")
    assert load_manifest(tmp_path / "out").warnings == ()
    assert list((tmp_path / "cache").iterdir()) == []


@pytest.mark.parametrize("stage", ["cut_furniture", "settle", "write_scene", "save_manifest"])
@pytest.mark.parametrize(
    ("sent", "code", "word"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated"), (signal.SIGHUP, 129, "terminated")],
)
def test_a_signal_in_any_stage_leaves_nothing(pristine, tmp_path, capsys, cached, monkeypatch, stage, sent, code, word):
    """The signal arrives while a stage works; the decomposition has a test with a process of its own."""
    work = getattr(pipeline, stage)

    def interrupted(*args, **kwargs):
        result = work(*args, **kwargs)
        os.kill(os.getpid(), sent)
        return result

    interrupted.__module__, interrupted.__qualname__, interrupted.__name__ = "tests", f"{stage}{tmp_path}", stage
    monkeypatch.setattr(pipeline, stage, interrupted)
    before = signal.getsignal(signal.SIGTERM)
    out = tmp_path / "scenes" / "out"
    try:
        assert main(["convert", str(pristine / "gibson"), str(out), *WORDS]) == code
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == f"{word}; nothing was written\n"
    assert list(out.parent.iterdir()) == []


@pytest.fixture
def quick(monkeypatch):
    """Conversions of which every stage after reading is one file."""

    def made(scene, folder, *_):
        (folder / "scene.json").write_text("new")
        return pipeline.Converted(folder, None, (), None, 0, {})  # pyright: ignore

    monkeypatch.setattr(pipeline, "convert_raw", made)


def test_floors_that_were_put_in_place_when_the_signal_came_are_named(tmp_path, capsys, monkeypatch, quick):
    root, out, rename = tiny_raw.write_two_floors(tmp_path / "house"), tmp_path / "out", Path.rename

    def signalled(self, target):
        if target.name == "out_0":
            os.kill(os.getpid(), signal.SIGINT)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", signalled)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert main(["convert", str(root), str(out)]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == f"interrupted; written before: {out}_0, {out}_1\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["house", "out_0", "out_1"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_of_two_conversions_into_one_folder_one_stands_whole(gibson_raw, tmp_path, monkeypatch, quick, overwrite):
    made, out = pipeline.convert_raw, tmp_path / "out"

    def slow(scene, folder, *rest):
        monkeypatch.setattr(pipeline, "convert_raw", made)
        with pytest.raises(FileError, match=r"out: process \d+ is making it; wait for it or give another place"):
            convert(gibson_raw, out, SMALL)  # starts while the first is at work
        out.mkdir()  # and then comes from somewhere else
        (out / "mine.txt").write_text("its user's")
        return made(scene, folder, *rest)

    monkeypatch.setattr(pipeline, "convert_raw", slow)
    config = dataclasses.replace(SMALL, overwrite=overwrite)
    if overwrite:
        convert(gibson_raw, out, config)
    else:
        with pytest.raises(FileError, match="out: exists already; give another place or add --overwrite"):
            convert(gibson_raw, out, config)
    assert sorted(p.name for p in out.iterdir()) == ["scene.json" if overwrite else "mine.txt"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["gibson", "out"]


def test_a_map_of_the_wrong_place_names_both_extents(gibson_raw):
    from converters.read.gibson import read_gibson

    free = np.zeros((800, 800), np.uint8)
    free[:200, :200] = 255  # x and y from -4 to -2 m; the room is at 0 to 3
    Image.fromarray(free).save(gibson_raw / "floor_trav_0.png")
    with pytest.raises(SceneRejected, match=r"0% of the map's free area lies inside the mesh"):
        read_gibson(gibson_raw)


def test_warnings_are_printed_and_kept(gibson_raw, tmp_path, capsys, cached):
    (gibson_raw / "paint.png").unlink()
    assert main(["convert", str(gibson_raw), str(tmp_path / "out"), *WORDS]) == 0
    out = " ".join(capsys.readouterr().out.split())
    (kept,) = json.loads((tmp_path / "out" / "scene.json").read_text())["warnings"]
    assert f"warning: {kept}" in out
