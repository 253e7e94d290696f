"""Previews: the converted side alone, and beside the raw scan; a source of another scene is refused."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from converters.__main__ import main
from converters.check.preview import apart, preview, read_source
from converters.read.source import read_source as read_mesh_or_home
from scenes_mjcf.categories import CATEGORIES, OBJECT_CATEGORIES
from scenes_mjcf.schema import SceneError, load_manifest


def colours(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


@pytest.mark.heavy
def test_a_source_adds_scan_and_cut(tiny_scene, pristine, tmp_path):
    folder, made = tiny_scene[0], tmp_path / "made" / "on the way"
    preview(folder, made / "four.png")
    assert main(["preview", str(folder), "-o", str(made / "six.png"), "--source", str(pristine / "gibson")]) == 0
    four, six = colours(made / "four.png"), colours(made / "six.png")
    assert six.shape[0] > 1.2 * four.shape[0] and six.shape[1] == four.shape[1]  # three panels more, in a row
    for picture in (four, six):
        # The traversable area is drawn in its own colour, 0.85 0.94 0.85.
        near = np.abs(picture.astype(int) - [217, 240, 217]).max(axis=2) <= 6
        assert 0.03 < near.mean() < 0.8
    assert sorted(p.name for p in made.iterdir()) == ["four.png", "six.png"]


def test_the_source_of_another_scene_is_refused(tiny_scene, gibson_raw, tmp_path):
    path = gibson_raw / "floors.txt"
    path.write_text(path.read_text() + "\n")
    with pytest.raises(SceneError, match=r"floors.txt differs.; give its --source"):
        preview(tiny_scene[0], tmp_path / "p.png", gibson_raw)
    shutil.rmtree(gibson_raw)
    assert main(["preview", str(tiny_scene[0]), "-o", str(tmp_path / "p.png"), "--source", str(gibson_raw)]) == 2
    assert not (tmp_path / "p.png").exists()


def test_the_source_may_be_a_file_as_convert_takes_one(tiny_scene, scan2cad_raw, tmp_path):
    path = tmp_path / "room.ply"
    shutil.copy(scan2cad_raw / "scan" / "scene_tiny_vh_clean_2.ply", path)
    made = read_mesh_or_home(path)
    manifest = dataclasses.replace(load_manifest(tiny_scene[0]), source={"sha256": made.sources})
    raw = read_source(path, manifest, 0.0)
    assert raw.source_format == "mesh" and len(raw.scan.vertices) == len(made.scan.vertices)


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
