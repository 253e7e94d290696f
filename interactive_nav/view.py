"""Run `python -m interactive_nav.view SCENE`: open a scene with a robot and clutter in MuJoCo's viewer.

Without a screen, it opens a page in the browser (mjviser, an optional dependency).
"""

import contextlib
import functools
import importlib
import importlib.util
import itertools
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import mujoco
import numpy as np

from interactive_nav.navigation.tables import furniture_map
from interactive_nav.pictures.camera import BEHIND_M
from interactive_nav.pictures.scene_model import furnished_spec
from interactive_nav.robots import RobotSpec, get_robot, robot_names
from interactive_nav.scenes.objects import VISUAL_GROUP, SmallObject, add_shapes, body_names, pick
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav_common.commands import Command, option, parse, word
from interactive_nav_common.config import Natural
from interactive_nav_common.errors import UserError, missing, reports_errors
from interactive_nav_common.grids import cell_centres, clearance
from interactive_nav_common.untrusted.guard import guarded_server
from scenes_mjcf.look import cast, look_along

GAP_M = 0.03
"""Least gap between what is placed at random."""
FIRST_VIEWS = (4.0, 3.0, 2.0, 1.2), (-35.0, -50.0, -20.0, -70.0), range(90, 450, 15)
"""Views of the robot in order of preference: m between its outline and the camera, elevation and azimuth, degrees."""


class ViewError(UserError):
    """No viewer can open; the message says what to install."""


def can_open_window() -> bool:
    """Return whether GLFW, which MuJoCo's viewer draws with, finds a screen."""
    try:
        glfw = importlib.import_module("glfw")
    except ImportError:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opened = bool(glfw.init())
        if opened:
            glfw.terminate()
    return opened


def has_browser_viewer() -> bool:
    return importlib.util.find_spec("mjviser") is not None


def choose_viewer(wanted: str) -> str:
    """Return 'window' or 'browser'; of `auto`, a window where there is a screen."""
    if wanted in ("auto", "window") and can_open_window():
        return "window"
    if wanted == "window":
        raise ViewError("no screen to open a window on; log in with one (ssh -X does), or use --viewer browser")
    if has_browser_viewer():
        return "browser"
    why = "no screen to open a window on, and " if wanted == "auto" else ""
    raise ViewError(why + missing("a view in the browser", "mjviser", "view"))


def place_discs(scene: Scene, radii_m: Sequence[float], height_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return random places (n, 2), m, where discs keep clear of walls, furniture below a height and each other."""
    maps = scene.maps
    poses = {m.name: (m.pos_w, m.quat_w) for m in scene.movables}
    room_m = clearance(maps.traversable & ~furniture_map(scene, poses, height_m), maps.resolution_m)
    places: list[np.ndarray] = []
    for k, radius in enumerate(radii_m):
        free = cell_centres(room_m >= radius + GAP_M, maps.resolution_m, maps.origin_w)
        for xy, other in zip(places, radii_m, strict=False):
            free = free[np.linalg.norm(free - xy, axis=-1) > radius + other + GAP_M]
        if not len(free):
            raise ViewError(f"{scene.name}: no place for object {k} of radius {radius:.2f} m; ask for fewer --objects")
        places.append(free[rng.integers(len(free))])
    return np.array(places).reshape(-1, 2)


def build_model(folder: Path, robot: RobotSpec | None, small: Sequence[SmallObject], seed: int = 0) -> mujoco.MjModel:
    """Return the scene as stored, with textures and hulls, a robot and small objects at random free places."""
    scene = load_scene(folder)
    rng = np.random.default_rng(seed)
    radii = [robot.footprint_radius_m] if robot else []
    height_m = max([robot.height_m if robot else 0.0, *(o.height_m for o in small)], default=0.0)
    places = place_discs(scene, [*radii, *(o.radius_m for o in small)], max(height_m, 0.1), rng)
    spec = furnished_spec(scene, robot, small)

    def put(name: str, xy: np.ndarray, z: float) -> None:
        yaw, body = rng.uniform(-np.pi, np.pi), spec.body(name)
        body.pos, body.quat = [*xy, z], [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]

    if robot is not None:
        put(robot.base_body, places[0], robot.spawn_height_m)
        for view, (back_m, high_m) in BEHIND_M.items():
            eye = np.array([-back_m, 0.0, high_m - robot.spawn_height_m])
            pose = look_along(eye, [0.0, 0.0, robot.height_m / 2 - robot.spawn_height_m] - eye)
            camera = spec.body(robot.base_body).add_camera(name=view, pos=eye, fovy=60.0)
            camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
            camera.alt.xyaxes = pose.axes_w[:, 1:].T.ravel()
    for name, obj, xy in zip(body_names(small), small, places[len(radii) :], strict=True):
        put(name, xy, 0.0)
        add_shapes(spec.body(name), obj, name)
    model = spec.compile()
    if robot is not None:
        geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body(robot.base_body).id)
        if len(geoms) and (model.geom_group[geoms] > VISUAL_GROUP).all():  # viewers hide groups 3 and up
            model.geom_group[geoms] = VISUAL_GROUP
    return model


def aim_at_robot(model: mujoco.MjModel, data: mujoco.MjData, robot: RobotSpec) -> None:
    """Set the free camera with which viewers open so that as little as possible hides the robot."""
    is_robot = model.body_rootid[model.geom_bodyid] == model.body(robot.base_body).id
    parts_w = data.geom_xpos[is_robot & (model.geom_group <= VISUAL_GROUP)]
    model.stat.center[:], best = (parts_w.min(0) + parts_w.max(0)) / 2, -1.0
    for away_m, elevation, azimuth in itertools.product(*FIRST_VIEWS):
        camera = robot.footprint_radius_m + away_m, elevation, azimuth
        ways = parts_w - (eye_w := model.stat.center - _ahead(*camera))
        met = cast(model, data, eye_w, ways / np.linalg.norm(ways, axis=1)[:, None], range(VISUAL_GROUP + 1))[0]
        if (visible := float(np.mean((met >= 0) & is_robot[met]))) > best:
            best = visible
            model.stat.extent, model.vis.global_.elevation, model.vis.global_.azimuth = camera[0] / 1.5, *camera[1:]
        if best == 1.0:
            return


def _ahead(distance_m: float, elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return the way (3,) from a free camera to the point that it looks at, m."""
    up, turn = np.radians((elevation_deg, azimuth_deg))
    return distance_m * np.array([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)])


def open_window(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Open MuJoCo's viewer; return when its window is closed."""
    importlib.import_module("mujoco.viewer").launch(model, data)


def open_browser(model: mujoco.MjModel, data: mujoco.MjData, host: str, port: int) -> None:
    """Serve mjviser's page until Ctrl-C: it opens as the window does, or keeps to the camera `vis.global.cameraid`."""
    mjviser, first = importlib.import_module("mjviser"), model.vis.global_
    (server, address), camera = guarded_server(host, port, "view", "view"), first.cameraid
    print(f"{address} (Ctrl-C ends it)", flush=True)

    def draw(scene: Any) -> None:
        scene.update_from_mjdata(data)
        for client in server.get_clients().values() if camera >= 0 else ():
            with client.atomic():
                client.camera.position = data.cam_xpos[camera]
                client.camera.look_at = data.cam_xpos[camera] - data.cam_xmat[camera].reshape(3, 3)[:, 2]
                client.camera.fov = np.radians(model.cam_fovy[camera])

    viewer = mjviser.Viewer(model, data, render_fn=draw, server=server)
    viewer.scene.camera_tracking_enabled = False  # it follows a body of its choice
    # mjviser looks at the model's centre, from a place in spherical coordinates around the world's origin.
    x, y, z = model.stat.center - _ahead(1.5 * model.stat.extent, first.elevation, first.azimuth)
    viewer.scene.create_scene_gui = functools.partial(
        viewer.scene.create_scene_gui,
        camera_distance=float(np.linalg.norm((x, y, z))),
        camera_azimuth=float(np.degrees(np.arctan2(-y, -x))),
        camera_elevation=float(np.degrees(np.arctan2(z, np.hypot(x, y)))),
    )
    viewer.run()


class View(Command):
    """Look at a scene in a window or in the browser."""

    scene: Annotated[Path, *word("SCENE")]
    """Scene folder."""
    robot: Annotated[str, option(metavar="NAME|FILE")] = "turtlebot"
    """Robot to place: a name, a URDF or MJCF file, path.py:function, or none."""
    objects: Natural = 10
    """Number of small objects to place."""
    small_objects: Literal["train", "test"] = "train"
    """Split that the small objects come from."""
    seed: int = 0
    """Random seed of the objects' places."""
    view: Literal["whole", "follow", "eye"] = "whole"
    """Camera: whole moves freely; follow and eye stay behind the robot, 1.8 m and 1.5 m above the floor."""
    viewer: Literal["auto", "window", "browser"] = "auto"
    """Viewer to open; auto opens a window if there is a screen, otherwise the browser."""
    host: Annotated[str, option(metavar="ADDRESS")] = "127.0.0.1"
    """Address of the browser's viewer. Addresses that other machines reach need a token, which is printed."""
    port: int = 8080
    """TCP port of the browser's viewer."""

    @classmethod
    def epilog(cls) -> str:
        return f"robots: {', '.join(robot_names())}"


@reports_errors("interactive_nav.view")
def main(argv: Sequence[str] | None = None) -> int:
    """Open a viewer; return 0 when it was closed, 2 with one line on stderr when none can open."""
    arguments = parse(View, "python -m interactive_nav.view", argv)
    robot = None if arguments.robot == "none" else get_robot(arguments.robot)
    small = pick(arguments.objects, arguments.small_objects)
    if arguments.view != "whole" and robot is None:
        raise ViewError(f"--view {arguments.view} is of a robot, and none is in the scene; leave out --robot none")
    model = build_model(arguments.scene, robot, small, arguments.seed)
    if arguments.view != "whole":
        model.vis.global_.cameraid = model.camera(arguments.view).id
    viewer = choose_viewer(arguments.viewer)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    if robot is not None:
        aim_at_robot(model, data, robot)
    if viewer == "window":
        open_window(model, data)
    else:
        with contextlib.suppress(KeyboardInterrupt):
            open_browser(model, data, arguments.host, arguments.port)
    return 0


if __name__ == "__main__":
    sys.exit(main())
