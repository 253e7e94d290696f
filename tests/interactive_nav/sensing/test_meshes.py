"""Textured meshes by our own Warp kernel, on the CPU: against C MuJoCo's rays, and texels by hand."""

import functools
import gc
import weakref

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

from interactive_nav.config import NavConfig
from interactive_nav.pictures.scene_model import SCENE, SceneModel
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing import make_renderer
from interactive_nav.sensing.boxes import build_boxes
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.look import CameraPose, Lens, look_along, trace
from tests.toys import write_room

pytest.importorskip("warp")
LENS = Lens(32, 32, 100.0)


@pytest.fixture(scope="module")
def flats():
    """Two scenes, three environments with four small objects before a camera each; a function that draws them."""
    scenes = tuple(load_scene(f"scenes_mjcf/{name}") for name in ("apartment_0", "cedar"))
    world = build_world(get_robot("turtlebot"), scenes, NavConfig.of(num_objects=4))
    scene, rng = np.array([0, 1, 0], np.int32), np.random.default_rng(3)
    qpos, eyes = world.rest_qpos[scene].astype(np.float32), np.full((3, 3), 0.6, np.float32)
    for i, s in enumerate(scene):
        maps = scenes[s].maps
        row, column = rng.choice(np.argwhere(maps.traversable))
        eyes[i, :2] = np.asarray(maps.origin_w) + (np.array([column, row]) + 0.5) * maps.resolution_m
        for k in range(4):
            at = world.layout.slot_qpos[k]
            qpos[i, at : at + 3] = [eyes[i, 0] + 0.7, eyes[i, 1] - 0.3 + 0.2 * k, 0.02]
    camera = look_along(eyes, np.array([[1, 0.3, -0.1], [1, -0.3, -0.2], [-1, 0.2, -0.1]], np.float32))
    renderer = make_renderer(build_boxes(world), LENS, "auto", "native", world)
    draw = jax.jit(jax.vmap(functools.partial(renderer.images, ("rgb", "normals"))))
    return world, scene, qpos, camera, draw


def test_depth_classes_and_normals_equal_c_mujocos_rays(flats):
    world, scene, qpos, camera, draw = flats
    seen = jax.device_get(draw(scene, qpos, camera))
    classes = set()
    for i, s in enumerate(scene):
        model = SceneModel(world.robot, world.scenes[s], world.small_objects)
        model.pose(world, int(s), qpos[i])
        pose = CameraPose(camera.pos_w[i], camera.axes_w[i])
        ray, geom, depth, normal = trace(model.model, model.data, pose, LENS, SCENE)
        met = (geom >= 0) & (depth < 100)
        ids = np.where(met, model.class_id[geom], 0)
        classes |= set(ids.ravel().tolist())
        assert np.mean(seen["segmentation"][i] == ids) > 0.99
        assert np.mean(np.abs(seen["depth"][i] - np.where(met, depth, 0)) < 1e-3) > 0.99
        normal = np.where(((normal * ray).sum(-1) > 0)[..., None], -normal, normal) * met[..., None]
        forward, right, up = pose.axes_w.T
        want = np.stack([normal @ right, normal @ up, -(normal @ forward)], -1)
        assert np.mean(np.abs(seen["normals"][i] - want).max(-1) < 0.02) > 0.99
    assert len(classes) >= 4 and {6, 10} & classes


@pytest.mark.parametrize(("classes", "own"), [(4, {4, 6, 8}), (5, {11, 6, 8})])
def test_pictures_and_meshes_share_one_table_of_classes(tmp_path, classes, own):
    """The second basket is 8 and a desk 4, or apart from tables 11, pixel for pixel in both."""
    room = write_room(tmp_path / "room", blocks=(("desk", 0.7, 0.5, 9.0, 0.5),))
    config = NavConfig.of(num_objects=6, segmentation_classes=classes)
    world = build_world(get_robot("turtlebot"), (load_scene(room),), config)
    qpos = world.rest_qpos[:1].astype(np.float32)
    for k, at in enumerate(world.layout.slot_qpos[:6]):
        qpos[0, at : at + 2] = [-1.5 + 0.6 * k, -0.5]
    camera = look_along(np.array([[0.0, -1.2, 1.8]], np.float32), np.array([[0.0, 0.6, -1.0]], np.float32))
    renderer = make_renderer(build_boxes(world, classes), LENS, "auto", "native", world)
    _, ids = jax.jit(renderer.render_batch)(jnp.zeros(1, jnp.int32), jnp.asarray(qpos), camera)
    model = SceneModel(world.robot, world.scenes[0], world.small_objects, classes)
    model.pose(world, 0, qpos[0])
    _, geom, _, _ = trace(model.model, model.data, CameraPose(camera.pos_w[0], camera.axes_w[0]), LENS, SCENE)
    want = np.where(geom >= 0, model.class_id[geom], 0)
    assert np.mean(ids[0] == want) > 0.99
    assert own <= set(np.unique(ids)) == set(np.unique(want))


def test_what_moves_is_elsewhere_in_the_next_picture(flats):
    world, scene, qpos, camera, draw = flats
    before = jax.device_get(draw(scene, qpos, camera))
    moved = qpos.copy()
    at = world.layout.slot_qpos[:4]
    moved[0, at + 2] += 30.0
    after = jax.device_get(draw(scene, moved, camera))
    gone = (before["segmentation"][0] >= 6) & (before["depth"][0] < 1.5)
    assert gone.sum() > 10
    assert (after["depth"][0][gone] > before["depth"][0][gone]).all() and (after["segmentation"][0][gone] < 6).all()
    np.testing.assert_array_equal(after["rgb"][1:], before["rgb"][1:])


@pytest.mark.parametrize(("baked", "bent"), [(True, False), (False, False), (True, True)])
def test_texels_are_where_the_faces_coordinates_put_them(tmp_path, baked, bent):
    # A square of 0.4 m at x = 1 that faces a camera at the origin; its image: red, green over blue, white.
    folder = write_room(tmp_path / "room", blocks=(("chair", 1.5, 1.0, 5.0, 0.5),))
    image = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    Image.fromarray(image).save(folder / "assets" / "square.png")
    # Seen along x, +y is to the left: u grows to the right, v upwards.
    rows = ["v 0 0.2 -0.2", "v 0 -0.2 -0.2", "v 0 -0.2 0.2", "v 0 0.2 0.2", "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    faces = ["f 1/1 3/3 2/2", "f 1/1 4/4 3/3"]
    if bent:  # as if it were round; its back shows: to the left on the left, to the right on the right
        rows += ["vn 0.8 -0.6 0", "vn 0.8 0.6 0"]
        faces = ["f 1/1/1 3/3/2 2/2/2", "f 1/1/1 4/4/1 3/3/2"]
    (folder / "assets" / "square.obj").write_text("\n".join([*rows, *faces, ""]))
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    spec.add_texture(name="square", type=mujoco.mjtTexture.mjTEXTURE_2D, file=str(folder / "assets" / "square.png"))
    material = spec.add_material(name="square")
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "square"
    spec.add_mesh(
        name="square", file=str(folder / "assets" / "square.obj"), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    )
    square = spec.body("structure").add_geom(name="square", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="square")
    square.material, square.group, square.contype, square.conaffinity, square.pos = "square", 2, 0, 0, [1.0, 0, 0.5]
    spec.visual.headlight.ambient = [0.25 if baked else 0.1] * 3
    (folder / "scene.xml").write_text(spec.to_xml())
    world = build_world(get_robot("turtlebot"), (load_scene(folder),), NavConfig.of(num_objects=0))
    renderer = make_renderer(build_boxes(world), Lens(40, 40, 60.0), "auto", "native", world)
    camera = look_along(jnp.asarray([[0.0, 0.0, 0.5]]), jnp.asarray([[1.0, 0.0, 0.0]]))
    draw = jax.jit(functools.partial(renderer.images_batch, ("rgb",)))
    seen = jax.device_get(draw(jnp.zeros(1, jnp.int32), jnp.asarray(world.rest_qpos[:1], jnp.float32), camera))
    rgb, depth = seen["rgb"][0], seen["depth"][0]
    # A tenth of a metre beside the middle is 3.5 pixels from it; the square faces -x: no sun, all of the lamp.
    light = 1.0 if baked else 0.45 + 0.25
    for (row, column), texel in zip(((16, 16), (16, 23), (23, 16), (23, 23)), image.reshape(4, 3), strict=True):
        np.testing.assert_allclose(rgb[row, column], light * texel / 255, atol=1e-5)
        assert depth[row, column] == pytest.approx(1.0, abs=1e-5)
        # The camera's frame: right is -y. In the middle of the half, half of the corner's slant.
        slant = np.array([-0.3, 0, 0.8]) * [1 if column < 20 else -1, 1, 1] if bent else np.array([0, 0, 1])
        np.testing.assert_allclose(
            seen["normals"][0, row, column], slant / np.linalg.norm(slant), atol=0.02 if bent else 1e-5
        )


def test_rays_of_plain_jax_draw_no_meshes():
    with pytest.raises(ConfigError, match="renderer is 'rays', expected auto or warp with image_geometry=meshes"):
        NavConfig.of(observations=("rgb",), image_geometry="meshes", renderer="rays")


def test_a_program_outlives_the_renderer_that_it_draws_with(room):
    world = build_world(get_robot("turtlebot"), (load_scene(room),), NavConfig.of(num_objects=0))
    renderer = make_renderer(build_boxes(world), LENS, "auto", "native", world)
    camera = look_along(jnp.asarray([[-1.0, 0.0, 0.2]]), jnp.asarray([[1.0, 0.0, 0.0]]))
    at = jnp.zeros(1, jnp.int32), jnp.asarray(world.rest_qpos[:1], jnp.float32), camera
    draw = jax.jit(functools.partial(renderer.images_batch, ("rgb",))).lower(*at).compile()
    want, mesh = jax.device_get(draw(*at)["depth"]), weakref.ref(renderer._mesh)
    del renderer
    jax.clear_caches()
    gc.collect()
    assert mesh() is not None
    np.testing.assert_array_equal(draw(*at)["depth"], want)
    del draw
    gc.collect()
    assert mesh() is None
