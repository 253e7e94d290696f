"""The viewer's command: which viewer is taken, what is said where none can open, and the model it shows."""

from __future__ import annotations

import contextlib
import sys
import types
import urllib.error
import urllib.request
from pathlib import Path

import mujoco
import numpy as np
import pytest

from interactive_nav import view
from interactive_nav.robots import get_robot
from interactive_nav.scenes.objects import pick
from interactive_nav.scenes.scene import load_scene
from tests.gl_program import drawn, need_gl

ROOT = Path(__file__).parents[2]


def offer(monkeypatch, window: bool, browser: bool) -> None:
    monkeypatch.setattr(view, "can_open_window", lambda: window)
    monkeypatch.setattr(view, "has_browser_viewer", lambda: browser)


@pytest.mark.parametrize(
    ("wanted", "window", "browser", "chosen"),
    [
        ("auto", True, True, "window"),
        ("auto", True, False, "window"),
        ("auto", False, True, "browser"),
        ("browser", True, True, "browser"),
    ],
)
def test_a_window_where_there_is_a_screen_else_the_browser(monkeypatch, wanted, window, browser, chosen):
    offer(monkeypatch, window, browser)
    assert view.choose_viewer(wanted) == chosen


@pytest.mark.parametrize(
    ("wanted", "has", "message"),
    [("auto", False, "no screen to open a window on, and a view in the browser needs mjviser"),
     ("browser", False, "^a view in the browser needs mjviser"),
     ("window", True, "no screen to open a window on; .* --viewer browser")],
)  # fmt: skip
def test_what_is_missing_is_said(monkeypatch, wanted, has, message):
    offer(monkeypatch, window=False, browser=has)
    with pytest.raises(view.ViewError, match=message):
        view.choose_viewer(wanted)


def test_without_a_display_and_mjviser_the_command_says_so_in_one_line(room, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(view, "has_browser_viewer", lambda: False)  # GLFW is really asked
    monkeypatch.setattr("sys.platform", "linux")
    assert view.main([str(room), "--objects", "2"]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert error == [
        "interactive_nav.view: no screen to open a window on, and a view in the browser needs mjviser, "
        "which is not installed; pip install 'interactive-nav[view]'"
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robot", "turtlbot"], "unknown robot 'turtlbot', did you mean 'turtlebot'"),
        (["--objects", "-1"], "--objects is -1, expected 0 or more"),
        (["--objects", "400"], "no place for object"),
    ],
)
def test_bad_arguments_give_one_line(room, capsys, arguments, message):
    assert view.main([str(room), *arguments]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and message in error[0]


def test_the_chosen_viewer_is_given_the_model(room, monkeypatch):
    opened = []
    offer(monkeypatch, window=False, browser=True)
    monkeypatch.setattr(view, "open_browser", lambda model, data, *where: opened.append((model.nbody, *where)))
    assert view.main([str(room), "--robot", "turtlebot", "--objects", "1", "--port", "9000"]) == 0
    # World, structure, the room's cube, robot with two wheels, one small object.
    assert opened == [(7, "127.0.0.1", 9000)]


def test_the_browsers_page_opens_where_the_window_does(room, monkeypatch):
    """With a stand-in for mjviser 0.0.14: at the centre, from spherical coordinates around the world's origin."""
    seen = {}

    class Viewer:
        def __init__(self, model, data, render_fn, server):
            def create_scene_gui(camera_distance, camera_azimuth, camera_elevation):
                turn, up = np.radians((camera_azimuth, camera_elevation))
                flat = -np.cos(up) * np.array([np.cos(turn), np.sin(turn)])
                seen.update(eye_w=camera_distance * np.array([*flat, np.sin(up)]), at_w=model.stat.center.copy())

            self.scene = types.SimpleNamespace(camera_tracking_enabled=True, create_scene_gui=create_scene_gui)
            seen.update(host=server.get_host(), time=data.time)
            self._server = server

        def run(self):
            self.scene.create_scene_gui()
            seen["tracking"] = self.scene.camera_tracking_enabled
            page = urllib.request.Request(
                f"http://127.0.0.1:{self._server.get_port()}", headers={"Host": "evil.example"}
            )
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(page)
            self._server.stop()

    pytest.importorskip("viser", reason="viser is not installed (pip install 'viser>=1.1,<1.2')")
    monkeypatch.setitem(sys.modules, "mjviser", types.SimpleNamespace(Viewer=Viewer))
    model = view.build_model(room, None, [])
    model.stat.center[:] = 3.0, -2.0, 0.5
    model.vis.global_.azimuth, model.vis.global_.elevation = 120.0, -30.0
    view.open_browser(model, mujoco.MjData(model), "127.0.0.1", 0)
    assert (seen["host"], seen["time"], seen["tracking"]) == ("127.0.0.1", 0.0, False)
    np.testing.assert_allclose(seen["at_w"], [3.0, -2.0, 0.5])
    away_m = 1.5 * model.stat.extent  # along x -1/2, along y sqrt(3)/2 of the level share, sqrt(3)/2; down by 1/2
    ahead = np.array([-np.sqrt(3) / 4, 3 / 4, -1 / 2])
    np.testing.assert_allclose(seen["eye_w"], seen["at_w"] - away_m * ahead, atol=1e-5)


FIRST_PICTURE = """
import os, sys
os.environ["MUJOCO_GL"] = "egl"
import numpy as np
import mujoco
from interactive_nav import view
shown = []
view.choose_viewer, view.open_window = lambda wanted: "window", lambda *what: shown.extend(what)
assert view.main([sys.argv[2], "--seed", sys.argv[4], "--robot", sys.argv[3]]) == 0
model, data = shown
camera = mujoco.MjvCamera()
mujoco.mjv_defaultFreeCamera(model, camera)
picture = mujoco.Renderer(model, 480, 640)
picture.enable_segmentation_rendering()
picture.update_scene(data, camera)
geom, kind = np.moveaxis(picture.render(), -1, 0)
root = model.body_rootid[model.geom_bodyid[np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, geom, 0)]]
np.savez(sys.argv[1], robot=root == model.body(sys.argv[3] + "_base").id, eye=picture.scene.camera[0].pos)
picture.close()
"""


@pytest.mark.parametrize(
    ("scene", "robot", "seed"), [("alder", "turtlebot", 0), ("apartment_0", "fetch", 0), ("drawn/flat", "turtlebot", 1)]
)
def test_a_window_opens_where_the_robot_is_in_sight(tmp_path, monkeypatch, scene, robot, seed):
    need_gl()
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    made = drawn(FIRST_PICTURE, tmp_path, ROOT / "scenes_mjcf" / scene, robot, str(seed))
    rows, columns = np.nonzero(made["robot"])
    assert len(rows) > 2000  # a TurtleBot at 4 m is 60 pixels high and 50 wide
    assert abs(rows.mean() - 240) < 80 and abs(columns.mean() - 320) < 80
    assert 0.3 < made["eye"][2] < 4.5


@pytest.mark.parametrize(("name", "back_m", "high_m"), [("follow", 1.8, 1.8), ("eye", 2.6, 1.5)])
def test_views_from_behind_look_at_the_robots_middle_as_films_do(two_rooms, monkeypatch, name, back_m, high_m):
    shown, robot = [], get_robot("turtlebot")
    offer(monkeypatch, window=True, browser=False)
    monkeypatch.setattr(view, "open_window", lambda model, data: shown.append((model, data)))
    assert view.main([str(two_rooms), "--robot", "turtlebot", "--objects", "0", "--view", name]) == 0
    model, data = shown[0]
    assert model.camera(model.vis.global_.cameraid).name == name
    base, camera = data.body(robot.base_body), data.camera(name)
    ahead = base.xmat.reshape(3, 3)[:, 0]
    at = base.xpos * [1, 1, 0] - back_m * ahead + [0, 0, high_m]
    np.testing.assert_allclose(camera.xpos, at, atol=2e-3)
    to_middle = base.xpos * [1, 1, 0] + [0, 0, robot.height_m / 2] - at
    np.testing.assert_allclose(-camera.xmat.reshape(3, 3)[:, 2], to_middle / np.linalg.norm(to_middle), atol=2e-3)
    assert abs(camera.xmat.reshape(3, 3)[2, 0]) < 2e-3  # no roll


def test_a_view_of_a_robot_needs_one(room, capsys):
    assert view.main([str(room), "--view", "eye", "--robot", "none"]) == 2
    assert "--view eye is of a robot, and none is in the scene; leave out --robot none" in capsys.readouterr().err


def test_the_browsers_page_looks_through_the_robots_camera(two_rooms, monkeypatch):
    client = types.SimpleNamespace(camera=types.SimpleNamespace(), atomic=contextlib.nullcontext)
    server = types.SimpleNamespace(get_clients=lambda: {0: client})

    class Viewer:
        def __init__(self, model, data, render_fn, server):
            self.scene = types.SimpleNamespace(
                update_from_mjdata=lambda data: None, create_scene_gui=lambda **where: None
            )
            self._draw = render_fn

        def run(self):
            self._draw(self.scene)

    monkeypatch.setattr(view, "guarded_server", lambda *_: (server, "http://localhost"))
    monkeypatch.setitem(sys.modules, "mjviser", types.SimpleNamespace(Viewer=Viewer))
    model = view.build_model(two_rooms, get_robot("turtlebot"), [])
    model.vis.global_.cameraid = model.camera("eye").id
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view.open_browser(model, data, "127.0.0.1", 8123)
    eye = data.camera("eye")
    np.testing.assert_allclose(client.camera.position, eye.xpos)
    np.testing.assert_allclose(client.camera.position - client.camera.look_at, eye.xmat.reshape(3, 3)[:, 2])
    assert client.camera.fov == pytest.approx(np.pi / 3)


def test_what_is_placed_stands_free_at_rest_and_is_seen(two_rooms):
    robot, small = get_robot("turtlebot"), pick(4)
    model = view.build_model(two_rooms, robot, small, seed=3)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for contact in data.contact[: data.ncon]:
        names = {model.geom(g).name for g in contact.geom}
        assert "floor" in names or contact.dist > -2e-3, names
    start = data.xpos.copy()
    for _ in range(200):
        mujoco.mj_step(model, data)
    placed = [b for b in range(model.nbody) if "small" in model.body(b).name or "turtlebot" in model.body(b).name]
    assert len(placed) == 7 and np.linalg.norm(data.xpos - start, axis=1)[placed].max() < 0.03
    for name in (robot.base_body, "basket_small_0"):
        body = model.body(name).id
        assert (model.geom_group[model.geom_bodyid == body] <= 2).any()
    assert model.body("basket_small_0").subtreemass[0] == pytest.approx(0.9)


def test_places_keep_clear_of_walls_furniture_and_each_other(two_rooms):
    scene = load_scene(two_rooms)
    places = view.place_discs(scene, [0.2] * 5, 0.4, np.random.default_rng(0))
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9 * np.eye(5)
    assert gaps.min() > 0.4
    assert (np.abs(places[:, 0]) < 2.5 - 0.2).all() and (np.abs(places[:, 1]) < 2.0 - 0.2).all()
    for movable in scene.movables:
        if movable.joint is None:
            half = movable.boxes[0, 7:9]
            outside = np.maximum(np.abs(places - movable.pos_w[:2]) - half, 0)
            assert np.linalg.norm(outside, axis=1).min() > 0.2
