"""Sources far from the origin become the same scenes as near ones, and files keep the digits of long homes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from converters.geometry.boxes import OrientedBox
from converters.pipeline import ConvertConfig, convert
from converters.read.annotations import read_scan2cad
from converters.records.raw import at_origin
from converters.write.emit import SceneParts, write_scene
from interactive_nav.scenes.scene import load_scene
from scenes_mjcf.schema import load_maps
from tests.converters.test_same_room import room

UTM_M = np.array([448_262.02, 5_411_932.02, 0.0])


def write_room(path: Path, low_m: np.ndarray) -> Path:
    """The room of 4 x 3 m as OBJ with all digits, its corner at a place."""
    mesh = room()
    vertices = mesh.vertices - mesh.vertices.min(axis=0) + low_m
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_georeferenced_scan_gives_the_scene_of_the_same_scan_at_the_origin(tmp_path):
    config = ConvertConfig(up="z", structure_texture=64)
    far = convert(write_room(tmp_path / "far.obj", UTM_M), tmp_path / "far", config)
    # Its middle, (448264.02, 5411933.52), is moved by whole metres to (0.02, -0.48).
    near = convert(write_room(tmp_path / "near.obj", np.array([-1.98, -1.98, 0.0])), tmp_path / "near", config)
    message = "moved by (-448264, -5411934) m to the origin; add (448264, 5411934) m to return to the source's frame"
    assert message in far.manifest.warnings and not any("moved by" in w for w in near.manifest.warnings)
    ours, theirs = load_maps(tmp_path / "far"), load_maps(tmp_path / "near")
    np.testing.assert_array_equal(ours.traversable, theirs.traversable)
    np.testing.assert_allclose(ours.origin_w, theirs.origin_w, atol=1e-6)
    np.testing.assert_allclose(load_scene(tmp_path / "far").walls, load_scene(tmp_path / "near").walls, atol=1e-6)


def test_everything_of_a_source_moves_together(scan2cad_raw):
    raw = read_scan2cad(scan2cad_raw)
    assert at_origin(raw) is raw  # within 100 m
    by = np.array([5000.0, -300.0, 0.0])
    pose = np.eye(4)
    pose[:3, 3] = by
    far = dataclasses.replace(
        raw,
        scan=dataclasses.replace(raw.scan, vertices=raw.scan.vertices + by),
        annotations=tuple(
            dataclasses.replace(a, pose=pose @ a.pose, keypoints_scan=a.keypoints_scan + by) for a in raw.annotations
        ),
    )
    back = at_origin(far)
    shift = back.scan.vertices[0] - raw.scan.vertices[0]
    np.testing.assert_allclose(shift, np.round(shift), atol=1e-9)
    low, high = (getattr(back.scan.vertices[:, :2], name)(axis=0) for name in ("min", "max"))
    assert np.abs(low + high).max() / 2 <= 0.5 + 1e-9
    for ours, theirs in zip(back.annotations, raw.annotations, strict=True):
        np.testing.assert_allclose(ours.pose[:3, 3] - theirs.pose[:3, 3], shift, atol=1e-9)
        np.testing.assert_allclose(ours.keypoints_scan, theirs.keypoints_scan + shift, atol=1e-9)


@pytest.mark.parametrize("at_m", [0.123456, 12.345678, 98.765432])
def test_walls_are_written_with_all_their_digits(tmp_path, at_m):
    """MuJoCo writes six digits: 12.3457 for 12.345678."""
    wall = OrientedBox(np.array([at_m, 0.0, 1.0]), np.eye(3), np.array([0.1, 31.234567, 1.0]))
    (tmp_path / "scene").mkdir()
    write_scene(SceneParts("scene", (), (), (wall,)), tmp_path / "scene")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / "scene.xml"))
    geom = model.geom("wall_0")
    np.testing.assert_allclose(geom.pos, [at_m, 0, 1], atol=1e-9)
    np.testing.assert_allclose(geom.size, [0.1, 31.234567, 1.0], atol=1e-9)
