"""Fronts that open are looked at over their range: walls and heavy furniture block them, light furniture does not."""

import mujoco
import numpy as np
import pytest

from converters.bodies.objects import PlacedObject, physical_properties
from converters.check.opening import blocked_fronts, held_bodies
from converters.geometry.boxes import OrientedBox, convex_hull
from converters.records.raw import ScannedHinge
from converters.write.emit import SceneParts, build_spec


def _hull(low, high):
    return convex_hull(np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0, 0.2)]))


def _box(centre, half):
    return OrientedBox(np.array(centre, float), np.eye(3), np.array(half, float))


def _front(name, category, hinge):
    """A panel of 0.5 x 0.02 x 0.2 m whose face is at y = 0, shut in a cabinet behind it."""
    hull = _hull((-0.25, 0.0), (0.25, 0.02))
    grey = np.full((len(hull.faces), 3), 128, np.uint8)
    box = _box((0, 0.01, 0.1), (0.25, 0.01, 0.1))
    placed = PlacedObject(name, category, "c", hull.vertices, hull.faces, grey, (hull,), (box,), np.array([0, 0, 0.3]))
    return placed.__class__(**{**vars(placed), "hinge": hinge})


def _piece(y, kg):
    hull = _hull((-0.1, -0.1), (0.1, 0.1))
    grey = np.full((len(hull.faces), 3), 128, np.uint8)
    box = _box((0, 0, 0.1), (0.1, 0.1, 0.1))
    placed = PlacedObject("box_0", "box", "b", hull.vertices, hull.faces, grey, (hull,), (box,), np.array([0, y, 0.35]))
    return placed, physical_properties("box", (hull,), kg)


SLIDE = ScannedHinge(np.zeros(3), np.array([0.0, -1.0, 0.0]), (0.0, 0.3), slides=True)
DOOR = ScannedHinge(np.array([-0.25, 0.0, 0.0]), np.array([0.0, 0.0, -1.0]), (0.0, np.pi / 2))
FLAP = ScannedHinge(np.zeros(3), np.array([1.0, 0.0, 0.0]), (0.0, np.pi / 2))
ASIDE = ScannedHinge(np.zeros(3), np.array([1.0, 0.0, 0.0]), (0.0, 0.4), slides=True)
CABINET = _box((0, 0.3, 0.4), (0.3, 0.295, 0.4))


def _model(front, walls=(), pieces=()):
    bodies = [(front, physical_properties(front.category, front.hulls_b)), *pieces]
    objects, physical = zip(*bodies, strict=True)
    spec = build_spec(SceneParts("test", objects, physical, (CABINET, *walls)))
    model = spec.compile()
    for exclude in spec.excludes:
        spec.delete(exclude)
    for geom in spec.geoms:
        if "_hull_" in geom.name or "_box_" in geom.name:
            geom.contype = geom.conaffinity = int("_box_" in geom.name)
    return model, spec.compile()


@pytest.mark.parametrize("hinge", [SLIDE, DOOR, FLAP])
def test_a_front_before_free_floor_opens(hinge):
    model, solid = _model(_front("front_0", "drawer" if hinge.slides else "cabinet_door", hinge))
    assert blocked_fronts(solid) == () and len(held_bodies(model)) == 1
    kind = mujoco.mjtJoint.mjJNT_SLIDE if hinge.slides else mujoco.mjtJoint.mjJNT_HINGE
    assert model.jnt_type[0] == kind and model.jnt_range[0] == pytest.approx(hinge.range_rad, abs=1e-6)


@pytest.mark.parametrize(
    ("hinge", "line"),
    [(SLIDE, "drawer_0 hits structure at 0.26 m"), (DOOR, "cabinet_door_0 hits structure at 0.59 rad")],
)
def test_a_wall_before_it_blocks_a_front(hinge, line):
    """It stands 0.2 m before the panel's face."""
    category = "drawer" if hinge.slides else "cabinet_door"
    wall = _box((0, -0.25, 0.5), (1.0, 0.05, 0.5))
    assert blocked_fronts(_model(_front(f"{category}_0", category, hinge), (wall,))[1]) == (line,)


def test_a_wardrobes_door_slides_along_its_front():
    """Structure beside it does not block it, where the wardrobe is in cells; heavy furniture does."""
    door = _front("cabinet_door_0", "cabinet_door", ASIDE)
    beside = _box((0.36, 0.0, 0.4), (0.1, 0.045, 0.4))
    assert blocked_fronts(_model(door, (beside,))[1]) == ()
    heavy, physical = _piece(0.0, 40.0)
    heavy = heavy.__class__(**{**vars(heavy), "position_w": np.array([0.4, 0.0, 0.35])})
    (line,) = blocked_fronts(_model(door, pieces=((heavy, physical),))[1])
    assert line.startswith("cabinet_door_0 hits box_0 at 0.")


def test_a_wall_close_to_a_front_that_is_shut_is_not_its_cabinet():
    """One 7 cm before it blocks it; 1 cm beside it blocks what slides and turns past it by no more than its cells."""
    for hinge, category in ((SLIDE, "drawer"), (DOOR, "cabinet_door")):
        front = _front(f"{category}_0", category, hinge)
        before, beside = _box((0, -0.12, 0.5), (1.0, 0.05, 0.5)), _box((0.31, -0.2, 0.5), (0.05, 0.5, 0.5))
        (line,) = blocked_fronts(_model(front, (before,))[1])
        assert line.startswith(f"{category}_0 hits structure at ")
        assert blocked_fronts(_model(front, (beside,))[1]) == ()
    skew = _box((-0.31, -0.325, 0.5), (0.05, 0.275, 0.5))  # at the hinge; a handle of 0.1 m would turn into it
    for length, lines in ((0.02, ()), (0.1, ("cabinet_door_0 hits structure at 1.57 rad",))):
        handle = _hull((0.1, -length), (0.2, 0.02))
        front = _front("cabinet_door_0", "cabinet_door", DOOR)
        boxes = (*front.boxes_b, _box((0.15, 0.01 - length / 2, 0.1), (0.05, length / 2 + 0.01, 0.1)))
        front = front.__class__(**{**vars(front), "hulls_b": (*front.hulls_b, handle), "boxes_b": boxes})
        assert blocked_fronts(_model(front, (skew,))[1]) == lines


def test_light_furniture_is_pushed_and_heavy_furniture_blocks():
    front = _front("drawer_0", "drawer", SLIDE)
    assert blocked_fronts(_model(front, pieces=(_piece(-0.3, 5.0),))[1]) == ()
    assert blocked_fronts(_model(front, pieces=(_piece(-0.3, 40.0),))[1]) == ("drawer_0 hits box_0 at 0.26 m",)


def test_a_flap_stays_where_it_is_left_and_a_drawer_slows_down():
    for hinge, category, start in ((FLAP, "cabinet_door", 0.8), (DOOR, "cabinet_door", 0.8), (SLIDE, "drawer", 0.2)):
        model, _ = _model(_front("front_0", category, hinge))
        data = mujoco.MjData(model)
        data.qpos[0] = start
        for _ in range(400):
            mujoco.mj_step(model, data)
        assert data.qpos[0] == pytest.approx(start, abs=0.01), category
    data.qpos[0], data.qvel[0] = 0.0, 0.5  # the drawer, 2 kg
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert 0.01 < data.qpos[0] < 0.1
