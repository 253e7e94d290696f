"""Plans and furniture of several seeds: layout, doors on their hinges, free ways; no scan is made here."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
import shapely
from scipy import ndimage

from converters.generate import Building, BuildingConfig, GenerationError, design_building
from converters.generate.homes.doors import DOOR_GAP_M
from converters.generate.homes.space import GRID_M, floor_maps, free_grid, image_size, passes, room_mask, static_grid
from converters.generate.models.cad import TEST_MODELS, Instance, cad_model, place
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.grids import clearance

SEEDS = range(8)
LARGE = BuildingConfig(
    floor_area_m2=(60, 160), n_rooms=(4, 11), n_chairs=(5, 9), n_tables=(2, 4), n_desks=(2, 4),
    n_sofas=(1, 3), n_doors=(2, 5), n_static=(3, 6), n_windows=(4, 9), n_bottlenecks=2, models=TEST_MODELS
)  # fmt: skip


@functools.cache
def building(seed: int) -> Building:
    return design_building(seed)


def polygon(rect) -> shapely.Polygon:
    return shapely.box(rect.x0, rect.y0, rect.x1, rect.y1)


def turned(item: Instance, angle_rad: float) -> Instance:
    """A door leaf turned about its hinge by an angle, by plain geometry in the floor plane."""
    assert item.hinge is not None
    hinge = item.to_floor(np.array([item.hinge.origin]))[0]
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    offset = item.position - hinge
    moved = hinge + np.array([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1], offset[2]])
    return dataclasses.replace(item, yaw_rad=item.yaw_rad + angle_rad, position=moved)


@pytest.mark.parametrize("seed", SEEDS)
def test_sizes_and_counts(seed):
    b = building(seed)
    o = b.plan.outer
    t = BuildingConfig().wall_thickness_m[1]
    inside_m2 = (o.x1 - o.x0 - 2 * t) * (o.y1 - o.y0 - 2 * t)
    assert 30.5 <= inside_m2 <= 42.5
    assert 3 <= len(b.plan.rooms) <= 4
    counts = {c: sum(i.model.category == c for i in b.items) for c in ("chair", "table", "desk", "sofa", "door")}
    assert 6 <= len(b.items) <= 10 and sum(counts.values()) == len(b.items)
    assert counts["chair"] >= 3 and counts["table"] == counts["desk"] == counts["sofa"] == 1
    assert 1 <= counts["door"] <= 2
    assert b.floor_height_m >= 0.05
    assert abs(sum(b.plan.outer.centre)) > 1e-6  # not centred on the origin
    assert all(d.width_m >= 0.9 - 1e-9 for d in b.plan.doorways)


@pytest.mark.parametrize("seed", SEEDS)
def test_rooms_and_walls_tile_the_building(seed):
    plan = building(seed).plan
    rooms = [polygon(r) for r in plan.rooms]
    holes = [polygon(d.rect) for d in plan.doorways]
    standing = [polygon(w.rect) for w in plan.walls if w.low[2] == 0]
    lintels = [w for w in plan.walls if w.low[2] > 0]
    pieces = rooms + holes + standing
    assert sum(p.area for p in pieces) == pytest.approx(plan.outer.area_m2, rel=1e-9)
    for a, b in itertools.combinations(pieces, 2):
        assert a.intersection(b).area < 1e-9
    assert len(lintels) == len(holes)
    assert all(w.low[2] == plan.doorways[0].height_m and w.high[2] == plan.wall_height_m for w in lintels)


@pytest.mark.parametrize("seed", SEEDS)
def test_furniture_stands_apart_inside_rooms_on_the_floor(seed):
    b = building(seed)
    fixtures = [polygon(f.rect) for f in b.plan.fixtures]
    shapes = [i.footprint for i in b.items]
    for x, y in itertools.combinations(shapes + fixtures, 2):
        assert x.intersection(y).area == 0
    for item, shape in zip(b.items, shapes, strict=True):
        bottom = item.to_floor(np.concatenate([p.vertices for p in item.model.parts]))[:, 2].min()
        if item.hinge is None:
            assert sum(polygon(r).contains(shape) for r in b.plan.rooms) == 1
            assert bottom == pytest.approx(0.0, abs=1e-5)
            ratio = item.scale / item.model.unit_m
            assert (np.abs(ratio - 1) <= 0.08 + 1e-9).all()
        else:
            assert 0.005 <= bottom <= 0.0105


def test_instances_of_one_building_differ_in_scale_and_yaw():
    items = [i for i in building(0).items if i.model.category == "chair"]
    assert len({tuple(np.round(i.scale, 6)) for i in items}) == len(items)
    assert len({round(i.yaw_rad, 6) for i in items}) == len(items)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_room_is_reached_with_the_furniture_in_place(seed):
    b = building(seed)
    # The oracle is made here: the static map at 1 cm, furniture drawn in, eroded by the robot's radius.
    free = floor_maps(b.plan)[1] > 0
    half = free.shape[0] // 2
    centres = (np.arange(free.shape[0]) - half + 0.5) * 0.01
    xs, ys = np.meshgrid(centres, centres)
    for item in b.items:
        free &= ~shapely.contains_xy(item.footprint, xs, ys)
    room_for_robot = np.asarray(ndimage.distance_transform_edt(free)) * 0.01 > 0.18
    regions = np.zeros(free.shape, np.int32)
    ndimage.label(room_for_robot, output=regions)
    main = regions == 1 + np.argmax(np.bincount(regions.ravel())[1:])
    for r in b.plan.rooms:
        inside = (xs > r.x0) & (xs < r.x1) & (ys > r.y0) & (ys < r.y1)
        assert (main & inside).sum() * 1e-4 >= 0.3


@pytest.mark.parametrize("seed", SEEDS)
def test_some_chair_narrows_the_way_between_two_rooms(seed):
    b = building(seed)
    low, high = BuildingConfig().bottleneck_gap_m
    grid, empty = free_grid(b.plan, list(b.items)), static_grid(b.plan)
    narrowed = 0
    for d in b.plan.doorways:
        masks = [room_mask(grid, b.plan.rooms[i]) for i in d.rooms]
        assert passes(clearance(empty, GRID_M), masks, high)
        narrowed += not passes(clearance(grid, GRID_M), masks, high)
    assert narrowed >= 1


@pytest.mark.parametrize("seed", SEEDS)
def test_door_hangs_at_a_jamb_and_swings_from_closed_to_the_wall(seed):
    b = building(seed)
    walls = shapely.union_all([polygon(w.rect) for w in b.plan.walls if w.low[2] == 0])
    for item in [i for i in b.items if i.hinge is not None]:
        assert item.hinge is not None
        low, high = item.hinge.range_rad
        assert item.hinge.axis.tolist() == [0.0, 1.0, 0.0] and low < 0 < high
        hinge = item.to_floor(np.array([item.hinge.origin]))[0]
        # The hinge line: DOOR_GAP_M from the jamb, on the face of the wall.
        doorway = min(b.plan.doorways, key=lambda d: polygon(d.rect).distance(shapely.Point(hinge[:2])))
        outline = polygon(doorway.rect)
        assert outline.exterior.distance(shapely.Point(hinge[:2])) < 1e-6
        along = 1 - doorway.axis
        ends = (doorway.rect.x0, doorway.rect.x1) if along == 0 else (doorway.rect.y0, doorway.rect.y1)
        assert min(abs(hinge[along] - e) for e in ends) == pytest.approx(DOOR_GAP_M, abs=1e-6)
        # One end of the range closes it: the slab (first part; handles stand off) then lies in the doorway.
        slab = item.model.parts[0].vertices
        closed = [
            outline.buffer(1e-6).contains(shapely.MultiPoint(turned(item, a).to_floor(slab)[:, :2]).convex_hull)
            for a in (low, high)
        ]
        assert sum(closed) == 1
        opened = -low if closed[0] else high
        assert math.radians(85) - 1e-9 <= opened <= math.radians(115) + 1e-9
        assert math.pi / 2 <= high - low <= math.radians(121)
        # Nothing static nor any other piece stands in the sweep; the slab never enters a wall.
        others = [o.footprint for o in b.items if o is not item]
        for angle in np.linspace(low, high, 25):
            leaf = shapely.MultiPoint(turned(item, angle).to_floor(slab)[:, :2]).convex_hull
            assert leaf.intersection(walls).area < 1e-6
            assert all(not leaf.intersects(o) for o in others)


@pytest.mark.parametrize("seed", SEEDS)
def test_maps_show_the_static_structure_at_one_centimetre(seed):
    plan = building(seed).plan
    obstacles, traversable = floor_maps(plan)
    size = image_size(plan)
    assert obstacles.shape == traversable.shape == (size, size) and size % 2 == 0
    assert set(np.unique(obstacles)) == set(np.unique(traversable)) == {0, 255}
    assert not ((traversable == 255) & (obstacles == 0)).any()
    rooms_m2 = sum(r.area_m2 for r in plan.rooms) + sum(d.rect.area_m2 for d in plan.doorways)
    fixtures_m2 = sum(f.rect.area_m2 for f in plan.fixtures)
    assert (traversable == 255).sum() * 1e-4 == pytest.approx(rooms_m2 - fixtures_m2, abs=1e-6)
    for box in plan.walls:
        x, y = box.rect.centre
        expected = 0 if box.low[2] == 0 else 255  # above a doorway one walks through
        assert obstacles[int(y / 0.01 + size / 2), int(x / 0.01 + size / 2)] == expected


def test_place_faces_where_it_is_told():
    for name in ("chair_slat", "chair_panel"):  # fronts +z and -z
        model = cad_model(name)
        item = place(model, np.full(3, model.unit_m), np.array([1.0, 2.0]), math.radians(30))
        tip = model.center + [0, 0, model.front * 0.5]
        ahead = (item.to_floor(tip[None]) - item.to_floor(model.center[None]))[0]
        assert math.atan2(ahead[1], ahead[0]) == pytest.approx(math.radians(30))
        assert ahead[2] == pytest.approx(0)
        x, y = item.footprint.centroid.coords[0]
        assert (x, y) == pytest.approx((1.0, 2.0))


def test_same_seed_same_building_other_seed_another():
    a, b, c = design_building(3), design_building(3), design_building(4)
    assert a.plan == b.plan and a.plan != c.plan
    assert all((x.matrix == y.matrix).all() for x, y in zip(a.items, b.items, strict=True))


@pytest.mark.parametrize("seed", [0, 5])
def test_a_large_test_building_uses_held_out_models_only(seed):
    b = design_building(seed, LARGE)
    assert 4 <= len(b.plan.rooms) <= 11 and 12 <= len(b.items) <= 25
    assert {i.model.name for i in b.items} <= set(TEST_MODELS)
    assert (b.plan.corridor is None) == (len(b.plan.rooms) < LARGE.corridor_from_rooms)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"floor_area_m2": (9.0, 9.0)}, "no plan in"),
        ({"n_sofas": (12, 12), "n_chairs": (30, 30)}, "no way to furnish"),
        ({"n_rooms": (4, 3)}, "n_rooms is (4, 3), expected at least 1, ascending"),
        ({"voxel_m": -1.0}, "voxel_m is -1.0"),
        ({"models": ("chair_throne",)}, "unknown CAD models"),
        ({"models": ("chair_slat",)}, "names no table"),
        ({"n_bottlenecks": 9}, "each bottleneck needs a chair"),
        ({"n_blockers": 3}, "each bottleneck needs a chair"),
        ({"passage_chairs": ("sofa_two",)}, "passage_chairs names ['sofa_two']"),
        ({"corner_doorways": 1.5}, "corner_doorways is 1.5, expected between 0 and 1"),
    ],
)
def test_what_cannot_be_built_is_said_in_one_line(changes, message):
    with pytest.raises(ConfigError) as caught:
        design_building(0, dataclasses.replace(BuildingConfig(), **changes), max_plans=1)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_negative_seed_is_refused():
    with pytest.raises(GenerationError, match="seed is -1"):
        design_building(-1)
