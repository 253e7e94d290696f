"""The released layout: the tiny room written in it reads back as it was, and converts."""

from __future__ import annotations

import dataclasses
import math
import shutil

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.pipeline import ConvertConfig, convert
from converters.read.gibson import assume_hinge, read_gibson, read_interactive_gibson
from converters.read.source import detect_format
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR
from scenes_mjcf.schema import load_manifest
from tests.converters.read.released import FRICTION, MASS_KG, PLANE_COLOUR, placed_vertices, write_released

SMALL = ConvertConfig(structure_texture=64, object_texture=32)
TABLE = "alignment_centered_0_04379243.urdf"


@pytest.fixture(scope="module")
def original(pristine):
    """The tiny room."""
    return read_gibson(pristine / "gibson")


@pytest.fixture
def released(tmp_path, original):
    return write_released(original, tmp_path / "released")


def test_it_reads_back_as_it_was_written(released, original):
    assert detect_format(released) == "interactive-gibson"
    raw = read_interactive_gibson(released)
    assert raw.source_format == "interactive-gibson" and raw.floor_height_m == original.floor_height_m
    assert [a.category for a in raw.annotations] == ["table", "basket"]
    for annotation, before in zip(raw.annotations, original.annotations, strict=True):
        want = placed_vertices(original, before)
        at = placed_vertices(raw, annotation)
        np.testing.assert_allclose([at.min(0), at.max(0)], [want.min(0), want.max(0)], atol=2e-5)
        cad = raw.cads[annotation.cad_id]
        assert (cad.mass_kg, cad.friction) == (MASS_KG, FRICTION)
        assert set(map(tuple, cad.face_colours)) == {(51, 102, 153)}
    # A top and four legs, each a box of 8 corners: the collision mesh's own convex pieces.
    pieces = raw.cads["0_04379243"].pieces
    assert pieces is not None and [len(v) for v, _ in pieces] == [8] * 5


def test_the_plane_fills_the_holes_with_its_own_colour(released, original):
    raw = read_interactive_gibson(released)
    (released / "plane_z_up_0.obj").unlink()
    without = read_interactive_gibson(released)
    added = len(raw.scan.faces) - len(without.scan.faces)
    assert any("plane_z_up_0.obj is absent" in w for w in without.warnings)
    new = raw.scan.vertices[raw.scan.faces[-added:]]
    area = np.linalg.norm(np.cross(new[:, 1] - new[:, 0], new[:, 2] - new[:, 0]), axis=1).sum() / 2
    # Pieces in squares of 0.1 m that show no floor: at most the holes under table (1.0 x 0.6) and basket (0.3 x 0.3),
    # grown by a square's width; at least the part of the holes that is a square away from seen floor.
    assert 0.8 * 0.4 + 0.1 * 0.1 <= area <= 1.2 * 0.8 + 0.5 * 0.5
    np.testing.assert_allclose(new[..., 2], original.floor_height_m)
    assert (raw.scan.labels[raw.scan.faces[-added:]] == FLOOR).all()
    assert raw.scan.corner_uv is not None and raw.scan.texture is not None
    u, v = raw.scan.corner_uv[-added:].mean(axis=1).T
    height, width = raw.scan.texture.shape[:2]
    shown = raw.scan.texture[((1 - v) * height).astype(int), (u * width).astype(int)]
    assert (shown == PLANE_COLOUR).all()


def test_the_plane_stays_on_the_map(released, original):
    image = np.zeros((800, 800), np.uint8)
    image[400:650, 600:700] = 255  # x from 2 to 3 m: the basket's hole is on it, the table's is not
    Image.fromarray(image).save(released / "floor_trav_0.png")

    def patch(raw):
        """Corners of what the plane added: the scan's own vertices come first."""
        return raw.scan.vertices[len(original.scan.vertices) :]

    (released / "floor_trav_0.png").rename(released / "away.png")
    everywhere = patch(read_interactive_gibson(released))
    (released / "away.png").rename(released / "floor_trav_0.png")
    on_map = patch(read_interactive_gibson(released))
    assert 0 < len(on_map) < len(everywhere)
    assert everywhere[:, 0].min() < 1.5 and on_map[:, 0].min() > 2.0 - 0.05  # a piece's middle lies on it


def test_it_converts_with_the_urdfs_mass_friction_and_pieces(released, tmp_path, hull_cache):
    converted = convert(released, tmp_path / "room", SMALL, cache=hull_cache)
    assert {g.name for g in converted.gates if not g.passed} == set()
    manifest = load_manifest(tmp_path / "room")
    assert [(o.name, o.mass_kg, o.friction, o.n_hulls) for o in manifest.objects] == [
        ("table_0", MASS_KG, FRICTION, 5),
        ("basket_0", MASS_KG, FRICTION, 1),
    ]
    assert manifest.collision["from_source"] == ["0_04379243", "1_02747177"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "room" / "scene.xml"))
    body = model.body("basket_0")  # a solid box of 0.3 x 0.3 x 0.4 m: m (a2 + b2) / 12, not the placeholder's 1
    want = MASS_KG / 12 * np.array([0.3**2 + 0.4**2, 0.3**2 + 0.4**2, 0.3**2 + 0.3**2])
    np.testing.assert_allclose(sorted(body.inertia), sorted(want), rtol=0.01)


def test_a_doors_leaf_lies_along_its_body(original, tmp_path):
    yaw = math.radians(30)
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    door = dataclasses.replace(original.annotations[1], category="door", pose=np.eye(4))
    door.pose[:3, :3], door.pose[:3, 3] = turn, (1.5, 1.2, 1.1)
    leaf = original.cads["basket-a"].vertices * [0.8 / 0.3, 0.04 / 0.3, 1.6 / 0.4]
    cads = original.cads | {"basket-a": dataclasses.replace(original.cads["basket-a"], vertices=leaf)}
    raw = dataclasses.replace(original, cads=cads, annotations=(original.annotations[0], door))
    read = read_interactive_gibson(write_released(raw, tmp_path / "doors"))
    annotation = read.annotations[0] if read.annotations[0].category == "door" else read.annotations[1]
    cad = read.cads[annotation.cad_id]
    np.testing.assert_allclose(np.ptp(cad.vertices, axis=0), (0.8, 0.04, 1.6), atol=1e-4)
    along = annotation.pose[:3, 0]
    assert abs(along @ turn[:, 0]) == pytest.approx(1.0, abs=1e-6)
    assert annotation.hinge is not None and annotation.hinge.assumed
    assert abs(annotation.hinge.origin[0]) == pytest.approx(0.4, abs=1e-4)  # at an end of the leaf


def test_the_assumed_hinge_hangs_on_the_wall_and_stops_at_it():
    leaf = np.array([(x, y, z) for x in (0.0, 0.8) for y in (-0.02, 0.02) for z in (0.0, 2.0)])
    heights = np.arange(0.3, 1.8, 0.05)
    # A wall along y through the leaf's far end x = 0.8 (the hinge), going both ways.
    wall = np.array([(0.85, y, z) for y in np.arange(-2, 2, 0.05) for z in heights])
    hinge = assume_hinge(leaf, np.eye(4), wall)
    np.testing.assert_allclose(hinge.origin, (0.8, 0.0, 0.0))
    low, high = hinge.range_rad
    assert math.radians(80) < high < math.radians(95) and math.radians(80) < -low < math.radians(95)
    # A wardrobe beside the door: seen from the hinge the leaf turns clockwise (towards +y) onto it after 45 degrees.
    box = np.array(
        [(0.8 - r * math.cos(a), r * math.sin(a), z) for a in (0.82, 0.85) for r in (0.4, 0.5) for z in heights]
    )
    low, high = assume_hinge(leaf, np.eye(4), np.vstack([wall, box])).range_rad
    assert -low == pytest.approx(0.82, abs=0.15) and math.radians(80) < high < math.radians(95)


def test_the_assumed_range_agrees_with_the_turned_leaf():
    """Independent of the angles' bookkeeping: turn the leaf to both ends of its range and a step beyond."""
    leaf = np.array([(x, y, z) for x in (0.0, 0.8) for y in (-0.02, 0.02) for z in (0.0, 2.0)])
    rng = np.random.default_rng(3)
    for _ in range(20):
        angle = rng.uniform(-math.pi, math.pi)
        middle = rng.uniform(0.3, 0.7) * np.array([math.cos(angle), math.sin(angle)])
        post = np.array([(*middle, z) for z in np.arange(0.3, 1.8, 0.1)])
        corner = np.array([(-0.05, y, z) for y in (-0.05, 0, 0.05) for z in np.arange(0.3, 1.8, 0.1)])
        hinge = assume_hinge(leaf, np.eye(4), np.vstack([post, corner]))
        assert hinge.origin[0] == 0.0
        for end, away in ((hinge.range_rad[0], -1), (hinge.range_rad[1], 1)):
            if abs(end) > math.radians(119):
                continue
            inside = []
            for turn in (end - away * 0.02, end + away * 0.1):
                c, s = math.cos(-turn), math.sin(-turn)
                x, y = c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]
                inside.append(0 < x < 0.82 and abs(y) < 0.04)
            assert inside == [False, True]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: (r / "pos_0_04379243.txt").unlink(), "pos_0_04379243.txt: no such file; expected x y z"),
        (lambda r: (r / "pos_0_04379243.txt").write_text("1 2\n"), "holds 2 numbers, expected x y z"),
        (lambda r: (r / "pos_0_04379243.txt").write_text("1 2 nan\n"), "all finite"),
        (lambda r: (r / "pos_0_04379243.txt").write_text("a b c\n"), "expected x y z in metres"),
        (lambda r: (r / TABLE).rename(r / "alignment_centered_0_123.urdf"), "category id is 123, expected one of"),
        (lambda r: (r / "0_04379243.obj").unlink(), "names the mesh '0_04379243.obj', which is not there"),
        (lambda r: (r / TABLE).write_text("<robot>"), "not readable as URDF"),
        (lambda r: (r / "floors.txt").unlink(), "floors.txt: no such file"),
    ],
)
def test_damage_is_named(released, change, words):
    change(released)
    with pytest.raises(SceneRejected, match=words):
        read_interactive_gibson(released)


def test_furniture_annotated_twice_is_taken_once(released):
    (released / "alignment_centered_7_04379243.urdf").write_text((released / TABLE).read_text())
    x, y, z = (float(v) for v in (released / "pos_0_04379243.txt").read_text().split())
    (released / "pos_7_04379243.txt").write_text(f"{x + 0.05} {y} {z}\n")
    raw = read_interactive_gibson(released)
    assert [a.category for a in raw.annotations] == ["table", "basket"]
    assert "table 7_04379243 stands in 0_04379243; it is left out" in raw.warnings


def test_furniture_outside_is_left_out(released):
    (released / "pos_1_02747177.txt").write_text("30 0 0.5\n")
    raw = read_interactive_gibson(released)
    assert [a.category for a in raw.annotations] == ["table"]
    assert any("outside the scan; it is left out" in w for w in raw.warnings)
    with pytest.raises(SceneRejected, match="--strict"):
        read_interactive_gibson(released, strict=True)


@pytest.mark.heavy
@pytest.mark.data
def test_original_objects_in_a_released_building(released, original, sample_data, tmp_path, hull_cache):
    """Files of the release itself: URDFs of four of its small objects, with their collision meshes, as furniture."""
    masses = {"2eZY2JqYPQE": 0.28980, "lGzQi2Pk5uC": 0.06756, "nPBvPYCdYgU": 0.69224, "RcqC01G24pR": 0.15587}
    source = sample_data / "interactive_gibson_objects"
    for path in source.iterdir():
        shutil.copy(path, released / path.name)
    taken = np.vstack([placed_vertices(original, a)[:, :2] for a in original.annotations])
    low, high = original.scan.vertices[:, :2].min(axis=0), original.scan.vertices[:, :2].max(axis=0)
    spots = [
        np.array((x, y)) for x in np.arange(low[0] + 0.5, high[0] - 0.4, 0.5) for y in (low[1] + 0.5, high[1] - 0.5)
    ]
    free = [s for s in spots if np.linalg.norm(taken - s, axis=1).min() > 0.5][:4]
    assert len(free) == 4 and original.floor_height_m is not None
    placed = {}
    for k, (name, spot) in enumerate(zip(masses, free, strict=True), start=5):
        (released / f"object_{name}.urdf").rename(released / f"alignment_centered_{k}_02747177.urdf")
        mesh = trimesh.load(released / f"model_{name}.obj", force="mesh")
        assert isinstance(mesh, trimesh.Trimesh)
        position = np.array([*spot, original.floor_height_m - mesh.bounds[0, 2]])
        (released / f"pos_{k}_02747177.txt").write_text(" ".join(map(str, position)))
        placed[f"{k}_02747177"] = (masses[name], position)
    assert detect_format(released) == "interactive-gibson"
    raw = read_interactive_gibson(released)
    assert {k: raw.cads[k].mass_kg for k in placed} == {k: pytest.approx(m, abs=1e-5) for k, (m, _) in placed.items()}
    converted = convert(released, tmp_path / "room", SMALL, cache=hull_cache)
    assert {g.name for g in converted.gates if not g.passed} == set()
    manifest = load_manifest(tmp_path / "room")
    assert [o.category for o in manifest.objects] == ["table"] + ["basket"] * 5
    assert set(placed) <= set(manifest.collision["from_source"])
    assert sum("names the texture" in w for w in manifest.warnings) == 4
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "room" / "scene.xml"))
    for item, row in zip(manifest.objects, manifest.alignment, strict=True):
        if item.cad_id not in placed:
            continue
        mass, _ = placed[item.cad_id]
        assert item.mass_kg == pytest.approx(mass, abs=1e-4) and item.friction == 1.0
        assert row["settle_shift_m"] < 0.02 and abs(row["settle_drop_m"]) < 0.02
        # The URDF's placeholder is 1 kg m2; nothing of this mass within 0.2 m of its middle has more than this.
        assert model.body(item.name).inertia.max() < mass * 0.2**2
