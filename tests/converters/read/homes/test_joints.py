"""Cabinets with a door and a drawer in three formats: where their fronts go, by hand and by MuJoCo."""

import json
import math

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from converters.pipeline import convert
from converters.read.homes.habitat import read_habitat
from converters.read.homes.mjcf import read_mjcf
from converters.read.homes.sdf import read_sdf
from tests.converters.read.homes.test_habitat import HALF, SCENE, write_home
from tests.converters.read.homes.test_sdf import ROOM, SMALL, write_world

# 0.6 x 0.4 x 0.8 m, its front along -y, turned by a quarter at (-1, 0.5). The door hangs at its left front edge.
MJCF = """<mujoco><worldbody><geom type="plane" size="2 1.5 0.1"/>
<body name="walls"><geom type="box" pos="0 1.55 1.2" size="2 .05 1.2"/>
<geom type="box" pos="0 -1.55 1.2" size="2 .05 1.2"/>
<geom type="box" pos="2.05 0 1.2" size="0.05 1.5 1.2"/><geom type="box" pos="-2.05 0 1.2" size="0.05 1.5 1.2"/></body>
<body name="cabinet" pos="-1 0.5 0" euler="0 0 90"><geom type="box" pos="0 0 0.4" size="0.3 0.2 0.4"/>
<body name="left_door" pos="-0.28 -0.2 0.3"><joint name="j" axis="0 0 -1" range="0 90"/>
<geom type="box" pos="0.28 -0.01 0" size="0.28 0.01 0.25" mass="4"/>
<body name="knob" pos="0.5 -0.03 0"><joint axis="0 1 0" range="0 90"/><geom size="0.01" mass="0.1"/></body></body>
<body name="top" pos="0 -0.21 0.7"><joint name="s" type="slide" axis="0 -1 0" range="0 0.3"/>
<geom type="box" size="0.28 0.01 0.1" mass="3"/></body>MORE</body></worldbody>KEY</mujoco>"""
SDF = """<model name="cabinet"><static>true</static><pose>-1 0.5 0 0 0 1.5707963</pose>
<link name="body"><pose>0 0 0.4 0 0 0</pose>{body}</link>
<link name="left_door"><pose>-0.28 -0.2 0.3 0 0 0</pose><inertial><mass>4.1</mass></inertial>{door}</link>
<link name="top"><pose>0 -0.21 0.7 0 0 1.5707963</pose><inertial><mass>3</mass></inertial>{drawer}</link>
<joint name="j" type="revolute"><parent>body</parent><child>left_door</child><axis><xyz>0 0 -1</xyz>
<limit><lower>0</lower><upper>1.5707963</upper></limit></axis></joint>
<joint name="s" type="prismatic"><parent>body</parent><child>top</child><axis><xyz>{axis}</xyz>
<limit><lower>0</lower><upper>0.3</upper></limit></axis></joint>{more}</model>"""
URDF = """<robot name="cabinet"><link name="body">{body}</link><link name="left_door">
<inertial><mass value="4.1"/></inertial>{door}</link><link name="top"><inertial><mass value="3"/></inertial>{drawer}
</link><joint name="j" type="revolute"><parent link="body"/><child link="left_door"/>
<origin xyz="-0.28 0.3 0.2"/><axis xyz="0 -1 0"/>
<limit lower="0" upper="1.5707963"/></joint><joint name="s" type="prismatic"><parent link="body"/><child link="top"/>
<origin xyz="0 0.7 0.21"/><axis xyz="0 0 1"/><limit lower="0" upper="0.3"/></joint></robot>"""


def _sdf_box(size, pose="0 0 0"):
    shape = f"<pose>{pose} 0 0 0</pose><geometry><box><size>{size}</size></box></geometry>"
    return f"<collision name='c'>{shape}</collision><visual name='v'>{shape}</visual>"


def _urdf_box(size, at="0 0 0"):
    shape = f'<origin xyz="{at}"/><geometry><box size="{size}"/></geometry>'
    return f"<visual>{shape}</visual><collision>{shape}</collision>"


def _mjcf(root, more="", key=""):
    root.mkdir()
    (root / "scene.xml").write_text(MJCF.replace("MORE", more).replace("KEY", key))
    return root


def _sdf(root, version="1.6", more="", static="true"):
    # The drawer's link is turned by a quarter: its x is the cabinet's y.
    boxes = {"body": "0.6 0.4 0.8", "drawer": "0.02 0.56 0.2"}
    model = SDF.format(
        **{key: _sdf_box(size) for key, size in boxes.items()},
        door=_sdf_box("0.56 0.02 0.5", "0.28 -0.01 0"),
        axis="0 -1 0" if version == "1.4" else "-1 0 0",
        more=more,
    ).replace("true", static)
    write_world(root, [*ROOM, model])
    world = root / "worlds" / "home.world"
    world.write_text(world.read_text().replace("<sdf version='1.6'>", f"<sdf version='{version}'>", 1))
    return root


def _habitat(root, fixed=True):
    write_home(root, [])
    door, drawer = _urdf_box("0.56 0.5 0.02", "0.28 0 0.01"), _urdf_box("0.56 0.2 0.02")
    text = URDF.format(body=_urdf_box("0.6 0.8 0.4", "0 0.4 0"), door=door, drawer=drawer)
    (root / "urdf" / "dresser" / "dresser.urdf").write_text(text)
    path = root / "configs" / "scenes" / f"apt_0{SCENE}"
    scene = json.loads(path.read_text())
    about = {"translation": [-1, 0, -0.5], "rotation": [HALF, 0, HALF, 0], "fixed_base": fixed}
    scene["articulated_object_instances"] = [{"template_name": "dresser", **about}]
    path.write_text(json.dumps(scene))
    return root


def _corner(kind, q):
    turned = np.array([0.56 * math.cos(q) - 0.02 * math.sin(q), -0.56 * math.sin(q) - 0.02 * math.cos(q)])
    x, y, z = (*(turned + [-0.28, -0.2]), 0.55) if kind == "cabinet_door" else (0.28, -0.22 - q, 0.8)
    return np.array([-1 - y, 0.5 + x, z])


def _opened(annotation, cad, q):
    hinge, points = annotation.hinge, cad.vertices
    moved = points + q * hinge.axis
    if not hinge.slides:
        moved = Rotation.from_rotvec(q * hinge.axis).apply(points - hinge.origin) + hinge.origin
    return moved @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]


def _nearest(points, corner):
    return np.linalg.norm(points - corner, axis=1).min()


@pytest.mark.parametrize("source", ["mjcf", "sdf 1.6", "sdf 1.4", "habitat"])
def test_fronts_open_where_hand_arithmetic_puts_them(tmp_path, source):
    kind, _, version = source.partition(" ")
    root = tmp_path / "home"
    raw = {
        "mjcf": lambda: read_mjcf(_mjcf(root)),
        "sdf": lambda: read_sdf(_sdf(root, version)),
        "habitat": lambda: read_habitat(_habitat(root)),
    }[kind]()
    fronts = {a.category: a for a in raw.annotations}
    assert sorted(fronts) == ["cabinet_door", "drawer"] and len(raw.annotations) == 2
    for category, most, kg in (("cabinet_door", math.pi / 2, 4.1), ("drawer", 0.3, 3.0)):
        annotation, cad = fronts[category], raw.cads[fronts[category].cad_id]
        assert annotation.hinge is not None and annotation.hinge.slides == (category == "drawer")
        assert annotation.hinge.range_rad == pytest.approx((0.0, most), abs=1e-6)
        assert cad.mass_kg == pytest.approx(kg)
        for q in (0.0, 0.5 * most, most):
            assert _nearest(_opened(annotation, cad, q), _corner(category, q)) < 1e-6
    words = " ".join(raw.warnings)
    assert ("1 x hinge joint (fixed, as part of its piece)" in words) == (kind == "mjcf")  # the knob, on the door
    middle = [-1, 0.5, 0.4]
    near = (np.abs(raw.scan.vertices - middle) <= np.array([0.2, 0.3, 0.4]) + 1e-6).all(axis=1)
    np.testing.assert_allclose(np.ptp(raw.scan.vertices[near], axis=0), [0.4, 0.6, 0.8], atol=1e-6)  # stands fast


def test_a_written_scene_opens_as_its_source_does(tmp_path):
    """Also one that is ajar."""
    more = """<body name="low" pos="0 -0.215 0.08"><joint name="low" type="slide" axis="0 -1 0" range="0 0.3"/>
<geom type="box" size="0.28 0.01 0.06" mass="2"/></body>
<body name="flap" pos="0 0 0.82"><joint name="free"/><geom type="box" size="0.28 0.1 0.01"/></body>"""
    root = _mjcf(tmp_path / "home", more, '<keyframe><key qpos="0.2 0 0.1 0 0"/></keyframe>')
    done = convert(root, tmp_path / "out", SMALL)
    told = " ".join(done.manifest.warnings)
    assert "joint 'free' of 'flap' stands outside of its limits, or has none (-inf to inf); welded shut" in told
    assert "low_of_cabinet cannot be parted from left_door_of_cabinet, and its joint is welded shut" in told
    assert all(gate.passed for gate in done.gates)
    source, scene = (mujoco.MjModel.from_xml_path(str(p / "scene.xml")) for p in (root, tmp_path / "out"))
    for front, body, start, most in (
        ("cabinet_door_0", "left_door", 0.2, math.pi / 2),
        ("drawer_0", "top", 0.1, 0.3),
    ):
        of, to = source.body_jntadr[source.body(body).id], scene.body_jntadr[scene.body(front).id]
        assert scene.jnt_type[to] == source.jnt_type[of]
        assert scene.jnt_range[to] == pytest.approx([-start, most - start], abs=1e-5)
        assert scene.body(front).mass[0] == pytest.approx(source.body_subtreemass[source.body(body).id], abs=1e-3)
        for q in (start, most):
            there, here = mujoco.MjData(source), mujoco.MjData(scene)
            there.qpos[source.jnt_qposadr[of]], here.qpos[scene.jnt_qposadr[to]] = q, q - start
            mujoco.mj_kinematics(source, there)
            mujoco.mj_kinematics(scene, here)
            geom = int(source.body_geomadr[source.body(body).id])
            far = there.geom_xpos[geom] + there.geom_xmat[geom].reshape(3, 3) @ (source.geom_size[geom] * [1, -1, 1])
            hull = scene.geom(f"{front}_hull_0").id
            mesh = scene.geom_dataid[hull]
            first, count = scene.mesh_vertadr[mesh], scene.mesh_vertnum[mesh]
            points = scene.mesh_vert[first : first + count] @ here.geom_xmat[hull].reshape(3, 3).T
            assert _nearest(points + here.geom_xpos[hull], far) < 2e-3


def test_the_lower_end_of_a_range_is_where_a_front_is_shut(tmp_path):
    path = _mjcf(tmp_path / "home") / "scene.xml"
    path.write_text(path.read_text().replace('axis="0 0 -1" range="0 90"', 'axis="0 0 1" range="-90 0"'))
    raw = read_mjcf(tmp_path / "home")
    (door,) = (a for a in raw.annotations if a.category == "cabinet_door")
    assert door.hinge is not None and door.hinge.range_rad == pytest.approx((0.0, math.pi / 2))
    assert _nearest(_opened(door, raw.cads[door.cad_id], 0.5), _corner("cabinet_door", 0.5)) < 1e-6


def test_a_saved_state_leaves_fronts_open(tmp_path):
    """The door by 0.4 rad, the drawer by 0.1 m; poses are in the world. What is off its joint is welded."""
    state = """<state><model name='cabinet'><pose>-1 0.5 0 0 0 1.5707963</pose><link name='left_door'>
<pose>-0.8 0.22 0.3 0 0 1.1707963</pose></link><link name='top'><pose>-0.69 0.5 0.7 0 0 3.1415926</pose></link></model>
</state></world>"""
    world = _sdf(tmp_path / "home") / "worlds" / "home.world"
    text = world.read_text()
    world.write_text(text.replace("</world>", state))
    raw = read_sdf(tmp_path / "home")
    fronts = {a.category: a for a in raw.annotations}
    for category, start, most in (("cabinet_door", 0.4, math.pi / 2), ("drawer", 0.1, 0.3)):
        annotation, cad = fronts[category], raw.cads[fronts[category].cad_id]
        assert annotation.hinge is not None
        assert annotation.hinge.range_rad == pytest.approx((-start, most - start), abs=1e-6)
        for q in (0.0, start, most):
            assert _nearest(_opened(annotation, cad, q - start), _corner(category, q)) < 1e-6
    world.write_text(text.replace("</world>", state.replace("0.22 0.3", "0.22 0.35").replace("-0.69 0.5", "-0.3 0.5")))
    assert [a.category for a in read_sdf(tmp_path / "home").annotations] == ["sideboard"]


def test_joints_of_loose_models_and_of_other_kinds_are_counted(tmp_path):
    raw = read_sdf(_sdf(tmp_path / "loose", static="false"))
    assert {a.category for a in raw.annotations} == {"sideboard"}
    assert {w.partition(": ")[2] for w in raw.warnings if "joint" in w} == {
        "1 x revolute joint (its links are one part): not read",
        "1 x prismatic joint (its links are one part): not read",
    }
    tied = "<joint name='t' type='fixed'><parent>world</parent><child>body</child></joint>"
    raw = read_sdf(_sdf(tmp_path / "tied", more=tied, static="false"))
    assert sorted(a.category for a in raw.annotations) == ["cabinet_door", "drawer"]
    raw = read_habitat(_habitat(tmp_path / "loose_urdf", fixed=False))
    assert [a.category for a in raw.annotations] == ["dresser"]
    assert any("articulated object (its joints are held at 0)" in w for w in raw.warnings)


def test_a_tall_leaf_on_a_named_door_is_a_room_door(tmp_path):
    leaf = """<body name="frame" pos="1 0 0"><geom type="box" pos="-0.05 0 1" size="0.04 0.04 1"/>
<body name="hall_door"><joint axis="0 0 1" range="0 80"/>
<geom type="box" pos="0.4 0 1" size="0.39 0.02 0.98" mass="20"/></body></body>"""
    root = _mjcf(tmp_path / "home")
    text = (root / "scene.xml").read_text().replace('<body name="cabinet"', leaf + '<body name="cabinet"')
    (root / "scene.xml").write_text(text)
    raw = read_mjcf(root)
    (door,) = (a for a in raw.annotations if a.category == "door")
    assert door.hinge is not None and not door.hinge.assumed
    assert door.hinge.range_rad == pytest.approx((0, math.radians(80)))
    pin = door.pose[:3, :3] @ door.hinge.origin + door.pose[:3, 3]
    np.testing.assert_allclose(pin[:2], [1, 0], atol=1e-9)
