"""The sheet of CAD models: what a picture shows, which models are on it, and names that are none."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from converters.__main__ import main
from converters.check.model_sheet import LABEL_PIXELS, PIXELS, camera_axes, model_picture, model_sheet
from converters.generate.models.parts import MATERIALS


def shown(picture: np.ndarray, material: str) -> np.ndarray:
    """(n, 2) rows and columns of a material's pixels, in whatever light."""
    colour = np.array(MATERIALS[material]) / max(MATERIALS[material])
    bright = picture.max(axis=2).astype(float)
    same = np.abs(picture - colour * bright[..., None]).max(axis=2) <= 2
    return np.argwhere(same & (bright < 250) & (bright > 20))


def test_the_reader_stands_before_right_of_and_above_the_model():
    axes = camera_axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert (axes[2] > 0).all() and axes[2, 2] > axes[2, 0] and axes[1, 1] > 0.9 and axes[0, 1] == 0


@pytest.mark.parametrize("name", ["bed_panel", "bed_divan"])  # the second is drawn with its front along -z
def test_a_beds_head_is_behind_its_cover_and_hides_nothing_of_it(name):
    picture = model_picture(name, 120)
    head, cover = ("oak", "denim") if name == "bed_panel" else ("grey", "cream")
    assert shown(picture, cover)[:, 0].mean() > shown(picture, "mattress")[:, 0].min()
    assert shown(picture, head)[:, 0].min() < shown(picture, cover)[:, 0].min()  # the head rises above it
    assert len(shown(picture, cover)) > 900
    used = np.argwhere((picture < 255).any(axis=2))
    assert (used.min(axis=0).min(), used.max(axis=0).max()) == (4, 115)  # it fills 94 % of the longer side


def test_nearer_parts_hide_those_behind_them():
    # A washer's black glass is before its drum's grey ring, and both before the body.
    picture = model_picture("washer_front", 150)
    glass, ring = shown(picture, "black"), shown(picture, "grey")
    rows, columns = glass[:, 0], glass[:, 1]
    middle = picture[int(np.median(rows)), int(np.median(columns))]
    assert len(glass) > 300 and len(ring) > 150 and middle.max() < 40


def test_a_sheet_holds_whole_categories_and_single_models(tmp_path, capsys):
    assert model_sheet(tmp_path / "sheet.png", ["tub", "bed_iron"]) == 5
    with Image.open(tmp_path / "sheet.png") as image:
        assert image.size == (5 * PIXELS, PIXELS + LABEL_PIXELS)
    assert main(["models", "stove", "-o", str(tmp_path / "stoves.png")]) == 0
    assert "stoves.png: picture of 4 models" in capsys.readouterr().out.replace("\n", "")


def test_a_wrong_name_is_one_line_and_nothing_is_written(tmp_path, capsys):
    assert main(["models", "throne", "-o", str(tmp_path / "sheet.png")]) == 2
    error = capsys.readouterr().err
    assert "no model or category named throne; categories: armchair, bag," in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
