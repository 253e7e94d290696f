"""MJCF homes: rooms written here, and a scene of our own read back; files outside of the folder are refused."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from converters.__main__ import main
from converters.geometry.faces import face_areas, face_labels
from converters.pipeline import ConvertConfig, convert
from converters.read.homes.mjcf import read_mjcf
from converters.read.source import detect_format, read_source
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR
from scenes_mjcf.schema import load_manifest

SCENES = Path(__file__).parents[4] / "scenes_mjcf"
ROOM = """<mujoco>
<compiler meshdir="parts"/>
<asset><mesh name="top" file="top.obj"/></asset>
<worldbody>
<geom type="plane" size="2 1.5 0.1"/>
<body name="walls"><geom type="box" pos="0 1.55 1.2" size="2 0.05 1.2"/>
<geom type="box" pos="0 -1.55 1.2" size="2 0.05 1.2"/>
<geom type="box" pos="2.05 0 1.2" size="0.05 1.5 1.2"/><geom type="box" pos="-2.05 0 1.2" size="0.05 1.5 1.2"/></body>
<body name="chair_1" pos="-1 0.5 0" euler="0 0 90"><freejoint/>
<geom type="box" pos="0 0 0.2" size="0.2 0.25 0.2" mass="4" friction="0.7 0 0"/>
<geom type="box" pos="-0.15 0 0.6" size="0.05 0.25 0.2" mass="2" friction="0.4 0 0"/></body>
<body name="kitchen"><body name="table" pos="0.9 0.4 0"><geom type="mesh" mesh="top" pos="0 0 0.35" mass="20"/>
<body name="vase" pos="0 0 0.8"><geom type="cylinder" size="0.05 0.1"/></body></body></body>
<body name="drawer" pos="-1.8 -1.2 0.4"><joint type="slide" axis="0 1 0"/><geom type="box" size="0.1 0.1 0.4"/></body>
<include file="more.xml"/>
</worldbody></mujoco>"""
SMALL = ConvertConfig(structure_texture=64, object_texture=32, jobs=1)
MORE = """<mujocoinclude>
<body name="tall_thing" pos="1.5 -1 0.5"><geom type="capsule" size="0.1 0.4"/></body>
</mujocoinclude>"""


def write_room(root: Path, assets: str = "</asset>") -> Path:
    (root / "parts").mkdir(parents=True)
    trimesh.creation.box((0.8, 0.6, 0.7)).export(root / "parts" / "top.obj")
    (root / "more.xml").write_text(MORE)
    (root / "home.xml").write_text(ROOM.replace("</asset>", assets))
    return root


def test_free_bodies_and_named_furniture_move_and_the_rest_is_structure(tmp_path):
    root = write_room(tmp_path / "home")
    raw = read_mjcf(root)
    assert detect_format(root) == "mjcf" and {a.category for a in raw.annotations} == {"chair", "table"}
    chair, table = (next(a for a in raw.annotations if a.category == c) for c in ("chair", "table"))
    np.testing.assert_allclose(chair.pose[:3, 3], [-1, 0.5, 0], atol=1e-9)
    np.testing.assert_allclose(chair.pose[:3, 0], [0, 1, 0], atol=1e-9)
    cad = raw.cads[chair.cad_id]
    assert cad.mass_kg == pytest.approx(6.0) and cad.friction == pytest.approx(0.7)
    assert cad.pieces is not None and len(cad.pieces) == 2
    np.testing.assert_allclose(
        [cad.vertices.min(0), cad.vertices.max(0)], [[-0.2, -0.25, 0], [0.2, 0.25, 0.8]], atol=1e-6
    )
    top = raw.cads[table.cad_id].vertices @ table.pose[:3, :3].T + table.pose[:3, 3]
    np.testing.assert_allclose([top.min(0), top.max(0)], [[0.5, 0.1, 0], [1.3, 0.7, 0.9]], atol=1e-5)  # with its vase
    area = face_areas(raw.scan.vertices, raw.scan.faces)
    assert area[face_labels(raw.scan.labels, raw.scan.faces) == FLOOR].sum() == pytest.approx(4.2 * 3.2, rel=0.03)
    assert set(raw.sources) == {"home.xml", "more.xml", "parts/top.obj"}


@pytest.mark.parametrize(
    "changes",
    [
        (('size="2 1.5 0.1"', 'size="0 0 1"'),),
        (('size="2 1.5 0.1"', 'size="50 50 1"'),),
    ],
    ids=["no end", "large"],
)  # fmt: skip
def test_planes_are_floor(tmp_path, changes):
    root = write_room(tmp_path / "home")
    change(root, *changes)
    raw = read_mjcf(root)
    assert raw.floor_height_m == pytest.approx(0.0, abs=1e-5)
    area = face_areas(raw.scan.vertices, raw.scan.faces)
    assert area[face_labels(raw.scan.labels, raw.scan.faces) == FLOOR].sum() == pytest.approx(4.2 * 3.2, rel=0.03)
    assert {a.category for a in raw.annotations} == {"chair", "table"}


@pytest.mark.parametrize(
    ("geom", "colour"),
    [('material="m"', (255, 0, 0)), ('material="m" rgba="0 0 1 1"', (0, 0, 255)), ('rgba="0 1 0 1"', (0, 255, 0))],
)
def test_a_geoms_own_colour_takes_the_place_of_its_materials(tmp_path, geom, colour):
    root = write_room(tmp_path / "home")
    change(
        root, ("</asset>", '<material name="m" rgba="1 0 0 1"/></asset>'), ('mesh="top" pos', f'mesh="top" {geom} pos')
    )
    raw = read_mjcf(root)
    (table,) = (raw.cads[a.cad_id] for a in raw.annotations if a.category == "table")
    assert (table.face_colours == colour).all(axis=1).any()


def test_a_room_becomes_a_scene_that_passes_its_gates(tmp_path, hull_cache):
    made = convert(
        write_room(tmp_path / "home"),
        tmp_path / "scene",
        SMALL,
        cache=hull_cache,
    )
    assert [g.name for g in made.gates if not g.passed] == []
    assert {o.category: o.mass_kg for o in made.manifest.objects}["chair"] == pytest.approx(6.0)


def test_a_scene_of_our_own_comes_back(tmp_path):
    name = "apartment_0"
    raw, manifest = read_mjcf(SCENES / name), load_manifest(SCENES / name)
    model = mujoco.MjModel.from_xml_path(str(SCENES / name / "scene.xml"))
    movable = {o.name: o for o in manifest.objects}
    assert sorted(a.category for a in raw.annotations) == sorted(o.category for o in movable.values())
    found = {a.cad_id: a for a in raw.annotations}
    for name, o in movable.items():
        body = model.body(name)
        assert raw.cads[name].mass_kg == pytest.approx(o.mass_kg, rel=1e-3)
        if o.category != "door":
            np.testing.assert_allclose(found[name].pose[:3, 3], body.pos, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('file="top.obj"', 'file="../../outside.obj"', "leads out of the source folder"),
        ('file="top.obj"', 'file="/etc/passwd"', "leads out of the source folder"),
        ('meshdir="parts"', 'meshdir="../.."', "leads out of the source folder"),
        ('file="more.xml"', 'file="home.xml"', "does one include itself"),
        ('file="more.xml"', 'file="absent.xml"', "no such file"),
        ('type="capsule"', 'type="donut"', "MuJoCo refuses it"),
        ('pos="-1 0.5 0"', 'pos="NaN 0.5 0"', "home.xml: a geom stands at no usable place"),
        ("</worldbody>", "", "not readable as MJCF|no known layout|are none"),
    ],
)
def test_bad_homes_are_one_line(tmp_path, old, new, message):
    root = write_room(tmp_path / "a" / "home")
    (tmp_path / "outside.obj").write_text("v 0 0 0\n")
    for path in (root / "home.xml", root / "more.xml"):
        path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SceneRejected, match=message) as refusal:
        read_mjcf(root)
    assert "\n" not in str(refusal.value)


def size_of_top(root: Path, within: Path | None = None) -> float:
    """Width of the table's top as we read it."""
    raw = read_mjcf(root, within=within)
    table = next(a for a in raw.annotations if a.category == "table")
    return float(np.ptp(raw.cads[table.cad_id].vertices[:, 0]))


def size_in_mujoco(root: Path) -> float:
    model = mujoco.MjModel.from_xml_path(str(root / "home.xml"))
    return float(np.ptp(model.mesh_vert, axis=0).max())  # its frame is the inertia's


def change(root: Path, *changes: tuple[str, str]) -> None:
    for old, new in changes:
        for path in (root / "home.xml", root / "more.xml"):
            path.write_text(path.read_text().replace(old, new))


ASSET = '<asset><mesh name="top" file="top.obj"/></asset>'
NESTED = (("<worldbody>\n<geom", '<include file="deep/own.xml"/><worldbody>\n<geom'), (ASSET, ""))
"""The mesh is named by a file in a folder of its own, which the home includes."""


@pytest.mark.parametrize(
    ("changes", "size"),
    [
        ((("</mujoco>", '<compiler meshdir="late"/></mujoco>'),), 0.9),
        ((("</mujoco>", '<compiler assetdir="late"/></mujoco>'),), 0.9),
        ((('meshdir="parts"', 'meshdir="parts" assetdir="late"'),), 0.8),
        ((('file="top.obj"', 'file="../late/top.obj"'),), 0.9),
        ((('file="top.obj"', 'file="..\\late\\top.obj"'),), 0.9),
        ((('file="top.obj"', 'file="../../absent/top.obj"'), ("meshdir", 'strippath="true" meshdir')), 0.8),
        (NESTED, 0.8),
        ((*NESTED, ('meshdir="parts"', "")), 1.1),
        ((*NESTED, ('meshdir="parts"', 'meshdir="nowhere"')), 1.1),
        ((*NESTED, ("deep/own.xml", "deep/on.xml")), 0.8),
    ],
)
def test_names_mean_what_they_mean_to_mujoco(tmp_path, changes, size):
    root = write_room(tmp_path / "home")
    for folder, width in (("late", 0.9), ("deep", 1.1)):
        (root / folder).mkdir()
        trimesh.creation.box((width, 0.6, 0.7)).export(root / folder / "top.obj")
    (root / "deep" / "own.xml").write_text(f"<x>{ASSET}</x>")
    (root / "deep" / "on.xml").write_text('<x><include file="own.xml"/></x>')
    change(root, *changes)
    assert size_in_mujoco(root) == pytest.approx(size, abs=1e-5)
    assert size_of_top(root) == pytest.approx(size, abs=1e-5)


@pytest.mark.parametrize(
    ("changes", "own"),
    [
        (
            (("</mujoco>", '<include file="deep/own.xml"/></mujoco>'),),
            '<compiler meshdir=".."/>',
        ),  # the last one counts
        (NESTED, ASSET.replace("top.obj", "../../top.obj")),  # below the including file's folder it lies within
        (NESTED, '<include file="../own.xml"/>'),
        ((('file="top.obj"', 'file="link.obj"'),), ""),
        ((*NESTED, ("deep/own.xml", "link.xml")), ""),
    ],
)
def test_no_file_outside_of_the_folder_is_read(tmp_path, changes, own):
    outside, root = tmp_path / "outside", tmp_path / "outside" / "home"
    write_room(root)
    for path, width in ((outside, 3.0), (root / "deep", 0.8), (root / "parts", 0.8), (root, 0.8)):
        path.mkdir(exist_ok=True)
        trimesh.creation.box((width, 0.6, 0.7)).export(path / "top.obj")
    (outside / "own.xml").write_text(f'<x><asset><mesh name="top" file="{outside / "top.obj"}"/></asset></x>')
    (root / "deep" / "own.xml").write_text(f"<x>{own}</x>")
    (root / "own.xml").write_text(f"<x>{ASSET}</x>")
    (root / "parts" / "link.obj").symlink_to(outside / "top.obj")
    (root / "link.xml").symlink_to(outside / "own.xml")
    change(root, *changes)
    assert size_in_mujoco(root) == pytest.approx(3.0, abs=1e-5)  # MuJoCo itself reads what lies outside
    with pytest.raises(SceneRejected, match="leads out of the source folder.*--root DIR"):
        read_mjcf(root)
    assert size_of_top(root, outside) == pytest.approx(3.0, abs=1e-5)  # with --root


def test_a_folder_that_may_be_read_is_named(tmp_path, capsys, monkeypatch, hull_cache):
    root = write_room(tmp_path / "assets" / "arenas")
    (root / "parts").rename(tmp_path / "assets" / "parts")
    change(root, ('meshdir="parts"', 'meshdir="../parts"'))
    monkeypatch.setattr("converters.pipeline.cache_folder", lambda: hull_cache)
    command = ["convert", str(root / "home.xml"), str(tmp_path / "out"), "--jobs", "1", "structure_texture=64"]
    assert main(command) == 2 and "--root DIR" in " ".join(capsys.readouterr().err.split())
    assert main([*command, "--root", str(tmp_path / "assets")]) == 0
    assert {o.category for o in load_manifest(tmp_path / "out").objects} == {"chair", "table"}
    (tmp_path / "outside.obj").write_text("v 0 0 0\n")
    top = tmp_path / "assets" / "parts" / "top.obj"
    top.unlink()
    top.symlink_to(tmp_path / "outside.obj")
    with pytest.raises(SceneRejected, match="leads out of the source folder"):
        read_source(root, within=tmp_path / "assets")
    top.rename(tmp_path / "scan.obj")
    with pytest.raises(SceneRejected, match="--root .* is for MJCF and Gazebo homes"):
        read_source(tmp_path / "scan.obj", within=tmp_path)


def test_models_to_attach_are_read_and_their_number_has_an_end(tmp_path):
    root = write_room(tmp_path / "home")
    child = '<mujoco><asset>{}</asset><worldbody><body name="b">{}</body></worldbody></mujoco>'
    (root / "sub").mkdir()
    (root / "sub" / "pot.xml").write_text(
        child.format('<mesh name="pot" file="pot.obj"/>', '<geom type="mesh" mesh="pot"/>')
    )
    trimesh.creation.box((0.2, 0.2, 0.4)).export(root / "sub" / "pot.obj")
    attach = '<attach model="m" body="b" prefix="p_"/><include file="more.xml"/>'
    change(
        root,
        (ASSET, ASSET[:-8] + '<model name="m" file="sub/pot.xml"/></asset>'),
        ('<include file="more.xml"/>', attach),
    )
    assert {"sub/pot.xml", "sub/pot.obj"} <= set(read_mjcf(root).sources)
    for k in range(12):
        threefold = "".join(f'<model name="m{i}" file="m{k + 1}.xml"/>' for i in range(3))
        (root / "sub" / f"m{k}.xml").write_text(child.format(threefold, ""))
    change(root, ("sub/pot.xml", "sub/m0.xml"))
    (root / "sub" / "m12.xml").write_text(child.format("", ""))
    with pytest.raises(SceneRejected, match="1,001 MJCF files, expected at most 1,000"):
        read_mjcf(root)


KITCHEN = """
<body name="floor_backing_room_main" pos="0 0 -0.1"><geom type="box" size="2.1 1.6 0.06"/></body>
<body name="stool_1_island_group_main" pos="-1.5 -1.2 0"><geom type="box" pos="0 0 0.3" size="0.15 0.15 0.3"/></body>
<body name="dresser" pos="0.2 -1.2 0"><geom type="box" pos="0 0 0.4" size="0.4 0.2 0.4"/>
<body name="drawer_box" pos="0 0.2 0.6"><joint type="slide" axis="0 1 0"/><geom type="box" size="0.3 0.02 0.1"/></body>
<body name="lid_door" pos="0 0 0.82"><joint type="hinge"/>
<geom type="ellipsoid" size="0.3 0.2 0.02"/></body>
</body>
<body name="inner_box" pos="1.8 1.3 0.1"><joint type="slide" axis="0 1 0"/><geom type="box" size="0.1 0.1 0.1"/></body>
<body name="desk" pos="1.6 -1.2 0.5"><geom type="box" size="0.2 0.2 0.5"/>
<body name="counters1"><geom size="0.1"/></body>
<body name="kettle_stand"><geom type="sphere" pos="0 0 0.6" size="0.1"/></body></body>
<body name="kettle" pos="1.6 -1.2 1.3"><freejoint/><geom type="sphere" size="0.1"/></body>
<geom type="box" contype="0" conaffinity="0" group="1" pos="-1.9 1.4 1" size="0.05 0.05 0.05"/>
<light pos="0 0 3"/>"""


def test_drawers_lids_and_fitted_furniture_stay_and_it_is_said(tmp_path):
    root = write_room(tmp_path / "home")
    change(root, ('<body name="tall_thing"', KITCHEN.strip() + '<body name="tall_thing"'))
    raw = read_mjcf(root)
    assert sorted(a.category for a in raw.annotations) == ["chair", "dresser", "stool", "table"]
    assert raw.floor_height_m == pytest.approx(0.0, abs=1e-6)  # not that of the slab below it, -0.04
    dresser = raw.cads["dresser"].vertices
    np.testing.assert_allclose([dresser.min(0), dresser.max(0)], [[-0.4, -0.2, 0], [0.4, 0.22, 0.84]], atol=2e-3)
    for middle, half in (((1.6, -1.2, 1.1), 0.1), ((1.6, -1.2, 1.3), 0.1), ((1.8, 1.3, 0.1), 0.1)):
        near = raw.scan.vertices[(np.abs(raw.scan.vertices - middle) <= half + 1e-6).all(1)]
        assert np.ptp(near[:, :2], axis=0).min() > 1.9 * half  # spheres, and the box that slides, are there
    told = " ".join(raw.warnings)
    for words in ("'drawer_box' stands", "'inner_box' stands", "1 x light: d", "stay fixed: kettle"):
        assert words in told


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_damaged_homes_end_in_one_line_or_a_scene(tmp_path_factory, data):
    root = write_room(tmp_path_factory.mktemp("fuzz") / "home")
    path = data.draw(st.sampled_from([root / "home.xml", root / "more.xml", root / "parts" / "top.obj"]))
    text = path.read_bytes()
    at = data.draw(st.integers(0, len(text)))
    piece = data.draw(st.sampled_from([b"", b"-1e999", b"nan", b"<", b"\x00", b"</body>", b"../", b"1e9", b"<body>"]))
    path.write_bytes(text[:at] + piece + text[at + data.draw(st.integers(0, 30)) :])
    try:
        raw = read_mjcf(root)
    except SceneRejected as refusal:
        assert "\n" not in str(refusal)
    else:
        assert np.isfinite(raw.scan.vertices).all()
