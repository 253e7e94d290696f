"""Pictures for people, drawn by rays: they run everywhere, so do these tests."""

import functools
import importlib.util
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav.pictures.camera import STREAMS, PictureCamera, SceneView
from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import pick
from interactive_nav.scenes.scene import load_scene
from interactive_nav.scenes.world import build_world
from interactive_nav.sensing import build_boxes
from interactive_nav.sensing.boxes import PALETTES
from interactive_nav.sensing.rays import RayRenderer
from interactive_nav.sensing.sensors import Sensors
from interactive_nav_common.errors import UserError
from scenes_mjcf.categories import SEGMENTATIONS
from tests.toys import write_room


@pytest.fixture(scope="module")
def scene_and_state(world):
    """What a camera asks of an environment, and the second scene at rest with the robot at (1, 1.4), heading -x."""
    env = types.SimpleNamespace(world=world, scenes=world.scenes, sensors=Sensors(world, NavConfig(), "native"))
    qpos = world.rest_qpos[1].copy()
    at = world.layout.robot_qpos
    qpos[at : at + 7] = [1.0, 1.4, 0, 0, 0, 0, 1]
    info = {"nav": types.SimpleNamespace(scene_index=1)}
    return env, types.SimpleNamespace(pipeline_state=types.SimpleNamespace(qpos=qpos), info=info)


def test_the_whole_scene_from_above(scene_and_state):
    env, state = scene_and_state
    frame = PictureCamera(env, "rays").frame(state, 120, 100, STREAMS, view="top")
    assert frame["rgb"].shape == (100, 120, 3) and frame["rgb"].dtype == np.uint8
    ids = frame["segmentation"]
    # x to the right, y up: the chair (1.2, 0) right of the middle, the table (-1.2, 1) left and above, the robot.
    rows, columns = {}, {}
    for name, number in (("robot", 1), ("chair", 2), ("table", 4)):
        row, column = np.nonzero(ids == number)
        assert len(row) > 10, name
        rows[name], columns[name] = row.mean(), column.mean()
    assert columns["table"] < 60 < columns["chair"] and rows["table"] < 45
    assert rows["robot"] < rows["chair"] and 5 in ids
    # The floor's normal points at the viewer; at its edges it is as deep as near the middle.
    np.testing.assert_allclose(frame["normals"][75, 40], [0, 0, 1], atol=1e-6)
    floor = frame["depth"][ids == 0]
    assert floor.max() == pytest.approx(frame["depth"][75, 40], abs=1e-3)


def test_the_robots_own_view_is_the_sensors_view(scene_and_state):
    env, state = scene_and_state
    frame = PictureCamera(env, "rays").frame(state, 68, 68, ("rgb", "normals", "depth", "segmentation"))
    assert set(frame) == {"rgb", "normals", "depth", "segmentation"} and not (frame["segmentation"] == 1).any()
    qpos = jnp.asarray(state.pipeline_state.qpos, jnp.float32)[None]
    camera = env.sensors.mount.pose(qpos)
    renderer = RayRenderer(build_boxes(env.world, colours=True), env.sensors.lens)
    seen = jax.jit(functools.partial(renderer.images_batch, ("rgb",)))(jnp.ones(1, jnp.int32), qpos, camera)
    depth, ids = seen["depth"], seen["segmentation"]
    # The toy scene's furniture is drawn as its boxes; its walls have no visual mesh but themselves.
    assert np.mean(np.abs(frame["depth"] - depth[0]) < 0.01) > 0.99
    assert np.mean(frame["segmentation"] == ids[0]) > 0.99
    assert np.mean(np.abs(frame["rgb"] - 255 * seen["rgb"][0]).max(-1) < 1.0) > 0.99
    assert np.mean(np.abs(frame["normals"] - seen["normals"][0]).max(-1) < 1e-3) > 0.99


@pytest.mark.parametrize(("classes", "own"), [(4, {4, 6, 8}), (5, {11, 6, 8}), ("all", {3, 7, 8, 9, 10})])
def test_pictures_have_the_masks_ids_of_each_model(tmp_path, classes, own):
    """The second basket is 8 to both, and a desk 4 or, apart from tables, 11; or each category has one id."""
    room = write_room(tmp_path / "room", blocks=(("desk", 0.7, 0.5, 9.0, 0.5),))
    config = NavConfig.of(num_objects=6, segmentation_classes=classes)
    world = build_world(get_robot("turtlebot"), (load_scene(room),), config)
    env = types.SimpleNamespace(world=world, scenes=world.scenes, sensors=Sensors(world, config, "native"))
    qpos = world.rest_qpos[0].copy()
    for slot, kind in enumerate(world.layout.slot_kind):
        if kind == "small":
            qpos[world.layout.slot_qpos[slot] : world.layout.slot_qpos[slot] + 2] = [-1.5 + 0.6 * slot, -0.5]
    qpos[world.layout.robot_qpos : world.layout.robot_qpos + 2] = [-1.2, 1.0]
    state = types.SimpleNamespace(
        pipeline_state=types.SimpleNamespace(qpos=qpos), info={"nav": types.SimpleNamespace(scene_index=0)}
    )
    seen = set(
        np.unique(PictureCamera(env, "rays").frame(state, 160, 120, ("segmentation",), view="top")["segmentation"])
    )
    observed = set(np.unique(env.sensors.boxes.class_id[0]))
    assert seen == observed | {1} and own <= seen
    view = SceneView(get_robot("turtlebot"), world.scenes[0], pick(6), classes)
    assert set(np.unique(view.class_id)) == seen
    assert [SEGMENTATIONS[4].names[k] for k in (7, 8, 10)] == ["pot", "basket", "shoe"]
    colours = SEGMENTATIONS[classes].colours
    np.testing.assert_allclose(PALETTES[classes][: len(colours)], colours, atol=1e-6)


def test_the_follower_sees_the_robot(scene_and_state):
    env, state = scene_and_state
    frame = PictureCamera(env, "rays").frame(state, 60, 60, ("segmentation",), view="follow")
    assert 1 in frame["segmentation"][20:40, 20:40]


def test_what_cannot_be_drawn_is_refused(scene_and_state):
    env, state = scene_and_state
    camera = PictureCamera(env, "rays")
    with pytest.raises(UserError, match="engine is 'opengl', expected one of auto, gl, warp, rays"):
        PictureCamera(env, "opengl")
    with pytest.raises(UserError, match="streams is .*, expected a choice from rgb, normals, depth, segmentation"):
        camera.frame(state, streams=("colour",))
    with pytest.raises(UserError, match="view is 'side', expected one of robot, top, follow"):
        camera.frame(state, view="side")
    batch = types.SimpleNamespace(pipeline_state=types.SimpleNamespace(qpos=np.zeros((3, 9))), info=state.info)
    with pytest.raises(UserError, match=r"state is a batch of shape \(3,\), expected one environment"):
        camera.frame(batch)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="the package warp-lang (extra 'warp') is absent")
def test_mjx_warp_draws_the_same_colours(scene_and_state):
    """Lamps and the floor differ between the two; what is where, and in which colour, does not."""
    env, state = scene_and_state
    drawn = PictureCamera(env, "warp").frame(state, 32, 24, ("rgb",), view="top")["rgb"]
    rays = PictureCamera(env, "rays").frame(state, 32, 24, ("rgb", "segmentation"), view="top")
    assert drawn.shape == (24, 32, 3) and drawn.dtype == np.uint8
    chair, table = rays["segmentation"] == 2, rays["segmentation"] == 4
    got, want = (picture[chair].mean(0) - picture[table].mean(0) for picture in (drawn.astype(float), rays["rgb"]))
    assert got @ want / (np.linalg.norm(got) * np.linalg.norm(want)) > 0.95
