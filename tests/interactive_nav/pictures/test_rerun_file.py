"""Rerun recordings, read back by Rerun's own reader, against the replay and the environment's scores."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interactive_nav
from interactive_nav import record
from interactive_nav.pictures import replay
from interactive_nav.pictures.camera import SceneView
from interactive_nav.pictures.replay import EpisodePlayer
from interactive_nav.pictures.rerun_file import write_recording
from interactive_nav.scenes.scene import load_scene
from interactive_nav.types import EpisodeStart
from interactive_nav_common.rotations import yaw_from_quat

rerun_chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (pip install 'interactive-nav[rerun]')")
STEPS, EVERY = 20, 8


@pytest.fixture(scope="module")
def env(room):
    return interactive_nav.make("turtlebot", [room], backend="native", num_objects=1, episode_steps=STEPS, k_int=0.5)


START = EpisodeStart(
    scene_index=jnp.zeros(1, jnp.int32),
    start_xy_w=jnp.array([[-0.1, -0.2]]),
    start_yaw_rad=jnp.array([0.25]),
    goal_xy_w=jnp.array([[1.5, 1.0]]),
    small_xy_w=jnp.array([[-1.2, 1.0]]),
    small_yaw_rad=jnp.ones((1, 1)),
    small_placed=jnp.ones((1, 1), bool),
)
"""Towards the cube, whose side is at x = 0.5."""
AHEAD = jnp.array([0.4, 0.4])


@pytest.fixture(scope="module")
def played(env):
    player = EpisodePlayer(env, lambda observation, key: AHEAD, "ahead")
    return player.play(jax.random.PRNGKey(3), start=START)


@pytest.fixture(scope="module")
def states(env):
    """States of the same episode, played by hand."""
    first = jax.tree.map(lambda x: x[0], START)
    out, step = [jax.jit(env.reset_to)(first, jax.random.PRNGKey(3))], jax.jit(env.step)
    for _ in range(STEPS):
        out.append(step(out[-1], AHEAD))
    return out


@pytest.fixture(scope="module")
def entities(env, played, room, tmp_path_factory):
    """Entity -> component -> times, s (None: it always holds), and values."""
    path = tmp_path_factory.mktemp("rerun") / "a.rrd"
    view, counts = SceneView(env.robot, load_scene(room), played.small), []
    assert write_recording(played, view, path, 24, EVERY, counts.append) == 4 and counts == [1, 2, 3, 4]
    return read(path)


def read(path: Any) -> dict[str, dict[str, tuple[np.ndarray | None, list]]]:
    out: dict[str, dict[str, tuple[np.ndarray | None, list]]] = {}
    for chunk in rerun_chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        assert chunk.is_static or chunk.timeline_names == ["time"]
        times = None if chunk.is_static else batch["time"].cast("int64").to_numpy() / 1e9
        for name in batch.schema.names:
            kind, _, part = name.partition(":")
            if part and kind[0].isupper():
                values = out.setdefault(chunk.entity_path, {})
                old = values.get(name, (None if times is None else times[:0], []))
                joined = None if times is None or old[0] is None else np.concatenate([old[0], times])
                values[name] = joined, old[1] + batch[name].to_pylist()
    return out


def series(entities: Any, entity: str, component: str) -> tuple[np.ndarray, np.ndarray]:
    times, values = entities[entity][component]
    return times, np.array(values)


def test_the_robot_and_the_objects_are_where_they_were(entities, played):
    times, pos_w = series(entities, "/world/robot/turtlebot_base", "Transform3D:translation")
    np.testing.assert_allclose(times, 0.1 * np.arange(STEPS + 1), atol=1e-9)
    for step in (0, 15):
        np.testing.assert_allclose(pos_w[step, 0], played.body_pos_w[step, 0], atol=1e-6)
    assert np.linalg.norm(pos_w[15, 0] - pos_w[0, 0]) > 0.2
    _, quat = series(entities, "/world/robot/turtlebot_base", "Transform3D:quaternion")  # x y z w
    yaw = 2 * np.arctan2(quat[:, 0, 2], quat[:, 0, 3])
    turn = np.exp(1j * yaw) / np.exp(1j * yaw_from_quat(played.body_quat_w[:, 0]))
    np.testing.assert_allclose(turn, 1, atol=1e-4)
    places = {"/world/robot/turtlebot_base"}  # whose mesh has the wheels
    places |= {f"/world/objects/{name}" for name in played.bodies[played.num_robot_bodies :]}
    assert "/world/objects/chair_0" in places
    others = {"camera", "camera/rgb", "camera/depth", "camera/segmentation", "goal", "path", "structure/cut_walls"}
    places |= {"/world/robot/turtlebot_base/waypoints"} | {f"/world/{name}" for name in others}
    assert {name for name in entities if name.startswith("/world") and not name.rpartition("/")[2].isdigit()} == places


def test_shapes_have_the_sizes_of_what_they_show(entities):
    """The chair is a cube of 0.4 m, the room 4 x 3 m; views from outside have its walls cut at 0.55 m."""

    def boxes(entity: str) -> list[tuple[np.ndarray, ...]]:
        parts = [p for name, p in entities.items() if name.startswith(entity) and "Boxes3D:half_sizes" in p]
        return [tuple(np.array(p[f"Boxes3D:{n}"][1][0][0]) for n in ("centers", "half_sizes")) for p in parts]

    ((_, half_m),) = boxes("/world/objects/chair_0/")
    np.testing.assert_allclose(half_m, 0.2, atol=1e-6)
    walls = boxes("/world/structure/cut_walls/")
    assert len(walls) == 4 and all(centre[2] + half[2] == pytest.approx(0.55) for centre, half in walls)
    np.testing.assert_allclose(np.max([np.abs(centre[:2]) for centre, _ in walls], 0), [2.0, 1.5], atol=0.25)


def test_reward_terms_are_the_environments(states, entities, played):
    """The potential adds up to the progress; a touched object costs 0.5 a step; with success they are the reward."""
    names = [name for name in entities if name.startswith("/reward/")]
    assert sorted(names) == ["/reward/interaction", "/reward/potential", "/reward/success"]
    times, reward = series(entities, "/reward", "Scalars:scalars")
    np.testing.assert_allclose(times, 0.1 * np.arange(1, STEPS + 1), atol=1e-9)
    terms = {name: series(entities, name, "Scalars:scalars")[1] for name in names}
    np.testing.assert_allclose(sum(terms.values()), reward, atol=1e-6)
    assert reward.sum() == pytest.approx(played.reward.sum(), abs=1e-5)
    touched = played.metrics["interaction_steps"]
    assert touched > 0 and terms["/reward/interaction"].sum() == pytest.approx(-0.5 * touched)
    progress = float(states[0].info["nav"].geodesic_m - states[-1].info["nav"].geodesic_m)
    assert terms["/reward/potential"].sum() == pytest.approx(progress, abs=1e-3)
    _, force_n = series(entities, "/force", "Scalars:scalars")
    assert force_n.sum() == pytest.approx(played.metrics["force_sum_n"], rel=1e-3) and force_n.sum() > 1


def test_waypoints_and_goal_are_where_the_episode_has_them(env, states, entities):
    times, waypoints_b = series(entities, "/world/robot/turtlebot_base/waypoints", "Points3D:positions")
    assert waypoints_b.shape == (STEPS + 1, env.config.num_waypoints, 3) and len(times) == STEPS + 1
    for step in (0, 12):
        np.testing.assert_allclose(waypoints_b[step, :, :2], states[step].info["nav"].waypoints_b, atol=1e-3)
    _, (centre,) = entities["/world/goal"]["Ellipsoids3D:centers"]
    np.testing.assert_allclose(centre[0][:2], [1.5, 1.0], atol=1e-6)


def test_images_of_the_robots_camera(entities, played):
    """One set every eighth step and one at the end; the pinhole has the episode's field of view."""
    times, (buffer, *_) = entities["/world/camera/depth"]["DepthImage:buffer"]
    np.testing.assert_allclose(times, [0.0, 0.8, 1.6, 2.0], atol=1e-9)
    depth = np.frombuffer(bytes(buffer[0]), np.float32).reshape(24, 24)
    assert 0 < depth[12, 12] < 5
    for name, component in (("rgb", "EncodedImage:blob"), ("segmentation", "SegmentationImage:buffer")):
        assert len(entities[f"/world/camera/{name}"][component][1]) == 4
    matrix = np.array(entities["/world/camera"]["Pinhole:image_from_camera"][1][0][0]).reshape(3, 3).T
    assert 2 * np.degrees(np.arctan(12 / matrix[1, 1])) == pytest.approx(played.image_fov_deg, abs=1e-4)
    axes = np.array(entities["/world/camera"]["Transform3D:mat3x3"][1][0][0]).reshape(3, 3)  # right, down, ahead
    yaw = float(yaw_from_quat(played.body_quat_w[:1, 0])[0])
    np.testing.assert_allclose(axes[0], [np.sin(yaw), -np.cos(yaw), 0], atol=1e-3)
    assert axes[1, 2] < -0.5 and axes[2, :2] @ [np.cos(yaw), np.sin(yaw)] > 0.5


def test_views_have_no_effect_on_a_recording(played, tmp_path, capsys):
    replay.save_replay(played, tmp_path / "a.npz")
    assert record.main([str(tmp_path / "a.npz"), "--rerun", str(tmp_path / "a.rrd"), "--views", "eye"]) == 2
    assert "--views has no effect with --rerun" in capsys.readouterr().err
