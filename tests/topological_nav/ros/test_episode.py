"""A whole episode over real DDS on loopback, recorded as a rosbag2 folder and read back with `rosbags`."""

import json
import math
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
from interactive_nav_common.config import overridden
from tests.toys import write_room
from topological_nav.ros.__main__ import main
from topological_nav.ros.config import SimulatorConfig

PROGRAM = [sys.executable, "-m", "topological_nav.ros"]
LIGHT = '''
import sys
from topological_nav.ros import __main__ as program
node = """if True:
    import signal, sys, time
    if sys.argv[1:] == ["sim", "nowhere"]:
        from topological_nav.ros.__main__ import main
        sys.exit(main())
    signal.signal(15, lambda *_: sys.exit(0))
    time.sleep(60)
"""
program.PROGRAM = [sys.executable, "-c", node]
sys.exit(program.main(sys.argv[1:]))
'''
"""The same program with nodes that only wait for SIGTERM; the simulator of `nowhere` is the real one."""
START = (-2.0, 0.5, 0.8)


def run_all(base, *words):
    """Run `all` to its end."""
    return subprocess.run([*PROGRAM, "all", *map(str, words)], cwd=base, capture_output=True, text=True)


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    base = tmp_path_factory.mktemp("episode")
    room = write_room(base / "room", (6.0, 4.0), (("chair", 1.4, -0.5, 5.0, 0.5),))
    simulator = f"--lockstep engine=rays width=64 height=48 supersample=1 start={list(START)}".replace(", ", ",")
    # Relative paths are relative to the folder in which the command was given.
    words = [room.name, f"--sim={simulator}", "--navigator", "drive_s=2 heading_rad=0 linear_mps=0.5"]
    ran = run_all(base, *words, "--bag", "bag")
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
    # The same from the bag: odometry's frame is the start's.
    _, last = episode.read[messages.ODOMETRY][-1]
    ahead, left = last.pose.pose.position.x, last.pose.pose.position.y
    cos, sin = math.cos(START[2]), math.sin(START[2])
    assert [START[0] + cos * ahead - sin * left, START[1] + sin * ahead + cos * left] == pytest.approx([x, y], abs=2e-3)
    assert messages.quat_yaw(last.pose.pose.orientation) == pytest.approx(yaw - START[2], abs=2e-3)
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
    assert pictures[0].shape == (48, 64, 3) and pictures[0].std() > 5
    assert np.abs(pictures[-1].astype(float) - pictures[0]).mean() > 2
    _, info = read[messages.INFO][0]
    assert messages.info_lens(info).fov_deg == pytest.approx(120.0)
    # At the end the robot looks along x: the beam ahead meets the wall at x = 3, or is out of range.
    _, scan = read[messages.SCAN][-1]
    ahead = scan.ranges[round(-scan.angle_min / scan.angle_increment)]
    assert ahead == pytest.approx(3.0 - episode.tally["end_w"][0] - 0.17, abs=0.05)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in read[messages.IMAGE]]
    assert stamps == pytest.approx(1.0 + 0.1 * np.arange(len(stamps)))
    assert stamps == pytest.approx([m.clock.sec + 1e-9 * m.clock.nanosec for _, m in read[messages.CLOCK]])
    # The bag's times are those of the clock, a message of which may come after the picture's.
    assert [at for at, _ in read[messages.IMAGE]] == pytest.approx(stamps, abs=0.101)


@pytest.mark.slow
def test_a_failed_node_is_in_the_exit_code(tmp_path):
    ran = subprocess.run([sys.executable, "-c", LIGHT, "all", "nowhere"], cwd=tmp_path, capture_output=True, text=True)
    last = ran.stderr.splitlines()[-1]
    assert ran.returncode == 2 and last.startswith("topological_nav.ros: "), ran.stderr
    assert "simulator ended with exit code 2; its message is above" in last
    assert "nowhere" in ran.stderr.splitlines()[0]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_is_in_the_exit_code_and_ends_both_nodes(number, tmp_path):
    begun = subprocess.Popen([sys.executable, "-c", LIGHT, "all", "room"], cwd=tmp_path)
    children = Path(f"/proc/{begun.pid}/task/{begun.pid}/children")
    while len(nodes := children.read_text().split()) < 2:
        assert begun.poll() is None
        time.sleep(0.05)
    time.sleep(0.3)  # so that their handlers are there
    begun.send_signal(number)
    begun.communicate(timeout=60)
    assert begun.returncode == 128 + number
    assert not [pid for pid in nodes if os.path.exists(f"/proc/{pid}")]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["sim", "room", "hight=3"], "unknown key 'hight', did you mean 'height'?"),
        (["sim", "room", "drive_s=3"], "unknown key 'drive_s'"),
        (["navigator", "linear_mps=5"], "linear_mps is 5.0, expected between -2 and 2"),
    ],
)
def test_mistakes_are_one_line(words, told, capsys):
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("topological_nav.ros: ") and told in error and error.count("\n") == 1


def test_without_rclpy_the_command_that_installs_it_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert main(["all", "room"]) == 2
    error = capsys.readouterr().err
    assert "needs rclpy" in error and "pip install 'interactive-nav[ros2]'" in error and error.count("\n") == 1


def test_a_start_is_read_from_the_command_line():
    assert overridden(SimulatorConfig(), ["start=[1,2,0.5]"]).start == (1.0, 2.0, 0.5)
