"""Previews: the floor, objects and labels that a picture shows, and scenes that are damaged."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from converters.__main__ import main
from converters.check.preview import apart, preview
from scenes_mjcf.categories import CATEGORIES, OBJECT_CATEGORIES


def colours(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_the_traversable_area_is_drawn_in_a_colour_of_its_own(tiny_scene, tmp_path):
    made = tmp_path / "made" / "on the way"
    assert main(["preview", str(tiny_scene[0]), "-o", str(made / "p.png")]) == 0
    near = np.abs(colours(made / "p.png").astype(int) - [217, 240, 217]).max(axis=2) <= 6  # 0.85 0.94 0.85
    assert 0.03 < near.mean() < 0.8
    assert [p.name for p in made.iterdir()] == ["p.png"]


@pytest.fixture
def scene(tiny_scene, tmp_path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(tiny_scene[0], tmp_path / "scene"))


def change(folder: Path, **values: str) -> None:
    data = json.loads((folder / "scene.json").read_text())
    data["objects"][1] |= values
    (folder / "scene.json").write_text(json.dumps(data))


def test_every_category_has_a_colour_of_its_own_and_is_drawn(scene):
    assert len({CATEGORIES[name].preview_colour for name in OBJECT_CATEGORIES}) == len(OBJECT_CATEGORIES)
    change(scene, category="shoe")
    preview(scene, scene / "p.png")
    shoe = np.rint(255 * np.array(CATEGORIES["shoe"].preview_colour))
    assert (np.abs(colours(scene / "p.png") - shoe).max(axis=2) <= 4).sum() > 50  # the legend's patch and the object


def test_the_view_from_the_side_shows_furniture_in_its_own_colours(scene):
    """A magenta basket is seen in the uppermost picture, and nothing of it in the others' place."""
    preview(scene, scene / "before.png")
    texture = scene / "assets" / "basket_0.png"
    with Image.open(texture) as image:
        Image.new("RGB", image.size, (255, 0, 255)).save(texture)
    preview(scene, scene / "after.png")
    before, after = (colours(scene / f"{name}.png").astype(int) for name in ("before", "after"))
    magenta = [(p[..., 0] > 90) & (p[..., 2] > 90) & (p[..., 1] < 40) for p in (before, after)]
    rows = np.flatnonzero(magenta[1].sum(1) > magenta[0].sum(1))
    assert magenta[1].sum() > magenta[0].sum() + 15 and rows.max() < 0.6 * len(after)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: change(f, name="basket_7"), "no body named 'basket_7', which scene.json lists"),
        (lambda f: (f / "maps.npz").write_bytes((f / "maps.npz").read_bytes()[:-30]), "maps.npz: not readable"),
        (lambda f: (f / "assets" / "basket_0_visual.obj").unlink(), "does not compile (Error: Error opening file"),
    ],
)
def test_a_damaged_scene_is_one_line_and_an_older_picture_stays(scene, capsys, damage, words):
    (scene / "p.png").write_text("older")
    damage(scene)
    assert main(["preview", str(scene), "-o", str(scene / "p.png")]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert (scene / "p.png").read_text() == "older" and not list(scene.glob(".*"))


def test_labels_move_apart_as_little_as_it_takes():
    """By hand: 2 wide, 1 high. The second lies on the first, the third beside them, the fourth on the first two."""
    centres = np.array([[0.0, 0.0], [1.0, 0.4], [5.0, 0.0], [0.5, 0.6], [0.0, 9.0]])
    placed = apart(centres, np.tile([2.0, 1.0], (5, 1)))
    np.testing.assert_allclose(placed, [[0.0, 0.0], [1.0, 1.0], [5.0, 0.0], [0.5, 2.0], [0.0, 9.0]])
    assert apart(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0, 2)
