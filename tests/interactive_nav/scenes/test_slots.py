"""The tables of what is in each slot are what the compiled models have, whatever axis a body turns or slides on."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.navigation.tables import friction_share, rest_poses
from interactive_nav.physics import PhysicsState
from interactive_nav.physics.nearness import Nearness
from interactive_nav.physics.window import PhysicsWindow
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.boxes import body_poses, build_boxes
from interactive_nav_common.rotations import matrix_from_quat
from tests.toys import write_room

PACKAGED = ("drawn/flat", "aws_house", "alder", "apartment_0", "maple")


@pytest.fixture(scope="module")
def world():
    scenes = tuple(load_scene(f"scenes_mjcf/{name}") for name in PACKAGED)
    return build_world(get_robot("turtlebot"), scenes, NavConfig.of(num_objects=5))


def _geoms(model, body, kind):
    prefix = f"{model.body(body).name}_{kind}_"
    ids = [g for g in range(model.ngeom) if model.geom(g).name.startswith(prefix)]
    assert all(model.geom_bodyid[g] == body for g in ids)
    return ids


def test_tables_of_packaged_scenes_are_the_compiled_models(world):
    slots, layout = world.slots, world.layout
    assert slots.occupied.sum(1).tolist() == [len(s.movables) + 5 for s in world.scenes] and slots.held.sum() == 4
    for s, (scene, model) in enumerate(zip(world.scenes, world.models, strict=True)):
        stored = mujoco.MjModel.from_xml_path(str(scene.path / "scene.xml"))
        assert {*slots.names[s][5:]} == {m.name for m in scene.movables} | {""}
        for m, body in enumerate(layout.slot_body):
            rows, geoms = slots.rows(s, m), _geoms(model, body, "box")
            assert len(_geoms(model, body, "foot")) == 12 and len(rows) <= len(geoms) == (slots.box_slot == m).sum()
            joint = model.body_jntadr[body]
            np.testing.assert_array_equal(slots.com_b_m[s, m], model.body_ipos[body])
            np.testing.assert_array_equal(slots.pos_w_m[s, m], model.body_pos[body])
            np.testing.assert_array_equal(slots.axes_w[s, m], matrix_from_quat(model.body_quat[body]))
            np.testing.assert_array_equal(slots.axis_b[s, m], model.jnt_axis[joint])
            np.testing.assert_array_equal(slots.anchor_b_m[s, m], model.jnt_pos[joint])
            assert slots.held[m] == (model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE) and not slots.slides[m]
            if not slots.occupied[s, m]:
                assert not len(rows) and slots.mass_kg[s, m] == 0 and slots.categories[s][m] == ""
                continue
            own = geoms[: len(rows)]
            want = np.concatenate([model.geom_pos[own], model.geom_quat[own], model.geom_size[own]], 1)
            np.testing.assert_allclose(rows, want, rtol=0, atol=1e-15)
            assert slots.mass_kg[s, m] == model.body_mass[body]
            assert (model.geom_friction[geoms, 0] == slots.friction[s, m]).all()
            if m >= 5:
                assert stored.body(slots.names[s][m]).mass[0] == pytest.approx(slots.mass_kg[s, m], abs=1e-12)
        np.testing.assert_array_equal(slots.rows(s, layout.num_slots), scene.walls)
        share = slots.mass_kg[s] * model.geom_friction[[_geoms(model, b, "box")[0] for b in layout.slot_body], 0]
        np.testing.assert_array_equal(friction_share(world, s), share / world.robot_mass_kg)


def test_class_ids_are_of_the_categories(world):
    ids = world.slots.class_ids("all")
    assert ids.shape == (len(PACKAGED), world.layout.num_slots + 1) and (ids[:, -1] == 0).all()
    assert ((ids[:, :-1] == 0) <= ~world.slots.occupied).all()
    first = [next(c for c in row if c) for row in world.slots.categories]
    assert first == ["basket"] * 5 and (ids[:, 0] == 7).all() and (world.slots.class_ids(4)[:, 0] == 6).all()


def test_a_window_finds_geoms_by_name_in_any_order(world):
    """One body's boxes come after its feet, where the others' come before them."""
    config = NavConfig.of(num_objects=5, active_furniture=0, active_small=0, active_doors=0, active_walls=0)
    spec, name = world.specs[0].copy(), world.models[0].body(world.layout.slot_body[5]).name
    for geom in [g for g in spec.body(name).geoms if "_box_" in g.name]:
        fields = {f: getattr(geom, f) for f in ("name", "type", "pos", "quat", "size", "friction", "group", "mass")}
        spec.delete(geom)
        spec.body(name).add_geom(**fields)
    other = dataclasses.replace(world, models=(spec.compile(), *world.models[1:]))
    assert _geoms(other.models[0], world.layout.slot_body[5], "foot")[0] < _geoms(
        other.models[0], world.layout.slot_body[5], "box")[0]  # fmt: skip
    plain, changed = PhysicsWindow(world, config), PhysicsWindow(other, config)
    everything = tuple(jnp.arange(group.width) for group in plain.groups), jnp.arange(plain.n_walls)
    fields, others = (window.fields(jnp.asarray(0), *everything) for window in (plain, changed))
    for field, values in fields.items():
        np.testing.assert_array_equal(values, others[field], err_msg=field)


TILTED = ((0.8, 0.0, 0.6, 0.0), (0.5, 0.5, 0.5, 0.5))
JOINTS = (
    ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), False),
    ((1.0, 0.0, 0.0), TILTED[0], False),
    ((0.6, 0.0, -0.8), TILTED[1], False),
    ((0.6, 0.8, 0.0), (0.8, 0.0, 0.0, 0.6), True),
    ((0.6, 0.0, -0.8), TILTED[1], True),
)


@pytest.fixture(scope="module", params=JOINTS)
def hatch(request, tmp_path_factory):
    """A room whose door hangs from any axis, or slides along it, in a body that is turned."""
    (axis, quat, slides), pos = request.param, np.array([0.1, 0.02, 0.3])
    scene = load_scene(write_room(tmp_path_factory.mktemp("hatch") / "room", (5.0, 4.0), door=True))
    door = next(m for m in scene.movables if m.joint)
    assert door.joint is not None
    joint = dataclasses.replace(door.joint, axis=np.array(axis), anchor_m=pos, slides=slides)
    door = dataclasses.replace(door, quat_w=np.array(quat), pos_w=np.array([-1.0, 0.5, 1.0]), joint=joint)
    movables = tuple(door if m.joint else m for m in scene.movables)
    scene = dataclasses.replace(scene, movables=movables)
    return build_world(get_robot("turtlebot"), (scene,), NavConfig.of(num_objects=1))


def test_held_bodies_are_where_c_mujoco_has_them_whatever_their_axis(hatch):
    model, slot = hatch.models[0], hatch.slots.names[0].index("door_0")
    data, body = mujoco.MjData(model), hatch.layout.slot_body[slot]
    near, tables = Nearness(hatch), build_boxes(hatch)
    place = jax.jit(lambda qpos: (near.boxes(jnp.asarray(0), PhysicsState(qpos, qpos, qpos)), body_poses(
        tables, jnp.asarray(0), qpos)))  # fmt: skip
    geom = _geoms(model, body, "box")[0]
    for angle in np.linspace(-1.5, 1.5, 7):
        data.qpos[:] = hatch.rest_qpos[0]
        data.qpos[hatch.layout.slot_qpos[slot]] = angle
        mujoco.mj_kinematics(model, data)
        boxes, (pos, axes) = place(jnp.asarray(data.qpos, jnp.float32))
        np.testing.assert_allclose(pos[slot], data.xpos[body], atol=1e-5)
        np.testing.assert_allclose(axes[slot], data.xmat[body].reshape(3, 3), atol=1e-5)
        np.testing.assert_allclose(boxes.axes[slot], data.xmat[body].reshape(3, 3)[:2], atol=1e-5)
        np.testing.assert_allclose(boxes.centre[slot], data.geom_xpos[geom][:2], atol=1e-5)
        np.testing.assert_allclose(boxes.half[slot], model.geom_size[geom], atol=1e-6)


def test_a_hatch_that_fell_is_furniture_where_it_came_to_rest(hatch):
    slot, data = hatch.slots.names[0].index("door_0"), mujoco.MjData(hatch.models[0])
    data.qpos[:] = hatch.rest_qpos[0]
    mujoco.mj_kinematics(hatch.models[0], data)
    up = abs((hatch.slots.axes_w[0, slot] @ hatch.slots.axis_b[0, slot])[2])
    upright = up == (0.0 if hatch.slots.slides[slot] else 1.0)
    assert upright == (abs(hatch.rest_qpos[0, hatch.layout.slot_qpos[slot]]) < 1e-3)
    pos, quat = rest_poses(hatch, 0)["door_0"]
    np.testing.assert_array_equal(pos, data.body(hatch.layout.slot_body[slot]).xpos)
    np.testing.assert_array_equal(quat, data.body(hatch.layout.slot_body[slot]).xquat)
