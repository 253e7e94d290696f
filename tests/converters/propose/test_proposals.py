"""Proposals and retrieval: instances from labels, what is merged, JSON that reads back, models that are found."""

from __future__ import annotations

import errno
import json
import math
import os

import numpy as np
import pytest
import trimesh

from converters.__main__ import main
from converters.bodies.alignment import apply_alignment
from converters.generate.models.cad import cad_model
from converters.generate.surface.write import write_cad
from converters.propose.pieces import Proposal, bounds, box_iou
from converters.propose.proposals import as_scan2cad, propose_instances
from converters.propose.retrieval import fit_model, read_library, retrieve, without_annotation
from converters.read.annotations import parse_annotations, read_scan2cad
from converters.records.errors import SceneRejected
from converters.records.raw import CadModel, ScanMesh
from interactive_nav_common.rotations import wrap_angle, yaw_matrix


def scan_of(*parts: tuple[trimesh.Trimesh, int]) -> ScanMesh:
    vertices = np.vstack([m.vertices for m, _ in parts])
    offsets = np.cumsum([0] + [len(m.vertices) for m, _ in parts[:-1]])
    faces = np.vstack([m.faces + o for (m, _), o in zip(parts, offsets, strict=True)])
    labels = np.concatenate([np.full(len(m.vertices), label) for m, label in parts])
    grey = np.full((len(vertices), 3), 128, np.uint8)
    return ScanMesh(vertices, faces, labels=labels, vertex_colours=grey)


def box(size, centre) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(centre)


def test_two_chairs_a_hand_apart_are_two_and_extents_are_right():
    scan = scan_of((box((0.5, 0.5, 0.9), (0, 0, 0.45)), 5), (box((0.5, 0.5, 0.9), (0.6, 0, 0.45)), 5))
    found = propose_instances(scan)
    assert [p.category for p in found] == ["chair", "chair"]
    for proposal in found:
        np.testing.assert_allclose(np.sort(proposal.extent_m), [0.5, 0.5, 0.9], atol=0.02)
        assert proposal.centre[2] == pytest.approx(0.45, abs=0.02) and abs(proposal.centre[1]) < 0.02
        assert proposal.confidence == pytest.approx(1.0)
    assert sorted(round(float(p.centre[0]), 1) for p in found) == [0.0, 0.6]


def test_a_seat_above_its_base_is_one_chair_and_a_table_named_desk_in_part_is_one_table():
    seat, base = box((0.5, 0.5, 0.5), (0, 0, 0.8)), box((0.5, 0.5, 0.1), (0, 0, 0.05))
    top, drawer = box((1.2, 0.8, 0.3), (3, 0, 0.6)), box((0.4, 0.7, 0.25), (3, 0, 0.6))
    found = propose_instances(scan_of((seat, 5), (base, 5), (top, 7), (drawer, 14)))
    assert sorted(p.category for p in found) == ["chair", "table"]
    chair = next(p for p in found if p.category == "chair")
    assert chair.extent_m[2] == pytest.approx(1.05, abs=0.02)


def chair(turn: float, x: float, y: float = 0.0) -> trimesh.Trimesh:
    """A plain chair, 0.46 x 0.46 x 0.9 m: seat, back, four legs."""
    parts = [box((0.46, 0.46, 0.05), (0, 0, 0.45)), box((0.46, 0.04, 0.45), (0, 0.21, 0.67))]
    parts += [box((0.05, 0.05, 0.45), (i, j, 0.22)) for i in (-0.2, 0.2) for j in (-0.2, 0.2)]
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
    return mesh.apply_translation((x, y, 0))


@pytest.mark.parametrize(
    ("places"),
    [
        [(0.0, 0.0, 0.0), (math.pi / 4, 0.56, 0.0)],  # a corner against a side
        [(0.2, 0.0, 0.0), (0.7, 0.45, 0.38)],  # corner to corner
        [(0.0, 0.0, 0.0), (0.0, 0.46, 0.0)],  # side to side, no gap at all
        [(0.0, 0.0, 0.0), (0.0, 0.46, 0.0), (0.0, 0.92, 0.0)],
    ],
)
def test_chairs_that_touch_are_told_apart(places):
    found = propose_instances(scan_of(*((chair(*p), 5) for p in places)))
    assert len(found) == len(places)
    for turn, x, y in places:
        truth = bounds(np.asarray(chair(turn, x, y).vertices))
        assert max(box_iou(truth, bounds(p.points)) for p in found) > 0.8
    assert all(p.confidence > 0.6 for p in found)
    assert sum(len(p.points) for p in found) > 1000 and len({id(p.points) for p in found}) == len(found)


def table(length: float, depth: float, x: float, y: float, high: float = 0.74) -> trimesh.Trimesh:
    """A top on four legs."""
    parts = [box((length, depth, 0.04), (0, 0, high - 0.02))]
    legs = [(i * (length / 2 - 0.05), j * (depth / 2 - 0.05)) for i in (-1, 1) for j in (-1, 1)]
    parts += [box((0.06, 0.06, high - 0.04), (i, j, high / 2 - 0.02)) for i, j in legs]
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh.apply_translation((x, y, 0))


FLOOR = box((3.4, 3.0, 0.001), (0.8, 0.8, 0)), 2
TABLES = {
    "an L": [(1.6, 0.8, 0, 0), (0.8, 1.2, 0.4, 1.0)],
    "a T": [(1.6, 0.8, 0, 0), (0.8, 1.4, 0, 1.1)],
    "side by side, moved along": [(1.6, 0.8, 0, 0), (1.6, 0.8, 0.5, 0.8)],
    "end to end, one narrower": [(1.6, 0.9, 0, 0), (1.2, 0.6, 1.4, 0.15)],
    "end to end": [(1.6, 0.8, 0, 0), (1.6, 0.8, 1.6, 0)],
    "three in a row": [(1.4, 0.8, 0, 0), (1.4, 0.8, 1.4, 0), (1.4, 0.8, 2.8, 0)],
    "side by side": [(1.8, 0.8, 0, 0), (1.8, 0.8, 0, 0.8)],
    "one lower": [(1.4, 0.8, 0, 0), (1.0, 0.6, 1.2, 0, 0.45)],
}


@pytest.mark.parametrize(("name", "yaw", "floor"), [*((n, 0.4, True) for n in TABLES), ("an L", 0.0, False)])
def test_tables_that_touch_are_told_apart(name, yaw, floor):
    turn = trimesh.transformations.rotation_matrix(yaw, (0, 0, 1))
    tables = [table(*sizes).apply_transform(turn) for sizes in TABLES[name]]
    ground = [(FLOOR[0].copy().apply_transform(turn), FLOOR[1])] if floor else []
    found = propose_instances(scan_of(*((t, 7) for t in tables), *ground))
    assert [p.category for p in found] == ["table"] * len(tables)
    for one in tables:
        truth = bounds(np.asarray(one.vertices))
        assert max(box_iou(truth, bounds(p.points)) for p in found) > 0.95


@pytest.mark.parametrize("yaw", [0.4])
def test_one_table_or_desk_is_not_parted(yaw):
    """A long one, a round one, one with a tray on it, a corner desk, a desk with a shelf; an L half hidden."""
    round_top = trimesh.creation.cylinder(0.7, 0.04).apply_translation((6, 0, 0.72)), 7
    tray = table(1.2, 0.8, 12, 0), box((0.4, 0.3, 0.1), (12, 0, 0.79))
    corner = box((1.6, 0.7, 0.05), (18, 0, 0.72)), box((0.7, 1.0, 0.05), (17.55, 0.85, 0.72))
    shelf = box((1.2, 0.6, 0.05), (24, 0, 0.72)), box((1.2, 0.25, 0.3), (24, 0.17, 1.0))
    parts = [(table(2.4, 0.9, 0, 0), 7), round_top, *((m, 7) for m in tray), *((m, 14) for m in (*corner, *shelf))]
    # A top of 1.6 x 1.4 m, a corner of which something hides: no floor is seen there, only around.
    hidden = box((1.6, 0.7, 0.05), (30, -0.35, 0.72)), box((0.9, 0.7, 0.05), (29.65, 0.35, 0.72))
    around = [box((4, 0.5, 0.001), (30, y, 0)) for y in (-1.2, 1.2)] + [box((0.8, 2, 0.001), (31.4, 0, 0))]
    parts += [(m, 7) for m in hidden] + [(m, 2) for m in around]
    turn = trimesh.transformations.rotation_matrix(yaw, (0, 0, 1))
    found = propose_instances(scan_of(*((m.apply_transform(turn), label) for m, label in parts)))
    assert sorted(p.category for p in found) == ["desk"] * 2 + ["table"] * 4


def test_one_thing_is_not_parted():
    """An L of a sofa, a long table on a leg at one end, a door, a swivel chair on its star of legs."""
    corner = (box((2.2, 0.9, 0.8), (0, 0, 0.4)), 6), (box((0.9, 1.0, 0.8), (0.65, 0.95, 0.4)), 6)
    table = (box((2.8, 0.9, 0.05), (6, 0, 0.72)), 7), (box((0.1, 0.8, 0.7), (5, 0, 0.35)), 7)
    door = (box((1.0, 0.05, 2.0), (10, 0, 1.0)), 8)
    star = [(box((0.6, 0.05, 0.05), (14, 0, 0.05)), 5) for _ in range(5)]
    for k, (mesh, _) in enumerate(star):
        mesh.apply_transform(trimesh.transformations.rotation_matrix(k * math.pi / 5, (0, 0, 1), (14, 0, 0)))
    seat = (box((0.42, 0.42, 0.5), (14, 0, 0.7)), 5)
    found = propose_instances(scan_of(*corner, *table, door, *star, seat))
    assert sorted(p.category for p in found) == ["chair", "door", "sofa", "table"]


def test_noise_is_dropped_and_an_odd_size_lowers_the_confidence():
    crumb, giant = box((0.05, 0.05, 0.05), (5, 0, 0)), box((2.0, 1.5, 0.9), (0, 0, 0.45))
    (only,) = propose_instances(scan_of((crumb, 5), (giant, 5)))
    assert only.confidence == pytest.approx(0.5, abs=0.01)  # twice as wide as chairs are


def test_box_iou_by_hand():
    one = (np.zeros(3), np.ones(3))
    assert box_iou(one, (np.array([0.5, 0, 0]), np.array([1.5, 1, 1]))) == pytest.approx(1 / 3)
    assert box_iou(one, (np.array([2.0, 0, 0]), np.array([3.0, 1, 1]))) == 0.0


def test_models_of_classes_that_are_not_looked_for_are_passed_over(tmp_path):
    write_cad(tmp_path / "cad", cad_model("dresser_tall"))
    with pytest.raises(SceneRejected, match="no model of a known class"):
        read_library(tmp_path)
    write_cad(tmp_path / "cad", cad_model("Scopia/chair"))
    assert [cad.category for cad in read_library(tmp_path).values()] == ["chair"]


def test_the_tiny_room_is_proposed_and_its_models_are_found(scan2cad_raw):
    raw = read_scan2cad(scan2cad_raw)
    proposals = propose_instances(raw.scan)
    assert sorted(p.category for p in proposals) == ["basket", "table"]
    assert without_annotation(proposals, raw.annotations, raw.cads) == []
    assert without_annotation(proposals, (), raw.cads) == [0, 1]
    library = read_library(scan2cad_raw)
    for proposal in proposals:
        found = retrieve(proposal, library, 0.3)
        assert found is not None and found.cad.category == proposal.category
        annotation = next(a for a in raw.annotations if a.category == proposal.category)
        true = raw.cads[annotation.cad_id].vertices @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]
        assert box_iou(bounds(apply_alignment(found.pose, found.cad.vertices)), bounds(true)) > 0.85
        assert found.confidence > 0.5
        # The JSON reads back as an annotation of that model at that pose.
        _, records = parse_annotations(as_scan2cad("tiny", (proposal,), {0: found}), scan2cad_raw)
        back = records[0][1]
        assert back.cad_id == found.cad.cad_id
        moved = found.cad.vertices @ back.pose[:3, :3].T + back.pose[:3, 3]
        np.testing.assert_allclose(moved, apply_alignment(found.pose, found.cad.vertices), atol=1e-4)


def l_shape() -> CadModel:
    """A chair without any symmetry: seat, back at -y, one arm at +x."""
    parts = [box((1, 1, 0.2), (0, 0, 0.1)), box((1, 0.2, 1), (0, -0.4, 0.7)), box((0.2, 0.8, 0.3), (0.4, 0.1, 0.35))]
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return CadModel("chair", "l", np.asarray(mesh.vertices), np.asarray(mesh.faces), np.zeros((36, 3), np.uint8))


@pytest.mark.parametrize("yaw", [0.4, 2.0, -1.2])
def test_a_known_pose_is_found_again(yaw):
    cad = l_shape()
    scale, shift = np.array([0.6, 0.5, 0.55]), np.array([1.0, 2.0, 0.1])
    mesh = trimesh.Trimesh(cad.vertices, cad.faces, process=False)
    surface = np.asarray(trimesh.sample.sample_surface(mesh, 3000, seed=1)[0])
    points = surface * scale @ yaw_matrix(yaw).T + shift + np.random.default_rng(0).normal(0, 0.005, surface.shape)
    proposal = Proposal("chair", 5, points, points.mean(axis=0), np.ptp(points, axis=0), 0.0, 1000, 1.0)
    fit = fit_model(proposal, cad, 0.1)
    assert abs(math.degrees(wrap_angle(fit.pose.yaw - yaw))) < 3
    np.testing.assert_allclose(fit.pose.scale, scale, rtol=0.06)
    np.testing.assert_allclose(fit.pose.translation, shift, atol=0.02)
    assert fit.residual_m < 0.03 and fit.explained > 0.95


def test_nothing_of_the_class_in_the_library(scan2cad_raw):
    library = {k: c for k, c in read_library(scan2cad_raw).items() if c.category == "basket"}
    table = next(p for p in propose_instances(read_scan2cad(scan2cad_raw).scan) if p.category == "table")
    assert retrieve(table, library, 0.3) is None


def test_propose_writes_json_and_prints_a_table(scan2cad_raw, tmp_path, capsys):
    assert main(["propose", str(scan2cad_raw), "-o", str(tmp_path / "p"), "--auto-align"]) == 0
    printed = capsys.readouterr().out
    assert "Proposals" in printed and "basket" in printed and "table" in printed
    data = json.loads((tmp_path / "p" / "proposals.json").read_text())
    assert data[0]["n_aligned_models"] == len(data[0]["aligned_models"]) == 2
    assert all(0 < m["proposal"]["confidence"] <= 1 and m["id_cad"] for m in data[0]["aligned_models"])


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))])
def test_what_fails_leaves_the_older_file(scan2cad_raw, tmp_path, monkeypatch, capsys, failure):
    out = tmp_path / "p"
    out.mkdir()
    (out / "proposals.json").write_text("older")

    def fail(*_):
        raise failure

    monkeypatch.setattr("converters.propose.proposals.as_scan2cad", fail)
    assert main(["propose", str(scan2cad_raw), "-o", str(out)]) == (130 if failure.args == () else 2)
    assert capsys.readouterr().err.count("\n") == 1
    assert [(p.name, p.read_text()) for p in out.iterdir()] == [("proposals.json", "older")]


def test_propose_refuses_a_scan_without_furniture_labels(gibson_raw, tmp_path, capsys):
    path = gibson_raw / "mesh_z_up.labels.npz"
    labels = np.load(path)["label"]
    np.savez(path, label=np.where(labels == 2, 2, 1).astype(np.uint8))
    assert main(["propose", str(gibson_raw), "-o", str(tmp_path / "p")]) == 2
    assert "no furniture label" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()


def test_a_library_chair_is_found_again_among_the_packaged_ones():
    library = read_library(None)
    assert {cad.category for cad in library.values()} >= {"chair", "table", "sofa", "desk"}
    chairs = {k: c for k, c in library.items() if c.category == "chair"}
    few = dict(sorted(chairs.items())[:5]) | {"Scopia_chair": chairs["Scopia_chair"]}
    true = few["Scopia_chair"]
    assert true.pieces is not None and true.surface is not None
    mesh = trimesh.Trimesh(true.vertices, true.faces, process=False)
    mesh.apply_translation([2.0, 1.0, 0.0])
    (proposal,) = propose_instances(scan_of((mesh.subdivide(), 5)))
    found = retrieve(proposal, few, 0.0)
    assert found is not None and found.cad.cad_id == "Scopia_chair" and found.residual_m < 0.02
