"""MJCF homes: a room written here, and a scene of our own read back; files outside of the folder are refused."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from converters.geometry.faces import face_areas, face_labels
from converters.pipeline import ConvertConfig, convert
from converters.read.homes.mjcf import read_mjcf
from converters.read.source import detect_format
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
MORE = """<mujocoinclude>
<body name="tall_thing" pos="1.5 -1 0.5"><geom type="capsule" size="0.1 0.4"/></body>
</mujocoinclude>"""


def write_room(root: Path) -> Path:
    (root / "parts").mkdir(parents=True)
    trimesh.creation.box((0.8, 0.6, 0.7)).export(root / "parts" / "top.obj")
    (root / "more.xml").write_text(MORE)
    (root / "home.xml").write_text(ROOM)
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
    assert area[face_labels(raw.scan.labels, raw.scan.faces) == FLOOR].sum() == pytest.approx(12.0, rel=0.03)
    assert any("1 x slide joint" in w for w in raw.warnings)
    assert set(raw.sources) == {"home.xml", "more.xml", "parts/top.obj"}


def test_a_room_becomes_a_scene_that_passes_its_gates(tmp_path, hull_cache):
    made = convert(write_room(tmp_path / "home"), tmp_path / "scene", ConvertConfig(jobs=1), cache=hull_cache)
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
