"""Robots given by a file: what is inferred, what the YAML file beside it says, Python functions, what a run keeps."""

import shutil
import warnings
from pathlib import Path

import pytest

import interactive_nav
from interactive_nav import robots, view
from interactive_nav.robots import reference
from interactive_nav.robots.__main__ import main
from interactive_nav_common.errors import ConfigError, UserError
from tests.interactive_nav.robots.test_add_a_robot import _cart
from tests.interactive_nav.robots.urdf import cart, joint, link
from tests.toys import write_room


def write(folder, text, name="porter.urdf"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def get(robot, mode="native"):
    """The spec, and what was warned of beside wheels and cylinders."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        spec = robots.get_robot(robot, mode)
    told = [str(w.message) for w in caught]
    return spec, [t for t in told if "meets furniture" not in t and "an octagon" not in t]


def test_a_bare_file_shows_its_wheels_casters_and_speed(tmp_path):
    spec, told = get(write(tmp_path, cart()))
    assert spec.name == "porter" and spec.base_body == "porter_base_link" and not told
    assert spec.actuators == ("porter_left_joint", "porter_right_joint") and spec.action_high == (10.0, 10.0)
    assert spec.rolling_bodies[2:] == ("porter_front_caster", "porter_rear_caster")
    assert spec.mass_kg == pytest.approx(13.2) and spec.reference == str(tmp_path / "porter.urdf")
    twist, again = get(spec.reference, "twist")
    assert twist.action_high == pytest.approx((0.7, 2 * 0.7 / 0.36)) and not again


def test_an_mjcf_with_four_wheels_is_sorted_from_front_to_back(tmp_path):
    text = _cart().replace('<motor name="old" joint="fl"/>', '<velocity joint="fl" kv="1" ctrlrange="-8 8"/>')
    spec, told = get(write(tmp_path, text, "rover.xml"))
    assert spec.actuators == ("rover_fl", "rover_rl", "rover_fr", "rover_rr") and spec.action_high == (8.0,) * 4
    assert told == ["nothing drives 'mast': they are held at home; name those to drive in joints"]


@pytest.mark.parametrize("limit", ["", '<limit effort="0" velocity="0"/>', '<limit effort="0" velocity="1000"/>'])
def test_limits_that_say_nothing_are_replaced_with_a_warning(tmp_path, limit):
    spec, told = get(write(tmp_path, cart(limit=limit)))
    assert spec.action_high == pytest.approx((1 / 0.07, 1 / 0.07))
    assert told == [
        "its wheels have no limit below 3 m/s; 1 m/s is taken",
        *(f"wheel joint '{side}_joint' has no torque limit; 9.06 N m is taken, at which it slips"
          for side in ("left", "right")),
    ]  # fmt: skip


def test_the_file_beside_it_overrides_and_completes(tmp_path):
    path = write(tmp_path, cart())
    write(tmp_path, "max_wheel_speed_rad_s: 4\nbody_width_m: 0.5\ncamera: {body: base_link, pos_m: [0.1, 0, 0.3]}\n"
          "casters: [front_caster]\ntorque_limits: {left_joint: 2}\n", "porter.yaml")  # fmt: skip
    spec, told = get(path)
    assert spec.action_high == (4.0, 4.0) and spec.body_width_m == 0.5 and not told
    assert spec.camera.body == "porter_base_link" and spec.camera.pos_m == (0.1, 0, 0.3)
    assert spec.rolling_bodies[2:] == ("porter_front_caster",)
    write(tmp_path, "name: hauler\n", "porter.yaml")  # another content is another robot
    assert get(path)[0].name == "hauler"


def test_what_cannot_be_inferred_comes_with_an_example_that_works(tmp_path):
    text = cart().replace('<cylinder radius="0.07" length="0.04"/>', '<box size="0.1 0.1 0.04"/>', 1)
    path = write(tmp_path, text)
    with pytest.raises(
        ConfigError, match="0 wheels on the left and 1 on the right are named, or stand on the floor"
    ) as refused:
        get(path)
    message = str(refused.value)
    example = message[message.index("{base_body") :]
    assert "name them in porter.yaml beside it" in message
    assert example == (
        "{base_body: base_link, left_wheels: ['left_joint'], right_wheels: ['right_joint'], max_wheel_speed_rad_s: 10}"
    )
    path = write(tmp_path, cart(), "other.urdf")
    write(tmp_path, example, "other.yaml")
    assert get(path)[0].action_high == (10.0, 10.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wheels: 2", "porter.yaml: unknown key 'wheels'.*known keys: base_body, body_width_m, camera"),
        ("left_wheels: left_joint", 'porter.yaml: left_wheels is "left_joint", expected a list'),
        ("[", "porter.yaml: not readable as YAML"),
        ("base_body: chassis", "no body named 'chassis'"),
        ("name: fetch", "robot 'fetch' exists already; rename the file, or set its name"),
    ],
)
def test_a_wrong_file_beside_it_is_refused(tmp_path, text, message):
    write(tmp_path, text, "porter.yaml")
    with pytest.raises(UserError, match=message):
        get(write(tmp_path, cart()))


def test_passive_wheels_of_a_swivel_are_not_driven(tmp_path):
    wheel = '<cylinder radius="0.03" length="0.02"/>'
    swivel = (
        link("fork", "", 0.1) + joint("swivel", "continuous", "base_link", "fork", "-0.25 0 0.1")
        + link("roll", wheel, 0.1)
        + joint("roll_joint", "continuous", "fork", "roll", "-0.03 0 -0.07", "-1.5708 0 0")
    )  # fmt: skip
    spec, told = get(write(tmp_path, cart(swivel)))
    assert spec.actuators == ("porter_left_joint", "porter_right_joint")
    assert told == ["nothing drives 'swivel', 'roll_joint': they turn freely"]


MODULE = """
from pathlib import Path
from interactive_nav import robots
FACTS = dict(base_body="base_link", left_wheels=("left_joint",), right_wheels=("right_joint",),
             max_wheel_speed_rad_s=6.0, casters=("front_caster", "rear_caster"))
def made(): return robots.from_file(Path(__file__).with_name("porter.urdf"), name="mine_made", **FACTS)
def registers(): robots.register("mine_registered", robots.from_file(
    Path(__file__).with_name("porter.urdf"), name="mine_registered", **FACTS))
factory = robots.from_file(Path(__file__).with_name("porter.urdf"), name="mine_factory", **FACTS)
def by_mode(control_mode="native"): return factory(control_mode)
def nothing(): return 3
def breaks(): return {}["wheel"]
def other(): return robots.from_file("none.urdf", name="x", **FACTS)
"""


@pytest.mark.parametrize("function", ["made", "registers", "factory", "by_mode"])
def test_a_python_function_gives_a_robot(tmp_path, monkeypatch, function):
    monkeypatch.setattr(robots, "_FACTORIES", dict(robots._FACTORIES))
    write(tmp_path, cart())
    path = f"{write(tmp_path, MODULE, f'{function}.py')}:{function}"
    assert get(path)[0].action_high == (6.0, 6.0) and get(path, "twist")[0].reference == path
    assert robots.robot_name(path) == get(path)[0].name


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ("mine.py:nothing", "gave type int, expected a RobotSpec for a control mode, or what from_file returns"),
        ("mine.py:breaks", "raised KeyError: 'wheel'"),
        ("mine.py:absent", "mine.py has no 'absent'.*expected one of its functions: "),
        ("mine.py", "mine.py has no ''.*expected one of its functions"),
        ("mine.py:other", "robot file .*none.urdf does not exist"),
        ("absent.py:made", "robot file .*absent.py does not exist, expected a URDF or MJCF file, or path/to/file.py"),
        ("absent.urdf", "robot file .*absent.urdf does not exist"),
        ("turtelbot", "unknown robot 'turtelbot', did you mean 'turtlebot'.*; or a URDF or MJCF file"),
    ],
)
def test_what_gives_no_robot_is_refused_in_one_line(tmp_path, monkeypatch, robot, message):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, cart())
    write(tmp_path, MODULE, "mine.py")
    with pytest.raises(UserError, match=message) as refused:
        get(robot)
    assert "\n" not in str(refused.value)


def test_make_the_viewer_and_the_table_take_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, cart())
    room = write_room(tmp_path / "room")
    env = interactive_nav.make("porter.urdf", [str(room)], backend="native", num_objects=1)
    assert env.robot.name == "porter" and env.action_size == 2
    model = view.build_model(room, get("porter.urdf")[0], [])
    assert model.body("porter_base_link").mass[0] == pytest.approx(12.0)
    assert main(["porter.urdf"]) == 0
    assert "porter" in (table := capsys.readouterr().out) and "turtlebot" not in table


def test_a_run_keeps_the_files_of_its_robot(tmp_path):
    path = write(tmp_path, cart())
    write(tmp_path, "max_wheel_speed_rad_s: 4\n", "porter.yaml")
    reference.record_robot(path, tmp_path / "run" / "robot")
    shutil.move(tmp_path / "run", tmp_path / "moved")
    (tmp_path / "porter.urdf").unlink()
    kept, identity = reference.recorded_robot(tmp_path / "moved" / "robot") or ("", "")
    assert get(kept)[0].action_high == (4.0, 4.0) and get(kept)[0].name == "porter"
    assert identity.startswith("porter.urdf, sha256 ") and reference.identity(kept) == identity
    (tmp_path / "moved" / "robot" / "porter.yaml").write_text("max_wheel_speed_rad_s: 5\n")
    with pytest.warns(UserWarning, match="porter.urdf changed since the run began"):
        reference.recorded_robot(tmp_path / "moved" / "robot")


def test_a_run_refers_to_a_python_function_and_to_files_that_name_others(tmp_path):
    places = (
        write(tmp_path, MODULE, "mine.py") + ":made",
        write(tmp_path, '<mujoco><include file="x"/></mujoco>', "a.xml"),
        write(tmp_path, f'<robot><mesh filename="package://x/{Path(write(tmp_path, "", "a.stl")).name}"/></robot>'),
    )
    for k, place in enumerate(places):
        reference.record_robot(place, tmp_path / f"robot{k}")
        assert reference.recorded_robot(tmp_path / f"robot{k}") == (place, reference.identity(place))
        assert [p.name for p in (tmp_path / f"robot{k}").iterdir()] == ["reference.json"]
    (tmp_path / "mine.py").write_text(MODULE + "#")
    with pytest.warns(UserWarning, match="mine.py:made changed since the run began"):
        reference.recorded_robot(tmp_path / "robot0")
    (tmp_path / "mine.py").unlink()
    lost, _ = reference.recorded_robot(tmp_path / "robot0") or ("", "")
    with pytest.raises(ConfigError, match="mine.py does not exist.*to play a run, give env.robot=PATH"):
        get(lost)


def test_robots_with_a_name_leave_nothing_in_a_run(tmp_path):
    reference.record_robot("fetch", tmp_path / "robot")
    assert not (tmp_path / "robot").exists() and reference.recorded_robot(tmp_path / "robot") is None
    assert reference.identity("fetch") == robots.robot_name("fetch") == "fetch"


def test_a_circle_of_links_is_one_line(tmp_path):
    (tmp_path / "porter.urdf").symlink_to("porter.urdf")
    with pytest.raises(ConfigError, match="porter.urdf does not exist, expected a URDF or MJCF file"):
        get(str(tmp_path / "porter.urdf"))
