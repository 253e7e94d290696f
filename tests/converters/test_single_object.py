"""URDFs and single objects: what is read, what is not, and what the written body does."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.__main__ import main
from converters.read.files import SourceFolder
from converters.read.meshes import colours_of_faces
from converters.read.urdf import read_urdf
from converters.records.errors import SceneRejected
from converters.single_object import ObjectConfig, convert_object, guess_category

BOX = (0.3, 0.2, 0.1)
URDF = """<robot name="{name}"><link name="base">
  <contact><lateral_friction value="0.8"/></contact>
  <inertial><origin xyz="0 0 9"/><mass value="2.5"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  <visual><origin xyz="0 0 0.05"/><geometry><mesh filename="{mesh}" scale="{scale}"/></geometry></visual>
  <collision><origin xyz="0 0 0.05"/><geometry><mesh filename="{mesh}" scale="{scale}"/></geometry></collision>
</link>{more}</robot>
"""


def write(folder: Path, name: str = "toy_box", mesh: str = "box.obj", scale: str = "1 1 1", more: str = "") -> Path:
    trimesh.creation.box(BOX).export(folder / "box.obj")
    path = folder / "thing.urdf"
    path.write_text(URDF.format(name=name, mesh=mesh, scale=scale, more=more))
    return path


def test_the_urdfs_mass_and_friction_count_and_its_inertia_does_not(tmp_path, hull_cache):
    about = convert_object(write(tmp_path), tmp_path / "out", ObjectConfig(), hull_cache)
    assert (about["category"], about["mass_kg"], about["friction"]) == ("toy", 2.5, 0.8)
    assert (about["mass_source"], about["friction_source"], about["hull_source"]) == ("urdf", "urdf", "collision mesh")
    assert about == json.loads((tmp_path / "out" / "object.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "object.xml"))
    body = model.body("out")
    assert model.nbody == 2 and model.njnt == 1 and model.nlight == 0 and body.mass == pytest.approx(2.5)
    a, b, c = BOX
    want = 2.5 / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(sorted(body.inertia), sorted(want), rtol=1e-3)
    np.testing.assert_allclose(body.ipos, (0, 0, 0.05), atol=1e-4)  # the box's middle, not the URDF's (0, 0, 9)
    names = {model.geom(g).name for g in range(model.ngeom)}
    assert names == {"out_visual", "out_hull_0", "out_box_0"}
    assert model.geom("out_hull_0").friction[0] == 0.8 and model.geom("out_box_0").contype == 0
    assert about["rest"]["drift_hulls_m"] < 1e-3 and about["rest"]["tilt_deg"] < 0.1
    assert about["size_m"] == pytest.approx(BOX)
    assert sorted(about["source"]["sha256"]) == ["box.obj", "thing.urdf"]


def test_links_on_fixed_joints_are_one_body(tmp_path):
    more = """<link name="top"><inertial><mass value="0.5"/></inertial>
      <visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>
      <collision><geometry><cylinder radius="0.05" length="0.1"/></geometry></collision></link>
      <joint name="on" type="fixed"><parent link="base"/><child link="top"/><origin xyz="0 0 0.15"/></joint>"""
    item = read_urdf(SourceFolder(tmp_path), write(tmp_path, more=more).name, "")
    assert item.mass_kg == 3.0 and item.pieces is not None and len(item.pieces) == 2
    np.testing.assert_allclose(item.surface.vertices[:, 2].max(), 0.2)
    np.testing.assert_allclose(max(v[:, 2].max() for v, _ in item.pieces), 0.2)


def test_a_urdfs_colours_are_read_and_what_is_not_read_is_counted(tmp_path):
    more = """<material name="red"><color rgba="1 0 0 1"/></material><gazebo/><gazebo/><transmission name="t"/>
      <link name="top"><visual><geometry><capsule radius="0.1" length="0.2"/></geometry><material name="red"/></visual>
      </link><joint name="on" type="fixed"><parent link="base"/><child link="top"/><mimic joint="on"/></joint>"""
    source = SourceFolder(tmp_path)
    item = read_urdf(source, write(tmp_path, more=more).name, "")
    assert (255, 0, 0) in {tuple(colour) for colour in colours_of_faces(item.surface).tolist()}
    assert [w for w in source.warnings if "not read" in w] == [
        "thing.urdf: 2 x <gazebo> in <robot>: not read",
        "thing.urdf: 1 x <mimic> in <joint>: not read",
        "thing.urdf: 1 x <transmission> in <robot>: not read",
    ]


@pytest.mark.parametrize("mesh", ["package://objects/box.obj", "C:\\models\\BOX.obj"])
def test_meshes_are_found_beside_the_urdf_and_scaled(tmp_path, mesh):
    item = read_urdf(SourceFolder(tmp_path), write(tmp_path, mesh=mesh, scale="2 1 -1").name, "")
    np.testing.assert_allclose(np.ptp(item.surface.vertices, axis=0), (0.6, 0.2, 0.1))
    mirrored = trimesh.Trimesh(item.surface.vertices, item.surface.faces, process=False)
    assert mirrored.volume == pytest.approx(0.6 * 0.2 * 0.1)  # its faces still look outwards


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<robot/>", "has no <link>"),
        ("nothing", "not readable as URDF"),
        ("<robot><link name='a'/></robot>", "names no mesh"),
        ("<robot><link name='a'><visual><geometry><mesh filename='b'/></geometry></visual></link></robot>", "mesh 'b'"),
        ("<robot><link name='a'><visual><geometry><capsule/></geometry></visual></link></robot>", "<capsule>"),
        ("<robot><link name='a'><inertial><mass value='x'/></inertial></link></robot>", "not readable as URDF"),
        ("<robot><link name='a'><inertial><mass value='nan'/></inertial></link></robot>", "usable numbers"),
        (
            "<robot><link name='a'/><link name='b'/><joint name='j' type='revolute'><parent link='a'/>"
            "<child link='b'/></joint></robot>",
            "joint 'j' is revolute, expected fixed joints only",
        ),
        (
            "<robot><link name='a'/><link name='b'/><joint name='j' type='fixed'><parent link='a'/><child link='b'/>"
            "</joint><joint name='k' type='fixed'><parent link='b'/><child link='a'/></joint></robot>",
            "form a loop",
        ),
    ],
)  # fmt: skip
def test_bad_urdfs_are_named(tmp_path, text, words):
    (tmp_path / "thing.urdf").write_text(text)
    with pytest.raises(SceneRejected, match=words):
        read_urdf(SourceFolder(tmp_path), "thing.urdf", "")


def test_names_tell_categories():
    assert guess_category("PALMBEACHNAVAJOSANDAL") == "shoe"
    assert guess_category("EcoformsPlantContainerQPEbony") == "pot"
    assert guess_category("model_04", "Office_Chair") == "chair"
    assert guess_category("Pansy") is None


def test_a_plain_mesh_takes_mass_from_its_category(tmp_path, hull_cache):
    image = Image.fromarray(np.full((8, 8, 3), (10, 200, 30), np.uint8))
    solid = trimesh.creation.box((30.0, 20.0, 10.0))  # centimetres, y up: 20 high
    solid.visual = trimesh.visual.TextureVisuals(np.full((8, 2), 0.5), image=image)
    solid.export(tmp_path / "shoe.glb")
    config = ObjectConfig(scale=0.01, up="y")
    about = convert_object(tmp_path / "shoe.glb", tmp_path / "out", config, hull_cache)
    assert about["category"] == "shoe" and about["size_m"] == pytest.approx((0.3, 0.1, 0.2))
    assert about["mass_source"] == "density" and about["mass_kg"] == pytest.approx(250 * 0.006, rel=0.25)
    colours = np.asarray(Image.open(tmp_path / "out" / "assets" / "out.png").convert("RGB")).reshape(-1, 3)
    np.testing.assert_allclose(np.median(colours, axis=0), (10, 200, 30), atol=4)


def test_the_command(tmp_path, capsys, monkeypatch, hull_cache):
    monkeypatch.setenv("INTERACTIVE_NAV_CACHE", str(hull_cache))
    path = write(tmp_path, name="thing")
    assert main(["object", str(path), str(tmp_path / "plain")]) == 0
    said = capsys.readouterr().out
    assert said.count("the name thing tells no category: it is 'other', unless --category says so") == 1
    assert "plain: other, 2.500 kg (urdf)" in said
    assert main(["object", str(path), str(tmp_path / "out"), "--category", "basket", "--mass", "1.5"]) == 0
    assert "basket, 1.500 kg (given), 30.0 x 20.0 x 10.0 cm, 1 hulls (collision mesh)" in capsys.readouterr().out
    assert main(["object", str(path), str(tmp_path / "out"), "--category", "basket"]) == 2
    assert "exists already" in capsys.readouterr().err
    for arguments, words in (
        ([str(tmp_path / "none.obj")], "no such file"),
        ([str(path), "--scale", "1000", "--category", "toy"], "give --scale for another unit"),
    ):
        assert main(["object", *arguments[:1], str(tmp_path / "other"), *arguments[1:]]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
        assert not (tmp_path / "other").exists()


def test_a_thing_without_category_takes_mass_from_its_volume(tmp_path, hull_cache):
    trimesh.creation.box(BOX).export(tmp_path / "drainer.stl")
    about = convert_object(tmp_path / "drainer.stl", tmp_path / "out", ObjectConfig(), hull_cache)
    assert (about["category"], about["mass_source"], about["friction"]) == ("other", "density", 0.5)
    assert about["mass_kg"] == pytest.approx(300 * 0.006, rel=0.25)


def test_warnings_of_reading_come_before_the_work(tmp_path, monkeypatch, hull_cache):
    from converters import single_object

    class Stop(Exception):
        pass

    def stop(*arguments):
        raise Stop

    told: list[str] = []
    trimesh.creation.box(BOX).export(tmp_path / "toy.obj", include_texture=False, include_color=False)
    monkeypatch.setattr(single_object, "_hulls", stop)
    with pytest.raises(Stop):
        convert_object(tmp_path / "toy.obj", tmp_path / "out", ObjectConfig(), hull_cache, told.append)
    assert told == ["toy.obj: has no texture; it stays grey"]


def test_the_source_may_be_wider_than_the_models_folder(tmp_path, hull_cache):
    (tmp_path / "images").mkdir()
    (tmp_path / "models").mkdir()
    Image.new("RGB", (4, 4), (200, 30, 10)).save(tmp_path / "images/t.png")
    solid = trimesh.creation.box(BOX)
    lines = [f"v {x} {y} {z}" for x, y, z in solid.vertices] + ["vt 0.5 0.5", "usemtl a"]
    lines += [f"f {a}/1 {b}/1 {c}/1" for a, b, c in solid.faces + 1]
    (tmp_path / "models/toy.obj").write_text("\n".join(["mtllib m.mtl", *lines, ""]))
    (tmp_path / "models/m.mtl").write_text("newmtl a\nKd 1 1 1\nmap_Kd ../images/t.png\n")
    path = tmp_path / "models/toy.obj"
    about = convert_object(path, tmp_path / "narrow", ObjectConfig(), hull_cache)
    assert any("'../images/t.png', which lies outside of the source folder" in w for w in about["warnings"])
    about = convert_object(path, tmp_path / "wide", ObjectConfig(within=tmp_path), hull_cache)
    assert about["warnings"] == [] and "images/t.png" in about["source"]["sha256"]
    colours = np.asarray(Image.open(tmp_path / "wide/assets/wide.png").convert("RGB")).reshape(-1, 3)
    np.testing.assert_allclose(np.median(colours, axis=0), (200, 30, 10), atol=4)


def test_an_object_joins_a_scene_and_rests_there(tmp_path, hull_cache, room):
    convert_object(write(tmp_path), tmp_path / "out", ObjectConfig(), hull_cache)
    scene = mujoco.MjSpec.from_file(str(room / "scene.xml"))
    frame = scene.worldbody.add_frame(pos=[1.0, 1.0, 0.0])
    frame.attach_body(mujoco.MjSpec.from_file(str(tmp_path / "out" / "object.xml")).body("out"), "new_", "")
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 200)
    np.testing.assert_allclose(data.body("new_out").xpos, (1.0, 1.0, 0.0), atol=2e-3)
    assert model.body("new_out").mass == pytest.approx(2.5)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "category", "mass_kg", "friction"),
    [
        ("2eZY2JqYPQE", "pot", 0.28980, 1.0),
        ("lGzQi2Pk5uC", "pot", 0.06756, 1.0),
        ("nPBvPYCdYgU", "shoe", 0.69224, 1.0),
        ("RcqC01G24pR", "shoe", 0.15587, 1.0),
    ],
)
def test_the_original_small_objects_rest(sample_data, tmp_path, hull_cache, name, category, mass_kg, friction):
    source = sample_data / "interactive_gibson_objects" / f"object_{name}.urdf"
    about = convert_object(source, tmp_path / "out", ObjectConfig(category=category), hull_cache)
    assert about["mass_kg"] == pytest.approx(mass_kg, abs=1e-5) and about["friction"] == friction
    assert about["hull_source"] == "collision mesh" and 1 <= about["n_hulls"] <= 16
    assert [w for w in about["warnings"] if "rpy= of <mesh>: not read" not in w] == [
        f"model_{name}.mtl: names the texture 'texture_{name}.png', which is missing; the material's plain colour is "
        "taken"
    ]
    rest = about["rest"]
    assert rest["tilt_deg"] < 0.5
    for shape in ("hulls", "boxes"):
        assert rest[f"drift_{shape}_m"] < 0.001 and rest[f"turn_{shape}_deg"] < 0.5
        assert rest[f"penetration_{shape}_m"] < 0.002
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "object.xml"))
    # Far from the placeholder of 1 kg m2: no mass can be further from the middle than the box around the object.
    half = np.sort(about["size_m"])[1:] / 2
    assert model.body("out").inertia.max() < mass_kg * (half**2).sum()
