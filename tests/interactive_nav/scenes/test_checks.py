"""Absurd scenes are refused when they are loaded, each in one line that names what is wrong."""

from __future__ import annotations

import dataclasses
import json
import re
import warnings

import numpy as np
import pytest

from interactive_nav.scenes.scene import load_scene
from scenes_mjcf.schema import SceneError, load_maps, save_maps
from scenes_mjcf.sets import HERE
from tests.toys import write_room


def edit_xml(folder, pattern: str, new: str) -> None:
    path = folder / "scene.xml"
    text, count = re.subn(pattern, new, path.read_text(), count=1)
    assert count == 1
    path.write_text(text)


def edit_object(folder, **values) -> None:
    path = folder / "scene.json"
    manifest = json.loads(path.read_text())
    manifest["objects"][0] |= values
    path.write_text(json.dumps(manifest))


def move_map(folder, by_m: float) -> None:
    maps = load_maps(folder)
    save_maps(dataclasses.replace(maps, origin_w=(maps.origin_w[0] + by_m, maps.origin_w[1])), folder)


BODY = r'<body name="chair_0" pos="[^"]*"'
FAULTS = {
    "high up": (
        lambda f: edit_xml(f, BODY, '<body name="chair_0" pos="0.7 0 100"'),
        "chair_0 is at a height of 99.8 m",
    ),
    "below": (
        lambda f: edit_xml(f, BODY, '<body name="chair_0" pos="0.7 0 -3"'),
        "chair_0 is at a height of -3.2 m",
    ),
    "far away": (lambda f: edit_xml(f, BODY, '<body name="chair_0" pos="50 0 0.2"'), r"stands at \(50, 0\) m"),
    "map away": (lambda f: move_map(f, 1e6), "free floor of maps.npz reaches from"),
    "friction": (lambda f: edit_object(f, friction=1e18), "friction is 1e.18, expected 0.001 to 10"),
    "mass differs": (lambda f: edit_object(f, mass_kg=100.0), "mass_kg is 5 in scene.xml, 100 in scene.json"),
    "friction differs": (lambda f: edit_object(f, friction=0.7), "friction is 0.5 in scene.xml, 0.7 in scene.json"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_absurd_scene_is_refused(tmp_path, fault):
    folder = write_room(tmp_path / "room")
    load_scene(folder)
    change, message = FAULTS[fault]
    change(folder)
    with pytest.raises(SceneError, match=message) as refusal:
        load_scene(folder)
    assert "convert the scene again" in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("mass_kg", [1e-9, 1e5])
def test_an_absurd_mass_in_both_files_is_refused(tmp_path, mass_kg):
    folder = write_room(tmp_path / "room", blocks=(("chair", 0.7, 0.0, mass_kg, 0.5),))
    with pytest.raises(SceneError, match=re.escape(f"mass_kg is {mass_kg:g}, expected 0.001 to 10000")):
        load_scene(folder)


def test_a_position_that_is_not_a_number_is_refused(tmp_path):
    folder = write_room(tmp_path / "room")
    edit_xml(folder, BODY, '<body name="chair_0" pos="nan 0 0.2"')
    with pytest.raises(SceneError, match="not finite|not readable as MJCF"):
        load_scene(folder)


def test_a_home_without_walls_is_refused(tmp_path):
    folder = write_room(tmp_path / "room")
    text = (folder / "scene.xml").read_text()
    (folder / "scene.xml").write_text(re.sub(r'\s*<geom name="wall_[^>]*/>', "", text))
    with pytest.raises(SceneError, match="has no wall"):
        load_scene(folder)


def test_loading_warns_where_most_furniture_is_out_of_reach(tmp_path):
    """By the gate of the converter: one that passed, or that is not there, warns of nothing."""
    folder = write_room(tmp_path / "room")
    for passed, warned in ((False, 1), (True, 0), (None, 0)):
        text = json.loads((folder / "scene.json").read_text())
        gate = {"passed": passed, "value": 0.6, "limit": 0.5, "unit": "share"}
        text["gates"] = {} if passed is None else {"furniture_apart": gate}
        (folder / "scene.json").write_text(json.dumps(text))
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            load_scene(folder)
        said = [str(each.message) for each in heard if "stand on floor that no robot can reach" in str(each.message)]
        assert len(said) == warned


@pytest.mark.parametrize("name", sorted(p.parent.name for p in HERE.glob("*/scene.json")))
def test_packaged_scenes_load_without_a_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(HERE / name)
    assert np.isfinite(scene.walls).all()
