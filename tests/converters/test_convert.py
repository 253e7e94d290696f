"""The whole converter on the tiny room: what it writes, that it writes it twice alike, and how it stops."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.__main__ import main
from converters.check.gates import LIMITS, Limit
from converters.check.settle import push_apart, settle
from converters.clock import STAGES
from converters.geometry.boxes import OrientedBox
from converters.pipeline import ConvertConfig, convert
from converters.read.files import read_obj
from converters.read.homes.parts import built_in
from converters.read.source import read_source
from converters.records.errors import SceneRejected
from converters.structure.clean import LIFT_M
from interactive_nav_common.errors import FileError
from interactive_nav_common.files import remove_stale
from interactive_nav_common.rotations import matrix_from_quat
from scenes_mjcf.schema import load_manifest, load_maps
from tests.converters import tiny_raw

SMALL = ConvertConfig(structure_texture=128, object_texture=32)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_names_classes_and_joints_are_as_promised(tiny_scene):
    folder, _ = tiny_scene
    manifest = load_manifest(folder)
    assert [o.name for o in manifest.objects] == ["table_0", "basket_0"]
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    assert spec.meshdir == spec.texturedir == "assets"
    model = spec.compile()
    assert model.opt.timestep == 0.005 and model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for item in manifest.objects:
        assert model.joint(f"{item.name}_free").type[0] == mujoco.mjtJoint.mjJNT_FREE
        assert model.body_mass[model.body(item.name).id] == pytest.approx(item.mass_kg, abs=1e-4)
        visual = model.geom(f"{item.name}_visual")
        assert (visual.contype[0], visual.conaffinity[0], visual.group[0]) == (0, 0, 2)
        for i in range(item.n_hulls):
            hull, box = model.geom(f"{item.name}_hull_{i}"), model.geom(f"{item.name}_box_{i}")
            assert (hull.contype[0], hull.group[0]) == (1, 3) and (box.contype[0], box.group[0]) == (0, 4)
            assert hull.friction[0] == box.friction[0] == pytest.approx(item.friction)
    assert model.geom("floor").type[0] == mujoco.mjtGeom.mjGEOM_PLANE
    assert model.geom("structure_visual").group[0] == 2
    wall = model.geom("wall_0")
    assert (wall.contype[0], wall.group[0]) == (1, 3)
    assert "/" not in manifest.name and str(Path.home()) not in (folder / "scene.xml").read_text()


def test_the_model_names_each_bodys_semantic_class(tiny_scene):
    spec = mujoco.MjSpec.from_file(str(tiny_scene[0] / "scene.xml"))
    assert {t.name: t.data for t in spec.texts} == {
        "class_structure": "structure",
        "class_table_0": "table",
        "class_basket_0": "basket",
    }


def test_objects_stand_where_they_were_annotated(tiny_scene):
    folder, converted = tiny_scene
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    for name, item in zip(("table_0", "basket_0"), tiny_raw.ITEMS, strict=True):
        body = model.body(name)
        np.testing.assert_allclose(body.pos[:2], item.position[:2], atol=0.01)
        assert abs(body.pos[2]) < 0.005
        forward = matrix_from_quat(body.quat) @ [1, 0, 0]
        np.testing.assert_allclose(forward, (np.cos(item.yaw), np.sin(item.yaw), 0), atol=0.02)
    assert max(converted.settled.displacement_m) < 0.01
    for row in converted.manifest.alignment:
        assert row["rms_m"] < 1e-4 and row["yaw_difference_deg"] < 0.01
        assert row["texture_seen_share"] > 0.7


def test_masses_follow_density_times_volume(tiny_scene):
    table, basket = load_manifest(tiny_scene[0]).objects
    assert 10.0 <= table.mass_kg <= 40.0
    assert basket.mass_kg == 2.0  # 0.036 m3 solid: clipped to what a basket weighs


def test_the_map_and_the_scans_floor_height(tiny_scene):
    maps = load_maps(tiny_scene[0])
    assert maps.floor_height_m == tiny_raw.FLOOR_M and maps.resolution_m == 0.05
    area = maps.traversable.sum() * 0.05**2
    assert 2.85 * 2.35 <= area <= 3.0 * 2.5  # furniture is no part of the static map
    row, column = np.argwhere(maps.traversable).min(axis=0)
    assert maps.origin_w[0] + column * 0.05 == pytest.approx(0.05, abs=0.051)
    assert maps.origin_w[1] + row * 0.05 == pytest.approx(0.05, abs=0.051)


def test_the_objects_take_the_scans_colours(tiny_scene):
    image = np.asarray(Image.open(tiny_scene[0] / "assets" / "table_0.png").convert("RGB")).reshape(-1, 3)
    np.testing.assert_allclose(np.median(image, axis=0), tiny_raw.COLOURS[7], atol=3)


def test_a_movable_can_be_attached_to_another_scene(tiny_scene):
    folder, _ = tiny_scene
    source = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    target = mujoco.MjSpec()
    target.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
    target.worldbody.add_frame(pos=[5, 0, 0]).attach_body(source.body("table_0"), "a_", "")
    model = target.compile()
    assert model.body("a_table_0").mass[0] == pytest.approx(load_manifest(folder).objects[0].mass_kg, abs=1e-4)


def test_same_inputs_same_bytes_with_and_without_the_cache(tiny_scene, pristine, tmp_path):
    folder, _ = tiny_scene
    convert(pristine / "gibson", tmp_path / "tiny", SMALL, cache=tmp_path / "empty-cache")
    assert contents(tmp_path / "tiny") == contents(folder)


def test_scan2cad_layout_gives_the_same_scene(tiny_scene, pristine, tmp_path, hull_cache):
    folder, _ = tiny_scene
    convert(pristine / "scan2cad", tmp_path / "tiny", SMALL, cache=hull_cache)
    one = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    other = mujoco.MjModel.from_xml_path(str(tmp_path / "tiny" / "scene.xml"))
    np.testing.assert_allclose(other.body_pos, one.body_pos, atol=1e-3)
    np.testing.assert_array_equal(load_maps(tmp_path / "tiny").traversable, load_maps(folder).traversable)


def test_progress_runs_through_every_stage_up_to_one(pristine, tmp_path, hull_cache):
    calls: list[tuple[str, float]] = []
    convert(pristine / "gibson", tmp_path / "out", SMALL, lambda *call: calls.append(call), hull_cache)
    shares = [share for _, share in calls]
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1.0)
    assert list(dict.fromkeys(stage for stage, _ in calls)) == list(STAGES)


def test_an_existing_folder_is_kept_unless_told(pristine, tmp_path, hull_cache):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    with pytest.raises(FileError, match="exists already; give another place or add --overwrite"):
        convert(pristine / "gibson", out, SMALL, cache=hull_cache)
    assert contents(out) == {"mine.txt": b"keep"}
    convert(pristine / "gibson", out, dataclasses.replace(SMALL, overwrite=True), cache=hull_cache)
    assert "mine.txt" not in contents(out) and (out / "scene.xml").is_file()


def test_a_failure_half_way_leaves_nothing_and_keeps_the_old_scene(gibson_raw, tmp_path, hull_cache):
    vertices, _, labels = tiny_raw.scan()
    np.savez(gibson_raw / "mesh_z_up.labels.npz", label=np.where(labels == 2, 1, labels).astype(np.uint8))
    out = tmp_path / "scenes" / "out"
    out.mkdir(parents=True)
    (out / "old.txt").write_text("old")
    with pytest.raises(SceneRejected, match="no traversable floor"):
        convert(gibson_raw, out, dataclasses.replace(SMALL, overwrite=True), cache=hull_cache)
    assert [p.name for p in out.parent.iterdir()] == ["out"] and contents(out) == {"old.txt": b"old"}


def test_auto_align_adds_the_object_that_nobody_annotated(gibson_raw, tmp_path, hull_cache):
    data = tiny_raw.annotation()
    data[0]["aligned_models"] = data[0]["aligned_models"][:1]
    (gibson_raw / "alignments.json").write_text(json.dumps(data))
    config = dataclasses.replace(SMALL, auto_align=True)
    done = convert(gibson_raw, tmp_path / "out", config, cache=hull_cache)
    assert [o.name for o in done.manifest.objects] == ["table_0", "basket_0"]
    rows = {r["name"]: r for r in done.manifest.alignment}
    assert "retrieved_confidence" not in rows["table_0"] and rows["basket_0"]["retrieved_confidence"] > 0.5
    basket = next(o for o in done.settled.parts.objects if o.name == "basket_0")
    np.testing.assert_allclose(basket.position_w[:2], tiny_raw.ITEMS[1].position[:2], atol=0.03)
    assert all(g.passed for g in done.gates)


def test_convert_exits_one_when_a_gate_fails_and_keeps_the_scene(pristine, tmp_path, hull_cache, monkeypatch, capsys):
    monkeypatch.setitem(LIMITS, "walls", Limit("count", most=0))
    monkeypatch.setattr("converters.check.gates.free_space_warnings", lambda maps: ("a room is cut off",))
    monkeypatch.setattr("converters.pipeline.cache_folder", lambda: hull_cache)
    words = ["structure_texture=128", "object_texture=32"]
    assert main(["convert", str(pristine / "gibson"), str(tmp_path / "out"), *words]) == 1
    printed = capsys.readouterr().out
    assert "gates that fail: walls" in printed and "warning: a room is cut off" in printed
    assert load_manifest(tmp_path / "out").gates["walls"]["passed"] is False
    assert load_manifest(tmp_path / "out").warnings == ("a room is cut off",)


def test_settling_parts_two_objects_that_overlap(tiny_scene):
    parts = tiny_scene[1].settled.parts
    table, basket = parts.objects
    inside = dataclasses.replace(basket, position_w=table.position_w + [0.25, 0.45, 0.02])  # at the table's leg
    settled = settle(dataclasses.replace(parts, objects=(table, inside)))
    assert max(settled.displacement_m) < 0.4
    heights = [o.position_w[2] for o in settled.parts.objects]
    np.testing.assert_allclose(heights, 0.0, atol=0.005)


def test_a_fitted_model_that_does_not_part_is_held_and_an_annotated_one_is_not(tiny_scene):
    parts = tiny_scene[1].settled.parts
    basket = parts.objects[1]  # 0.3 m wide, in a gap of 0.2 m
    walls = tuple(
        OrientedBox(np.array([basket.position_w[0] + x, basket.position_w[1], 0.5]), np.eye(3), np.array([0.1, 2, 0.5]))
        for x in (-0.2, 0.2)
    )
    squeezed = dataclasses.replace(parts, objects=(basket,), physical=parts.physical[1:], walls=walls)
    settled = settle(squeezed, fitted=(0,))
    assert settled.held == {0: "structure"} and settled.displacement_m == (0.0,)
    assert push_apart(squeezed)[1] == {}
    open_side = settle(dataclasses.replace(squeezed, walls=walls[:1]), fitted=(0,))
    # The wall's face is 0.1 m from the basket's middle, and it was 0.05 m in it.
    assert not open_side.held and open_side.displacement_m[0] == pytest.approx(0.05, abs=0.005)


def test_a_scan_without_a_fitted_model_says_so(gibson_raw):
    raw = read_source(gibson_raw)
    rest = built_in(raw, {1: "a wall, or what is built in"})
    assert rest.annotations == raw.annotations[:1] and set(rest.cads) == {"table-a"}
    assert rest.warnings[-1] == "basket-a cannot be parted from a wall, or what is built in, and is built in"


def test_commands_and_their_exit_codes(tiny_scene, tmp_path, capsys):
    folder, _ = tiny_scene
    assert main(["check", str(folder)]) == 0
    printed = capsys.readouterr().out
    # All gates but that of fronts: nothing there opens.
    assert printed.count("PASS") == len(LIMITS) - 1 and "FAIL" not in printed and "drift_hulls" in printed
    assert main(["preview", str(folder), "-o", str(tmp_path / "p.png")]) == 0
    assert min(Image.open(tmp_path / "p.png").size) > 300
    capsys.readouterr()
    for arguments in (
        ["check", str(tmp_path / "absent")],
        ["convert", str(tmp_path / "absent"), str(tmp_path / "o")],
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert len(error) == 1 and error[0].startswith("error: ") and "absent" in error[0]
    assert not (tmp_path / "o").exists()


def test_check_exits_one_when_a_gate_fails(tiny_scene, tmp_path, capsys):
    folder = Path(shutil.copytree(tiny_scene[0], tmp_path / "scene"))
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    spec.body("basket_0").pos = np.array([2.4, 0.6, 0.2])
    (folder / "scene.xml").write_text(spec.to_xml())
    assert main(["check", str(folder)]) == 1
    assert "FAIL  drift_hulls" in capsys.readouterr().out


def _start_conversion(source: Path, out: Path, cache: Path) -> subprocess.Popen[str]:
    """Runs `convert` in a process of its own; returns once it is at work."""
    process = subprocess.Popen(
        [sys.executable, "-m", "converters", "convert", str(source), str(out)],
        env=os.environ | {"INTERACTIVE_NAV_CACHE": str(cache), "PYTHONUNBUFFERED": "1"},
        cwd=Path(__file__).parents[2],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while not (out.parent.is_dir() and list(out.parent.iterdir())) and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.5)  # inside the decomposition
    return process


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interruption_leaves_nothing(pristine, tmp_path, sent, code):
    out = tmp_path / "scenes" / "out"
    process = _start_conversion(pristine / "gibson", out, tmp_path / "cache")
    process.send_signal(sent)
    _, error = process.communicate(timeout=30)
    assert process.returncode == code
    assert "nothing was written" in error and "Traceback" not in error
    assert list(out.parent.iterdir()) == []


def test_the_next_conversion_clears_what_a_killed_one_left_and_not_what_runs(pristine, tmp_path, hull_cache):
    out = tmp_path / "scenes" / "out"
    process = _start_conversion(pristine / "gibson", out, tmp_path / "cache")
    (running,) = out.parent.iterdir()
    os.utime(running, (0, 0))
    remove_stale(out)
    assert running.is_dir()  # its lock is held
    process.kill()
    process.communicate(timeout=30)
    assert running.is_dir()
    other = out.parent / ".output.part-1"
    other.mkdir()
    older = out.parent / ".out.old-77"
    older.mkdir()
    (older / "scene.json").write_text("kept")
    os.utime(running, (0, 0))
    # Killed while it replaced a scene: that one is there again, and is not overwritten unasked.
    with pytest.raises(FileError, match="exists already"):
        convert(pristine / "gibson", out, SMALL, cache=hull_cache)
    assert (out / "scene.json").read_text() == "kept"
    assert sorted(p.name for p in out.parent.iterdir()) == [".output.part-1", "out"]  # another scene's stays


def test_a_small_whole_scan_is_drawn_as_it_is(tmp_path, hull_cache):
    """Own vertices, 4 mm above the plane that collides, texture coordinates and image, to the bit."""
    room = trimesh.creation.box((4.0, 3.0, 2.5)).apply_translation((2.0, 1.5, 1.25))
    room.invert()
    colours = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    uv = np.round(np.random.default_rng(1).random((len(room.vertices), 2)), 4)
    room.visual = trimesh.visual.TextureVisuals(uv, image=Image.fromarray(colours))
    (tmp_path / "raw").mkdir()
    room.export(tmp_path / "raw" / "room.obj")
    upright = dataclasses.replace(SMALL, up="z")
    convert(tmp_path / "raw" / "room.obj", tmp_path / "room", upright, None, hull_cache)
    mesh = read_obj(tmp_path / "room" / "assets" / "structure_visual.obj")
    vertices, faces, corner_uv = mesh.vertices, mesh.faces, mesh.corner_uv
    assert (np.asarray(Image.open(tmp_path / "room" / "assets" / "structure.png").convert("RGB")) == colours).all()
    assert corner_uv is not None and len(faces) == 12
    # Its image holds the light of the place: the scene adds an even one, that a ceiling gets as a floor does.
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "room" / "scene.xml"))
    even = model.light_ambient[0, 0] + model.vis.headlight.ambient[0]
    assert even == pytest.approx(0.75) and model.light_diffuse[0, 0] + model.vis.headlight.diffuse[0] <= 0.41
    middle, given = vertices[faces].mean(axis=1).round(4), (room.triangles.mean(axis=1) + [0, 0, LIFT_M]).round(4)
    assert np.allclose(middle[np.lexsort(middle.T)], given[np.lexsort(given.T)], atol=1e-4)
    assert np.allclose(np.unique(corner_uv.reshape(-1, 2), axis=0), np.unique(uv, axis=0), atol=1e-4)
