"""Class ids as the original's, and camera poses against C MuJoCo's kinematics."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.robots import get_robot
from interactive_nav.robots.spec import RobotCamera
from interactive_nav.scenes.objects import pick
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.boxes import body_poses, box_poses, build_boxes
from interactive_nav.sensing.sensors import make_mount
from interactive_nav_common.errors import UserError
from scenes_mjcf.categories import OBJECT_CATEGORIES, SEGMENTATIONS, class_id
from scenes_mjcf.look import look_along


def test_class_ids_are_the_originals(world, boxes):
    # Reference benchmark, section 1.4; small objects: basket, shoe, pot, toy in the order of `objects.pick`.
    assert [class_id(c) for c in ("chair", "sofa", "table", "desk", "door")] == [2, 3, 4, 4, 5]
    assert class_id("desk", 5) == 11 and class_id("table", 5) == 4
    first = [int(boxes.class_id[0, np.flatnonzero(boxes.body == m)[0]]) for m in range(4)]
    assert first == [6, 10, 7, 9]
    walls = boxes.body == len(world.layout.slot_qpos)
    assert (np.asarray(boxes.class_id)[:, walls] == 0).all()


def test_masks_of_every_category_number_what_moves_from_two_on():
    masks = SEGMENTATIONS["all"]
    assert masks.names[:4] == ("structure", "robot", "chair", "desk") and masks.names[2:] == OBJECT_CATEGORIES
    assert masks.divisor == len(masks.names) == len(masks.colours) == len(set(masks.colours)) == 35
    assert [class_id(c, "all") for c in ("wardrobe", "structure", "robot", "other", "armchair")] == [0, 0, 1, 11, 12]
    assert pick(1)[0].category == "basket" and [pick(1)[0].mask_id(c) for c in (4, 5, "all")] == [6, 6, 7]


@pytest.mark.parametrize("classes", [4, 5])
def test_masks_of_few_classes_keep_the_originals_numbers_for_new_categories(classes):
    masks = SEGMENTATIONS[classes]
    assert masks.divisor == 11 and len(masks.names) == 12 and set(masks.ids.values()) <= set(range(12))
    like = {"armchair": 3, "bed": 3, "bench": 3, "stool": 2, "pouf": 2, "bookcase": 4, "cart": 4, "drying_rack": 4,
            "box": 6, "bag": 6, "bin": 6, "laundry_basket": 6, "suitcase": 6, "plant": 7, "floor_lamp": 7}  # fmt: skip
    assert {c: masks.ids[c] for c in like} == like
    assert {masks.ids[c] for c in ("wardrobe", "counter", "fridge", "toilet", "radiator")} == {0}


def test_box_poses_equal_c_mujocos(world, boxes, jumble):
    scene, qpos, _, _ = jumble
    centre, axes = map(np.asarray, jax.jit(lambda s, q: box_poses(boxes, s, q))(scene, qpos))
    compared = 0
    for i in range(len(scene)):
        model = world.models[scene[i]]
        data = mujoco.MjData(model)
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(model, data)
        bodies = [*world.layout.slot_body, world.layout.structure_body]
        for b in range(boxes.num_boxes):
            half = np.asarray(boxes.half_m[scene[i], b])
            if half[0] < 0:
                continue
            own = np.flatnonzero(model.geom_bodyid == bodies[boxes.body[b]])
            geom = own[b - np.flatnonzero(boxes.body == boxes.body[b])[0]]
            np.testing.assert_allclose(half, model.geom_size[geom], atol=1e-6)
            np.testing.assert_allclose(centre[i, b], data.geom_xpos[geom], atol=1e-4)
            np.testing.assert_allclose(axes[i, b], data.geom_xmat[geom].reshape(3, 3), atol=1e-5)
            compared += 1
    assert compared > 60


ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><freejoint name="free"/><geom size=".1"/>
<body name="torso" pos=".1 0 .3" quat=".9 .1 .2 .1"><joint name="lift" type="slide" axis="0 0 1"/><geom size=".1"/>
<body name="head" pos="0 .1 .2"><joint name="pan" axis="0 0 1" pos=".05 0 0"/>
<joint name="tilt" axis="0 1 0" ref=".2"/><geom size=".1"/></body></body></body>
<body name="other" pos="3 0 0"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""


def test_a_camera_on_a_jointed_head_is_where_c_mujoco_has_it():
    model = mujoco.MjModel.from_xml_string(ARM)
    camera = RobotCamera("head", (0.1, 0.02, 0.05), pitch_rad=0.26)
    mount = make_mount(model, "base", camera)
    camera_pose, data = jax.jit(mount.pose), mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for _ in range(5):
        data.qpos[:10] = [*rng.normal(size=3), 0, 0, 0, 0, *rng.uniform(-1, 1, 3)]
        quat = np.append(3.0, rng.normal(size=3))
        data.qpos[3:7] = quat / np.linalg.norm(quat)
        mujoco.mj_kinematics(model, data)
        head = data.body("head")
        frame = head.xmat.reshape(3, 3)
        pose = camera_pose(np.asarray(data.qpos, np.float32))
        np.testing.assert_allclose(pose.pos_w, head.xpos + frame @ camera.pos_m, atol=1e-5)
        forward = frame @ [np.cos(0.26), 0, -np.sin(0.26)]
        np.testing.assert_allclose(pose.axes_w[:, 0], forward, atol=1e-5)
        right, up = np.asarray(pose.axes_w[:, 1]), np.asarray(pose.axes_w[:, 2])
        assert abs(right[2]) < 1e-6 and up[2] > 0  # no roll
        np.testing.assert_allclose(np.cross(right, forward), up, atol=1e-5)


def test_a_camera_on_no_body_of_the_robot_is_refused():
    model = mujoco.MjModel.from_xml_string(ARM)
    with pytest.raises(UserError, match="camera body 'hed' is no body of the robot, did you mean 'head'"):
        make_mount(model, "base", RobotCamera("hed", (0, 0, 0)))
    with pytest.raises(UserError, match="camera body 'other'"):
        make_mount(model, "base", RobotCamera("other", (0, 0, 0)))


def test_numpys_cameras_are_jaxs():
    rng = np.random.default_rng(3)
    forward = np.concatenate([rng.normal(size=(50, 3)), [[0, 0, -2.0], [0, 0, 1.0]]]).astype(np.float32)
    there = np.zeros_like(forward)
    plain, traced = look_along(there, forward), jax.jit(look_along)(there, forward)
    assert isinstance(plain.axes_w, np.ndarray) and plain.axes_w.dtype == np.float32
    np.testing.assert_allclose(plain.axes_w, traced.axes_w, atol=1e-6)


def test_looking_straight_down_has_axes():
    axes = np.asarray(look_along(jnp.zeros(3), jnp.asarray([0.0, 0.0, -2.0])).axes_w)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-6)


def test_the_robots_bodies_are_where_c_mujoco_has_them(room):
    world = build_world(get_robot("fetch"), (load_scene(room),), NavConfig.of(num_objects=1))
    tables, model = build_boxes(world, "all", robot=True), world.models[0]
    qpos = np.array(world.rest_qpos[0], np.float32)
    own = slice(world.layout.robot_qpos, world.layout.robot_qpos + world.layout.robot_nq)
    qpos[own] = np.random.default_rng(1).uniform(-0.7, 0.7, world.layout.robot_nq)
    qpos[own][3:7] /= np.linalg.norm(qpos[own][3:7])
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    pos, axes = jax.jit(lambda q: body_poses(tables, jnp.asarray(0), q))(qpos)
    first, bodies = world.layout.num_slots + 1, world.layout.robot_bodies
    np.testing.assert_allclose(pos[first:], data.xpos[bodies], atol=1e-5)
    np.testing.assert_allclose(axes[first:], data.xmat[bodies].reshape(-1, 3, 3), atol=1e-5)
    centre, _ = box_poses(tables, jnp.asarray(0), jnp.asarray(qpos))
    mine = tables.body >= first
    assert set(np.asarray(tables.class_id)[0, mine]) == {1} and 1 not in np.asarray(tables.class_id)[0, ~mine]
    # Those for show, but for the one around the camera.
    shown = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies and model.geom_group[g] == 2]
    shown = [g for g in shown if model.geom_bodyid[g] != model.body("fetch_head_tilt").id]
    want = sorted(map(tuple, np.round(data.geom_xpos[shown], 3)))
    np.testing.assert_allclose(sorted(map(tuple, np.round(np.asarray(centre)[mine], 3))), want, atol=2e-3)
