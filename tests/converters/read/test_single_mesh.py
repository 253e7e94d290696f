"""One mesh file as a source: any kind, tilted, in centimetres; what is wrong with it in one line."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from converters.__main__ import main
from converters.pipeline import ConvertConfig, convert, convert_building
from converters.read.meshes import SUFFIXES
from converters.read.source import read_source
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR, WALL
from tests.converters import tiny_raw

SMALL = ConvertConfig(structure_texture=64, jobs=1)
TURN = Rotation.from_euler("xyz", [118, 11, 0], degrees=True).as_matrix()


def tall_room() -> trimesh.Trimesh:
    """The tiny room with walls of 2 m, so that they are told by shape."""
    vertices, faces, labels = tiny_raw.scan()
    vertices[labels == WALL, 2] = tiny_raw.FLOOR_M + (vertices[labels == WALL, 2] - tiny_raw.FLOOR_M) * 1.35
    up = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])[:, 2]
    down = (labels[faces] == FLOOR).all(axis=1) & (up < 0)
    faces[down] = faces[down][:, ::-1]
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("single") / "room.ply"
    tall_room().export(path)
    return path


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl"])
def test_every_kind_of_file_gives_the_same_floor(tmp_path, suffix):
    path = tmp_path / f"room{suffix}"
    tall_room().export(path)
    assert suffix in SUFFIXES
    raw = read_source(path, up="z", unit="m")
    assert raw.floor_height_m == pytest.approx(tiny_raw.FLOOR_M, abs=0.01) and raw.source_format == "mesh"
    area = tiny_raw.ROOM_M[0] * tiny_raw.ROOM_M[1]
    floor = raw.scan.faces[(raw.scan.labels[raw.scan.faces] == FLOOR).all(axis=1)]
    corners = raw.scan.vertices[floor]
    covered = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert 0.8 * area < covered < 1.05 * area


def test_a_tilted_scan_in_centimetres_becomes_the_scene_of_the_right_one(room, tmp_path, hull_cache):
    mesh = tall_room()
    mesh.vertices = 100.0 * mesh.vertices @ TURN.T
    mesh.export(tmp_path / "tilted.ply")
    right = convert(room, tmp_path / "a", SMALL, cache=hull_cache)
    tilted = convert(tmp_path / "tilted.ply", tmp_path / "b", SMALL, cache=hull_cache)
    assert all(g.passed for g in (*right.gates, *tilted.gates))
    assert tilted.manifest.floor_area_m2 == pytest.approx(right.manifest.floor_area_m2, rel=0.1)
    words = " ".join(tilted.manifest.warnings)
    assert "turned by 117" in words and "taken to be in cm" in words and "labelled by shape" in words
    assert "turned" not in " ".join(right.manifest.warnings)
    told: list[str] = []
    convert_building(
        room, tmp_path / "c", dataclasses.replace(SMALL, auto_align=True), cache=hull_cache, warn=told.append
    )
    assert "--auto-align: no label of furniture in the scan, so no model is fitted" in told


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["room.txt"], "is no mesh file; expected one of .ply"),
        (["empty.ply"], "not readable as a mesh (it is empty); expected OBJ"),
        (["flat.ply"], "shows one direction of surface only; say which axis points up with --up"),
        (["absent.ply"], "no such file or folder"),
        (["folder", "--up", "y"], "--up, --unit and --mirror are for a single mesh file"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, capsys, arguments, message):
    (tmp_path / "room.txt").write_text("no mesh")
    (tmp_path / "empty.ply").write_text("")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False).export(tmp_path / "flat.ply")
    tiny_raw.write_gibson(tmp_path / "folder")
    source, *options = arguments
    assert main(["convert", str(tmp_path / source), str(tmp_path / "out"), *options]) == 2
    said = capsys.readouterr().err.strip()
    assert message in said.replace("\n", " ") and "Traceback" not in said
    assert not (tmp_path / "out").exists()


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_files_end_in_one_line_or_a_scan(room, tmp_path_factory, data):
    content = room.read_bytes()
    at = data.draw(st.integers(0, len(content)))
    piece = data.draw(st.sampled_from([b"", b"\xff" * 8, b"nan", b"-1", b"\x00" * 4, b"99999999"]))
    path = tmp_path_factory.mktemp("damaged") / "room.ply"
    path.write_bytes(content[:at] + piece + content[at + data.draw(st.sampled_from([0, 4, 100000])) :])
    try:
        raw = read_source(path)
    except SceneRejected as refusal:
        assert "\n" not in str(refusal)
    else:
        assert np.isfinite(raw.scan.vertices).all()


@pytest.mark.parametrize("ceiling", [False, True])
@pytest.mark.parametrize("up", ["auto", "z"])
def test_a_mirrored_or_inside_out_mesh_is_refused_and_mirrors_back(tmp_path, ceiling, up):
    right = tall_room()
    if ceiling:
        lid = [[0, 0, 2.3], [3.0, 0, 2.3], [3.0, 2.5, 2.3], [0, 2.5, 2.3]]
        right += trimesh.Trimesh(lid, [[0, 2, 1], [0, 3, 2]], process=False)
    right.export(tmp_path / "right.ply")
    expected = read_source(tmp_path / "right.ply", up="z")
    assert expected.floor_height_m == pytest.approx(tiny_raw.FLOOR_M, abs=0.01)
    mirrored, inside_out = right.copy(), right.copy()
    mirrored.vertices = right.vertices * [-1, 1, 1]  # trimesh's own transform would turn the faces along
    inside_out.faces = right.faces[:, ::-1]
    for name, wrong in (("mirrored", mirrored), ("inside_out", inside_out)):
        path = tmp_path / f"{name}.ply"
        wrong.export(path)
        with pytest.raises(SceneRejected, match="its floor faces down: .*--mirror, which mirrors x"):
            read_source(path, up=up)
    back = read_source(tmp_path / "mirrored.ply", up="z", mirror=True)
    np.testing.assert_allclose(back.scan.vertices, expected.scan.vertices, atol=1e-6)
    assert back.floor_height_m == expected.floor_height_m
    with pytest.raises(SceneRejected, match="--mirror are for a single mesh file"):
        read_source(tmp_path, mirror=True)
