"""Previews: the converted side alone, and beside the raw scan; a source of another scene is refused."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from PIL import Image

from converters.__main__ import main
from converters.preview import preview
from scenes_mjcf.schema import SceneError


def colours(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_a_source_adds_scan_and_cut(tiny_scene, pristine, tmp_path):
    folder = tiny_scene[0]
    preview(folder, tmp_path / "four.png")
    assert main(["preview", str(folder), "-o", str(tmp_path / "six.png"), "--source", str(pristine / "gibson")]) == 0
    four, six = colours(tmp_path / "four.png"), colours(tmp_path / "six.png")
    assert six.shape[1] > 1.3 * four.shape[1]  # three columns, not two
    for picture in (four, six):
        # The traversable area is drawn in its own colour, 0.85 0.94 0.85.
        near = np.abs(picture.astype(int) - [217, 240, 217]).max(axis=2) <= 6
        assert 0.03 < near.mean() < 0.8
    assert sorted(p.name for p in tmp_path.iterdir()) == ["four.png", "six.png"]


def test_the_source_of_another_scene_is_refused(tiny_scene, gibson_raw, tmp_path):
    path = gibson_raw / "floors.txt"
    path.write_text(path.read_text() + "\n")
    with pytest.raises(SceneError, match=r"floors.txt differs.; give its own --source"):
        preview(tiny_scene[0], tmp_path / "p.png", gibson_raw)
    shutil.rmtree(gibson_raw)
    assert main(["preview", str(tiny_scene[0]), "-o", str(tmp_path / "p.png"), "--source", str(gibson_raw)]) == 2
    assert not (tmp_path / "p.png").exists()
