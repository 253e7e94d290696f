"""Small objects: the default ten, splits of equal layout, masses, and shapes that fit their boxes."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest

from interactive_nav.scenes.objects import MODELS, add_shapes, pick

ALL = [o for kinds in MODELS.values() for models in kinds.values() for o in models]


def test_the_default_ten_are_two_models_a_kind():
    assert [(o.category, o.mass_kg) for o in pick(10)] == [
        ("basket", 0.9), ("shoe", 0.38), ("pot", 1.4), ("toy", 0.5), ("shoe", 0.32),
        ("basket", 0.7), ("toy", 0.3), ("pot", 0.9), ("basket", 0.9), ("shoe", 0.38),
    ]  # fmt: skip
    assert pick(10)[1].boxes[1].centre_m[2] == 0.075 and pick(10)[0].boxes[0].half_m == (0.19, 0.14, 0.006)
    assert pick(0) == ()


def test_models_per_kind_and_split():
    for kinds in MODELS.values():
        assert {k: len(m) for k, m in kinds.items()} == {"basket": 2, "shoe": 2, "pot": 2, "toy": 2}
    assert len({o.name for o in ALL}) == len(ALL) == len({o.boxes for o in ALL})
    assert {o.name for o in pick(10, "test")} == {o.name for m in MODELS["test"].values() for o in m}


def test_slots_hold_the_same_kind_and_number_of_boxes_in_both_splits():
    for base, other in zip(pick(10), pick(10, "test"), strict=True):
        assert (base.category, len(base.boxes)) == (other.category, len(other.boxes))


def test_masses_are_those_of_real_things():
    ranges = {"basket": (0.4, 1.8), "shoe": (0.2, 1.0), "pot": (0.8, 3.2), "toy": (0.3, 1.0)}
    for obj in ALL:
        low, high = ranges[obj.category]
        assert low <= obj.mass_kg <= high, obj.name
        assert 0.09 < obj.radius_m < 0.27 and obj.height_m <= 0.41


def test_segmentation_ids_are_the_originals_five():
    by_kind = {
        kind: {o.segmentation_id for o in ALL if o.category == kind} for kind in ("basket", "shoe", "pot", "toy")
    }
    assert by_kind == {"basket": {6, 8}, "shoe": {10}, "pot": {7}, "toy": {9}}


def outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a geom's own box, world."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    corners = np.array(list(itertools.product((-1, 1), repeat=3))) * half + centre
    points = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    return points.min(axis=0), points.max(axis=0)


@pytest.mark.parametrize("obj", ALL, ids=lambda o: o.name)
def test_shapes_weigh_nothing_do_not_collide_and_fit_the_boxes(obj):
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="thing")
    body.add_freejoint()
    for box in obj.boxes:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=box.centre_m, size=box.half_m, density=100, group=3)
    bare = spec.compile().body_mass[1]
    add_shapes(body, obj, "thing")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert model.body_mass[1] == pytest.approx(bare)
    seen = np.flatnonzero(model.geom_group == 2)
    assert len(seen) == len(obj.shapes) >= 4 and not model.geom_contype[seen].any()
    spans = {}
    for group in (2, 3):
        corners = [outline(model, data, g) for g in np.flatnonzero(model.geom_group == group).tolist()]
        spans[group] = np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)
    # What is seen stands on the floor and covers what collides, to 3 cm (a plant stands above its pot).
    np.testing.assert_allclose(spans[2][0], spans[3][0], atol=0.03)
    np.testing.assert_allclose(spans[2][1][:2], spans[3][1][:2], atol=0.03)
    assert spans[2][0][2] > -0.005 and -0.03 < spans[2][1][2] - spans[3][1][2] < 0.17
