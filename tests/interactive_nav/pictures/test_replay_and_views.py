"""Replays against the environment's own bookkeeping; rays against geometry by hand; videos and maps read back."""

import dataclasses
import itertools
import json
import math
import subprocess
import sys

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

import interactive_nav
from interactive_nav import record
from interactive_nav.interop import gym_env
from interactive_nav.pictures import replay
from interactive_nav.pictures.camera import (
    GOAL_COLOUR,
    OUTSIDE,
    FloorPaint,
    SceneView,
    depth_picture,
    mask_picture,
    robot_camera,
)
from interactive_nav.pictures.replay import EpisodePlayer, ReplayError
from interactive_nav.pictures.scene_model import SCENE, detach
from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import pick
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.slots import bodies_by_name
from interactive_nav.task.rollout import policy_key_of
from interactive_nav_common.errors import UserError
from interactive_nav_common.rotations import yaw_from_quat
from scenes_mjcf.categories import CATEGORIES, SEGMENTATIONS, class_id
from scenes_mjcf.look import Lens, look_along
from tests.gl_program import drawn, need_gl

CLASSES = SEGMENTATIONS[4].names
STEPS = 60


@pytest.fixture(scope="module")
def env(room):
    return interactive_nav.make("turtlebot", [room], backend="native", num_objects=3, episode_steps=STEPS, sleep=False)


def straight(observation, key):
    """Full speed ahead, with a little noise."""
    return jnp.array([0.4, 0.4]) + 0.1 * jax.random.normal(key, (2,))


@pytest.fixture(scope="module")
def played(env):
    return EpisodePlayer(env, straight, "straight", "by hand").play(jax.random.PRNGKey(3), episode=4)


def test_a_replay_is_what_the_environment_kept_account_of(env, played):
    key = jax.random.PRNGKey(3)
    state = jax.jit(env.reset)(key)
    step, policy_key = jax.jit(env.step), policy_key_of(key)
    robot, objects = [state.info["nav"].robot_pos_w], state.info["nav"].object_pos_w
    for t in range(played.num_steps):
        state = step(state, straight(state.obs, jax.random.fold_in(policy_key, t)))
        robot.append(state.info["nav"].robot_pos_w)
    nav = state.info["nav"]
    assert state.done and (played.policy, played.episode, played.label) == ("straight", 4, "by hand")
    np.testing.assert_allclose(played.body_pos_w[:, 0], robot, atol=2e-3)
    assert played.force_n.sum() == pytest.approx(float(nav.memory["force_sum_n"]), rel=0.02)
    assert played.touches_movable.sum() == nav.memory["interaction_steps"]
    assert played.touches_structure.sum() == nav.memory["structure_steps"]
    assert played.metrics["ins_0.5"] == pytest.approx(float(state.metrics["ins_0.5"]), abs=0.01)
    assert np.linalg.norm(np.diff(played.body_pos_w[:, 0], axis=0), axis=1).sum() == pytest.approx(
        played.metrics["robot_path_m"], abs=1e-3
    )
    # Small objects have their centre of mass above their origin: the same place in the plane.
    small = [played.bodies.index(name) for name in played.bodies if "_small_" in name]
    assert len(small) == 3
    np.testing.assert_allclose(played.body_pos_w[0, small, :2], objects[:3, :2], atol=0.03)
    np.testing.assert_allclose(np.linalg.norm(played.body_quat_w, axis=-1), 1, atol=1e-5)


def test_a_replay_survives_its_file(played, tmp_path):
    path = tmp_path / "deep" / "a.npz"
    replay.save_replay(played, path)
    back = replay.load_replay(path)
    for field in dataclasses.fields(played):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(played, field.name))
    assert list(path.parent.iterdir()) == [path]


def test_files_that_are_no_replays_are_refused(played, tmp_path):
    with pytest.raises(ReplayError, match="no such file"):
        replay.load_replay(tmp_path / "absent.npz")
    np.savez(tmp_path / "other.npz", x=1)
    (tmp_path / "text.npz").write_text("hello")
    replay.save_replay(played, tmp_path / "cut.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "cut.npz").read_bytes()[:-3000])
    for name in ("other", "text", "cut"):
        with pytest.raises(ReplayError, match=rf"{name}\.npz: not readable .*; record the episode again"):
            replay.load_replay(tmp_path / f"{name}.npz")
    np.savez(tmp_path / "older.npz", header=np.array(json.dumps({"format": 1})))
    with pytest.raises(ReplayError, match=r"older\.npz: its format is 1, expected 2; record the episode again"):
        replay.load_replay(tmp_path / "older.npz")


@pytest.fixture(scope="module")
def view(room):
    return SceneView(get_robot("turtlebot"), load_scene(room), pick(1))


IDENTITY = [1.0, 0.0, 0.0, 0.0]


def test_depth_and_classes_by_hand(view):
    """A room of 4 x 3 m with a cube of 0.4 m on the floor at (0.7, 0); the eye is at 0.3 m."""
    view.place(("chair_0",), np.array([[0.7, 0.0, 0.2]]), np.array([IDENTITY]))
    eye = look_along(np.array([-1.0, 0.0, 0.3]), np.array([1.0, 0, 0])), Lens(101, 101, 90.0)
    seen = view.render(*eye, SCENE)
    assert CLASSES[seen["segmentation"][50, 50]] == "chair" and seen["depth"][50, 50] == pytest.approx(1.5, abs=1e-5)
    # Beside the cube the wall, 3 m ahead of the eye: depth is along the axis, so equal over the wall.
    wall = seen["depth"][50, 75], seen["depth"][40, 30]
    assert wall == pytest.approx((3.0, 3.0), abs=1e-5)
    assert CLASSES[seen["segmentation"][50, 75]] == "structure"
    # The floor k rows below the middle is at depth 0.3 / (k / 50.5).
    assert seen["depth"][80, 50] == pytest.approx(0.3 * 50.5 / 30, rel=1e-5)
    # Away with the cube: the wall behind it, 0.3 m above the floor.
    view.place(("chair_0",), np.array([[0.7, 9.0, 0.2]]), np.array([IDENTITY]))
    assert view.render(*eye, SCENE)["depth"][50, 50] == pytest.approx(3.0, abs=1e-5)
    # Turned by 45 degrees it shows an edge: half a diagonal in front of its middle.
    turned = [math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]
    view.place(("chair_0",), np.array([[0.7, 0.0, 0.2]]), np.array([turned]))
    assert view.render(*eye, SCENE)["depth"][50, 50] == pytest.approx(1.7 - 0.2 * math.sqrt(2), abs=1e-3)


def test_the_robot_is_seen_from_outside_only(view):
    robot = get_robot("turtlebot")
    bodies = [b for b in range(view.model.nbody) if view.model.body(b).name == robot.base_body]
    assert len(bodies) == 1
    view.place((robot.base_body,), np.array([[-0.5, 0.3, 0.0]]), np.array([IDENTITY]))
    camera, lens = robot_camera(view, 33, 33)
    np.testing.assert_allclose(camera.pos_w, np.array([-0.5, 0.3, 0.0]) + robot.camera.pos_m, atol=1e-9)
    np.testing.assert_allclose(camera.axes_w[:, 0], [1, 0, 0], atol=1e-9)
    index = CLASSES.index("robot")
    assert not (view.render(camera, lens, SCENE)["segmentation"] == index).any()
    above = look_along(np.array([-1.5, 0.3, 2.0]), np.array([1.0, 0, -1.0])), Lens(60, 60, math.degrees(1.0))
    assert (view.render(*above, OUTSIDE)["segmentation"] == index).sum() > 20


def test_views_from_outside_have_shadows(view):
    """A lamp at 9 m, 2 m and 3 m off the middle, sees the cube of 0.4 m at (0.7, 0): its shadow is 0.14 m long in y."""
    view.place(("chair_0",), np.array([[0.7, 0.0, 0.2]]), np.array([IDENTITY]))
    down = look_along(np.array([0.7, 0.0, 3.0]), np.array([0.0, 0.0, -1.0])), Lens(101, 101, math.degrees(0.3))
    middle = view.render(*down, OUTSIDE)["rgb"].mean(-1)[50]
    pixel_m = 2 * 3.0 * math.tan(0.15) / 101
    # The middle row lies along y (a camera that looks straight down has -y on its right).
    beside = [middle[50 + side * round(0.23 / pixel_m)] for side in (-1, 1)]
    assert min(beside) / max(beside) == pytest.approx(0.83 / 1.13, rel=0.06)


def test_goal_and_path_are_painted_on_the_floor(view):
    down = look_along(np.array([-1.2, 0.0, 3.0]), np.array([1e-3, 0, -1.0])), Lens(41, 41, math.degrees(0.3))
    paint = FloorPaint(np.array([-1.2, 0.0]), 0.2, np.array([[-1.2, 0.3]]))
    plain, painted = view.render(*down, OUTSIDE)["rgb"], view.render(*down, OUTSIDE, paint)["rgb"]
    changed = (plain != painted).any(-1)
    # A disc of 0.2 m and a dot of 0.04 m, in a view of 2 * 3 m * tan(0.15).
    share = (math.pi * 0.2**2 + math.pi * 0.04**2) / (2 * 3.0 * math.tan(0.15)) ** 2
    assert changed.mean() == pytest.approx(share, rel=0.1)
    ring = painted[20, 20 + round(0.18 / (2 * 3.0 * math.tan(0.15)) * 41)] / 255
    assert np.argmax(ring) == np.argmax(GOAL_COLOUR)


def test_pictures_show_the_episodes_own_models_and_goal(room, played, tmp_path, monkeypatch):
    told = dataclasses.replace(played, small_objects="test", segmentation_classes=5, success_distance_m=0.7)
    replay.save_replay(told, tmp_path / "a.npz")
    told = replay.load_replay(tmp_path / "a.npz")
    assert (told.small_objects, told.segmentation_classes, told.success_distance_m) == ("test", 5, 0.7)
    names = [f"{o.category}_small_{i}" for i, o in enumerate(pick(3, "test"))]
    shown = bodies_by_name(load_scene(room), told.small)
    view = record.Compositor(told, load_scene(room), height=120)._view
    for name, obj in zip(names, pick(3, "test"), strict=True):
        halves = [box.half_m for box in obj.boxes]
        np.testing.assert_allclose(shown[name].rows[:, 7:], halves)
        body = view.model.body(name)
        np.testing.assert_allclose(view.model.geom_size[body.geomadr[0] : body.geomadr[0] + body.geomnum[0]], halves)
    painted, made = [], record.drawing.FloorPaint
    monkeypatch.setattr(record.drawing, "FloorPaint", lambda *of: painted.extend(of[1:2]) or made(*of))
    record.Compositor(told, load_scene(room), height=120).frame(0)
    assert painted.pop() == 0.7


def test_the_robots_pictures_have_the_episodes_field_of_view(room, env, played):
    assert played.image_fov_deg == env.sensors.lens.fov_deg == env.robot.camera.fov_deg
    usual, narrow = (
        record.Compositor(dataclasses.replace(played, image_fov_deg=fov), load_scene(room), height=120).frame(0)
        for fov in (played.image_fov_deg, 40.0)
    )
    np.testing.assert_array_equal(narrow[:, :160], usual[:, :160])
    assert all((narrow[at : at + 40, 160:] != usual[at : at + 40, 160:]).any() for at in (0, 40))


def test_a_policy_draws_from_another_key_than_the_environment(env):
    key = jax.random.PRNGKey(3)
    own = jax.jit(env.reset)(key).info["rng"]
    assert (own == jax.random.fold_in(key, 0)).all() and (policy_key_of(key) != own).any()


def test_importing_and_drawing_leave_matplotlibs_backend_alone():
    code = """
import matplotlib
matplotlib.use("svg")
from matplotlib import pyplot
import interactive_nav.record
print(matplotlib.get_backend(), pyplot.get_fignums())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().splitlines()[-1].lower() == "svg []"


def test_a_body_that_is_not_there_is_refused(view):
    with pytest.raises(UserError, match="no body 'lamp_0' in this scene with robot 'turtlebot'"):
        view.place(("lamp_0",), np.zeros((1, 3)), np.array([IDENTITY]))


def test_pictures_of_depth_and_classes():
    depth = depth_picture(np.array([[1e-6, 2.5, 5.0, 0.0]]))
    assert depth[0, :, 0].tolist() == [254, 63, 0, 0]  # (1 - d / 5)^2
    mask = mask_picture(np.array([[0, CLASSES.index("shoe")]], np.uint8), np.array([[0.0, 1.0]]))
    assert mask[0, 0].tolist() == [0, 0, 0] and mask[0, 1].tolist() == [204, 71, 76]
    bed = mask_picture(np.array([[class_id("bed", "all")]], np.uint8), np.ones((1, 1)), "all")[0, 0]
    assert bed.tolist() == [int(255 * value) for value in CATEGORIES["bed"].colour]


@pytest.fixture(scope="module")
def compositor(played, room):
    return record.Compositor(played, load_scene(room), height=120)


def test_a_video_holds_the_frames_that_were_composed(compositor, played, tmp_path):
    out = tmp_path / "out.mp4"
    count = record.write_video(compositor, out, every=20)
    assert count == -(-played.num_steps // 20) + 1
    reader = imageio_ffmpeg.read_frames(str(out))
    meta = next(reader)
    assert meta["size"] == compositor.size == (200, 140) and meta["fps"] == pytest.approx(0.5)
    frames = [np.frombuffer(x, np.uint8).reshape(140, 200, 3) for x in reader]
    assert len(frames) == count + round(1.5 * 0.5)
    for got, step in ((frames[0], 0), (frames[-1], played.num_steps)):
        want = compositor.frame(step)
        assert np.abs(got.astype(int) - want).mean() < 6  # lossy
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 6  # something happened
    assert list(tmp_path.iterdir()) == [out]


def test_parts_of_a_frame(compositor, played):
    """Behind: the robot in the middle column; beside it 68 x 68 depth and mask, enlarged."""
    frame = compositor.frame(0)
    assert frame.shape == (140, 200, 3) and frame.dtype == np.uint8
    depth = frame[40:80, 160:]
    assert (depth == depth[..., :1]).all()  # grey
    np.testing.assert_array_equal(frame[120:, -1], np.broadcast_to([24, 28, 36], (20, 3)))
    assert (frame[:120, :160].std((0, 1)) > 5).all()


@pytest.mark.parametrize("height", [240, 360, 720])
def test_words_of_a_caption_stand_apart_within_the_frame(played, room, height):
    film = record.Compositor(played, load_scene(room), height=height)
    for step in (0, 20, played.num_steps):
        strip = film._caption(step)
        inked = np.asarray((strip[len(strip) // 2 :] > 120).any((0, 2)))
        assert not inked[-height // 60 :].any()
        gaps = [
            len(list(run)) for ink, run in itertools.groupby(inked[inked.argmax() : -inked[::-1].argmax()]) if not ink
        ]
        # Spaces are 0.32 em, the letters at most 0.15 em from each other.
        words = {0: "0.0 s reward 0.00 force 0.0 N", 20: "2.0 s reward 0.0 force 0.0 N touches nothing"}
        end = "6.0 s failed P_eff 0.0 E_eff 0.0 INS_0.5 0.0"
        count = len(words.get(step, end).split())
        assert sum(gap >= 0.2 * height / 28 + 0.9 for gap in gaps) in (count - 1, count), (step, gaps)


FILM = """
import sys, weakref, numpy as np
early = weakref.finalize(sys.modules["numpy"], print)  # programs that JAX compiles make some before there is a GL
from interactive_nav import record
from interactive_nav.pictures.camera import Painter
from interactive_nav.pictures.replay import load_replay
from interactive_nav.scenes.scene import load_scene
replay = load_replay(sys.argv[2])
film = record.Compositor(replay, load_scene(replay.scene), height=120, views=("eye", "above"))
film._view._painter = Painter(sys.argv[3])
eye, _ = film._camera("eye", 0)
above, lens = film._camera("above", 0)
np.savez(sys.argv[1], frame=film.frame(replay.num_steps), eye=eye.pos_w, above=above.pos_w, pixel=lens.pixel)
"""


@pytest.mark.parametrize("engine", ["rays", "gl"])
def test_a_film_from_eye_height_and_from_above(played, tmp_path, engine):
    if engine == "gl":
        need_gl()
    replay.save_replay(played, tmp_path / "a.npz")
    made = drawn(FILM, tmp_path, tmp_path / "a.npz", engine)
    frame, above = made["frame"], made["above"]
    assert frame.shape == (140, 320, 3)
    # The room is 4 by 3 m; whoever films stands in it, behind the robot.
    x, y, z = made["eye"]
    assert abs(x) < 2.0 and abs(y) < 1.5 and z <= 1.5 + 1e-6
    assert (played.body_pos_w[0, 0, :2] - (x, y)) @ (played.robot_xy_w[20] - played.robot_xy_w[0]) > 0.02
    # From above the goal is where a pinhole puts it, x to the right and y up, lighter within than grass.
    at = (played.goal_xy_w - above[:2]) / above[2] / made["pixel"]
    column, row = 160 + 80 + at[0], 60 - at[1]
    red, green, blue = frame[int(row), int(column)].astype(int)
    assert green > red + 15 and green > blue + 15
    assert np.abs(frame[:120, :160].astype(int) - frame[0, 0]).max() > 50


def test_a_camera_stays_behind_or_beside_a_robot_that_backs_off(played, room):
    pos_w, quat = played.body_pos_w.copy(), played.body_quat_w.copy()
    pos_w[:, 0, :2] = np.stack([np.linspace(1.0, 0.0, len(pos_w)), np.zeros(len(pos_w))], -1)
    quat[:, 0] = IDENTITY
    backs = dataclasses.replace(played, body_pos_w=pos_w, body_quat_w=quat)  # along -x, looking along +x
    film = record.Compositor(backs, load_scene(room), height=120, views=("eye", "beside"))
    for view, turn_rad in (("eye", 0.0), ("beside", record._BESIDE_RAD)):
        away = film._cameras[view][:, :2] - film._target[:, :2]
        np.testing.assert_allclose(np.abs(np.arctan2(away[:, 1], -away[:, 0])), turn_rad, atol=1e-3)


def test_a_gif_and_refusals(played, room, two_rooms, tmp_path, capsys):
    path = tmp_path / "a.npz"
    replay.save_replay(played, path)
    arguments = [str(path), "--height", "120", "--every", "30"]
    assert record.main([*arguments, "-o", str(tmp_path / "a.gif")]) == 0
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == -(-played.num_steps // 30) + 1 and gif.size == (200, 140)
    capsys.readouterr()
    assert record.main([*arguments, "--views", "above", "-o", str(tmp_path / "a.webp")]) == 0
    with Image.open(tmp_path / "a.webp") as film:
        assert film.n_frames == -(-played.num_steps // 30) + 1 and film.size == (160, 140)
    capsys.readouterr()
    assert record.main([*arguments, "-o", str(tmp_path / "a.avi")]) == 2
    assert "ends in '.avi', expected one of .mp4, .gif, .webp" in capsys.readouterr().err
    assert record.main([str(path), "--height", "125"]) == 2
    assert "height is 125, expected a multiple of 12" in capsys.readouterr().err
    other = dataclasses.replace(played, scene=str(two_rooms))
    replay.save_replay(other, tmp_path / "b.npz")
    assert record.main([str(tmp_path / "b.npz"), "-o", str(tmp_path / "b.gif")]) == 2
    assert "has changed since the replay was recorded" in capsys.readouterr().err
    assert not (tmp_path / "b.gif").exists()


def test_gymnasium_renders_the_view_from_behind(room):
    settings = {"backend": "native", "num_objects": 1, "render_mode": "rgb_array"}
    env = gym_env.InteractiveNavEnv("turtlebot", [str(room)], **settings)
    assert env.metadata["render_fps"] == 10 and env.render() is None
    env.reset(seed=0)
    frame = env.render()
    assert frame is not None and frame.shape == (360, 480, 3) and frame.dtype == np.uint8
    # The robot stands before the camera: its dark body is in the middle column.
    assert frame[150:260, 200:280].min() < 60
    assert yaw_from_quat(np.array([math.cos(0.4), 0, 0, math.sin(0.4)])) == pytest.approx(0.8)
    with pytest.raises(UserError, match="render_mode is 'human', expected one of rgb_array"):
        gym_env.InteractiveNavEnv("turtlebot", [str(room)], **{**settings, "render_mode": "human"})


def test_detached_bodies_are_placed_one_by_one_and_mujoco_does_not_complain():
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="arm" pos="1 0 0"><joint/>
      <geom size=".1" mass="1"/><body name="hand" pos="0 2 0"><joint axis="1 0 0"/>
      <geom size=".1" mass="1" pos="0 0 3"/></body></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    detach(model, data)
    assert data.body("hand").xpos.tolist() == [1, 2, 0] and data.geom_xpos[1].tolist() == [1, 2, 3]
    model.body("arm").pos[:] = 5, 5, 5
    mujoco.mj_forward(model, data)  # as the renderer of MJX-Warp does
    assert data.geom_xpos.tolist() == [[5, 5, 5], [1, 2, 3]]
    assert [warning.number for warning in data.warning] == [0] * len(data.warning)
