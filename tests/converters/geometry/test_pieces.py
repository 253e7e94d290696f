"""Convex pieces of meshes: told apart, joined, and read from beside a model."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from converters.generate.models.cad import cad_model
from converters.generate.surface.write import write_cad
from converters.geometry.boxes import convex_pieces, hull_volume, merge_pieces
from converters.read.annotations import MOST_PIECES, read_cad
from converters.read.files import SourceFolder
from interactive_nav_common.rotations import Y_UP_TO_Z_UP

CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)


def test_pieces_are_told_from_shapes_that_are_not_convex():
    boxes = [trimesh.creation.box((1, 1, 1)).apply_translation((x, 0, 0)) for x in (0, 1, 2)]
    row = trimesh.util.concatenate(boxes)
    pieces = convex_pieces(np.asarray(row.vertices), np.asarray(row.faces))
    assert pieces is not None and len(pieces) == 3
    ring = trimesh.creation.annulus(0.5, 1.0, 0.2)
    assert convex_pieces(np.asarray(ring.vertices), np.asarray(ring.faces)) is None


def test_merging_takes_the_pair_that_encloses_least():
    # Two cubes side by side join without a gap; the third stands apart.
    merged = merge_pieces([CUBE, CUBE + [5, 0, 0], CUBE + [1, 0, 0]], 2)
    spans = sorted(tuple(np.ptp(p, axis=0)) for p in merged)
    assert spans == [(1, 1, 1), (2, 1, 1)]
    assert len(merge_pieces([CUBE] * 20, 16)) == 16


def test_joining_goes_on_while_it_adds_little():
    beside, near, far = CUBE + [1, 0, 0], CUBE + [2.5, 0, 0], CUBE + [9, 0, 0]
    four = [CUBE, beside, near, far]
    assert [len(merge_pieces(four, 9, slack)) for slack in (0.01, 0.6, 10.0)] == [3, 2, 1]
    assert len(merge_pieces(four, 9)) == 4


@pytest.mark.parametrize("name", ["cart_tea", "plant_monstera", "BlendSwap-CC-0/chair"])
def test_a_model_with_a_collision_mesh_comes_with_its_pieces(tmp_path, name):
    model = cad_model(name)
    write_cad(tmp_path / "cad", model)
    source = SourceFolder(tmp_path)
    read = read_cad(source, model.catid, model.id_cad)
    assert read.pieces is not None and 1 < len(read.pieces) <= MOST_PIECES
    parts = [p.vertices @ Y_UP_TO_Z_UP.T for p in model.parts]
    everything = np.concatenate(parts)
    own = np.concatenate([v for v, _ in read.pieces])
    np.testing.assert_allclose([own.min(axis=0), own.max(axis=0)], [everything.min(axis=0), everything.max(axis=0)])
    for part in parts:  # each part lies in one of the pieces
        slack = [hull_volume(np.vstack([v, part])) - hull_volume(v) for v, _ in read.pieces]
        assert min(slack) < 1e-9
    assert any(path.endswith("collision.obj") for path in source.sha256)


def test_a_piece_that_is_not_convex_is_told_and_the_model_decomposed(tmp_path):
    model = cad_model("cart_tea")
    write_cad(tmp_path / "cad", model)
    folder = tmp_path / "cad" / model.catid / model.id_cad / "models"
    (folder / "collision.obj").write_text(trimesh.creation.annulus(0.5, 1.0, 0.2).export(file_type="obj"))
    source = SourceFolder(tmp_path)
    assert read_cad(source, model.catid, model.id_cad).pieces is None
    assert any("not convex; the model is decomposed" in note for note in source.warnings)
