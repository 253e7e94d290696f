"""A whole episode over topics of a real master on loopback, recorded and read back with `rosbags`."""

import functools
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from interactive_nav_common.config import overridden
from tests.toys import write_room
from topological_nav.ros import debian, messages, topics
from topological_nav.ros.__main__ import main
from topological_nav.ros.config import SimulatorConfig

PROGRAM = [sys.executable, "-m", "topological_nav.ros"]
START = (-2.0, 0.5, 0.8)


@functools.cache
def what_is_missing():
    """Asked once, and of a process of its own: Debian's packages are not to come into this one."""
    asked = subprocess.run([*PROGRAM, "check"], capture_output=True, text=True)
    return asked.stderr.strip() if asked.returncode else ""


def ros_or_skip():
    if what_is_missing():
        pytest.skip(what_is_missing())
    return pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed (pip install rosbags)")


def begin_all(base, *words):
    """`all` in `base`, with a master of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        master = f"http://localhost:{free.getsockname()[1]}"
    environment = {**os.environ, "ROS_LOG_DIR": str(base / "log"), "ROS_MASTER_URI": master}
    for name in ("ROS_IP", "ROS_HOSTNAME", "ROS_PACKAGE_PATH"):
        environment.pop(name, None)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*PROGRAM, "all", *words], env=environment, cwd=base, **pipes)


def run_all(base, *words):
    """The same, to its end."""
    begun = begin_all(base, *words)
    out, err = begun.communicate()
    return subprocess.CompletedProcess(words, begun.returncode, out, err)


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    rosbag1 = ros_or_skip()
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    base = tmp_path_factory.mktemp("episode")
    room = write_room(base / "room", (6.0, 4.0), (("chair", 1.4, -0.5, 5.0, 0.5),))
    bag = base / "episode.bag"
    simulator = f"--lockstep engine=rays width=64 height=48 supersample=1 start={list(START)}".replace(", ", ",")
    words = [f"scene:={room.name}", f"sim:={simulator}", "navigator:=drive_s=2 heading_rad=0 linear_mps=0.5"]
    # What is relative is so to where the command was given.
    ran = run_all(base, f"bag:={bag.name}", *words)
    assert ran.returncode == 0 and bag.is_file(), ran.stdout + ran.stderr
    told = next(line for line in ran.stdout.splitlines() if line.startswith("{"))
    store, read = get_typestore(Stores.ROS1_NOETIC), {}
    with rosbag1.Reader(bag) as reader:
        for connection in reader.connections:
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, stamp, raw in reader.messages():
            message = store.deserialize_ros1(raw, connection.msgtype)
            read.setdefault(connection.topic, []).append((stamp / 1e9, message))
        kinds = {c.topic: c.msgtype.replace("/msg/", "/") for c in reader.connections}
    return SimpleNamespace(tally=json.loads(told), read=read, kinds=kinds)


@pytest.mark.slow
def test_all_topics_are_in_the_bag_with_as_many_messages_as_steps(episode):
    assert episode.kinds == topics.TOPICS
    counts = {topic: len(rows) for topic, rows in episode.read.items()}
    steps = round(episode.tally["seconds"] / 0.1)
    once = {topics.TF_STATIC, topics.DONE}
    assert {counts[t] for t in once} == {1}
    # The last picture's command ends the episode; one more stops the robot.
    assert {counts[t] for t in set(topics.FROM_ROBOT) - once - {topics.CLOCK}} == {steps + 1}
    assert steps + 1 <= counts[topics.COMMAND] <= steps + 2


@pytest.mark.slow
def test_the_robot_went_where_the_commands_said(episode):
    tally = episode.tally
    assert tally["done"] and tally["structure_s"] == 0 and tally["movable_s"] == 0
    x, y, yaw = tally["end_w"]
    assert 0.7 < x - START[0] < 1.05 and abs(y - START[1]) < 0.15 and abs(yaw) < 0.05
    # The same from the bag: odometry's frame is the start's.
    _, last = episode.read[topics.ODOMETRY][-1]
    ahead, left = last.pose.pose.position.x, last.pose.pose.position.y
    cos, sin = math.cos(START[2]), math.sin(START[2])
    assert [START[0] + cos * ahead - sin * left, START[1] + sin * ahead + cos * left] == pytest.approx([x, y], abs=2e-3)
    assert messages.quat_yaw(last.pose.pose.orientation) == pytest.approx(yaw - START[2], abs=2e-3)
    _, imu = episode.read[topics.HEADING][-1]
    assert messages.quat_yaw(imu.orientation) == pytest.approx(yaw, abs=2e-3)


@pytest.mark.slow
def test_every_command_follows_from_the_heading_of_its_picture(episode):
    headings = [messages.quat_yaw(m.orientation) for _, m in episode.read[topics.HEADING]]
    commands = [messages.twist_command(m) for _, m in episode.read[topics.COMMAND]][: len(headings)]
    turned = [a for v, a in commands if v == 0.0][:-2]
    assert turned == pytest.approx([max(-1.0, -2.0 * h) for h in headings[: len(turned)]], abs=1e-5)
    assert len(turned) > 5 and sum(v == 0.5 for v, _ in commands) == 20


@pytest.mark.slow
def test_pictures_scans_and_clock_hold_what_was_sensed(episode):
    read = episode.read
    pictures = [messages.image_array(m) for _, m in read[topics.IMAGE]]
    assert pictures[0].shape == (48, 64, 3) and pictures[0].std() > 5
    assert np.abs(pictures[-1].astype(float) - pictures[0]).mean() > 2
    _, info = read[topics.INFO][0]
    assert messages.info_lens(info).fov_deg == pytest.approx(120.0)
    # At the end the robot looks along x: the beam ahead meets the wall at x = 3, or is out of range.
    _, scan = read[topics.SCAN][-1]
    ahead = scan.ranges[round(-scan.angle_min / scan.angle_increment)]
    assert ahead == pytest.approx(3.0 - episode.tally["end_w"][0] - 0.17, abs=0.05)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in read[topics.IMAGE]]
    assert stamps == pytest.approx(1.0 + 0.1 * np.arange(len(stamps)))
    # The first time is told until all have joined.
    assert stamps == pytest.approx(sorted({m.clock.sec + 1e-9 * m.clock.nanosec for _, m in read[topics.CLOCK]}))
    # rosbag has its time from the clock, which goes its own way to it.
    assert [at for at, _ in read[topics.IMAGE]] == pytest.approx(stamps, abs=0.101)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["scene:=nowhere", "python:=nowhere"], "ended with exit code 127"),
        (["scene:=nowhere"], r"simulator-\d+ ended with exit code 2; "),
        ([], "requires the 'scene' arg to be set"),
    ],
)
def test_a_failed_node_is_in_the_exit_code(words, told, tmp_path):
    ros_or_skip()
    ran = run_all(tmp_path, *words)
    last = ran.stderr.splitlines()[-1]
    assert ran.returncode == 2 and last.startswith("topological_nav.ros: ") and re.search(told, last), ran.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_is_in_the_exit_code(number, tmp_path):
    ros_or_skip()
    idle = tmp_path / "idle"
    idle.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\nexec sleep 60\n")
    idle.chmod(0o755)
    begun = begin_all(tmp_path, "scene:=nowhere", f"python:={idle}")
    while not (tmp_path / "started").exists():
        assert begun.poll() is None, begun.communicate()
        time.sleep(0.05)
    time.sleep(0.5)  # roslaunch looks after its handlers every 0.1 s
    begun.send_signal(number)
    begun.communicate(timeout=60)
    assert begun.returncode == 128 + number


def test_without_a_master_the_navigator_says_so(monkeypatch, tmp_path, capfd):
    ros_or_skip()
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    asked = subprocess.run([*PROGRAM, "navigator"], capture_output=True, text=True)
    assert asked.returncode == 2
    assert "no master answers at http://127.0.0.1:9; start one" in asked.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["sim", "room", "hight=3"], "unknown key 'hight', did you mean 'height'?"),
        (["sim", "room", "drive_s=3"], "unknown key 'drive_s'"),
        (["navigator", "linear_mps=5"], "linear_mps is 5.0, expected between -2 and 2"),
    ],
)
def test_mistakes_are_one_line(words, told, capsys, monkeypatch):
    monkeypatch.setattr("topological_nav.ros.debian.load", lambda: None)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("topological_nav.ros: ") and told in error and error.count("\n") == 1


def test_ci_installs_the_packages_that_are_asked_for():
    script = Path(__file__).parents[3] / ".ci" / "run"
    if not script.is_file():
        pytest.skip("no .ci/run here (an installed copy)")
    assert " ".join(debian.PACKAGES.split()) in " ".join(script.read_text().replace("\\\n", " ").split())


def test_a_start_is_read_from_the_command_line():
    assert overridden(SimulatorConfig(), ["start=[1,2,0.5]"]).start == (1.0, 2.0, 0.5)
