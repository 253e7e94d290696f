"""A scene drawn for Sweet Home 3D, read and converted again."""

import shutil
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest
import shapely
import trimesh
from scipy.spatial import KDTree

from converters.__main__ import main
from converters.pipeline import ConvertConfig, convert
from converters.read.homes.sh3d import kind_of, read_sh3d
from converters.read.homes.sh3d_archive import point
from converters.write.sh3d import export_sh3d
from converters.write.sh3d_rooms import Wall, merged_walls
from interactive_nav_common.rotations import matrix_from_quat, yaw_from_quat
from scenes_mjcf.schema import CATEGORIES, load_manifest, load_maps
from tests.converters.read.homes.test_drawn_lamps import PLAIN
from tests.converters.read.homes.test_sh3d import piece, write_home

SMALL = ConvertConfig(structure_texture=64, object_texture=32)
HOME = Path(__file__).parents[3] / "scenes_mjcf" / "apartment_0"
DRAWN = HOME.parent / "drawn" / "flat"
"""The example of the tutorial, beside its drawing."""
CUT_M = 1.05


@pytest.fixture(scope="module")
def drawing(tmp_path_factory) -> Path:
    """A committed home with two doors, drawn."""
    path = tmp_path_factory.mktemp("drawn") / "apartment.sh3d"
    told = export_sh3d(HOME, path)
    assert told[0] == "36 walls, 4 rooms, 2 doors, 0 windows, 7 other objects"
    return path


def of_scene(folder: Path) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(folder / "scene.xml"))


def footprint(folder: Path) -> shapely.Geometry:
    """Of the wall boxes that are higher than `CUT_M`."""
    boxes = [g for g in of_scene(folder).geoms if g.name.startswith("wall_") and g.pos[2] + g.size[2] > CUT_M]
    return shapely.union_all([shapely.box(*(g.pos - g.size)[:2], *(g.pos + g.size)[:2]) for g in boxes])


def seen(folder: Path, name: str) -> trimesh.Trimesh:
    """Return a body's visual mesh, in the world."""
    body = of_scene(folder).body(name)
    mesh = trimesh.load_mesh(folder / "assets" / f"{name}_visual.obj", process=False)
    return trimesh.Trimesh(mesh.vertices @ matrix_from_quat(np.array(body.quat)).T + body.pos, mesh.faces)


def apart(first: trimesh.Trimesh, second: trimesh.Trimesh) -> float:
    """Return how far the vertices of one of two surfaces are at most from the other surface, m.

    Not from its vertices: a mesh that comes back may be divided into other triangles.
    """
    return max(trimesh.proximity.closest_point(a, b.vertices)[1].max() for a, b in ((first, second), (second, first)))


def test_every_piece_stands_where_it_stood(drawing):
    raw, objects = read_sh3d(drawing), load_manifest(HOME).objects
    assert sorted(a.category for a in raw.annotations) == sorted(o.category for o in objects)
    for thing in objects:
        world = seen(HOME, thing.name)
        found = [
            apart(trimesh.Trimesh(surface.vertices @ a.pose[:3, :3].T + a.pose[:3, 3], surface.faces), world)
            for a in raw.annotations
            if a.category == thing.category and (surface := raw.cads[a.cad_id].surface) is not None
        ]
        assert min(found) < 0.002, thing.name


def test_walls_and_doorways_are_the_scenes(drawing):
    raw, stands = read_sh3d(drawing), footprint(HOME)
    segments = trimesh.intersections.mesh_plane(
        trimesh.Trimesh(raw.scan.vertices, raw.scan.faces, process=False), [0, 0, 1], [0, 0, CUT_M]
    )
    lines = shapely.union_all(shapely.linestrings(np.asarray(segments)[:, :, :2]))
    outline = shapely.points(shapely.get_coordinates(stands.boundary.segmentize(0.1)))
    assert shapely.distance(outline, lines).max() < 0.01
    # The bars of a frame fill the steps of a wall that tapers towards its doorway.
    assert shapely.difference(lines, stands.buffer(0.01)).length < 1.0 and stands.buffer(0.11).covers(lines)


def test_leaves_turn_as_far_to_the_same_side(drawing):
    raw = read_sh3d(drawing)
    for k in (0, 1):
        body = of_scene(HOME).body(f"door_{k}")
        turn = matrix_from_quat(np.array(body.quat))
        pin = (turn @ body.joints[0].pos + body.pos)[:2]
        ends = [a for a in raw.annotations if a.hinge is not None]
        off = [np.linalg.norm((a.pose[:3, :3] @ a.hinge.origin + a.pose[:3, 3])[:2] - pin) for a in ends if a.hinge]
        hinge = ends[int(np.argmin(off))].hinge
        assert min(off) < 0.002 and hinge is not None
        assert hinge.range_rad == pytest.approx(body.joints[0].range, abs=0.1)
        pose = ends[int(np.argmin(off))].pose
        assert np.hypot(*(pose[:2, 0] - turn[:2, 0])) < 0.1, f"door_{k}: its frame is turned, not only the leaf"


def test_hulls_come_back_in_their_pieces(drawing):
    raw, spec = read_sh3d(drawing), of_scene(HOME)
    for thing in load_manifest(HOME).objects:
        body = spec.body(thing.name)
        own = [spec.mesh(g.meshname).file for g in body.geoms if g.name.startswith(f"{thing.name}_hull_")]
        points = np.vstack([trimesh.load_mesh(HOME / "assets" / f, process=False).vertices for f in own])
        points = points @ matrix_from_quat(np.array(body.quat)).T + body.pos
        found = []
        for a in raw.annotations:
            pieces = raw.cads[a.cad_id].pieces
            assert pieces is not None
            if a.category == thing.category and len(pieces) == len(own):
                again = np.vstack([p for p, _ in pieces]) @ a.pose[:3, :3].T + a.pose[:3, 3]
                ends, old = (np.array([p.min(axis=0), p.max(axis=0)]) for p in (again, points))
                found.append(max(np.abs(ends - old).max(), KDTree(points).query(again)[0].max()))
        assert min(found) < 0.002, thing.name


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_reader_knows_every_category(category):
    assert kind_of(f"interactive_nav#{category}", "thing", 0.3) == category


def test_a_scene_comes_back(tiny_scene, tmp_path, hull_cache):
    assert main(["export", str(tiny_scene[0]), str(tmp_path / "tiny.sh3d")]) == 0
    back = convert(tmp_path / "tiny.sh3d", tmp_path / "back", SMALL, cache=hull_cache)
    assert {g.name for g in back.gates if not g.passed} == set()
    own, again = (sorted(load_manifest(f).objects, key=lambda o: o.name) for f in (tiny_scene[0], tmp_path / "back"))
    assert [o.name for o in again] == [o.name for o in own]
    for thing in own:
        before, after = (of_scene(f).body(thing.name) for f in (tiny_scene[0], tmp_path / "back"))
        assert np.linalg.norm(np.array(before.pos) - after.pos) < 0.01
        turn = matrix_from_quat(np.array(before.quat)).T @ matrix_from_quat(np.array(after.quat))
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 1
    maps = [load_maps(folder) for folder in (tiny_scene[0], tmp_path / "back")]
    assert np.array_equal(maps[0].traversable, maps[1].traversable) and maps[0].origin_w == maps[1].origin_w
    assert footprint(tiny_scene[0]).symmetric_difference(footprint(tmp_path / "back")).area < 1e-6


@pytest.mark.heavy
@pytest.mark.parametrize(("name", "rooms"), [("elm", 7)])
def test_a_generated_home_comes_back_piece_by_piece(tmp_path, hull_cache, name, rooms):
    home = HOME.parent / name
    told = export_sh3d(home, tmp_path / "home.sh3d")
    assert f", {rooms} rooms," in told[0]
    back = convert(tmp_path / "home.sh3d", tmp_path / "back", SMALL, cache=hull_cache)
    assert {g.name for g in back.gates if not g.passed} == set()
    own, again = load_manifest(home).objects, list(back.manifest.objects)
    assert len(own) == len(again)
    heights = [{round(2 * g.size[2], 2) for g in of_scene(f).geoms if "wall_" in g.name} for f in (home, back.folder)]
    assert len(heights[0]) > 1 and heights[0] >= heights[1] and max(heights[0]) == max(heights[1])
    for thing in own:
        world = seen(home, thing.name)
        alike = [o for o in again if o.category == thing.category and o.n_hulls == thing.n_hulls]
        off = [apart(seen(back.folder, o.name), world) for o in alike]
        # A centimetre at the end of a metre is less than a degree.
        assert min(off) < 0.01, thing.name
        found = alike[int(np.argmin(off))]
        again.remove(found)
        assert found.mass_kg == pytest.approx(thing.mass_kg, rel=0.02)


def test_the_example_was_made_of_its_drawing():
    raw, own = read_sh3d(DRAWN.with_suffix(".sh3d")), load_manifest(DRAWN)
    assert raw.sources == own.source["sha256"] and raw.licence == own.licence
    assert sorted(a.category for a in raw.annotations) == sorted(o.category for o in own.objects)
    assert (DRAWN / "ATTRIBUTION.md").read_text() == raw.attribution and raw.attribution.count("| CC BY 3.0") == 8


@pytest.mark.heavy
def test_the_example_is_what_its_drawing_becomes(tmp_path, hull_cache):
    made = convert(DRAWN.with_suffix(".sh3d"), tmp_path / "flat", SMALL, cache=hull_cache)
    own, again = load_manifest(DRAWN), load_manifest(made.folder)
    assert {g.name for g in made.gates if not g.passed} == set()
    assert {o.name: o.category for o in own.objects} == {o.name: o.category for o in again.objects}
    specs = of_scene(DRAWN), of_scene(made.folder)
    rest, found = (np.array([spec.body(o.name).pos for o in own.objects]) for spec in specs)
    assert len(rest) == 16 and np.abs(rest - found).max() < 0.01
    walls, same = (np.array([[*g.pos, *g.size] for g in spec.geoms if g.name.startswith("wall_")]) for spec in specs)
    # The packaged flat was converted when small loose parts were dropped: handles of the counter take a row of cells.
    assert walls.shape == same.shape == (23, 6)
    assert np.abs(walls[:, None] - same[None]).max(axis=-1).min(axis=1).max() < 0.051
    export_sh3d(made.folder, tmp_path / "again.sh3d")
    windows, back = ([np.array([*w.middle, *w.half[[0, 2]], w.yaw]) for w in read_sh3d(p).windows]
                     for p in (DRAWN.with_suffix(".sh3d"), tmp_path / "again.sh3d"))  # fmt: skip
    assert len(windows) == 3 and np.abs(np.subtract(windows, back)).max() < 0.01


def test_overlapping_boxes_become_walls_side_by_side():
    boxes = [((0, 0, 1.25), (2, 0.1, 1.25)), ((1.9, 1, 1.25), (0.1, 1, 1.25)), ((0, 0.3, 0.5), (0.5, 0.4, 0.5))]
    turn = 0.3
    c, s = np.cos(turn), np.sin(turn)
    placed = [(np.array([c * x - s * y, s * x + c * y, z]), np.array(half), turn) for (x, y, z), half in boxes]
    walls = merged_walls(placed)
    assert all(isinstance(w, Wall) for w in walls) and sorted(w.height for w in walls) == [1.0, 2.5, 2.5]
    areas = [w.polygon().area for w in walls]
    assert sum(areas) == pytest.approx(shapely.union_all([w.polygon() for w in walls]).area, abs=1e-6)
    assert sum(areas) == pytest.approx(4 * 0.2 + 0.2 * 1.9 + 1.0 * 0.6, abs=1e-3)


def test_one_mesh_is_written_once(tmp_path):
    folder = shutil.copytree(HOME, tmp_path / "twins")
    text = (folder / "scene.xml").read_text()
    for word in ("mesh", "material"):
        end = "visual" if word == "mesh" else "material"
        text = text.replace(f' {word}="chair_1_{end}"', f' {word}="chair_0_{end}"')
    (folder / "scene.xml").write_text(text)
    export_sh3d(folder, tmp_path / "twins.sh3d")
    with zipfile.ZipFile(tmp_path / "twins.sh3d") as archive:
        assert sum(name.endswith("/model.obj") for name in archive.namelist()) == 8
        assert archive.read("Home.xml").count(b"<pieceOfFurniture") == 7


@pytest.mark.parametrize(
    ("spoil", "out", "words"),
    [
        (lambda f: shutil.rmtree(f), "home.sh3d", "expected a scene folder"),
        (lambda f: (f / "assets" / "chair_0_visual.obj").unlink(), "home.sh3d", "chair_0 needs it; convert the scene"),
        (
            lambda f: (f / "assets" / "chair_0.png").write_bytes(b"?"),
            "home.sh3d",
            "chair_0 needs it; convert the scene",
        ),
        (lambda f: (f / "assets" / "structure_visual.obj").write_text("v 0 0 0"), "home.sh3d", "structure_visual.obj"),
        (lambda f: (f / "assets" / "structure.png").unlink(), "home.sh3d", "structure.png"),
        (lambda f: (f / "scene.xml").write_text("<mujoco"), "home.sh3d", "not readable as MJCF"),
        (lambda f: None, "home.xml", "expected a new file that ends in .sh3d"),
        (lambda f: (f.parent / "home.sh3d").write_text("kept"), "home.sh3d", "exists, expected a new file"),
    ],
)
def test_bad_input(tmp_path, capsys, spoil, out, words):
    folder = Path(shutil.copytree(HOME, tmp_path / "home"))
    spoil(folder)
    before = sorted(p.name for p in tmp_path.iterdir())
    assert main(["export", str(folder), str(tmp_path / out)]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def rgb(word: str | None) -> np.ndarray:
    return np.array(list(bytes.fromhex((word or "")[2:])), int)


def test_colours_of_floors_and_walls_come_back(tmp_path):
    drawn, again = DRAWN.with_suffix(".sh3d"), tmp_path / "flat.sh3d"
    export_sh3d(DRAWN, again)
    with zipfile.ZipFile(drawn) as first, zipfile.ZipFile(again) as second:
        homes = [ElementTree.fromstring(archive.read("Home.xml")) for archive in (first, second)]
    plans = [{room: shapely.Polygon([point(p) for p in room]) for room in home.iter("room")} for home in homes]
    assert len(plans[1]) == 3
    for room, plan in plans[1].items():
        own = max(plans[0], key=lambda r: plans[0][r].intersection(plan).area)
        assert np.abs(rgb(room.get("floorColor")) - rgb(own.get("floorColor"))).max() <= 12
    lines = [
        {w: shapely.LineString([point(w, f"x{e}", f"y{e}") for e in ("Start", "End")]) for w in h.iter("wall")}
        for h in homes
    ]
    stands = shapely.union_all([line.buffer(float(w.get("thickness", "0")) / 200) for w, line in lines[0].items()])
    own = [wall for wall, line in lines[1].items() if stands.contains(line)]
    sides = np.array([rgb(wall.get(f"{side}SideColor")) for wall in own for side in ("left", "right")])
    assert len(sides) == 18 and np.abs(sides - rgb("FFEDEAE4")).max() <= 12  # all of the drawing's are


def openings(folder: Path) -> np.ndarray:
    """(n, 7) middle, half sizes (m) and direction (rad) of the windows of a scene."""
    sites = [s for s in of_scene(folder).sites if s.name.startswith("window_")]
    return np.array([[*s.pos, *s.size, yaw_from_quat(s.quat) % np.pi] for s in sites])


def test_windows_come_back_where_they_were(tmp_path, hull_cache):
    words = "angle='1.5707964' elevation='80' cutOutShape='M0,0 v1 h1 v-1 z'"
    counter = piece("Counter", 100, 30, "200 60 80", "movable='false'")  # the scene has no wall behind it
    home = [*PLAIN, counter, piece("Side", -5, 150, "80 10 120", words, tag="doorOrWindow")]
    home.append(piece("Alone", 200, 150, "80 10 120", words, tag="doorOrWindow"))  # in no wall
    made = convert(write_home(tmp_path / "two", home), tmp_path / "out", SMALL, cache=hull_cache)
    assert " 2 windows, " in export_sh3d(made.folder, tmp_path / "again.sh3d")[0]
    drawn = [[1.0, 0.05, 1.4, 0.6, 0.03, 0.5, 0.0], [-0.05, -1.5, 1.4, 0.4, 0.06, 0.6, np.pi / 2]]
    assert openings(made.folder) == pytest.approx(np.array(drawn), abs=1e-5)
    back = convert(tmp_path / "again.sh3d", tmp_path / "back", SMALL, cache=hull_cache)
    assert {g.name for g in back.gates if not g.passed} == set()
    off = np.abs(openings(back.folder) - drawn)
    assert off[:, [0, 1, 2, 3, 5]].max() < 0.01 and np.degrees(off[:, 6]).max() < 1
    scan = read_sh3d(tmp_path / "again.sh3d").scan
    solid = trimesh.Trimesh(scan.vertices, scan.faces, process=False)
    for x, y, z, wide, _, high, yaw in drawn:
        along, across = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        for out, passes in ((-1.05, False), (-0.85, True), (0.0, True), (0.85, True), (1.05, False)):
            for side, rise in ((out * wide, 0.0), (0.0, out * high)):
                start = np.array([x, y, z + rise]) + side * along - 0.2 * across
                hits = solid.ray.intersects_location([start], [across])[0]
                depth = np.abs(hits[:, :2] @ across[:2] - np.array([x, y]) @ across[:2])
                depth = depth[depth < 0.2]
                assert (depth.max() < 0.01) == passes, (yaw, out)  # a pane in the middle, and no wall before it


def test_windows_of_a_scan_are_drawn_where_its_file_says(gibson_raw, tmp_path, hull_cache):
    """The floor is at 0.3 m; one window lies along x, one along y."""
    (gibson_raw / "windows.txt").write_text("0.6 2.45 0.9 1.4 2.55 1.5\n-0.05 0.5 0.9 0.05 1.5 1.5\n")
    made = convert(gibson_raw, tmp_path / "out", SMALL, cache=hull_cache)
    there = [[1.0, 2.5, 0.9, 0.4, 0.05, 0.3, 0.0], [0.0, 1.0, 0.9, 0.5, 0.05, 0.3, np.pi / 2]]
    assert openings(made.folder) == pytest.approx(np.array(there), abs=1e-6)
    export_sh3d(made.folder, tmp_path / "room.sh3d")
    with zipfile.ZipFile(tmp_path / "room.sh3d") as archive:
        drawn = [e for e in ElementTree.fromstring(archive.read("Home.xml")).iter("doorOrWindow")]
    sizes_cm = [float(e.get(name, "nan")) for e in drawn for name in ("width", "height", "elevation")]
    assert sizes_cm == pytest.approx([80, 60, 60, 100, 60, 60])


def is_mostly(colour: str | None, channel: int) -> bool:
    """Whether a colour has this channel, in light and shade, and next to nothing of the others."""
    value = rgb(colour)
    return value[channel] > 100 and np.delete(value, channel).max() < 12


def test_each_side_of_a_wall_has_its_own_colour(tmp_path, hull_cache):
    root = tmp_path / "two"
    made = convert(write_home(root, PLAIN), root / "out", ConvertConfig(structure_texture=256), cache=hull_cache)
    export_sh3d(made.folder, tmp_path / "two.sh3d")
    with zipfile.ZipFile(tmp_path / "two.sh3d") as archive:
        home = ElementTree.fromstring(archive.read("Home.xml"))
    (room,) = home.iter("room")
    assert np.ptp(rgb(room.get("floorColor"))) <= 8  # grey, in the light that falls on it
    seen = {wall.get(f"{side}SideColor") for wall in home.iter("wall") for side in ("left", "right")}
    assert any(is_mostly(side, 0) for side in seen) and any(is_mostly(side, 1) for side in seen)
    for wall in (w for w in home.iter("wall") if w.get("id") != "wall5"):  # red is what looks at the room, but the leaf
        start, end = point(wall, "xStart", "yStart"), point(wall, "xEnd", "yEnd")
        left = (end - start)[::-1] * [-1.0, 1.0]
        inside = "left" if left @ ([2.0, -1.5] - start) > 0 else "right"
        assert is_mostly(wall.get(f"{inside}SideColor"), 0), wall.attrib
