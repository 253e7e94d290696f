"""A generated folder, read back from its files, against the plan and the furniture that it was made from."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import converters.generate as generate
from converters.generate import Building, GenerationError, design_building, generate_building
from converters.generate.homes.config import home_config
from converters.generate.surface import texture
from converters.generate.surface.scan import (
    NYU40,
    Scan,
    Solid,
    building_solids,
    fuse,
    nearest_solids,
    solid_from_box,
    visible_from,
)
from converters.generate.surface.write import SCAN_TO_WORLD, pose_in_world
from interactive_nav_common.errors import FileError

SEED = 1
SMALL = home_config("sparse", {"floor_area_m2": (30.0, 30.0), "n_rooms": (3, 3), "voxel_m": 0.025})
TINY = home_config(
    "sparse",
    {
        "floor_area_m2": (12.0, 12.0), "n_rooms": (1, 1), "n_doors": (0, 0), "n_windows": (0, 0),
        "furniture_share": 0.08, "voxel_m": 0.05, "faces_per_m2": 300.0, "texels_per_m": 24.0,
    },
)  # fmt: skip


@functools.cache
def drawn() -> Building:
    return design_building(SEED, SMALL)


def solids_of(b: Building) -> list[Solid]:
    return building_solids(b.plan, list(b.items))


@dataclasses.dataclass(frozen=True)
class Raw:
    folder: Path
    vertices: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    face_uv: np.ndarray
    labels: np.ndarray
    scan: dict


@pytest.fixture(scope="module")
def raw(tmp_path_factory) -> Raw:
    folder = tmp_path_factory.mktemp("generated") / "home"
    generate_building(folder, SEED, config=SMALL)
    rows: dict[str, list] = {"v": [], "vt": [], "f": []}
    for line in (folder / "mesh_z_up.obj").read_text().splitlines():
        word, *rest = line.split()
        if word in rows:
            rows[word].append(rest)
    corners = np.array([[c.split("/") for c in face] for face in rows["f"]], int) - 1
    return Raw(
        folder,
        np.array(rows["v"], float),
        np.array(rows["vt"], float),
        corners[:, :, 0],
        corners[:, :, 1],
        np.load(folder / "mesh_z_up.labels.npz")["label"],
        json.loads((folder / "alignments.json").read_text())[0],
    )


def trs_matrix(trs: dict) -> np.ndarray:
    w, x, y, z = trs["rotation"]
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix() @ np.diag(trs["scale"])
    out[:3, 3] = trs["translation"]
    return out


def apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def test_the_folder_is_complete_and_small(raw):
    names = {p.name for p in raw.folder.iterdir()}
    assert names == {
        "mesh_z_up.obj", "mesh_z_up.mtl", "mesh_z_up_texture.png", "mesh_z_up.labels.npz", "floors.txt",
        "floor_0.png", "floor_trav_0.png", "alignments.json", "cad", "generator.json", "LICENCE", "windows.txt",
        "ATTRIBUTION.md",
    }  # fmt: skip
    assert sum(p.stat().st_size for p in raw.folder.rglob("*") if p.is_file()) < 12 * 2**20
    assert not [p for p in raw.folder.parent.iterdir() if p != raw.folder]


def test_mesh_is_sound(raw):
    assert 10_000 <= len(raw.faces) <= 20_000
    assert np.isfinite(raw.vertices).all() and raw.labels.dtype == np.uint8
    assert len(raw.labels) == len(raw.vertices)
    assert set(np.unique(raw.faces)) == set(range(len(raw.vertices)))
    assert (np.sort(raw.faces, axis=1)[:, 1:] != np.sort(raw.faces, axis=1)[:, :-1]).all()
    assert raw.uv.min() >= 0 and raw.uv.max() <= 1 and raw.face_uv.max() < len(raw.uv)


def test_surface_follows_the_truth_within_the_noise(raw):
    b = drawn()
    solids = solids_of(b)
    points = raw.vertices - [0, 0, b.floor_height_m]
    index, _ = nearest_solids(points, solids)
    off = np.zeros(len(points))
    for k, s in enumerate(solids):
        off[index == k] = s.distance(points[index == k])
    # 6 mm of noise and 25 mm voxels: the bulk within a centimetre, nothing beyond two voxels and the noise.
    assert 0.003 < np.median(np.abs(off)) < 0.010
    assert np.percentile(np.abs(off), 98) < 0.035


def test_floor_lies_at_the_height_in_floors_txt(raw):
    height = float((raw.folder / "floors.txt").read_text())
    assert height > 0.04
    floor_z = raw.vertices[raw.labels == NYU40["floor"], 2]
    assert np.median(floor_z) == pytest.approx(height, abs=0.003)


def test_labels_are_mostly_right_and_wrong_only_near_borders(raw):
    b = drawn()
    solids = solids_of(b)
    index, other = nearest_solids(raw.vertices - [0, 0, b.floor_height_m], solids)
    truth = np.array([s.label for s in solids])[index]
    wrong = raw.labels != truth
    assert 0.005 < wrong.mean() < 0.05
    # OBJ rounding (0.1 mm) may change which solid is nearest, so a handful of others is allowed.
    assert (other[wrong] == raw.labels[wrong]).mean() > 0.97
    present = {NYU40[i.model.category] for i in (*b.items, *b.plan.built_in)} | {NYU40["wall"], NYU40["floor"]}
    for label in present:
        assert (raw.labels == label).sum() >= 40, label
    assert set(np.unique(raw.labels)) <= present


def test_scan_has_holes_where_no_camera_looked(raw):
    b = drawn()
    points = raw.vertices - [0, 0, b.floor_height_m]
    sofa = next(i for i in b.items if i.model.category == "sofa")
    inner = sofa.footprint.buffer(-0.15)
    x0, y0, x1, y1 = inner.bounds
    low = points[(points[:, 2] < 0.05) & (points[:, 0] > x0) & (points[:, 0] < x1)]
    low = low[(low[:, 1] > y0) & (low[:, 1] < y1)]
    # At the density of the open floor the area under the sofa would have inner.area * density vertices.
    floor = np.abs(points[:, 2]) < 0.02
    density = floor.sum() / sum(r.area_m2 for r in b.plan.rooms)
    assert len(low) < 0.3 * density * inner.area
    for window in b.plan.windows:
        middle = (np.array(window.low) + np.array(window.high)) / 2
        assert np.linalg.norm(points - middle, axis=1).min() > 0.25


def test_outside_of_the_building_is_unseen(raw):
    b = drawn()
    o = b.plan.outer
    points = raw.vertices[:, :2]
    inside = (points > [o.x0 + 0.1, o.y0 + 0.1]).all(axis=1) & (points < [o.x1 - 0.1, o.y1 - 0.1]).all(axis=1)
    assert inside.mean() > 0.995


def test_maps_agree_with_the_mesh(raw):
    height = float((raw.folder / "floors.txt").read_text())
    obstacles = np.array(Image.open(raw.folder / "floor_0.png"))
    traversable = np.array(Image.open(raw.folder / "floor_trav_0.png"))
    size = obstacles.shape[0]
    assert obstacles.shape == traversable.shape == (size, size)
    column = (raw.vertices[:, 0] / 0.01 + size / 2).astype(int)
    row = (raw.vertices[:, 1] / 0.01 + size / 2).astype(int)
    z = raw.vertices[:, 2] - height
    # The scanned floor lies on traversable pixels, and walls of the robot's height on or beside blocked ones.
    floor = (raw.labels == NYU40["floor"]) & (np.abs(z) < 0.02)
    assert (traversable[row[floor], column[floor]] == 255).mean() > 0.95  # the rest lies beneath what is built in
    wall = np.flatnonzero((raw.labels == NYU40["wall"]) & (z > 0.3) & (z < 1.0))
    near = np.zeros(len(wall), bool)
    for dr in (-4, 0, 4):
        for dc in (-4, 0, 4):
            near |= obstacles[row[wall] + dr, column[wall] + dc] == 0
    assert near.mean() > 0.97
    # Movable things are in neither map: some of their vertices stand over traversable pixels.
    sofa = (raw.labels == NYU40["sofa"]) & (z < 0.6)
    assert (traversable[row[sofa], column[sofa]] == 255).mean() > 0.9


def test_annotations_lead_back_to_the_furniture(raw):
    b = drawn()
    models = raw.scan["aligned_models"]
    assert raw.scan["n_aligned_models"] == len(models) == len(b.items)
    to_world = trs_matrix(raw.scan["trs"])
    np.testing.assert_allclose(to_world[:3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-12)  # z up -> y up
    np.testing.assert_allclose(apply(to_world, raw.vertices).min(0), -apply(to_world, raw.vertices).max(0), atol=2e-4)
    for item, entry in zip(b.items, models, strict=True):
        pose = trs_matrix(entry["trs"])
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        box_cad = np.array(entry["center"]) + corners * entry["bbox"]
        np.testing.assert_allclose(box_cad.min(0), item.model.bounds[0], atol=1e-9)
        truth = item.to_floor(box_cad) + [0, 0, b.floor_height_m]
        annotated = apply(np.linalg.inv(to_world), apply(pose, box_cad))
        error = np.linalg.norm(annotated - truth, axis=1)
        assert 0.0005 < error.mean() < 0.05 and error.max() < 0.09


def test_keypoints_agree_with_the_poses_within_the_noise(raw):
    b = drawn()
    residuals = []
    for item, entry in zip(b.items, raw.scan["aligned_models"], strict=True):
        on_cad = np.array(entry["keypoints_cad"]["position"]).reshape(-1, 3)
        on_scan = np.array(entry["keypoints_scan"]["position"]).reshape(-1, 3)
        assert 6 <= len(on_cad) == len(on_scan) == entry["keypoints_cad"]["n_keypoints"] <= 10
        local = apply(np.linalg.inv(trs_matrix(entry["trs"])), on_cad)
        low, high = item.model.bounds
        assert (local > low - 1e-3).all() and (local < high + 1e-3).all()
        # Spread over the model, so that all three scales can be solved for.
        assert (np.ptp(local, axis=0) > 0.35 * (high - low)).all()
        t, r = pose_in_world(item, np.array(raw.scan["trs"]["translation"]), b.floor_height_m)
        truth = r.apply(local * item.scale) + t
        residuals.append(on_scan - truth)
    spread = np.concatenate(residuals).std()
    assert 0.008 < spread < 0.012  # annotation_noise_m is 0.01


def test_every_annotated_model_is_in_the_library(raw):
    for entry in raw.scan["aligned_models"]:
        path = raw.folder / "cad" / entry["catid_cad"] / entry["id_cad"] / "models" / "collision.obj"
        rows = [line.split()[1:] for line in path.read_text().splitlines() if line.startswith("v ")]
        points = np.array(rows, float)
        np.testing.assert_allclose((points.max(0) + points.min(0)) / 2, entry["center"], atol=1e-5)
        np.testing.assert_allclose((points.max(0) - points.min(0)) / 2, entry["bbox"], atol=1e-5)
        assert path.with_name("model_normalized.mtl").is_file()


def test_doors_carry_their_hinge(raw):
    doors = [m for m in raw.scan["aligned_models"] if m["catid_cad"] == "03221720"]
    assert doors and all(m["articulation"]["type"] == "hinge" for m in doors)
    for m in doors:
        low, high = m["articulation"]["range_rad"]
        assert m["articulation"]["axis"] == [0, 1, 0] and low < 0 < high
        assert m["articulation"]["origin"][0] == pytest.approx(m["center"][0] - m["bbox"][0])
    others = [m for m in raw.scan["aligned_models"] if m not in doors]
    assert all("articulation" not in m for m in others)


def test_texture_shows_wood_or_tiles_on_floors_and_light_walls(raw):
    image = np.array(Image.open(raw.folder / "mesh_z_up_texture.png"))
    assert image.ndim == 3 and image.dtype == np.uint8
    size = image.shape[0]
    uv = raw.uv[raw.face_uv].mean(axis=1)
    colour = image[((1 - uv[:, 1]) * size).astype(int), (uv[:, 0] * size).astype(int)].astype(float)
    label = raw.labels[raw.faces]
    pure = (label == label[:, :1]).all(axis=1)
    walls, floors = (colour[pure & (label[:, 0] == NYU40[c])].mean(axis=0) for c in ("wall", "floor"))
    assert walls.min() > 150 and walls.mean() > floors.mean()  # light paint over darker floors
    assert colour[pure].std(axis=0).min() > 20


def test_each_face_shows_the_colour_of_its_place(monkeypatch):
    """A box room, seen from inside, whose colours say where they are; also what a chart's last texel shows."""
    size = np.array([2.0, 3.0, 2.5])
    room = trimesh.creation.box(extents=size).subdivide_to_size(0.3)
    vertices, faces = np.asarray(room.vertices), np.asarray(room.faces)[:, ::-1]
    monkeypatch.setattr(texture, "paint", lambda scan, rooms, uses, points, ids, rng: points / size + 0.5)
    scan = Scan(vertices, faces, np.zeros(len(vertices), np.uint8))
    atlas = texture.make_atlas(scan, (), (), 40.0, np.random.default_rng(0))
    side = len(atlas.image)
    # 37 m2 at 40 texels a metre, of an image that is filled to six tenths
    assert atlas.image.shape == (315, 315, 3) and (atlas.faces == faces).all()
    for weights in ([1 / 3, 1 / 3, 1 / 3], [0.96, 0.02, 0.02]):
        uv, places = (np.einsum("k,fkd->fd", weights, of) for of in (atlas.uv[atlas.uv_faces], vertices[faces]))
        shown = atlas.image[((1 - uv[:, 1]) * side).astype(int), (uv[:, 0] * side).astype(int)] / 255
        off_m = np.abs((shown - 0.5) * size - places)
        assert off_m.max() < 0.5 * size.max() / 63 + 1.5 / 40  # half a level of 64, and a texel and a half


def digests(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def test_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    stages = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        generate_building(tmp_path / name, seed, lambda stage, share: stages.append((stage, share)), TINY)
    a, b, c = (digests(tmp_path / n) for n in "abc")
    assert a == b
    assert a["mesh_z_up.obj"] != c["mesh_z_up.obj"] and a["alignments.json"] != c["alignments.json"]
    shares = [share for _, share in stages[: len(stages) // 3]]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0


def test_a_failure_half_way_leaves_nothing(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(generate, "write_cad", full)
    with pytest.raises(OSError, match="No space"):
        generate_building(tmp_path / "home", 1, config=TINY)
    assert list(tmp_path.iterdir()) == []


def test_a_taken_folder_is_left_alone(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "note.txt").write_text("mine")
    with pytest.raises(GenerationError, match="not an empty folder"):
        generate_building(tmp_path / "home", 1, config=TINY)
    assert (tmp_path / "home" / "note.txt").read_text() == "mine"


def test_a_folder_that_was_filled_meanwhile_is_left_alone_and_litter_goes(tmp_path, monkeypatch):
    def fill(*args, **kwargs):
        (tmp_path / "home").mkdir()
        (tmp_path / "home" / "note.txt").write_text("mine")

    left = tmp_path / ".home.part-7-01234567"  # of a process that was killed
    left.mkdir()
    os.utime(left, (0, 0))
    monkeypatch.setattr(generate, "_write", fill)
    with pytest.raises(FileError, match="home: exists already"):
        generate_building(tmp_path / "home", 1, config=TINY)
    assert [p.name for p in tmp_path.rglob("*")] == ["home", "note.txt"]


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "note").write_text("mine")
    with pytest.raises(GenerationError, match="note is a file"):
        generate_building(tmp_path / "note" / "home", 1, config=TINY)


def test_a_wall_hides_what_is_behind_it():
    wall = solid_from_box((1.0, -1.0, 0.0), (1.1, 1.0, 2.0), 1, "paint")
    floor = solid_from_box((-1.0, -1.0, -0.3), (3.0, 1.0, 0.0), 2, "floor")
    volume = fuse([wall, floor], np.array([-1.1, -1.1, -0.4]), np.array([3.1, 1.1, 2.1]), 0.025)
    points = np.array([[0.5, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.1, 0.0, 1.0], [-0.9, 0.0, 0.0]])
    normals = np.array([[0, 0, 1.0], [0, 0, 1.0], [-1.0, 0, 0], [1.0, 0, 0], [0, 0, 1.0]])
    seen = visible_from(points, normals, np.array([[0.0, 0.0, 1.5]]), volume)
    # floor before the wall, floor behind it, its near face, its far face, floor on the other side
    assert seen.tolist() == [True, False, True, False, True]


def test_scan_to_world_turns_z_up_into_y_up():
    np.testing.assert_allclose(SCAN_TO_WORLD.apply([1.0, 2.0, 3.0]), [1.0, 3.0, -2.0], atol=1e-12)
