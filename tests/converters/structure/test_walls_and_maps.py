"""Maps and wall boxes: rectangles cover what they must, and the tiny room's free space comes out right."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from converters.bodies.objects import PlacedObject
from converters.geometry.boxes import convex_hull
from converters.geometry.faces import sample_faces
from converters.records.raw import CEILING, FLOOR, UP, WALL, GivenMap, ScannedHinge
from converters.structure.maps import Grid, make_floor_plan, resample
from converters.structure.walls import border_cells, cover_rectangles, main_direction, wall_boxes
from interactive_nav_common.rotations import yaw_matrix
from tests.converters import tiny_raw


def paint(shape, rectangles) -> np.ndarray:
    count = np.zeros(shape, int)
    for r0, r1, c0, c1 in rectangles:
        count[r0:r1, c0:c1] += 1
    return count


@settings(max_examples=80, deadline=None)
@given(arrays(bool, (9, 11)), arrays(bool, (9, 11)))
def test_rectangles_cover_the_needed_and_stay_in_the_allowed(needed, extra):
    allowed = needed | extra
    count = paint(needed.shape, cover_rectangles(needed, allowed))
    assert (count[needed] >= 1).all()
    assert not count[~allowed].any()


def test_a_frame_takes_four_rectangles():
    frame = np.ones((10, 12), bool)
    frame[1:-1, 1:-1] = False
    assert len(list(cover_rectangles(frame, frame))) == 4


def test_the_most_useful_rectangle_comes_first_and_ties_go_to_the_first_cell():
    cells = np.zeros((6, 8), bool)
    cells[0:4, 0] = cells[5, 2:8] = cells[1, 4:8] = cells[1:5, 7] = True
    assert list(cover_rectangles(cells, cells)) == [(5, 6, 2, 8), (0, 4, 0, 1), (1, 2, 4, 8), (1, 6, 7, 8)]
    bars = np.ones((200, 400), bool)
    bars[::4], bars[:, ::5] = False, False  # 4,000 pieces of 3 x 4 cells
    began = time.process_time()
    found = list(cover_rectangles(bars, bars))
    assert found[:2] == [(1, 4, 1, 5), (1, 4, 6, 10)] and len(found) == 4000
    assert time.process_time() - began < 20  # a tenth of it by itself


def test_border_surrounds_a_single_cell():
    free = np.zeros((5, 5), bool)
    free[2, 2] = True
    assert border_cells(free).sum() == 8


def test_samples_lie_on_the_face_and_close_together():
    triangle = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.4, 0.0]])
    points, face = sample_faces(triangle, np.array([[0, 1, 2]]), 0.05)
    assert set(face) == {0} and len(points) == 55  # 0.5 m / 0.05 m = 10 steps: 10 * 11 / 2 points
    assert (points[:, :2] >= 0).all() and (points[:, 0] / 0.3 + points[:, 1] / 0.4 <= 1).all()


def test_a_long_thin_face_needs_few_points_and_all_of_it_is_sampled():
    strip = np.array([[0, 0, 0], [60, 0, 0], [60, 0.1, 0]])
    points, face = sample_faces(strip, np.array([[0, 1, 2]]), 1 / 60)  # 6.5 million, by even barycentric steps
    assert set(face) == {0} and len(points) == 12_603
    assert (points[:, 1] <= points[:, 0] / 600 + 1e-12).all() and (points[:, 1] >= 0).all()
    assert points[:, 0].min() < 1 / 60 and points[:, 0].max() > 60 - 1 / 60
    assert np.diff(np.unique(points[:, 0])).max() < 1 / 60 + 1e-9


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_an_empty_hall_has_four_walls(turn):
    side = 30.0  # on the cells' borders, which rounding would share out along such long walls
    hall = trimesh.creation.box((side, side, 3.0))
    corners = np.asarray(hall.vertices)[np.asarray(hall.faces)].reshape(-1, 3) + [0, 0, 1.5]
    up = np.asarray(hall.face_normals)[:, 2].round().astype(int)
    labels = np.array([FLOOR, WALL, CEILING])[1 + np.repeat(up, 3)]
    faces = np.arange(len(corners)).reshape(-1, 3)[:, ::-1]
    plan = make_floor_plan(corners @ yaw_matrix(turn).T, faces, labels, (), None, turn)
    boxes = wall_boxes(plan)
    assert len(boxes) == 4
    assert plan.traversable.sum() * 0.05**2 == pytest.approx(side**2, rel=0.01)


def test_grid_cells_and_centres_agree_when_turned():
    grid = Grid(0.3, (-1.0, -2.0), (30, 40), 0.05)
    row, column, inside = grid.cells(grid.centres_w().reshape(-1, 2))
    assert inside.all()
    np.testing.assert_array_equal(row, np.indices(grid.shape)[0].ravel())
    np.testing.assert_array_equal(column, np.indices(grid.shape)[1].ravel())


@pytest.mark.parametrize("yaw", [0.0, 0.2, -0.6])
def test_main_direction_finds_the_rooms_turn(yaw):
    vertices, faces, labels = tiny_raw.scan()
    assert main_direction(vertices @ yaw_matrix(yaw).T, faces, labels) == pytest.approx(yaw, abs=1e-3)


def room_plan(yaw: float = 0.0, given=None, keep=None, objects=(), exact=False):
    vertices, faces, labels = tiny_raw.scan()
    faces = faces[np.isin(labels[faces[:, 0]], (1, 2))] if keep is None else faces[keep(labels[faces[:, 0]])]
    return make_floor_plan(
        (vertices - [0, 0, 0.3]) @ yaw_matrix(yaw).T, faces, labels, objects, given, yaw, exact=exact
    )


@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_the_empty_room_is_free_up_to_its_walls(yaw):
    plan = room_plan(yaw)
    # 3.0 x 2.5 m, less at most one cell (5 cm) along each wall.
    area = plan.traversable.sum() * 0.05**2
    assert 2.85 * 2.35 <= area <= 3.0 * 2.5
    assert plan.wall_height_m == pytest.approx(1.5, abs=0.05)
    boxes = wall_boxes(plan)
    assert len(boxes) == 4
    for box in boxes:
        assert math.atan2(box.rotation[1, 0], box.rotation[0, 0]) == pytest.approx(yaw)
    mask, origin = resample(plan.grid, plan.traversable, 0.05)
    assert mask.sum() * 0.05**2 <= area + 1e-9
    assert mask.sum() * 0.05**2 > 0.93 * area  # a turned grid loses at most the cells along the walls
    cells = np.argwhere(mask) + 0.5
    back = (cells[:, ::-1] * 0.05 + origin) @ yaw_matrix(yaw)[:2, :2]
    assert back.min() >= -1e-9 and (back <= np.array(tiny_raw.ROOM_M) + 1e-9).all()


def test_unannotated_furniture_is_static():
    with_basket = room_plan(keep=lambda label: np.isin(label, (1, 2, 39)))
    empty = room_plan()
    gone = empty.traversable & ~with_basket.traversable
    # The basket covers 0.3 x 0.3 m; its surface may touch one more row of cells on each side.
    assert 0.25**2 <= gone.sum() * 0.05**2 <= 0.4**2


def test_low_furniture_keeps_its_height_and_walls_theirs():
    plan = room_plan(keep=lambda label: np.isin(label, (1, 2, 39)))
    basket = max(tiny_raw.ITEMS, key=lambda i: i.position[0])  # at (2.4, 0.6), 0.4 m high
    boxes = wall_boxes(plan)
    low = [b for b in boxes if 2 * b.half[2] < 1.0]
    tall = [b for b in boxes if 2 * b.half[2] >= 1.0]
    assert low and len(tall) >= 4
    for box in low:
        assert 2 * box.half[2] == pytest.approx(0.4, abs=0.101)
        np.testing.assert_allclose(box.centre[:2], basket.position[:2], atol=0.3)
        assert box.centre[2] == pytest.approx(box.half[2])  # stands on the floor
    for box in tall:
        assert 2 * box.half[2] == pytest.approx(plan.wall_height_m)
        assert np.linalg.norm(box.centre[:2] - basket.position[:2]) > 0.3


@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_the_inside_of_a_closed_solid_is_not_free_and_a_room_of_its_own_is(yaw):
    """Floor runs on below all of them: a pillar (whose faces look away from it), a housing of panels, a closed room."""

    def box(size, at):
        return trimesh.creation.box(size).apply_translation([*at, size[2] / 2])

    floor = trimesh.creation.box((10.0, 6.0, 0.02)).apply_translation((0, 0, -0.01))
    pillar = box((1.6, 1.6, 2.4), (-3.0, 0.0))
    housing = [box((0.7, 0.02, 1.8), (0, y)) for y in (-0.35, 0.35)] + [
        box((0.02, 0.7, 1.8), (x, 0)) for x in (-0.35, 0.35)
    ]
    room = [box((2.0, 0.1, 2.4), (3.5, y)) for y in (-1, 1)] + [box((0.1, 2.0, 2.4), (3.5 + x, 0)) for x in (-1, 1)]
    around = [box((10.0, 0.1, 2.4), (0, y)) for y in (-3, 3)] + [box((0.1, 6.0, 2.4), (x, 0)) for x in (-5, 5)]
    parts = [floor, pillar, *housing, *room, *around]
    whole = trimesh.util.concatenate(parts)
    labels = np.full(len(whole.vertices), 38)
    labels[:8] = FLOOR
    plan = make_floor_plan(whole.vertices @ yaw_matrix(yaw).T, np.asarray(whole.faces), labels, (), None, yaw)

    def free(x, y):
        row, column, inside = plan.grid.cells(np.array([[x, y, 0.0]]) @ yaw_matrix(yaw).T)
        assert inside.all()
        return bool(plan.traversable[row[0], column[0]])

    assert not free(-3.0, 0.0) and not free(-2.5, 0.5)  # 2.6 m2
    assert not free(0.0, 0.0)  # 0.5 m2
    assert free(3.5, 0.0) and free(-4.5, 2.5) and free(1.5, 0.0)


@pytest.mark.parametrize(
    ("gap_m", "wall", "free_m2", "unseen_m2"),
    [(0.6, False, 2 * 2.0 * 2.0 + 0.6 * 2.0, 1.2), (0.6, True, 8.0, 0.0), (1.6, False, 8.0, 0.0)],
)
def test_unseen_floor_between_two_pieces_is_bridged_where_nothing_stands(gap_m, wall, free_m2, unseen_m2):
    parts = [
        trimesh.creation.box((1.98, 1.98, 0.02)).apply_translation((s * (1 + gap_m / 2), 0, -0.01)) for s in (-1, 1)
    ]
    if wall:
        parts.append(trimesh.creation.box((0.1, 2.2, 2.4)).apply_translation((0, 0, 1.2)))
    whole = trimesh.util.concatenate(parts)
    labels = np.where(np.arange(len(whole.vertices)) < 16, FLOOR, WALL)
    plan = make_floor_plan(np.asarray(whole.vertices), np.asarray(whole.faces), labels, (), None, 0.0)
    assert plan.traversable.sum() * 0.05**2 == pytest.approx(free_m2, abs=1e-9)
    assert plan.unseen_m2 == pytest.approx(unseen_m2, abs=1e-9)


def test_the_sources_map_adds_floor_that_the_scan_missed():
    vertices, faces, labels = tiny_raw.scan()
    middle = vertices[faces].mean(axis=1)
    hole = (labels[faces[:, 0]] == 2) & (middle[:, 0] > 2.0)  # a third of the floor was not scanned
    kept = faces[np.isin(labels[faces[:, 0]], (1, 2)) & ~hole]
    given = GivenMap(np.ones((400, 400), bool), 0.01, (-0.5, -0.5))
    low = vertices - [0, 0, 0.3]
    without = make_floor_plan(low, kept, labels, (), None, 0.0)
    plan = make_floor_plan(low, kept, labels, (), given, 0.0)
    assert without.traversable.sum() * 0.05**2 < 2.2 * 2.5
    assert plan.traversable.sum() == room_plan().traversable.sum()


def door_at_the_wall(x_m: float = 0.43) -> PlacedObject:
    """A leaf of 0.8 x 0.04 m, square to the wall x = 0, its hinge in it, that turns flat against it both ways."""
    leaf = convex_hull(np.array([(x, y, z) for x in (-0.4, 0.4) for y in (-0.02, 0.02) for z in (0.0, 1.4)]))
    hinge = ScannedHinge(np.array([-0.4, 0.0, 0.0]), UP, (-math.pi / 2, math.pi / 2))
    place = np.array([x_m, 1.25, 0.0])
    colours = np.zeros((len(leaf.faces), 3), np.uint8)
    turn = np.array([1.0, 0, 0, 0])
    return PlacedObject("door_0", "door", "d", leaf.vertices, leaf.faces, colours, (leaf,), (), place, turn, hinge)


@pytest.mark.parametrize(("x_m", "exact"), [(0.43, False), (0.43, True), (0.33, True)])
def test_walls_beside_a_doors_sweep_stay_and_the_leaf_meets_no_box(x_m, exact):
    door = door_at_the_wall(x_m)
    bare, plan = room_plan(), room_plan(objects=(door,), exact=exact)
    np.testing.assert_array_equal(plan.occupied, bare.occupied)
    assert not (plan.traversable & bare.occupied).any()
    assert plan.leaf is not None and plan.leaf.sum() >= 20  # the leaf lies along 1.6 m of wall, in cells of 5 cm
    boxes = wall_boxes(plan)
    assert door.hinge is not None
    leaf = door.hulls_b[0].vertices
    leaf = leaf + 0.01 * exact * np.sign(leaf) * [1, 1, 0]  # so far may a leaf's box stand out of it
    side = np.linspace(0, 1, 30)[:, None]
    for angle in np.linspace(*door.hinge.range_rad, 25):
        turned = (leaf - door.hinge.origin) @ yaw_matrix(angle).T + door.hinge.origin + door.position_w
        ends = turned[np.argsort(turned[:, 2])[:4], :2]
        points = np.vstack([a * (1 - side) + b * side for a in ends for b in ends])
        for box in boxes:
            inside = np.abs((points - box.centre[:2]) @ box.rotation[:2, :2]) < box.half[:2]
            assert not inside.all(axis=1).any()
    # Behind the leaf the wall is still closed: nothing but the leaf's own cells lost its box.
    covered = np.zeros(plan.grid.shape, bool)
    centres = plan.grid.centres_w()
    for box in boxes:
        covered |= (np.abs((centres - box.centre[:2]) @ box.rotation[:2, :2]) < box.half[:2]).all(axis=-1)
    assert covered[border_cells(plan.traversable | plan.leaf)].all()
