"""Scenes of published collections: what scenezoo says becomes a scan; its own readers on layouts written here."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import trimesh

from converters.geometry.faces import face_areas, face_labels
from converters.pipeline import ConvertConfig, convert
from converters.read.datasets.scanned import COLLECTIONS, NYU40, label_of, read_scan
from converters.read.source import detect_format
from converters.records.errors import SceneRejected
from converters.records.raw import DOOR, FLOOR, UNLABELLED, WALL

CHAIR, CUP = 5, 40


@pytest.mark.parametrize(
    ("name", "label"),
    [("wall", 1), ("office chair", 5), ("Floor mat", 20), ("shower curtain", 28), ("tv monitor", 25), ("chairs", 5),
     ("couch", 6), ("night stand", 32), ("doorframe", 8), ("heater", 40), ("", 40), ("suspended ceiling", 22),
     ("armchair", 5)],
)  # fmt: skip
def test_the_last_words_of_a_class_tell_its_id(name, label):
    assert label_of(name) == label


def test_every_name_of_nyu40_is_its_own():
    assert {name: label_of(name) for name in NYU40} == NYU40
    assert list(dict.fromkeys(NYU40.values())) == list(range(1, 41))


def a_room() -> tuple[trimesh.Trimesh, np.ndarray, dict[int, str]]:
    """4 x 3 x 2.4 m without a ceiling, with a block that is called a chair; classes by face."""
    floor = trimesh.creation.box((4, 3, 0.02))
    walls = [trimesh.creation.box(size) for size in ((4, 0.1, 2.4), (4, 0.1, 2.4), (0.1, 3, 2.4), (0.1, 3, 2.4))]
    for wall, at in zip(walls, ((0, 1.5), (0, -1.5), (2, 0), (-2, 0)), strict=True):
        wall.apply_translation((*at, 1.2))
    chair = trimesh.creation.box((0.5, 0.5, 0.8))
    chair.apply_translation((0.6, 0.3, 0.41))
    parts = [floor, *walls, chair]
    for part in parts:
        part.vertices, part.faces = trimesh.remesh.subdivide_to_size(part.vertices, part.faces, 0.15)[:2]
    kinds = np.concatenate([np.full(len(p.faces), k) for p, k in zip(parts, (7, 3, 3, 3, 3, 9), strict=True)])
    room = trimesh.util.concatenate(parts)
    assert isinstance(room, trimesh.Trimesh)
    return room, kinds, {3: "wall", 7: "floor", 9: "office chair", 11: "Christmas tree"}


def fake_scenezoo(monkeypatch, domain="face", labels=None, asked=None, no_labels=False):
    room, kinds, names = a_room()
    by_vertex = np.zeros(len(room.vertices), int)
    by_vertex[room.faces.ravel()] = np.repeat(kinds, 3)
    values = labels if labels is not None else kinds if domain == "face" else by_vertex

    class Unsupported(Exception):
        pass

    class Dataset:
        def get_mesh(self, scene):
            return types.SimpleNamespace(
                vertices=room.vertices, triangles=room.faces, vertex_colors=np.full_like(room.vertices, 0.5),
                has_vertex_colors=lambda: True,
            )  # fmt: skip

        def get_segmentation(self, scene, **options):
            if asked is not None:
                asked.append((scene, options))
            if no_labels:
                raise Unsupported("not published")
            return types.SimpleNamespace(labels=values, id_to_name=names, domain=domain, invalid_id=-1)

    def get_dataset(name, root):
        if asked is not None:
            asked.append((name, root))
        return Dataset()

    library = types.SimpleNamespace(get_dataset=get_dataset, UnsupportedOperationError=Unsupported)
    monkeypatch.setitem(sys.modules, "scenezoo", library)


def areas_of(raw):
    labels, areas = face_labels(raw.scan.labels, raw.scan.faces), face_areas(raw.scan.vertices, raw.scan.faces)
    return {int(k): float(areas[labels == k].sum()) for k in np.unique(labels)}


@pytest.mark.parametrize("domain", ["face", "vertex"])
def test_labels_by_name_and_where_the_collection_is(monkeypatch, tmp_path, domain):
    asked = []
    fake_scenezoo(monkeypatch, domain, asked=asked)
    scene = tmp_path / "scannet" / "scans" / "scene0000_00"
    scene.mkdir(parents=True)
    (scene / "scene0000_00_vh_clean_2.ply").write_bytes(b"ply")
    assert detect_format(scene) == "scannet"
    raw = read_scan("scannet", scene)
    assert asked == [("scannetv2", tmp_path / "scannet"), ("scene0000_00", {"segmentation_type": "semantic"})]
    areas = areas_of(raw)
    assert set(areas) == {WALL, FLOOR, CHAIR} and areas[FLOOR] == pytest.approx(2 * 12, rel=0.15)
    assert areas[CHAIR] == pytest.approx(2 * 0.25 + 4 * 0.4, rel=0.05)
    assert raw.name == "scene0000_00" and raw.floor_height_m == pytest.approx(0.01, abs=0.02)
    assert list(raw.sources) == ["scene0000_00_vh_clean_2.ply"] and (raw.scan.vertex_colours == 128).all()
    assert any("Christmas tree" in w for w in raw.warnings)


def test_without_labels_shape_tells_the_structure(monkeypatch, tmp_path):
    fake_scenezoo(monkeypatch, no_labels=True)
    raw = read_scan("scannetpp", tmp_path)
    assert {WALL, FLOOR, UNLABELLED} <= set(areas_of(raw)) and any("has no labels" in w for w in raw.warnings)


def test_it_becomes_a_scene(monkeypatch, tmp_path):
    fake_scenezoo(monkeypatch)
    (tmp_path / "raw").mkdir()
    result = convert(
        tmp_path / "raw", tmp_path / "out", ConvertConfig(format="multiscan", structure_texture=64, object_texture=32)
    )
    assert result.manifest.source["format"] == "multiscan" and all(g.passed for g in result.gates)


def test_one_line_each_for_what_is_wrong(monkeypatch, tmp_path):
    fake_scenezoo(monkeypatch, labels=np.zeros(5, int))
    with pytest.raises(SceneRejected, match="5 labels a face, expected"):
        read_scan("matterport3d", tmp_path)
    monkeypatch.setitem(sys.modules, "scenezoo", None)
    with pytest.raises(SceneRejected, match=r"not installed; pip install 'interactive-nav\[datasets\]'"):
        read_scan("3rscan", tmp_path)
    library = types.SimpleNamespace(get_dataset=lambda *_: 1 / 0)
    monkeypatch.setitem(sys.modules, "scenezoo", library)
    with pytest.raises(SceneRejected, match=r"not readable as arkitscenes \(ZeroDivisionError: division by zero\)"):
        read_scan("arkitscenes", tmp_path)


def write_scannetpp(root: Path) -> Path:
    room, kinds, names = a_room()
    scene = root / "data" / "0a0a"
    (scene / "scans").mkdir(parents=True)
    room.export(scene / "scans" / "mesh_aligned_0.05.ply", vertex_normal=False)
    by_vertex = np.zeros(len(room.vertices), int)
    by_vertex[room.faces.ravel()] = np.repeat(kinds, 3)
    (scene / "scans" / "segments.json").write_text(json.dumps({"segIndices": by_vertex.tolist()}))
    groups = [{"id": k, "objectId": k, "label": n, "segments": [k]} for k, n in names.items() if k != 11]
    (scene / "scans" / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))
    return scene


def write_multiscan(root: Path) -> Path:
    room, kinds, names = a_room()
    scene = root / "scene_00000_00"
    scene.mkdir(parents=True)
    vertices = "\n".join(" ".join(f"{v:.6f}" for v in row) for row in room.vertices)
    faces = "\n".join(f"3 {a} {b} {c} {k} {k}" for (a, b, c), k in zip(room.faces, kinds, strict=True))
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(room.vertices)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(room.faces)}\nproperty list uchar int vertex_indices\n"
        "property int objectId\nproperty int partId\nend_header\n"
    )
    (scene / f"{scene.name}.ply").write_text(f"{header}{vertices}\n{faces}\n")
    objects = [{"objectId": k, "label": f"{n}.1", "partIds": [k]} for k, n in names.items()]
    parts = [{"partId": k, "label": f"{n}.1"} for k, n in names.items()]
    (scene / f"{scene.name}.annotations.json").write_text(json.dumps({"objects": objects, "parts": parts}))
    return scene


@pytest.mark.parametrize(("name", "write"), [("scannetpp", write_scannetpp), ("multiscan", write_multiscan)])
def test_scenezoo_itself_reads_the_layout(tmp_path, name, write):
    pytest.importorskip("scenezoo", reason="scenezoo is not installed (pip install 'interactive-nav[datasets]')")
    scene = write(tmp_path)
    assert detect_format(scene) == name
    areas = areas_of(read_scan(name, scene))
    assert {WALL, FLOOR, CHAIR} <= set(areas) and areas[CHAIR] == pytest.approx(2.1, rel=0.1)


def test_scenezoo_reads_the_sample_scan_as_our_own_reader_does(sample_data, tmp_path):
    pytest.importorskip("scenezoo", reason="scenezoo is not installed (pip install 'interactive-nav[datasets]')")
    from converters.read.annotations import read_scan2cad

    ours = read_scan2cad(sample_data / "scan2cad_scene0470_00")
    (scan,) = (sample_data / "scan2cad_scene0470_00" / "scan").glob("*_vh_clean_2.ply")
    scene = tmp_path / "scans" / "scene0470_00"
    scene.mkdir(parents=True)
    (scene / scan.name).write_bytes(scan.read_bytes())
    raw = read_scan("scannet", scene)
    np.testing.assert_allclose(raw.scan.vertices, ours.scan.vertices, atol=1e-5)
    np.testing.assert_array_equal(raw.scan.faces, ours.scan.faces)
    assert DOOR not in raw.scan.labels and set(COLLECTIONS) >= {"scannet"}
