"""Robot files as they are found: limits at wheels, odd roots, masses in other links, joints that nothing drives."""

import re
import warnings
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from docs.studies.robots.pictures import stage
from interactive_nav import robots
from interactive_nav_common.errors import UserError
from tests.interactive_nav.robots.urdf import cart, joint, link

SETTINGS = dict(
    name="cart",
    base_body="base_link",
    left_wheels=("left_joint",),
    right_wheels=("right_joint",),
    max_wheel_speed_rad_s=10.0,
    casters=("front_caster", "rear_caster"),
)


def build(tmp_path, text, name="cart.urdf", **settings):
    """The robot's spec, and what was warned of beside its wheels."""
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        robot = robots.from_file(path, **{**SETTINGS, **settings})("native")
    return robot, [str(w.message) for w in caught if "meets furniture" not in str(w.message)]


def drive(robot, speed_rad_s=5.0, seconds=2.0):
    """Model and data after driving straight."""
    model, data = stage(robot)
    data.ctrl[:2] = speed_rad_s
    for _ in range(int(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return model, data


def declared_kg(text):
    """The sum of the masses that a URDF declares."""
    return sum(float(m.get("value", "")) for m in ElementTree.fromstring(text).iter("mass"))


@pytest.mark.parametrize("kind", ["continuous", "revolute"])
def test_wheels_with_position_limits_drive_on(tmp_path, kind):
    text = cart(wheel=kind, limit='<limit effort="5" velocity="10" lower="-1.5" upper="1.5"/>')
    robot, told = build(tmp_path, text)
    assert told == [
        f"wheel joint '{side}_joint' has position limits [-1.5, 1.5]; it turns without" for side in ("left", "right")
    ]
    _, data = drive(robot)
    assert data.qpos[0] == pytest.approx(5 * 0.07 * 2, abs=0.02)  # 9.9 rad of the wheels


HULL = '<box size="0.4 0.3 0.1"/>'
MASSLESS = link("base_link", HULL, None, "0 0 0.1")
INNER = link("inner", "", 12, "0 0 0.1") + joint("inner_fix", "fixed", "base_link", "inner")
PLATE = link("plate", HULL, None, "0 0 0.2") + joint("plate_fix", "fixed", "base_link", "plate")


@pytest.mark.parametrize(
    "text",
    [
        cart(),
        cart(INNER, base=MASSLESS),
        cart(INNER + PLATE, base=MASSLESS),
        cart(PLATE),
        cart(
            link("tray") + joint("tray_fix", "fixed", "base_link", "tray")
            + link("inner", "", 12) + joint("inner_fix", "fixed", "tray", "inner"),
            base=MASSLESS,
        ),
    ],
    ids=["plain", "inertia in a fixed link", "and a plate", "a plate of shapes", "two links down"],
)  # fmt: skip
def test_a_robot_weighs_what_its_file_declares(tmp_path, text):
    robot, told = build(tmp_path, text)
    assert declared_kg(text) == pytest.approx(13.2)
    assert robot.mass_kg == pytest.approx(13.2, abs=1e-3) and not told


def test_a_robot_without_any_inertia_weighs_as_its_shapes(tmp_path):
    text = cart(base=MASSLESS).replace('<mass value="0.1"/>', '<mass value="0"/>')
    text = re.sub(r'(<link name="\w+_caster">.*?)<inertial>.*?</inertial>', r"\1", text)
    robot, told = build(tmp_path, text)
    # 1000 kg/m3 * 0.4 * 0.3 * 0.1 m3, two wheels, two spheres of radius 0.03 m.
    assert robot.mass_kg == pytest.approx(12 + 1 + 2 * 0.1131, abs=1e-3)
    assert sum("has no inertia; taken from its shapes" in t for t in told) == 3


def test_mass_without_inertia_takes_its_shapes(tmp_path):
    robot, told = build(tmp_path, cart(base=link("base_link", HULL, 12, "0 0 0.1", inertia=0)))
    model, _ = stage(robot)
    # A box: m / 12 (a^2 + b^2).
    np.testing.assert_allclose(sorted(model.body("cart_base_link").inertia), [0.1, 0.17, 0.25], atol=1e-6)
    assert len(told) == 1 and "'base_link' has mass but no inertia" in told[0]


ARM = (
    link("upper", '<box size="0.06 0.06 0.3"/>', 1, "0 0 0.15")
    + joint("pan", "revolute", "base_link", "upper", "0.1 0 0.15",
            limit='<limit effort="30" velocity="2" lower="-3" upper="3"/>')
    + link("fore", '<box size="0.4 0.05 0.05"/>', 1, "0.2 0 0")
    + joint("shoulder", "revolute", "upper", "fore", "0 0 0.3", axis="0 1 0",
            limit='<limit effort="30" velocity="2" lower="-2" upper="2"/>')
)  # fmt: skip


@pytest.mark.parametrize("home", [{}, {"shoulder": -0.6}])
def test_joints_that_nothing_drives_are_held_at_home(tmp_path, home):
    robot, told = build(tmp_path, cart(ARM), home=home)
    assert len(told) == 1 and "nothing drives 'pan', 'shoulder': they are held at home" in told[0]
    model, data = drive(robot, 0.0)
    fore = data.body("cart_fore")
    # The forearm's x axis: ahead, turned about y by the home angle.
    angle = home.get("shoulder", 0.0)
    np.testing.assert_allclose(fore.xmat.reshape(3, 3)[:, 0], [np.cos(angle), 0, -np.sin(angle)], atol=0.02)
    np.testing.assert_allclose(fore.xpos, [0.1, 0, 0.45], atol=0.01)
    assert robot.mass_kg == pytest.approx(15.2, abs=1e-3)


def test_a_joint_is_held_within_its_limits_and_driven_ones_stay(tmp_path):
    text = cart(ARM.replace('lower="-2" upper="2"', 'lower="0.5" upper="2"'))
    robot, told = build(tmp_path, text, joints={"pan": 1.0})
    _, data = drive(robot, 0.0)
    np.testing.assert_allclose(data.body("cart_fore").xmat.reshape(3, 3)[2, 0], -np.sin(0.5), atol=0.01)
    assert len(told) == 1 and "nothing drives 'shoulder'" in told[0]
    assert robot.actuators == ("cart_left_joint", "cart_right_joint", "cart_pan")


def test_swivels_of_casters_turn_freely(tmp_path):
    swivel = (
        link("fork", '<box size="0.02 0.02 0.05"/>', 0.1)
        + joint("swivel", "continuous", "base_link", "fork", "-0.2 0 0.1")
        + link("ball", '<sphere radius="0.03"/>', 0.1)
        + joint("ball_fix", "fixed", "fork", "ball", "-0.03 0 -0.07")
    )
    robot, told = build(tmp_path, cart(swivel), casters=("front_caster", "rear_caster", "ball"))
    model, _ = stage(robot)
    assert model.nv == 6 + 2 + 1 and model.joint("cart_swivel").type == mujoco.mjtJoint.mjJNT_HINGE
    assert len(told) == 1 and "nothing drives 'swivel': they turn freely" in told[0]


@pytest.mark.parametrize("effort", ["100", "1000", "1e30"])
def test_the_torque_of_a_wheel_is_bounded_by_its_grip(tmp_path, effort):
    robot, told = build(tmp_path, cart(limit=f'<limit effort="{effort}" velocity="10"/>'))
    model, data = drive(robot)
    slip = 13.2 * 9.81 * 0.07
    np.testing.assert_allclose(model.jnt_actfrcrange[model.joint("cart_left_joint").id], [-slip, slip], rtol=1e-4)
    # What the wheels' armature adds to the robot's mass stays in its order: less than 10 kg a wheel, not 1,020.
    assert model.dof_armature.max() / 0.07**2 < 10
    assert data.qpos[0] == pytest.approx(5 * 0.07 * 2, abs=0.02)
    assert len(told) == 2 and "bounded to 9.06 N m" in told[0]


@pytest.mark.parametrize("kind", ["fixed", "floating", "planar"])
@pytest.mark.parametrize("chain", [("base_footprint",), ("map", "odom", "base_footprint")])
def test_massless_roots_are_left_out(tmp_path, kind, chain):
    above = "".join(
        link(name) + joint(f"from_{name}", kind, name, child)
        for name, child in zip(chain, (*chain[1:], "base_link"), strict=True)
    )
    robot, told = build(tmp_path, cart(above))
    assert robot.base_body == "cart_base_link" and robot.mass_kg == pytest.approx(13.2, abs=1e-6) and not told


def test_a_fixed_root_may_be_named_as_the_base(tmp_path):
    text = cart(link("base_footprint") + joint("f", "fixed", "base_footprint", "base_link", "0 0 0.01"))
    robot, _ = build(tmp_path, text, base_body="base_footprint")
    assert robot.base_body == "cart_base_footprint" and robot.mass_kg == pytest.approx(13.2, abs=1e-3)
    assert robot.spawn_height_m == pytest.approx(-0.01, abs=1e-6)


def test_a_byte_order_mark_line_ends_and_a_space_are_read(tmp_path):
    text = '<?xml version="1.0"?>\n' + cart().replace("><", ">\n<")
    robot, told = build(tmp_path, b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(), name="bom crlf.urdf")
    assert robot.mass_kg == pytest.approx(13.2, abs=1e-6) and not told


def write_box(path, half_m, centre_m=(0.0, 0.0, 0.0)):
    """An OBJ file of a box."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half_m + centre_m
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f " + " ".join(str(i + 1) for i in quad) for quad in quads]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines))


@pytest.mark.parametrize("place", ["package://cart/meshes/", "file://meshes/", "./meshes/"])
def test_meshes_collide_as_boxes_and_wheels(tmp_path, place):
    write_box(tmp_path / "meshes" / "hull.obj", (0.2, 0.15, 0.05), (0.01, 0.02, 0.1))
    write_box(tmp_path / "meshes" / "wheel.obj", (0.07, 0.07, 0.02))
    text = cart().replace('<cylinder radius="0.07" length="0.04"/>', f'<mesh filename="{place}wheel.obj"/>')
    mesh = f'<geometry><mesh filename="{place}hull.obj"/></geometry>'
    text = text.replace('<origin xyz="0 0 0.1"/><geometry><box size="0.4 0.3 0.1"/></geometry>', mesh, 1)
    robot, told = build(
        tmp_path, text.replace('<link name="base_link">', f'<link name="base_link"><visual>{mesh}</visual>')
    )
    assert told == ["3 meshes now collide as the boxes around them, or as wheels"]
    model, data = drive(robot)
    solid = [
        i for i in range(model.ngeom) if model.geom_contype[i] and model.geom_type[i] != mujoco.mjtGeom.mjGEOM_PLANE
    ]
    sizes = {model.geom(i).name: model.geom_size[i] for i in solid}
    np.testing.assert_allclose(sizes["cart_left_wheel_guard"], [0.049, 0.02, 0.049], atol=1e-6)
    (hull,) = [i for i in solid if "guard" not in model.geom(i).name]
    np.testing.assert_allclose(model.geom_size[hull], [0.2, 0.15, 0.05], atol=1e-6)
    np.testing.assert_allclose(model.geom_pos[hull], [0.01, 0.02, 0.1], atol=1e-6)
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).sum() == 1 and robot.mass_kg == pytest.approx(13.2, abs=1e-3)
    assert data.qpos[0] == pytest.approx(5 * 0.07 * 2, abs=0.02)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (cart(base=link("base_link", HULL, 12, "0 0 0.05")), "would drag on the floor; it is lifted by 0.5 cm"),
        (cart().replace("<axis", '<dynamics damping="9" friction="3"/><axis'), "would lose 93 N m to damping"),
        (cart().replace('<sphere radius="0.03"/>', '<cylinder radius="0.03" length="0.02"/>'), ""),
    ],
    ids=["a box on the floor", "stiff wheels", "cylinders as casters"],
)
def test_what_would_stop_a_robot_is_taken_away(tmp_path, text, said):
    robot, told = build(tmp_path, text)
    assert all(said in line for line in told) and bool(told) == bool(said)
    model, data = drive(robot)
    assert data.qpos[0] == pytest.approx(5 * 0.07 * 2, abs=0.02) and model.npair == 4


TRANSMISSION = (
    '<transmission name="t"><joint name="left_joint"><hardwareInterface>x</hardwareInterface></joint></transmission>'
)
VISUAL = '<visual><geometry><mesh filename="package://cart/base.dae"/></geometry></visual>'
KEEP = '<mujoco><compiler discardvisual="false" meshdir="meshes"/></mujoco>'
FINGER_LIMIT = '<limit effort="1" velocity="1" lower="0.1" upper="0.3"/><mimic joint="left_joint" multiplier="2"/>'
FINGER = link("finger", "", 0.0) + joint("grip", "prismatic", "base_link", "finger", limit=FINGER_LIMIT)


@pytest.mark.parametrize(
    "text",
    [
        cart(TRANSMISSION),
        cart(KEEP).replace('<link name="base_link">', '<link name="base_link">' + VISUAL),
        cart(FINGER),
        cart().replace("<robot", '<!-- ${macro} <xacro:x> --><robot xmlns:xacro="http://ros.org/wiki/xacro"'),
    ],
    ids=["transmission", "meshes as visuals", "mimic", "comments and an unused namespace"],
)
def test_what_a_file_has_beside_is_passed_over(tmp_path, text):
    robot, _ = build(tmp_path, text)
    model, data = drive(robot)
    assert robot.mass_kg == pytest.approx(13.2, abs=1e-3) and model.nv == 8
    assert data.qpos[0] == pytest.approx(5 * 0.07 * 2, abs=0.02)


def test_names_with_spaces_are_names(tmp_path):
    robot, _ = build(tmp_path, cart().replace("left_joint", "left joint"), left_wheels=("left joint",))
    assert robot.actuators == ("cart_left joint", "cart_right_joint")


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (cart().replace('value="12"', 'value="${6*2}"'), "c.urdf", "xacro first: xacro c.urdf -o c_plain.urdf"),
        (cart().replace('value="12"', 'value="$(arg m)"'), "c.xacro", "run xacro first: xacro c.xacro -o c_plain.urdf"),
        (cart("<xacro:wheel/>"), "c.urdf.xacro", "run xacro first: xacro c.urdf.xacro -o c.urdf"),
        (cart("<xacro:wheel/>").replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'), "c.urdf",
         "run xacro first"),
        ('<sdf version="1.6"><model name="m"/></sdf>', "m.sdf", "its root element is <sdf>, expected <robot> .*xacro"),
        ("<html/>", "m.urdf", "its root element is <html>, expected"),
        (cart().replace('value="12"', 'value="-12"'), "c.urdf", "link 'base_link' has mass -12, expected kilograms"),
        (cart().replace('value="0.5"', 'value="nan"'), "c.urdf", "link 'left_wheel' has mass nan, expected kilograms"),
        (cart().replace('value="0.5"', 'value="half"'), "c.urdf", "cannot read it .*'half'"),
        (cart().replace("rear_caster", "front_caster"), "c.urdf", "2 links are named 'front_caster'"),
        (cart().replace("rear_fix", "front_fix"), "c.urdf", "2 joints are named 'front_fix'"),
        (cart(link("stray", HULL, 1)), "c.urdf", "'stray' is no part of 'base_link', expected one tree; remove it"),
        (cart(link("keel", HULL, 1) + joint("k", "fixed", "keel", "base_link")), "c.urdf",
         "give base_body='keel', which carries it"),
        (cart(link("keel", HULL, 1) + joint("k", "floating", "keel", "base_link")), "c.urdf",
         "'k' from 'keel' to 'base_link' is floating, expected the robot below it: give base_body='base_link'"),
        (cart("<joint name='k' type='fixed'/>"), "c.urdf", "cannot read it"),
        (cart().replace('<sphere radius="0.03"/>', '<mesh filename="x.stl"/>'), "c.urdf",
         "link 'front_caster' collides as 'x.stl', expected an STL or OBJ file that exists"),
        (cart().replace('<sphere radius="0.03"/>', '<sphere radius="-1"/>'), "c.urdf", "cannot read it"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, text, name, message):
    with pytest.raises(UserError, match=message) as refused:
        build(tmp_path, text, name)
    assert "\n" not in str(refused.value)
