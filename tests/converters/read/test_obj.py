"""OBJ and MTL: polygons, indices from the end, several materials in one image, names of another machine."""

from __future__ import annotations

import collections
import unicodedata

import numpy as np
import pytest
from PIL import Image

from converters.read.files import SourceFolder, read_obj
from converters.read.obj import (
    TexturedMesh,
    join_meshes,
    join_textures,
    parse_mtl,
    read_scan_obj,
    texels,
    texture_name,
)
from converters.records.errors import SceneRejected

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def obj(tmp_path, text):
    path = tmp_path / "mesh.obj"
    path.write_text(text)
    return path


@pytest.mark.parametrize("face", ["f 1 2 3 4", "f 1//1 2//1 3//1 4//1", "f -4 -3 -2 -1", "f 1 -3 3 -1"])
def test_polygons_become_fans_whatever_the_index_style(tmp_path, face):
    mesh = read_obj(obj(tmp_path, SQUARE + face + "\n"))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    assert mesh.corner_uv is None


@pytest.mark.parametrize("plane", [(0, 1, 2), (2, 0, 1), (1, 2, 0), (1, 0, 2)])
def test_a_door_frame_of_one_polygon_stays_open(tmp_path, plane):
    """A fan around the first corner would cover the opening."""
    outline = np.array([(0, 0), (1, 0), (1, 20), (9, 20), (9, 0), (10, 0), (10, 21), (0, 21)], float)
    points = np.column_stack([outline, np.zeros(8)])[:, plane]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in points) + "f 1 2 3 4 5 6 7 8\n"
    mesh = read_obj(obj(tmp_path, text))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a) / 2
    assert len(mesh.faces) == 6 and np.linalg.norm(area, axis=1).sum() == pytest.approx(50)
    assert np.abs(area.sum(axis=0)).max() == pytest.approx(50)  # all face one way


def test_a_ring_with_a_bridge_keeps_its_hole(tmp_path):
    """A square of 3 x 3 around one of 1 x 1, joined by an edge that the outline runs along twice."""
    corners = [(0, 0), (3, 0), (3, 3), (0, 3), (1, 1), (1, 2), (2, 2), (2, 1)]
    text = "".join(f"v {x} {y} 0\n" for x, y in corners) + "f 1 2 3 4 1 5 6 7 8 5\n"
    mesh = read_obj(obj(tmp_path, text))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    np.testing.assert_allclose((np.cross(b - a, c - a)[:, 2] / 2).sum(), np.abs(np.cross(b - a, c - a)).sum() / 2)
    assert len(mesh.faces) == 8 and np.abs(np.cross(b - a, c - a)).sum() / 2 == pytest.approx(8)


def test_a_large_polygon_is_cut_as_a_small_one(tmp_path):
    """A comb of 200 teeth, 1 x 9 each, on a back of 400 x 1: most triangles of a fan would lie between the teeth."""
    teeth = [corner for k in range(0, 400, 2) for corner in ((k, 10), (k + 1, 10), (k + 1, 1), (k + 2, 1))]
    outline = [(0, 0), *teeth[:-1], (400, 1), (400, 0)][::-1]
    text = "".join(f"v {x} {y} 0\n" for x, y in outline) + f"f {' '.join(map(str, range(1, len(outline) + 1)))}\n"
    mesh = read_obj(obj(tmp_path, text))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert len(mesh.faces) == len(outline) - 2
    assert np.abs(np.cross(b - a, c - a)).sum() / 2 == pytest.approx(400 + 200 * 9)


def test_a_polygon_that_crosses_itself_is_a_fan(tmp_path):
    text = "v 0 0 0\nv 3 0 0\nv 1 1 0\nv 3 2 0\nv 2 -1 0\nf 1 2 3 4 5\n"
    assert read_obj(obj(tmp_path, text)).faces.shape == (3, 3)


def test_faces_without_texture_coordinates_leave_the_others_theirs_and_edges_are_passed_over(tmp_path):
    (tmp_path / "m.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.5 0.5\nvt 0.25 0.75\nf 1/2 2/2 3/2\nf 1//1 3//1 4//1\nf 1 2\n"
    )
    mesh = read_obj(tmp_path / "m.obj")
    assert len(mesh.faces) == 2 and mesh.corner_uv is not None
    np.testing.assert_array_equal(mesh.corner_uv[0], [[0.25, 0.75]] * 3)
    np.testing.assert_array_equal(mesh.corner_uv[1], [[0.5, 0.5]] * 3)


def test_texture_coordinates_belong_to_corners(tmp_path):
    text = SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\nf 1/4/1 2/3/1 3/2/1\nf 1/-4 2/-3 3/-2\n"
    mesh = read_obj(obj(tmp_path, text))
    assert mesh.corner_uv is not None
    np.testing.assert_array_equal(mesh.corner_uv[1], [[0, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(mesh.corner_uv[2], [[0, 1], [1, 1], [1, 0]])
    np.testing.assert_array_equal(mesh.corner_uv[3], [[0, 0], [1, 0], [1, 1]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (SQUARE + "f 1 2 3\nf 1\n", "mesh.obj:6: a face has 1 corners"),
        (SQUARE + "f 1 2 9\n", "names vertex 8 of 4"),
        (SQUARE + "f 0 1 2\n", "names vertex"),
        (SQUARE + "f 1 2 x\n", "not readable as OBJ"),
        (SQUARE + "vt 0 0\nf 1/1 2/1 3/2\n", "texture coordinate 2 of 1"),
        ("v 1 2\n", "fewer than 3 coordinates"),
        ("v 1 2 inf\nv 0 0 0\nv 1 0 0\nf 1 2 3\n", "1 vertices are not finite"),
        ("v 1 2 1e999999\nv 0 0 0\nv 1 0 0\nf 1 2 3\n", "not finite"),
        ("v 1 2 1e300\nv 0 0 0\nv 1 0 0\nf 1 2 3\n", "1 vertices are not finite numbers below 1e.12"),
        (SQUARE + "f 1 2 99999999999999999999999\n", "not readable as OBJ"),
    ],
)
def test_damage_is_named(tmp_path, text, words):
    with pytest.raises(SceneRejected, match=words):
        read_obj(obj(tmp_path, text))


def test_mtl_options_and_colours():
    text = "newmtl a\nKd 1 0.5 0\nmap_Kd -s 1 1 1 wood.png\nnewmtl b\nkd 0 nan 2\n newmtl c\nKd x\n"
    tabs = "newmtl\td e\nKd\t1\t0 0.5\nmap_Kd\twood.png\n"
    assert parse_mtl(tabs) == {"d e": ((255, 0, 128), "wood.png")}
    assert parse_mtl(text) == {
        "a": ((255, 128, 0), "-s 1 1 1 wood.png"),
        "b": ((0, 0, 255), ""),
        "c": ((170, 170, 170), ""),
    }


@pytest.mark.parametrize(
    ("text", "name", "unused"),
    [
        ("wood.png", "wood.png", {}),
        ("my wood 2.png", "my wood 2.png", {}),
        ("-blendu on -s 2 3 1 my wood.png", "my wood.png", {"-s": 1}),
        ("-blendv off -s 2 -o 0.5 -0.25 wood.png", "wood.png", {"-s": 1, "-o": 1}),
        ("-blendu on", "", {}),
        ("-s 2", "", {"-s": 1}),
        (
            "-mm 0.1 0.5 -bm 0.5 -imfchan r -clamp on -texres 512 -t 1 1 1 a.png",
            "a.png",
            {"-clamp": 1, "-imfchan": 1, "-mm": 1, "-t": 1},
        ),
    ],
)
def test_options_of_a_texture(text, name, unused):
    counted = collections.Counter()
    assert texture_name(text, counted) == name and +counted == unused


@pytest.mark.parametrize(
    ("options", "notes"),
    [
        ("", []), ("-o 0.5 ", ["m.mtl: not used: 1 -o"]), ("-clamp on ", ["m.mtl: not used: 1 -clamp"]),
        ("-s 1 1 1 ", []), ("-cc on ", ["m.mtl: not used: 1 -cc"]),
    ],
)  # fmt: skip
def test_options_of_a_texture_are_reported(tmp_path, options, notes):
    """The left half of the image is red, the right half green; u is 1.2 at two corners and 1.3 at the third."""
    Image.fromarray(np.array([[(200, 0, 0), (0, 200, 0)]], np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "m.mtl").write_text(f"newmtl a\nd 1\nTr 0\nmap_Kd {options}a.png\n")
    text = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 1.2 0.5\nvt 1.2 0.5\nvt 1.3 0.5\nusemtl a\nf 1/1 2/2 3/3\n"
    (tmp_path / "m.obj").write_text(text)
    source = SourceFolder(tmp_path)
    mesh = read_scan_obj(source, "m.obj", "")
    assert mesh.texture is not None and mesh.corner_uv is not None
    assert texels(mesh.texture, mesh.corner_uv[0]).tolist() == [[200, 0, 0]] * 3
    assert source.warnings == notes


def test_transparency_of_materials_is_reported(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\nd 0.4\nnewmtl b\nd 1.0\ndisp wood.png\nTr 0.5\n")
    (tmp_path / "m.obj").write_text(SQUARE.replace("v 0 0 0", "mtllib m.mtl\nusemtl a\nv 0 0 0") + "f 1 2 3\n")
    source = SourceFolder(tmp_path)
    read_scan_obj(source, "m.obj", "")
    assert source.warnings == ["m.mtl: not used: 1 Tr", "m.mtl: not used: 1 d"]


@pytest.mark.parametrize(
    "change",
    [
        str,
        lambda t: t.replace(" ", "\t"),
        lambda t: t.replace("v 1 1 0", "v 1 \\\n 1 0"),
        lambda t: "\ufeff" + t.replace("\n", "\r\n"),
        lambda t: t.replace("\nf", " # a corner, 1,5 high\nf"),
    ],
)
def test_tabs_continued_lines_marks_and_comments(tmp_path, change):
    path = tmp_path / "m.obj"
    path.write_bytes(change(SQUARE + "f 1 2 3\nf 1 3 4\n").encode())
    mesh = read_obj(path)
    np.testing.assert_array_equal(mesh.vertices, [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    np.testing.assert_array_equal(mesh.faces, [(0, 1, 2), (0, 2, 3)])


@pytest.mark.parametrize("line", ["v 0,5 1,0 0,0", "v 0,5,1", "vt 0,5 0,5"])
def test_decimal_commas_are_named(tmp_path, line):
    with pytest.raises(SceneRejected, match="decimal commas, expected points.*; export it again"):
        read_obj(obj(tmp_path, SQUARE + line + "\nf 1 2 3\n"))


@pytest.mark.parametrize("of", ["1 0.5 0", "255 128 0", "0.9 1 0.5 0", "1 0.5 none"])
def test_colours_of_vertices_are_kept_where_no_texture_is(tmp_path, of):
    """The textured face keeps its texture; a plain material gives way, as in mesh viewers."""
    source = two_materials(tmp_path)
    path = tmp_path / "mesh.obj"
    lines = path.read_text().splitlines()
    path.write_text("".join(f"{line} {of}\n" if line[:2] == "v " else f"{line}\n" for line in lines))
    mesh = read_scan_obj(source, "mesh.obj", "")
    assert [tuple(map(int, sampled(mesh, k))) for k in range(3)] == [(255, 0, 0), (255, 128, 0), (255, 128, 0)]
    path.write_text("v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nf 1 2 3\n")
    assert tuple(sampled(read_scan_obj(SourceFolder(tmp_path), "mesh.obj", ""), 0)) == (85, 85, 85)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_names_with_umlauts_and_spaces_and_several_libraries(tmp_path, encoding):
    Image.fromarray(np.full((2, 2, 3), (0, 9, 0), np.uint8)).save(tmp_path / unicodedata.normalize("NFD", "Büro ä.png"))
    (tmp_path / "Möbel 1.mtl").write_bytes("newmtl Stuhl ü\r\nmap_Kd Büro ä.png\r\n".encode(encoding))
    (tmp_path / "b.mtl").write_text("newmtl plain\nKd 0 0 1\n")
    text = "mtllib Möbel 1.mtl\nmtllib c.mtl b.mtl\n" + SQUARE
    text += "vt 0.5 0.5\nusemtl Stuhl ü\nf 1/1 2/1 3/1\nusemtl plain\nf 1 3 4\n"
    (tmp_path / "mesh.obj").write_bytes(text.encode(encoding))
    mesh = read_scan_obj(SourceFolder(tmp_path), "mesh.obj", "")
    assert [tuple(map(int, sampled(mesh, k))) for k in range(2)] == [(0, 9, 0), (0, 0, 255)]


def test_what_is_not_used_is_said_once(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\nKe 0 0.0 0.000\nmap_d x.png\nmap_Bump y.png\nKe 1 0 0\nNs 9\n")
    lines = "s off\no thing\n# word\nvn 0 0 1\nl 1 2\nl 2 3\ncurv 0 1 1 2\n"
    obj(tmp_path, f"mtllib m.mtl\n{SQUARE}{lines}usemtl a\nf 1 2 3\n")
    source = SourceFolder(tmp_path)
    read_scan_obj(source, "mesh.obj", "")
    assert source.warnings == [
        "mesh.obj: not used: 1 curv", "mesh.obj: not used: 2 l", "m.mtl: not used: 1 Ke", "m.mtl: not used: 1 map_d",
    ]  # fmt: skip


def sampled(mesh: TexturedMesh, face: int) -> np.ndarray:
    """Colour at the middle of a face."""
    assert mesh.corner_uv is not None and mesh.texture is not None
    u, v = mesh.corner_uv[face].mean(axis=0)
    height, width = mesh.texture.shape[:2]
    return mesh.texture[int((1 - v) * height), int(u * width)]


def two_materials(tmp_path, red: str = "red.png"):
    Image.fromarray(np.full((8, 4, 3), (255, 0, 0), np.uint8)).save(tmp_path / "red.png")
    (tmp_path / "m.mtl").write_text(f"newmtl red\nmap_Kd {red}\nnewmtl plain\nKd 0 0 1\n")
    uv = "vt 5.2 -3.9\nvt 5.9 -3.9\nvt 5.9 -3.1\n"  # a repeat: [0.2, 0.9] x [0.1, 0.9] of the image
    faces = "usemtl red\nf 1/1 2/2 3/3\nusemtl plain\nf 1/1 3/3 4/3\nusemtl none\nf 1/1 2/2 4/3\n"
    obj(tmp_path, f"mtllib m.mtl\n{SQUARE}{uv}{faces}")
    return SourceFolder(tmp_path)


def test_several_materials_share_one_image(tmp_path):
    source = two_materials(tmp_path)
    mesh = read_scan_obj(source, "mesh.obj", "")
    np.testing.assert_array_equal(sampled(mesh, 0), (255, 0, 0))
    np.testing.assert_array_equal(sampled(mesh, 1), (0, 0, 255))
    np.testing.assert_array_equal(sampled(mesh, 2), (170, 170, 170))
    assert mesh.texture is not None and mesh.texture.shape == (8 + 4 + 4 + 3 * 4, 4 + 4, 3)
    assert source.warnings == ["mesh.obj: material 'none' is in no material file; it stays grey"]
    assert sorted(source.sha256) == ["m.mtl", "mesh.obj", "red.png"]


@pytest.mark.parametrize("name", ["C:\\scans\\home\\red.png", "/home/someone/RED.png", "textures/red.png"])
def test_a_texture_is_found_by_its_bare_name(tmp_path, name):
    source = two_materials(tmp_path, name)
    np.testing.assert_array_equal(sampled(read_scan_obj(source, "mesh.obj", ""), 0), (255, 0, 0))
    assert any("which is not there; red.png is taken" in w for w in source.warnings)
    strict = SourceFolder(tmp_path, strict=True)
    with pytest.raises(SceneRejected, match="red.png is taken; --strict refuses"):
        read_scan_obj(strict, "mesh.obj", "")


@pytest.mark.parametrize("name", ["x" * 300 + ".png", "a/" * 3000 + "b.png", "x\x1b[2Jy.png"])
def test_names_that_no_file_can_have_are_missing_files(tmp_path, name):
    source = two_materials(tmp_path, name)
    np.testing.assert_array_equal(sampled(read_scan_obj(source, "mesh.obj", ""), 0), (170, 170, 170))
    shown = name.replace("\x1b", "\\x1b")
    assert any(w.startswith(f"m.mtl: names the texture '{shown}', which is missing") for w in source.warnings)
    assert not source.has(name)
    with pytest.raises(SceneRejected, match="no such file; put it there"):
        source.use(name, "put it there")


def test_nothing_outside_the_folder_is_read(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    Image.fromarray(np.full((2, 2, 3), 9, np.uint8)).save(tmp_path / "secret.png")
    source = two_materials(inner, "../secret.png")
    mesh = read_scan_obj(source, "mesh.obj", "")
    np.testing.assert_array_equal(sampled(mesh, 0), (170, 170, 170))
    assert (
        "m.mtl: names the texture '../secret.png', which lies outside of the source folder; the material's plain "
        "colour is taken"
    ) in (source.warnings)


@pytest.mark.parametrize("name", ["mesh.obj", "m.mtl", "red.png"])
def test_a_link_out_of_the_folder_is_refused(tmp_path, name):
    inner = tmp_path / "inner"
    inner.mkdir()
    source = two_materials(inner)
    (inner / name).rename(tmp_path / name)
    (inner / name).symlink_to(tmp_path / name)
    with pytest.raises(SceneRejected, match=f"inner/{name}: leads out of the source folder, to .*/{name}; put a copy"):
        read_scan_obj(source, "mesh.obj", "")
    assert name not in source.sha256
    (inner / name).unlink()
    (inner / name).symlink_to(inner / name)
    with pytest.raises(SceneRejected, match=f"inner/{name}: leads nowhere"):
        read_scan_obj(SourceFolder(inner), "mesh.obj", "")


def test_a_link_within_the_folder_is_followed(tmp_path):
    source = two_materials(tmp_path)
    (tmp_path / "images").mkdir()
    (tmp_path / "red.png").rename(tmp_path / "images" / "red.png")
    (tmp_path / "red.png").symlink_to("images/red.png")
    np.testing.assert_array_equal(sampled(read_scan_obj(source, "mesh.obj", ""), 0), (255, 0, 0))
    assert "images/red.png" in source.sha256 and source.root == tmp_path


def test_joining_keeps_each_mesh_its_colour():
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    uv = np.full((1, 3, 2), 0.5)
    red = TexturedMesh(vertices, faces, uv, np.full((2, 6, 3), (250, 0, 0), np.uint8))
    green = TexturedMesh(vertices, faces, uv, np.full((4, 2, 3), (0, 250, 0), np.uint8))
    both = join_meshes(join_meshes(red, green), TexturedMesh(vertices, faces, None, None))
    assert [tuple(sampled(both, k)) for k in range(3)] == [(250, 0, 0), (0, 250, 0), (170, 170, 170)]
    np.testing.assert_array_equal(both.faces, [[0, 1, 2], [3, 4, 5], [6, 7, 8]])


def test_one_image_stays_untouched():
    uv, image = np.random.default_rng(0).random((2, 3, 2)) * 3, np.zeros((5, 5, 3), np.uint8)
    same_uv, same = join_textures(uv, np.zeros(2, int), [image])
    assert same is image and same_uv is uv
