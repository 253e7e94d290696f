"""Colours and normals of boxes, by hand, and how observations hold them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.boxes import FLOOR_COLOUR, build_boxes, visual_geoms
from interactive_nav.sensing.rays import RayRenderer
from scenes_mjcf.categories import CATEGORIES
from scenes_mjcf.look import SKY_COLOUR, Lens, geom_colour, look_along

SUN = np.array([0.35, 0.25, 0.9]) / np.linalg.norm([0.35, 0.25, 0.9])


@pytest.fixture(scope="module")
def near_cube(room):
    """A room whose only object, a chair of 0.4 m at (0.7, 0), is turned by 0.5 rad; a camera at x = -1 looks at it."""
    world = build_world(get_robot("turtlebot"), (load_scene(room),), NavConfig.of(num_objects=0))
    qpos = world.rest_qpos[:1].astype(np.float32)
    at = world.layout.slot_qpos[0]
    qpos[0, at : at + 7] = [0.7, 0.0, 0.2, np.cos(0.25), 0.0, 0.0, np.sin(0.25)]
    return world, qpos, look_along(jnp.asarray([[-1.0, 0.0, 0.2]]), jnp.asarray([[1.0, 0.0, 0.0]]))


def test_a_cube_shows_its_colour_and_its_faces_normals(near_cube):
    world, qpos, camera = near_cube
    tables = build_boxes(world, colours=True)
    draw = jax.jit(functools.partial(RayRenderer(tables, Lens(41, 41, 90.0)).images_batch, ("rgb", "normals")))
    seen = {name: np.asarray(value)[0] for name, value in draw(np.zeros(1, np.int32), qpos, camera).items()}
    # The ray of the middle pixel runs along x: it meets the face whose normal is -x, turned by 0.5 rad to
    # (-cos, -sin, 0), at 0.2 / cos 0.5 before the centre. Right of the camera is -y: (sin, 0, cos) in its frame.
    cos, sin = np.cos(0.5), np.sin(0.5)
    assert seen["segmentation"][20, 20] == 2
    assert seen["depth"][20, 20] == pytest.approx(1.7 - 0.2 / cos, abs=1e-5)
    np.testing.assert_allclose(seen["normals"][20, 20], [sin, 0, cos], atol=1e-6)
    # The sun is behind that face; the lamp at the camera shines along x.
    sun = max(0.0, float(np.dot([-cos, -sin, 0], SUN)))
    assert sun == 0.0
    light = 0.45 + 0.25 * cos
    np.testing.assert_allclose(seen["rgb"][20, 20], light * np.array(CATEGORIES["chair"].colour), atol=1e-6)
    # The floor faces up; the lamp does not light it. Above the walls there is nothing.
    np.testing.assert_allclose(seen["normals"][-1, 20], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(seen["rgb"][-1, 20], (0.45 + 0.4 * SUN[2]) * np.array(FLOOR_COLOUR), atol=1e-6)
    np.testing.assert_allclose(seen["rgb"][0, 20], SKY_COLOUR, atol=1e-6)
    assert not seen["normals"][0, 20].any() and seen["depth"][0, 20] == 0


def test_depth_and_masks_are_the_same_with_and_without_colours(world, boxes, jumble):
    scene, qpos, eye, forward = jumble
    camera, renderer = look_along(eye, forward), RayRenderer(build_boxes(world, colours=True), Lens(48, 32, 90.0))
    plain = jax.jit(functools.partial(renderer.images_batch, ("depth",)))(scene, qpos, camera)
    full = jax.jit(functools.partial(renderer.images_batch, ("depth", "rgb")))(scene, qpos, camera)
    assert np.mean(np.abs(full["depth"] - plain["depth"]) < 1e-3) > 0.998
    assert np.mean(full["segmentation"] == plain["segmentation"]) > 0.998
    length = np.linalg.norm(full["normals"], axis=-1)
    np.testing.assert_allclose(length, np.asarray(full["depth"]) > 0, atol=1e-5)


def test_a_bodys_colour_is_the_mean_of_its_texture():
    scene = load_scene("scenes_mjcf/apartment_0")
    model, visual = visual_geoms(scene)
    assert {m.name for m in scene.movables} | {"structure"} <= set(visual)
    name = scene.movables[0].name
    own = model.geom_bodyid == model.body(name).id
    (geom,) = np.flatnonzero(own & (model.geom_group == 2))
    assert visual[name] == [geom]
    world = build_world(get_robot("turtlebot"), (scene,), NavConfig.of(num_objects=1))
    tables = build_boxes(world, colours=True)
    assert tables.colour is not None and tables.colour.shape == (1, tables.num_boxes + 1, 3)
    walls = np.asarray(tables.colour)[0, :-1][tables.body == world.layout.num_slots]
    mean = np.mean([geom_colour(model, g) for g in visual["structure"]], 0)
    assert mean.min() > 0 and mean.max() <= 1
    np.testing.assert_allclose(walls, np.tile(mean, (len(walls), 1)), atol=1e-6)
    box = np.flatnonzero(tables.body == world.slots.names[0].index(name))[0]
    np.testing.assert_allclose(np.asarray(tables.colour)[0, box], geom_colour(model, int(geom)), atol=1e-6)
