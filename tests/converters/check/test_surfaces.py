"""Shares by hand, and the gates on surfaces: passed by whole furniture, failed by furniture of 160 triangles."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import trimesh

from converters.check.gates import LIMITS, body_shares, check_folder, judge
from converters.geometry.faces import face_areas, simplify
from converters.library.store import read_shape
from interactive_nav_common.rotations import Y_UP_TO_Z_UP

CUBE = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide().subdivide()


def without(x: float) -> tuple[np.ndarray, np.ndarray]:
    """The cube without the side that faces +x or -x."""
    return np.asarray(CUBE.vertices), np.asarray(CUBE.faces)[CUBE.triangles_center[:, 0] * x < 0.499]


def test_shares_of_a_cube_by_hand():
    corners = np.asarray(CUBE.vertices)
    assert body_shares((corners, np.asarray(CUBE.faces)), [corners]) == (0.0, 0.0)
    unseen, unsolid = body_shares(without(1.0), [corners])
    assert unseen == pytest.approx(0.8 * 0.8 / 4, abs=0.03) and unsolid == 0.0
    # Two halves: their common sides are not outer ones.
    halves = [corners * [0.5, 1.0, 1.0] + [x, 0, 0] for x in (-0.25, 0.25)]
    assert body_shares((corners, np.asarray(CUBE.faces)), halves) == (0.0, 0.0)
    # With one half gone, so is what stood for half of the surface less a rim of 5 cm.
    assert body_shares((corners, np.asarray(CUBE.faces)), halves[:1])[1] == pytest.approx((4 * 0.45 + 1) / 6, abs=0.03)


@pytest.mark.parametrize("name", ["BlendSwap-CC-0/L_shaped_sofa", "BlendSwap-CC-0/sofa", "BlendSwap-CC-0/silla2"])
def test_furniture_of_160_triangles_fails_and_whole_furniture_passes(name):
    shape = read_shape(name)
    hulls = [hull.vertices @ Y_UP_TO_Z_UP.T for hull in shape.hulls]
    whole = shape.visual.vertices @ Y_UP_TO_Z_UP.T, shape.visual.faces
    for drawn, good in ((whole, True), (simplify(*whole, 160), False)):
        unseen, unsolid = body_shares(drawn, hulls)
        kept = float(face_areas(*drawn).sum() / face_areas(*whole).sum())
        assert judge("unseen_hulls", unseen).passed is good and judge("surface_kept", kept).passed is good
        assert judge("unsolid_surface", unsolid).passed


def test_a_scene_without_a_tables_top_fails_by_name(tiny_scene, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(tiny_scene[0], folder)
    data = json.loads((folder / "scene.json").read_text())
    assert {row["drawn_area_share"] for row in data["alignment"]} == {1.0}
    data["alignment"][0]["drawn_area_share"] = 0.5
    (folder / "scene.json").write_text(json.dumps(data))
    path = folder / "assets" / "basket_0_visual.obj"
    lines = [line.split() for line in path.read_text().splitlines()]
    points = np.array([words[1:] for words in lines if words[0] == "v"], float)
    polygons = [words[1:] for words in lines if words[0] == "f"]
    triangles = [(c[0], c[k], c[k + 1]) for c in polygons for k in range(1, len(c) - 1)]
    bottom = [t for t in triangles if points[[int(c.split("/")[0]) - 1 for c in t], 2].max() < 0.01]
    assert 0 < len(bottom) < len(triangles)
    kept = [words for words in lines if words[0] != "f"] + [["f", *t] for t in bottom]
    path.write_text("\n".join(map(" ".join, kept)) + "\n")
    gates = {gate.name: gate for gate in check_folder(folder)[1]}
    assert {name for name, gate in gates.items() if not gate.passed} == {"unseen_hulls", "surface_kept"}
    assert gates["unseen_hulls"].warnings == ("unseen_hulls: basket_0 is worst",)
    assert gates["surface_kept"].value == 0.5 and LIMITS["surface_kept"].least == 0.9
