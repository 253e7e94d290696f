"""Observations beside the task's own: hand-made poses in a room of known size, noise, and the batched loop."""

import dataclasses
import math
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav.camera_config import KINECT
from interactive_nav.config import NavConfig
from interactive_nav.physics import PhysicsState
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing.base import draw_look
from interactive_nav.sensing.boxes import FLOOR_COLOUR
from interactive_nav.sensing.sensors import Sensors, stream
from interactive_nav.task.terms import TERMS, Moment, advance_odometry
from interactive_nav.task.wrappers import AutoResetEnv
from interactive_nav.types import NavInfo
from interactive_nav_common.errors import UserError
from interactive_nav_common.rotations import matrix_from_quat

YAW = 0.3
SEES = {"observations": ("depth",)}
ALL = ("goal", "velocity", "waypoints", "localisation", "odometry", "collision", "joints", "lidar")


@pytest.fixture(scope="module")
def world(room):
    return build_world(get_robot("turtlebot"), (load_scene(room),), NavConfig.of(num_objects=0))


@pytest.fixture(scope="module")
def moment(world):
    """Physics and task memory of a robot at (-1, 0.2), yaw 0.3, that has just met the cube."""
    layout = world.layout
    qpos = world.rest_qpos[0].astype(np.float32)
    at = layout.robot_qpos
    qpos[at : at + 7] = [-1.0, 0.2, 0.0, math.cos(YAW / 2), 0, 0, math.sin(YAW / 2)]
    qpos[at + 7 : at + 9] = [7.0, -0.5]
    qvel = np.zeros(world.models[0].nv, np.float32)
    qvel[layout.robot_qvel + 6 : layout.robot_qvel + 8] = [3.0, -2.0]
    zeros: dict[str, Any] = {field.name: jnp.zeros((), jnp.int32) for field in dataclasses.fields(NavInfo)}
    told = {
        "goal_xy_w": jnp.zeros(2),
        "robot_pos_w": jnp.asarray([-1.0, 0.2, 0.0]),
        "yaw_rad": jnp.asarray(YAW),
        "waypoints_b": jnp.zeros((10, 2)),
        "step_count": jnp.asarray(7, jnp.int32),
        "memory": {
            "odometry": jnp.asarray([0.5, -0.1, 4.0]),
            "touching": jnp.asarray([True, False]),
        },
    }
    fields: dict[str, Any] = zeros | told
    nav = NavInfo(**fields)
    return PhysicsState(jnp.asarray(qpos), jnp.asarray(qvel), jnp.asarray(qvel)), nav, jax.random.PRNGKey(5)


def sense(world, moment, **settings):
    sensors = Sensors(world, NavConfig.of(num_objects=0, **settings), "native")
    physics, nav, rng = moment
    rotation = matrix_from_quat(physics.qpos[world.layout.robot_qpos + 3 :][:4])
    at = Moment(NavConfig(), None, 1.0, nav, physics, rotation)  # type: ignore[arg-type]
    parts = [t for t in TERMS if t.kind == "observation" and t.name in sensors.sizes]
    remembered = {t.name: t.value(nav.memory[t.name], at) for t in parts if t.value}
    return sensors, jax.jit(sensors.observe)(physics, nav, rng, remembered)


def test_signals_stand_behind_the_tasks_29_numbers(world, moment):
    sensors, obs = sense(world, moment, observations=ALL, lidar_rays=4, lidar_fov_deg=360.0, lidar_range_m=4.0)
    assert sensors.observation_size == obs.shape[0] == 29 + 3 + 3 + 2 + 4 + 4
    names = ["waypoints", "goal", "velocity", "localisation", "odometry", "collision", "joints", "lidar"]
    assert list(sensors.sizes) == names
    part = dict(zip(names, np.split(np.asarray(obs), np.cumsum(list(sensors.sizes.values()))[:-1]), strict=True))
    np.testing.assert_allclose(part["localisation"], [-1.0, 0.2, YAW], atol=1e-6)
    np.testing.assert_allclose(part["odometry"], [0.5, -0.1, 4.0 - 2 * np.pi], atol=1e-6)
    np.testing.assert_array_equal(part["collision"], [1.0, 0.0])
    # Wheels turn without limit: angles are wrapped.
    np.testing.assert_allclose(part["joints"], [7.0 - 2 * np.pi, -0.5, 3.0, -2.0], atol=1e-5)
    # The room's walls are x = +/- 2, y = +/- 1.5; beams go backwards, to the right, ahead and to the left of yaw 0.3,
    # 0.37 m above the floor, where the cube (x = 0.7, height 0.4) is: ahead, its face x = 0.5 is missed to the left.
    s, c = math.sin(YAW), math.cos(YAW)
    back, right, left = 1.0 / c, 1.7 / c, 1.3 / c
    ahead = min(3.0 / c, 1.3 / s)
    np.testing.assert_allclose(part["lidar"] * 4.0, [back, right, ahead, left], atol=2e-3)


def test_images_have_the_keys_and_numbers_that_learners_expect(world, moment):
    sensors, obs = sense(world, moment, observations=("goal", "depth", "segmentation"))
    assert sensors.observation_size == {k: v.shape for k, v in obs.items()}
    assert sensors.observation_size == {
        "state": (3,),
        "pixels/depth": (68, 68, 1),
        "pixels/segmentation": (68, 68, 1),
    }
    depth, ids = (np.asarray(obs[f"pixels/{k}"])[..., 0] for k in ("depth", "segmentation"))
    assert depth.dtype == np.float32 and depth.min() >= 0 and depth.max() <= 1
    # The only object is a chair, id 2 of 11.
    assert set(np.unique(np.round(ids * 11, 5))) == {0.0, 2.0}
    # Bottom row, middle: the floor, 0.272 m below the camera, at depth 0.272 / tan(59.55 degrees) of 5 m.
    assert depth[-1, 33] == pytest.approx(0.272 / (math.tan(math.radians(60)) * 67 / 68) / 5, rel=0.01)
    for dtype, unit in (("uint8", 255), ("float16", 1)):
        _, coarse = sense(world, moment, observations=("depth", "segmentation"), image_dtype=dtype)
        assert set(coarse) == {"pixels/depth", "pixels/segmentation"}
        assert coarse["pixels/depth"].dtype == jnp.dtype(dtype)
        got = np.asarray(coarse["pixels/depth"], np.float32)[..., 0] / unit
        np.testing.assert_allclose(got, depth, atol=0.5 / 255 + 1e-6 if unit == 255 else 1e-3)


@pytest.mark.parametrize(("dtype", "unit"), [("float32", 1), ("float16", 1), ("uint8", 255)])
def test_colours_and_normals_stand_beside_the_other_images(world, moment, dtype, unit):
    names = ("depth", "segmentation", "rgb", "normals")
    sensors, obs = sense(world, moment, observations=names, image_dtype=dtype, image_size=32)
    assert sensors.observation_size == {f"pixels/{n}": (32, 32, 3 if n in names[2:] else 1) for n in names}
    assert {name: value.shape for name, value in obs.items()} == sensors.observation_size
    assert obs["pixels/rgb"].dtype == jnp.dtype(dtype)
    # Normals have signs: they are never u8.
    assert obs["pixels/normals"].dtype == (jnp.float32 if unit == 255 else jnp.dtype(dtype))
    # Bottom row, middle: the floor, lit by the sun alone.
    np.testing.assert_allclose(obs["pixels/normals"][-1, 16], [0, 1, 0], atol=1e-3)
    light = 0.45 + 0.4 * 0.9 / math.hypot(0.35, 0.25, 0.9)
    got = np.asarray(obs["pixels/rgb"][-1, 16], np.float32) / unit
    np.testing.assert_allclose(got, light * np.array(FLOOR_COLOUR), atol=0.5 / 255 + 1e-6)


def test_noise_is_off_by_default_and_drawn_by_key_and_step(world, moment):
    clean = np.asarray(sense(world, moment, observations=("depth",))[1]["pixels/depth"])
    noisy = {"observations": ("depth",), "depth_dropout": 0.2, "depth_noise": 0.05}
    sensors, first = sense(world, moment, **noisy)
    first = np.asarray(first["pixels/depth"])
    seen = clean > 0
    lost = seen & (first == 0)
    assert lost.sum() / seen.sum() == pytest.approx(0.2, abs=0.03)
    error = first[seen & ~lost & (clean < 0.8)] / clean[seen & ~lost & (clean < 0.8)] - 1
    assert error.std() == pytest.approx(0.05, rel=0.1) and abs(error.mean()) < 0.005
    physics, nav, rng = moment
    again = np.asarray(jax.jit(sensors.observe)(physics, nav, rng)["pixels/depth"])
    later = np.asarray(
        jax.jit(sensors.observe)(physics, nav.replace(step_count=nav.step_count + 1), rng)["pixels/depth"]
    )
    np.testing.assert_array_equal(again, first)
    assert ((later == 0) != (first == 0)).mean() > 0.1
    beams = {"observations": ("lidar",), "lidar_rays": 400}
    scan, bad = sense(world, moment, **beams)[1], sense(world, moment, **beams, lidar_dropout=0.1)[1]
    assert (np.asarray(bad) == 1).mean() - (np.asarray(scan) == 1).mean() == pytest.approx(0.1, abs=0.05)


def test_odometry_adds_up_to_the_pose_in_the_starts_frame():
    rng = np.random.default_rng(0)
    yaw = 2.0 + np.cumsum(np.append(0.0, rng.normal(0, 0.3, 30)))
    path = np.vstack([[1.0, -2.0], [1.0, -2.0] + np.cumsum(rng.normal(0, 0.1, (30, 2)), 0)])
    step, pose, off = jax.jit(advance_odometry), jnp.zeros(3), jnp.zeros(3)
    for t in range(30):
        moved = path[t + 1] - path[t]
        pose = step(pose, moved, yaw[t], yaw[t + 1] - yaw[t], np.zeros(2))
        off = step(off, moved, yaw[t], yaw[t + 1] - yaw[t], np.array([0.1, 0.1]))
    c, s = math.cos(yaw[0]), math.sin(yaw[0])
    want = np.array([[c, s], [-s, c]]) @ (path[-1] - path[0])
    np.testing.assert_allclose(pose, [*want, yaw[-1] - yaw[0]], atol=1e-4)
    assert float(off[2]) == pytest.approx(1.1 * (yaw[-1] - yaw[0]), rel=1e-4)


def test_a_batched_loop_draws_once_a_step_and_shows_new_episodes(room):
    env = interactive_nav.make(
        "turtlebot",
        [room],
        backend="native",
        num_objects=1,
        episode_steps=3,
        image_size=32,
        observations=("goal", "odometry", "collision", "depth", "segmentation"),
    )
    auto, drawn = AutoResetEnv(env), []
    assert env.sensors.renderer is not None
    draw = env.sensors.renderer.render_batch

    def counted(scene, *rest):
        jax.debug.callback(lambda: drawn.append(scene.shape[0]))
        return draw(scene, *rest)

    env.sensors.renderer.render_batch = counted  # type: ignore[method-assign]
    state = jax.jit(auto.reset)(jax.random.split(jax.random.PRNGKey(0), 4))
    step, observe = jax.jit(auto.step), jax.jit(jax.vmap(env.observe))
    shapes = jax.tree.map(lambda x: x.shape[1:], state.obs)
    assert shapes == env.observation_size == auto.observation_size
    first = state
    for t in range(3):
        drawn.clear()
        state = step(state, jnp.full((4, 2), 0.3))
        jax.block_until_ready(state)
        jax.effects_barrier()
        assert drawn == [4]
        if t == 0:
            assert (np.asarray(state.obs["state"])[:, 3] > 0.005).all()  # odometry: has driven ahead
    assert (np.asarray(state.done) == 1).all() and (np.asarray(state.info["nav"].step_count) == 0).all()
    assert (np.asarray(state.obs["state"])[:, 3:] == 0).all()
    fresh = observe(state).obs
    for key in state.obs:
        np.testing.assert_allclose(state.obs[key], fresh[key], atol=1e-6)
        assert np.abs(np.asarray(state.obs[key]) - np.asarray(first.obs[key])).max() > 0.05


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observations": ("dept",)}, "observations is .*dept.*, expected a choice from .*depth"),
        ({"image_dtype": "int8"}, "image_dtype is 'int8', expected one of float32, float16, uint8"),
        ({"segmentation_classes": 6}, "segmentation_classes is 6, expected one of 4, 5, all"),
        ({"depth_dropout": 1.5}, "depth_dropout is 1.5, expected between 0 and 1"),
        ({"lidar_pos_m": (0.0, 0.1)}, "lidar_pos_m is .*, expected a list of 3"),
        ({"image_fov_deg": 180.0}, "image_fov_deg is 180.0"),
        ({"image_size": 31}, "image_size is 31, expected between 32 and 512"),
        ({"cameras": [{"name": "left"}]}, "cameras is .*, which changes nothing here: expected one of depth"),
        ({"cameras": [{}], **SEES}, r"cameras have the names \[''\], expected a different one for each"),
        ({"cameras": [{"name": "a"}, {"name": "a"}], **SEES}, r"cameras have the names \['a', 'a'\], expected a diff"),
        ({"cameras": [{"name": "a", "size": 600}], **SEES}, "cameras: size is 600, expected between 32 and 512"),
        ({"cameras": [{"name": "a", "yaw": 9}], **SEES}, "cameras: unknown key 'yaw', did you mean 'yaw_deg'"),
        ({"cameras": [{"name": "a", "pos_m": [1]}], **SEES}, "cameras: pos_m is .1.0,., expected a list of 3"),
        ({"cameras": ["left"], **SEES}, "cameras.0. is 'left', expected a mapping"),
        ({"renderer": "opengl"}, "renderer is 'opengl', expected one of auto, warp, rays"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(UserError, match=message):
        NavConfig.of(**settings)


def test_no_sensor_uses_the_key_that_the_next_episode_is_drawn_from():
    key, step = jax.random.PRNGKey(7), jnp.asarray(0)
    names = ("depth", "lidar", "odometry")
    bases = [jax.random.fold_in(key, zlib.crc32(name.encode())) for name in names]
    used = [*bases, *(stream(key, name, step) for name in names)]
    drawn = [*jax.random.split(key), key, *jax.random.split(jax.random.split(key)[1], 6)]
    rows = np.stack([np.asarray(k) for k in (*used, *drawn)])
    assert len(np.unique(rows, axis=0)) == len(rows)
    for name, base in zip(names, bases, strict=True):
        np.testing.assert_array_equal(stream(key, name, step), jax.random.fold_in(base, 0))
    # What a small number does: the base of the depth's stream was the next episode's key.
    np.testing.assert_array_equal(jax.random.fold_in(key, 1), jax.random.split(key)[1])


def test_a_noisy_camera_reads_anew_each_step_of_what_its_renderer_drew(world, moment):
    images = {"observations": ("depth", "rgb"), "image_size": 32}
    clean = sense(world, moment, **images)[1]
    sensors, first = sense(world, moment, **images, **KINECT, rgb_noise=0.02)
    z, read = (np.asarray(obs["pixels/depth"])[..., 0] * 5 for obs in (clean, first))
    # Nearer than half a metre, seen at a grazing angle or behind an edge: a hole.
    assert (read[(z > 0) & (z < 0.48)] == 0).all() and 0.1 < (read == 0).mean() < 0.9
    kept = (read > 0) & (z < 3)
    assert (np.abs(read - z)[kept] < 6 * 0.0014 * z[kept] ** 2 + 1e-3).all() and kept.any()
    assert (read != z)[kept].mean() > 0.9
    error = np.asarray(first["pixels/rgb"] - clean["pixels/rgb"])
    assert error.std() == pytest.approx(0.02, rel=0.1)
    physics, nav, rng = moment
    later = jax.jit(sensors.observe)(physics, nav.replace(step_count=nav.step_count + 1), rng)
    assert (np.asarray(later["pixels/rgb"]) != np.asarray(first["pixels/rgb"])).mean() > 0.9


def test_several_cameras_look_each_its_own_way_with_its_own_lens(world, moment):
    images = {"observations": ("depth", "rgb", "goal"), "image_size": 33}
    alone = sense(world, moment, **images)[1]
    cameras = [
        {"name": "front"},
        {"name": "left", "yaw_deg": 90, "fov_deg": 60, "size": 49},
        {"name": "back", "yaw_deg": 180.0, "pitch_deg": 0, "pos_m": [0.0, 0.0, 0.5]},
    ]
    sensors, obs = sense(world, moment, **images, cameras=cameras)
    sides = {"front": 33, "left": 49, "back": 33}
    shapes = {f"pixels/{c}/{n}": (s, s, k) for c, s in sides.items() for n, k in (("depth", 1), ("rgb", 3))}
    assert {name: value.shape for name, value in obs.items()} == sensors.observation_size == {"state": (3,), **shapes}
    for name in ("depth", "rgb"):
        np.testing.assert_array_equal(obs[f"pixels/front/{name}"], alone[f"pixels/{name}"])
    # The robot's camera is 0.087 m behind and 0.0125 m right of (-1, 0.2), yaw 0.3; walls are x = +/- 2, y = +/- 1.5.
    s, c = math.sin(YAW), math.cos(YAW)
    left_m = (1.5 - (0.2 - 0.087 * s - 0.0125 * c)) / c
    assert float(obs["pixels/left/depth"][24, 24, 0]) * 5 == pytest.approx(left_m, abs=1e-3)
    assert float(obs["pixels/back/depth"][16, 16, 0]) * 5 == pytest.approx(1.0 / c, abs=1e-3)
    # One pixel up and aside of the middle, through a lens of 60 degrees: farther along the ray, as deep along the axis.
    assert sensors.cameras[1].lens.fov_deg == 60 and sensors.cameras[0].renderer is sensors.cameras[2].renderer
    noisy = sense(world, moment, **images, cameras=cameras, depth_dropout=0.5)[1]
    lost = [np.asarray(noisy[f"pixels/{name}/depth"] == 0)[16, :33] for name in sides]
    assert (lost[0] != lost[2]).any()


@pytest.mark.parametrize("geometry", ["boxes", "meshes"])
def test_a_robot_sees_its_own_body_where_that_is_asked_for(world, moment, geometry):
    if geometry == "meshes":
        pytest.importorskip("warp")
    images = {"observations": ("depth", "segmentation"), "image_size": 64, "image_geometry": geometry}
    _, blind = sense(world, moment, **images)
    sensors, obs = sense(world, moment, **images, robot_visible=True)
    assert not (np.round(np.asarray(blind["pixels/segmentation"]) * 11) == 1).any()
    mine = np.round(np.asarray(obs["pixels/segmentation"])[..., 0] * 11) == 1
    depth = np.asarray(obs["pixels/depth"])[..., 0] * 5
    # Below the camera, at (-0.087, -0.0125, 0.272), is a round plate of 0.16 m, its top at 0.201 m;
    # a rod stands on it at x = 0.13, under another plate.
    lens = sensors.lens
    right, up = np.meshgrid(lens.columns, lens.rows)
    plate = (0.272 - 0.201) / np.maximum(-up, 1e-6)
    x, y = plate - 0.087, -0.0125 - plate * right
    inside = np.maximum(abs(x), abs(y)) if geometry == "boxes" else np.hypot(x, y)
    low = up < -0.1
    on = low & (inside < 0.157) & (x < 0.12)
    assert mine[on].all() and on.sum() > 500
    np.testing.assert_allclose(depth[on], plate[on], atol=2e-4)
    assert (np.abs(depth - plate)[low & (inside > 0.161)] > 1e-3).all() and (low & (inside > 0.161)).sum() > 100
    assert mine[0, 32] and 0.4 < mine.mean() < 0.8
    np.testing.assert_array_equal(depth[~mine], np.asarray(blind["pixels/depth"])[..., 0][~mine] * 5)


@pytest.mark.parametrize("geometry", ["boxes", "meshes"])
def test_colours_and_light_are_drawn_once_an_episode(world, moment, geometry):
    if geometry == "meshes":
        pytest.importorskip("warp")
    images = {"observations": ("rgb", "segmentation"), "image_size": 32, "image_geometry": geometry}
    plain = sense(world, moment, **images)[1]["pixels/rgb"]
    sensors, obs = sense(world, moment, **images, random_colours=0.2)
    observe, (physics, nav, rng) = jax.jit(sensors.observe), moment
    first, mask = np.asarray(obs["pixels/rgb"]), np.round(np.asarray(obs["pixels/segmentation"])[..., 0] * 11)
    tint = draw_look(stream(rng, "look", jnp.asarray(0)), 0.2, 0.0, 4).tint
    assert np.log(tint).std() == pytest.approx(0.2, abs=0.06)
    floor = np.array(FLOOR_COLOUR)
    np.testing.assert_allclose(first[-1, 16] / plain[-1, 16], np.minimum(floor * tint[0], 1) / floor, rtol=1e-4)
    chair = np.argwhere(mask == 2)[0]
    at = tuple(chair)
    dull = np.asarray(plain)[at] * tint[2] < 0.5
    np.testing.assert_allclose((first[at] / np.asarray(plain)[at])[dull], np.asarray(tint[2])[dull], rtol=1e-4)
    later = observe(physics, nav.replace(step_count=nav.step_count + 1), rng)["pixels/rgb"]
    np.testing.assert_array_equal(later, first)
    assert np.abs(observe(physics, nav, jax.random.PRNGKey(6))["pixels/rgb"] - first).max() > 0.02
    _, lit = sense(world, moment, **images, random_light=0.3)
    look = draw_look(stream(rng, "look", jnp.asarray(0)), 0.0, 0.3, 4)
    assert np.linalg.norm(look.sun_w) == pytest.approx(1.0, abs=1e-5) and look.sun_w[2] > 0
    light = min(0.45 + 0.4 * float(look.sun_w[2]), 1.0) * float(look.brightness)
    np.testing.assert_allclose(lit["pixels/rgb"][-1, 16], np.minimum(light * floor, 1.0), rtol=1e-3)
