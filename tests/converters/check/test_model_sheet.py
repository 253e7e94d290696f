"""The sheet of CAD models: what a picture shows, which models are on it, and names that are none."""

from __future__ import annotations

import numpy as np
from PIL import Image

from converters.__main__ import main
from converters.check.pictures import COLUMNS, LABEL_PIXELS, PIXELS, camera_axes, model_picture, model_sheet
from converters.generate.models.cad import cad_model
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


def test_a_model_with_a_texture_is_drawn_in_its_colours():
    surface = cad_model("Scopia/chair").surface
    assert surface is not None
    picture = model_picture("Scopia/chair", 120)
    used = np.argwhere((picture < 255).any(axis=2))
    assert (used.min(axis=0).min(), used.max(axis=0).max()) == (4, 115)  # it fills 94 % of the longer side
    shade = picture[tuple(used.T)].max(axis=0)
    assert (shade <= surface.image.reshape(-1, 3).max(axis=0)).all() and len(used) > 2000


def test_nearer_parts_hide_those_behind_them():
    # A stove's black glass door is before its body.
    picture = model_picture("stove_range", 150)
    assert len(shown(picture, "black")) > 200


def test_a_sheet_holds_whole_categories_and_single_models(tmp_path, capsys):
    assert model_sheet(tmp_path / "sheet.png", ["shoe_rack", "fridge_american"]) == 4 * 6 + 1  # racks in six tints
    with Image.open(tmp_path / "sheet.png") as image:
        assert image.size == (COLUMNS * PIXELS, 4 * (PIXELS + LABEL_PIXELS))
    assert main(["models", "cart", "-o", str(tmp_path / "carts.png")]) == 0
    assert "carts.png: picture of 24 models" in capsys.readouterr().out.replace("\n", "")


def test_a_wrong_name_is_one_line_and_nothing_is_written(tmp_path, capsys):
    assert main(["models", "throne", "-o", str(tmp_path / "sheet.png")]) == 2
    error = capsys.readouterr().err
    assert "no model or category named throne; categories: armchair, bag," in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
