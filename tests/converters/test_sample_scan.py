"""The licensed ScanNet room end to end; skipped with a reason where the data is absent."""

from __future__ import annotations

import time

import mujoco
import numpy as np
import pytest
import trimesh

from converters.check.gates import check_folder
from converters.pipeline import ConvertConfig, convert
from converters.propose.pieces import bounds, box_iou
from converters.propose.proposals import propose_instances
from converters.propose.retrieval import annotated_vertices
from converters.read.annotations import read_scan2cad
from scenes_mjcf.schema import load_maps
from tests.converters.structure.test_fill import hits

pytestmark = pytest.mark.data

LIMIT_S = 180.0


def escaping_share(folder, maps) -> float:
    """Share of downward rays from twenty free places, 0.6 m high, that pass the structure's picture."""
    structure = trimesh.load(folder / "assets" / "structure_visual.obj", process=False, force="mesh")
    rng = np.random.default_rng(0)
    cells = np.argwhere(maps.traversable)
    escaped = []
    for row, column in cells[rng.choice(len(cells), 20)]:
        x, y = np.array(maps.origin_w) + (np.array([column, row]) + 0.5) * maps.resolution_m
        yaw, pitch = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(-np.pi / 2, -0.05, 3000)
        ray = np.column_stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        eye = np.array([x, y, 0.6])
        escaped.append(hits(np.asarray(structure.vertices), np.asarray(structure.faces), eye, eye + ray) < 0)
    return float(np.mean(escaped))


@pytest.mark.heavy
def test_the_real_room_converts_and_its_seven_objects_stay_put(sample_data, tmp_path, hull_cache):
    config = ConvertConfig(format="scan2cad", structure_texture=512, object_texture=128)
    start = time.monotonic()
    out = tmp_path / "scenes" / "room"
    converted = convert(sample_data / "scan2cad_scene0470_00", out, config, cache=hull_cache)
    seconds = time.monotonic() - start
    assert seconds < LIMIT_S, f"took {seconds:.0f} s"
    manifest, gates = check_folder(out)
    assert {g.name for g in gates if not g.passed} == set()
    assert sorted(o.category for o in manifest.objects) == ["basket", *["chair"] * 5, "table"]
    for item in manifest.objects:
        low, high = {"chair": (4, 8), "table": (10, 40), "basket": (0.5, 2)}[item.category]
        assert low <= item.mass_kg <= high
    for row in manifest.alignment:
        # People clicked these keypoints on a reconstruction: residuals of centimetres, nothing gross.
        assert 0.01 < row["rms_m"] < 0.1
        assert row["translation_difference_m"] < 0.05 and row["yaw_difference_deg"] < 5.0
        assert all(0.8 < v < 1.2 for v in row["scale_ratio"])
        assert row["texture_seen_share"] > 0.5
        assert row["settle_shift_m"] < 0.2 and abs(row["settle_drop_m"]) < 0.1
    maps = load_maps(out)
    assert 6.5 < maps.traversable.sum() * maps.resolution_m**2 < 9.0  # of the room's 3.5 x 2.9 m
    assert escaping_share(out, maps) < 0.005
    assert converted.n_walls <= 64
    assert 0.03 < maps.floor_height_m < 0.1
    assert sum(p.stat().st_size for p in out.rglob("*") if p.is_file()) < 3 * 2**20
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    assert sum(int(n) for n in model.body_jntnum) == 7


@pytest.mark.parametrize("voxel_m", [0.03, 0.05, 0.08])
def test_chairs_that_touch_at_coarse_voxels_are_told_apart(sample_data, voxel_m):
    """From 0.05 m on two of the room's chairs are one component."""
    raw = read_scan2cad(sample_data / "scan2cad_scene0470_00")
    found = propose_instances(raw.scan, voxel_m)
    assert sorted(p.category for p in found) == ["basket", *["chair"] * 5, "door", "table"]
    boxes = [bounds(annotated_vertices(a, raw.cads)) for a in raw.annotations]
    assert sum(max(box_iou(box, bounds(p.points)) for p in found) > 0.4 for box in boxes) >= 6
