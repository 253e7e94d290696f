"""Rays of our own against C MuJoCo's and MJX-Warp's over the same scenes; distances by hand."""

import functools
import importlib.util
import itertools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.boxes import box_poses, build_boxes
from interactive_nav.sensing.rays import RayRenderer, camera_boxes, cast_fan, in_view
from scenes_mjcf.categories import SEGMENTATIONS, MaskClasses, class_id
from scenes_mjcf.look import CameraPose, Lens, look_along
from tests.toys import write_room

HAS_WARP = importlib.util.find_spec("warp") is not None
LENS = Lens(68, 68, 120.0)


def depth_and_classes(renderer):
    """Of one environment, as `render_batch` returns them of a batch."""

    def draw(*of_one):
        images = renderer.images(("depth", "segmentation"), *of_one)
        return images["depth"], images["segmentation"]

    return draw


@pytest.fixture(scope="module")
def drawn(boxes, jumble):
    scene, qpos, eye, forward = jumble
    return jax.jit(RayRenderer(boxes, LENS, tiled=True).render_batch)(scene, qpos, look_along(eye, forward))


def c_mujoco(world, scene, qpos, pos, axes, lens, classes: MaskClasses = 4):
    """Depth and class ids by `mj_multiRay` over the physics model's own geoms, the robot's left out."""
    model, layout = world.models[scene], world.layout
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qpos[layout.robot_qpos : layout.robot_qpos + 3] = [500, 500, 0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    right, up = np.meshgrid(lens.columns.astype(float), lens.rows.astype(float))
    ray = np.stack([np.ones_like(right), right, up], -1) @ np.asarray(axes, float).T
    length = np.linalg.norm(ray, axis=-1)
    geom, distance = np.zeros(length.size, np.int32), np.zeros(length.size)
    unit = (ray / length[..., None]).ravel()
    mujoco.mj_multiRay(model, data, np.asarray(pos, float), unit, None, 1, -1, geom, distance, None, length.size, 400.0)
    categories = {m.name: m.category for m in world.scenes[scene].movables}
    ids = np.zeros(model.ngeom, np.uint8)
    for slot, name in enumerate(world.slots.names[scene]):
        if name:
            small = layout.slot_kind[slot] == "small"
            own = world.small_objects[slot].mask_id(classes) if small else class_id(categories[name], classes)
            ids[model.geom_bodyid == layout.slot_body[slot]] = own
    depth = distance.reshape(length.shape) / length
    met = (distance.reshape(length.shape) > 0) & (depth < 100)
    return np.where(met, depth, 0.0), np.where(met, ids[geom.reshape(length.shape)], 0)


def test_depth_and_classes_equal_c_mujocos_rays(world, jumble, drawn):
    scene, qpos, eye, forward = jumble
    axes = look_along(eye, forward).axes_w
    for i in range(len(scene)):
        depth, ids = c_mujoco(world, scene[i], qpos[i], eye[i], axes[i], LENS)
        assert np.mean(np.abs(drawn[0][i] - depth) < 1e-3) > 0.998  # the rest: rays that graze an edge
        assert np.mean(np.asarray(drawn[1][i]) == ids) > 0.998
    seen = set(np.unique(drawn[1]).tolist())
    assert {0, 2, 4, 5} <= seen and len(seen & {6, 7, 9, 10}) >= 3  # chair, table, door and small objects are in view


def test_both_orders_of_work_draw_the_same(boxes, jumble, drawn):
    scene, qpos, eye, forward = jumble
    scanned = jax.jit(RayRenderer(boxes, LENS, tiled=False).render_batch)(scene, qpos, look_along(eye, forward))
    assert np.mean(np.abs(scanned[0] - drawn[0]) < 1e-4) > 0.999
    assert np.mean(scanned[1] == drawn[1]) > 0.999


@pytest.mark.parametrize("tiled", [True, False])
def test_all_classes_are_told_apart_up_to_the_highest(tmp_path, tiled):
    rows = (("drawer", 0.7, -0.8, 5.0, 0.5), ("bed", 0.7, 0.0, 9.0, 0.5), ("coffee_table", 0.7, 0.8, 5.0, 0.5))
    scene = load_scene(write_room(tmp_path / "room", blocks=rows))
    world = build_world(get_robot("turtlebot"), (scene,), NavConfig.of(num_objects=0))
    qpos, eye = world.rest_qpos[:1].astype(np.float32), np.asarray([[-1.5, 0.0, 0.4]], np.float32)
    camera = look_along(eye, np.asarray([[1.0, 0.0, -0.1]], np.float32))
    renderer = RayRenderer(build_boxes(world, "all"), LENS, tiled)
    depth, ids = jax.jit(renderer.render_batch)(np.zeros(1, np.int32), qpos, camera)
    want = c_mujoco(world, 0, qpos[0], eye[0], camera.axes_w[0], LENS, "all")
    assert np.mean(np.asarray(ids[0]) == want[1]) > 0.998 and np.mean(np.abs(depth[0] - want[0]) < 1e-3) > 0.998
    assert set(np.unique(ids).tolist()) == {0, 16, 17, 34} and len(SEGMENTATIONS["all"].names) == 35


@pytest.mark.parametrize("size", [(20, 11), (37, 130)])
def test_sizes_that_tiles_do_not_divide(boxes, jumble, size):
    scene, qpos, eye, forward = (x[:2] for x in jumble)
    lens, camera = Lens(size[0], size[1], 80.0), look_along(eye, forward)
    tiled = jax.jit(RayRenderer(boxes, lens, tiled=True).trace_batch)(scene, qpos, camera)
    scanned = jax.jit(RayRenderer(boxes, lens, tiled=False).trace_batch)(scene, qpos, camera)
    assert tiled[0].shape == (2, size[1], size[0])
    assert np.mean(np.abs(tiled[0] - scanned[0]) < 1e-4) > 0.999
    assert np.mean(tiled[1] == scanned[1]) > 0.999


@pytest.mark.parametrize("size", [(68, 68), (40, 20)])
def test_in_view_is_what_no_side_of_the_picture_cuts_off(boxes, jumble, size):
    scene, qpos, eye, forward = jumble
    lens, pose = Lens(size[0], size[1], 80.0), look_along(eye, forward)
    seen = np.asarray(in_view(camera_boxes(boxes, scene, qpos, pose), lens))
    # By corners: [N, B, 8, 3] ahead, to the right and up.
    centre, axes = box_poses(boxes, scene, qpos)
    half, signs = np.asarray(boxes.half_m)[scene], np.array(list(itertools.product((-1, 1), repeat=3)))
    corners = centre[:, :, None] + np.einsum("nbij,kj,nbj->nbki", axes, signs, half) - pose.pos_w[:, None, None]
    ahead, right, up = np.moveaxis(np.einsum("nji,nbkj->nbki", pose.axes_w, corners), -1, 0)
    high, wide = math.tan(math.radians(40)), math.tan(math.radians(40)) * size[0] / size[1]
    cut = [ahead < 0.01, right > wide * ahead, right < -wide * ahead, up > high * ahead, up < -high * ahead]
    want = (half[..., 0] >= 0) & ~np.any([side.all(-1) for side in cut], 0)
    assert np.mean(seen == want) > 0.99 and (seen | ~want).all() and not seen.all() and seen.any()
    _, index = jax.jit(RayRenderer(boxes, lens, tiled=False).trace_batch)(scene, qpos, pose)
    drawn = [np.unique(image[(image >= 0) & (image < boxes.num_boxes)]) for image in np.asarray(index)]
    assert all(seen[i][own].all() for i, own in enumerate(drawn))


def test_depth_is_measured_along_the_optical_axis(world, boxes):
    # Scene 0: a wall at x = 2. From x = 0.5 and 0.3 m up its depth is 1.5 all over, and the floor's in a row that
    # looks down by `u` per unit of depth is 0.3 / u. The top of the wall is at 1.2 m; above it nothing is met.
    qpos = world.rest_qpos[:1].astype(np.float32)
    camera = look_along(jnp.asarray([[0.5, 1.2, 0.3]]), jnp.asarray([[1.0, 0.0, 0.0]]))
    depth, ids = (
        np.asarray(x)[0] for x in jax.jit(RayRenderer(boxes, LENS).render_batch)(np.zeros(1, np.int32), qpos, camera)
    )
    rows = LENS.rows
    assert rows[0] == pytest.approx(math.tan(math.radians(60)) * 67 / 68)
    column = 33
    low, high = 0.3 / 1.5, 0.9 / 1.5
    on_wall = (rows > -low) & (rows < high)
    np.testing.assert_allclose(depth[on_wall, column], 1.5, rtol=1e-5)
    np.testing.assert_allclose(depth[rows < -low, column], 0.3 / -rows[rows < -low], rtol=1e-5)
    assert (depth[rows > high + 0.1, column] == 0).all() and (ids[:, column] == 0).all()


def test_padding_and_parked_objects_are_never_seen(world, boxes):
    # The camera looks over the parking lot from its corner: some of the four parked small objects, and nothing else.
    rest = world.rest_qpos[:1].astype(np.float32)
    camera = look_along(jnp.asarray([[198.5, 200.0, 0.4]]), jnp.asarray([[1.0, 0.0, 0.0]]))
    renderer, scene = RayRenderer(boxes, LENS), np.zeros(1, np.int32)
    _, index = jax.jit(renderer.trace_batch)(scene, rest, camera)
    bodies = {int(boxes.body[i]) for i in np.unique(index) if 0 <= i < boxes.num_boxes}
    assert bodies <= {0, 1, 2, 3} and bodies
    # From a room they are beyond the far plane.
    camera = look_along(jnp.asarray([[0.0, 0.0, 3.0]]), jnp.asarray([[1.0, 1.0, 0.0]]))
    depth, ids = jax.jit(renderer.render_batch)(scene, rest, camera)
    assert int(ids.max()) == 0 and float(depth[0, :34].max()) == 0.0


def test_nested_vmaps_reach_the_renderer_as_one_batch(boxes, jumble, drawn):
    scene, qpos, eye, forward = jumble
    renderer, executed = RayRenderer(boxes, LENS), []
    batch = renderer.images_batch

    def counted(names, scene, *rest):
        jax.debug.callback(lambda: executed.append(scene.shape[0]))
        return batch(names, scene, *rest)

    renderer.images_batch = counted  # type: ignore[method-assign]
    camera = look_along(eye, forward)
    folded = jax.tree.map(lambda x: jnp.asarray(x).reshape(2, 3, *x.shape[1:]), (scene, qpos, camera))
    out = jax.jit(jax.vmap(jax.vmap(depth_and_classes(renderer))))(*folded)
    np.testing.assert_allclose(out[0].reshape(drawn[0].shape), drawn[0], atol=1e-5)
    jax.effects_barrier()
    assert executed == [6]


def test_a_broken_pose_draws_finite_numbers(boxes, jumble):
    scene, qpos, eye, forward = (x[:1] for x in jumble)
    depth, _ = jax.jit(RayRenderer(boxes, LENS).render_batch)(scene, qpos * np.nan, look_along(eye, forward))
    assert np.isfinite(depth).all()


def test_beams_of_a_scanner_meet_walls_at_their_distance(world, boxes):
    # Scene 0 is 4 x 3 m with a cube of 0.4 m at x = 0.7.
    rest = jnp.asarray(world.rest_qpos[0], jnp.float32)
    beams = jnp.asarray([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, -1], [0, 0, 1]])
    distance = cast_fan(boxes, jnp.int32(0), rest, jnp.asarray([-1.0, 0.0, 0.2]), beams)
    np.testing.assert_allclose(distance, [1.5, 1.5, 1.0, 0.2, np.inf], atol=0.01)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_WARP, reason="the package warp-lang (extra 'warp') is not installed")
def test_mjx_warp_draws_the_same(world, boxes, jumble, drawn):
    from interactive_nav.sensing.warp import WarpRenderer

    scene, qpos, eye, forward = jumble
    # Chairs get the highest number of all.
    boxes = boxes.replace(class_id=jnp.where(boxes.class_id == 2, jnp.uint8(32), boxes.class_id), classes="all")
    renderer = WarpRenderer(boxes, LENS)
    camera = look_along(eye, forward)
    draw = jax.jit(jax.vmap(depth_and_classes(renderer)))
    depth, ids = draw(scene, qpos, camera)
    assert np.mean(np.abs(depth - drawn[0]) < 0.01) > 0.99
    assert np.mean(ids == np.where(drawn[1] == 2, 32, drawn[1])) > 0.99 and (np.asarray(ids) == 32).any()
    # The same program with everything elsewhere: scenes swapped between environments, objects and cameras moved.
    roll = jax.tree.map(lambda x: jnp.roll(jnp.asarray(x), 1, 0), (scene, qpos, camera))
    moved = (roll[0], roll[1], CameraPose(roll[2].pos_w + 0.1, roll[2].axes_w))
    want = jax.jit(RayRenderer(boxes, LENS).render_batch)(*moved)
    got = draw(*moved)
    assert np.mean(np.abs(got[0] - want[0]) < 0.01) > 0.99 and np.mean(got[1] == want[1]) > 0.99
    assert np.mean(np.abs(got[0] - depth) > 0.01) > 0.5
    # Colours and normals are made from the boxes that either has met.
    boxes = build_boxes(world, "all", colours=True)
    renderers = [kind(boxes, LENS) for kind in (RayRenderer, WarpRenderer)]  # kept while their programs run
    every = [jax.jit(functools.partial(r.images_batch, ("rgb", "normals")))(*moved) for r in renderers]
    for name in ("rgb", "normals"):
        assert np.mean(np.abs(every[0][name] - every[1][name]).max(-1) < 1e-4) > 0.99
