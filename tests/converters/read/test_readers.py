"""Readers: known values in, the same values out; each kind of bad input gives one helpful line."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import trimesh

from converters.geometry.faces import merge_vertices
from converters.pipeline import ConvertConfig, convert
from converters.read.annotations import parse_annotations, read_scan2cad, trs_matrix
from converters.read.files import SourceFolder
from converters.read.gibson import read_gibson
from converters.read.source import FILES, READERS, detect_format, read_source
from converters.records.errors import SceneRejected
from converters.records.raw import CEILING, FLOOR, WALL, ScanMesh
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
    assert door.hinge.axis.tolist() == [0.0, 0.0, 1.0] and door.hinge.range_rad == (-1.5, 0.2)
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
    ["mesh_z_up.obj", "floors.txt", "cad/04379243/table-a/models/model_normalized.obj"],
)
def test_missing_gibson_file(gibson_raw, name):
    (gibson_raw / name).unlink()
    refused(read_gibson, gibson_raw, name, "no such file")


@pytest.mark.parametrize(
    ("name", "warning"),
    [
        ("mesh_z_up.mtl", "mesh_z_up.obj: its material file mesh_z_up.mtl is missing; it stays grey"),
        ("paint.png", "mesh_z_up.mtl: names the texture 'paint.png', which is missing; the material's plain colour"),
        (
            "cad/04379243/table-a/models/model_normalized.mtl",
            "file model_normalized.mtl is missing; it stays grey",
        ),
    ],
)
def test_missing_colour_is_a_warning_and_an_error_where_strict(gibson_raw, name, warning):
    (gibson_raw / name).unlink()
    raw = read_gibson(gibson_raw)
    assert len(raw.warnings) == 1 and warning in raw.warnings[0]
    assert str(gibson_raw) not in raw.warnings[0]
    np.testing.assert_array_equal(raw.scan.faces, tiny_raw.scan()[1])
    refused(lambda root: read_gibson(root, strict=True), gibson_raw, warning.split(";")[0], "--strict refuses")


def test_a_whole_folder_has_no_warning(gibson_raw, scan2cad_raw):
    assert read_gibson(gibson_raw, strict=True).warnings == () == read_scan2cad(scan2cad_raw, strict=True).warnings


def table_obj(root):
    return root / "cad/04379243/table-a/models/model_normalized.obj"


def rewrite_faces(path, change) -> None:
    """Applies a function to the list of an OBJ's face lines."""
    lines = path.read_text().splitlines()
    faces = change([line for line in lines if line.startswith("f ")])
    path.write_text("\n".join([line for line in lines if not line.startswith("f ")] + faces) + "\n")


@pytest.mark.parametrize(
    ("change", "warning"),
    [
        (lambda f: [*f, "f 1 1 2", "f 1 2 2"], None),
        (lambda f: f[1:], "is not watertight (3 open edges)"),
        (lambda f: [*f, "f 1 2 20"], "is not manifold"),
    ],
)
def test_open_and_non_manifold_models_are_used_and_noted(gibson_raw, change, warning):
    rewrite_faces(table_obj(gibson_raw), change)
    raw = read_gibson(gibson_raw)
    np.testing.assert_allclose(np.ptp(raw.cads["table-a"].vertices, axis=0), (1.0, 0.6, 0.7), atol=1e-6)
    assert bool(raw.warnings) == (warning is not None)
    if warning:
        assert warning in raw.warnings[0]


def test_faces_without_area_are_dropped_and_noted(gibson_raw):
    path = table_obj(gibson_raw)
    text = path.read_text()  # three corners on one line, all at different places
    path.write_text(text + "v 5e-1 0.25 0.3\nv 0.5 0.3 0.3\nv 0.5 0.35 0.3\nf 41 42 43\n")
    raw = read_gibson(gibson_raw)
    assert any("1 of 61 faces have no area; they are dropped" in w for w in raw.warnings)
    assert len(raw.cads["table-a"].faces) == 60


@pytest.mark.parametrize("text", ["v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n"])
def test_a_model_without_any_area_is_refused(gibson_raw, text):
    table_obj(gibson_raw).write_text(text)
    refused(read_gibson, gibson_raw, "model_normalized.obj", "enclose no area")


def test_a_model_with_nan_is_refused(gibson_raw):
    path = table_obj(gibson_raw)
    path.write_text(path.read_text().replace("v 0.500000 ", "v nan ", 1))
    refused(read_gibson, gibson_raw, "model_normalized.obj", "vertices are not finite")


def shift_model(data, index, by):
    model = data[0]["aligned_models"][index]
    model["trs"]["translation"][0] += by


def test_an_object_outside_the_scan_is_left_out(gibson_raw):
    edit_json(gibson_raw / "alignments.json", lambda d: shift_model(d, 1, 20.0))
    raw = read_gibson(gibson_raw)
    assert [a.category for a in raw.annotations] == ["table"] and set(raw.cads) == {"table-a"}
    # The basket reaches from x = 2.25 + 20 on; the scan ends at 3.
    assert raw.warnings == (
        "alignments.json: object 1 (basket, basket-a) lies 19.2 m outside the scan; it is left out",
    )
    refused(lambda root: read_gibson(root, strict=True), gibson_raw, "19.2 m outside", "--strict")


def test_an_annotation_of_another_scan_is_refused(gibson_raw, scan2cad_raw):
    for reader, root, name in (
        (read_gibson, gibson_raw, "alignments.json"),
        (read_scan2cad, scan2cad_raw, "full_annotations.json"),
    ):
        edit_json(root / name, lambda d: (shift_model(d, 0, 20.0), shift_model(d, 1, 20.0)))
        refused(reader, root, name, "2 of 2 objects lie outside the scan", "another scan")


def write_map(root, free, name="floor_trav_0.png") -> None:
    from PIL import Image

    Image.fromarray(np.asarray(free, np.uint8) * 255).save(root / name)


def test_obstacles_are_taken_off_the_given_map(gibson_raw):
    free, clear = np.zeros((800, 800), bool), np.ones((800, 800), bool)
    free[400:650, 400:700] = True
    clear[400:500, 400:700] = False
    write_map(gibson_raw, free)
    write_map(gibson_raw, clear, "floor_0.png")
    given_map = read_gibson(gibson_raw).given_map
    assert given_map is not None and given_map.traversable.sum() == 150 * 300


@pytest.mark.parametrize(
    ("free", "words"),
    [
        (np.ones((100, 200), bool), ("is 200 x 100, expected a square image",)),
        (np.ones((80, 80), bool), ("covers 0.8 x 0.8 m", "of the mesh's floor on the map")),
        (np.ones((4000, 4000), bool), ("covers 40.0 x 40.0 m", "of the map's free area lies inside the mesh")),
    ],
)
def test_a_map_of_another_size_than_the_mesh(gibson_raw, free, words):
    write_map(gibson_raw, free)
    refused(read_gibson, gibson_raw, "floor_trav_0.png", *words)


def test_two_maps_of_different_sizes(gibson_raw):
    write_map(gibson_raw, np.ones((600, 600)))
    write_map(gibson_raw, np.ones((500, 500)), "floor_0.png")
    refused(read_gibson, gibson_raw, "floor_0.png: is 500 x 500, expected the 600 x 600 of floor_trav_0.png")


def test_a_y_up_mesh_given_as_z_up(gibson_raw):
    path = gibson_raw / "mesh_z_up.obj"
    lines = []
    for line in path.read_text().splitlines():
        word, *rest = line.split()
        if word == "v":
            x, y, z = (float(v) for v in rest)
            line = f"v {x} {z} {-y}"
        lines.append(line)
    path.write_text("\n".join(lines) + "\n")
    refused(read_gibson, gibson_raw, "mesh_z_up.obj", "the mesh is y up, expected z up")


def test_ids_cannot_leave_the_library(gibson_raw):
    edit_json(gibson_raw / "alignments.json", lambda d: d[0]["aligned_models"][0].update(id_cad="../../../etc"))
    refused(read_gibson, gibson_raw, "id_cad is '../../../etc'", "expected one folder name")


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
        ("floors.txt", "0.1\n0.9\n", ("0.1 m and 0.9 m are less than 1 m apart",)),
        ("floors.txt", "ground\n", ("floors.txt", "expected one floor height")),
        ("floors.txt", "", ("floors.txt", "expected one floor height")),
        ("floors.txt", "inf\n", ("floors.txt", "expected one floor height")),
        ("floors.txt", "1.7\n", ("lie level at the floor's height of 1.7 m", "check floors.txt")),
        ("floor_trav_0.png", "no png", ("floor_trav_0.png", "not readable as an image")),
        ("mesh_z_up.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n", ("names vertex 8 of 3",)),
        ("mesh_z_up.obj", "v 0 0 nan\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", ("1 vertices are not finite",)),
        ("mesh_z_up.obj", "v 0 0\nv 1 0 0\nf 1 2 3\n", ("fewer than 3 coordinates",)),
        ("mesh_z_up.obj", "# empty\n", ("0 vertices and 0 faces",)),
        ("mesh_z_up.labels.npz", "not a zip", ("mesh_z_up.labels.npz", "array 'label'")),
    ],
)  # fmt: skip
def test_damaged_gibson_file(gibson_raw, name, text, words):
    if name == "floors.txt" and text == "1.7\n":
        (gibson_raw / "mesh_z_up.labels.npz").unlink()  # with labels the floor is where they are
    (gibson_raw / name).write_text(text)
    refused(read_gibson, gibson_raw, *words)


def test_a_damaged_texture_costs_colour_only(gibson_raw):
    (gibson_raw / "paint.png").write_bytes(b"no png")
    (warning,) = read_gibson(gibson_raw).warnings
    assert warning.startswith("paint.png: not readable as an image") and str(gibson_raw) not in warning


def test_no_known_layout(tmp_path):
    refused(detect_format, tmp_path, "no known layout", "mesh_z_up.obj", "full_annotations.json")
    refused(detect_format, tmp_path / "absent", "no such file or folder")


def read_room(root, strict=False, chosen=None):
    """Reads an empty room from a file with its length, width and height in m: a reader as docs/extend.md describes."""
    source = SourceFolder(root, strict)
    name = source.inside(chosen) if chosen else "home.room"
    path = source.use(name, "write length, width and height of the room into it")
    try:
        size = np.array([float(word) for word in path.read_text().split()]).reshape(3)
    except ValueError:
        raise SceneRejected(f"{path}: expected three numbers; write length, width and height in m") from None
    room = trimesh.creation.box(size).apply_translation(size / 2)
    triangles = room.vertices[room.faces[:, ::-1]]  # which look into the room
    heights = triangles[:, :, 2]
    labels = np.where((heights == 0).all(1), FLOOR, np.where((heights == size[2]).all(1), CEILING, WALL))
    corners = triangles.reshape(-1, 3)  # labels are of vertices, and a corner would belong to three faces
    faces, grey = np.arange(len(corners)).reshape(-1, 3), np.full((len(corners), 3), 200, np.uint8)
    scan = ScanMesh(corners, faces, labels=labels.repeat(3), vertex_colours=grey)
    return source.scene("room", scan, licence="CC0", floor_height_m=0.0)


def test_a_reader_of_a_new_layout(tmp_path, monkeypatch):
    monkeypatch.setitem(READERS, "room", (lambda root: (root / "home.room").is_file(), read_room))
    monkeypatch.setitem(FILES, (".room",), (lambda path: path.resolve().parent, read_room))
    path = tmp_path / "flat" / "home.room"
    path.parent.mkdir()
    path.write_text("4 3 2.5")
    assert detect_format(path.parent) == "room"
    (path.parent / "attic.room").write_text("2 2 2")
    attic, flat = read_source(path.parent / "attic.room"), read_source(path.parent, "room")
    assert (attic.name, flat.name) == ("attic", "flat") and list(attic.sources) == ["attic.room"]
    np.testing.assert_array_equal(flat.scan.vertices.max(0), [4, 3, 2.5])
    scene = convert(path.parent, tmp_path / "scene", ConvertConfig(structure_texture=128))
    assert scene.manifest.floor_area_m2 == pytest.approx(12.0, rel=0.1) and scene.manifest.source["format"] == "room"
    assert all(gate.passed for gate in scene.gates), scene.gates
    path.write_text("4 3")
    refused(read_source, path.parent, "home.room: expected three numbers")
