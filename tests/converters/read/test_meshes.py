"""Mesh files of every kind: textures beside and above them, COLLADA's unit and axis, links, damage."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.read.annotations import read_cad
from converters.read.files import SourceFolder
from converters.read.meshes import colours_of_faces, read_surface
from converters.records.errors import SceneRejected

RED = (200, 30, 10)
CAD = "cad/04379243/t/models/model_normalized.obj"
TRIANGLES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 1\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/2\n"


def image(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((4, 4, 3), RED, np.uint8)).save(path)
    return path


def shapenet(root: Path, texture: str = "../images/t.png") -> SourceFolder:
    obj = root / CAD
    obj.parent.mkdir(parents=True)
    obj.write_text("mtllib m.mtl\nusemtl a\n" + TRIANGLES)
    obj.with_name("m.mtl").write_text(f"newmtl a\nKd 1 1 1\nmap_Kd {texture}\n")
    return SourceFolder(root)


def test_a_cad_models_texture_in_a_folder_beside_its_own_is_loaded(tmp_path):
    source = shapenet(tmp_path)
    image(tmp_path / "cad/04379243/t/images/t.png")
    cad = read_cad(source, "04379243", "t")
    assert (cad.face_colours == RED).all()
    assert cad.surface is not None and cad.surface.texture is not None
    assert (cad.surface.texture == RED).all() and cad.surface.texture.shape == (4, 4, 3)
    assert np.allclose(np.sort(cad.surface.vertices, axis=0), np.sort(cad.vertices, axis=0))
    assert "cad/04379243/t/images/t.png" in source.sha256
    assert not [w for w in source.warnings if "texture" in w]


def test_a_cad_models_missing_or_broken_texture_is_said(tmp_path):
    source = shapenet(tmp_path)
    assert (read_cad(source, "04379243", "t").face_colours == 255).all()
    assert any("names the texture '../images/t.png', which is missing" in w for w in source.warnings)
    image(tmp_path / "cad/04379243/t/images/t.png").write_bytes(b"no image")
    source = SourceFolder(tmp_path)
    assert (read_cad(source, "04379243", "t").face_colours == 255).all()
    assert any("cad/04379243/t/images/t.png: not readable as an image" in w for w in source.warnings)


@pytest.mark.data
def test_the_sample_rooms_table_is_wooden(sample_data):
    source = SourceFolder(sample_data / "scan2cad_scene0470_00")
    cad = read_cad(source, "04379243", "142060f848466cad97ef9a13efb5e3f7")
    red, green, blue = cad.face_colours.mean(axis=0)
    assert 180 < red < 230 and green < red - 15 and blue < green - 10


def gltf(root: Path, uri: str = "../images/t.png") -> SourceFolder:
    solid = trimesh.creation.box((1, 1, 1))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), RED))
    solid.visual = trimesh.visual.TextureVisuals(np.full((8, 2), 0.5), material=material)
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(solid))
    (root / "models").mkdir(parents=True)
    for name, content in files.items():
        (root / "models" / name).write_bytes(content)
    tree = json.loads((root / "models/model.gltf").read_text())
    tree["images"] = [{"uri": uri}]
    (root / "models/model.gltf").write_text(json.dumps(tree))
    return SourceFolder(root)


def test_a_gltfs_files_are_read_within_the_source_and_hashed(tmp_path):
    source = gltf(tmp_path)
    image(tmp_path / "images/t.png")
    assert (colours_of_faces(read_surface(source, "models/model.gltf", "")) == RED).all()
    assert "images/t.png" in source.sha256 and any(name.endswith(".bin") for name in source.sha256)
    assert source.warnings == []


def test_a_gltfs_texture_outside_of_the_source_is_not_read(tmp_path):
    image(tmp_path / "secret.png")
    source = gltf(tmp_path / "inner", "../../secret.png")
    assert not (colours_of_faces(read_surface(source, "models/model.gltf", "")) == RED).any()
    assert any("'../../secret.png', which lies outside of the source folder" in w for w in source.warnings)
    (tmp_path / "inner/models/link.png").symlink_to(tmp_path / "secret.png")
    path = tmp_path / "inner/models/model.gltf"
    path.write_text(path.read_text().replace("../../secret.png", "link.png"))
    source = SourceFolder(tmp_path / "inner")
    with pytest.raises(SceneRejected, match="link.png: leads out of the source folder"):
        read_surface(source, "models/model.gltf", "")


def test_colours_of_vertices_count(tmp_path):
    solid = trimesh.creation.box((1, 1, 1))
    solid.visual = trimesh.visual.ColorVisuals(solid, vertex_colors=np.full((8, 3), RED, np.uint8))
    solid.export(tmp_path / "box.ply")
    assert (colours_of_faces(read_surface(SourceFolder(tmp_path), "box.ply", "")) == RED).all()


DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{asset}</asset>
<library_images><image id="im" name="im"><init_from>{texture}</init_from></image></library_images>
<library_effects><effect id="ef"><profile_COMMON>
<newparam sid="su"><surface type="2D"><init_from>im</init_from></surface></newparam>
<newparam sid="sa"><sampler2D><source>su</source></sampler2D></newparam>
<technique sid="t"><lambert><diffuse><texture texture="sa" texcoord="UV"/></diffuse></lambert></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="ma" name="ma"><instance_effect url="#ef"/></material></library_materials>
<library_geometries><geometry id="ge" name="ge"><mesh>
<source id="p"><float_array id="pa" count="12">0 0 0 10 0 0 0 20 0 0 0 30</float_array><technique_common>
<accessor source="#pa" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<source id="u"><float_array id="ua" count="2">0.5 0.5</float_array><technique_common>
<accessor source="#ua" count="1" stride="2"><param name="S" type="float"/><param name="T" type="float"/></accessor>
</technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4" material="m"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="TEXCOORD" source="#u" offset="1" set="0"/>
<p>0 0 2 0 1 0 0 0 1 0 3 0 0 0 3 0 2 0 1 0 2 0 3 0</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="vs"><node id="n"><instance_geometry url="#ge">
<bind_material><technique_common>
<instance_material symbol="m" target="#ma"/></technique_common></bind_material></instance_geometry>
</node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#vs"/></scene></COLLADA>
"""


def test_emission_and_vertex_colours_beside_a_material_are_reported(tmp_path):
    source = dae(tmp_path, "")
    path = next(tmp_path.rglob("*.dae"))
    relative = source.inside(path)
    text = path.read_text()
    read_surface(source, relative, "")
    assert not any("not used" in w for w in source.warnings)
    glow = "<emission><color sid='emission'>{} 0 0 1</color></emission>"
    lit = text.replace("<lambert>", "<lambert>" + glow.format(0.5)).replace(
        "<p>", '<input semantic="COLOR" source="#p" offset="0"/><p>'
    )
    path.write_text(lit)
    source = SourceFolder(tmp_path)
    read_surface(source, relative, "")
    assert {w for w in source.warnings if "not used" in w} == {
        f"{relative}: not used: 1 emission",
        f"{relative}: not used: 1 colours of vertices beside a material",
    }
    path.write_text(text.replace("<lambert>", "<lambert>" + glow.format("0.000000")))
    source = SourceFolder(tmp_path)
    read_surface(source, relative, "")
    assert not any("not used" in w for w in source.warnings)


def dae(root: Path, asset: str, texture: str = "../images/t%20t.png") -> SourceFolder:
    pytest.importorskip("collada")
    (root / "models").mkdir(exist_ok=True)
    (root / "models/m.dae").write_text(DAE.format(asset=asset, texture=texture))
    return SourceFolder(root)


@pytest.mark.parametrize(
    ("asset", "size"),
    [
        ('<unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis>', (0.1, 0.2, 0.3)),
        ('<unit meter="0.01"/>', (0.1, 0.3, 0.2)),  # y up where nothing is said
        ("<up_axis>X_UP</up_axis>", (20, 30, 10)),
        ("", (10, 30, 20)),
    ],
)
def test_colladas_unit_and_axis_hold(tmp_path, asset, size):
    image(tmp_path / "images/t t.png")
    source = dae(tmp_path, asset)
    mesh = read_surface(source, "models/m.dae", "")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), size)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    assert solid.volume == pytest.approx(np.prod(size) / 6)  # turned, not mirrored: faces look outwards
    assert (colours_of_faces(mesh) == RED).all() and "images/t t.png" in source.sha256 and source.warnings == []


def test_colladas_missing_texture_and_strange_unit_are_said(tmp_path):
    source = dae(tmp_path, "")
    assert (colours_of_faces(read_surface(source, "models/m.dae", "")) == 255).all()
    assert source.warnings == [
        "models/m.dae: names the texture '../images/t%20t.png', which is missing; the material's plain colour is taken"
    ]
    with pytest.raises(SceneRejected, match="--strict refuses"):
        read_surface(SourceFolder(tmp_path, strict=True), "models/m.dae", "")
    for asset in ('<unit meter="0"/>', '<unit meter="cm"/>', "<up_axis>W_UP</up_axis>"):
        with pytest.raises(SceneRejected, match="expected a positive number and one of X_UP, Y_UP, Z_UP"):
            read_surface(dae(tmp_path, asset), "models/m.dae", "")


PLACES = np.array([(448262.0001, 5411932.0003, 520.00001), (448263, 5411932.0003, 520), (448263, 5411933.0007, 520.5)])


@pytest.mark.parametrize(("kind", "order"), [("ascii", "<"), ("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_doubles_of_a_ply_keep_all_digits_and_other_properties_are_said(tmp_path, kind, order):
    fields = [("x", "double"), ("y", "double"), ("z", "double"), ("quality", "float"), ("red", "uchar"),
              ("green", "uchar"), ("blue", "uchar")]  # fmt: skip
    head = f"ply\nformat {kind} 1.0\nelement vertex 3\n" + "".join(f"property {t} {name}\n" for name, t in fields)
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text = "".join(f"{' '.join(repr(float(v)) for v in row)} 0.5 60 90 160\n" for row in PLACES) + "3 0 1 2\n"
    data = b"".join(struct.pack(f"{order}3df3B", *row, 0.5, 60, 90, 160) for row in PLACES)
    data += struct.pack(f"{order}B3i", 3, 0, 1, 2)
    (tmp_path / "m.ply").write_bytes(head.encode() + (text.encode() if kind == "ascii" else data))
    source = SourceFolder(tmp_path)
    mesh = read_surface(source, "m.ply", "")
    np.testing.assert_array_equal(mesh.vertices, PLACES)
    assert tuple(colours_of_faces(mesh)[0]) == (60, 90, 160)
    assert source.warnings == ["m.ply: not used: 1 property quality"]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", []),
        ("COFF\n3 1 0\n0 0 0 9 9 9 9\n1 0 0 9 9 9 9\n0 1 0 9 9 9 9\n3 0 1 2\n", ["1 colours of vertices"]),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 200 0 0\n", ["1 colours of faces"]),
    ],
)
def test_colours_of_an_off_file_are_said(tmp_path, text, what):
    (tmp_path / "m.off").write_text(text)
    source = SourceFolder(tmp_path)
    assert len(read_surface(source, "m.off", "").faces) == 1
    assert source.warnings == [f"m.off: not used: {each}" for each in what]


def test_colours_of_an_stl_file_are_reported(tmp_path):
    triangle = np.array([(0, 0, 1), (0, 0, 0), (1, 0, 0), (0, 1, 0)], "<f4").tobytes()
    (tmp_path / "m.stl").write_bytes(b" " * 80 + struct.pack("<I", 2) + (triangle + b"\0\0") + (triangle + b"\x1f\x80"))
    source = SourceFolder(tmp_path)
    assert len(read_surface(source, "m.stl", "").faces) == 2
    assert source.warnings == ["m.stl: not used: 1 colours of faces"]


def test_textures_of_a_collada_file_that_do_not_repeat_are_reported(tmp_path):
    image(tmp_path / "images/t t.png")
    source = dae(tmp_path, "")
    path = tmp_path / "models/m.dae"
    more = "<extra><sampler2D><wrap_s>WRAP</wrap_s><wrap_t>CLAMP</wrap_t></sampler2D></extra>"
    path.write_text(path.read_text().replace("</COLLADA>", f"{more}</COLLADA>"))
    read_surface(source, "models/m.dae", "")
    assert source.warnings == ["models/m.dae: not used: 1 textures that do not repeat"]


def test_what_of_a_collada_file_is_not_used_is_said(tmp_path):
    image(tmp_path / "images/t t.png")
    source = dae(tmp_path, "")
    path = tmp_path / "models/m.dae"
    more = '<library_animations><animation id="a"/><animation id="b"/></library_animations>'
    path.write_text(path.read_text().replace("<library_images>", f"{more}<library_images>"))
    read_surface(source, "models/m.dae", "")
    assert source.warnings == ["models/m.dae: not used: 2 animation"]
