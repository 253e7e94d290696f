"""Where the camera is, against the environment's own mount; what it sees of a painted scene."""

import logging
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.sensing.sensors import make_mount
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens
from topological_nav.scenes import rendering
from topological_nav.scenes.rendering import CPU_IMAGES, SceneRenderer, batch_sizes, calls, camera_pose, shrink


def test_the_camera_stands_where_the_robots_mount_has_it():
    robot = get_robot("ttbot")
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
    robot.add_to(spec)
    model = spec.compile()
    mount = make_mount(model, robot.base_body, robot.camera)
    qpos = np.zeros((3, model.nq), np.float32)
    headings, places = np.array([0.0, 1.1, -2.5]), np.array([[0.0, 0.0], [2.0, -1.0], [-3.0, 4.0]])
    qpos[:, :2], qpos[:, 3], qpos[:, 6] = places, np.cos(headings / 2), np.sin(headings / 2)
    expected = mount.pose(qpos)  # type: ignore[arg-type]
    got = camera_pose(robot, places, headings, np.zeros(3))
    assert np.allclose(got.pos_w, expected.pos_w, atol=1e-6)
    assert np.allclose(got.axes_w, expected.axes_w, atol=1e-6)


def test_pitch_turns_the_view_up_and_leaves_the_place():
    robot = get_robot("ttbot")
    up = camera_pose(robot, np.zeros(2), np.array([0.0]), np.array([math.radians(30)]))
    assert np.allclose(up.axes_w[0, :, 0], [math.cos(math.radians(30)), 0, 0.5], atol=1e-6)
    assert np.allclose(up.pos_w[0], robot.camera.pos_m, atol=1e-6)


def test_a_camera_on_another_link_is_refused():
    with pytest.raises(UserError, match="the camera of 'fetch' sits on .* choose a robot with a camera on its base"):
        camera_pose(get_robot("fetch"), np.zeros(2), np.zeros(1), np.zeros(1))


def test_shrinking_takes_means_over_squares():
    image = np.arange(16, dtype=np.uint8).reshape(1, 4, 4, 1).repeat(3, -1)
    # Upper left square: 0 1 4 5, mean 2.5, rounded to even.
    assert shrink(image, 2)[0, :, :, 0].tolist() == [[2, 4], [10, 12]]
    assert (shrink(image, 1) == image).all()


def test_walls_have_their_colours_and_batches_of_any_size_their_order(painted):
    renderer = SceneRenderer(load_scene(painted), Lens(16, 12, 60.0))
    robot, n = get_robot("ttbot"), CPU_IMAGES[-1] + 3
    # Turning between the red walls on the left (looking along -x) and the green ones on the right.
    heading = np.where(np.arange(n) % 2 == 0, np.pi, 0.0)
    place = np.where((np.arange(n) % 2 == 0)[:, None], [-1.5, 0.0], [1.5, 0.0])
    images = renderer.draw(camera_pose(robot, place, heading, np.full(n, -0.2)))
    assert images.shape == (n, 12, 16, 3) and images.dtype == np.uint8
    middle = images[:, 5:8, 6:10].astype(float).mean((1, 2))
    red = middle[:, 0] > 2 * middle[:, 1]
    green = middle[:, 1] > 2 * middle[:, 0]
    assert (red == (np.arange(n) % 2 == 0)).all() and (green == ~red).all()
    assert (images[0] == images[2]).all() and (images[-1] == images[0]).all()


def test_images_do_not_depend_on_how_many_are_drawn_at_once(painted, monkeypatch):
    scene, lens, robot = load_scene(painted), Lens(16, 12, 60.0), get_robot("ttbot")
    pose = camera_pose(robot, np.array([-1.5, 0.0]), np.linspace(0.0, 6.0, 8), np.zeros(8))
    usual = SceneRenderer(scene, lens).draw(pose)
    monkeypatch.setattr(rendering, "batch_sizes", lambda *_: (3,))
    assert (SceneRenderer(scene, lens).draw(pose) == usual).all() and usual.std() > 10


@pytest.mark.parametrize("by", [1, 2, 3, 5, 16])
def test_shrinking_on_a_device_gives_the_same_levels(by):
    images = np.random.default_rng(by).integers(0, 256, (3, 4 * by, 6 * by, 3), np.uint8)
    images[0, :by, :by] = np.arange(by * by).reshape(by, by, 1) % 2  # means of a half, or near it
    device = jax.jit(shrink, static_argnums=1)(jnp.asarray(images), by)
    exact = images.reshape(3, 4, by, 6, by, 3).astype(float).mean((2, 4))
    assert isinstance(device, jax.Array) and device.dtype == np.uint8
    assert (np.asarray(device) == np.rint(exact)).all()
    assert (shrink(images, by) == np.rint(exact)).all()


def test_batches_grow_on_an_accelerator_as_far_as_memory_allows():
    assert batch_sizes(Lens(640, 480, 60.0), "cpu") == CPU_IMAGES
    assert batch_sizes(Lens(640, 480, 60.0), "gpu") == (8, 16, 32, 64, 128, 256)
    assert batch_sizes(Lens(64, 48, 60.0), "gpu")[-1] == 2048
    assert batch_sizes(Lens(4096, 4096, 60.0), "gpu") == (8,)


@given(count=st.integers(0, 200))
def test_a_cpu_draws_no_image_in_vain(count):
    assert sum(calls(count, CPU_IMAGES)) == count and set(calls(count, CPU_IMAGES)) <= set(CPU_IMAGES)


def test_calls_by_hand():
    assert calls(47, (1, 2, 6, 18)) == [18, 18, 6, 2, 2, 1]
    assert calls(0, (1,)) == [] and calls(3, (1,)) == [1, 1, 1]
    assert calls(19, (2, 4, 8)) == [8, 8, 4] and calls(3, (5,)) == [5] and calls(9, (8, 16)) == [16]


def test_each_call_takes_the_least_batch_that_serves(painted, monkeypatch):
    monkeypatch.setattr(rendering, "batch_sizes", lambda *_: (2, 4, 8))
    asked, make = [], rendering._painter

    def noted(*key):
        paint = make(*key)
        return lambda pos, *rest: asked.append(len(pos)) or paint(pos, *rest)

    monkeypatch.setattr(rendering, "_painter", noted)
    scene, lens, robot = load_scene(painted), Lens(16, 12, 60.0), get_robot("ttbot")
    pose = camera_pose(robot, np.array([-1.5, 0.0]), np.linspace(0.0, 6.0, 19), np.zeros(19))
    many = SceneRenderer(scene, lens, supersample=2)
    images = many.draw(pose)
    assert asked == [8, 8, 4]
    monkeypatch.undo()
    assert (images == SceneRenderer(scene, lens, supersample=2).draw(pose)).all() and images.std() > 10
    assert many.draw(camera_pose(robot, np.zeros((0, 2)), np.zeros(0), np.zeros(0))).shape == (0, 12, 16, 3)


def test_where_any_number_of_cameras_is_needs_no_compiling(caplog):
    # By JAX's arrays each number was compiled anew, in nearly every step of a large batch.
    with jax.log_compiles(), caplog.at_level(logging.DEBUG):
        for n in (11, 13, 17):
            pose = camera_pose(get_robot("ttbot"), np.zeros((n, 2)), np.linspace(0, 3, n), np.zeros(n))
            assert pose.axes_w.shape == (n, 3, 3) and pose.axes_w.dtype == np.float32
    assert not caplog.records, caplog.text
