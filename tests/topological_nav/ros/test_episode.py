"""A whole episode over real DDS on loopback, recorded as a rosbag2 folder and read back with `rosbags`."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from interactive_nav.ros import messages
from interactive_nav.ros.__main__ import main as simulate
from tests.toys import write_room
from topological_nav.ros.__main__ import main

PROGRAM = [sys.executable, "-m", "interactive_nav.ros", "simulate"]
START = (-2.0, 0.5, 0.8)


def words_of(base, node):
    """Return the command line that runs a node beside the simulator of a toy room."""
    room = write_room(base / "room", (6.0, 4.0), (("chair", 1.4, -0.5, 5.0, 0.5),))
    settings = ["observations=[rgb]", "image_size=48", "num_objects=0", "control_mode=twist"]
    start = f"--start={','.join(map(str, START))}"
    return [*PROGRAM, room.name, "--robot", "ttbot", start, "--run", f"{sys.executable} {node}", *settings]


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    base = tmp_path_factory.mktemp("episode")
    # Relative paths are relative to the folder in which the command was given.
    words = words_of(base, Path(__file__).with_name("turning.py"))
    ran = subprocess.run([*words, "--lockstep", "--bag", "bag"], cwd=base, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    store, read = get_typestore(Stores.ROS2_KILTED), {}
    with Reader(base / "bag") as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        for connection, stamp, raw in reader.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            read.setdefault(connection.topic, []).append((stamp / 1e9, message))
    return SimpleNamespace(tally=json.loads(ran.stdout.splitlines()[-1]), read=read, kinds=kinds)


@pytest.mark.slow
def test_all_topics_are_in_the_bag_with_as_many_messages_as_steps(episode):
    assert episode.kinds == {
        topic: f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}" for topic, kind in messages.TOPICS.items()
    }
    counts = {topic: len(rows) for topic, rows in episode.read.items()}
    steps = round(episode.tally["seconds"] / 0.1)
    assert counts[messages.DONE] == 1
    # The last picture's command ends the episode; one more stops the robot.
    assert {counts[t] for t in messages.FROM_ROBOT if t != messages.TF_STATIC} == {steps + 1}
    assert steps + 1 <= counts[messages.COMMAND] <= steps + 2


@pytest.mark.slow
def test_the_robot_went_where_the_commands_said(episode):
    tally = episode.tally
    assert tally["done"] and tally["structure_s"] == 0 and tally["movable_s"] == 0
    x, y, yaw = tally["end_w"]
    assert 0.7 < x - START[0] < 1.05 and abs(y - START[1]) < 0.15 and abs(yaw) < 0.05
    # The same from the bag: odometry begins at the pose in the map.
    _, last = episode.read[messages.ODOMETRY][-1]
    assert [last.pose.pose.position.x, last.pose.pose.position.y] == pytest.approx([x, y], abs=2e-3)
    assert messages.quat_yaw(last.pose.pose.orientation) == pytest.approx(yaw, abs=2e-3)
    _, imu = episode.read[messages.HEADING][-1]
    assert messages.quat_yaw(imu.orientation) == pytest.approx(yaw, abs=2e-3)


@pytest.mark.slow
def test_every_command_follows_from_the_heading_of_its_picture(episode):
    headings = [messages.quat_yaw(m.orientation) for _, m in episode.read[messages.HEADING]]
    commands = [messages.twist_command(m) for _, m in episode.read[messages.COMMAND]][: len(headings)]
    turned = [a for v, a in commands if v == 0.0][:-2]
    assert turned == pytest.approx([max(-1.0, -2.0 * h) for h in headings[: len(turned)]], abs=1e-5)
    assert len(turned) > 5 and sum(v == 0.5 for v, _ in commands) == 20


@pytest.mark.slow
def test_pictures_scans_and_clock_hold_what_was_sensed(episode):
    read = episode.read
    pictures = [messages.image_array(m) for _, m in read[messages.IMAGE]]
    assert pictures[0].shape == (48, 48, 3) and pictures[0].std() > 5
    assert np.abs(pictures[-1].astype(float) - pictures[0]).mean() > 2
    _, info = read[messages.INFO][0]
    assert messages.info_lens(info).fov_deg == pytest.approx(120.0)
    # At the end the robot looks along x: the beam ahead meets the wall at x = 3, or is out of range.
    _, scan = read[messages.SCAN][-1]
    ahead = scan.ranges[round(-scan.angle_min / scan.angle_increment)]
    assert ahead == pytest.approx(3.0 - episode.tally["end_w"][0], abs=0.05)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in read[messages.IMAGE]]
    assert stamps == pytest.approx(1.0 + 0.1 * np.arange(len(stamps)))
    assert stamps == pytest.approx([m.clock.sec + 1e-9 * m.clock.nanosec for _, m in read[messages.CLOCK]])
    # The bag's times are those of the clock, a message of which may come after the picture's.
    assert [at for at, _ in read[messages.IMAGE]] == pytest.approx(stamps, abs=0.101)


@pytest.mark.heavy
def test_a_failed_node_is_in_the_exit_code(tmp_path):
    words = words_of(tmp_path, "-m topological_nav.ros --map x.npz passable=5")
    ran = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    first, last = ran.stderr.splitlines()[:: len(ran.stderr.splitlines()) - 1]
    assert ran.returncode == 2 and first.startswith("topological_nav.ros: setting: passable is 5.0"), ran.stderr
    assert last == f"interactive_nav.ros: {sys.executable} ended with exit code 2; its message is above"


@pytest.mark.slow
@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.heavy), signal.SIGTERM])
def test_a_stop_is_in_the_exit_code_and_ends_both_nodes(number, tmp_path):
    begun = subprocess.Popen(words_of(tmp_path, "-c 'import time; time.sleep(600)'"), cwd=tmp_path)
    children = Path(f"/proc/{begun.pid}/task/{begun.pid}/children")
    while not (nodes := children.read_text().split()):
        assert begun.poll() is None
        time.sleep(0.05)
    begun.send_signal(number)
    begun.communicate(timeout=60)
    assert begun.returncode == 128 + number
    assert not [pid for pid in nodes if os.path.exists(f"/proc/{pid}")]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["hight=3"], "unknown key 'hight'"),
        (["passable=5"], "passable is 5.0, expected between 0 and 1"),
    ],
)
def test_mistakes_are_one_line(words, told, capsys):
    assert main(["--map", "x.npz", *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("topological_nav.ros: ") and told in error and error.count("\n") == 1


def test_a_node_that_is_no_program_is_one_line(tmp_path, capsys):
    room = write_room(tmp_path / "room", (6.0, 4.0), (("chair", 1.4, -0.5, 5.0, 0.5),))
    assert simulate(["simulate", str(room), "--run", "nowhere 1"]) == 2
    assert capsys.readouterr().err == (
        "interactive_nav.ros: --run is 'nowhere 1', expected a program that can be run, with its words\n"
    )


def test_without_rclpy_the_command_that_installs_it_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert main(["--map", "x.npz"]) == 2
    error = capsys.readouterr().err
    assert "needs rclpy" in error and "pip install 'interactive-nav[ros2]'" in error and error.count("\n") == 1
