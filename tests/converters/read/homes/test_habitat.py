"""A Habitat scene written here: frames, origins, scales and classes by hand; damaged ones in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from converters.__main__ import main
from converters.geometry.faces import face_areas, face_labels
from converters.read.homes.habitat import SCENE, read_habitat
from converters.read.source import detect_format, read_source
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR, WALL
from scenes_mjcf.schema import load_manifest

# Habitat's world: x right, y up, z towards the viewer; here (x, y, z) becomes (x, -z, y).
HALF = float(np.sqrt(0.5))
SCENE_OBJECTS: list[dict[str, Any]] = [
    # A chair modelled with z up, turned by a quarter about y; its own origin, at its base, is what is placed.
    {"template_name": "objects/frl_chair_01", "translation": [-1, 0, -0.5], "rotation": [HALF, 0, HALF, 0],
     "translation_origin": "asset_local", "motion_type": "DYNAMIC"},
    # A table that a hash names, static, placed by the middle of its box, twice as wide as modelled.
    {"template_name": "0f3a", "translation": [0.9, 0.35, 0.4], "non_uniform_scale": [2, 1, 1], "motion_type": "STATIC"},
    {"template_name": "picture", "translation": [0, 1.5, -1.4], "motion_type": "STATIC"},
]  # fmt: skip
DRESSER = """<robot name="dresser"><link name="body"><inertial><mass value="40"/></inertial><visual>
<origin xyz="0 0.8 0"/><geometry><box size="0.6 1.6 0.5"/></geometry></visual><collision><origin xyz="0 0.8 0"/>
<geometry><box size="0.6 1.6 0.5"/></geometry></collision></link><link name="leaf"><visual><geometry>
<box size="0.6 1.5 0.04"/></geometry></visual></link><joint name="hinge" type="revolute"><parent link="body"/>
<child link="leaf"/><origin xyz="0 0.8 0.27"/><axis xyz="0 1 0"/></joint></robot>"""


def write_home(root: Path, objects: list[dict[str, Any]]) -> Path:
    for folder in ("stages", "objects", "urdf/dresser", "configs/scenes"):
        (root / folder).mkdir(parents=True)
    box = trimesh.creation.box
    room = [box((4, 0.1, 3)), *(box((4, 2.4, 0.1)) for _ in "ns"), *(box((0.1, 2.4, 3)) for _ in "ew")]
    for part, at in zip(
        room, ((0, -0.05, 0), (0, 1.2, 1.55), (0, 1.2, -1.55), (2.05, 1.2, 0), (-2.05, 1.2, 0)), strict=True
    ):
        part.apply_translation(at)
    trimesh.util.concatenate(room).export(root / "stages" / "flat.glb")
    chair = trimesh.util.concatenate([box((0.4, 0.5, 0.4)), box((0.1, 0.5, 0.4))])
    chair.apply_translation((0, 0, 0.2))
    chair.export(root / "objects" / "chair.glb")
    box((0.5, 0.7, 0.6)).export(root / "objects" / "0f3a.glb")
    box((0.3, 0.3, 0.02)).export(root / "objects" / "picture.glb")
    (root / "urdf" / "dresser" / "dresser.urdf").write_text(DRESSER)
    dump = {
        "home.scene_dataset_config.json": {},
        "semantic_lexicon.json": {"classes": [{"id": 7, "name": "table"}, {"id": 9, "name": "picture"}]},
        "stages/flat.stage_config.json": {"render_asset": "flat.glb"},
        "objects/frl_chair_01.object_config.json": {
            "render_asset": "chair.glb", "up": [0, 0, 1], "front": [0, 1, 0], "mass": 6.5, "friction_coefficient": 0.4,
            "collision_asset": "chair.glb",
        },
        "objects/0f3a.object_config.json": {"render_asset": "0f3a.glb", "semantic_id": 7, "mass": 9000},
        f"configs/scenes/apt_0{SCENE}": {
            "stage_instance": {"template_name": "stages/flat"}, "default_lighting": "lights/x",
            "object_instances": objects,
            "articulated_object_instances": [
                {"template_name": "dresser", "translation": [-1.6, 0, 1.1], "fixed_base": True}
            ],
        },
    }  # fmt: skip
    for name, value in dump.items():
        (root / name).write_text(json.dumps(value))
    return root


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    return write_home(tmp_path_factory.mktemp("habitat") / "home", SCENE_OBJECTS)


def _bounds(raw, annotation):
    cad = raw.cads[annotation.cad_id]
    points = cad.vertices @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]
    return np.array([points.min(axis=0), points.max(axis=0)])


def test_where_things_stand_and_what_they_are(source):
    raw = read_habitat(source)
    assert detect_format(source) == "habitat"
    found = {a.category: a for a in raw.annotations}
    assert set(found) == {"chair", "table", "dresser"}
    # 0.4 wide, 0.5 deep and 0.4 high in its own frame; the quarter turn makes its depth lie along x.
    np.testing.assert_allclose(_bounds(raw, found["chair"]), [[-1.25, 0.3, 0], [-0.75, 0.7, 0.4]], atol=1e-6)
    np.testing.assert_allclose(_bounds(raw, found["table"]), [[0.4, -0.7, 0], [1.4, -0.1, 0.7]], atol=1e-6)
    np.testing.assert_allclose(_bounds(raw, found["dresser"]), [[-1.9, -1.39, 0], [-1.3, -0.85, 1.6]], atol=1e-6)
    chair = raw.cads[found["chair"].cad_id]
    assert chair.mass_kg == 6.5 and chair.friction == 0.4 and chair.pieces is not None
    assert raw.cads[found["table"].cad_id].mass_kg is None, "9 t are no table"
    assert raw.cads[found["dresser"].cad_id].mass_kg == 40.0
    told = "".join(raw.warnings)
    assert "1 x default_lighting" in told and "joint 'hinge' of 'leaf' stands" in told and "placeholder" in told


def test_keys_that_are_not_read_are_counted(tmp_path):
    odd = [{**SCENE_OBJECTS[0], "initial_joint_pose": [1], "mass_scale": 2}, {**SCENE_OBJECTS[0], "mass_scale": 3}]
    told = read_habitat(write_home(tmp_path / "home", odd)).warnings
    for count, key in ((2, "mass_scale"), (1, "initial_joint_pose")):
        assert f"apt_0{SCENE}: {count} x {key} (not read)" in told


def test_the_stage_is_floor_and_walls(source):
    raw = read_habitat(source)
    labels = face_labels(raw.scan.labels, raw.scan.faces)
    areas = face_areas(raw.scan.vertices, raw.scan.faces)
    assert raw.floor_height_m == pytest.approx(0.0, abs=0.02)
    assert areas[labels == FLOOR].sum() == pytest.approx(12.0, rel=0.1)
    assert areas[labels == WALL].sum() > 0.8 * 2 * (4 + 3) * 2.4


def test_one_scene_of_many_is_named_by_its_file_and_converts(source, tmp_path):
    scenes = source / "configs" / "scenes"
    one = scenes / f"apt_0{SCENE}"
    assert read_source(one).name == "apt_0"
    other = scenes / f"apt_1{SCENE}"
    other.write_text(one.read_text())
    try:
        with pytest.raises(SceneRejected, match="scenes are apt_0, apt_1, expected one; give the file of one"):
            read_habitat(source)
        assert main(["convert", str(one), str(tmp_path / "flat"), "structure_texture=64"]) == 0
    finally:
        other.unlink()
    manifest = load_manifest(tmp_path / "flat")
    assert sorted(o.category for o in manifest.objects) == ["chair", "dresser", "table"]
    assert manifest.source["format"] == "habitat"


_ANY = st.one_of(
    st.none(), st.booleans(), st.text(max_size=8), st.floats(), st.integers(), st.lists(st.floats(), max_size=5),
    st.just({}), st.just("../../etc/passwd"), st.just("/etc/passwd"),
)  # fmt: skip


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    where=st.sampled_from(["scene", "object", "instance"]),
    key=st.sampled_from(
        ["stage_instance", "object_instances", "template_name", "translation", "rotation", "non_uniform_scale", "mass",
         "uniform_scale", "render_asset", "collision_asset", "up", "front", "scale", "semantic_id",
         "motion_type", "COM"]
    ),
    value=_ANY,
)  # fmt: skip
def test_any_value_anywhere_is_read_or_refused(source, where, key, value):
    path = source / (f"configs/scenes/apt_0{SCENE}" if where != "object" else "objects/0f3a.object_config.json")
    before = path.read_text()
    table = json.loads(before)
    (table["object_instances"][1] if where == "instance" else table)[key] = value
    try:
        path.write_text(json.dumps(table))
        raw = read_habitat(source)
        assert np.isfinite(raw.scan.vertices).all() and len(raw.annotations) <= 3
        assert all(not name.startswith(("/", "..")) for name in raw.sources)
    except SceneRejected as refusal:
        assert "\n" not in str(refusal) and str(source) in str(refusal)
    finally:
        path.write_text(before)


@pytest.mark.parametrize(
    ("where", "key", "value", "message"),
    [
        ("objects/0f3a.object_config.json", "semantic_id", [1], r"semantic_id is \[1\], expected a whole number"),
        (f"configs/scenes/apt_0{SCENE}", "rotation", [10**400, 0, 0, 0], r"rotation\[0\] is 10+\.\.\., expected a"),
    ],
)
def test_what_numpy_or_a_table_cannot_take_is_told_with_its_key(source, where, key, value, message):
    before = (source / where).read_text()
    table = json.loads(before)
    (table["object_instances"][1] if "object_instances" in table else table)[key] = value
    (source / where).write_text(json.dumps(table))
    try:
        with pytest.raises(SceneRejected, match=message):
            read_habitat(source)
    finally:
        (source / where).write_text(before)


def test_what_lies_outside_of_the_folder_is_not_read(source, tmp_path):
    config = source / "objects" / "0f3a.object_config.json"
    before = config.read_text()
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "secret.glb")
    try:
        for name in (str(tmp_path / "secret.glb"), "../../secret.glb"):
            config.write_text(json.dumps({"render_asset": name}))
            with pytest.raises(SceneRejected, match="which is not in"):
                read_habitat(source)
    finally:
        config.write_text(before)


@pytest.mark.parametrize("cut", [0, 1, 40, 200])
def test_a_truncated_scene_is_one_line(source, cut):
    path = source / "configs" / "scenes" / f"apt_0{SCENE}"
    before = path.read_text()
    try:
        path.write_text(before[:cut])
        with pytest.raises(SceneRejected, match="not readable as JSON"):
            read_habitat(source)
    finally:
        path.write_text(before)
