"""Pieces of a drawing: what overlaps is moved a little or built in; models of every kind, leaves, lamps, textures."""

from __future__ import annotations

import io
import math
import zipfile

import numpy as np
import pytest
from PIL import Image

from converters.geometry.faces import face_vectors
from converters.pipeline import ConvertConfig, Converted, convert
from converters.read.homes.sh3d import read_sh3d
from converters.read.meshes import colours_of_faces
from converters.records.errors import SceneRejected
from tests.converters.read.homes.test_sh3d import HOME, cuboid, piece, placed, seen, write_home

SMALL = ConvertConfig(structure_texture=64, object_texture=32, jobs=1)


@pytest.fixture(scope="module")
def crowded(tmp_path_factory, hull_cache) -> Converted:
    """A chest 4 cm deep in a wall, with a vase; a bookcase across a wall; a table and a bench 4 cm into it."""
    root = tmp_path_factory.mktemp("crowded")
    things = [
        piece("Chest of drawers", 300, 16, "80 40 70"),
        piece("Vase", 300, 20, "10 10 20", "elevation='70'"),
        piece("Bookcase", 0, 150, "30 100 180"),
        piece("Table", 200, 150, "80 60 70"),
        piece("Bench", 200, 190, "60 28 45"),
    ]
    return convert(write_home(root, [*HOME[:5], *things]), root / "out", SMALL, cache=hull_cache)


def test_what_overlaps_is_moved_a_little_and_told(crowded):
    rows = {row["cad_id"]: row for row in crowded.manifest.alignment}
    assert sorted(rows) == ["Bench_1", "Chest_of_drawers_1-Vase_1", "Table_1"]
    assert 0.035 < rows["Chest_of_drawers_1-Vase_1"]["settle_shift_m"] < 0.055
    apart = rows["Bench_1"]["settle_shift_m"], rows["Table_1"]["settle_shift_m"]
    assert sum(apart) == pytest.approx(0.04, abs=0.01) and min(apart) > 0.01
    assert {g.name for g in crowded.gates if not g.passed} == set()


def test_what_cannot_be_parted_is_built_in(crowded):
    (told,) = [w for w in crowded.manifest.warnings if "built in" in w]
    assert told == "Bookcase_1 cannot be parted from a wall, or what is built in, and is built in"
    # It stands in the way as it was drawn: 15 cm of it are in the room.
    boxes = crowded.settled.parts.walls
    corners = [b.centre + (b.half * s) @ b.rotation.T for b in boxes for s in np.array([(1, 1, 1), (1, -1, 1)])]
    assert any(c == pytest.approx([0.15, c[1], c[2]], abs=0.03) and -2.1 < c[1] < -0.9 for c in corners)


def test_a_leaf_that_stands_in_a_piece_stays_shut(tmp_path, hull_cache):
    blocked = write_home(tmp_path, [*HOME[:7], piece("Bookcase", 400, 230, "60 60 180")])
    made = convert(blocked, tmp_path / "out", SMALL, cache=hull_cache)
    assert made.manifest.objects == ()
    told = " ".join(w for w in made.manifest.warnings if "built in" in w)
    assert "Door_1_leaf_1 cannot be parted" in told and "Bookcase_1 cannot be parted" in told
    assert {g.name for g in made.gates if not g.passed} == set()


RAIL = f"g sweethome3d_opening_on_rail_1\n{cuboid((-45, 5, 25), (45, 45, 27), 8)}"
DRAWER = f"g body\n{cuboid((-50, 0, -25), (50, 50, 25))}{RAIL}"


def test_parts_of_a_model_are_moved_as_drawn(tmp_path):
    """A drawer pulled out by 20 cm of 72; what is not in the model, or no matrix, is told."""
    moved = "<transformation name='sweethome3d_rail_1' matrix='1 0 0 0 0 1 0 0 0 0 1 20'/>"
    other = "<transformation name='sweethome3d_rail_7' matrix='1 0 0 0 0 1 0 0 0 0 1 20'/>"
    path = write_home(
        tmp_path, [*HOME[:5], piece("Dresser", 200, 150, "100 72 50", "model='5'", moved + other)], {"5": DRAWER}
    )
    raw = read_sh3d(path)
    points = placed(raw, "Dresser")
    assert np.unique(points[:, 1].round(4)).tolist() == pytest.approx([-1.86, -1.84, -1.64, -1.14])
    assert any("has no part 'sweethome3d_rail_7'" in w for w in raw.warnings)
    assert "Dresser 1: its sliding or folding parts stay as drawn" in raw.warnings
    for matrix in ("1 0 0", "0 0 0 0 0 0 0 0 0 0 0 0", "nan 0 0 0 0 1 0 0 0 0 1 0"):
        bad = moved.replace("1 0 0 0 0 1 0 0 0 0 1 20", matrix)
        path = write_home(
            tmp_path, [*HOME[:5], piece("Dresser", 200, 150, "100 72 50", "model='5'", bad)], {"5": DRAWER}
        )
        with pytest.raises(SceneRejected, match="<pieceOfFurniture> Dresser: transformation is"):
            read_sh3d(path)


def test_back_faces_are_seen_too(tmp_path):
    """One quad, seen from its back as well."""
    sheet = "v -1 0 0\nv 1 0 0\nv 1 2 0\nv -1 2 0\nf 1 2 3\nf 1 3 4\n"
    things = [
        piece("Chair", 100, 150, "40 1 90", "model='5'"),
        piece("Stool", 300, 150, "40 1 90", "model='5' backFaceShown='true'"),
    ]
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], *things], {"5": sheet}))
    front, both = (next(c.surface for k, c in raw.cads.items() if k.startswith(n)) for n in ("Chair", "Stool"))
    assert front is not None and both is not None
    normals = [face_vectors(s.vertices, s.faces)[:, 1] / 2 for s in (front, both)]
    assert normals[0] == pytest.approx([-0.18, -0.18]) and sorted(normals[1]) == pytest.approx(
        [-0.18, -0.18, 0.18, 0.18]
    )


def test_a_model_without_leaves_gets_flat_ones(tmp_path):
    sash = "<sash xAxis='0.05' yAxis='0.5' width='0.9' startAngle='0' endAngle='-1.5707964'/>"
    door = piece("Door", 200, -5, "100 10 200", "color='FF102030'", sash, "doorOrWindow")
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], door]))
    leaf = placed(raw, "Door_1_leaf_1")
    assert leaf.min(axis=0) == pytest.approx([1.55, 0.03, 0.0]) and leaf.max(axis=0) == pytest.approx([2.45, 0.07, 2.0])
    (annotation,) = raw.annotations
    assert annotation.hinge is not None
    assert annotation.hinge.range_rad == pytest.approx((-math.pi / 2, 0.0))
    assert (annotation.pose[:3, :3] @ annotation.hinge.origin + annotation.pose[:3, 3]) == pytest.approx(
        [1.55, 0.05, 0.0]
    )
    assert "<doorOrWindow> Door: its model has no leaf of its own; flat leaves take its place" in raw.warnings


COLLADA = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><up_axis>Y_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="24">{numbers}</float_array><technique_common>
<accessor source="#a" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles>
</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def test_collada_and_3ds(tmp_path):
    """A wedge that is high at its rear (-z); of 3DS a box, and a word."""
    wedge = [(x, y * (2 if z < 0 else 1), z) for x in (-1, 1) for y in (0, 1) for z in (-1, 1)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = " ".join(f"{a} {b} {c} {a} {c} {d}" for a, b, c, d in quads)
    text = COLLADA.format(numbers=" ".join(str(v) for p in wedge for v in p), faces=faces)
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w") as archive:
        archive.writestr("w.dae", text)
    things = [
        piece("Chair", 100, 150, "40 50 90", "model='7/w.dae'"),
        piece("Stool", 300, 150, "40 50 60", "model='8/s.3ds'"),
    ]
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], *things], {"7": inner.getvalue(), "8/s.3ds": b"MM"}))
    chair, stool = placed(raw, "Chair"), placed(raw, "Stool")
    assert chair.min(axis=0) == pytest.approx([0.8, -1.75, 0.0]) and chair.max(axis=0) == pytest.approx(
        [1.2, -1.25, 0.9]
    )
    # Its rear is up in the plan.
    assert chair[chair[:, 2] > 0.5, 1].min() == pytest.approx(-1.25) and chair[
        chair[:, 1] < -1.5, 2
    ].max() == pytest.approx(0.45)
    assert np.ptp(stool, axis=0) == pytest.approx([0.4, 0.5, 0.6])
    assert any("is in the format .3ds, expected OBJ or COLLADA; a box stands for it" in w for w in raw.warnings)


def test_textures_on_pieces_and_on_their_materials(tmp_path):
    picture = io.BytesIO()
    Image.fromarray(np.full((2, 2, 3), (0, 0, 255), np.uint8)).save(picture, "PNG")
    texture = "<texture name='t' width='10' height='10' image='9'/>"
    things = [
        piece("Table", 100, 150, "40 40 70", "", texture),
        piece("Chair", 300, 150, "40 40 90", "model='1'", f"<material name='red'>{texture}</material>"),
    ]
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], *things], {"9": picture.getvalue()}))
    table, chair = (next(c.surface for k, c in raw.cads.items() if k.startswith(n)) for n in ("Table", "Chair"))
    assert table is not None and chair is not None
    assert {tuple(int(v) for v in c) for c in colours_of_faces(table)} == {(0, 0, 255)}
    high = chair.vertices[chair.faces, 2].mean(axis=1) > 0.5
    shown = colours_of_faces(chair)
    assert {tuple(int(v) for v in c) for c in shown[high]} == {(0, 0, 255)}
    # The faces of the back, and none of the seat's.
    assert (shown == (0, 0, 255)).all(axis=1).sum() == (shown == (255, 255, 255)).all(axis=1).sum() == 12


def test_a_room_drawn_around_another_leaves_a_hole(tmp_path):
    """A room's outline that crosses itself on a seam encloses a ring; the later room is seen where two overlap."""
    ring = ((0, 0), (400, 0), (400, 300), (0, 300), (0, 0), (100, 100), (100, 200), (300, 200), (300, 100), (100, 100))
    points = "".join(f"<point x='{x}' y='{y}'/>" for x, y in ring)
    outer = f"<room id='r' floorColor='FF102030' ceilingVisible='false'>{points}</room>"
    raw = read_sh3d(write_home(tmp_path, [*HOME[:4], outer]))
    assert seen(raw, (2.0, -1.5, 0.0), (0, 0, 1)) == () and seen(raw, (2.0, -0.5, 0.0), (0, 0, 1)) == (16, 32, 48)
    inner = HOME[4].replace("FF102030", "FF405060").replace("x='0'", "x='150'")
    raw = read_sh3d(write_home(tmp_path, [*HOME[:4], HOME[4], inner]))
    assert seen(raw, (1.0, -1.5, 0.0), (0, 0, 1)) == (16, 32, 48)
    assert seen(raw, (2.0, -1.5, 0.0), (0, 0, 1)) == (64, 80, 96)
