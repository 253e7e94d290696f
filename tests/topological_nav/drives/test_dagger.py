"""A policy drives and the expert labels: whose commands are executed, what is recorded, where a drive ends."""

import dataclasses
import functools
import json

import numpy as np
import pytest

from interactive_nav_common.config import overridden
from interactive_nav_common.errors import ConfigError
from tests.topological_nav.conftest import DRIVEN
from topological_nav.__main__ import main
from topological_nav.config import DriveConfig
from topological_nav.drives import dagger
from topological_nav.drives.dataset import Drives, load_drives, simulate_drives, summary
from topological_nav.drives.driving import load_policy

CONFIG = overridden(DriveConfig(), [*DRIVEN, "driver=a-digest"])


class Constant:
    """Commands one velocity, and counts the steps of its memory."""

    def __init__(self, linear: float):
        self.linear, self.seen = linear, []

    def start(self, batch: int):
        return (np.zeros(batch, int),)

    def act(self, state, images):
        self.seen.append((state[0].copy(), images.mean((1, 2, 3))))
        return (state[0] + 1,), np.full(len(images), self.linear), np.zeros(len(images))


class Renderer:
    """Draws the time that a scene's cameras were asked, and records their places."""

    def __init__(self):
        self.pos_w = []

    def draw(self, pose):
        self.pos_w.append(pose.pos_w)
        return np.full((len(pose.pos_w), 32, 32, 3), 1 + len(self.pos_w) % 200, np.uint8)


def simulated(painted, out, config, driver, renderer=None) -> Drives:
    pupil = functools.partial(dagger.Pupil, driver=driver, renderers=[renderer or Renderer()])  # type: ignore[arg-type]
    return simulate_drives([painted], out, config, pupil=pupil)


@pytest.fixture(scope="module")
def own(driven) -> Drives:
    """The expert's own drives of the same plan."""
    return load_drives(driven)


def test_an_expert_that_drives_all_steps_drives_as_without_a_policy(painted, own, tmp_path):
    drives = simulated(painted, tmp_path, dataclasses.replace(CONFIG, expert_share=1.0), Constant(0.0))
    for name in ("scene", "test", "first", "touching", "reached", "broken", "goal_w"):
        assert (getattr(drives, name) == getattr(own, name)).all(), name
    for name in ("pose_w", "command", "gap_m"):  # another program rounds in another way
        assert getattr(drives, name) == pytest.approx(getattr(own, name), abs=1e-4), name
    assert drives.labelled.all() and not own.labelled.any()


def test_a_policy_that_stands_still_is_told_what_the_expert_would_do_at_the_start(painted, own, tmp_path):
    driver, renderer = Constant(0.0), Renderer()
    drives = simulated(painted, tmp_path, dataclasses.replace(CONFIG, leg_s=6.0, batch=10), driver, renderer)
    assert drives.steps.tolist() == [60] * 10  # a leg of 6 s
    first = drives.first[:-1]
    assert (drives.pose_w[first] == own.pose_w[own.first[:-1]]).all()
    assert drives.command[first] == pytest.approx(own.command[own.first[:-1]], abs=1e-6)
    command = drives.command.reshape(10, 60, 2)
    # The expert speeds up by 0.1 m/s a step at most, in its own mind: the robot has not moved.
    assert (np.abs(np.diff(command, axis=1)).max((0, 1)) <= [0.1 + 1e-5, 0.4 + 1e-5]).all()
    assert np.median(command[:, -1, 0]) == pytest.approx(0.5)
    assert np.ptp(drives.pose_w.reshape(10, 60, 3)[..., :2], axis=1).max() < 0.01
    row = summary(drives)
    assert (row["reached"], row["touched"], row["kept"]) == (0.0, 0.0, 1.0)
    # Each step was seen once, from the pose of the step, and the memory was fresh after 5 s.
    assert len(renderer.pos_w) == 60
    assert [int(memory[0]) for memory, _ in driver.seen[:60]] == [*range(50), *range(10)]
    assert [int(image[0]) for _, image in driver.seen[:60]] == list(range(2, 62))
    gone = renderer.pos_w[0][:, :2] - drives.pose_w[first, :2]
    assert np.linalg.norm(gone, axis=1).max() < 0.3  # the camera sits on the robot


def test_a_drive_ends_where_it_touches_and_is_kept_until_then(painted, tmp_path):
    drives = simulated(painted, tmp_path, CONFIG, Constant(0.5))
    assert drives.touched.sum() >= 3 and drives.kept.all()
    for k in range(len(drives)):
        rows = drives.rows(k)
        assert not drives.touching[rows[:-1]].any()  # only the last step touched: no image shows what came of it
        assert drives.touching[rows[-1]].any() or drives.reached[k]
    row = summary(drives)
    assert row["touched"] == drives.touched.mean() and row["reached"] == drives.reached.mean() < 1.0
    assert row["contact_s"] == pytest.approx(0.1 * row["touched"])


@pytest.mark.heavy
def test_the_share_of_steps_is_the_experts_whatever_the_batch(painted, own, tmp_path):
    config = dataclasses.replace(CONFIG, expert_share=0.5)
    drives = simulated(painted, tmp_path / "a", config, Constant(0.0))
    other = simulated(painted, tmp_path / "b", dataclasses.replace(config, batch=10), Constant(0.0))
    assert (drives.first == other.first).all() and drives.pose_w == pytest.approx(other.pose_w, abs=1e-4)
    # Half the steps stand still: the same ways take about twice as long.
    both = drives.reached & own.reached
    assert both.sum() >= 5 and 1.6 < np.median(drives.steps[both] / own.steps[both]) < 2.6


@pytest.mark.heavy
def test_the_command_names_the_driver_by_its_weights_and_what_it_draws_teaches(
    painted, made, steered, tmp_path, capsys
):
    out = tmp_path / "drives"
    words = ["data", "--drives", str(painted), "-o", str(out), *DRIVEN, f"driver={steered}", "expert_share=0.5"]
    assert main(words) == 0
    drives, settings = load_drives(out), json.loads((out / "drives.json").read_text())["settings"]
    assert settings["driver"] == load_policy(steered).about["digest"] and settings["expert_share"] == 0.5
    assert f"kept {int(drives.kept.sum())}" in capsys.readouterr().out and drives.kept.all()
    stamp = (out / "batch-000.npz").stat().st_mtime_ns
    assert main(words) == 0 and (out / "batch-000.npz").stat().st_mtime_ns == stamp
    runs = ["--localiser", str(made.rooms), "--detector", str(made.passages), "-o", str(tmp_path / "policy")]
    small = ["hidden=8", "projection=8", "forward_hidden=8", "steps=20", "batch=8", "epochs=1", "straight_kept=1"]
    assert main(["train", "policy", "--data", str(out), *runs, *small]) == 0


def test_another_camera_and_wrong_shares_are_refused(painted, steered, tmp_path, capsys):
    words = ["data", "--drives", str(painted), "-o", str(tmp_path / "new"), *DRIVEN, f"driver={steered}"]
    assert main([*words, "width=64"]) == 2
    told = capsys.readouterr().err
    assert "images have width = 64, the networks learned from 32; drive again with width=32" in told
    assert not (tmp_path / "new").exists()
    assert main([*words, "expert_share=1.5"]) == 2
    assert "expert_share is 1.5, expected between 0 and 1" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="expert_share is 0.5, which changes nothing here: expected driver=RUN"):
        DriveConfig(expert_share=0.5)
