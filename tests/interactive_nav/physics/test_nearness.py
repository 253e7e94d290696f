"""Gaps against shapely's distances, boxes against MuJoCo's geoms, and who is near to what moves."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState
from interactive_nav.physics.nearness import FAR_M, TOUCH_M, Boxes, Nearness, widths_at
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import FEET, build_world
from interactive_nav_common.rotations import matrix_from_quat
from tests.toys import write_room

# A long bench across the way, a chair at its far end, a table out of everybody's reach.
FURNITURE = (("sofa", 1.0, 0.6, 20.0, 0.5), ("chair", 1.0, 1.25, 2.0, 0.4), ("table", -3.0, -1.5, 9.0, 0.5))
_NUMBER = st.floats(-2.0, 2.0)
_SIZE = st.floats(0.05, 1.0)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = write_room(tmp_path_factory.mktemp("near") / "room", (8.0, 5.0), FURNITURE)
    return build_world(get_robot("turtlebot"), (load_scene(folder),), NavConfig.of(num_objects=1))


def _boxes(centre, quat, half):
    rows = np.asarray(matrix_from_quat(np.asarray(quat)))[:2]
    return Boxes(*(jnp.asarray([v], jnp.float32) for v in (centre, rows, half)))


@jax.jit
def _gap(centre, axes, half, *other):
    return Boxes(centre, axes, half).gap_m(*other)


def gap(boxes, *other):
    """[M] m, of boxes to one other or to a point."""
    return np.asarray(_gap(boxes.centre, boxes.axes, boxes.half, *(np.float32(v) for v in other)))


def _shadow(centre, quat, half):
    """What a box covers of the plane."""
    corners = np.array(np.meshgrid(*([-1, 1],) * 3)).reshape(3, -1).T * np.asarray(half, float)
    seen = corners @ np.asarray(matrix_from_quat(np.asarray(quat)))[:2].T + np.asarray(centre)
    return shapely.MultiPoint(seen).convex_hull


@settings(max_examples=60, deadline=None)
@given(*[st.tuples(_NUMBER, _NUMBER)] * 2, *[st.tuples(*[_NUMBER] * 4)] * 2, *[st.tuples(*[_SIZE] * 3)] * 2)
def test_gaps_are_never_larger_than_the_true_ones_nor_much_smaller(here, there, turn, other, half, size):
    quats = [
        np.array(q) / np.linalg.norm(q) if np.linalg.norm(q) > 0.1 else np.array([1.0, 0, 0, 0]) for q in (turn, other)
    ]
    one, two = _boxes(here, quats[0], half), _boxes(there, quats[1], size)
    near = float(gap(one, two.centre[0], two.axes[0], two.half[0])[0])
    true = _shadow(here, quats[0], half).distance(_shadow(there, quats[1], size))
    assert near <= true + 1e-4
    # Off by a corner at most: edges' normals are 90 degrees apart or less.
    assert near >= 0.7 * true - 1e-4 or true == 0
    point = float(gap(one, there, np.eye(2, 3), np.zeros(3))[0])
    assert point <= _shadow(here, quats[0], half).distance(shapely.Point(there)) + 1e-4


def test_the_gap_of_an_upright_box_is_to_its_side_at_any_turn():
    for yaw in np.linspace(0, 2 * np.pi, 9):
        away = 1.5 * np.array([np.cos(yaw), np.sin(yaw)])
        box = _boxes(away, (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)), (0.2, 0.9, 0.4))
        assert float(gap(box, np.zeros(2), np.eye(2, 3), np.zeros(3))[0]) == pytest.approx(1.3, abs=1e-5)


def test_boxes_hold_the_geoms_wherever_bodies_stand(world):
    near, layout, model = Nearness(world), world.layout, world.models[0]
    rng = np.random.default_rng(3)
    data = mujoco.MjData(model)
    place = jax.jit(lambda qpos: near.boxes(jnp.asarray(0), _state(world, qpos)))
    for _ in range(5):
        data.qpos[:] = world.rest_qpos[0]
        for slot in np.flatnonzero(world.slots.occupied[0]):
            at = layout.slot_qpos[slot]
            if near.held[slot]:
                data.qpos[at] = rng.uniform(-1, 1)
            else:
                quat = rng.normal(size=4)
                data.qpos[at : at + 7] = [*rng.uniform(-2, 2, 3), *quat / np.linalg.norm(quat)]
        mujoco.mj_kinematics(model, data)
        boxes = place(data.qpos)
        for slot in np.flatnonzero(world.slots.occupied[0]):
            body = layout.slot_body[slot]
            first, last = model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body] - FEET
            shadow = _shadow(boxes.centre[slot], _whole(boxes.axes[slot]), boxes.half[slot])
            for geom in range(first, last):
                turn = data.geom_xmat[geom].reshape(3, 3)
                corners = np.array(np.meshgrid(*([-1, 1],) * 3)).reshape(3, -1).T * model.geom_size[geom]
                for x, y in (corners @ turn.T + data.geom_xpos[geom])[:, :2]:
                    assert shadow.buffer(1e-3).contains(shapely.Point(x, y))
            assert shadow.area < 6 * sum(np.prod(2 * np.sort(model.geom_size[g])[1:]) for g in range(first, last)) + 0.5


def _whole(axes):
    """The unit quaternion of a rotation whose first two rows these are."""
    rows = np.asarray(axes, float)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.vstack([rows, np.cross(rows[0], rows[1])]).ravel())
    return quat


def _state(world, qpos, qvel=None):
    still = jnp.zeros(world.models[0].nv)
    return PhysicsState(jnp.asarray(qpos, jnp.float32), still if qvel is None else qvel, still)


def test_what_stands_behind_a_moving_thing_is_near_however_far_from_the_robot(world):
    """The chair stands 0.25 m behind the sofa, out of the robot's own reach."""
    near, slot = Nearness(world), {n: i for i, n in enumerate(world.slots.names[0]) if n}
    qpos = world.rest_qpos[0].copy()
    qpos[:7] = [0.0, 0.0, 0, 1, 0, 0, 0]
    measure = jax.jit(lambda state: near.measure(jnp.asarray(0), state, 0.78))
    rest, moving, _ = measure(_state(world, qpos))
    assert not moving.any()
    sofa, chair, table = (slot[f"{name}_0"] for name in ("sofa", "chair", "table"))
    boxes = jax.jit(near.boxes)(jnp.asarray(0), _state(world, qpos))
    between = float(gap(boxes, boxes.centre[sofa], boxes.axes[sofa], boxes.half[sofa])[chair])
    shadows = [_shadow(boxes.centre[s], _whole(boxes.axes[s]), boxes.half[s]) for s in (sofa, chair)]
    assert between == pytest.approx(shadows[0].distance(shadows[1]), abs=0.02)
    still = jnp.zeros(world.models[0].nv)
    pushed, moves, _ = measure(_state(world, qpos, still.at[world.layout.slot_qvel[sofa]].set(0.3)))
    assert bool(moves[sofa]) and not bool(moves[chair])
    np.testing.assert_allclose(pushed[chair], min(float(rest[chair]), between - TOUCH_M), atol=1e-4)
    assert float(pushed[table]) > 1.0 and float(pushed[sofa]) == pytest.approx(float(rest[sofa]))
    assert (np.asarray(rest)[~np.asarray(world.slots.occupied[0])] == FAR_M).all()


def test_a_window_is_as_wide_as_what_stands_near_somewhere(tmp_path):
    """Three chairs in a corner, one table far away: three pieces at a time, and the two walls of a corner."""
    blocks = (*(("chair", 3.0, y, 2.0, 0.4) for y in (0.9, 1.4, 1.9)), ("table", -3.0, -1.5, 9.0, 0.5))
    folder = write_room(tmp_path / "room", (8.0, 5.0), blocks)
    world = build_world(get_robot("turtlebot"), (load_scene(folder),), NavConfig.of(num_objects=2))
    assert widths_at(Nearness(world).counts(0.78)) == {"small": 2, "free": 3, "hinge": 1, "slide": 1, "walls": 2}
    assert widths_at(Nearness(world).counts(0.1))["free"] == 2, "chairs 0.1 m apart"
    assert widths_at(Nearness(world).counts(20.0)) == {"small": 2, "free": 4, "hinge": 1, "slide": 1, "walls": 4}
