"""Gates on the share of a scan that is kept and on floor that is not the home's; pillars are no floor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.check.gates import check_folder, judge, kept_share
from converters.read.source import read_source
from converters.structure.maps import make_floor_plan
from scenes_mjcf.schema import load_maps, save_maps
from tests.toys import write_room


def test_the_kept_share_is_that_of_the_area():
    """The drawing lacks a wall of 4 x 2 m beside a floor of 4 x 3 m: 12 of 20 m2 are kept."""
    floor = np.array([(0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0)], float)
    wall = np.array([(0, 0, 0.5), (4, 0, 0.5), (4, 0, 2.5), (0, 0, 2.5)], float)
    square = np.array([(0, 1, 2), (0, 2, 3)])
    share = kept_share(np.vstack([floor, wall]), np.vstack([square, square + 4]), (floor + [0, 0, 0.1], square))
    assert share == pytest.approx(12 / 20, abs=0.01)
    assert kept_share(floor, square, (floor, square)) == pytest.approx(1.0)


def test_the_gates_fail_where_they_should():
    assert not judge("scan_kept", 0.9).passed and judge("scan_kept", 0.99).passed
    assert not judge("floor_open", 0.6).passed and judge("floor_open", 0.1).passed


def test_furniture_apart_from_the_largest_floor_fails_its_gate(tmp_path):
    blocks = tuple(("chair", x, y, 5.0, 0.5) for x, y in ((-2.2, 0.0), (2.0, -1.0), (2.0, 1.0)))
    folder = write_room(tmp_path / "room", size_m=(6.0, 3.0), blocks=blocks)
    gate = {g.name: g for g in check_folder(folder)[1]}["furniture_apart"]
    assert gate.passed and gate.value == 0.0
    maps = load_maps(folder)
    free = maps.traversable.copy()
    free[:, 66:70] = False
    save_maps(type(maps)(free, maps.resolution_m, maps.origin_w, 0.0), folder)
    gate = {g.name: g for g in check_folder(folder)[1]}["furniture_apart"]
    assert not gate.passed and gate.value == pytest.approx(2 / 3) and "2 of 3 movable objects" in gate.warnings[0]


def write_layout(root: Path, pillar_m: float, inwards: bool) -> Path:
    """A room of 6 x 5 x 2.6 m in the released layout, whose map has the inside of a closed pillar as free."""
    root.mkdir()
    room = trimesh.creation.box((6, 5, 2.6)).apply_translation((3, 2.5, 1.3))
    room.invert()
    pillar = trimesh.creation.box((pillar_m, pillar_m, 2.6)).apply_translation((3, 2.5, 1.3))
    if inwards:
        pillar.invert()
    whole = trimesh.util.concatenate([room, pillar])
    vertices, faces = trimesh.remesh.subdivide_to_size(  # pyright: ignore[reportAssignmentType]
        whole.vertices, whole.faces, 0.1
    )
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (root / "mesh_z_up_cleaned.obj").write_text("\n".join(lines) + "\n")
    (root / "floors.txt").write_text("0.0\n")
    free = np.zeros((1200, 1200), np.uint8)
    free[600:1100, 600:1200] = 255
    Image.fromarray(free).save(root / "floor_trav_0.png")
    return root


@pytest.mark.parametrize(("pillar_m", "inwards"), [(0.6, True), (0.9, False), (0.9, True), (1.2, True), (2.0, False)])
def test_the_inside_of_a_pillar_is_no_floor_in_the_released_layout(tmp_path, pillar_m, inwards):
    raw = read_source(write_layout(tmp_path / "home", pillar_m, inwards), "interactive-gibson")
    vertices_w = raw.scan.vertices - [0, 0, raw.floor_height_m]
    plan = make_floor_plan(vertices_w, raw.scan.faces, raw.scan.labels, (), raw.given_map, 0.0)
    rows, columns, _ = plan.grid.cells(np.array([[3.0, 2.5, 0.0], [1.0, 1.0, 0.0]]))
    assert plan.traversable[rows, columns].tolist() == [False, True]
    # 6 x 5 m less the pillar; walls and pillar take a cell or two on each side.
    assert 5.9 * 4.9 - (pillar_m + 0.15) ** 2 <= plan.traversable.sum() * 0.05**2 <= 30 - pillar_m**2
