"""A user's URDF and MJCF become robots that drive; the documentation's code runs; what cannot be used is refused."""

import dataclasses
import functools
import re
import warnings
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
import yaml

import interactive_nav
from docs.studies.robots import evidence
from docs.studies.robots.pictures import stage
from interactive_nav import robots
from interactive_nav.robots import build
from interactive_nav_common.errors import UserError
from interactive_nav_common.records import read_packaged
from tests.toys import write_room

DOC = Path(__file__).parents[3] / "docs" / "add-a-robot.md"
TEXT = DOC.read_text(encoding="utf-8")
URDF = re.findall(r"```xml\n(.*?)```", TEXT, re.S)[0]
WEIGHTLESS = re.sub(r"<mass value=\"12\"/>", '<mass value="0"/>', URDF)
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.S)
PORTER = dict(
    name="porter",
    base_body="base_link",
    left_wheels=("left_wheel_joint",),
    right_wheels=("right_wheel_joint",),
    max_wheel_speed_rad_s=12.0,
    casters=("front_caster", "rear_caster"),
)


@pytest.fixture
def registry(monkeypatch):
    """A copy of the registry that a test may add to."""
    monkeypatch.setattr(robots, "_FACTORIES", dict(robots._FACTORIES))


def _write(folder, text, name="porter.urdf"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def _from_file(path, **settings):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return robots.from_file(path, **settings)


def test_the_documents_code_runs(tmp_path, monkeypatch, registry, capsys):
    monkeypatch.chdir(tmp_path)
    _write(tmp_path, URDF)
    write_room(tmp_path / "scenes_mjcf" / "my_scene", (4.0, 3.0), ())
    names = {}
    with pytest.warns(UserWarning) as told:
        exec(BLOCKS[0], names)  # noqa: S102
    for block in BLOCKS[1:]:
        exec(block, names)  # noqa: S102
    messages = [str(w.message) for w in told]
    assert sum("sphere of radius 0.07 m" in m for m in messages) == 2
    assert sum("four boxes" in m for m in messages) == 1
    assert len(messages) == 3
    printed = capsys.readouterr().out
    assert printed.count(" ok\n") >= 15 and "FAILED" not in printed
    env = names["env"]
    assert env.action_size == 2 and names["drive"].robot.action_names == ("forward m/s", "turn rad/s")
    state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.PRNGKey(0)), np.ones(2, np.float32))
    assert state.obs.shape == (29,) and np.isfinite(state.obs).all()


def test_a_model_and_a_row_add_a_wheeled_robot(tmp_path, monkeypatch, registry):
    """The steps of docs/extend.md, on copies of the package's files."""
    model, table = build.FOLDER / "turtlebot.xml", build.FOLDER.parent / "models" / "wheeled.yaml"
    _write(tmp_path, model.read_text().replace('model="turtlebot"', 'model="puck"'), "puck.xml")
    monkeypatch.setattr(build, "FOLDER", tmp_path)
    rows = yaml.safe_load(table.read_text())
    (row,) = [row for row in rows if row["base"]["name"] == "turtlebot"]
    row["base"] |= {"name": "puck", "max_linear_m_s": 0.5}
    (row,) = read_packaged(_write(tmp_path, yaml.safe_dump([row]), "wheeled.yaml"), tuple[build.Row, ...])
    robots._FACTORIES["puck"] = functools.partial(build.wheeled_robot, **vars(row))
    assert "puck" in robots.robot_names()
    scene = write_room(tmp_path / "room", (4.0, 3.0), ())
    env = interactive_nav.make("puck", [scene], num_objects=0, control_mode="twist", backend="native")
    assert env.robot.action_high[0] == 0.5
    state, step = jax.jit(env.reset)(jax.random.PRNGKey(0)), jax.jit(env.step)
    start_m = state.info["nav"].robot_pos_w[:2]
    for _ in range(5):
        state = step(state, np.array([1.0, 0.0], np.float32))
    assert 0.05 < np.linalg.norm(state.info["nav"].robot_pos_w[:2] - start_m) < 0.25  # 0.5 s at up to 0.5 m/s


def test_a_urdf_keeps_its_masses_and_limits_and_gets_its_figures_from_its_shapes(tmp_path):
    robot = _from_file(_write(tmp_path, URDF), **PORTER)("native")
    model, data = stage(robot)
    assert model.body("porter_base_link").mass[0] == 12.0
    np.testing.assert_allclose(sorted(model.body("porter_base_link").inertia), [0.2, 0.25, 0.3])
    # The casters declare no mass, and are fixed to a link that does.
    assert robot.mass_kg == pytest.approx(12 + 2 * 0.5, abs=1e-3)
    np.testing.assert_allclose(model.jnt_actfrcrange[model.joint("porter_left_wheel_joint").id], [-4, 4])
    assert robot.action_high == (12.0, 12.0) and robot.spawn_height_m == pytest.approx(0.07)
    # The guards of the wheels: 0.18 + 0.02 m; the octagon of radius 0.22 m is 0.2033 m wide.
    assert robot.body_width_m == pytest.approx(2 * 0.2033, abs=2e-3)
    assert robot.footprint_radius_m == pytest.approx(0.22, abs=2e-3)
    solid = {int(t) for t, c in zip(model.geom_type[1:], model.geom_contype[1:], strict=True) if c}
    assert solid == {int(mujoco.mjtGeom.mjGEOM_BOX)}
    assert model.npair == 4  # two wheels and two casters with the floor
    # The right wheel's axis pointed right: both positive speeds drive forward now.
    np.testing.assert_allclose(data.xaxis[model.joint("porter_right_wheel_joint").id], [0, 1, 0], atol=1e-4)


@pytest.mark.heavy
def test_a_base_frame_off_the_axle_is_no_failure(tmp_path, registry):
    """The porter's frame is 5 cm behind its axle: everything stands that much further ahead."""
    text = re.sub(r'<origin xyz="(\S+) ', lambda x: f'<origin xyz="{float(x[1]) + 0.05:g} ', URDF)
    robots.register("porter", _from_file(_write(tmp_path, text), **PORTER))
    own = {check.name: check for check in evidence.measure("porter").checks}
    failed = [f"{c.name}: {c.value:.4g}, limits {c.low:.3g} to {c.high:.3g}" for c in own.values() if not c.passed]
    assert not failed, "; ".join(failed)
    # It does go round the axle: 0.1 m from one side to the other, where the limit is 0.03 m.
    assert own["turn: centre moves m"].value < 0.02


CART = """<mujoco model="cart"><compiler angle="degree"/><option timestep="0.001"/>
<default><geom friction="0.4"/></default>
<worldbody><light pos="0 0 3"/><geom name="ground" type="plane" size="5 5 0.1"/>
<body name="hull" pos="1 2 0.1"><freejoint/>
<geom type="box" size="0.25 0.17 0.06" pos="0 0 0.08" mass="18"/>
<body name="mast" pos="0 0 0.14"><joint name="mast" axis="0 0 1" range="-90 90" limited="true" actuatorfrcrange="-3 3"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.5"/></body>
{wheels}
</body></worldbody>
<actuator><motor name="old" joint="fl"/></actuator></mujoco>"""
WHEEL = """<body name="{name}_wheel" pos="{x} {y} 0" euler="90 0 0">
<joint name="{name}" axis="0 0 -1" armature="0.1"{limit}/><geom type="cylinder" size="0.1 0.03" mass="0.8"/></body>"""
CORNERS = {"fl": (0.13, 0.21), "fr": (0.13, -0.21), "rl": (-0.13, 0.21), "rr": (-0.13, -0.21)}


def _cart(limit=' actuatorfrcrange="-8 8"'):
    return CART.format(wheels="".join(WHEEL.format(name=n, x=x, y=y, limit=limit) for n, (x, y) in CORNERS.items()))


CART_ARGS = dict(
    name="cart",
    base_body="hull",
    left_wheels=("fl", "rl"),
    right_wheels=("fr", "rr"),
    max_wheel_speed_rad_s=10.0,
    joints={"mast": 1.0},
    home={"mast": 0.3},
    max_angular_rad_s=1.0,
)


def test_an_mjcf_with_its_own_actuators_and_degrees_drives(tmp_path, registry):
    factory = _from_file(_write(tmp_path, _cart(), "cart.xml"), **CART_ARGS)
    robots.register("cart", factory)
    robot = robots.get_robot("cart", "whole_body")
    assert robot.actuators == ("cart_fl", "cart_rl", "cart_fr", "cart_rr", "cart_mast")
    assert robot.action_names[-1] == "mast rad/s" and robot.home_qpos == (("cart_mast", 0.3),)
    model, _ = stage(robot)
    np.testing.assert_allclose(model.joint("cart_mast").range, [-np.pi / 2, np.pi / 2])
    assert model.opt.timestep != 0.001 and model.nu == 5
    # Skid steer: 0.42 + 0.26^2 / 0.42 = 0.581 m.
    assert robot.twist is not None
    assert robot.twist.matrix[0] == pytest.approx((10.0, -0.581 / 0.2), abs=1e-2)
    checks = {c.name: c for c in evidence.measure("cart").checks}
    for name in ("linear / asked", "stopped mm/s", "straight line deviation %", "standing drift mm", "pushes basket m"):
        assert checks[name].passed, checks[name]
    assert checks["angular / asked"].value == pytest.approx(1.0, abs=0.2)  # the track is an estimate


@pytest.mark.parametrize(
    ("text", "settings", "message"),
    [
        (URDF, {"base_body": "base"}, "no body named 'base'; it has base_link, left_wheel"),
        (URDF, {"left_wheels": ("wheel",)}, "no joint named 'wheel'; it has left_wheel_joint"),
        (URDF, {"left_wheels": ("left_wheel_joint", "left_wheel_joint")}, "2 wheels on the left and 1 on .* as many"),
        (URDF, {"torque_limits": {"left_wheel_joint": 0.0}}, "left_wheel_joint is 0.0, expected a positive number"),
        (_cart("").replace(' limited="true" actuatorfrcrange="-3 3"', ""), {**CART_ARGS, "casters": ()},
         "joint 'mast' has no torque limit"),
        (URDF.replace('rpy="1.5708 0 0"/><axis', 'rpy="0 0 0"/><axis'), {}, "expected its y axis"),
        (URDF.replace('cylinder radius="0.07" length="0.04"', 'box size="0.1 0.1 0.04"'), {}, "no round one"),
        (URDF.replace('sphere radius="0.03"', 'box size="0.1 0.1 0.04"'), {}, "caster 'front_caster' is not round"),
        (URDF, {"left_wheels": "left_wheel_joint"}, "left_wheels is 'left_wheel_joint', expected a list"),
        (URDF, {"right_wheels": ("left_wheel_joint",)}, "'left_wheel_joint' is on both sides"),
        (
            URDF,
            {"left_wheels": ("right_wheel_joint",), "right_wheels": ("left_wheel_joint",)},
            r"left wheels lie at y = -0.18 m, the right ones at 0.18 m, .* swap",
        ),
        (URDF.replace('radius="0.07" length="0.04"', 'radius="70" length="40"'), {}, "radius of 70 m, .* millimetres"),
        (URDF, {"max_wheel_speed_rad_s": 0.0}, "max_wheel_speed_rad_s is 0.0, expected a positive number"),
        (URDF, {"max_wheel_speed_rad_s": float("nan")}, "max_wheel_speed_rad_s is nan, expected a positive number"),
        (URDF, {"track_m": -0.4}, "track_m is -0.4, expected a positive number"),
        (URDF, {"max_linear_m_s": 0.0}, "max_linear_m_s is 0.0, expected a positive number"),
        (URDF, {"name": ""}, "name is '', expected letters, digits, _ and -"),
        (URDF, {"name": "my robot"}, "name is 'my robot', expected letters"),
        (URDF, {"name": "a/b"}, "name is 'a/b', expected letters"),
        (WEIGHTLESS, {}, "base 'base_link' weighs 0.0001 kg, expected its mass"),
        ("<robot name='x'><link", {}, "MuJoCo cannot read it"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_with_the_remedy(tmp_path, text, settings, message):
    with pytest.raises(UserError, match=message):
        _from_file(_write(tmp_path, text), **{**PORTER, **settings})


def test_what_from_file_is_not_given_it_reads_off_the_file(tmp_path):
    told, shown = _from_file(_write(tmp_path, URDF), **PORTER)("twist"), _from_file(tmp_path / "porter.urdf")("twist")
    for field in dataclasses.fields(told):
        if field.name not in ("add_to", "control"):
            assert getattr(told, field.name) == getattr(shown, field.name), field.name
    with pytest.raises(UserError, match="unknown setting 'wheels'"):
        _from_file(tmp_path / "porter.urdf", wheels=2)


def test_torque_limits_complete_a_file(tmp_path):
    path = _write(tmp_path, URDF.replace('<limit effort="4" velocity="12"/>', ""))
    limits = {"left_wheel_joint": 3.0, "right_wheel_joint": 3.0}
    model, _ = stage(_from_file(path, **PORTER, torque_limits=limits)("native"))
    np.testing.assert_allclose(model.jnt_actfrcrange[model.joint("porter_left_wheel_joint").id], [-3, 3])


def test_a_missing_file_and_a_taken_name_are_refused(tmp_path, registry):
    with pytest.raises(UserError, match="does not exist"):
        _from_file(tmp_path / "none.urdf", **PORTER)
    with pytest.raises(UserError, match="exists already"):
        robots.register("fetch", lambda mode: robots.get_robot("fetch", mode))
    factory = _from_file(_write(tmp_path, URDF), **PORTER)
    with pytest.raises(UserError, match="is called 'porter', expected 'other'"):
        robots.register("other", factory)
