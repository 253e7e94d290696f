"""Readers: known values in, the same values out; each kind of bad input gives one helpful line."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from converters.annotations import parse_annotations, trs_matrix
from converters.cad import merge_vertices
from converters.errors import SceneRejected
from converters.gibson import read_gibson
from converters.pipeline import detect_format
from converters.scan2cad import read_scan2cad
from tests.converters import tiny_raw

LABELS = "scan/scene_tiny_vh_clean_2.labels.ply"
SCAN = "scan/scene_tiny_vh_clean_2.ply"


def edit_json(path, change) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def refused(reader, root, *words) -> str:
    """The reader refuses the folder with one line that has all the words."""
    with pytest.raises(SceneRejected) as caught:
        reader(root)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    return message


def test_trs_scales_then_turns_then_moves():
    half = math.sqrt(0.5)  # 90 degrees about z
    matrix = trs_matrix({"translation": [1, 2, 3], "rotation": [half, 0, 0, half], "scale": [2, 3, 4]})
    # (1, 0, 0) -> scaled (2, 0, 0) -> turned (0, 2, 0) -> moved (1, 4, 3)
    np.testing.assert_allclose(matrix @ [1, 0, 0, 1], [1, 4, 3, 1], atol=1e-12)


def test_merge_vertices_joins_equal_and_drops_collapsed():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0.0], [1, 1, 0]])
    merged, faces, keep = merge_vertices(vertices, np.array([[0, 1, 2], [3, 4, 2], [1, 3, 4]]))
    assert len(merged) == 4
    np.testing.assert_array_equal(keep, [0, 1])
    assert len(set(faces[0]) & set(faces[1])) == 2


@pytest.mark.parametrize("layout", ["scan2cad", "gibson"])
def test_both_layouts_say_the_same(layout, tmp_path):
    write, read = {
        "scan2cad": (tiny_raw.write_scan2cad, read_scan2cad),
        "gibson": (tiny_raw.write_gibson, read_gibson),
    }[layout]
    root = write(tmp_path / "raw")
    assert detect_format(root) == layout
    raw = read(root)
    vertices, faces, labels = tiny_raw.scan()
    np.testing.assert_allclose(raw.scan.vertices, vertices, atol=1e-5)
    np.testing.assert_array_equal(raw.scan.faces, faces)
    np.testing.assert_array_equal(raw.scan.labels, labels)
    assert [a.category for a in raw.annotations] == ["table", "basket"]
    for annotation, item in zip(raw.annotations, tiny_raw.ITEMS, strict=True):
        # The CAD through its pose lies on the scanned item; so do the keypoints.
        cad = raw.cads[annotation.cad_id].vertices
        placed = cad @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]
        want = tiny_raw.placed(item).bounds
        np.testing.assert_allclose([placed.min(0), placed.max(0)], want, atol=1e-5)
        at = annotation.keypoints_cad @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]
        np.testing.assert_allclose(at, annotation.keypoints_scan, atol=1e-9)
        np.testing.assert_allclose(annotation.keypoints_scan.min(0), want[0], atol=1e-6)
        assert set(map(tuple, raw.cads[annotation.cad_id].face_colours)) == {(51, 102, 153)}
    assert raw.floor_height_m == (tiny_raw.FLOOR_M if layout == "gibson" else None)
    assert all(len(v) == 64 for v in raw.sources.values()) and not any(k.startswith("/") for k in raw.sources)


def test_gibson_hinge_is_read_in_the_z_up_frame():
    data = tiny_raw.annotation()
    data[0]["aligned_models"][0] |= {
        "catid_cad": "03221720",
        "articulation": {
            "type": "hinge",
            "axis": [0, 1, 0],
            "origin": [0.5, 0, 0.2],
            "range_rad": [-1.5, 0.2],
        },
    }
    _, ((_, door), _) = parse_annotations(data, tiny_raw.Path("alignments.json"))
    assert door.category == "door" and door.hinge is not None
    np.testing.assert_allclose(door.hinge.origin, (0.5, -0.2, 0.0))  # (x, y, z) -> (x, -z, y)
    assert door.hinge.sign == 1.0 and door.hinge.range_rad == (-1.5, 0.2)
    data[0]["aligned_models"][0]["articulation"]["axis"] = [1, 0, 0]
    with pytest.raises(SceneRejected, match="expected the vertical"):
        parse_annotations(data, tiny_raw.Path("alignments.json"))


def test_given_map_is_centred_on_the_origin(gibson_raw):
    from PIL import Image

    image = np.zeros((800, 800), np.uint8)
    image[400:650, 400:700] = 255  # x from 0 to 3 m, y from 0 to 2.5 m
    Image.fromarray(image).save(gibson_raw / "floor_trav_0.png")
    given_map = read_gibson(gibson_raw).given_map
    assert given_map is not None and given_map.origin == (-4.0, -4.0)
    assert given_map.traversable.sum() == 250 * 300


@pytest.mark.parametrize("name", ["full_annotations.json", SCAN, LABELS])
def test_missing_scan2cad_file(scan2cad_raw, name):
    (scan2cad_raw / name).unlink()
    refused(read_scan2cad, scan2cad_raw, name, "no such file")


@pytest.mark.parametrize(
    "name",
    ["mesh_z_up.obj", "mesh_z_up.mtl", "paint.png", "mesh_z_up.labels.npz", "floors.txt", "alignments.json"],
)
def test_missing_gibson_file(gibson_raw, name):
    (gibson_raw / name).unlink()
    refused(read_gibson, gibson_raw, name, "no such file")


@pytest.mark.parametrize("keep", [0, 200, 5000])
@pytest.mark.parametrize("name", [SCAN, LABELS])
def test_truncated_ply(scan2cad_raw, name, keep):
    path = scan2cad_raw / name
    path.write_bytes(path.read_bytes()[:keep])
    refused(read_scan2cad, scan2cad_raw, name)


def test_absent_cad_model_is_named_with_where_it_was_sought(scan2cad_raw):
    path = scan2cad_raw / "cad/04379243/table-a/models/model_normalized.obj"
    path.unlink()
    refused(read_scan2cad, scan2cad_raw, "table-a", "04379243", str(path), "put the model there")


def test_label_count_must_match(scan2cad_raw, gibson_raw):
    vertices, faces, labels = tiny_raw.scan()
    np.savez(gibson_raw / "mesh_z_up.labels.npz", label=labels[:-3].astype(np.uint8))
    refused(read_gibson, gibson_raw, f"{len(labels) - 3} labels", f"{len(labels)} vertices")


def test_label_ply_of_another_mesh(scan2cad_raw):
    vertices, faces, labels = tiny_raw.scan()
    tiny_raw.write_label_ply(
        scan2cad_raw / LABELS, vertices[:-1], faces[(faces < len(vertices) - 1).all(1)], labels[:-1]
    )
    refused(read_scan2cad, scan2cad_raw, f"{len(labels) - 1} labels", f"{len(labels)} vertices")


def test_label_ply_without_labels(scan2cad_raw):
    (scan2cad_raw / LABELS).write_bytes((scan2cad_raw / SCAN).read_bytes())
    refused(read_scan2cad, scan2cad_raw, "no property 'label'")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.append(d[0]), ("a list of 2", "one scan")),
        (lambda d: d[0]["aligned_models"][1].update(catid_cad="02691156"), ("02691156", "03001627 (chair)")),
        (
            lambda d: d[0]["aligned_models"][0]["trs"].pop("scale"),
            ("aligned_models[0]", "missing key 'scale'"),
        ),
        (
            lambda d: d[0]["aligned_models"][0]["trs"].update(scale=[1, 0, 1]),
            ("aligned_models[0]", "non-zero"),
        ),
        (lambda d: d[0].pop("trs"), ("missing key 'trs'",)),
    ],
)
def test_bad_annotations(scan2cad_raw, change, words):
    edit_json(scan2cad_raw / "full_annotations.json", change)
    refused(read_scan2cad, scan2cad_raw, "full_annotations.json", *words)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"a": 1}', "[1]"])
def test_annotation_file_with_something_else(scan2cad_raw, text):
    (scan2cad_raw / "full_annotations.json").write_text(text)
    refused(read_scan2cad, scan2cad_raw, "full_annotations.json")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("floors.txt", "0.1\n2.9\n", ("2 floor heights", "expected one")),
        ("floors.txt", "ground\n", ("floors.txt", "expected one floor height")),
        ("mesh_z_up.mtl", "newmtl scan\n", ("names 0 textures", "expected exactly one")),
        ("mesh_z_up.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3 1\n", ("obj:4", "4 corners", "triangulate")),
        ("mesh_z_up.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n", ("names vertex 8 of 3",)),
        ("mesh_z_up.obj", "v 0 0 nan\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", ("1 vertices are not finite",)),
        ("mesh_z_up.obj", "v 0 0\nv 1 0 0\nf 1 2 3\n", ("not readable as OBJ",)),
        ("mesh_z_up.obj", "# empty\n", ("0 vertices and 0 faces",)),
        ("mesh_z_up.labels.npz", "not a zip", ("mesh_z_up.labels.npz", "array 'label'")),
        ("paint.png", "not a png", ("paint.png", "not readable as an image")),
    ],
)  # fmt: skip
def test_damaged_gibson_file(gibson_raw, name, text, words):
    (gibson_raw / name).write_text(text)
    refused(read_gibson, gibson_raw, *words)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_fuzzed_files_never_crash_a_reader(gibson_raw, data):
    name = data.draw(st.sampled_from(["mesh_z_up.labels.npz", "alignments.json", "floors.txt", "paint.png"]))
    path = gibson_raw / name
    good = path.read_bytes()
    at = data.draw(st.integers(0, len(good) - 1))
    path.write_bytes(good[:at] + data.draw(st.binary(max_size=8)) + good[at + data.draw(st.integers(0, 20)) :])
    try:
        read_gibson(gibson_raw)
    except SceneRejected as error:
        assert "\n" not in str(error)
    finally:
        path.write_bytes(good)


def test_no_known_layout(tmp_path):
    refused(detect_format, tmp_path, "no known layout", "mesh_z_up.obj", "full_annotations.json")
    refused(detect_format, tmp_path / "absent", "no such folder")
