"""Drives through a toy scene: what was driven, against geometry; files that go on, repeat and refuse."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import shapely
from PIL import Image

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.config import overridden
from interactive_nav_common.errors import FileError, UserError
from tests.topological_nav.conftest import DRIVEN
from topological_nav.__main__ import main
from topological_nav.config import DriveConfig
from topological_nav.data.folders import lens_of, read_shard
from topological_nav.drives import dataset as driving
from topological_nav.drives.expert import drive_env
from topological_nav.scenes.rendering import SceneRenderer, camera_pose

CONFIG = overridden(DriveConfig(), DRIVEN)
CUBES = [shapely.box(1.2, -0.7, 1.6, -0.3), shapely.box(-1.7, 0.3, -1.3, 0.7), shapely.box(-0.05, -2.0, 0.05, 1.0)]
"""Furniture and the partition of the painted scene."""


@pytest.fixture(scope="module")
def drives(driven):
    return driving.load_drives(driven)


def test_the_expert_arrives_and_touches_nothing(drives):
    row = driving.summary(drives)
    assert row["drives"] == 10 and row["reached"] >= 0.9 and row["touched"] == 0.0 and row["contact_s"] == 0.0
    assert not drives.broken.any()
    ends = np.array([drives.pose_w[drives.rows(k)[-1], :2] for k in np.flatnonzero(drives.reached)])
    # The last pose is of the beginning of the last step, at most 0.05 m before the node's circle.
    assert np.linalg.norm(ends - drives.goal_w[drives.reached], axis=1).max() < CONFIG.reached_m + 0.06


def test_the_drives_are_those_of_before(drives):
    """Golden numbers of the loop that drove before `rollout` did, on C MuJoCo."""
    assert drives.steps.tolist() == [46, 49, 89, 32, 79, 61, 30, 94, 23, 25]
    assert np.abs(drives.pose_w).sum(0) == pytest.approx([723.5778, 474.8871, 773.8063], rel=1e-3)
    assert np.abs(drives.command).sum(0) == pytest.approx([237.3, 110.7], rel=1e-3)


def test_the_footprint_keeps_clear_of_what_stands_there(drives):
    half = np.array([0.25, 0.225])
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half
    room = shapely.box(-3, -2, 3, 2)
    for x, y, yaw in drives.pose_w[::3]:
        turned = corners @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        body = shapely.Polygon(turned + [x, y])
        assert all(body.distance(cube) > 0.01 for cube in CUBES) and room.contains(body)


def test_commands_stay_within_bounds_and_move_the_robot(drives):
    v, w = drives.command.T
    assert v.min() >= 0 and v.max() <= 0.5 + 1e-6 and np.abs(w).max() <= 0.5 + 1e-6
    moved, asked, turned = [], [], []
    for k in range(len(drives)):
        rows = drives.rows(k)
        moved.append(np.linalg.norm(np.diff(drives.pose_w[rows, :2], axis=0), axis=1).sum())
        asked.append(0.1 * v[rows].sum())
        step = np.diff(drives.pose_w[rows, 2])
        turned.append([((step + np.pi) % (2 * np.pi) - np.pi).sum(), 0.1 * w[rows][:-1].sum()])
    assert np.array(moved) == pytest.approx(np.array(asked), rel=0.2, abs=0.1)
    # A skid steer turns by some tenths less than it is told.
    turned, told = np.array(turned).T
    assert turned == pytest.approx(told, rel=0.3, abs=0.3)
    # Within the dynamic window: 0.1 m/s and 0.4 rad/s a step.
    for k in range(len(drives)):
        change = np.abs(np.diff(drives.command[drives.rows(k)], axis=0)).max(0)
        assert (change <= [0.1 + 1e-5, 0.4 + 1e-5]).all()


def test_images_are_what_the_robot_saw(drives, driven, painted):
    robot, scene = get_robot("ttbot"), load_scene(painted)
    renderer = SceneRenderer(scene, lens_of(CONFIG, robot), 1)
    seen = 0
    for rows, images in driving.drive_images(driven):
        assert len(images) == drives.steps[rows].sum() and images.shape[1:] == (32, 32, 3)
        seen += len(rows)
        at = drives.rows(rows)
        some = np.array([0, len(at) // 2, len(at) - 1])
        pose = drives.pose_w[at[some]]
        assert (renderer.draw(camera_pose(robot, pose[:, :2], pose[:, 2], np.zeros(3))) == images[some]).all()
    assert seen == drives.kept.sum()
    assert Image.open(driven / "preview.png").size[0] > 800


def test_an_interrupted_folder_is_completed_to_the_same(drives, driven, painted, tmp_path):
    copy = tmp_path / "drives"
    shutil.copytree(driven, copy)
    kept = sorted(copy.glob("painted/images-*.npz"))
    before = read_shard(kept[-1])
    stamp = (copy / "batch-000.npz").stat().st_mtime_ns
    (copy / "batch-001.npz").unlink()
    kept[-1].unlink()
    with pytest.raises(FileError, match="batch-001.npz is missing; the same 'data --drives' command goes on"):
        driving.load_drives(copy)
    told = []
    again = driving.simulate_drives([painted], copy, CONFIG, lambda *x: told.append(x))
    assert (copy / "batch-000.npz").stat().st_mtime_ns == stamp
    assert told[0] == ("drives", 6, 10) and told[-1] == ("drives", 10, 10)
    for field in dataclasses.fields(drives):
        assert (getattr(again, field.name) == getattr(drives, field.name)).all(), field.name
    with pytest.raises(FileError, match="images-00. is missing|images-00..npz is missing"):
        list(driving.drive_images(copy))
    driving.draw_drives([painted], copy)
    assert (read_shard(kept[-1]) == before).all()


def test_other_settings_and_other_folders_are_refused(driven, painted, tmp_path, capsys):
    with pytest.raises(FileError, match="the dataset there has legs = 3, this one 2"):
        driving.simulate_drives([painted], driven, dataclasses.replace(CONFIG, legs=2))
    copy = tmp_path / "drives"
    copy.mkdir()
    header = json.loads((driven / "drives.json").read_text())
    header["scenes"][0]["digest"] = "0" * 64
    (copy / "drives.json").write_text(json.dumps(header))
    with pytest.raises(FileError, match="is of painted as they were; the scenes differ"):
        driving.simulate_drives([painted], copy, CONFIG)
    with pytest.raises(FileError, match="holds no drives"):
        driving.load_drives(tmp_path)
    assert main(["data", "--drives", str(painted), "-o", str(tmp_path / "new"), "leg=2"]) == 2
    assert "unknown key 'leg', did you mean 'legs'?" in capsys.readouterr().err


def test_a_robot_without_a_scanner_is_refused(painted):
    with pytest.raises(UserError, match="robot is 'turtlebot', expected one with a scanner: ttbot"):
        drive_env([painted], dataclasses.replace(CONFIG, robot="turtlebot"))


def test_contacts_and_failures_are_counted_and_left_out():
    touching = np.zeros((9, 2), bool)
    touching[4, 0] = touching[5, 1] = True
    made = driving.Drives(
        np.zeros(3, np.int32),
        np.zeros(3, bool),
        np.array([0, 3, 6, 9]),
        np.zeros((9, 3), np.float32),
        np.tile(np.array([0.4, 0.2], np.float32), (9, 1)),
        touching,
        np.zeros(9, np.float32),
        np.array([True, True, False]),
        np.zeros(3, bool),
        np.zeros((3, 2)),
    )
    assert made.touched.tolist() == [False, True, False] and made.kept.tolist() == [True, False, False]
    assert made.rows(1).tolist() == [3, 4, 5] and made.rows(np.array([2, 0])).tolist() == [6, 7, 8, 0, 1, 2]
    row = driving.summary(made)
    assert row["reached"] == pytest.approx(2 / 3) and row["touched"] == row["kept"] == pytest.approx(1 / 3)
    assert row["contact_s"] == pytest.approx(0.2 / 3) and row["seconds"] == pytest.approx(0.3)
    assert row["m_s"] == pytest.approx(0.4) and row["turning"] == 1.0
