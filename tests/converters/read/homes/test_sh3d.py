"""A Sweet Home 3D drawing written here: the right way round, openings, leaves, what moves; bad ones in one line."""

from __future__ import annotations

import io
import math
import shutil
import time
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image

from converters.geometry.faces import face_areas, face_labels
from converters.pipeline import ConvertConfig, convert
from converters.read.homes import sh3d, sh3d_archive, sh3d_walls
from converters.read.homes.sh3d import kind_of, read_sh3d
from converters.read.homes.sh3d_archive import outline
from converters.read.meshes import colours_of_faces
from converters.read.obj import texels
from converters.read.source import detect_format, read_source
from converters.read.surfaces import split_storeys
from converters.records.errors import SceneRejected
from converters.records.raw import FLOOR, WALL, RawScene


def cuboid(low: tuple[float, ...], high: tuple[float, ...], first: int = 0) -> str:
    """Vertices and outward faces of a box in OBJ."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    faces = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    return "\n".join(lines + ["f " + " ".join(str(int(k) + first) for k in f.split()) for f in faces]) + "\n"


BOX = f"usemtl amber\n{cuboid((-1, 0, -1), (1, 2, 1))}"
# A seat, and a back at the chair's rear (-z), red; without an MTL.
CHAIR = (
    f"g seat\nusemtl flwhite1\n{cuboid((-1, 0, -1), (1, 1, 1))}"
    f"g back\nusemtl red\n{cuboid((-1, 1, -1), (1, 2, -0.8), 8)}"
)
DOOR = (
    f"g frame\nusemtl white\n{cuboid((-50, 200, -5), (50, 205, 5))}{cuboid((-50, 0, -5), (-46, 200, 5), 8)}"
    f"{cuboid((46, 0, -5), (50, 200, 5), 16)}"
    f"g sweethome3d_hinge_1\n{cuboid((-46, 90, 4), (-45, 95, 5), 24)}"
    f"g sweethome3d_opening_on_hinge_1_door\nusemtl amber\n{cuboid((-45, 0, 1), (45, 199, 5), 32)}"
)
SHAPES = {"0": BOX, "1": CHAIR, "2": DOOR}
COLOURS = "leftSideColor='FF00FF00' rightSideColor='FFFF0000'"


def wall(name: str, start: str, end: str, more: str = "", inner: str = "") -> str:
    (x0, y0), (x1, y1) = start.split(), end.split()
    ends = f"xStart='{x0}' yStart='{y0}' xEnd='{x1}' yEnd='{y1}'"
    return f"<wall id='{name}' {ends} height='250' thickness='10' {COLOURS} {more}>{inner}</wall>"


def joined(before: str, after: str) -> str:
    return f"wallAtStart='{before}' wallAtEnd='{after}'"


def piece(
    name: str, x: float, y: float, size: str, more: str = "", inner: str = "", tag: str = "pieceOfFurniture"
) -> str:
    width, depth, height = size.split()
    model = "" if "model=" in more else "model='0'"
    return (
        f"<{tag} id='p-{name}' name='{name}' x='{x}' y='{y}' width='{width}' depth='{depth}' height='{height}' "
        f"{model} {more}>{inner}</{tag}>"
    )


SASH = "<sash xAxis='0.05' yAxis='0.8' width='0.9' startAngle='0' endAngle='-1.5707964'/>"
ROOM = "".join(f"<point x='{x}' y='{y}'/>" for x, y in ((0, 0), (400, 0), (400, 300), (0, 300)))
HOME = [
    # Around clockwise as the plan shows it: the inner side is to the right.
    wall("north", "-5 -5", "405 -5", joined("west", "east")),
    wall("east", "405 -5", "405 305", joined("north", "south")),
    wall("south", "405 305", "-5 305", joined("east", "west")),
    wall("west", "-5 305", "-5 -5", joined("south", "north")),
    f"<room id='r' name='Room' floorColor='FF102030' ceilingColor='FFFFFFFF'>{ROOM}</room>",
    piece(
        "Window", 100, -5, "120 4 100", "catalogId='eTeks#window' elevation='90' cutOutShape='M0,0 v1 h1 v-1 z'",
        tag="doorOrWindow",
    ),
    piece(
        "Door", 405, 230, "100 10 205", "catalogId='eTeks#door' model='2' angle='1.5707964' movable='false'", SASH,
        "doorOrWindow",
    ),
    # In the upper right corner of the plan, turned clockwise by a quarter: its back, up in the plan, is to the right.
    piece("Chair", 350, 60, "40 50 90", "catalogId='eTeks#chair' model='1' angle='1.5707964'"),
    piece("Tisch", 100, 220, "80 60 70", "color='FF112233'"),
    piece("Vase", 110, 225, "10 10 20", "elevation='70'"),
    piece("Schrank", 30, 60, "60 120 200", "movable='false'"),
    "<furnitureGroup id='g' name='Gruppe' x='200' y='200' width='100' depth='100' height='100'>"
    + piece("Silla", 220, 150, "45 45 80", "model='1'")
    + piece("Thing", 250, 220, "30 30 30", "") + "</furnitureGroup>",
    piece("Lamp", 200, 150, "30 30 30", "elevation='210'", "<lightSource x='0' y='0' z='0'/>", "light"),
    piece("Ghost", 200, 150, "30 30 30", "visible='false'"),
    "<dimensionLine id='d' xStart='0' yStart='0' xEnd='1' yEnd='1' offset='1'/><label id='l' x='0' y='0'/>",
]  # fmt: skip


def document(elements: list[str]) -> str:
    return f"<?xml version='1.0'?><home version='6500' wallHeight='250'>{''.join(elements)}</home>"


def write_home(root: Path, elements: list[str] | None = None, files: dict[str, str | bytes] | None = None) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(root / "flat.sh3d", "w", zipfile.ZIP_DEFLATED) as archive:
        content = {"Home": b"\xac\xed", "Home.xml": document(HOME if elements is None else elements), **SHAPES}
        for name, data in (content | (files or {})).items():
            archive.writestr(name, data)
    return root / "flat.sh3d"


@pytest.fixture(scope="module")
def drawing(tmp_path_factory) -> Path:
    return write_home(tmp_path_factory.mktemp("sh3d"))


@pytest.fixture(scope="module")
def raw(drawing) -> RawScene:
    return read_source(drawing)


def placed(raw: RawScene, name: str) -> np.ndarray:
    """(n, 3) vertices in the home of what was called so."""
    annotation = next(a for a in raw.annotations if a.cad_id.startswith(name))
    return raw.cads[annotation.cad_id].vertices @ annotation.pose[:3, :3].T + annotation.pose[:3, 3]


def seen(raw: RawScene, at: tuple[float, float, float], towards: tuple[float, float, float]) -> tuple[int, ...]:
    """Colour of the structure's face at a place that looks some way, to 5 mm."""
    scan = raw.scan
    a, b, c = (scan.vertices[scan.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    offset = np.einsum("ij,ij->i", np.array(at) - a, normal)
    for k in np.flatnonzero((normal @ np.array(towards) > 0.99) & (np.abs(offset) < 0.005)):
        axes = np.argsort(np.abs(normal[k]))[:2]
        if (
            shapely.Polygon(scan.vertices[scan.faces[k]][:, axes])
            .buffer(1e-6)
            .contains(shapely.Point(np.array(at)[axes]))
        ):
            assert scan.texture is not None and scan.corner_uv is not None
            return tuple(int(v) for v in texels(scan.texture, scan.corner_uv[k].mean(axis=0)[None])[0])
    return ()


def test_it_is_found_and_named(drawing, raw):
    assert detect_format(drawing.parent) == "sh3d"
    assert (raw.name, raw.source_format, list(raw.sources)) == ("flat", "sh3d", ["flat.sh3d"])
    assert raw.floor_height_m == 0.0 and raw.storeys == ()


def test_the_name_that_a_download_gives_it_is_read_too(drawing, raw, tmp_path):
    path = shutil.copy(drawing, tmp_path / "flat.sh3d.zip")
    again = read_source(path)
    assert (again.name, set(again.sources.values())) == (raw.name, set(raw.sources.values()))


def test_the_plan_is_the_right_way_round(raw):
    """Right stays right, and what is up in the plan is at the larger y."""
    chair = placed(raw, "Chair")
    assert (chair.min(axis=0) + chair.max(axis=0))[:2] / 2 == pytest.approx([3.5, -0.6], abs=1e-6)
    assert np.ptp(chair, axis=0) == pytest.approx([0.5, 0.4, 0.9])
    # A quarter clockwise: the back of the model looked up in the plan, and is to the right now.
    assert chair[chair[:, 2] > 0.5, 0].min() == pytest.approx(3.7)
    assert raw.scan.vertices.min(axis=0)[:2] == pytest.approx([-0.1, -3.1])
    assert raw.scan.vertices.max(axis=0)[:2] == pytest.approx([4.1, 0.1])


def test_walls_have_sides_and_openings(raw):
    green, red = (0, 255, 0), (255, 0, 0)
    assert seen(raw, (3.0, 0.0, 1.2), (0, -1, 0)) == red  # north, from within
    assert seen(raw, (3.0, 0.1, 1.2), (0, 1, 0)) == green  # and from without
    for at, there in (((1.0, 0.0, 1.4), ()), ((1.0, 0.0, 0.8), red), ((1.0, 0.0, 2.0), red), ((1.7, 0.0, 1.4), red)):
        assert seen(raw, at, (0, -1, 0)) == there
    assert seen(raw, (1.0, 0.05, 0.9), (0, 0, 1)) == red  # the sill
    assert seen(raw, (4.0, -2.3, 1.0), (-1, 0, 0)) == () and seen(raw, (4.0, -2.3, 2.2), (-1, 0, 0)) == red
    assert seen(raw, (2.0, -1.5, 0.0), (0, 0, 1)) == (16, 32, 48)
    assert seen(raw, (4.05, -2.3, 0.0), (0, 0, 1)) == (16, 32, 48)  # a doorway has a floor
    assert seen(raw, (2.0, -1.5, 2.5), (0, 0, -1)) == (255, 255, 255)


def test_labels_and_what_moves(raw):
    areas = face_areas(raw.scan.vertices, raw.scan.faces)
    labels = face_labels(raw.scan.labels, raw.scan.faces)
    assert areas[labels == FLOOR].sum() == pytest.approx(12.0, abs=0.3)
    assert areas[labels == WALL].sum() > 25
    found = {a.cad_id: a.category for a in raw.annotations}
    assert found == {
        "Door_1_leaf_1": "door", "Chair_1": "chair", "Tisch_1-Vase_1": "table", "Silla_1": "chair", "Thing_1": "other",
    }  # fmt: skip
    assert placed(raw, "Tisch")[:, 2].max() == pytest.approx(0.9)
    assert "1 pieces that are hidden: dropped" in raw.warnings and "1 labels: dropped" in raw.warnings


def test_a_leaf_swings_about_its_sash(raw):
    leaf = next(a for a in raw.annotations if a.category == "door")
    assert leaf.hinge is not None and not leaf.hinge.assumed
    # The door is turned a quarter clockwise: its left, where the hinge is, is up in the plan.
    assert (leaf.pose[:3, :3] @ leaf.hinge.origin + leaf.pose[:3, 3])[:2] == pytest.approx([4.02, -1.85])
    # -90 degrees is towards the door's front, to the left in the plan: from shut it turns clockwise as seen from above.
    assert leaf.hinge.range_rad == pytest.approx((-math.pi / 2, 0.0), abs=0.05)
    assert np.ptp(placed(raw, "Door"), axis=0) == pytest.approx([0.04, 0.9, 1.99], abs=1e-3)


def test_leaves_of_a_double_door_part_in_the_middle(tmp_path):
    model = "".join(
        f"g sweethome3d_opening_on_hinge_{k}\n{cuboid((low, 0, z), (high, 200, z + 4), first)}"
        for k, low, high, z, first in ((1, -50, 3, 0, 0), (2, -3, 50, 2, 8))
    )
    sashes = "".join(
        f"<sash xAxis='{x}' yAxis='0.5' width='0.5' startAngle='{a}' endAngle='{b}'/>"
        for x, a, b in ((0, 0, -math.pi / 2), (1, math.pi, 3 * math.pi / 2))
    )
    double = piece("Double", 200, -5, "100 6 200", "model='5'", sashes, "doorOrWindow")
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], double], {"5": model}))
    leaves = [placed(raw, f"Double_1_leaf_{k}") for k in (1, 2)]
    assert leaves[0][:, 0].min() == pytest.approx(1.5) and leaves[1][:, 0].max() == pytest.approx(2.5)
    assert (leaves[0][:, 0].max(), leaves[1][:, 0].min()) == pytest.approx((1.988, 2.012))
    spans = [a.hinge.range_rad for a in raw.annotations if a.hinge is not None]
    assert spans == [pytest.approx((-math.pi / 2, 0), abs=0.1), pytest.approx((0, math.pi / 2), abs=0.1)]


def test_a_leaf_that_is_drawn_ajar_turns_both_ways(tmp_path):
    swing = "<sash xAxis='0.05' yAxis='0.8' width='0.9' startAngle='0.7' endAngle='-0.9'/>"
    ajar = piece(
        "Door", 405, 230, "100 10 205", "catalogId='eTeks#door' model='2' angle='1.5707964'", swing, "doorOrWindow"
    )
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], ajar]))
    assert [a.hinge.range_rad for a in raw.annotations if a.hinge] == [pytest.approx((-0.9, 0.7), abs=0.05)]


def test_colours_are_the_drawings(raw):
    def colours(name: str) -> set[tuple[int, ...]]:
        surface = next(c.surface for k, c in raw.cads.items() if k.startswith(name))
        return {tuple(int(v) for v in c) for c in colours_of_faces(surface)}

    assert colours("Chair") == {(255, 255, 255), (197, 0, 0)}  # names that no file explains
    assert (17, 34, 51) in colours("Tisch")


@pytest.mark.parametrize(
    ("catalogue_id", "name", "height", "category"),
    [
        ("eTeks#chair", "Chaise", 0.9, "chair"), ("", "Chaise de bureau", 0.9, "chair"),
        ("", "Bürostuhl", 0.9, "chair"),
        ("eTeks#squareTable", "Table", 0.4, "coffee_table"), ("eTeks#texturableBox", "Box", 1.0, "structure"),
        ("eTeks#tvUnit", "Meuble", 0.4, "tv_bench"), ("eTeks#bed90x190", "", 0.5, "bed"), ("", "Fenêtre", 1.0, "other"),
        ("eTeks#kitchenUpperCabinet", "Cabinet", 0.8, "shelf"), ("eTeks#curveStaircase", "Stairs", 2.6, "structure"),
        ("", "Kleiderschrank", 2.0, "wardrobe"), ("", "Canapé", 0.8, "sofa"), ("", "Frigorífico", 1.8, "fridge"),
    ],
)  # fmt: skip
def test_categories(catalogue_id, name, height, category):
    assert kind_of(catalogue_id, name, height) == category


def test_round_and_sloping_walls(tmp_path):
    arc = wall("arc", "100 100", "300 100", f"arcExtent='{math.pi}'")
    slope = wall("slope", "50 250", "350 250", "heightAtEnd='50'")
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], arc, slope]))
    points = raw.scan.vertices
    # A half circle about (2, -1) that bulges to the left: up in the plan.
    ring = points[np.abs(np.hypot(points[:, 0] - 2, points[:, 1] + 1) - 1) < 0.0505]
    assert len(ring) > 100 and ring[:, 1].min() > -1.06 and ring[:, 1].max() == pytest.approx(0.05, abs=0.01)
    low, high = (points[np.abs(points - [x, -2.45, 0])[:, :2].max(axis=1) < 1e-6, 2].max() for x in (3.5, 0.5))
    assert (low, high) == pytest.approx((0.5, 2.5))


def test_pieces_are_turned_mirrored_and_tilted(tmp_path):
    raw = read_sh3d(
        write_home(
            tmp_path,
            [
                *HOME[:5],
                piece("Hocker", 100, 100, "40 20 60", "model='1' modelRotation='0 0 1 0 1 0 -1 0 0'"),
                piece("Sofa", 300, 100, "40 20 60", "model='3' modelMirrored='true'"),
                piece("Stuhl", 200, 200, "40 40 100", f"pitch='{math.pi / 2}'"),
            ],
            {"3": f"{cuboid((0, 0, 0), (1, 1, 1))}{cuboid((0, 1, 0), (0.2, 2, 1), 8)}"},
        )
    )
    # A turn about the vertical that takes the rear to the left.
    stool, sofa, chair = (placed(raw, name) for name in ("Hocker", "Sofa", "Stuhl"))
    assert np.ptp(stool, axis=0) == pytest.approx([0.4, 0.2, 0.6])
    assert stool[stool[:, 2] > 0.4, 0].max() == pytest.approx(0.8 + 0.04)
    assert sofa[sofa[:, 2] > 0.4, 0].min() == pytest.approx(3.2 - 0.08)
    assert np.ptp(chair, axis=0) == pytest.approx([0.4, 1.0, 0.4]) and chair[:, 2].min() == pytest.approx(0.0)


def test_levels_become_storeys_and_stairs_a_shaft(tmp_path):
    levels = "".join(
        f"<level id='{k}' name='{k}' elevation='{z}' floorThickness='12' height='250' {more}/>"
        for k, z, more in (("low", 0, ""), ("high", 262, ""), ("attic", 524, "visible='false'"))
    )
    both = [
        e.replace("<wall ", f"<wall level='{k}' ").replace("<room ", f"<room level='{k}' ")
        for k in ("low", "high", "attic") for e in HOME[:5]
    ]  # fmt: skip
    stairs = piece(
        "Stairs", 50, 150, "100 200 250", "level='low' staircaseCutOutShape='M0,0 v1 h1 v-1 z' movable='false'"
    )
    chair = piece("Chair", 300, 100, "40 40 90", "level='high' model='1'")
    raw = read_sh3d(write_home(tmp_path, [levels, *both, stairs, chair]))
    assert [s.height_m for s in raw.storeys] == pytest.approx([0, 2.62])
    assert seen(raw, (0.5, -1.5, 2.62), (0, 0, 1)) == () and seen(raw, (2.0, -1.5, 2.62), (0, 0, 1)) == (16, 32, 48)
    low, high = split_storeys(raw)
    assert [len(s.annotations) for s in (low, high)] == [0, 1]
    assert high.scan.vertices[:, 2].min() > -0.1 and min(v[:, 2].min() for v, _ in high.picture) > -0.1
    assert max(v[:, 2].max() for v, _ in low.picture) < 2.7
    assert any("hidden" in w for w in raw.warnings)


def test_attributes_and_keywords_that_are_not_read_are_reported_and_shelves_are_read(tmp_path):
    texture = "<texture attribute='floorTexture' name='t' width='1' height='1' angle='0.7' image='no'/>"
    shelf = piece("Regal", 200, 150, "60 30 180", "model='7' shelfElevations='0.1 0.5'", tag="shelfUnit")
    elements = [*HOME[:4], HOME[4].replace("</room>", f"{texture}</room>"), shelf, "<carpet/>"]
    raw = read_sh3d(write_home(tmp_path, elements, {"7": cuboid((0, 0, 0), (1, 1, 1)) + "curv 0 1 1 2\n"}))
    assert [w for w in raw.warnings if "not read" in w or "not used" in w] == [
        "the drawing: 1 x <carpet> in <home>: not read", "the drawing: 1 x angle= of <texture>: not read",
        "7: not used: 1 curv",
    ]  # fmt: skip
    assert np.ptp(placed(raw, "Regal"), axis=0) == pytest.approx([0.6, 0.3, 1.8])


def test_a_texture_is_repeated_by_its_size(tmp_path):
    picture = io.BytesIO()
    Image.fromarray(np.array([[(255, 0, 0), (0, 0, 255)]], np.uint8)).save(picture, "PNG")
    texture = "<texture attribute='floorTexture' name='t' width='100' height='100' image='9'/>"
    room = HOME[4].replace("</room>", f"{texture}</room>")
    raw = read_sh3d(write_home(tmp_path, [*HOME[:4], room], {"9": picture.getvalue()}))
    scan = raw.scan
    assert scan.texture is not None and scan.corner_uv is not None
    level = np.flatnonzero((scan.vertices[scan.faces, 2] == 0).all(axis=1))
    middle = scan.vertices[scan.faces[level]]
    for weights in (np.array([0.6, 0.3, 0.1]), np.array([0.1, 0.2, 0.7])):
        at = np.einsum("k,nkd->nd", weights, middle)[:, 0] % 1.0
        shown = texels(scan.texture, np.einsum("k,nkd->nd", weights, scan.corner_uv[level]))
        sure = (np.abs(at - 0.5) > 0.02) & (np.abs(at - 0.5) < 0.48)
        assert sure.sum() > 10 and ((shown[:, 2] > 128) == (at > 0.5))[sure].all()


def test_a_drawing_without_rooms_has_a_floor(tmp_path):
    raw = read_sh3d(write_home(tmp_path, HOME[:4]))
    assert seen(raw, (2.0, -1.5, 0.0), (0, 0, 1)) == (235, 235, 230)


def test_what_walls_enclose_without_a_room_is_floor_on_the_ground(tmp_path):
    parted = [*HOME[:4], wall("middle", "255 0", "255 300"), HOME[4].replace("x='400'", "x='245'")]
    raw = read_sh3d(write_home(tmp_path, parted))
    assert seen(raw, (1.0, -1.5, 0.0), (0, 0, 1)) == (16, 32, 48)
    assert seen(raw, (3.0, -1.5, 0.0), (0, 0, 1)) == (235, 235, 230)
    assert "4.2 m2 within walls are in no room: taken for floor" in raw.warnings
    levels = "".join(f"<level id='{k}' elevation='{z}' height='250'/>" for k, z in (("low", 0), ("high", 262)))
    both = [
        e.replace("<wall ", f"<wall level='{k}' ").replace("<room ", f"<room level='{k}' ")
        for k in ("low", "high") for e in parted
    ]  # fmt: skip
    raw = read_sh3d(write_home(tmp_path, [levels, *both]))
    assert seen(raw, (1.0, -1.5, 2.62), (0, 0, 1)) == (16, 32, 48)
    assert seen(raw, (3.0, -1.5, 2.62), (0, 0, 1)) == () and seen(raw, (3.0, -1.5, 0.0), (0, 0, 1)) != ()


def test_a_foundation_below_the_ground_floor_has_no_floor(tmp_path):
    levels = "".join(f"<level id='{k}' elevation='{z}' height='250'/>" for k, z in (("base", 0), ("ground", 124)))
    walls = [e.replace("<wall ", "<wall level='base' ") for e in HOME[:4]]
    walls += [e.replace("<wall ", "<wall level='ground' ") for e in HOME[:4]]
    raw = read_sh3d(write_home(tmp_path, [levels, *walls, HOME[4].replace("<room ", "<room level='ground' ")]))
    assert raw.floor_height_m == pytest.approx(1.24)
    assert seen(raw, (2.0, -1.5, 1.24), (0, 0, 1)) == (16, 32, 48) and seen(raw, (2.0, -1.5, 0.0), (0, 0, 1)) == ()


def test_pieces_that_stand_far_apart_are_refused(tmp_path):
    far = wall("far", "990000 0", "990300 0")
    assert "expected a building of at most 100 m" in refusal(write_home(tmp_path, [*HOME[:5], far]))


def test_outlines():
    half = outline("M0,1 a0.5,0.997 0 1,1 1,0 z")
    assert half is not None and half.min() > -0.01 and half[:, 1].min() == pytest.approx(0.0, abs=0.05)
    assert outline("M0,0 v1 h1 v-1 z") == pytest.approx(np.array([(0, 0), (0, 1), (1, 1), (1, 0)]))
    bowed = outline(
        "m0 0 q.5,1 1,0 V1 H0 Z m.2 .2h.1"
    )  # y = 2 x (1 - x), in nine steps; the second outline is not read
    assert bowed is not None and len(bowed) == 12
    assert bowed[:10, 1] == pytest.approx(2 * bowed[:10, 0] * (1 - bowed[:10, 0])) and bowed[10:].tolist() == [
        [1, 1],
        [0, 1],
    ]
    for unreadable in ("nonsense", None, "M0,0 L", "M0,0 h1 v99 z", "M0,0 L1e999,1 0,1", "M0,0 h1 z"):
        assert outline(unreadable) is None, unreadable


def test_it_converts(drawing, tmp_path, hull_cache):
    made = convert(drawing, tmp_path / "out", ConvertConfig(structure_texture=64, object_texture=32), cache=hull_cache)
    assert {g.name for g in made.gates if not g.passed} == set()
    assert [o.category for o in made.manifest.objects].count("chair") == 2


NESTED = io.BytesIO()
with zipfile.ZipFile(NESTED, "w") as _archive:
    _archive.writestr("deep/chair.obj", CHAIR)


def test_a_model_in_an_archive_of_its_own(tmp_path):
    things = [
        piece("Chair", 100, 100, "40 40 90", "model='7'"),
        piece("Stool", 200, 100, "40 40 60", "model='7/deep/chair.obj'"),
    ]
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], *things], {"7": NESTED.getvalue()}))
    assert [len(raw.cads[a.cad_id].faces) for a in raw.annotations] == [24, 24]


@pytest.mark.parametrize("model", ["model='gone'", "model='../../etc/passwd'", "model='8'", "model=''"])
def test_a_missing_model_is_a_box_and_told(tmp_path, model):
    path = write_home(tmp_path, [*HOME[:5], piece("Chair", 200, 100, "40 50 90", model)], {"8": "v 0 0 0\nf 1 2 3\n"})
    raw = read_sh3d(path)
    assert np.ptp(placed(raw, "Chair"), axis=0) == pytest.approx([0.4, 0.5, 0.9])
    (warning,) = [w for w in raw.warnings if "a box stands for it" in w]
    assert str(tmp_path) not in warning and "/tmp" not in warning
    with pytest.raises(SceneRejected, match="--strict refuses"):
        read_sh3d(path, strict=True)


def bomb() -> bytes:
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(5):
            archive.writestr(f"{k}.obj", bytes(1 << 20))
    return inner.getvalue()


def refusal(path: Path) -> str:
    started = time.monotonic()
    with pytest.raises(SceneRejected) as caught:
        read_source(path)
    assert time.monotonic() - started < 20
    text = str(caught.value)
    assert "\n" not in text and text.startswith(str(path)) and "sh3d-" not in text
    return text


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        ([HOME[0].replace("'-5'", "'nan'", 1), *HOME[1:5]], "xStart is 'nan', expected a number"),
        ([*HOME[:5], piece("Chair", 1e9, 0, "40 40 90")], "x is '1000000000.0', expected a number"),
        ([*HOME[:5], piece("Chair", 0, 0, "-40 40 90")], "cm large"),
        ([*HOME[:5], piece("Chair", 0, 0, "40 40 90", "level='no'")], "names a level that is not there"),
        ([*HOME[:5], piece("Chair", 0, 0, "40 40 90", "modelRotation='1 2 3'")], "modelRotation is no rotation"),
        ([*HOME[:5], *(piece("Chair", k, 0, "4 4 9") for k in range(10_000))], "10,004 walls and pieces"),
        ([HOME[0]], "has no room and no closed walls"),
        ([], "has no room and no closed walls"),
        (["<room id='r'><point x='0' y='0'/><point x='9' y='0'/></room>"], "has no room and no closed walls"),
    ],
)  # fmt: skip
def test_bad_drawings(tmp_path, elements, words):
    assert words in refusal(write_home(tmp_path, elements))


def test_a_wall_without_length_and_an_open_room_are_left_out(tmp_path):
    point, line = wall("dot", "100 100", "100 100"), "<room id='q' name='Strip'><point x='0' y='0'/></room>"
    raw = read_sh3d(write_home(tmp_path, [*HOME[:5], point, line]))
    assert [w for w in raw.warnings if "left out" in w] == [
        "<wall> dot: has no length or height; it is left out",
        "<room> Strip: its outline encloses nothing; it is left out",
    ]


def test_a_wall_shorter_than_its_neighbours_are_thick_is_read(tmp_path):
    """The mitres of a pier of 5 cm between walls of 20 cm cross each other."""
    pier = [
        wall("a", "0 0", "0 150", joined("d", "b")), wall("b", "0 150", "5 154", joined("a", "c")),
        wall("c", "5 154", "5 300", joined("b", "e")), wall("e", "5 300", "400 300", joined("c", "f")),
        wall("f", "400 300", "400 0", joined("e", "d")), wall("d", "400 0", "0 0", joined("f", "a")),
    ]  # fmt: skip
    raw = read_sh3d(write_home(tmp_path, [e.replace("thickness='10'", "thickness='20'") for e in pier]))
    areas = face_areas(raw.scan.vertices, raw.scan.faces)
    assert areas[face_labels(raw.scan.labels, raw.scan.faces) == FLOOR].sum() == pytest.approx(3.78 * 2.8, abs=0.15)
    corners = [w.corners for w in sh3d_walls.read_walls([ElementTree.fromstring(e) for e in pier], {None: 0.0}, print)]
    assert all(((c[:, 1] - c[:, 0]) @ (c[0, 1] - c[0, 0]) >= 0).all() for c in corners)


def test_walls_without_thickness_are_thin_and_rooms_that_cross_themselves_keep_all_parts(tmp_path):
    thin = HOME[0].replace("thickness='10'", "thickness='0'")
    bow = "".join(f"<point x='{x}' y='{y}'/>" for x, y in ((0, 0), (400, 300), (400, 0), (0, 300)))
    raw = read_sh3d(write_home(tmp_path, [thin, *HOME[1:4], f"<room id='r' floorColor='FF102030'>{bow}</room>"]))
    assert "<wall> north: has no thickness; 1 cm is taken" in raw.warnings
    assert seen(raw, (0.5, -1.5, 0.0), (0, 0, 1)) == seen(raw, (3.5, -1.5, 0.0), (0, 0, 1)) == (16, 32, 48)
    assert seen(raw, (2.0, -0.5, 0.0), (0, 0, 1)) == () and seen(raw, (3.0, -0.055 + 0.1, 1.2), (0, -1, 0)) != ()


@pytest.mark.parametrize(
    ("ends", "more"), [(("0 0", "90000 0"), ""), (("0 0", "300 0"), f"arcExtent='{2 * math.pi - 1e-4}'")]
)
def test_walls_that_are_larger_than_a_building_are_named(tmp_path, ends, more):
    assert refusal(write_home(tmp_path, [*HOME, wall("far", ends[0], ends[1], more)])).endswith(
        "<wall> far: is larger than 100 m; mend the drawing"
    )


@pytest.mark.parametrize("name", ["../../evil", "/evil", "a/../../evil", "a\\..\\evil"])
def test_nothing_is_written_outside(tmp_path, name):
    path = write_home(tmp_path / "in", files={name: b"x"})
    assert "leads out of it" in refusal(path)
    assert not list(tmp_path.rglob("evil"))


def test_bombs_entities_and_old_files(tmp_path, monkeypatch):
    for module in (sh3d, sh3d_archive):
        monkeypatch.setattr(module, "UNPACKED", 4 << 20)
    assert "bytes once unpacked" in refusal(
        write_home(tmp_path / "a", files={str(k): bytes(1 << 20) for k in range(5)})
    )
    nested = write_home(tmp_path / "b", [*HOME[:5], piece("Chair", 1, 1, "40 40 90", "model='7'")], {"7": bomb()})
    assert any("bytes once unpacked" in w for w in read_sh3d(nested).warnings)
    entity = "<!DOCTYPE home [<!ENTITY a 'aa'>]><home/>"
    assert "it declares entities" in refusal(write_home(tmp_path / "c", files={"Home.xml": entity}))
    old = tmp_path / "old.sh3d"
    with zipfile.ZipFile(old, "w") as archive:
        archive.writestr("Home", b"\xac\xed\0\5")
    assert "open it in Sweet Home 3D 5.3 or later and save it again" in refusal(old)
    whole = write_home(tmp_path / "d").read_bytes()
    for k, data in enumerate((whole[: len(whole) // 2], b"", b"not a zip")):
        (tmp_path / f"{k}.sh3d").write_bytes(data)
        assert "not readable as a Sweet Home 3D file" in refusal(tmp_path / f"{k}.sh3d")
